//! Graded body-centred cubic lattice: an octree of cubes, their corners and centres, and its tets.
//!
//! Labelle & Shewchuk (2007), sections 3.1 and 3.4. Two cubes of the same size share the four tets of the BCC
//! lattice around each edge of their common face, split in two where an edge has a midpoint; between cubes of
//! different sizes there are half pyramids. Cubes that touch differ by at most one level.
//!
//! Coordinates are integers in units of half the finest cube, so that equal positions are equal in every bit.

use std::collections::HashMap;
use std::hash::BuildHasherDefault;

use rayon::prelude::*;

use crate::geometry::lattice_hash::KeyHasher;

/// A position of the lattice, in units.
pub type Place = [i32; 3];

/// Cubes at the coarsest level, each the root of a tree.
#[derive(Debug, Clone)]
pub struct Octree {
    /// Coarse cubes along each axis.
    counts: [usize; 3],
    /// Size of a coarse cube, units: 2 to the power of (deepest level + 1).
    coarse: i32,
    /// Root of each coarse cube; `NONE` where the cube is far from the tissue.
    roots: Vec<u32>,
    /// First of the eight children, or `NONE` for a leaf.
    children: Vec<u32>,
}

/// A cube without children.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Leaf {
    /// Its lowest corner.
    pub origin: Place,
    /// Its size, units.
    pub size: i32,
    /// Its index in the octree.
    pub index: u32,
}

/// Vertices and tets of the lattice.
#[derive(Debug, Clone)]
pub struct Lattice {
    /// Positions, ascending.
    pub places: Vec<Place>,
    /// Size of the smallest cube at each vertex, units.
    pub sizes: Vec<i32>,
    /// Four vertices of each tet, positively oriented.
    pub tets: Vec<[u32; 4]>,
}

const NONE: u32 = u32::MAX;
/// Bits of a packed coordinate; coordinates stay below 2 to this power.
const BITS: u32 = 21;

impl Octree {
    /// Coarse cubes, `counts` along each axis, that may be refined `levels` times; `active` chooses those near the tissue.
    pub fn new(counts: [usize; 3], levels: u32, active: &[bool]) -> Self {
        let mut roots = vec![NONE; active.len()];
        let mut next = 0;
        for (root, _) in roots.iter_mut().zip(active).filter(|(_, active)| **active) {
            *root = next;
            next += 1;
        }
        Self { counts, coarse: 2 << levels, roots, children: vec![NONE; next as usize] }
    }

    /// Size of a coarse cube, units.
    pub fn coarse_size(&self) -> i32 {
        self.coarse
    }

    /// The leaf at a position, lower faces included; none outside or far from the tissue.
    pub fn leaf_at(&self, place: Place) -> Option<Leaf> {
        let mut cube = [0_usize; 3];
        for axis in 0..3 {
            if place[axis] < 0 {
                return None;
            }
            cube[axis] = (place[axis] / self.coarse) as usize;
            if cube[axis] >= self.counts[axis] {
                return None;
            }
        }
        let [_, ny, nz] = self.counts;
        let mut index = self.roots[(cube[0] * ny + cube[1]) * nz + cube[2]];
        if index == NONE {
            return None;
        }
        let mut origin = cube.map(|c| c as i32 * self.coarse);
        let mut size = self.coarse;
        while self.children[index as usize] != NONE {
            size /= 2;
            let mut octant = 0;
            for axis in 0..3 {
                if place[axis] >= origin[axis] + size {
                    octant |= 1 << axis;
                    origin[axis] += size;
                }
            }
            index = self.children[index as usize] + octant;
        }
        Some(Leaf { origin, size, index })
    }

    /// Splits the leaf at `place` until it is no larger than `size`.
    pub fn refine(&mut self, place: Place, size: i32) {
        while let Some(leaf) = self.leaf_at(place).filter(|leaf| leaf.size > size) {
            self.split(leaf.index);
        }
    }

    fn split(&mut self, index: u32) {
        self.children[index as usize] = self.children.len() as u32;
        self.children.extend([NONE; 8]);
    }

    /// Splits until cubes that share a face, an edge or a corner differ by at most one level.
    pub fn balance(&mut self) {
        let mut pending = self.leaves();
        while !pending.is_empty() {
            let too_large: Vec<(Place, i32)> = pending
                .par_iter()
                .flat_map_iter(|leaf| neighbours(leaf).map(move |place| (place, leaf.size)))
                .filter(|&(place, size)| self.leaf_at(place).is_some_and(|l| l.size > 2 * size))
                .collect();
            let mut split = Vec::new();
            for (place, size) in too_large {
                // A previous split in this pass may have refined it far enough already.
                if let Some(leaf) = self.leaf_at(place).filter(|leaf| leaf.size > 2 * size) {
                    self.split(leaf.index);
                    split.push(leaf);
                }
            }
            pending = split
                .iter()
                .flat_map(|parent| {
                    (0..8).map(|octant| octant_of(parent.origin, parent.size / 2, octant))
                })
                .filter_map(|place| self.leaf_at(place))
                .collect();
        }
    }

    /// Every leaf, in the order of the coarse cubes and of their children.
    pub fn leaves(&self) -> Vec<Leaf> {
        let [_, ny, nz] = self.counts;
        (0..self.roots.len())
            .into_par_iter()
            .filter(|&c| self.roots[c] != NONE)
            .flat_map_iter(|c| {
                let cube = [c / (ny * nz), c / nz % ny, c % nz];
                let origin = cube.map(|c| c as i32 * self.coarse);
                let mut leaves = Vec::new();
                self.collect(Leaf { origin, size: self.coarse, index: self.roots[c] }, &mut leaves);
                leaves
            })
            .collect()
    }

