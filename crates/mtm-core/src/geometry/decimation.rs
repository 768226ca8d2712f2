//! Surfaces with fewer triangles, by quadrics (Garland and Heckbert 1997).
//!
//! Edges collapse in rounds, wherever that costs less than a threshold that grows from round to round: the order of
//! Forstmann's *Fast Quadric Mesh Simplification* (MIT licence). The result is, bit for bit, that of the package
//! fast-simplification 0.2, which runs the same rounds on global variables, one mesh at a time.

use rayon::prelude::*;

use crate::vector::{add, cross, dot, norm, sub};

/// Threshold of round k: `SCALE` (k + 3)^`SHARPNESS`, and the number of rounds.
const SCALE: f64 = 1e-9;
const SHARPNESS: f64 = 7.0;
const ROUNDS: usize = 100;
/// A collapse is refused if a triangle's edges come nearer to one line than this cosine, or if its normal turns
/// beyond this one.
const SHARPEST: f64 = 0.999;
const LEAST_FACING: f64 = 0.2;

/// The upper triangle of a symmetric 4 × 4 matrix, row by row: the sum of squared distances from planes.
type Quadric = [f64; 10];

struct Decimation {
    points: Vec<[f64; 3]>,
    quadrics: Vec<Quadric>,
    on_border: Vec<bool>,
    /// Triangles at each vertex, and which of their corners lies there.
    corners: Vec<Vec<(u32, u8)>>,
    triangles: Vec<[u32; 3]>,
    normals: Vec<[f64; 3]>,
    /// Cost of the collapse of each edge, and the least of each triangle's; infinite where it is gone.
    costs: Vec<[f64; 3]>,
    least: Vec<f64>,
    gone: Vec<bool>,
    n_left: usize,
}

/// The surface with about `wanted` triangles, open where it was. The caller has checked the indices.
pub fn decimated(
    points: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
    wanted: usize,
) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let mut mesh = Decimation::new(points, triangles);
    for round in 0..ROUNDS {
        if mesh.n_left <= wanted {
            break;
        }
        mesh.collapse_below(SCALE * ((round + 3) as f64).powf(SHARPNESS), wanted);
    }
    let gone = mesh.gone;
    let left = mesh.triangles.into_iter().zip(gone).filter(|(_, gone)| !gone).map(|(t, _)| t);
    let mut triangles: Vec<[u32; 3]> = left.collect();
    let mut number = vec![u32::MAX; mesh.points.len()];
    triangles.as_flattened().iter().for_each(|&j| number[j as usize] = 0);
    let mut kept = Vec::new();
    for (number, point) in number.iter_mut().zip(mesh.points).filter(|(n, _)| **n == 0) {
        *number = kept.len() as u32;
        kept.push(point);
    }
    triangles.as_flattened_mut().iter_mut().for_each(|j| *j = number[*j as usize]);
    (kept, triangles)
}

impl Decimation {
    fn new(points: Vec<[f64; 3]>, triangles: Vec<[u32; 3]>) -> Self {
        let (mut quadrics, mut corners) =
            (vec![[0.0; 10]; points.len()], vec![vec![]; points.len()]);
        let mut normals = Vec::with_capacity(triangles.len());
        for (triangle, t) in triangles.iter().enumerate() {
            let [p, q, r] = t.map(|j| points[j as usize]);
            let normal @ [a, b, c] = unit(cross(sub(q, p), sub(r, p)));
            normals.push(normal);
            let d = -dot(normal, p);
            let plane = [a * a, a * b, a * c, a * d, b * b, b * c, b * d, c * c, c * d, d * d];
            for (at, &j) in t.iter().enumerate() {
                quadrics[j as usize] = sum(&quadrics[j as usize], &plane);
                corners[j as usize].push((triangle as u32, at as u8));
            }
        }
        let on_border = vec![false; points.len()];
        let (gone, n_left) = (vec![false; triangles.len()], triangles.len());
        let (costs, least) = (Vec::new(), Vec::new());
        let mut mesh = Self {
            points,
            quadrics,
            on_border,
            corners,
            triangles,
            normals,
            costs,
            least,
            gone,
            n_left,
        };
        // The first costs do not know the border yet.
        mesh.costs = mesh.triangles.par_iter().map(|t| mesh.costs_of(t)).collect();
        mesh.least = mesh.costs.iter().map(least_of).collect();
        let sides = mesh.triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
        let mut edges: Vec<[u32; 2]> = sides.map(|[a, b]| [a.min(b), a.max(b)]).collect();
        edges.par_sort_unstable();
        for edge in edges.chunk_by(|a, b| a == b).filter(|edge| edge.len() == 1) {
            edge[0].iter().for_each(|&j| mesh.on_border[j as usize] = true);
        }
        mesh
    }

    /// Collapses edges that cost less than the threshold, in the triangles' order, one of each that did not change.
    fn collapse_below(&mut self, threshold: f64, wanted: usize) {
        let mut changed = vec![false; self.triangles.len()];
        for triangle in 0..self.triangles.len() {
            if self.least[triangle] > threshold || changed[triangle] {
                continue;
            }
            for k in 0..3 {
                let t = self.triangles[triangle];
                let (i, j) = (t[k], t[(k + 1) % 3]);
                let is_cheap = self.costs[triangle][k] < threshold;
                if !is_cheap || self.on_border[i as usize] != self.on_border[j as usize] {
                    continue;
                }
                let (_, place) = self.cost(i, j);
                if !self.flips(place, i, j) && !self.flips(place, j, i) {
                    self.collapse(i, j, place, &mut changed);
                    break;
                }
            }
            if self.n_left <= wanted {
                break;
            }
        }
    }

