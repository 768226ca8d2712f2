//! Generalised winding number of a triangle surface: how often it winds around a point, even if it has holes,
//! overlaps or flipped triangles.

use std::f64::consts::PI;

use rayon::prelude::*;

use crate::error::{ErrorKind, Result};
use crate::geometry::surface::Surface;
use crate::vector::{Vec3, of_each};

/// Number of triangles below which a cluster is not split: one pass over them costs about as much as two far
/// fields.
const LEAF_TRIANGLES: usize = 8;

/// Range of the real part of a product of half-angles within which another factor may be multiplied: positive,
/// and far from overflow and underflow.
const PRODUCT_RANGE: std::ops::Range<f64> = 1e-100..1e100;

/// Distance to the centre of a cluster over its radius above which its expansion is used, as in Barill et al. 2018:
/// a larger one is slower and closer to the exact sum (the error falls with the third power).
pub(crate) const BETA: f64 = 2.0;

/// A tree over the triangles of a surface that sums their solid angles, replacing distant triangles by clusters
/// (Barill, Dickson, Schmidt, Levin, Jacobson 2018, "Fast winding numbers for soups and clouds").
#[derive(Debug, Clone)]
pub struct WindingTree {
    /// Depth-first: the first child of an inner cluster follows it.
    clusters: Vec<Cluster>,
    /// The triangles, in the order of the leaves.
    triangles: Vec<Sheet>,
}

/// A triangle as the exact sum needs it.
#[derive(Debug, Clone, Copy)]
struct Sheet {
    corners: [Vec3; 3],
    /// Normal of twice the triangle's area.
    normal: Vec3,
}

impl Sheet {
    fn new(corners: [Vec3; 3]) -> Self {
        let [a, b, c] = &corners;
        Self { normal: (b - a).cross(&(c - a)), corners }
    }
}

/// A cluster of triangles and its Taylor expansion about `centre` up to the second order.
///
/// With d = x − centre and n dA the area element, over the triangles of the cluster.
#[derive(Debug, Clone)]
struct Cluster {
    centre: Vec3,
    /// Squared distance from `centre` beyond which the expansion is used, mm².
    far_squared: f64,
    /// N = ∫ n dA.
    zeroth: Vec3,
    /// Traceless symmetric part of ∫ n ⊗ d dA: xx, yy, zz, yz, xz, xy.
    first: [f64; 6],
    /// Traceless symmetric part of ∫ n ⊗ d ⊗ d dA, each entry times the number of its permutations:
    /// xxx, yyy, zzz, xxy, xxz, xyy, yyz, xzz, yzz, xyz.
    second: [f64; 10],
    /// Cluster to continue with after this one; past the end for the last.
    next: u32,
    /// Triangles of a leaf; empty range for an inner cluster.
    first_triangle: u32,
    end_triangle: u32,
}

impl WindingTree {
    /// Tree of a surface.
    ///
    /// The surface need not be closed, free of overlaps, or consistently oriented.
    pub fn new(surface: &Surface) -> Self {
        Self::build(surface, BETA)
    }

    /// Tree of a surface that replaces clusters further away than `beta` of their radii, 2 by default.
    ///
    /// # Errors
    /// [`crate::MtmError::OutOfRange`] for a `beta` below 1.
    pub fn with_beta(surface: &Surface, beta: f64) -> Result<Self> {
        let is_allowed = beta.is_finite() && beta >= 1.0;
        ErrorKind::Mesh.require(is_allowed, "winding number beta", beta, "1 or more")?;
        Ok(Self::build(surface, beta))
    }

    /// Winding number at each point (mm, finite), in their order.
    ///
    /// 1 inside a closed surface with outward normals, 0 outside, values in between if it has holes; on the
    /// surface itself, the mean of both sides or the value of either. Parallel; the result does not depend on
    /// the number of threads.
    pub fn winding_number(&self, points: &[[f64; 3]]) -> Vec<f64> {
        of_each(points, |point| self.winding_number_one(point))
    }

