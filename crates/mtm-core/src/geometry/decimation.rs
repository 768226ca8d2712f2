//! Surfaces with fewer triangles, by collapsing edges in the order of their quadric error (Garland and Heckbert
//! 1997, "Surface simplification using quadric error metrics").
//!
//! A collapse that would change how the surface is connected, or fold it, is refused: a closed manifold stays one,
//! and a border stays where it is. The order depends on the input alone, so the same surface always gives the same
//! result.

use crate::error::{ErrorKind, Result, check_coordinates};
use crate::geometry::surface::check_corners;
use crate::geometry::topology::NO_TRIANGLE;
use crate::vector::Vec3;

/// Weight of the distance from the surface's own vertices, next to that from its planes. It decides where planes
/// do not (in flat parts) and makes each quadric's matrix positive definite.
const FLAT_WEIGHT: f64 = 1e-4;
/// Weight of the planes that rise from the border, which keep it where it is.
const BORDER_WEIGHT: f64 = 10.0;
/// Least cosine between the normals of a triangle before and after a collapse.
const LEAST_TURN: f64 = 0.2;
/// Least ratio of twice a triangle's area to the square of its longest edge: a sliver's normal is not known.
const LEAST_SHAPE: f64 = 1e-3;

/// The sum of weighted squared distances from planes and points: xᵀ A x − 2 bᵀ x + c.
#[derive(Clone, Copy, Default)]
struct Quadric {
    /// Upper half of A: xx, xy, xz, yy, yz, zz.
    a: [f64; 6],
    b: Vec3,
    c: f64,
}

impl Quadric {
    /// Of the plane through a point with a unit normal.
    fn plane(normal: &Vec3, point: &Vec3, weight: f64) -> Self {
        let (n, d) = (normal, normal.dot(point));
        let a = [n.x * n.x, n.x * n.y, n.x * n.z, n.y * n.y, n.y * n.z, n.z * n.z];
        Self { a: a.map(|v| weight * v), b: weight * d * n, c: weight * d * d }
    }

    /// Of a point.
    fn point(point: &Vec3, weight: f64) -> Self {
        let w = weight;
        Self { a: [w, 0.0, 0.0, w, 0.0, w], b: w * point, c: w * point.norm_squared() }
    }

    fn plus(&self, other: &Self) -> Self {
        let mut a = self.a;
        for (mine, theirs) in a.iter_mut().zip(other.a) {
            *mine += theirs;
        }
        Self { a, b: self.b + other.b, c: self.c + other.c }
    }

    /// The point of least error, and that error; `None` where the matrix is singular.
    fn least(&self) -> Option<(Vec3, f64)> {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        // The adjugate of a symmetric matrix, by Cramer's rule.
        let (axx, axy, axz) = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy);
        let (ayy, ayz, azz) = (xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy);
        let det = xx * axx + xy * axy + xz * axz;
        if det.is_nan() || det <= f64::MIN_POSITIVE {
            return None;
        }
        let b = &self.b;
        let x = Vec3::new(
            axx * b.x + axy * b.y + axz * b.z,
            axy * b.x + ayy * b.y + ayz * b.z,
            axz * b.x + ayz * b.y + azz * b.z,
        ) / det;
        // At the minimum A x = b.
        Some((x, (self.c - x.dot(b)).max(0.0)))
    }
}

/// A round collapses at most this share of the edges, those of least error: rounds cost less than a queue of all
/// edges, which has to be kept in order after each collapse.
const ROUND_SHARE: usize = 4;

/// Vertices, mm, and triangles of them.
type Triangles = (Vec<[f64; 3]>, Vec<[u32; 3]>);

/// An edge and what its collapse costs: the bits of its error in single precision, and its ends.
type Rated = (u32, u32, u32);

/// A surface in the course of its decimation.
struct Decimation {
    places: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    /// Whether each triangle is still there.
    is_alive: Vec<bool>,
    quadrics: Vec<Quadric>,
    /// The last round in which each vertex changed.
    changed: Vec<u32>,
    is_border: Vec<bool>,
    /// Vertices at which the surface is no manifold.
    is_locked: Vec<bool>,
    /// Where in `around` the triangles at each vertex begin, and how many there are.
    span: Vec<(u32, u32)>,
    around: Vec<u32>,
    /// Buffers of one collapse.
    ring: Vec<u32>,
    other_ring: Vec<u32>,
}

