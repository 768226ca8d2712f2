//! A mesh split along an open surface: lips that are fused in an image become separate.
//!
//! Nodes near the surface move onto it if no tet degenerates; tets are sorted by side; every node on the faces
//! between the two sides is duplicated, one copy for each part of the tets around it. The rim of the surface
//! stays connected, so that the cut ends where the surface ends.

use std::collections::HashMap;

use crate::error::{ErrorKind, MtmError, Result};
use crate::geometry::surface::Surface;
use crate::mesh::TetMesh;
use crate::meshing::stuffing::cut::shape;
use crate::vector::{add, dot, norm, scaled, sub};

/// A node moves onto the surface from a distance of up to this share of its shortest edge.
const REACH: f64 = 0.4;
/// Smallest dihedral angle that a move may leave, radians.
const LEAST_DIHEDRAL: f64 = 10.0 * std::f64::consts::PI / 180.0;
/// Sine of the angle between the normal and the direction to the rim, above which a point lies outside the rim.
const BESIDE: f64 = 0.2;

/// A split mesh.
#[derive(Debug, Clone)]
pub struct Parted {
    /// The mesh; existing nodes keep their numbers, copies follow.
    pub mesh: TetMesh,
    /// Number of copies.
    pub doubled: usize,
}

/// `mesh` with a crack along `surface`.
///
/// # Errors
/// [`MtmError::OutOfRange`] if the surface runs between no two tets.
pub fn part(mesh: &TetMesh, surface: &Surface) -> Result<Parted> {
    let mut nodes = mesh.nodes().to_vec();
    snap(mesh, surface, &mut nodes);
    let sides = sides(mesh, surface, &nodes);
    let mut tets = mesh.tets().to_vec();
    let doubled = double(mesh, &sides, &mut nodes, &mut tets);
    if doubled == 0 {
        return Err(MtmError::OutOfRange {
            what: "nodes doubled by the parting surface".into(),
            index: 0,
            value: 0.0,
            allowed: "1 or more: the surface must run through the tissue, in the frame of the mesh",
            kind: ErrorKind::Mesh,
        });
    }
    Ok(Parted { mesh: TetMesh::new(nodes, tets)?, doubled })
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

fn snap(mesh: &TetMesh, surface: &Surface, nodes: &mut [[f64; 3]]) {
    for node in 0..nodes.len() {
        let x = nodes[node];
        let star = mesh.tets_of_node(node);
        let shortest = star
            .iter()
            .flat_map(|&t| mesh.tets()[t as usize])
            .filter(|&v| v as usize != node)
            .map(|v| norm(sub(nodes[v as usize], x)))
            .fold(f64::INFINITY, f64::min);
        let near = height(surface, x).filter(|h| h.abs() < REACH * shortest);
        if near.is_none() {
            continue;
        }
        let target = surface.closest_one(x).point;
        let worst = |place: [f64; 3]| {
            star.iter()
                .map(|&t| {
                    shape(
                        mesh.tets()[t as usize]
                            .map(|v| if v as usize == node { place } else { nodes[v as usize] }),
                    )
                })
                .fold(f64::INFINITY, f64::min)
        };
        if worst(target) >= LEAST_DIHEDRAL.min(worst(x)) {
            nodes[node] = target;
        }
    }
}

/// +1 or −1 for tets next to the surface, 0 for all others.
fn sides(mesh: &TetMesh, surface: &Surface, nodes: &[[f64; 3]]) -> Vec<i8> {
    mesh.tets()
        .iter()
        .map(|tet| {
            let x = tet.map(|v| nodes[v as usize]);
            let centroid = scaled(x.iter().fold([0.0; 3], |sum, &p| add(sum, p)), 0.25);
            let longest =
                x.iter().flat_map(|&p| x.iter().map(move |&q| norm(sub(p, q)))).fold(0.0, f64::max);
            match height(surface, centroid) {
                Some(h) if h.abs() < longest => {
                    if h > 0.0 {
                        1
                    } else {
                        -1
                    }
                }
                _ => 0,
            }
        })
        .collect()
}

/// Gives each part of the tets around a node of the crack its own copy; returns the number of copies.
fn double(mesh: &TetMesh, sides: &[i8], nodes: &mut Vec<[f64; 3]>, tets: &mut [[u32; 4]]) -> usize {
    let before = nodes.len();
    let cracked = |s: u32, t: u32| sides[s as usize] * sides[t as usize] < 0;
    for node in 0..before {
        let star = mesh.tets_of_node(node);
        if !(star.iter().any(|&t| sides[t as usize] > 0)
            && star.iter().any(|&t| sides[t as usize] < 0))
        {
            continue;
        }
        // The parts of the star that are connected by faces which the crack does not cross.
        let place: HashMap<u32, usize> = star.iter().enumerate().map(|(i, &t)| (t, i)).collect();
        let mut part = vec![usize::MAX; star.len()];
        let mut parts = 0;
        for first in 0..star.len() {
            if part[first] != usize::MAX {
                continue;
            }
            part[first] = parts;
            let mut pending = vec![first];
            while let Some(i) = pending.pop() {
                for other in mesh.face_neighbours(star[i] as usize) {
                    let Some(&j) = place.get(&other) else { continue };
                    if part[j] == usize::MAX && !cracked(star[i], other) {
                        part[j] = parts;
                        pending.push(j);
                    }
                }
            }
            parts += 1;
        }
        // If the star was already disconnected, at a hinge of the mesh, those parts stay as they were.
        for p in 1..parts {
            let copy = nodes.len() as u32;
            nodes.push(nodes[node]);
            for (i, &t) in star.iter().enumerate().filter(|(i, _)| part[*i] == p) {
                debug_assert_eq!(star[i], t);
                for v in tets[t as usize].iter_mut().filter(|v| **v as usize == node) {
                    *v = copy;
                }
            }
        }
    }
    nodes.len() - before
}
