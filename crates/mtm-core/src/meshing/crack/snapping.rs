//! Nodes next to a surface, moved onto it.

use rayon::prelude::*;

use crate::geometry::surface::Surface;
use crate::mesh::{TET_EDGES, TetMesh, ascending};
use crate::meshing::stuffing::cut::shape;
use crate::vector::{distinct, norm, of_each, sub, towards};

use super::height;

/// Two passes: a node moves onto the surface if an edge at it crosses the surface within a share of its length,
/// and no dihedral angle becomes smaller than so many degrees. Cutting an edge next to its end would leave worse
/// angles than those of the second pass.
const PASSES: [(f64, f64); 2] = [(0.35, 10.0), (0.2, 5.0)];
/// Where an angle is smaller already, a move may leave this share of it.
const LEAST_SHARE: f64 = 0.9;
/// Rounding of distances, relative.
const ROUNDING: f64 = 1e-9;

/// Moves `nodes` of `mesh` onto the surface where this keeps the shape of their tets; returns the height of each
/// above the surface, mm: 0 on it, none outside its rim.
pub fn snap(mesh: &TetMesh, surface: &Surface, nodes: &mut [[f64; 3]]) -> Vec<Option<f64>> {
    let mut heights = of_each(nodes, |x| height(surface, x));
    forget_around_rim(mesh, &mut heights);
    let boundary = mesh.boundary_edges();
    for (near, least) in PASSES {
        for node in 0..nodes.len() {
            let crossings = NodeCrossings::at(mesh, node, (nodes, &heights), &boundary);
            if crossings.nearest.is_none_or(|(share, _)| share >= near) {
                continue;
            }
            let worst = |place: [f64; 3]| worst_angle(mesh, node, nodes, place);
            let allowed = least.to_radians().min(LEAST_SHARE * worst(nodes[node]));
            let fits = |place: &[f64; 3]| worst(*place) >= allowed;
            // The boundary of the mesh keeps its shape if its nodes move along it.
            let along_boundary = crossings.on_boundary.filter(|(share, _)| *share < near);
            let place = along_boundary.map(|(_, x)| x).filter(fits).or_else(|| {
                let closest = surface.closest_one(nodes[node]).point;
                let places = [Some(closest), crossings.nearest.map(|(_, x)| x)];
                let fitting = places.into_iter().flatten().filter(fits);
                fitting.max_by(|a, b| worst(*a).total_cmp(&worst(*b)))
            });
            if let Some(place) = place {
                nodes[node] = place;
                heights[node] = Some(0.0);
            }
        }
    }
    heights
}

/// Where edges at a node cross the surface, each as a share of its length and a point.
struct NodeCrossings {
    nearest: Option<(f64, [f64; 3])>,
    /// The nearest on an edge of the boundary.
    on_boundary: Option<(f64, [f64; 3])>,
}

impl NodeCrossings {
    fn at(
        mesh: &TetMesh,
        node: usize,
        (nodes, heights): (&[[f64; 3]], &[Option<f64>]),
        boundary: &[[u32; 2]],
    ) -> Self {
        let mut found = Self { nearest: None, on_boundary: None };
        let Some(h) = heights[node].filter(|h| *h != 0.0) else { return found };
        let nearer =
            |share: f64, than: Option<(f64, [f64; 3])>| than.is_none_or(|(s, _)| share < s);
        for k in neighbours(mesh, node) {
            let Some(other) = heights[k as usize].filter(|other| other * h < 0.0) else { continue };
            let share = h / (h - other);
            let crossing = Some((share, towards(nodes[node], nodes[k as usize], share)));
            if nearer(share, found.nearest) {
                found.nearest = crossing;
            }
            if nearer(share, found.on_boundary)
                && boundary.binary_search(&ascending(node as u32, k)).is_ok()
            {
                found.on_boundary = crossing;
            }
        }
        found
    }
}

/// Quality of the worst tet at a node if it lies at `place`, as [`shape`].
fn worst_angle(mesh: &TetMesh, node: usize, nodes: &[[f64; 3]], place: [f64; 3]) -> f64 {
    let at = |v: u32| if v as usize == node { place } else { nodes[v as usize] };
    let star = mesh.tets_of_node(node).iter();
    star.map(|&t| shape(mesh.tets()[t as usize].map(at))).fold(f64::INFINITY, f64::min)
}

/// Forgets the heights of nodes on either side of the surface that are connected around its rim.
fn forget_around_rim(mesh: &TetMesh, heights: &mut [Option<f64>]) {
    let around: Vec<u32> = mesh
        .tets()
        .par_iter()
        .with_min_len(1024)
        .flat_map_iter(|tet| {
            let heights = &*heights;
            TET_EDGES.into_iter().map(|[a, b]| [tet[a], tet[b]]).filter(move |[a, b]| {
                let [h, other] = [a, b].map(|j| heights[*j as usize].unwrap_or(0.0));
                let [x, y] = [a, b].map(|j| mesh.nodes()[*j as usize]);
                h * other < 0.0 && h.abs() + other.abs() > (1.0 + ROUNDING) * norm(sub(y, x))
            })
        })
        .flat_map_iter(|pair| pair)
        .collect();
    for j in around {
        heights[j as usize] = None;
    }
}

/// The nodes that share an edge with a node, ascending.
fn neighbours(mesh: &TetMesh, node: usize) -> Vec<u32> {
    let star = mesh.tets_of_node(node).iter();
    distinct(star.flat_map(|&t| mesh.tets()[t as usize]).filter(|&k| k as usize != node))
}