    fn collect(&self, cube: Leaf, leaves: &mut Vec<Leaf>) {
        let first = self.children[cube.index as usize];
        if first == NONE {
            leaves.push(cube);
            return;
        }
        let size = cube.size / 2;
        for octant in 0..8 {
            let origin = octant_of(cube.origin, size, octant);
            self.collect(Leaf { origin, size, index: first + octant as u32 }, leaves);
        }
    }
}

/// A position inside each of the 26 neighbouring cubes of the leaf's own size.
pub fn neighbours(leaf: &Leaf) -> impl Iterator<Item = Place> + use<> {
    let Leaf { origin, size, .. } = *leaf;
    (0..27).filter(|&d| d != 13).map(move |d| {
        let step = [d / 9 - 1, d / 3 % 3 - 1, d % 3 - 1];
        [0, 1, 2].map(|a| origin[a] + size / 2 + step[a] * size)
    })
}

impl Lattice {
    /// Vertices and tets of a balanced octree.
    pub fn new(tree: &Octree) -> Self {
        let leaves = tree.leaves();
        let mut vertices: Vec<(u64, i32)> = leaves
            .par_iter()
            .flat_map_iter(|leaf| vertices_of(leaf).map(|place| (key(place), leaf.size)))
            .collect();
        vertices.par_sort_unstable();
        vertices.dedup_by_key(|vertex| vertex.0);
        let (keys, sizes): (Vec<u64>, Vec<i32>) = vertices.into_iter().unzip();
        let mut numbers: HashMap<u64, u32, BuildHasherDefault<KeyHasher>> =
            HashMap::with_capacity_and_hasher(keys.len(), BuildHasherDefault::default());
        numbers.extend(keys.iter().enumerate().map(|(number, &key)| (key, number as u32)));
        let number = |place: Place| numbers.get(&key(place)).copied();
        let places: Vec<Place> = keys.par_iter().map(|&k| unpacked(k)).collect();
        let tets = leaves
            .par_iter()
            .flat_map_iter(|leaf| {
                let mut tets = Vec::with_capacity(12);
                tets_of(tree, leaf, &number, &mut tets);
                for tet in &mut tets {
                    if sixfold_volume(tet.map(|v| places[v as usize])) < 0 {
                        tet.swap(2, 3);
                    }
                }
                tets
            })
            .collect();
        Self { places, sizes, tets }
    }
}

/// Appends the tets that belong to a leaf: those of its upper faces towards cubes of its size, and all those
/// towards larger cubes.
fn tets_of(
    tree: &Octree,
    leaf: &Leaf,
    number: &impl Fn(Place) -> Option<u32>,
    tets: &mut Vec<[u32; 4]>,
) {
    let known = |place: Place| number(place).expect("corners and centres of leaves are vertices");
    let half = leaf.size / 2;
    let centre = leaf.origin.map(|o| o + half);
    for axis in 0..3 {
        for side in [-1, 1] {
            let mut beyond = centre;
            beyond[axis] += side * leaf.size;
            let Some(other) = tree.leaf_at(beyond) else { continue };
            // The same position is a corner of a smaller cube: the smaller cubes create the tets.
            if other.size < leaf.size || (other.size == leaf.size && side < 0) {
                continue;
            }
            let [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
            let corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(|[p, q]| {
                let mut corner = centre;
                corner[axis] += side * half;
                corner[b] += p * half;
                corner[c] += q * half;
                corner
            });
            let other_centre = other.origin.map(|o| o + other.size / 2);
            if other.size == leaf.size {
                for e in 0..4 {
                    let [p, q] = [corners[e], corners[(e + 1) % 4]];
                    let middle = [0, 1, 2].map(|a| (p[a] + q[a]) / 2);
                    let ends = if leaf.size > 2 { number(middle) } else { None };
                    let pieces = match ends {
                        Some(m) => vec![[known(p), m], [m, known(q)]],
                        None => vec![[known(p), known(q)]],
                    };
                    for [p, q] in pieces {
                        tets.push([known(centre), known(other_centre), p, q]);
                    }
                }
                continue;
            }
            // The diagonal of the quarter face runs outwards from the centre of the large face.
            let from = (0..4)
                .find(|&v| corners[v][b] == other_centre[b] && corners[v][c] == other_centre[c])
                .expect("a quarter of a face has a corner at its middle");
            let corner = |step: usize| known(corners[(from + step) % 4]);
            for apex in [known(centre), known(other_centre)] {
                tets.push([apex, corner(0), corner(1), corner(2)]);
                tets.push([apex, corner(0), corner(2), corner(3)]);
            }
        }
    }
}

/// Lowest corner of an octant of cubes of this size around `origin`.
fn octant_of(origin: Place, size: i32, octant: i32) -> Place {
    [0, 1, 2].map(|a| origin[a] + (octant >> a & 1) * size)
}

/// Corners and centre of a leaf.
fn vertices_of(leaf: &Leaf) -> impl Iterator<Item = Place> + use<> {
    let Leaf { origin, size, .. } = *leaf;
    (0..8).map(move |corner| octant_of(origin, size, corner)).chain([origin.map(|o| o + size / 2)])
}

fn sixfold_volume(tet: [Place; 4]) -> i64 {
    let [u, v, w] = [1, 2, 3].map(|k| [0, 1, 2].map(|a| i64::from(tet[k][a] - tet[0][a])));
    u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
}

fn key(place: Place) -> u64 {
    place.iter().fold(0, |packed, &c| packed << BITS | c as u64)
}

fn unpacked(key: u64) -> Place {
    let mask = (1_u64 << BITS) - 1;
    [key >> (2 * BITS), key >> BITS & mask, key & mask].map(|c| c as i32)
}
