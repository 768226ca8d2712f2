//! Iterative closest points: the rigid motion that aligns points with a surface, or with other points.
//!
//! Besl & McKay (1992) without the worst pairs (Chetverikov et al. 2002). Steps minimise the distances to the
//! tangent planes (Chen & Medioni 1992); a step that would increase the distances is replaced by the best
//! motion of the pairs themselves, which never does. Both have the same fixed points: Σ (x − c) = 0 and Σ x ×
//! (x − c) = 0 over the pairs of a point x and its closest point c.

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector6};
use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result, check_finite_rows};
use crate::geometry::motion::{RigidMotion, rigid_matrix};
use crate::geometry::surface::Surface;
use crate::registration::nearest::PointTree;
use crate::registration::rigid::{LEAST_PAIRS, Pose, fit_pairs};
use crate::registration::spread::{check_coordinates, check_count, check_not_in_line};
use crate::vector::Vec3;

/// Number of pairs that determine a motion by their tangent planes.
const LEAST_PLANE_PAIRS: usize = 6;

/// Distance over the largest coordinate below which the direction to the closest point is mere rounding, and
/// the normal of the surface is used instead.
const TOUCHING: f64 = 64.0 * f64::EPSILON;

/// Ratio of the smallest to the largest eigenvalue of the normal equations of a tangent-plane step below which
/// some motion leaves all pairs unchanged.
const FREE_MOTION: f64 = 1e-10;

/// Points per parallel task.
const POINTS_PER_TASK: usize = 64;

/// What the moving points are aligned with.
#[derive(Debug, Clone, Copy)]
pub enum Fixed<'a> {
    /// The closest point of a surface.
    Surface(&'a Surface),
    /// The nearest of points.
    Points(&'a PointTree),
}

/// How a step is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IcpMethod {
    /// From the distances to tangent planes of the surface: quadratic convergence near the end.
    Plane,
    /// From the distances to the closest points: linear convergence, often slow.
    Point,
}

impl IcpMethod {
    /// The method called `name`.
    ///
    /// # Errors
    /// [`MtmError::UnknownName`].
    pub fn from_name(name: &str) -> Result<Self> {
        let known = [("plane", Self::Plane), ("point", Self::Point)];
        ErrorKind::Registration.named("icp method", name, known)
    }
}

/// Options of an iteration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IcpOptions {
    /// How a step is computed; if none, tangent planes for a surface, and points for points.
    pub method: Option<IcpMethod>,
    /// Initial rigid motion, 4×4 row by row.
    pub initial: [[f64; 4]; 4],
    /// Share of the pairs, those furthest apart, that a step ignores: 0 to below 1.
    pub trim: f64,
    /// Distance beyond which a pair is ignored, mm.
    pub max_distance: Option<f64>,
    /// Angle between the normals of a pair beyond which it is ignored, rad.
    pub max_angle: Option<f64>,
    /// Whether pairs on the border of an open surface count: where the moving points extend beyond the border,
    /// their partners on it are not the correct ones.
    pub keep_border: bool,
    /// Maximum number of steps.
    pub max_iterations: usize,
    /// Largest motion of a point in a step, over the radius of the points, below which the iteration has
    /// converged; 0: exactly `max_iterations` steps are done.
    pub tolerance: f64,
}

impl Default for IcpOptions {
    fn default() -> Self {
        Self {
            method: None,
            initial: *RigidMotion::identity().matrix(),
            trim: 0.0,
            max_distance: None,
            max_angle: None,
            keep_border: false,
            max_iterations: 200,
            tolerance: 1e-9,
        }
    }
}

/// Outcome of an iteration.
#[derive(Debug, Clone, PartialEq)]
pub struct IcpFit {
    /// Rigid motion, row by row, from the moving points to the fixed ones, including `initial`.
    pub matrix: [[f64; 4]; 4],
    /// Root mean square distance of the pairs that count, mm.
    pub rms: f64,
    /// Steps done.
    pub iterations: usize,
    /// Whether the iteration converged.
    pub converged: bool,
    /// Whether the pair of each moving point counts.
    pub kept: Vec<bool>,
    /// Distance of each moved point from its closest one, mm.
    pub distances: Vec<f64>,
    /// `rms` before the first step and after each step.
    pub rms_history: Vec<f64>,
}

