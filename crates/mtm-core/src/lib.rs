//! Mass-tensor mechanics of soft tissue.
pub mod blocks;
pub mod cholesky;
pub mod error;
pub mod motion;
pub mod surface;
mod topology;
pub mod triangle;
pub mod winding;
