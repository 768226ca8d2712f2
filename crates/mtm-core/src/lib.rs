//! Mass-tensor mechanics of soft tissue.
pub mod blocks;
pub mod error;
pub mod krylov;
pub mod multigrid;
