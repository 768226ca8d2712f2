//! Tissue inside other tissue, found without surfaces: nodes inside deformed tets that they do not belong to.
//!
//! Closest points show on which side of a surface a node is, but not whether it got there around an edge or
//! through the surface. A tet that contains a node of another part does show it.

use std::collections::HashMap;

use rayon::prelude::*;

use crate::mesh::TetMesh;
use crate::vector::{add, cross, distinct, dot, norm, sub};

/// Nodes that should not lie in any tet of another part.
#[derive(Debug)]
pub struct Overlap {
    nodes: Vec<u32>,
    /// Cell size of the lattice used to look up the nodes, mm.
    cell: f64,
}

impl Overlap {
    /// The members of `nodes` that lie in no tet of another part at rest.
    pub fn new(mesh: &TetMesh, nodes: Vec<u32>) -> Self {
        let nodes = distinct(nodes.into_iter().filter(|&j| (j as usize) < mesh.n_nodes()));
        let edges = mesh.tets().iter().map(|t| {
            let [a, b] = [t[0], t[1]].map(|j| mesh.nodes()[j as usize]);
            norm(sub(b, a))
        });
        let cell = edges.sum::<f64>() / mesh.tets().len() as f64;
        let mut out = Self { nodes, cell };
        let inside = out.depths(mesh, &vec![[0.0; 3]; mesh.n_nodes()]);
        let mut depth = inside.into_iter();
        out.nodes.retain(|_| depth.next() == Some(0.0));
        out
    }

    /// Such nodes that lie inside a tet of another part under displacements `u` of all nodes, ascending, each
    /// with its depth, mm, which is limited by the size of the tet.
    pub fn inside(&self, mesh: &TetMesh, u: &[[f64; 3]]) -> Vec<(u32, f64)> {
        let each = self.nodes.iter().copied().zip(self.depths(mesh, u));
        each.filter(|(_, depth)| *depth > 0.0).collect()
    }

    /// Whether each of `asked` is known to lie in no tet of another part under displacements `u` of all nodes;
    /// not for nodes that lie in one at rest.
    pub fn are_outside(&self, mesh: &TetMesh, u: &[[f64; 3]], asked: &[u32]) -> Vec<bool> {
        let known = asked.iter().copied().filter(|node| self.nodes.binary_search(node).is_ok());
        let some = Self { nodes: distinct(known), cell: self.cell };
        let depths = some.depths(mesh, u);
        let depth = |node: &u32| some.nodes.binary_search(node).ok().map(|i| depths[i]);
        asked.iter().map(|node| depth(node) == Some(0.0)).collect()
    }

    fn depths(&self, mesh: &TetMesh, u: &[[f64; 3]]) -> Vec<f64> {
        let place = |j: u32| add(mesh.nodes()[j as usize], u[j as usize]);
        let key = |x: [f64; 3]| x.map(|v| (v / self.cell).floor() as i64);
        let mut cells: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
        for (i, &j) in self.nodes.iter().enumerate() {
            cells.entry(key(place(j))).or_default().push(i as u32);
        }
        let found: Vec<(u32, f64)> = mesh
            .tets()
            .par_iter()
            .with_min_len(1024)
            .flat_map_iter(|tet| {
                let corners = tet.map(place);
                let mut held = Vec::new();
                let [low, high] = [f64::min, f64::max].map(|pick| {
                    [0, 1, 2].map(|k| corners.iter().map(|c| c[k]).reduce(pick).unwrap_or(0.0))
                });
                let (first, last) = (key(low), key(high));
                for x in first[0]..=last[0] {
                    for y in first[1]..=last[1] {
                        for z in first[2]..=last[2] {
                            for &i in cells.get(&[x, y, z]).into_iter().flatten() {
                                let node = self.nodes[i as usize];
                                let depth = depth_in(&corners, place(node));
                                if depth > 0.0 && !tet.contains(&node) {
                                    held.push((i, depth));
                                }
                            }
                        }
                    }
                }
                held
            })
            .collect();
        let mut out = vec![0.0; self.nodes.len()];
        for (i, depth) in found {
            out[i as usize] = f64::max(out[i as usize], depth);
        }
        out
    }
}

/// Smallest distance of a point from the faces of the tet that contains it, mm; zero or negative outside.
pub fn depth_in(corners: &[[f64; 3]; 4], point: [f64; 3]) -> f64 {
    let face = |k: usize| {
        let [a, b, c] = [1, 2, 3].map(|step| corners[(k + step) % 4]);
        let normal = cross(sub(b, a), sub(c, a));
        let (height, away) = (dot(normal, sub(corners[k], a)), dot(normal, sub(point, a)));
        away * height.signum() / norm(normal)
    };
    let depth = (0..4).map(face).fold(f64::INFINITY, f64::min);
    if depth.is_finite() { depth } else { 0.0 }
}
