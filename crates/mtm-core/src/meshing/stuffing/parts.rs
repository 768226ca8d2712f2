//! The bodies of a cut lattice: specks are removed, and bodies that only touch are separated.

use crate::vector::{cross, dot, sub};

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
        let x = tet.map(|v| cut.nodes[v as usize]);
        let [e1, e2, e3] = [1, 2, 3].map(|k| sub(x[k], x[0]));
        volumes[b as usize] += dot(cross(e1, e2), e3) / 6.0;
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
            [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]].map(|face: [usize; 3]| {
                let mut face = face.map(|v| tet[v]);
                face.sort_unstable();
                (face, t as u32)
            })
        })
        .collect();
    rayon::slice::ParallelSliceMut::par_sort_unstable(&mut faces[..]);
    let mut parent: Vec<u32> = (0..tets.len() as u32).collect();
    for pair in faces.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
        let [a, b] = [pair[0].1, pair[1].1].map(|t| root(&mut parent, t));
        parent[a.max(b) as usize] = a.min(b);
    }
    let mut number = vec![u32::MAX; tets.len()];
    let mut next = 0;
    (0..tets.len() as u32)
        .map(|t| {
            let root = root(&mut parent, t) as usize;
            if number[root] == u32::MAX {
                number[root] = next;
                next += 1;
            }
            number[root]
        })
        .collect()
}

fn root(parent: &mut [u32], mut t: u32) -> u32 {
    while parent[t as usize] != t {
        parent[t as usize] = parent[parent[t as usize] as usize];
        t = parent[t as usize];
    }
    t
}
