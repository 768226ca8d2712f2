//! Geometry without mechanics: triangles, closed surfaces, tubes, winding numbers, rigid motions.

pub(crate) mod lattice_hash;
pub mod motion;
pub mod surface;
pub(crate) mod topology;
pub mod triangle;
pub mod tube;
pub mod winding;
