//! Thin-plate spline in three dimensions: a smooth map that takes landmarks to their targets.
//!
//! With U(r) = r, the fundamental solution of the biharmonic equation in 3-D (Bookstein 1989 has the
//! 2-D one, r² log r), landmarks s_j and their targets y_j,
//!
//! f(x) = A x + b + Σ_j w_j U(|x − s_j|),   Σ_j w_j = 0,   Σ_j w_j s_jᵀ = 0.
//!
//! It is −U that is positive definite on weights that meet these conditions, so smoothing λ enters
//! as (U − λ I) w + (affine part) = y. Among all maps it minimises
//! Σ_j |y_j − f(s_j)|² + λ/(8π) ∫ |∇∇f|² dV, and y_j − f(s_j) = −λ w_j.

use std::f64::consts::PI;

use nalgebra::{Cholesky, DMatrix, Dyn, Matrix3};
use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result};
use crate::registration::spread::{check_coordinates, check_count, check_not_in_plane, extents};
use crate::vector::{Vec3, of_each};

/// Number of landmarks that a spline needs: four that are not coplanar determine its affine part.
pub const LEAST_LANDMARKS: usize = 4;

/// Maximum number of landmarks of a spline: the number of entries of its dense system is the square of theirs,
/// 134 MB.
pub const MOST_LANDMARKS: usize = 4096;

/// Distance of two landmarks over the longest extent below which they count as the same point.
pub const COINCIDENT_DISTANCE: f64 = 1e-6;

/// Refinement steps on the residual of the solved system: one reduces it to rounding, the second is a reserve.
const REFINEMENTS: usize = 2;

/// Points evaluated together: their sums stay in the vector registers.
const LANES: usize = 4;

/// Points per parallel task.
const POINTS_PER_TASK: usize = 1024;

/// A map through landmarks with the least bending.
#[derive(Debug, Clone)]
pub struct ThinPlateSpline {
    source: Vec<[f64; 3]>,
    target: Vec<[f64; 3]>,
    smoothing: f64,
    /// Mean of the source: coordinates are relative to it.
    centre: Vec3,
    /// Affine part: image of `centre`, and A.
    image: Vec3,
    linear: Matrix3<f64>,
    terms: Vec<Term>,
    residuals: Vec<f64>,
    bending_energy: f64,
}

/// Contribution of a landmark to the sum.
#[derive(Debug, Clone, Copy)]
struct Term {
    /// s_j about the centre, mm.
    at: [f64; 3],
    /// w_j, dimensionless.
    weight: [f64; 3],
}

/// Where a map turns space inside out.
#[derive(Debug, Clone, PartialEq)]
pub struct Folds {
    /// Determinant of the Jacobian at each point.
    pub determinants: Vec<f64>,
    /// Number of points with a determinant of zero or less.
    pub count: usize,
    /// Point with the smallest determinant, the first of several; none without points.
    pub worst: Option<usize>,
}

