//! How the hierarchy is built and the cycle is run.

use super::precision::CyclePrecision;

/// How the hierarchy is built and the cycle is run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MultigridOptions {
    /// Relative block norm above which two nodes are strongly connected; halved on each level.
    pub strength: f64,
    /// Degree of the Chebyshev smoother, before and after each coarse correction.
    pub smoother_degree: usize,
    /// Damping of the prolongator smoothing, as a multiple of 1/λ_max.
    pub prolongator_damping: f64,
    /// Number of block rows at which a level is solved directly.
    pub coarsest_rows: usize,
    /// Maximum number of levels.
    pub max_levels: usize,
    /// Numbers of the cycle.
    pub precision: CyclePrecision,
}

impl Default for MultigridOptions {
    fn default() -> Self {
        Self {
            strength: 0.08,
            smoother_degree: 2,
            // Of 4/3 to 1.6, what takes the fewest iterations on shells and heads (25 to 28).
            prolongator_damping: 1.4,
            coarsest_rows: 64,
            max_levels: 12,
            precision: CyclePrecision::Double,
        }
    }
}
