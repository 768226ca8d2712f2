//! Mass-tensor mechanics of soft tissue.
pub mod blocks;
pub mod error;
