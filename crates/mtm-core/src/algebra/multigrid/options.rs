//! How the hierarchy is built and the cycle is run.

use super::precision::CyclePrecision;

/// How the hierarchy is built and the cycle is run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MultigridOptions {
    /// Degree of the Chebyshev smoother, before and after each coarse correction.
    pub smoother_degree: usize,
    /// Number of block rows at which a level is solved directly.
    pub coarsest_rows: usize,
    /// Numbers of the cycle.
    pub precision: CyclePrecision,
}

impl Default for MultigridOptions {
    fn default() -> Self {
        Self { smoother_degree: 2, coarsest_rows: 64, precision: CyclePrecision::Double }
    }
}