impl ThinPlateSpline {
    /// Spline that takes each point of `source` to the one of `target` with the same index.
    ///
    /// `source`, `target`: mm. `smoothing`: λ, mm, 0 for a spline that is exact at the landmarks; otherwise a
    /// landmark with weight w stays λ |w| away from its target.
    ///
    /// # Errors
    /// [`MtmError::Length`] for sets of different size, [`MtmError::TooFewPoints`] and
    /// [`MtmError::OutOfRange`] for their number, coordinates beyond `LARGEST_COORDINATE` and a
    /// negative smoothing, [`MtmError::NotFinite`], [`MtmError::CoincidentPoints`] and
    /// [`MtmError::FlatPoints`] for the source.
    pub fn new(source: Vec<[f64; 3]>, target: Vec<[f64; 3]>, smoothing: f64) -> Result<Self> {
        check_landmarks(&source, &target, smoothing)?;
        let n = source.len();
        let mean = |points: &[[f64; 3]]| {
            points.iter().fold(Vec3::zeros(), |sum, &p| sum + Vec3::from(p)) / n as f64
        };
        let (centre, middle) = (mean(&source), mean(&target));
        let about: Vec<Vec3> = source.iter().map(|&s| Vec3::from(s) - centre).collect();
        // In units of the landmarks' radius L, all entries of the system have the same magnitude.
        let radius = about.iter().fold(0.0_f64, |largest, s| largest.max(s.norm()));
        check_spread(&about)?;

        let scaled: Vec<Vec3> = about.iter().map(|s| s / radius).collect();
        let right = DMatrix::from_fn(n, 3, |i, axis| target[i][axis] - middle[axis]);
        let system =
            PlateSystem::new(&scaled, smoothing / radius).ok_or_else(|| closest_pair(&about).0)?;
        let (a, c) = system.solve(&right);

        // a = −w L belongs to −U/L, and c to 1 and the scaled coordinates.
        let weight = |j: usize| [0, 1, 2].map(|axis| -a[(j, axis)] / radius);
        let terms = (0..n).map(|j| Term { at: about[j].into(), weight: weight(j) }).collect();
        let mut spline = Self {
            source,
            target,
            smoothing,
            centre,
            image: middle + Vec3::from_fn(|axis, _| c[(0, axis)]),
            linear: Matrix3::from_fn(|axis, k| c[(1 + k, axis)] / radius),
            terms,
            residuals: Vec::new(),
            // ∫ |∇∇f|² dV = −8π Σ wᵀ U w, since ΔΔ|x| = −8π δ(x).
            bending_energy: 8.0 * PI * (system.kernel_energy(&a) / radius).max(0.0),
        };
        let reached = spline.evaluate(&spline.source);
        spline.residuals = reached
            .iter()
            .zip(&spline.target)
            .map(|(&f, &y)| (Vec3::from(y) - Vec3::from(f)).norm())
            .collect();
        Ok(spline)
    }

    /// Images of `points` (mm), mm, in their order.
    ///
    /// Parallel; the result depends neither on the number of threads nor on the other points.
    ///
    /// # Errors
    /// [`MtmError::NotFinite`] and, for a coordinate beyond `LARGEST_COORDINATE`, [`MtmError::OutOfRange`] with the
    /// row.
    pub fn warp(&self, points: &[[f64; 3]]) -> Result<Vec<[f64; 3]>> {
        check_coordinates("points", points)?;
        Ok(self.evaluate(points))
    }

    /// Jacobian ∂f/∂x at each of `points` (mm): entry (i, k) is ∂f_i/∂x_k.
    ///
    /// J = A + Σ w_j ⊗ (x − s_j)/|x − s_j|. At a landmark the spline has no derivative: its own term is taken
    /// as zero there, the mean over all directions; along a unit vector e the one-sided derivative is J e +
    /// w_j.
    ///
    /// # Errors
    /// Those of [`ThinPlateSpline::warp`].
    pub fn jacobian(&self, points: &[[f64; 3]]) -> Result<Vec<[[f64; 3]; 3]>> {
        check_coordinates("points", points)?;
        let rows = |j: Matrix3<f64>| std::array::from_fn(|i| std::array::from_fn(|k| j[(i, k)]));
        Ok(of_each(points, |point| rows(self.derivative(point))))
    }

    /// Determinants of the Jacobian at `points` (mm), and where they are zero or less.
    ///
    /// # Errors
    /// Those of [`ThinPlateSpline::warp`].
    pub fn folds(&self, points: &[[f64; 3]]) -> Result<Folds> {
        check_coordinates("points", points)?;
        Ok(Folds::new(of_each(points, |point| self.derivative(point).determinant())))
    }

    /// Smallest determinant of the Jacobian in the limit at each landmark, over all directions of approach.
    ///
    /// Approached from the direction e, the determinant is det(J + w eᵀ) = det J + eᵀ adj(J) w with J as in
    /// [`ThinPlateSpline::jacobian`], so the smallest is det J − |adj(J) w|: zero or less if the spline folds
    /// next to the landmark.
    pub fn landmark_folds(&self) -> Folds {
        let smallest = |(&at, term): (&[f64; 3], &Term)| {
            let j = self.derivative(at);
            let [r0, r1, r2] = [0, 1, 2].map(|i| j.row(i).transpose());
            let adjugate = Matrix3::from_columns(&[r1.cross(&r2), r2.cross(&r0), r0.cross(&r1)]);
            j.determinant() - (adjugate * Vec3::from(term.weight)).norm()
        };
        Folds::new(self.source.iter().zip(&self.terms).map(smallest).collect())
    }

