//! What the solves of one plan share: the length that tolerances refer to, the work done, the interrupt.

use crate::statics::options::Interrupt;

/// Counters of the linear solves of one plan.
#[derive(Default)]
pub(crate) struct Effort {
    /// Estimated error of the last solve, mm.
    pub error_estimate: f64,
    /// Iterations of all solves.
    pub iterations: usize,
    /// Residual measure of each.
    pub history: Vec<f64>,
}

impl Effort {
    /// Adds the iterations of a solve, with the residual measure of each.
    pub fn add(&mut self, iterations: usize, history: Vec<f64>) {
        self.iterations += iterations;
        self.history.extend(history);
    }
}

/// The solve of one plan.
pub(crate) struct Solve<'a> {
    /// Length that the tolerance refers to: the largest prescribed displacement, mm.
    pub scale: f64,
    pub interrupted: Interrupt<'a>,
    pub effort: Effort,
}

impl<'a> Solve<'a> {
    /// A solve that has done nothing yet.
    pub fn new(scale: f64, interrupted: Interrupt<'a>) -> Self {
        Self { scale, interrupted, effort: Effort::default() }
    }
}
