//! What a solve returns: displacements, forces, how exact they are and where the time went.

use std::time::Instant;

use crate::contact::ContactStart;

/// Seconds by stage; a stage that the scene does not need stays at exactly zero.
pub type Timings = Vec<(&'static str, f64)>;

/// Contact at the sliding nodes after a solve.
#[derive(Debug, Clone)]
pub struct ContactResult {
    /// The sliding nodes, segment by segment.
    pub nodes: Vec<u32>,
    /// Closest point of the moved contact surface, mm.
    pub points: Vec<[f64; 3]>,
    /// Unit normal that the contact force follows, out of the bone.
    pub normals: Vec<[f64; 3]>,
    /// Contact force along the normal, N; positive pushes the tissue away from the bone.
    pub forces: Vec<f64>,
    /// Distance from the surface less the prescribed gap, mm; for nodes that keep their offset at rest,
    /// distance from the surface shifted by it.
    pub gaps: Vec<f64>,
    /// Whether the node is held to the surface.
    pub active: Vec<bool>,
    /// Largest way, mm, that the force along the surface would still move a sliding node by itself.
    pub unbalanced: f64,
    /// The nodes carried back with their segments to where these were at rest; none where one is deformed.
    pub at_rest: Option<ContactStart>,
    /// Whether gaps and forces are within the tolerance. Where they are not, they are so small that no face
    /// would show it.
    pub converged: bool,
}

/// Nodes that met what they may touch, with the forces between them.
#[derive(Debug, Clone, Default)]
pub struct TouchResult {
    /// The nodes, pair by pair; a node may meet several surfaces.
    pub nodes: Vec<u32>,
    /// Distance from the surface, less what the node has behind it at rest, mm; negative where it penetrates.
    pub gaps: Vec<f64>,
    /// Unit normal of the surface.
    pub normals: Vec<[f64; 3]>,
    /// Force along it, N, not negative.
    pub forces: Vec<f64>,
    /// Deepest that one of the nodes lies in a deformed tet of other tissue, mm, no deeper than the walls of that tet.
    pub overlap: f64,
    /// Rounds of the method of multipliers.
    pub rounds: usize,
    /// Whether gaps, forces and changes are within the tolerance.
    pub converged: bool,
}

impl TouchResult {
    /// Deepest that a node is behind its surface or in other tissue, mm.
    pub fn penetration(&self) -> f64 {
        self.gaps.iter().fold(self.overlap, |m, gap| m.max(-gap))
    }
}

impl Default for ContactResult {
    /// No sliding nodes.
    fn default() -> Self {
        Self {
            nodes: Vec::new(),
            points: Vec::new(),
            normals: Vec::new(),
            forces: Vec::new(),
            gaps: Vec::new(),
            active: Vec::new(),
            unbalanced: 0.0,
            at_rest: None,
            converged: true,
        }
    }
}

/// Displacements under one plan.
#[derive(Debug, Clone)]
pub struct Solution {
    /// Displacement of every node, mm.
    pub displacements: Vec<[f64; 3]>,
    /// Internal force K u of every node, N; zero at free nodes, the bone's load at the others.
    pub forces: Vec<[f64; 3]>,
    /// ‖f − loads − contact‖ over the unknown nodes, relative to the forces that the plan brings in: loads,
    /// those of joined nodes, and of walls both their push and what each node alone would take to follow.
    pub residual: f64,
    /// Estimate of the largest nodal error of the linear solve, mm; no bound. From the residual and the
    /// spectrum that an iterative method saw, confirmed on a known solution where stiff and soft tissue are
    /// mixed; for Cholesky a hundred times the error with which the factor recovered a known solution.
    /// Against the exact solution of K as stored: what rounding K itself costs is not in it, and of what
    /// contact leaves only ten times the largest gap. `benches/error_estimate.rs` measures how often it is
    /// too small.
    pub error_estimate: f64,
    /// Iterations of the linear solver (0 for Cholesky), over all contact iterations; with large deformation
    /// Newton's steps.
    pub iterations: usize,
    /// Residual measure of each linear iteration.
    pub residual_history: Vec<f64>,
    /// Contact at the sliding nodes.
    pub contact: ContactResult,
    /// What touches, where the boundary has pairs that may.
    pub touching: TouchResult,
    /// Newton steps of the contact solver, over all of Newton's steps.
    pub contact_iterations: usize,
    /// Seconds by stage.
    pub timings: Timings,
}

impl Solution {
    /// Largest |gap| of the held sliding nodes, mm; 0 without any.
    pub fn contact_gap(&self) -> f64 {
        let c = &self.contact;
        c.gaps.iter().zip(&c.active).filter(|(_, a)| **a).fold(0.0, |m, (g, _)| m.max(g.abs()))
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

    /// Books the time since the last lap under `stage`; exactly zero where the stage was not needed.
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
