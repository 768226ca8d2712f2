//! A mesh split along an open surface: lips that are fused in an image become separate.
//!
//! Nodes near the surface move onto it where their tets keep their shape, as in isosurface stuffing (Labelle &
//! Shewchuk 2007); edges that still cross it are cut, and their tets with them, so that the two new faces are as
//! smooth as the surface. Every node on these faces is then duplicated, one copy for each part of the tets
//! around it. The rim of the surface stays connected, so that the crack ends where the surface ends.

mod clipping;
mod snapping;

use std::collections::HashMap;

use crate::error::{ErrorKind, Result};
use crate::geometry::forest::Forest;
use crate::geometry::surface::Surface;
use crate::mesh::TetMesh;
use crate::vector::{add, dot, norm, scaled, sub};

use clipping::Clipped;

/// Sine of the angle between the normal and the direction to the rim, above which a point lies outside the rim.
const BESIDE: f64 = 0.2;

/// A split mesh.
#[derive(Debug, Clone)]
pub struct Parted {
    /// The mesh; existing nodes keep their numbers, new ones follow.
    pub mesh: TetMesh,
    /// The two nodes of the unsplit mesh on whose edge each new node lies, or twice the one that it is a copy
    /// of.
    pub parents: Vec<[u32; 2]>,
}

/// `mesh` with a crack along `surface`.
///
/// # Errors
/// [`crate::MtmError::OutOfRange`] if the surface runs between no two tets.
pub fn part(mesh: &TetMesh, surface: &Surface) -> Result<Parted> {
    let mut nodes = mesh.nodes().to_vec();
    let heights = snapping::snap(mesh, surface, &mut nodes);
    let Clipped { tets, parents: cut } = clipping::clip(mesh.tets(), &heights, &mut nodes);
    let n_on_edges = cut.len();
    let on_surface = |j: u32| {
        let height = heights.get(j as usize).copied();
        height.is_none_or(|h| h == Some(0.0))
    };
    let clipped = TetMesh::new(nodes.clone(), tets.clone())?;
    let sides = sides(&clipped, surface, &heights);
    let (mut tets, mut copied) = (tets, Vec::new());
    double(&clipped, (&sides, &on_surface), &mut tets, &mut copied);
    let allowed = "1 or more: the surface must run through the tissue, in the frame of the mesh";
    let what = "nodes doubled by the parting surface";
    ErrorKind::Mesh.require(!copied.is_empty(), what, 0.0, allowed)?;
    let first_cut = mesh.n_nodes();
    let mut parents = cut;
    for &j in &copied {
        nodes.push(nodes[j as usize]);
        let on_edge = (j as usize).checked_sub(first_cut).filter(|k| *k < n_on_edges);
        parents.push(on_edge.map_or([j, j], |k| parents[k]));
    }
    Ok(Parted { mesh: TetMesh::new(nodes, tets)?, parents })
}

/// Signed distance from the surface; none outside its rim, where "above" and "below" are undefined.
///
/// Over a bend of the surface the direction to it also deviates from the normal, but there the side is known.
fn height(surface: &Surface, x: [f64; 3]) -> Option<f64> {
    let closest = surface.closest_one(x);
    let along = dot(sub(x, closest.point), closest.normal);
    let length = closest.distance;
    let aside = (length * length - along * along).max(0.0).sqrt();
    (!closest.on_border || aside <= BESIDE * length).then_some(closest.signed_distance)
}

/// +1 or −1 for tets next to the surface, 0 for all others. No tet has nodes on either side.
///
/// `heights`: of the nodes of the unsplit mesh; all others lie on the surface.
fn sides(mesh: &TetMesh, surface: &Surface, heights: &[Option<f64>]) -> Vec<i8> {
    let side = |tet: &[u32; 4]| {
        let known = tet.iter().filter_map(|&j| heights.get(j as usize).copied().flatten());
        let sum: i8 = known.map(|h| i8::from(h > 0.0) - i8::from(h < 0.0)).sum();
        if sum != 0 {
            return sum.signum();
        }
        // All nodes on the surface, or beyond its rim.
        let x = tet.map(|j| mesh.nodes()[j as usize]);
        let centroid = scaled(x.iter().fold([0.0; 3], |sum, &p| add(sum, p)), 0.25);
        let apart = x.iter().flat_map(|&p| x.iter().map(move |&q| norm(sub(p, q))));
        let longest = apart.fold(0.0, f64::max);
        match height(surface, centroid) {
            Some(h) if h.abs() < longest => i8::from(h > 0.0) - i8::from(h <= 0.0),
            _ => 0,
        }
    };
    mesh.tets().iter().map(side).collect()
}

/// Gives each part of the tets around a node of the crack its own copy. `copied`: the node that each copy is of.
///
/// The crack runs between tets on either side through faces whose nodes all lie on the surface.
fn double(
    mesh: &TetMesh,
    (sides, on_surface): (&[i8], &impl Fn(u32) -> bool),
    tets: &mut [[u32; 4]],
    copied: &mut Vec<u32>,
) {
    let lies_on = |s: u32, t: u32| {
        let other = mesh.tets()[t as usize];
        let shared = mesh.tets()[s as usize].into_iter().filter(|j| other.contains(j));
        shared.into_iter().all(on_surface)
    };
    let cracked = |s: u32, t: u32| sides[s as usize] * sides[t as usize] < 0 && lies_on(s, t);
    for node in (0..mesh.n_nodes()).filter(|&j| on_surface(j as u32)) {
        let star = mesh.tets_of_node(node);
        if !(star.iter().any(|&t| sides[t as usize] > 0)
            && star.iter().any(|&t| sides[t as usize] < 0))
        {
            continue;
        }
        // The parts of the star that are connected by faces which the crack does not cross.
        let place: HashMap<u32, usize> = star.iter().enumerate().map(|(i, &t)| (t, i)).collect();
        let mut forest = Forest::new(star.len());
        for (i, &t) in star.iter().enumerate() {
            for other in mesh.face_neighbours(t as usize).filter(|&other| !cracked(t, other)) {
                if let Some(&j) = place.get(&other) {
                    forest.join(i, j);
                }
            }
        }
        let part = forest.numbered();
        let parts = part.iter().max().map_or(0, |&last| last + 1);
        // If the star was already disconnected, at a hinge of the mesh, those parts stay as they were.
        for p in 1..parts {
            let copy = (mesh.n_nodes() + copied.len()) as u32;
            copied.push(node as u32);
            for (&t, _) in star.iter().zip(&part).filter(|(_, own)| **own == p) {
                for v in tets[t as usize].iter_mut().filter(|v| **v as usize == node) {
                    *v = copy;
                }
            }
        }
    }
}
