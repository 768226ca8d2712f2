//! Rigid motion, optionally with a scale, that brings points closest to their partners.

use nalgebra::{Matrix3, Matrix4, Quaternion, UnitQuaternion};

use crate::error::{ErrorKind, MtmError, Result};
use crate::registration::spread::{check_coordinates, check_count, check_not_in_line};
use crate::vector::Vec3;

/// Number of pairs that determine a rigid motion, if they are not collinear.
pub const LEAST_PAIRS: usize = 3;

/// Gap between the best and the second-best quaternion, over the spread of the points, below which the rotation
/// is not determined: rounding then rotates it by 1e-6 rad.
const UNDETERMINED_GAP: f64 = 1e-10;

/// How pairs are fitted.
#[derive(Debug, Clone, Copy, Default)]
pub struct RigidFitOptions<'a> {
    /// Weight of each pair, 0 or more; equal weights if none.
    pub weights: Option<&'a [f64]>,
    /// Whether a uniform scale is fitted as well.
    pub scale: bool,
}

/// The best motion of paired points.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidFit {
    /// x ↦ s R x + t, row by row, t in mm; R is always a proper rotation.
    pub matrix: [[f64; 4]; 4],
    /// s: 1 unless a scale was requested.
    pub scale: f64,
    /// Distance of each moved point from its partner, mm.
    pub residuals: Vec<f64>,
    /// Root of the weighted mean of their squares, mm.
    pub rms: f64,
}

/// Motion s R x + t that minimises Σ w |s R x + t − y|² over pairs x of `moving`, y of `fixed` (mm).
///
/// The rotation is the unit quaternion q that maximises qᵀ N q (Horn 1987, section 4), so it is never a
/// reflection; the scale is Σ w y·R x / Σ w |x|² about the centroids (Umeyama 1991, eq. 42).
///
/// # Errors
/// [`MtmError::Length`], [`MtmError::NotFinite`], [`MtmError::OutOfRange`] for weights and coordinates,
/// [`MtmError::TooFewPoints`] with fewer than three pairs of weight above 0, [`MtmError::FlatPoints`] if
/// those of one set lie in a line, [`MtmError::NotDetermined`] if several rotations fit alike.
pub fn rigid_fit(
    moving: &[[f64; 3]],
    fixed: &[[f64; 3]],
    options: &RigidFitOptions<'_>,
) -> Result<RigidFit> {
    check_coordinates("moving", moving)?;
    check_coordinates("fixed", fixed)?;
    let ones = vec![1.0; moving.len()];
    let weights = options.weights.unwrap_or(&ones);
    check_pairs(moving, fixed, weights)?;
    let pose = fit_pairs(moving, fixed, weights, options.scale)?;
    let residuals: Vec<f64> = moving
        .iter()
        .zip(fixed)
        .map(|(&x, &y)| (pose.apply(Vec3::from(x)) - Vec3::from(y)).norm())
        .collect();
    let total: f64 = weights.iter().sum();
    let squares: f64 = residuals.iter().zip(weights).map(|(r, w)| w / total * r * r).sum();
    Ok(RigidFit { matrix: pose.matrix(), scale: pose.scale, residuals, rms: squares.sqrt() })
}

/// A motion about the centroid of the points it moves, which loses no digits.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pose {
    pub rotation: UnitQuaternion<f64>,
    pub scale: f64,
    /// Centroid before and after, mm.
    pub centre: Vec3,
    pub image: Vec3,
}

impl Pose {
    pub fn apply(&self, x: Vec3) -> Vec3 {
        self.rotation * (x - self.centre) * self.scale + self.image
    }

    /// 4×4, row by row.
    pub fn matrix(&self) -> [[f64; 4]; 4] {
        let r = self.rotation.to_rotation_matrix().into_inner() * self.scale;
        let t = self.image - r * self.centre;
        let row = |i: usize| [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]];
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    }
}