/// The surface with about as many triangles as wanted: its vertices, mm, those without a triangle dropped, and its
/// triangles. Fewer collapses are made where they would fold the surface or change how it is connected.
///
/// # Errors
///
/// [`NotFinite`](crate::MtmError::NotFinite) and [`IndexOutOfRange`](crate::MtmError::IndexOutOfRange).
pub fn decimated(
    vertices: &[[f64; 3]],
    triangles: &[[u32; 3]],
    wanted: usize,
) -> Result<Triangles> {
    check_coordinates("surface vertices", vertices, ErrorKind::Mesh)?;
    check_corners(vertices.len(), triangles)?;
    // A triangle with two equal corners is an edge: without it the surface is connected as before.
    let proper = triangles.iter().filter(|[a, b, c]| a != b && b != c && c != a);
    let mut work = Decimation::new(vertices, proper.copied().collect());
    work.run(wanted);
    Ok(work.finished())
}

impl Decimation {
    fn new(vertices: &[[f64; 3]], triangles: Vec<[u32; 3]>) -> Self {
        let n = vertices.len();
        let places: Vec<Vec3> = vertices.iter().map(|&v| Vec3::from(v)).collect();
        let mut span = vec![(0_u32, 0_u32); n];
        for &v in triangles.iter().flatten() {
            span[v as usize].1 += 1;
        }
        let mut begin = 0;
        for entry in &mut span {
            entry.0 = begin;
            begin += entry.1;
            entry.1 = 0;
        }
        let mut around = vec![NO_TRIANGLE; 3 * triangles.len()];
        for (t, triangle) in triangles.iter().enumerate() {
            for &v in triangle {
                let entry = &mut span[v as usize];
                around[(entry.0 + entry.1) as usize] = t as u32;
                entry.1 += 1;
            }
        }
        let mut work = Self {
            places,
            is_alive: vec![true; triangles.len()],
            triangles,
            quadrics: vec![Quadric::default(); n],
            changed: vec![0; n],
            is_border: vec![false; n],
            is_locked: vec![false; n],
            span,
            around,
            ring: Vec::new(),
            other_ring: Vec::new(),
        };
        work.weigh();
        work
    }

    /// The quadrics of all vertices, the border, and where the surface is no manifold.
    fn weigh(&mut self) {
        for t in 0..self.triangles.len() {
            let corners = self.triangles[t];
            let [p, q, r] = corners.map(|v| self.places[v as usize]);
            let cross = (q - p).cross(&(r - p));
            let twice_area = cross.norm();
            let normal = if twice_area > 0.0 { cross / twice_area } else { Vec3::zeros() };
            let plane = Quadric::plane(&normal, &p, twice_area);
            for (k, &v) in corners.iter().enumerate() {
                let own = Quadric::point(&self.places[v as usize], FLAT_WEIGHT * twice_area);
                let sum = self.quadrics[v as usize].plus(&plane).plus(&own);
                self.quadrics[v as usize] = sum;
                let to = corners[(k + 1) % 3];
                let (same, back) = self.uses_of(v, to);
                if same == 1 && back == 1 {
                    continue;
                }
                let ends = [v as usize, to as usize];
                if same == 1 && back == 0 {
                    let along = self.places[ends[1]] - self.places[ends[0]];
                    let rise = along.cross(&normal);
                    if rise.norm() > 0.0 {
                        let weight = BORDER_WEIGHT * along.norm_squared();
                        let wall = Quadric::plane(&rise.normalize(), &self.places[ends[0]], weight);
                        for end in ends {
                            self.quadrics[end] = self.quadrics[end].plus(&wall);
                        }
                    }
                    ends.into_iter().for_each(|end| self.is_border[end] = true);
                } else {
                    ends.into_iter().for_each(|end| self.is_locked[end] = true);
                }
            }
        }
    }