    /// Landmarks before the map, mm.
    pub fn source(&self) -> &[[f64; 3]] {
        &self.source
    }

    /// Target landmarks, which the map interpolates, or approximates with smoothing, mm.
    pub fn target(&self) -> &[[f64; 3]] {
        &self.target
    }

    /// λ, mm.
    pub fn smoothing(&self) -> f64 {
        self.smoothing
    }

    /// Distance of each landmark's image from its target, mm: only rounding without smoothing.
    pub fn residuals(&self) -> &[f64] {
        &self.residuals
    }

    /// Integral over all space of the squared second derivatives of the map, mm; 0 for an affine one.
    pub fn bending_energy(&self) -> f64 {
        self.bending_energy
    }

    /// Weight w_j of each landmark, dimensionless.
    pub fn weights(&self) -> Vec<[f64; 3]> {
        self.terms.iter().map(|term| term.weight).collect()
    }

    /// Affine part x ↦ A x + b as a 4×4 matrix, row by row, b in mm.
    pub fn affine(&self) -> [[f64; 4]; 4] {
        let b = self.image - self.linear * self.centre;
        let a = &self.linear;
        let row = |i: usize| [a[(i, 0)], a[(i, 1)], a[(i, 2)], b[i]];
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    }

    fn evaluate(&self, points: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut images = vec![[0.0; 3]; points.len()];
        images
            .par_chunks_mut(LANES)
            .zip(points.par_chunks(LANES))
            .with_min_len(POINTS_PER_TASK / LANES)
            .for_each(|(images, points)| self.evaluate_lanes(points, images));
        images
    }

    /// Images of at most [`LANES`] points: coordinate by coordinate, so that lanes become vectors.
    fn evaluate_lanes(&self, points: &[[f64; 3]], images: &mut [[f64; 3]]) {
        let mut x = [[0.0; LANES]; 3];
        for (lane, point) in points.iter().enumerate() {
            for axis in 0..3 {
                x[axis][lane] = point[axis] - self.centre[axis];
            }
        }
        let mut sum = [[0.0; LANES]; 3];
        for term in &self.terms {
            for lane in 0..LANES {
                let [dx, dy, dz] = [0, 1, 2].map(|axis| x[axis][lane] - term.at[axis]);
                let r = (dx * dx + dy * dy + dz * dz).sqrt();
                for axis in 0..3 {
                    sum[axis][lane] += term.weight[axis] * r;
                }
            }
        }
        for (lane, image) in images.iter_mut().enumerate() {
            let at = Vec3::new(x[0][lane], x[1][lane], x[2][lane]);
            let bent = Vec3::new(sum[0][lane], sum[1][lane], sum[2][lane]);
            *image = (self.image + (self.linear * at + bent)).into();
        }
    }

    fn derivative(&self, point: [f64; 3]) -> Matrix3<f64> {
        let x = Vec3::from(point) - self.centre;
        let mut j = self.linear;
        for term in &self.terms {
            let offset = x - Vec3::from(term.at);
            let r = offset.norm();
            if r > 0.0 {
                j += Vec3::from(term.weight) * (offset / r).transpose();
            }
        }
        j
    }
}

impl Folds {
    fn new(determinants: Vec<f64>) -> Self {
        let count = determinants.iter().filter(|&&d| d <= 0.0).count();
        let worst = (0..determinants.len())
            .min_by(|&i, &j| determinants[i].total_cmp(&determinants[j]).then(i.cmp(&j)));
        Self { determinants, count, worst }
    }

    /// Smallest determinant; none without points.
    pub fn smallest(&self) -> Option<f64> {
        self.worst.map(|at| self.determinants[at])
    }
}

/// (K + λ I) a + P c = y, Pᵀ a = 0 with K = −U and P = (1, x, y, z), in scaled coordinates.
///
/// On the null space of Pᵀ, spanned by the last n − 4 columns of the Q of P = Q R, the system is
/// positive definite (Wahba 1990, section 2.4).
struct PlateSystem {
    /// K + λ I.
    kernel: DMatrix<f64>,
    smoothing: f64,
    affine: DMatrix<f64>,
    q: DMatrix<f64>,
    r: DMatrix<f64>,
    factor: Cholesky<f64, Dyn>,
}

