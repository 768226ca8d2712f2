//! Mass-tensor mechanics of soft tissue.
pub mod blocks;
pub mod cholesky;
pub mod error;
pub mod material;
pub mod mesh;
pub mod ordering;
pub mod tensors;
