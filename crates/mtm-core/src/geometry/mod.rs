//! Geometry without mechanics: triangles, closed surfaces, their decimation and smoothing, tubes, winding numbers, rigid motions.

pub mod decimation;
pub(crate) mod forest;
pub(crate) mod lattice_hash;
pub mod motion;
pub mod smoothing;
pub mod surface;
pub(crate) mod topology;
pub mod triangle;
pub mod tube;
pub mod winding;
