//! What the solves of one plan share: the reference length of tolerances, the work done, the interrupt.

use std::sync::Arc;

use crate::algebra::multigrid::Multigrid;
use crate::statics::options::Interrupt;

/// The solve of one plan.
pub(crate) struct PlanSolve<'a> {
    /// Reference length of the tolerance: the largest prescribed displacement, mm.
    pub scale: f64,
    pub interrupted: Interrupt<'a>,
    /// Estimated error of the last linear solve, mm.
    pub error_estimate: f64,
    /// Iterations of all solves.
    pub iterations: usize,
    /// Residual measure of each.
    pub history: Vec<f64>,
    /// Error that the answers of the last rounds of contact may have whatever the tolerance, mm.
    pub allowed: f64,
    /// The hierarchy of the body with links that push; none for that of the body alone.
    pub multigrid: Option<Arc<Multigrid>>,
}

impl<'a> PlanSolve<'a> {
    /// The record of a solve that has not started.
    pub fn new(scale: f64, interrupted: Interrupt<'a>) -> Self {
        let (error_estimate, allowed, iterations, history) = (0.0, 0.0, 0, Vec::new());
        Self { scale, interrupted, error_estimate, iterations, history, allowed, multigrid: None }
    }

    /// Adds the iterations of a solve, by the residual measure of each.
    pub fn add(&mut self, history: Vec<f64>) {
        self.iterations += history.len();
        self.history.extend(history);
    }

    /// Notes that the error is at least this, mm.
    pub fn leaves(&mut self, error: f64) {
        self.error_estimate = self.error_estimate.max(error);
    }
}
