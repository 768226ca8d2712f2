//! Tetrahedral meshes from label images, and the cuts through them.

pub mod crack;
pub mod pieces;
pub mod signed_distance;
pub mod stuffing;