    /// How many triangles pass the edge in this direction, and in the other one.
    fn uses_of(&self, from: u32, to: u32) -> (usize, usize) {
        let (mut same, mut back) = (0, 0);
        for &t in self.at(from) {
            let corners = self.triangles[t as usize];
            for k in 0..3 {
                if corners[k] == from {
                    same += usize::from(corners[(k + 1) % 3] == to);
                    back += usize::from(corners[(k + 2) % 3] == to);
                }
            }
        }
        (same, back)
    }

    /// The triangles at a vertex.
    fn at(&self, vertex: u32) -> &[u32] {
        let (begin, count) = self.span[vertex as usize];
        &self.around[begin as usize..(begin + count) as usize]
    }

    /// Collapses edges until no more triangles are left than wanted, or nothing can be collapsed.
    fn run(&mut self, wanted: usize) {
        let mut left = self.triangles.len();
        let mut rated = Vec::with_capacity(left * 3 / 2);
        let (mut round, mut reach) = (0, 1);
        while left > wanted {
            round += 1;
            self.rate(&mut rated);
            let most = (rated.len() / ROUND_SHARE).min((left - wanted).div_ceil(2)).max(1);
            let count = rated.len().min(reach * most);
            if count < rated.len() {
                rated.select_nth_unstable(count);
            }
            rated[..count].sort_unstable();
            let before = left;
            for &(_, a, b) in &rated[..count] {
                let has_changed = [a, b].iter().any(|&v| self.changed[v as usize] == round);
                if left <= wanted || has_changed {
                    continue;
                }
                left -= self.tried(a, b, round);
            }
            // The edges of least error may be those that cannot be collapsed: then the next ones as well.
            reach = if left < before { 1 } else { 2 * reach };
            if left == before && count == rated.len() {
                return;
            }
        }
    }

    /// All edges that may be collapsed, each once or twice.
    fn rate(&self, rated: &mut Vec<Rated>) {
        rated.clear();
        for (corners, _) in self.triangles.iter().zip(&self.is_alive).filter(|(_, is)| **is) {
            for k in 0..3 {
                let (v, w) = (corners[k], corners[(k + 1) % 3]);
                let (a, b) = (v.min(w), v.max(w));
                let is_border = self.is_border[a as usize] && self.is_border[b as usize];
                // An inner edge is passed both ways; one of the border in one direction alone.
                if v > w && !is_border || self.is_locked[a as usize] || self.is_locked[b as usize] {
                    continue;
                }
                let sum = self.quadrics[a as usize].plus(&self.quadrics[b as usize]);
                if let Some((_, error)) = sum.least() {
                    // Errors are not negative: their bits have their order.
                    rated.push(((error as f32).to_bits(), a, b));
                }
            }
        }
    }

    /// Collapses an edge if that neither folds the surface nor changes how it is connected; how many triangles that
    /// removes.
    fn tried(&mut self, a: u32, b: u32, round: u32) -> usize {
        let sum = self.quadrics[a as usize].plus(&self.quadrics[b as usize]);
        let Some((place, _)) = sum.least() else { return 0 };
        if !self.keeps_sides(a, b, &place)
            || !self.keeps_sides(b, a, &place)
            || !self.keeps_connection(a, b)
        {
            return 0;
        }
        self.changed[a as usize] = round;
        self.changed[b as usize] = round;
        self.collapse(a, b, place, sum)
    }

    /// Whether the surface is connected as before once the edge is collapsed: its ends share the corners opposite
    /// it as neighbours and no others (Dey and others 1999), and those keep enough triangles.
    fn keeps_connection(&mut self, a: u32, b: u32) -> bool {
        let (mut ring, mut other) =
            (std::mem::take(&mut self.ring), std::mem::take(&mut self.other_ring));
        self.neighbours(a, &mut ring);
        self.neighbours(b, &mut other);
        let mut shared = 0;
        let mut keeps = true;
        for v in ring.iter().filter(|v| other.binary_search(v).is_ok()) {
            shared += 1;
            let least = if self.is_border[*v as usize] { 1 } else { 3 };
            keeps &= self.span[*v as usize].1 > least;
        }
        (self.ring, self.other_ring) = (ring, other);
        let on_edge =
            self.at(a).iter().filter(|&&t| self.triangles[t as usize].contains(&b)).count();
        let both_on_border = self.is_border[a as usize] && self.is_border[b as usize];
        keeps && shared == on_edge && on_edge > 0 && (on_edge == 1) == both_on_border
    }

