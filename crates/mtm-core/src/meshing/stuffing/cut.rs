//! The lattice cut by the zero set of a level: vertices near it are snapped to it, edges that still cross it
//! are cut.
//!
//! Labelle & Shewchuk (2007), sections 3.2 and 3.3. On a lattice of one size no tet has a dihedral angle
//! below 10.78° or above 164.75°, whatever the level.

use rayon::prelude::*;

use crate::mesh::{FACES, Incidence, TET_EDGES, sixfold_volume};
use crate::vector::{add, cross, dot, norm, scaled, sub};

use super::lattice::{Lattice, Place};
use super::level::LevelImage;

/// A vertex moves to a crossing nearer than this share of an edge along an axis (paper, Table 1).
const SNAP_LONG: f64 = 0.24999;
/// The same for an edge between a corner and a centre.
const SNAP_SHORT: f64 = 0.41189;
/// Length of an edge between a corner and a centre, in edges of the cube: √3/2.
const SHORT_EDGE: f64 = 0.866_025_403_784_438_6;
/// Bisection steps to find a crossing on an edge: on an edge of 3 mm it is accurate to 3e-9 mm.
const HALVINGS: usize = 30;

/// Tets inside the zero set.
#[derive(Debug, Clone)]
pub struct Cut {
    /// Node positions, mm.
    pub nodes: Vec<[f64; 3]>,
    /// Positively oriented tets.
    pub tets: Vec<[u32; 4]>,
    /// Whether each node lies on the zero set.
    pub on_surface: Vec<bool>,
}

/// Position of the lattice vertices relative to the level, and the edges that cross it.
struct Crossings<'a> {
    places: &'a [Place],
    /// Size of the smallest cube at each vertex, mm.
    sizes: Vec<f64>,
    positions: Vec<[f64; 3]>,
    /// +1 inside, −1 outside, 0 on the zero set.
    signs: Vec<i8>,
    /// Edges that crossed before snapping, ascending pairs, ascending.
    edges: Vec<[u32; 2]>,
    /// Crossing of each of them, mm.
    points: Vec<[f64; 3]>,
}

/// The tets of `lattice` inside `level`; lattice position p lies at origin + unit · p.
pub fn cut(lattice: &Lattice, level: &LevelImage, origin: [f64; 3], unit: f64) -> Cut {
    let mut crossings = Crossings::find(lattice, level, origin, unit);
    crossings.snap();
    crossings.tets(lattice)
}

impl Cut {
    /// Removes the nodes that no tet uses; the order of the others is kept.
    pub fn compress(&mut self) {
        let mut number = vec![u32::MAX; self.nodes.len()];
        for &v in self.tets.iter().flatten() {
            number[v as usize] = 0;
        }
        let mut count = 0;
        for v in 0..number.len() {
            if number[v] == 0 {
                number[v] = count;
                self.nodes[count as usize] = self.nodes[v];
                self.on_surface[count as usize] = self.on_surface[v];
                count += 1;
            }
        }
        self.nodes.truncate(count as usize);
        self.on_surface.truncate(count as usize);
        self.tets.par_iter_mut().for_each(|tet| *tet = tet.map(|v| number[v as usize]));
    }
}

impl<'a> Crossings<'a> {
    fn find(lattice: &'a Lattice, level: &LevelImage, origin: [f64; 3], unit: f64) -> Self {
        let positions: Vec<[f64; 3]> = lattice
            .places
            .par_iter()
            .map(|p| [0, 1, 2].map(|a| origin[a] + unit * f64::from(p[a])))
            .collect();
        let signs: Vec<i8> = positions
            .par_iter()
            .map(|&x| level.value(x))
            .map(|v| i8::from(v > 0.0) - i8::from(v < 0.0))
            .collect();
        let mut keys: Vec<u64> = lattice
            .tets
            .par_iter()
            .flat_map_iter(|tet| {
                let signs = &signs;
                TET_EDGES.into_iter().filter_map(move |[a, b]| {
                    let [v, w] = [tet[a], tet[b]];
                    let crosses = signs[v as usize] * signs[w as usize] < 0;
                    crosses.then(|| u64::from(v.min(w)) << 32 | u64::from(v.max(w)))
                })
            })
            .collect();
        keys.par_sort_unstable();
        keys.dedup();
        let edges: Vec<[u32; 2]> = keys.par_iter().map(|&k| [(k >> 32) as u32, k as u32]).collect();
        let points = edges
            .par_iter()
            .map(|&[v, w]| {
                let (mut inside, mut outside) = (positions[v as usize], positions[w as usize]);
                if signs[v as usize] < 0 {
                    std::mem::swap(&mut inside, &mut outside);
                }
                for _ in 0..HALVINGS {
                    let middle = scaled(add(inside, outside), 0.5);
                    if level.value(middle) > 0.0 { inside = middle } else { outside = middle }
                }
                scaled(add(inside, outside), 0.5)
            })
            .collect();
        let sizes = lattice.sizes.par_iter().map(|&s| unit * f64::from(s)).collect();
        Self { places: &lattice.places, sizes, positions, signs, edges, points }
    }

