//! Mass-tensor mechanics of soft tissue.
pub mod blocks;
pub mod cholesky;
pub mod error;
pub mod krylov;
pub mod multigrid;
