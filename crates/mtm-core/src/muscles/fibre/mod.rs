//! Fibre directions of a muscle, from oriented boxes of its surface (Kim et al. 2010, section 2.2)
//! or from known fibre lines.
//!
//! A box is aligned with the principal axes of a part of the surface. A single box is the method of the paper;
//! parts in series follow a bend, parallel lanes converge where the muscle tapers, sectors surround an opening.
//! Between boxes the direction changes smoothly: it is the principal axis of the mean of a aᵀ over the boxes'
//! directions a, in which signs cannot cancel.

mod centre_line;
mod course;
mod parts;
mod region;

use nalgebra::Matrix3;

use crate::error::{ErrorKind, MtmError, Result, check_finite_rows};
use crate::geometry::surface::Surface;
use crate::vector::{Vec3, of_each};
use course::{Courses, Segments};
use parts::FibrePart;
use region::Region;

/// Ratio of the second extent to the first above which the longest axis of a muscle does not determine the
/// direction of its fibres.
pub const SHEET_RATIO: f64 = 0.7;

/// Permitted deviation of box axes from orthonormality.
pub const AXES_TOLERANCE: f64 = 1e-6;

/// Smallest half extent of a box used in the distance to it, relative to its largest: a flat box would
/// otherwise have no neighbourhood.
const LEAST_EXTENT: f64 = 0.05;

/// Decay of a box's weight, exp(−q/2) with q = Σ (offset/half extent)²: between the centres of two equal boxes
/// the share of one then decreases almost linearly.
const DECAY: f64 = 0.5;

/// Difference in q above which the weight of a box vanishes in rounding.
const NEGLIGIBLE: f64 = 75.0;

/// Minimum number of boxes around an opening.
const LEAST_ROUND: usize = 3;

/// Maximum number of boxes for one muscle.
///
/// Beyond it, the boxes of a real muscle would be less than 1 mm long; cutting a surface into 100 000 of them
/// takes minutes and gigabytes.
pub const MOST_BOXES: usize = 64;

/// How the fibres of a muscle run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MuscleKind {
    /// Along the muscle.
    Strap,
    /// From a wide origin to a narrow insertion.
    Fan,
    /// Round an opening.
    Ring,
    /// In a layer; the outline gives no more than an approximate direction.
    Sheet,
}

impl MuscleKind {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Strap => "strap",
            Self::Fan => "fan",
            Self::Ring => "ring",
            Self::Sheet => "sheet",
        }
    }

    /// The kind called `name`.
    ///
    /// # Errors
    /// [`MtmError::UnknownName`].
    pub fn parse(name: &str) -> Result<Self> {
        let kinds = [Self::Strap, Self::Fan, Self::Ring, Self::Sheet];
        ErrorKind::Mesh.named("kind of muscle", name, kinds.map(|kind| (kind.name(), kind)))
    }
}

/// A box along the axes of a part of a muscle's surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedBox {
    /// Its centre, mm.
    pub centre: [f64; 3],
    /// Unit axes, right-handed; the fibres run along the first.
    pub axes: [[f64; 3]; 3],
    /// Half of its extent along each axis, mm.
    pub half_extents: [f64; 3],
}

/// Where the fibres of a muscle run.
#[derive(Debug, Clone)]
pub struct MuscleFibres {
    boxes: Vec<OrientedBox>,
    reaches: Vec<Reach>,
    courses: Option<Courses>,
    kind: Option<MuscleKind>,
    extents: Option<[f64; 3]>,
}

/// The segments and boxes that determine the directions in a ball; a buffer that is refilled for each ball.
#[derive(Debug, Clone, Default)]
pub struct NearFibres(Segments);

/// A box in the form in which its weight is computed.
#[derive(Debug, Clone, Copy)]
struct Reach {
    centre: Vec3,
    /// Axes over half extents, 1/mm, as rows.
    scaled: Matrix3<f64>,
    direction: Vec3,
}