    /// Moves vertices to the nearest crossing that is too close, one after another in their order.
    fn snap(&mut self) {
        let n = self.signs.len();
        let at_vertex = Incidence::new(n, &self.edges);
        for v in 0..n {
            let nearest = at_vertex
                .of(v)
                .iter()
                .filter_map(|&edge| {
                    let [p, q] = self.edges[edge as usize].map(|w| w as usize);
                    let other = if p == v { q } else { p };
                    if self.signs[v] * self.signs[other] >= 0 {
                        return None;
                    }
                    let part = norm(sub(self.points[edge as usize], self.positions[v]));
                    // Where cubes of two sizes meet, the smaller one limits how far a vertex may move.
                    let limit = if is_along_axis(self.places[v], self.places[other]) {
                        SNAP_LONG
                    } else {
                        SNAP_SHORT * SHORT_EDGE
                    };
                    (part < limit * self.sizes[v]).then_some((part, edge))
                })
                .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            if let Some((_, edge)) = nearest {
                self.positions[v] = self.points[edge as usize];
                self.signs[v] = 0;
            }
        }
    }

    fn tets(&self, lattice: &Lattice) -> Cut {
        let n = self.signs.len() as u32;
        // Cut points follow the lattice vertices in a common numbering, from which unused numbers are then
        // removed.
        let pieces: Vec<[u32; 4]> = lattice
            .tets
            .par_iter()
            .flat_map_iter(|tet| {
                let mut pieces = Vec::with_capacity(3);
                self.pieces(tet, n, &mut pieces);
                pieces
            })
            .collect();
        let total = n as usize + self.points.len();
        let nodes = (0..total as u32).into_par_iter().map(|v| self.position(v, n)).collect();
        let on_surface = (0..total).map(|v| v >= n as usize || self.signs[v] == 0).collect();
        let mut cut = Cut { nodes, tets: pieces, on_surface };
        cut.compress();
        cut
    }

    fn position(&self, v: u32, n: u32) -> [f64; 3] {
        if v < n { self.positions[v as usize] } else { self.points[(v - n) as usize] }
    }

    /// Appends the tets of the part of a lattice tet that lies inside.
    fn pieces(&self, tet: &[u32; 4], n: u32, out: &mut Vec<[u32; 4]>) {
        let of_sign =
            |sign: i8| tet.iter().copied().filter(move |&v| self.signs[v as usize] == sign);
        let (mut plus, mut zero, mut minus) = (of_sign(1), of_sign(0), of_sign(-1));
        let counts = tet.iter().fold([0; 3], |mut counts, &v| {
            counts[(self.signs[v as usize] + 1) as usize] += 1;
            counts
        });
        let mut next_plus = || plus.next().expect("counted");
        let mut next_zero = || zero.next().expect("counted");
        let mut next_minus = || minus.next().expect("counted");
        let cut = |v: u32, w: u32| n + self.edge_number(v, w);
        let mut push = |piece: [u32; 4]| out.push(self.oriented(piece, n));
        match counts {
            // [minus, zero, plus]
            [_, _, 0] => {}
            [0, _, _] => out.push(*tet),
            [3, 0, 1] => {
                let p = next_plus();
                push([p, cut(p, next_minus()), cut(p, next_minus()), cut(p, next_minus())]);
            }
            [2, 1, 1] => {
                let p = next_plus();
                push([p, next_zero(), cut(p, next_minus()), cut(p, next_minus())]);
            }
            [1, 2, 1] => {
                let p = next_plus();
                push([p, next_zero(), next_zero(), cut(p, next_minus())]);
            }
            [1, 1, 2] => {
                let (z, m) = (next_zero(), next_minus());
                let [a, b] = self.ordered(next_plus(), next_plus(), m);
                push([z, a, b, cut(b, m)]);
                push([z, a, cut(b, m), cut(a, m)]);
            }
            [1, 0, 3] => {
                let m = next_minus();
                let mut p = [next_plus(), next_plus(), next_plus()];
                p.sort_by_key(|&p| std::cmp::Reverse(self.order(p, m)));
                let columns = p.map(|p| [p, cut(p, m)]);
                prism(columns).into_iter().for_each(push);
            }
            _ => {
                let plus = [next_plus(), next_plus()];
                out.extend(self.halves(plus, [next_minus(), next_minus()], n));
            }
        }
    }