impl PlateSystem {
    /// None if rounding makes the factorisation of the system fail.
    fn new(points: &[Vec3], smoothing: f64) -> Option<Self> {
        let n = points.len();
        let mut kernel = DMatrix::from_fn(n, n, |i, j| -(points[i] - points[j]).norm());
        for i in 0..n {
            kernel[(i, i)] += smoothing;
        }
        let entry = |i: usize, k: usize| if k == 0 { 1.0 } else { points[i][k - 1] };
        let affine = DMatrix::from_fn(n, LEAST_LANDMARKS, entry);
        let qr = affine.clone().qr();
        let mut transposed = DMatrix::identity(n, n);
        qr.q_tr_mul(&mut transposed);
        let q = transposed.transpose();
        let null = q.columns(LEAST_LANDMARKS, n - LEAST_LANDMARKS);
        let reduced = null.tr_mul(&(&kernel * null));
        let factor = Cholesky::new(reduced)?;
        Some(Self { kernel, smoothing, affine, r: qr.r(), q, factor })
    }

    /// Weights a and affine part c.
    fn solve(&self, right: &DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
        let (mut a, mut c) = self.solve_once(right);
        for _ in 0..REFINEMENTS {
            let residual = right - &self.kernel * &a - &self.affine * &c;
            let (da, dc) = self.solve_once(&residual);
            a += da;
            c += dc;
        }
        (a, c)
    }

    fn solve_once(&self, right: &DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
        let n = self.kernel.nrows();
        let null = self.q.columns(LEAST_LANDMARKS, n - LEAST_LANDMARKS);
        let a = null * self.factor.solve(&null.tr_mul(right));
        let rest = right - &self.kernel * &a;
        let c = self.q.columns(0, LEAST_LANDMARKS).tr_mul(&rest);
        let c = self.r.solve_upper_triangular(&c).expect("points that are not in one plane");
        (a, c)
    }

    /// Σ aᵀ K a over the axes, without smoothing.
    fn kernel_energy(&self, a: &DMatrix<f64>) -> f64 {
        a.dot(&(&self.kernel * a)) - self.smoothing * a.norm_squared()
    }
}

/// The closest two of the points, of which there are at least two, as an error; and their distance, mm.
fn closest_pair(points: &[Vec3]) -> (MtmError, f64) {
    let (mut pair, mut distance) = ((0, 1), f64::INFINITY);
    for second in 1..points.len() {
        for first in 0..second {
            let apart = (points[first] - points[second]).norm();
            if apart < distance {
                (pair, distance) = ((first, second), apart);
            }
        }
    }
    let (first, second) = pair;
    let what = "source landmarks";
    (MtmError::CoincidentPoints { what, first, second, distance }, distance)
}

fn check_landmarks(source: &[[f64; 3]], target: &[[f64; 3]], smoothing: f64) -> Result<()> {
    let kind = ErrorKind::Registration;
    let n = source.len();
    kind.require_length("target landmarks", target.len(), n, "one for each source landmark")?;
    let shape = "landmarks that do not lie in one plane";
    check_count("a thin-plate spline", n, LEAST_LANDMARKS, shape)?;
    let allowed = "4 to 4096; take fewer points, spread evenly";
    kind.require(n <= MOST_LANDMARKS, "number of landmarks", n as f64, allowed)?;
    let allowed = "0 mm or more, finite";
    kind.require(smoothing.is_finite() && smoothing >= 0.0, "smoothing", smoothing, allowed)?;
    check_coordinates("source landmarks", source)?;
    check_coordinates("target landmarks", target)
}

/// Rejects points of which two coincide, or that are all coplanar.
fn check_spread(about: &[Vec3]) -> Result<()> {
    let [.., size] = extents(about);
    let (error, distance) = closest_pair(about);
    if distance <= COINCIDENT_DISTANCE * size {
        return Err(error);
    }
    check_not_in_plane("source landmarks", about)
}