/// A moved point and its partner.
#[derive(Debug, Clone, Copy)]
struct Match {
    moved: Vec3,
    closest: Vec3,
    /// Unit normal of the surface there; zero for points.
    normal: Vec3,
    distance: f64,
    counts: bool,
}

/// The pairs at one pose.
struct ClosestPairs {
    matches: Vec<Match>,
    kept: usize,
    mean_square: f64,
}

/// The rigid motion that brings `moving` (mm) closest to `fixed`.
///
/// `normals`: unit normal of each moving point, for [`IcpOptions::max_angle`]. The result does not
/// depend on the number of threads.
///
/// # Errors
/// [`MtmError::TooFewPoints`], [`MtmError::NotFinite`], [`MtmError::OutOfRange`],
/// [`MtmError::FlatPoints`] for the points and options; [`MtmError::NotRigid`] for `initial`; [`MtmError::NotDetermined`] if too few pairs are left or some motion leaves all pairs as they
/// are; [`MtmError::IcpNotConverged`] with the history; [`MtmError::Interrupted`].
pub fn icp(
    moving: &[[f64; 3]],
    normals: Option<&[[f64; 3]]>,
    fixed: Fixed<'_>,
    options: &IcpOptions,
    interrupt: &(dyn Fn() -> bool + Sync),
) -> Result<IcpFit> {
    check(moving, normals, fixed, options)?;
    let initial = rigid_matrix("initial", &options.initial, ErrorKind::Registration)?;
    let method = options.method.unwrap_or(match fixed {
        Fixed::Surface(_) => IcpMethod::Plane,
        Fixed::Points(_) => IcpMethod::Point,
    });
    let mut pose = initial_pose(moving, &initial);
    let reach = |x: &[f64; 3]| (Vec3::from(*x) - pose.centre).norm();
    let radius = moving.iter().map(reach).fold(0.0, f64::max);
    let find = |pose: &Pose| ClosestPairs::find(moving, normals, fixed, options, pose);

    let mut pairs = find(&pose)?;
    let mut history = vec![pairs.mean_square.sqrt()];
    let (mut converged, mut motion) = (false, f64::INFINITY);
    while history.len() <= options.max_iterations && !converged {
        if interrupt() {
            return Err(MtmError::Interrupted);
        }
        let mut next = match method {
            IcpMethod::Plane => plane_step(&pose, &pairs, radius)?,
            IcpMethod::Point => point_step(moving, &pairs)?,
        };
        let mut next_pairs = find(&next)?;
        if method == IcpMethod::Plane && next_pairs.mean_square > pairs.mean_square {
            next = point_step(moving, &pairs)?;
            next_pairs = find(&next)?;
        }
        motion = largest_motion(&pose, &next, radius);
        (pose, pairs) = (next, next_pairs);
        history.push(pairs.mean_square.sqrt());
        converged = options.tolerance > 0.0 && motion <= options.tolerance * radius;
    }
    if !converged && options.tolerance > 0.0 {
        return Err(MtmError::IcpNotConverged {
            iterations: options.max_iterations,
            motion,
            tolerance: options.tolerance * radius,
            history,
        });
    }
    Ok(IcpFit {
        matrix: pose.matrix(),
        rms: pairs.mean_square.sqrt(),
        iterations: history.len() - 1,
        converged,
        kept: pairs.matches.iter().map(|pair| pair.counts).collect(),
        distances: pairs.matches.iter().map(|pair| pair.distance).collect(),
        rms_history: history,
    })
}