    /// The vertices that share an edge with one, in ascending order.
    fn neighbours(&self, vertex: u32, found: &mut Vec<u32>) {
        found.clear();
        for &t in self.at(vertex) {
            found.extend(self.triangles[t as usize].iter().filter(|&&v| v != vertex));
        }
        found.sort_unstable();
        found.dedup();
    }

    /// Whether the triangles at `a` without `b` keep their side and a shape when `a` moves.
    fn keeps_sides(&self, a: u32, b: u32, place: &Vec3) -> bool {
        self.at(a).iter().all(|&t| {
            let corners = self.triangles[t as usize];
            if corners.contains(&b) {
                return true;
            }
            let before = corners.map(|v| self.places[v as usize]);
            let after = corners.map(|v| if v == a { *place } else { self.places[v as usize] });
            let (old, new) = (doubled_area(&before), doubled_area(&after));
            let sides = [after[1] - after[0], after[2] - after[1], after[0] - after[2]];
            let longest = sides.iter().map(Vec3::norm_squared).fold(0.0, f64::max);
            let size = new.norm();
            size > LEAST_SHAPE * longest && old.dot(&new) >= LEAST_TURN * old.norm() * size
        })
    }

    /// Merges `b` into `a` at a place; how many triangles that removes.
    fn collapse(&mut self, a: u32, b: u32, place: Vec3, sum: Quadric) -> usize {
        let (mut kept, mut removed) = (Vec::with_capacity(16), Vec::with_capacity(2));
        for &t in self.at(a) {
            let list =
                if self.triangles[t as usize].contains(&b) { &mut removed } else { &mut kept };
            list.push(t);
        }
        kept.extend(self.at(b).iter().filter(|&&t| !self.triangles[t as usize].contains(&a)));
        for &t in &kept {
            for corner in self.triangles[t as usize].iter_mut().filter(|corner| **corner == b) {
                *corner = a;
            }
        }
        for &t in &removed {
            self.is_alive[t as usize] = false;
            for v in self.triangles[t as usize].into_iter().filter(|&v| v != a && v != b) {
                let others: Vec<u32> = self.at(v).iter().copied().filter(|&u| u != t).collect();
                self.put_around(v, &others);
            }
        }
        self.put_around(a, &kept);
        self.span[b as usize].1 = 0;
        self.is_border[a as usize] |= self.is_border[b as usize];
        self.places[a as usize] = place;
        self.quadrics[a as usize] = sum;
        removed.len()
    }

    /// Files the triangles at a vertex, in its old place if they fit.
    fn put_around(&mut self, vertex: u32, triangles: &[u32]) {
        let entry = &mut self.span[vertex as usize];
        if triangles.len() > entry.1 as usize {
            entry.0 = self.around.len() as u32;
            self.around.extend(triangles);
        } else {
            let begin = entry.0 as usize;
            self.around[begin..begin + triangles.len()].copy_from_slice(triangles);
        }
        entry.1 = triangles.len() as u32;
    }

    /// Vertices and triangles that are left, in their old order.
    fn finished(self) -> Triangles {
        let mut number = vec![0_u32; self.places.len()];
        let alive =
            || self.triangles.iter().zip(&self.is_alive).filter(|(_, is)| **is).map(|(t, _)| *t);
        for v in alive().flatten() {
            number[v as usize] = 1;
        }
        let mut vertices = Vec::new();
        for (number, place) in number.iter_mut().zip(&self.places) {
            if *number == 1 {
                *number = vertices.len() as u32;
                vertices.push([place.x, place.y, place.z]);
            }
        }
        let triangles = alive().map(|corners| corners.map(|v| number[v as usize])).collect();
        (vertices, triangles)
    }
}

/// The normal of a triangle with twice its area as length.
fn doubled_area([p, q, r]: &[Vec3; 3]) -> Vec3 {
    (q - p).cross(&(r - p))
}