impl MuscleFibres {
    /// The fibres of a muscle from oriented boxes of its surface.
    ///
    /// `surface`: only areas count, so it may have holes and flipped triangles; pieces that do not belong to
    /// the muscle must be removed first. `boxes`: how many, in series (strap, sheet), side by side (fan) or
    /// around the opening (ring, at least 3), [`MOST_BOXES`] at most; none: as many as the shape needs.
    ///
    /// # Errors
    /// [`MtmError::OutOfRange`] for the number of boxes.
    pub fn from_surface(surface: &Surface, kind: MuscleKind, boxes: Option<usize>) -> Result<Self> {
        let least = if kind == MuscleKind::Ring { LEAST_ROUND } else { 1 };
        if let Some(count) = boxes.filter(|count| !(least..=MOST_BOXES).contains(count)) {
            let (what, allowed) = ("number of fibre boxes", "1 to 64, round an opening 3 to 64");
            return Err(ErrorKind::Mesh.out_of_range(what, 0, count as f64, allowed));
        }
        let region = Region::new(surface);
        let moments = region
            .moments()
            .ok_or(MtmError::Empty { what: "area of the muscle", kind: ErrorKind::Mesh })?;
        let axes = moments.axes();
        let found = match kind {
            MuscleKind::Strap | MuscleKind::Sheet => parts::in_series(&region, boxes),
            MuscleKind::Fan => {
                parts::in_lanes(&region, parts::taper_direction(&region, &moments), boxes)
            }
            MuscleKind::Ring => parts::in_ring(&region, boxes),
        };
        let extents = axes.map(|axis| {
            let [low, high] = region.range(&axis);
            high - low
        });
        let boxes: Vec<OrientedBox> = found.iter().map(oriented_box).collect();
        Ok(Self { kind: Some(kind), extents: Some(extents), ..Self::of_boxes(boxes) })
    }

    /// Fibres along the first axes of `boxes`.
    ///
    /// # Errors
    /// [`MtmError::Empty`] without a box; [`MtmError::NotFinite`] for a centre, axis or extent that is NaN or
    /// infinite; [`MtmError::OutOfRange`] for axes that are not orthonormal within `AXES_TOLERANCE`, and if a
    /// half extent is negative or all are 0.
    pub fn from_boxes(boxes: Vec<OrientedBox>) -> Result<Self> {
        let kind = ErrorKind::Mesh;
        kind.require_entries("fibre boxes", boxes.len())?;
        let rows = |row: fn(&OrientedBox) -> [f64; 3]| boxes.iter().map(row).collect::<Vec<_>>();
        check_finite_rows("centre of fibre boxes", &rows(|b| b.centre), kind)?;
        check_finite_rows("half extents of fibre boxes", &rows(|b| b.half_extents), kind)?;
        for (index, b) in boxes.iter().enumerate() {
            check_finite_rows(&format!("axes of fibre box {index}"), &b.axes, kind)?;
            let axes = b.axes.map(Vec3::from);
            let frame = Matrix3::from_columns(&axes);
            let off = (frame.transpose() * frame - Matrix3::identity()).amax();
            let refuse =
                |what: &str, value, allowed| Err(kind.out_of_range(what, index, value, allowed));
            if off > AXES_TOLERANCE {
                let what = "deviation of the axes of fibre boxes from orthonormal";
                return refuse(what, off, "at most 1e-6");
            }
            let least = b.half_extents.iter().copied().fold(f64::INFINITY, f64::min);
            if least < 0.0 {
                return refuse("half extents of fibre boxes", least, "0 mm or more");
            }
            if b.half_extents.iter().all(|&h| h == 0.0) {
                return refuse("half extents of fibre boxes", 0.0, "above 0 mm along one axis");
            }
        }
        Ok(Self::of_boxes(boxes))
    }

    /// Fibres along known lines only; see [`MuscleFibres::with_courses`].
    ///
    /// # Errors
    /// Those of [`MuscleFibres::with_courses`].
    pub fn from_courses(lines: &[Vec<[f64; 3]>]) -> Result<Self> {
        Self::of_boxes(Vec::new()).with_courses(lines)
    }