/// The best pose of checked pairs.
pub(crate) fn fit_pairs(
    moving: &[[f64; 3]],
    fixed: &[[f64; 3]],
    weights: &[f64],
    with_scale: bool,
) -> Result<Pose> {
    // Weights relative to their total: weights of any size give the same sums.
    let total: f64 = weights.iter().sum();
    let centroid = |points: &[[f64; 3]]| {
        points.iter().zip(weights).map(|(&p, w)| Vec3::from(p) * (w / total)).sum::<Vec3>()
    };
    let (centre, image) = (centroid(moving), centroid(fixed));
    // M = Σ w x yᵀ, with x and y about the centroids.
    let (mut m, mut moving_squares, mut fixed_squares) = (Matrix3::zeros(), 0.0, 0.0);
    for ((&x, &y), w) in moving.iter().zip(fixed).zip(weights) {
        let (x, y) = (Vec3::from(x) - centre, Vec3::from(y) - image);
        m += x * y.transpose() * (w / total);
        moving_squares += w / total * x.norm_squared();
        fixed_squares += w / total * y.norm_squared();
    }
    let spread = (moving_squares * fixed_squares).sqrt();
    if spread == 0.0 {
        let why = "all points of one set coincide; check whether all pairs share a point";
        return Err(MtmError::not_determined("the rotation between the two sets", why));
    }
    let rotation = best_rotation(&(m / spread))?;
    // Σ y·R x = tr(R M), since (R x)·y = tr(R x yᵀ).
    let scale = if with_scale {
        (rotation.to_rotation_matrix().into_inner() * m).trace() / moving_squares
    } else {
        1.0
    };
    Ok(Pose { rotation, scale, centre, image })
}

/// Rotation of largest tr(R M), with M (finite) over the spread of the points.
///
/// The quaternion is the eigenvector of the largest eigenvalue of the symmetric N (Horn 1987).
fn best_rotation(m: &Matrix3<f64>) -> Result<UnitQuaternion<f64>> {
    let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] =
        [0, 1, 2].map(|i| [0, 1, 2].map(|k| m[(i, k)]));
    #[rustfmt::skip]
    let n = Matrix4::new(
        xx + yy + zz, yz - zy,      zx - xz,       xy - yx,
        yz - zy,      xx - yy - zz, xy + yx,       zx + xz,
        zx - xz,      xy + yx,      yy - xx - zz,  yz + zy,
        xy - yx,      zx + xz,      yz + zy,       zz - xx - yy,
    );
    let eigen = n.symmetric_eigen();
    let mut order = [0, 1, 2, 3];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let gap = eigen.eigenvalues[order[0]] - eigen.eigenvalues[order[1]];
    if gap <= UNDETERMINED_GAP {
        let why = format!(
            "the best one is better than the next by {gap:.1e} of the spread of the points; is one set a \
             mirror image of the other, or do all its points lie in a line?"
        );
        return Err(MtmError::not_determined("the rotation between the two sets", why));
    }
    let best = eigen.eigenvectors.column(order[0]);
    // Of q and −q, the one with the smaller rotation angle: bitwise the same whatever the sign of the
    // eigenvector.
    let sign = if best[0] < 0.0 { -1.0 } else { 1.0 };
    Ok(UnitQuaternion::from_quaternion(Quaternion::new(best[0], best[1], best[2], best[3]) * sign))
}

fn check_pairs(moving: &[[f64; 3]], fixed: &[[f64; 3]], weights: &[f64]) -> Result<()> {
    let kind = ErrorKind::Registration;
    for (what, found) in [("fixed", fixed.len()), ("weights", weights.len())] {
        kind.require_length(what, found, moving.len(), "one for each moving point")?;
    }
    if let Some(index) = weights.iter().position(|w| !(w.is_finite() && *w >= 0.0)) {
        return Err(kind.out_of_range("weights", index, weights[index], "0 or more, finite"));
    }
    let weighing = |points: &[[f64; 3]]| -> Vec<Vec3> {
        let pairs = points.iter().zip(weights);
        pairs.filter(|&(_, &w)| w > 0.0).map(|(&p, _)| Vec3::from(p)).collect()
    };
    let (moving, fixed) = (weighing(moving), weighing(fixed));
    check_count("a rigid fit", moving.len(), LEAST_PAIRS, "pairs of points with a weight above 0")?;
    check_not_in_line("moving points", &moving)?;
    check_not_in_line("fixed points", &fixed)
}