    /// Winding number at `point` (mm, finite).
    pub fn winding_number_one(&self, point: [f64; 3]) -> f64 {
        let q = Vec3::from(point);
        let (mut sum, mut near) = (0.0, SolidAngle::new());
        let mut at = 0;
        while let Some(cluster) = self.clusters.get(at) {
            let r = cluster.centre - q;
            let r_squared = r.norm_squared();
            if r_squared > cluster.far_squared {
                sum += cluster.far_field(&r, r_squared);
            } else if cluster.end_triangle > cluster.first_triangle {
                let range = cluster.first_triangle as usize..cluster.end_triangle as usize;
                near.add(&q, &self.triangles[range]);
            } else {
                at += 1;
                continue;
            }
            at = cluster.next as usize;
        }
        (sum + near.total()) / (4.0 * PI)
    }

    fn build(surface: &Surface, beta: f64) -> Self {
        let n = surface.triangles().len();
        let sheets: Vec<Sheet> = (0..n).map(|t| Sheet::new(surface.corners(t))).collect();
        let centroid = |sheet: &Sheet| sheet.corners.iter().sum::<Vec3>() / 3.0;
        let centroids: Vec<Vec3> = sheets.iter().map(centroid).collect();
        let mut order: Vec<u32> = (0..n as u32).collect();
        let mut ranges = Vec::with_capacity(n / 2 + 1);
        split(&mut order, 0, &centroids, &mut ranges);
        let triangles: Vec<Sheet> = order.iter().map(|&t| sheets[t as usize]).collect();
        let moments = moments(&ranges, &triangles);
        let clusters = ranges
            .par_iter()
            .zip(&moments)
            .map(|(range, moments)| Cluster::new(range, moments, &triangles, beta))
            .collect();
        Self { clusters, triangles }
    }
}

/// Exact winding number at each point (mm, finite): the sum over all triangles, for reference.
pub fn winding_number_exact(surface: &Surface, points: &[[f64; 3]]) -> Vec<f64> {
    let n = surface.triangles().len();
    let triangles: Vec<Sheet> = (0..n).map(|t| Sheet::new(surface.corners(t))).collect();
    of_each(points, |point| {
        let mut sum = SolidAngle::new();
        sum.add(&Vec3::from(point), &triangles);
        sum.total() / (4.0 * PI)
    })
}

/// Triangles of one cluster, and where the depth-first walk continues after it.
struct ClusterRange {
    start: usize,
    end: usize,
    next: u32,
    is_leaf: bool,
}

/// Orders triangles by halving along the longest side of their centroids' box, and lists the
/// clusters.
fn split(order: &mut [u32], start: usize, centroids: &[Vec3], ranges: &mut Vec<ClusterRange>) {
    let this = ranges.len();
    let is_leaf = order.len() <= LEAF_TRIANGLES;
    ranges.push(ClusterRange { start, end: start + order.len(), next: 0, is_leaf });
    if !is_leaf {
        let (mut low, mut high) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for &t in order.iter() {
            low = low.inf(&centroids[t as usize]);
            high = high.sup(&centroids[t as usize]);
        }
        let axis = (high - low).imax();
        let half = order.len() / 2;
        order.select_nth_unstable_by(half, |&s, &t| {
            let (x, y) = (centroids[s as usize][axis], centroids[t as usize][axis]);
            x.total_cmp(&y).then(s.cmp(&t))
        });
        let (left, right) = order.split_at_mut(half);
        split(left, start, centroids, ranges);
        split(right, start + half, centroids, ranges);
    }
    ranges[this].next = ranges.len() as u32;
}

/// Moments of each cluster: of a leaf from its triangles, of the others from their two halves.
fn moments(ranges: &[ClusterRange], triangles: &[Sheet]) -> Vec<Moments> {
    let mut moments: Vec<Moments> = ranges
        .par_iter()
        .map(|range| {
            let leaf = if range.is_leaf { &triangles[range.start..range.end] } else { &[] };
            Moments::of(leaf)
        })
        .collect();
    // The two halves of a cluster are stored after it.
    for at in (0..ranges.len()).rev().filter(|&at| !ranges[at].is_leaf) {
        let halves = [at + 1, ranges[at + 1].next as usize];
        moments[at] = Moments::joined(halves.map(|half| &moments[half]));
    }
    moments
}

