//! Surfaces that nodes may not enter: of bone, and of tissue itself.

use std::collections::HashMap;
use std::sync::Arc;

use crate::error::{MtmError, Result};
use crate::geometry::motion::RigidMotion;
use crate::geometry::surface::Surface;
use crate::mesh::TetMesh;
use crate::vector::distinct;

/// A surface that nodes may not enter.
#[derive(Debug)]
pub(super) enum Wall {
    /// A part of the boundary of the tissue, and the node of each vertex.
    Tissue { surface: Surface, nodes: Vec<u32> },
    /// The surface of a segment, or of bone that does not move.
    Bone { surface: Arc<Surface>, segment: Option<usize> },
}

impl Wall {
    pub fn surface(&self) -> &Surface {
        match self {
            Self::Tissue { surface, .. } => surface,
            Self::Bone { surface, .. } => surface,
        }
    }

    /// The wall made of `triangles` of nodes, with vertices numbered in ascending order of node.
    pub fn of_tissue(places: &[[f64; 3]], triangles: &[[u32; 3]]) -> Result<Self> {
        let nodes = distinct(triangles.iter().flatten().copied());
        let number = |j: u32| nodes.partition_point(|&n| n < j) as u32;
        let rows = triangles.iter().map(|t| t.map(number)).collect();
        let vertices = nodes.iter().map(|&j| places[j as usize]).collect();
        Ok(Self::Tissue { surface: Surface::new(vertices, rows)?, nodes })
    }
}

/// A surface under a plan.
pub(super) enum MovedWall<'a> {
    /// Points are moved back to the surface at rest.
    Rigid(&'a Surface, RigidMotion),
    Deformed(Surface),
}

/// The boundary triangles of a mesh, whatever their orientation.
pub(super) struct Outside {
    triangles: HashMap<[u32; 3], [u32; 3]>,
}

impl Outside {
    pub fn new(mesh: &TetMesh) -> Self {
        let sorted = |mut t: [u32; 3]| {
            t.sort_unstable();
            t
        };
        Self { triangles: mesh.boundary_triangles().iter().map(|&t| (sorted(t), t)).collect() }
    }

    /// Rejects triangles of a pair that are not on the boundary of the tissue, or face into it.
    pub fn check(&self, pair: usize, triangles: &[[u32; 3]]) -> Result<()> {
        for (row, triangle) in triangles.iter().enumerate() {
            let mut key = *triangle;
            key.sort_unstable();
            let problem = match self.triangles.get(&key) {
                None => "is no triangle of the mesh's boundary",
                Some(out) if !same_turn(out, triangle) => {
                    "faces into the tissue: reverse the order of its nodes"
                }
                Some(_) => continue,
            };
            let problem = format!("has triangle {row} of nodes {triangle:?}, which {problem}");
            return Err(MtmError::TouchingPair { pair, problem });
        }
        Ok(())
    }
}

/// Whether two triangles of the same nodes list them in the same cyclic order.
fn same_turn(a: &[u32; 3], b: &[u32; 3]) -> bool {
    let at = a.iter().position(|v| *v == b[0]).unwrap_or(0);
    a[(at + 1) % 3] == b[1]
}