    /// The same muscle with known fibre lines, which are followed instead of the boxes.
    ///
    /// Between lines, their tangents at the nearest points are weighted by the inverse fourth power of the
    /// distance. `lines`: points from origin to insertion, mm; a line that ends where it starts is closed.
    ///
    /// # Errors
    /// [`MtmError::Empty`] without a line; [`MtmError::NotFinite`]; [`MtmError::Length`] for a line
    /// of fewer than two different points.
    pub fn with_courses(self, lines: &[Vec<[f64; 3]>]) -> Result<Self> {
        let kind = ErrorKind::Mesh;
        kind.require_entries("fibre lines", lines.len())?;
        let mut distinct = Vec::with_capacity(lines.len());
        for (index, line) in lines.iter().enumerate() {
            check_finite_rows(&format!("fibre line {index}"), line, kind)?;
            let mut points: Vec<Vec3> = line.iter().map(|&p| Vec3::from(p)).collect();
            points.dedup();
            if points.len() < 2 {
                let why = "a direction needs two different points";
                return Err(kind.length(format!("fibre line {index}"), points.len(), 2, why));
            }
            distinct.push(points);
        }
        Ok(Self { courses: Some(Courses::new(&distinct)), ..self })
    }

    fn of_boxes(boxes: Vec<OrientedBox>) -> Self {
        let reaches = boxes.iter().map(Reach::new).collect();
        Self { boxes, reaches, courses: None, kind: None, extents: None }
    }

    /// The boxes of the surface; none if the fibres were made from lines alone.
    pub fn boxes(&self) -> &[OrientedBox] {
        &self.boxes
    }

    /// The kind of muscle that was assumed; none if no surface was given.
    pub fn kind(&self) -> Option<MuscleKind> {
        self.kind
    }

    /// Extents of the whole muscle along its principal axes, mm; none if no surface was given.
    pub fn extents(&self) -> Option<[f64; 3]> {
        self.extents
    }

    /// Second extent of the whole muscle over the first, 0 to 1 for most shapes; none where no
    /// surface was given.
    pub fn sheet_ratio(&self) -> Option<f64> {
        self.extents.map(|[first, second, _]| second / first)
    }

    /// Whether the outline hardly determines the direction: a sheet without known lines, or a strap without
    /// them whose two longest extents are nearly equal (above `SHEET_RATIO`).
    pub fn is_sheet(&self) -> bool {
        if self.courses.is_some() {
            return false;
        }
        match self.kind {
            Some(MuscleKind::Sheet) => true,
            Some(MuscleKind::Strap) => self.sheet_ratio().is_some_and(|ratio| ratio > SHEET_RATIO),
            _ => false,
        }
    }

    /// Unit direction of the fibres at `point` (mm, finite); its sign has no meaning.
    pub fn direction(&self, point: [f64; 3]) -> [f64; 3] {
        self.direction_by(Courses::segments, &Vec3::from(point)).into()
    }

    /// Writes into `near` the data that determine the directions in a ball (mm).
    pub fn near(&self, centre: [f64; 3], radius: f64, near: &mut NearFibres) {
        if let Some(courses) = &self.courses {
            courses.segments_near(&Vec3::from(centre), radius, &mut near.0);
        }
    }

    /// Unit direction of the fibres at `point` of the ball that `near` was filled for: the same as
    /// [`MuscleFibres::direction`], at lower cost.
    pub fn direction_near(&self, near: &NearFibres, point: [f64; 3]) -> [f64; 3] {
        self.direction_by(|_| &near.0, &Vec3::from(point)).into()
    }