    /// Moves vertex `i` to a place and joins `j` to it; the triangles between them vanish.
    fn collapse(&mut self, i: u32, j: u32, place: [f64; 3], changed: &mut [bool]) {
        let (a, b) = (i as usize, j as usize);
        self.points[a] = place;
        self.quadrics[a] = sum(&self.quadrics[b], &self.quadrics[a]);
        let mut corners = std::mem::take(&mut self.corners[a]);
        corners.append(&mut self.corners[b]);
        corners.retain(|&(triangle, at)| {
            let triangle = triangle as usize;
            let t = &mut self.triangles[triangle];
            if self.gone[triangle] || (t.contains(&i) && t.contains(&j)) {
                self.n_left -= usize::from(!self.gone[triangle]);
                (self.gone[triangle], self.least[triangle]) = (true, f64::INFINITY);
                return false;
            }
            t[usize::from(at)] = i;
            changed[triangle] = true;
            let t = *t;
            for k in (0..3).map(|k| (usize::from(at) + k) % 3) {
                let ends = [t[k], t[(k + 1) % 3]];
                // The edge across keeps its cost, unless that is of before the border was known.
                if ends.contains(&i) || ends.iter().all(|&j| self.on_border[j as usize]) {
                    self.costs[triangle][k] = self.cost(ends[0], ends[1]).0;
                }
            }
            self.least[triangle] = least_of(&self.costs[triangle]);
            true
        });
        self.corners[a] = corners;
    }

    /// Whether a triangle at `i` that stays would fold if its corner moved to a place; those with `j` vanish.
    fn flips(&self, place: [f64; 3], i: u32, j: u32) -> bool {
        self.corners[i as usize].iter().any(|&(triangle, at)| {
            let (triangle, at) = (triangle as usize, usize::from(at));
            let t = self.triangles[triangle];
            let (a, b) = (t[(at + 1) % 3], t[(at + 2) % 3]);
            if self.gone[triangle] || a == j || b == j {
                return false;
            }
            let [u, v] = [a, b].map(|k| unit(sub(self.points[k as usize], place)));
            dot(u, v).abs() > SHARPEST
                || dot(unit(cross(u, v)), self.normals[triangle]) < LEAST_FACING
        })
    }

    fn costs_of(&self, t: &[u32; 3]) -> [f64; 3] {
        [self.cost(t[0], t[1]).0, self.cost(t[1], t[2]).0, self.cost(t[2], t[0]).0]
    }

    /// Cost of the collapse of an edge, and the place of the vertex that it leaves.
    fn cost(&self, i: u32, j: u32) -> (f64, [f64; 3]) {
        let (i, j) = (i as usize, j as usize);
        let q = sum(&self.quadrics[i], &self.quadrics[j]);
        let det = determinant(&q, [0, 1, 2, 1, 4, 5, 2, 5, 7]);
        if det != 0.0 && !(self.on_border[i] && self.on_border[j]) {
            let inverse = 1.0 / det;
            let place = [
                -inverse * determinant(&q, [1, 2, 3, 4, 5, 6, 5, 7, 8]),
                inverse * determinant(&q, [0, 2, 3, 1, 5, 6, 2, 7, 8]),
                -inverse * determinant(&q, [0, 1, 3, 1, 4, 6, 2, 5, 8]),
            ];
            return (value(&q, place), place);
        }
        let (a, b) = (self.points[i], self.points[j]);
        let places = [a, b, add(a, b).map(|x| x / 2.0)];
        let costs = places.map(|x| value(&q, x));
        let least = least_of(&costs);
        let best = (0..3).rev().find(|&k| costs[k] == least).unwrap_or(0);
        (least, places[best])
    }
}

/// The least of three costs, any that is no number left out.
fn least_of(costs: &[f64; 3]) -> f64 {
    costs[0].min(costs[1].min(costs[2]))
}

fn unit(a: [f64; 3]) -> [f64; 3] {
    let length = norm(a);
    a.map(|x| x / length)
}

fn sum(a: &Quadric, b: &Quadric) -> Quadric {
    std::array::from_fn(|k| a[k] + b[k])
}

/// Of columns and rows that are known where it is called.
#[inline(always)]
fn determinant(q: &Quadric, [a, b, c, d, e, f, g, h, i]: [usize; 9]) -> f64 {
    let plus = q[a] * q[e] * q[i] + q[c] * q[d] * q[h] + q[b] * q[f] * q[g];
    plus - q[c] * q[e] * q[g] - q[a] * q[f] * q[h] - q[b] * q[d] * q[i]
}

/// Sum of squared distances of a point from the planes of a quadric.
fn value(q: &Quadric, [x, y, z]: [f64; 3]) -> f64 {
    let of_x = q[0] * x * x + 2.0 * q[1] * x * y + 2.0 * q[2] * x * z + 2.0 * q[3] * x;
    let of_y = of_x + q[4] * y * y + 2.0 * q[5] * y * z + 2.0 * q[6] * y;
    of_y + q[7] * z * z + 2.0 * q[8] * z + q[9]
}
