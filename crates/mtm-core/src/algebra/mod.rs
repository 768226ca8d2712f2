//! Linear algebra on 3×3 blocks: sparse matrices, direct and iterative solvers, the memory they run in.

pub mod blocks;
pub mod cholesky;
pub mod constraints;
pub(crate) mod error_bound;
pub mod krylov;
pub(crate) mod line_search;
pub mod memory;
pub mod multigrid;
pub mod ordering;
pub mod pool;
pub mod relaxation;
pub(crate) mod row_sums;
pub mod simd;