    /// The direction at `x` from `segments` of the courses, or from the boxes if there are none.
    fn direction_by<'a>(
        &'a self,
        segments: impl Fn(&'a Courses) -> &'a Segments,
        x: &'a Vec3,
    ) -> Vec3 {
        if let Some(courses) = &self.courses {
            return blended(courses.tangents(segments(courses), x));
        }
        let distance = |reach: &Reach| (reach.scaled * (x - reach.centre)).norm_squared();
        let least = self.reaches.iter().map(distance).fold(f64::INFINITY, f64::min);
        let near = self.reaches.iter().filter_map(|reach| {
            let beyond = distance(reach) - least;
            (beyond < NEGLIGIBLE).then(|| (reach.direction, (-DECAY * beyond).exp()))
        });
        blended(near)
    }

    /// Unit directions at `points` (mm, finite), in their order.
    ///
    /// Parallel; the result does not depend on the number of threads.
    pub fn directions(&self, points: &[[f64; 3]]) -> Vec<[f64; 3]> {
        of_each(points, |point| self.direction(point))
    }
}

impl Reach {
    fn new(b: &OrientedBox) -> Self {
        let axes = b.axes.map(Vec3::from);
        let largest = b.half_extents.iter().copied().fold(0.0, f64::max);
        let rows = [0, 1, 2]
            .map(|k| (axes[k] / b.half_extents[k].max(LEAST_EXTENT * largest)).transpose());
        Self { centre: Vec3::from(b.centre), scaled: Matrix3::from_rows(&rows), direction: axes[0] }
    }
}

/// The box of a part: along its direction, then along the principal axes across it.
fn oriented_box(part: &FibrePart) -> OrientedBox {
    let axes = part.moments.axes_about(part.direction);
    let ranges = axes.map(|axis| part.region.range(&axis));
    let centre =
        (0..3).fold(Vec3::zeros(), |sum, k| sum + axes[k] * ranges[k][0].midpoint(ranges[k][1]));
    OrientedBox {
        centre: centre.into(),
        axes: axes.map(Into::into),
        half_extents: ranges.map(|[low, high]| 0.5 * (high - low)),
    }
}

/// The principal axis of Σ w a aᵀ over directions a with weights w; the direction of largest weight if the sum
/// has none.
fn blended(directions: impl Iterator<Item = (Vec3, f64)>) -> Vec3 {
    let (mut sum, mut heaviest, mut most) = (Matrix3::zeros(), Vec3::x(), 0.0);
    for (direction, weight) in directions {
        sum += direction * direction.transpose() * weight;
        if weight > most {
            (heaviest, most) = (direction, weight);
        }
    }
    // One direction has all the weight, up to rounding.
    let rest = sum.trace() - most;
    if rest <= f64::EPSILON * most { heaviest } else { principal_direction(&sum, heaviest) }
}

/// Unit eigenvector of the largest eigenvalue of a symmetric matrix; `otherwise` if that eigenvalue is double.
///
/// The eigenvalue in closed form (Smith 1961), the vector as the largest cross product of two rows
/// of A − λI.
fn principal_direction(a: &Matrix3<f64>, otherwise: Vec3) -> Vec3 {
    let mean = a.trace() / 3.0;
    let deviator = a - Matrix3::identity() * mean;
    let size = (deviator.norm_squared() / 6.0).sqrt();
    if size <= f64::EPSILON * mean.abs() {
        return otherwise;
    }
    // Rounding of the angle near 0 is lost in its cosine.
    let half_determinant = (0.5 * deviator.determinant() / size.powi(3)).clamp(-1.0, 1.0);
    let largest = 2.0 * size * (half_determinant.acos() / 3.0).cos();
    let m = deviator - Matrix3::identity() * largest;
    let [x, y, z] = [0, 1, 2].map(|k| m.column(k).into_owned());
    let candidates = [x.cross(&y), y.cross(&z), z.cross(&x)];
    let longest =
        candidates.into_iter().max_by(|p, q| p.norm_squared().total_cmp(&q.norm_squared()));
    longest.and_then(|v| v.try_normalize(f64::EPSILON * size * size)).unwrap_or(otherwise)
}