/// Area of a cluster and its moments about its centroid, with n dA the area element and d the vector from
/// there.
#[derive(Debug, Clone, Default)]
struct Moments {
    area: f64,
    centre: Vec3,
    /// ∫ n dA.
    zeroth: Vec3,
    /// ∫ n ⊗ d dA.
    first: [[f64; 3]; 3],
    /// ∫ n ⊗ d ⊗ d dA.
    second: [[[f64; 3]; 3]; 3],
}

impl Moments {
    fn of(triangles: &[Sheet]) -> Self {
        let mut sum = Self::default();
        for Sheet { corners: [a, b, c], normal } in triangles {
            let area = 0.5 * normal.norm();
            sum.centre += (a + b + c) * (area / 3.0);
            sum.area += area;
        }
        if sum.area > 0.0 {
            sum.centre /= sum.area;
        }
        for triangle in triangles {
            let [a, b, c] = triangle.corners.map(|corner| corner - sum.centre);
            let n = 0.5 * triangle.normal;
            let corners = a + b + c;
            sum.zeroth += n;
            for i in 0..3 {
                for j in 0..3 {
                    // ∫ d dA = A (a + b + c) / 3.
                    sum.first[i][j] += n[i] * corners[j] / 3.0;
                    for k in 0..3 {
                        // ∫ d ⊗ d dA = A (a⊗a + b⊗b + c⊗c + (a+b+c)⊗(a+b+c)) / 12.
                        let square =
                            a[j] * a[k] + b[j] * b[k] + c[j] * c[k] + corners[j] * corners[k];
                        sum.second[i][j][k] += n[i] * square / 12.0;
                    }
                }
            }
        }
        sum
    }

    /// Moments of two clusters together.
    fn joined(halves: [&Self; 2]) -> Self {
        let [a, b] = halves;
        let area = a.area + b.area;
        let centre = (a.centre * a.area + b.centre * b.area) / area;
        let mut sum = Self { area, centre, ..Self::default() };
        for half in halves {
            // d about the common centre is d about the half's own centre plus the vector between the two.
            let s = half.centre - centre;
            let n = half.zeroth;
            sum.zeroth += n;
            for i in 0..3 {
                for j in 0..3 {
                    sum.first[i][j] += half.first[i][j] + n[i] * s[j];
                    for k in 0..3 {
                        sum.second[i][j][k] += half.second[i][j][k]
                            + half.first[i][j] * s[k]
                            + half.first[i][k] * s[j]
                            + n[i] * s[j] * s[k];
                    }
                }
            }
        }
        sum
    }
}

impl Cluster {
    fn new(range: &ClusterRange, moments: &Moments, triangles: &[Sheet], beta: f64) -> Self {
        let corners = triangles[range.start..range.end].iter().flat_map(|t| &t.corners);
        let radius_squared =
            corners.map(|c| (c - moments.centre).norm_squared()).fold(0.0, f64::max);
        let is_leaf = range.is_leaf;
        Self {
            centre: moments.centre,
            far_squared: beta * beta * radius_squared,
            zeroth: moments.zeroth,
            first: traceless_first(&moments.first),
            second: traceless_second(&moments.second),
            next: range.next,
            first_triangle: if is_leaf { range.start as u32 } else { 0 },
            end_triangle: if is_leaf { range.end as u32 } else { 0 },
        }
    }

    /// Solid angle of the cluster from a distant point, r = centre − point.
    ///
    /// Ω = ∫ n·(r + d)/|r + d|³ dA ≈ N·r/r³ − 3 rᵀ M r/r⁵ + (15/2) T(r, r, r)/r⁷ with the traceless
    /// symmetric moments M and T: the kernel is harmonic, so the traces do not contribute.
    fn far_field(&self, r: &Vec3, r_squared: f64) -> f64 {
        let inverse = 1.0 / r_squared;
        let (x, y, z) = (r.x, r.y, r.z);
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let m = &self.first;
        let second_degree =
            m[0] * xx + m[1] * yy + m[2] * zz + 2.0 * (m[3] * y * z + m[4] * x * z + m[5] * x * y);
        let t = &self.second;
        let third_degree = x * (t[0] * xx + t[5] * yy + t[7] * zz)
            + y * (t[1] * yy + t[3] * xx + t[8] * zz)
            + z * (t[2] * zz + t[4] * xx + t[6] * yy)
            + t[9] * x * y * z;
        let series =
            self.zeroth.dot(r) + inverse * (-3.0 * second_degree + inverse * 7.5 * third_degree);
        series * inverse * inverse.sqrt()
    }
}

