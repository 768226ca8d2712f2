//! The bodies of a cut lattice: specks are removed, and bodies that only touch are separated.

use crate::geometry::forest::Forest;
use crate::mesh::{FACES, signed_volume};

use super::cut::Cut;

/// What was removed from a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Dropped {
    /// Bodies.
    pub parts: usize,
    /// Their volume, mm³.
    pub volume: f64,
}

/// Keeps the bodies of at least `least` (mm³), the largest in any case; a body is a set of tets connected by
/// faces.
///
/// Two bodies that share a node, as specks on a surface do, would form a hinge there: each gets its own node.
pub fn keep_bodies(cut: &mut Cut, least: f64) -> Dropped {
    let body = bodies(&cut.tets);
    let n_bodies = body.iter().max().map_or(0, |&b| b as usize + 1);
    if n_bodies <= 1 {
        return Dropped::default();
    }
    let mut volumes = vec![0.0; n_bodies];
    for (tet, &b) in cut.tets.iter().zip(&body) {
        volumes[b as usize] += signed_volume(&cut.nodes, tet);
    }
    let largest = volumes.iter().copied().fold(0.0, f64::max);
    let keep: Vec<bool> = volumes.iter().map(|&v| v >= least.min(largest)).collect();
    let dropped = volumes.iter().zip(&keep).filter(|(_, k)| !**k);
    let dropped = Dropped { parts: dropped.clone().count(), volume: dropped.map(|(v, _)| v).sum() };
    let mut bodies_kept: Vec<u32> = body.iter().copied().filter(|&b| keep[b as usize]).collect();
    let mut of_tet = body.iter();
    cut.tets.retain(|_| keep[*of_tet.next().expect("one per tet") as usize]);
    part_hinges(cut, &mut bodies_kept);
    cut.compress();
    dropped
}

/// Gives every body its own copy of the nodes that it shares with an earlier one.
fn part_hinges(cut: &mut Cut, body: &mut [u32]) {
    const NOBODY: u32 = u32::MAX;
    let mut owner = vec![NOBODY; cut.nodes.len()];
    let mut copies: Vec<((u32, u32), u32)> = Vec::new();
    for (t, &b) in body.iter().enumerate() {
        for corner in 0..4 {
            let v = cut.tets[t][corner];
            if owner[v as usize] == NOBODY {
                owner[v as usize] = b;
            }
            if owner[v as usize] == b {
                continue;
            }
            let known = copies.iter().find(|(key, _)| *key == (v, b)).map(|(_, copy)| *copy);
            let copy = known.unwrap_or_else(|| {
                let copy = cut.nodes.len() as u32;
                cut.nodes.push(cut.nodes[v as usize]);
                cut.on_surface.push(cut.on_surface[v as usize]);
                owner.push(b);
                copies.push(((v, b), copy));
                copy
            });
            cut.tets[t][corner] = copy;
        }
    }
}

/// Number of the body of each tet, in the order of their first tets.
fn bodies(tets: &[[u32; 4]]) -> Vec<u32> {
    let mut faces: Vec<([u32; 3], u32)> = tets
        .iter()
        .enumerate()
        .flat_map(|(t, tet)| {
            FACES.map(|face| {
                let mut face = face.map(|v| tet[v]);
                face.sort_unstable();
                (face, t as u32)
            })
        })
        .collect();
    rayon::slice::ParallelSliceMut::par_sort_unstable(&mut faces[..]);
    let mut forest = Forest::new(tets.len());
    for pair in faces.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
        forest.join(pair[0].1 as usize, pair[1].1 as usize);
    }
    forest.numbered()
}
