//! The result of a solve: displacements, forces, their accuracy, and the time spent.

use std::time::Instant;

use crate::contact::ContactResult;

/// Seconds by stage; exactly zero for a stage that the scene does not need.
pub type Timings = Vec<(&'static str, f64)>;

/// Nodes in contact with a surface of their pair, with the contact forces.
#[derive(Debug, Clone, Default)]
pub struct TouchResult {
    /// The nodes, pair by pair; a node may touch several surfaces.
    pub nodes: Vec<u32>,
    /// Distance from the surface, minus any penetration at rest, mm; negative where the node penetrates.
    pub gaps: Vec<f64>,
    /// Unit normal of the surface.
    pub normals: Vec<[f64; 3]>,
    /// Force along it, N, zero or positive.
    pub forces: Vec<f64>,
    /// Largest depth of one of the nodes inside a deformed tet of other tissue, mm, limited by the size of that
    /// tet.
    pub overlap: f64,
    /// Rounds of the method of multipliers.
    pub rounds: usize,
    /// Whether gaps, forces and changes are within the tolerance.
    pub converged: bool,
}

impl TouchResult {
    /// Largest depth of a node behind its surface or inside other tissue, mm.
    pub fn penetration(&self) -> f64 {
        self.gaps.iter().fold(self.overlap, |m, gap| m.max(-gap))
    }
}

/// Displacements of the rows after a solve, with contact if nodes slide.
#[derive(Default)]
pub(crate) struct SolvedRows {
    /// mm.
    pub rows: Vec<[f64; 3]>,
    pub contact: Option<ContactResult>,
    /// Time that contact took, s.
    pub contact_seconds: f64,
    /// What touches, and the force of it on each row, N; none without parts that may touch.
    pub touching: TouchResult,
    pub pushes: Vec<[f64; 3]>,
}

impl SolvedRows {
    /// Displacements of a body without parts that may touch.
    pub fn new(rows: Vec<[f64; 3]>, contact: Option<ContactResult>, contact_seconds: f64) -> Self {
        Self { rows, contact, contact_seconds, ..Self::default() }
    }
}

/// Displacements under one plan.
#[derive(Debug, Clone)]
pub struct Solution {
    /// Displacement of every node, mm.
    pub displacements: Vec<[f64; 3]>,
    /// Internal force K u of every node, N; zero at free nodes, the load from the bone at the others.
    pub forces: Vec<[f64; 3]>,
    /// ‖f − loads − contact‖ over the unknown nodes, relative to the forces that the plan introduces: loads,
    /// forces of joined nodes, and for walls both the contact force and the force that each node alone would
    /// need to follow.
    pub residual: f64,
    /// Estimate of the largest nodal error of the linear solve, mm; not a bound. For iterative methods it
    /// follows from the residual and the observed spectrum, confirmed on a known solution if stiff and soft
    /// tissue are mixed; for Cholesky it is a hundred times the error with which the factorisation recovered a
    /// known solution. It refers to the exact solution of K as stored: the rounding of K itself is not
    /// included, and the error left by contact only as ten times the largest gap. `benches/stability/error_estimate.rs`
    /// measures how often it is too small.
    pub error_estimate: f64,
    /// Iterations of the linear solver (0 for Cholesky), summed over all contact iterations; for large
    /// deformation, the number of Newton steps.
    pub iterations: usize,
    /// Residual measure of each linear iteration.
    pub residual_history: Vec<f64>,
    /// Contact at the sliding nodes.
    pub contact: ContactResult,
    /// Contact of the pairs, if the boundary has any.
    pub touching: TouchResult,
    /// Steps of the contact solver, summed over all Newton steps.
    pub contact_iterations: usize,
    /// Seconds by stage.
    pub timings: Timings,
}

impl Solution {
    /// Largest |gap| of the held sliding nodes, mm; 0 if there are none.
    pub fn contact_gap(&self) -> f64 {
        self.contact.largest_gap()
    }
}

/// Stop-watch with named laps.
pub(crate) struct Clock {
    begin: Instant,
    last: Instant,
    /// Laps so far.
    pub laps: Timings,
}

impl Clock {
    pub fn new() -> Self {
        let now = Instant::now();
        Self { begin: now, last: now, laps: Vec::new() }
    }

    /// Records the time since the last lap under `stage`; exactly zero if the stage was not needed.
    pub fn lap(&mut self, stage: &'static str, needed: bool) {
        let now = Instant::now();
        let seconds = if needed { (now - self.last).as_secs_f64() } else { 0.0 };
        self.laps.push((stage, seconds));
        self.last = now;
    }

    /// Seconds since the start.
    pub fn total(&self) -> f64 {
        self.begin.elapsed().as_secs_f64()
    }
}