/// Traceless symmetric part of a matrix: xx, yy, zz, yz, xz, xy.
fn traceless_first(m: &[[f64; 3]; 3]) -> [f64; 6] {
    let third = (m[0][0] + m[1][1] + m[2][2]) / 3.0;
    [
        m[0][0] - third,
        m[1][1] - third,
        m[2][2] - third,
        0.5 * (m[1][2] + m[2][1]),
        0.5 * (m[0][2] + m[2][0]),
        0.5 * (m[0][1] + m[1][0]),
    ]
}

/// Traceless symmetric part of a tensor symmetric in its last two indices, as [`Cluster::second`]
/// has it.
///
/// T′_ijk = S_ijk − (δ_ij s_k + δ_ik s_j + δ_jk s_i)/5 with S the symmetric part and s_k = S_iik.
fn traceless_second(t: &[[[f64; 3]; 3]; 3]) -> [f64; 10] {
    let symmetric = |i: usize, j: usize, k: usize| (t[i][j][k] + t[j][k][i] + t[k][i][j]) / 3.0;
    let trace = [0, 1, 2].map(|k| symmetric(0, 0, k) + symmetric(1, 1, k) + symmetric(2, 2, k));
    let cube = |i: usize| symmetric(i, i, i) - 0.6 * trace[i];
    let square = |i: usize, k: usize| 3.0 * (symmetric(i, i, k) - 0.2 * trace[k]);
    [
        cube(0),
        cube(1),
        cube(2),
        square(0, 1),
        square(0, 2),
        square(1, 0),
        square(1, 2),
        square(2, 0),
        square(2, 1),
        6.0 * symmetric(0, 1, 2),
    ]
}

/// Solid angle of triangles seen from a point, positive if the point lies behind them; summed in the given
/// order.
///
/// tan(Ω/2) = det(a, b, c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|) (van Oosterom & Strackee
/// 1983). Half-angles are added as complex products while both stay below a right angle, so that
/// most triangles need no arctangent. A triangle with the point on a corner counts as zero.
struct SolidAngle {
    half_angles: f64,
    re: f64,
    im: f64,
}

impl SolidAngle {
    fn new() -> Self {
        Self { half_angles: 0.0, re: 1.0, im: 0.0 }
    }

    fn add(&mut self, q: &Vec3, triangles: &[Sheet]) {
        for triangle in triangles {
            let [a, b, c] = triangle.corners.map(|corner| corner - q);
            let (la, lb, lc) = (a.norm(), b.norm(), c.norm());
            let product = la * lb * lc;
            let x = product + a.dot(&b) * lc + b.dot(&c) * la + c.dot(&a) * lb;
            // det(a, b, c) = a·((b − a) × (c − a)), which keeps its digits far away.
            let y = a.dot(&triangle.normal);
            if y == 0.0 || product == 0.0 {
                continue;
            }
            if x <= 0.0 {
                self.half_angles += y.atan2(x);
                continue;
            }
            let scale = 1.0 / product;
            let (x, y) = (x * scale, y * scale);
            // Both factors lie within a right angle of the real axis, so their angles add up without wrapping
            // around.
            (self.re, self.im) = (self.re * x - self.im * y, self.re * y + self.im * x);
            if !PRODUCT_RANGE.contains(&self.re) {
                self.half_angles += self.im.atan2(self.re);
                (self.re, self.im) = (1.0, 0.0);
            }
        }
    }

    fn total(&self) -> f64 {
        2.0 * (self.half_angles + self.im.atan2(self.re))
    }
}