impl ClosestPairs {
    fn find(
        moving: &[[f64; 3]],
        normals: Option<&[[f64; 3]]>,
        fixed: Fixed<'_>,
        options: &IcpOptions,
        pose: &Pose,
    ) -> Result<Self> {
        let least_cosine = options.max_angle.map(f64::cos);
        let farthest = options.max_distance.unwrap_or(f64::INFINITY);
        let pair = |(i, &x): (usize, &[f64; 3])| {
            let moved = pose.apply(Vec3::from(x));
            let (closest, normal, on_border) = match fixed {
                Fixed::Surface(surface) => {
                    let found = surface.closest_one(moved.into());
                    (Vec3::from(found.point), Vec3::from(found.normal), found.on_border)
                }
                Fixed::Points(tree) => {
                    (Vec3::from(tree.nearest(moved.into()).point), Vec3::zeros(), false)
                }
            };
            let faces = match (least_cosine, normals) {
                (Some(least), Some(normals)) => {
                    (pose.rotation * Vec3::from(normals[i])).dot(&normal) >= least
                }
                _ => true,
            };
            let distance = (moved - closest).norm();
            let counts = distance <= farthest && faces && (options.keep_border || !on_border);
            Match { moved, closest, normal, distance, counts }
        };
        let mut matches: Vec<Match> =
            moving.par_iter().enumerate().with_min_len(POINTS_PER_TASK).map(pair).collect();
        trim(&mut matches, options.trim);
        let kept = matches.iter().filter(|pair| pair.counts).count();
        if kept < LEAST_PLANE_PAIRS.min(moving.len()) {
            let all = moving.len();
            let why = format!(
                "{kept} of {all} pairs are left by trimming, distance, angle and border; allow more of them, \
                 or start closer (initial)"
            );
            return Err(MtmError::not_determined("the motion of the moving points", why));
        }
        let squares: f64 = counting(&matches).map(|pair| pair.distance * pair.distance).sum();
        Ok(Self { mean_square: squares / kept as f64, kept, matches })
    }
}

/// Ignores the share of the counting pairs that is furthest apart; of equal ones, the last.
fn trim(matches: &mut [Match], share: f64) {
    if share == 0.0 {
        return;
    }
    let mut order: Vec<usize> = (0..matches.len()).filter(|&i| matches[i].counts).collect();
    order.sort_by(|&i, &j| matches[i].distance.total_cmp(&matches[j].distance).then(i.cmp(&j)));
    let kept = ((1.0 - share) * order.len() as f64).ceil() as usize;
    for &i in &order[kept.min(order.len())..] {
        matches[i].counts = false;
    }
}

fn counting(matches: &[Match]) -> impl Iterator<Item = &Match> {
    matches.iter().filter(|pair| pair.counts)
}

/// The pose that brings the pairs closest to one another.
fn point_step(moving: &[[f64; 3]], pairs: &ClosestPairs) -> Result<Pose> {
    let weights: Vec<f64> =
        pairs.matches.iter().map(|pair| if pair.counts { 1.0 } else { 0.0 }).collect();
    let partners: Vec<[f64; 3]> = pairs.matches.iter().map(|pair| pair.closest.into()).collect();
    let fit = fit_pairs(moving, &partners, &weights, false)?;
    let centre = centroid(moving);
    // About the centroid of all points, like every pose here.
    Ok(Pose { image: fit.apply(centre), centre, ..fit })
}

