//! Tets on both sides of a surface, divided into tets on one side each.

use std::collections::HashMap;

use crate::mesh::{FACES, TET_EDGES, ascending};
use crate::meshing::stuffing::cut::positive;
use crate::vector::towards;

/// Tets divided where they cross a surface.
pub struct Clipped {
    pub tets: Vec<[u32; 4]>,
    /// The ends of the edge on which each new node lies.
    pub parents: Vec<[u32; 2]>,
}

/// The corners of a tet relative to the surface.
struct Corners<'a> {
    tet: [u32; 4],
    /// +1 or −1; 0 on the surface, and beyond its rim.
    signs: [i8; 4],
    on_edges: &'a HashMap<[u32; 2], u32>,
}

/// Divides `tets` with nodes on both sides, and adds the new nodes to `nodes`.
///
/// `heights`: of each node above the surface, mm; none outside its rim. Both pieces of a tet are convex, and are
/// divided from their node with the smallest number, like their faces: neighbours agree on a common face
/// without knowing of each other (Dompierre et al. 1999).
pub fn clip(tets: &[[u32; 4]], heights: &[Option<f64>], nodes: &mut Vec<[f64; 3]>) -> Clipped {
    let sign = |j: u32| match heights[j as usize] {
        Some(h) => i8::from(h > 0.0) - i8::from(h < 0.0),
        None => 0,
    };
    let (mut out, mut parents) = (Vec::with_capacity(tets.len()), Vec::new());
    let mut on_edges: HashMap<[u32; 2], u32> = HashMap::new();
    for &tet in tets {
        let signs = tet.map(sign);
        if !(signs.contains(&1) && signs.contains(&-1)) {
            out.push(tet);
            continue;
        }
        for [a, b] in TET_EDGES.into_iter().filter(|&[a, b]| signs[a] * signs[b] < 0) {
            let ends = ascending(tet[a], tet[b]);
            on_edges.entry(ends).or_insert_with(|| {
                let [h, other] = ends.map(|j| heights[j as usize].unwrap_or(0.0));
                let [x, y] = ends.map(|j| nodes[j as usize]);
                nodes.push(towards(x, y, h / (h - other)));
                parents.push(ends);
                nodes.len() as u32 - 1
            });
        }
        let corners = Corners { tet, signs, on_edges: &on_edges };
        for side in [1, -1] {
            corners.divide(side, nodes, &mut out);
        }
    }
    Clipped { tets: out, parents }
}

impl Corners<'_> {
    /// Adds the tets of the piece on one side.
    fn divide(&self, side: i8, nodes: &[[f64; 3]], out: &mut Vec<[u32; 4]>) {
        let mut faces: Vec<Vec<u32>> = FACES.iter().map(|face| self.face(*face, side)).collect();
        faces.retain(|face| face.len() > 2);
        faces.push(self.section());
        let Some(&apex) = faces.iter().flatten().min() else { return };
        for face in faces.iter().filter(|face| !face.contains(&apex)) {
            let first = (0..face.len()).min_by_key(|&i| face[i]).unwrap_or(0);
            let at = |i: usize| face[(first + i) % face.len()];
            for i in 1..face.len() - 1 {
                out.push(positive([apex, at(0), at(i), at(i + 1)], |v| nodes[v as usize]));
            }
        }
    }

    /// The part of a face on one side, in order; empty if none of its corners lies there.
    fn face(&self, corners: [usize; 3], side: i8) -> Vec<u32> {
        let mut out = Vec::with_capacity(4);
        if corners.iter().all(|&c| self.signs[c] != side) {
            return out;
        }
        for i in 0..3 {
            let (c, next) = (corners[i], corners[(i + 1) % 3]);
            if self.signs[c] * side >= 0 {
                out.push(self.tet[c]);
            }
            out.extend(self.crossing(c, next));
        }
        out
    }

    /// The polygon in which the surface crosses the tet, in order.
    fn section(&self) -> Vec<u32> {
        let with = |sign: i8| (0..4).filter(move |&c| self.signs[c] == sign);
        let (above, below): (Vec<usize>, Vec<usize>) = (with(1).collect(), with(-1).collect());
        if let ([p, q], [r, s]) = (&above[..], &below[..]) {
            let corners = [(*p, *r), (*q, *r), (*q, *s), (*p, *s)];
            return corners.into_iter().filter_map(|(a, b)| self.crossing(a, b)).collect();
        }
        let on_edges = TET_EDGES.into_iter().filter_map(|[a, b]| self.crossing(a, b));
        with(0).map(|c| self.tet[c]).chain(on_edges).collect()
    }

    /// The new node on an edge that crosses the surface.
    fn crossing(&self, a: usize, b: usize) -> Option<u32> {
        if self.signs[a] * self.signs[b] >= 0 {
            return None;
        }
        self.on_edges.get(&ascending(self.tet[a], self.tet[b])).copied()
    }
}
