//! The sides of all samples of one tet at once: one winding number, updated by crossings.

use crate::geometry::triangle;
use crate::muscles::equivalent::sequence::{Sequence, place};
use crate::muscles::equivalent::shape::{InsideTest, MuscleShape, is_inside};
use crate::vector::Vec3;

/// Distance of an anchor from the surface over the longest edge of the tet below which another one is chosen:
/// its side must not depend on the rounding of coordinates.
const CLEARANCE: f64 = 1e-9;
/// Smallest positive number: t > −SMALLEST means t ≥ 0, so that both are one comparison.
const SMALLEST: f64 = f64::MIN_POSITIVE;

/// Samples of one tet, relative to its centroid, coordinate by coordinate.
#[derive(Debug)]
pub(super) struct Packet {
    corners: [Vec3; 4],
    centroid: Vec3,
    coordinates: [Vec<f64>; 3],
    /// Winding number of each sample minus that of the anchor.
    turns: Vec<f64>,
    /// The coordinates again, relative to an anchor that is not the centroid.
    shifted: [Vec<f64>; 3],
}

/// Planes that determine whether the segment from the anchor to a sample crosses a triangle.
struct Gate {
    /// Three normals of the planes through the anchor and an edge, then that of the triangle.
    normals: [Vec3; 4],
    /// Thresholds for the products with them.
    limits: [f64; 4],
    /// Change of the winding number.
    turn: f64,
}

impl Packet {
    /// Room for `n` samples.
    pub fn new(n: usize) -> Self {
        let rows = || [vec![0.0; n], vec![0.0; n], vec![0.0; n]];
        let (corners, centroid) = ([Vec3::zeros(); 4], Vec3::zeros());
        Self { corners, centroid, coordinates: rows(), turns: vec![0.0; n], shifted: rows() }
    }

    /// Maps the samples into a tet.
    pub fn fill(&mut self, sequence: &Sequence, seed: u64, tet: u32, corners: [Vec3; 4]) {
        self.corners = corners;
        self.centroid = corners.iter().sum::<Vec3>() / 4.0;
        let edges = [1, 2, 3].map(|k| corners[k] - corners[0]);
        let start = corners[0] - self.centroid;
        for (s, weights) in sequence.in_tet(seed, tet).enumerate() {
            let x = start + place(&edges, weights);
            for axis in 0..3 {
                self.coordinates[axis][s] = x[axis];
            }
        }
    }

    /// Centre and radius of a ball that holds the tet, mm.
    pub fn ball(&self) -> (Vec3, f64) {
        let radius = self.corners.iter().map(|c| (c - self.centroid).norm()).fold(0.0, f64::max);
        (self.centroid, radius)
    }

    /// Sample `s`, mm.
    pub fn point(&self, s: usize) -> Vec3 {
        self.centroid + Vec3::from([0, 1, 2].map(|axis| self.coordinates[axis][s]))
    }

    /// Writes whether each sample lies inside `muscle`; `near` are the triangles that may cross the tet.
    ///
    /// The winding number jumps by one across each triangle and, between triangles, changes only because of the
    /// border of the surface. The value at an anchor, and the triangles on the straight segment from there to a
    /// sample, therefore determine the value at the sample, as long as the border is too far away to matter;
    /// otherwise each sample is evaluated separately. Two triangles at an edge use bitwise the same plane
    /// through the edge and the anchor: no segment slips between them or counts twice.
    pub fn inside(&mut self, muscle: &MuscleShape<'_>, near: &[u32], inside: &mut [bool]) {
        let (_, radius) = self.ball();
        let anchored = match muscle.test {
            InsideTest::Winding => self.anchor(muscle, near, radius),
            InsideTest::Normal => None,
        };
        let settled = anchored.and_then(|anchor| {
            let w = muscle.winding(&anchor);
            // The ball about the anchor contains the whole tet.
            let reach = radius + (anchor - self.centroid).norm();
            muscle.is_settled(w, &anchor, reach).then_some((anchor, w))
        });
        let Some((anchor, w)) = settled else {
            for (s, side) in inside.iter_mut().enumerate() {
                *side = muscle.holds(&self.point(s));
            }
            return;
        };
        let offset = anchor - self.centroid;
        if offset != Vec3::zeros() {
            for axis in 0..3 {
                let from = self.coordinates[axis].iter();
                self.shifted[axis].iter_mut().zip(from).for_each(|(to, x)| *to = x - offset[axis]);
            }
        }
        let [x, y, z] = if offset == Vec3::zeros() { &self.coordinates } else { &self.shifted };
        self.turns.fill(0.0);
        for &t in near {
            let corners = muscle.corners[t as usize].map(|c| c - anchor);
            if let Some(gate) = Gate::new(&corners, muscle.orientation) {
                gate.count(x, y, z, &mut self.turns);
            }
        }
        for (side, turns) in inside.iter_mut().zip(&self.turns) {
            *side = is_inside(w + turns);
        }
    }

    /// A point of the tet that is far enough from the surface: the centroid, or half-way to a corner.
    fn anchor(&self, muscle: &MuscleShape<'_>, near: &[u32], radius: f64) -> Option<Vec3> {
        let clearance = CLEARANCE * radius;
        let is_clear = |p: &Vec3| {
            near.iter().all(|&t| {
                let corners = &muscle.corners[t as usize];
                let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
                let height = normal.dot(&(p - corners[0])).abs();
                height > clearance * normal.norm()
                    || (triangle::closest_point(p, corners, [0, 1, 2]).point - p).norm() > clearance
            })
        };
        let half_way = self.corners.map(|c| 0.5 * (self.centroid + c));
        std::iter::once(self.centroid).chain(half_way).find(is_clear)
    }
}

impl Gate {
    /// Gate of a triangle given relative to the anchor; none if the anchor lies in its plane, since the
    /// triangle is then seen edge-on and hides nothing.
    fn new(corners: &[Vec3; 3], orientation: f64) -> Option<Self> {
        let [a, b, c] = corners;
        let normal = (b - a).cross(&(c - a));
        let height = normal.dot(a);
        if height == 0.0 {
            return None;
        }
        // The corners of the triangle run one way when seen from behind, and the other way from the front.
        let side = height.signum();
        let mut normals = [normal * side; 4];
        let mut limits = [height.abs(); 4];
        for (k, (p, q)) in [(a, b), (b, c), (c, a)].into_iter().enumerate() {
            // p × q and q × p have the same digits, so the two triangles at an edge agree; a sample exactly in
            // the plane belongs to the triangle that traverses the edge upwards, as seen from the anchor.
            normals[k] = p.cross(q) * side;
            limits[k] = if precedes(p, q) == (side > 0.0) { -SMALLEST } else { 0.0 };
        }
        Some(Self { normals, limits, turn: -side * orientation })
    }

    /// Adds the change of the winding number to every sample behind the triangle as seen from the anchor.
    fn count(&self, x: &[f64], y: &[f64], z: &[f64], turns: &mut [f64]) {
        let [m, n, o, p] = &self.normals;
        let [lm, ln, lo, lp] = self.limits;
        for (((turn, x), y), z) in turns.iter_mut().zip(x).zip(y).zip(z) {
            let product = |v: &Vec3| v.x * x + v.y * y + v.z * z;
            let behind =
                (product(m) > lm) & (product(n) > ln) & (product(o) > lo) & (product(p) > lp);
            *turn += if behind { self.turn } else { 0.0 };
        }
    }
}

/// Order of positions by coordinates, the same for every triangle at them.
fn precedes(p: &Vec3, q: &Vec3) -> bool {
    (p.x, p.y, p.z) < (q.x, q.y, q.z)
}