/// The pose that brings the points closest to the tangent planes at their partners, to first order.
///
/// Rotating by ω about the centre m and translating by τ changes n·(x − c) by n·(ω × (x − m) + τ) = ω·((x − m)
/// × n) + τ·n. With n the direction from c to x this is the change of their distance.
fn plane_step(pose: &Pose, pairs: &ClosestPairs, radius: f64) -> Result<Pose> {
    let (mut a, mut b) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
    let rounding = TOUCHING * (pose.image.amax() + radius);
    for pair in counting(&pairs.matches) {
        let offset = pair.moved - pair.closest;
        let touching = pair.distance <= rounding;
        let towards = if touching { pair.normal } else { offset / pair.distance };
        // Rotations are measured by the displacement of a point at the radius, mm, like translations.
        let turn = ((pair.moved - pose.image) / radius).cross(&towards);
        let row = Vector6::new(turn.x, turn.y, turn.z, towards.x, towards.y, towards.z);
        a += row * row.transpose();
        b += row * offset.dot(&towards);
    }
    let eigen = a.symmetric_eigen();
    let largest = eigen.eigenvalues.max();
    let free = eigen.eigenvalues.iter().filter(|&&v| v <= FREE_MOTION * largest).count();
    if free > 0 || pairs.kept < LEAST_PLANE_PAIRS {
        let kept = pairs.kept;
        let why = format!(
            "{free} of 6 ways to move them leave their distances as they are, as on a plane, a ball or a \
             cylinder ({kept} pairs); take more of the surface, or method \"point\""
        );
        return Err(MtmError::not_determined("the motion of the moving points", why));
    }
    let parts = eigen.eigenvectors.transpose() * b;
    let step = -(eigen.eigenvectors * parts.component_div(&eigen.eigenvalues));
    let turn = step.fixed_rows::<3>(0) / radius;
    let rotation = UnitQuaternion::from_scaled_axis(turn) * pose.rotation;
    Ok(Pose {
        rotation: UnitQuaternion::new_normalize(rotation.into_inner()),
        image: pose.image + step.fixed_rows::<3>(3),
        ..*pose
    })
}

/// Upper bound of the displacement of any moving point from one pose to another, mm.
fn largest_motion(from: &Pose, to: &Pose, radius: f64) -> f64 {
    let turn = (to.rotation * from.rotation.inverse()).angle();
    (to.image - from.image).norm() + turn * radius
}

fn initial_pose(moving: &[[f64; 3]], initial: &[[f64; 4]; 4]) -> Pose {
    let centre = centroid(moving);
    let linear = Matrix3::from_fn(|i, k| initial[i][k]);
    let image = linear * centre + Vec3::from_fn(|i, _| initial[i][3]);
    Pose { rotation: UnitQuaternion::from_matrix(&linear), scale: 1.0, centre, image }
}

fn centroid(points: &[[f64; 3]]) -> Vec3 {
    points.iter().map(|&p| Vec3::from(p)).sum::<Vec3>() / points.len() as f64
}

fn check(
    moving: &[[f64; 3]],
    normals: Option<&[[f64; 3]]>,
    fixed: Fixed<'_>,
    options: &IcpOptions,
) -> Result<()> {
    let kind = ErrorKind::Registration;
    check_coordinates("moving", moving)?;
    check_count("icp", moving.len(), LEAST_PAIRS, "moving points that are not in one line")?;
    let places: Vec<Vec3> = moving.iter().map(|&p| Vec3::from(p)).collect();
    check_not_in_line("moving points", &places)?;
    if let Some(normals) = normals {
        check_finite_rows("normals", normals, kind)?;
        kind.require_length("normals", normals.len(), moving.len(), "one for each moving point")?;
    }
    check_options(options, matches!(fixed, Fixed::Surface(_)), normals.is_some())
}

fn check_options(options: &IcpOptions, is_surface: bool, has_normals: bool) -> Result<()> {
    let kind = ErrorKind::Registration;
    let require = |is_allowed, what, value, allowed| kind.require(is_allowed, what, value, allowed);
    require((0.0..1.0).contains(&options.trim), "trim", options.trim, "0 to below 1")?;
    require(options.max_iterations > 0, "max_iterations", 0.0, "1 or more")?;
    let tolerance = options.tolerance;
    let is_allowed = tolerance >= 0.0 && tolerance.is_finite();
    require(is_allowed, "tolerance", tolerance, "0 or more, finite")?;
    if let Some(distance) = options.max_distance {
        require(distance > 0.0, "max_distance", distance, "above 0 mm")?;
    }
    if let Some(angle) = options.max_angle {
        let is_allowed = angle > 0.0 && angle <= std::f64::consts::PI;
        require(is_allowed, "max_angle", angle, "above 0 to pi rad")?;
        let allowed = "none unless both sides are surfaces with normals";
        require(is_surface && has_normals, "max_angle", angle, allowed)?;
    }
    if options.method == Some(IcpMethod::Plane) && !is_surface {
        let without = "a set of fixed points without a surface";
        return Err(kind.not_together(("icp method", "plane"), without, "point"));
    }
    Ok(())
}