    /// The tets of a lattice tet with two vertices inside, `a` and `b`, and two outside.
    fn halves(&self, [a, b]: [u32; 2], [m1, m2]: [u32; 2], n: u32) -> [[u32; 4]; 3] {
        let cut = |v: u32, w: u32| n + self.edge_number(v, w);
        let columns = [[a, b], [cut(a, m1), cut(b, m1)], [cut(a, m2), cut(b, m2)]];
        // Column 0 before column 1 stands for the diagonal from a to the crossing of b.
        let first = self.ordered(a, b, m1)[0] == a;
        let second = self.ordered(a, b, m2)[0] == a;
        let orders: &[[usize; 3]] = match (first, second) {
            (true, true) => &[[0, 1, 2], [0, 2, 1]],
            (true, false) => &[[2, 0, 1]],
            (false, true) => &[[1, 0, 2]],
            (false, false) => &[[1, 2, 0], [2, 1, 0]],
        };
        // The diagonal inside the cut can be chosen freely: the one with the better tets is used.
        let worst = |pieces: &[[u32; 4]; 3]| {
            pieces
                .iter()
                .map(|p| shape(p.map(|v| self.position(v, n))))
                .fold(f64::INFINITY, f64::min)
        };
        orders
            .iter()
            .map(|order| prism(order.map(|c| columns[c])).map(|p| self.oriented(p, n)))
            .map(|pieces| (worst(&pieces), pieces))
            .reduce(|best, other| if other.0 > best.0 { other } else { best })
            .expect("one order at least")
            .1
    }

    fn edge_number(&self, v: u32, w: u32) -> u32 {
        let edge = [v.min(w), v.max(w)];
        self.edges.binary_search(&edge).expect("a crossed edge was found before") as u32
    }

    /// Rank of an inside vertex on a face with outside vertex `m`; the same for both tets of the face.
    fn order(&self, p: u32, m: u32) -> (i64, u32) {
        let [p_place, m_place] = [p, m].map(|v| self.places[v as usize]);
        let square = (0..3).map(|a| i64::from(p_place[a] - m_place[a]).pow(2)).sum();
        (square, p)
    }

    /// The two inside vertices of a face, with the one whose diagonal splits the quadrilateral first.
    fn ordered(&self, a: u32, b: u32, m: u32) -> [u32; 2] {
        if self.order(a, m) > self.order(b, m) { [a, b] } else { [b, a] }
    }

    fn oriented(&self, piece: [u32; 4], n: u32) -> [u32; 4] {
        positive(piece, |v| self.position(v, n))
    }
}

/// The tet with two corners exchanged if its volume is negative.
pub fn positive(tet: [u32; 4], place: impl Fn(u32) -> [f64; 3]) -> [u32; 4] {
    if sixfold_volume(tet.map(place)) < 0.0 { [tet[0], tet[1], tet[3], tet[2]] } else { tet }
}

/// The three tets of a prism given by its columns; a column's diagonals run from its top to the
/// bottoms of those after it.
fn prism([[a, a1], [b, b1], [c, c1]]: [[u32; 2]; 3]) -> [[u32; 4]; 3] {
    [[a, b, c, c1], [a, b, b1, c1], [a, a1, b1, c1]]
}

fn is_along_axis(p: Place, q: Place) -> bool {
    (0..3).filter(|&a| p[a] != q[a]).count() == 1
}

/// Quality of a tet: its smallest dihedral angle, radians; for an inverted tet, its volume over its longest
/// edge cubed, which is negative, so that a less inverted tet has a higher quality.
pub fn shape(x: [[f64; 3]; 4]) -> f64 {
    let sixfold = sixfold_volume(x);
    if sixfold <= 0.0 {
        let longest = TET_EDGES.into_iter().map(|[a, b]| norm(sub(x[b], x[a]))).fold(0.0, f64::max);
        return if longest > 0.0 { sixfold / longest.powi(3) } else { 0.0 };
    }
    // Between outward normals n and m of two faces the dihedral angle is the supplement of theirs.
    let normals = FACES
        .map(|[a, b, c]| cross(sub(x[b], x[a]), sub(x[c], x[a])))
        .map(|n| scaled(n, 1.0 / norm(n)));
    let largest_cosine = TET_EDGES
        .into_iter()
        .map(|[f, g]| -dot(normals[f], normals[g]))
        .fold(f64::NEG_INFINITY, f64::max);
    // The arc cosine is inaccurate near 0 (1e-8 rad), where a tet is useless however flat; better shapes are
    // far from there, and equal shapes give equal values.
    largest_cosine.clamp(-1.0, 1.0).acos()
}
