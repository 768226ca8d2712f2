//! Geometry without mechanics: triangles, closed surfaces, winding numbers, rigid motions.

pub(crate) mod lattice_hash;
pub mod motion;
pub mod surface;
pub(crate) mod topology;
pub mod triangle;
pub mod winding;
