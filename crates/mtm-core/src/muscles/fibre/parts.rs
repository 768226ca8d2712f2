//! The parts of a muscle, each with one direction: in series, side by side, or around an opening.

use std::f64::consts::{FRAC_PI_2, PI};

use super::centre_line::{CentreLine, EXTENT_PER_DEVIATION};
use super::region::{AreaMoments, Region};
use crate::vector::Vec3;

/// Rotation of the centre line per box, rad (8°): at the ends of a box the direction is off by half of that.
const TURN_PER_BOX: f64 = 0.14;

/// Maximum number of boxes in series: a line that would need more reverses its direction.
const MOST_IN_SERIES: usize = 12;

/// Number of boxes around an opening if none is given: each covers 15°.
const BOXES_ROUND: usize = 24;

/// Angle between neighbouring lanes of a fan, rad (9°).
const TURN_PER_LANE: f64 = 0.16;

/// Ratio of length to width from which a lane's own centre line is determined.
const LANE_SLENDERNESS: f64 = 3.0;

/// Maximum number of lanes side by side.
const MOST_LANES: usize = 10;

/// Number of slices across a sheet that determine its taper.
const TAPER_SLICES: usize = 8;

/// Change of width over the length of a sheet, relative to the larger width, below which its lanes are
/// parallel: straps become that much narrower at their ends alone.
const PARALLEL_TAPER: f64 = 0.15;

/// Number of times that a pencil is aligned with the apex found and the search repeated.
const AIMS: usize = 4;

/// Minimum distance of the apex beyond the tip, relative to the length: planes through it must not intersect
/// inside.
const APEX_MARGIN: f64 = 0.02;

/// A piece of a muscle's surface with one direction of its fibres.
#[derive(Debug, Clone)]
pub(super) struct FibrePart {
    /// Its triangles.
    pub region: Region,
    /// Its centroid and covariance.
    pub moments: AreaMoments,
    /// Unit direction of the fibres.
    pub direction: Vec3,
}

impl FibrePart {
    fn new(region: Region, direction: Vec3) -> Option<Self> {
        region.moments().map(|moments| Self { region, moments, direction })
    }
}

/// Parts in series along the centre line; `count`, or as many as its rotation requires.
///
/// A single requested part has its principal axis (Kim et al. 2010); otherwise the directions are the tangents
/// of the line.
pub(super) fn in_series(region: &Region, count: Option<usize>) -> Vec<FibrePart> {
    let Some(moments) = region.moments() else { return Vec::new() };
    if count == Some(1) {
        return FibrePart::new(region.clone(), moments.axes()[0]).into_iter().collect();
    }
    let line = CentreLine::new(region, &moments);
    let needed = || ((line.turning() / TURN_PER_BOX).ceil() as usize).clamp(1, MOST_IN_SERIES);
    let count = count.unwrap_or_else(needed);
    let middle = |i: usize| line.tangent((i as f64 + 0.5) / count as f64);
    let slices = line.cut(region, count).into_iter().enumerate();
    slices.filter_map(|(i, slice)| FibrePart::new(slice, middle(i))).collect()
}

/// Parts in lanes that converge where the muscle tapers; `lanes` of one part each, or as many as the shape
/// needs, each in series.
///
/// `towards`: from the wide side to the narrow one.
pub(super) fn in_lanes(region: &Region, towards: Vec3, lanes: Option<usize>) -> Vec<FibrePart> {
    let Some(moments) = region.moments() else { return Vec::new() };
    let pencil = Pencil::new(region, &moments, towards);
    let count = lanes.unwrap_or(pencil.lanes);
    let in_lane = lanes.map(|_| 1);
    let (mut rest, mut parts) = (region.clone(), Vec::new());
    for left in (1..=count).rev() {
        if left == 1 {
            parts.extend(in_series(&rest, in_lane));
            break;
        }
        let slope = rest.offset(|x| pencil.slope(x), 1.0 / left as f64);
        let [lane, others] = rest.split(|x| pencil.height(x, slope));
        parts.extend(in_series(&lane, in_lane));
        rest = others;
    }
    parts
}

/// Parts around an opening, each with the tangent of the line through the parts.
///
/// The opening is a slit along the longer axis, whose length is the difference between length and width of the
/// ring: rays are perpendicular to it where it is straight, and turn around its ends.
pub(super) fn in_ring(region: &Region, count: Option<usize>) -> Vec<FibrePart> {
    let Some(moments) = region.moments() else { return Vec::new() };
    let count = count.unwrap_or(BOXES_ROUND);
    let track = Track::new(region, &moments);
    let sectors: Vec<(Region, AreaMoments)> = (0..count)
        .filter_map(|i| {
            let [from, middle, to] =
                [0.0, 0.5, 1.0].map(|k| track.ray((i as f64 + k) / count as f64));
            let [_, outside] = region.split(|x| middle.ahead(x));
            let [_, after] = outside.split(|x| from.left(x));
            let [sector, _] = after.split(|x| to.left(x));
            sector.moments().map(|m| (sector, m))
        })
        .collect();
    let middles: Vec<Vec3> = sectors.iter().map(|(_, m)| m.centroid).collect();
    let n = middles.len();
    let tangent = |i: usize| (middles[(i + 1) % n] - middles[(i + n - 1) % n]).normalize();
    let directions: Vec<Vec3> = (0..n).map(tangent).collect();
    let parts = sectors.into_iter().zip(directions);
    parts.map(|((region, moments), direction)| FibrePart { region, moments, direction }).collect()
}

/// The path around a slit at half the width of a ring.
struct Track {
    centre: Vec3,
    /// Unit vectors along and across the slit, in the plane of the ring.
    axes: [Vec3; 2],
    /// Half the length of the slit, mm.
    slit: f64,
    /// Distance of the path from the slit, mm.
    radius: f64,
}

/// A ray from the slit outward, in the plane of the ring.
struct Ray {
    origin: Vec3,
    outward: Vec3,
    onward: Vec3,
}

impl Track {
    fn new(region: &Region, moments: &AreaMoments) -> Self {
        let [u, v, w] = moments.axes();
        let [along, across] = [region.range(&u), region.range(&v)];
        let centre = u * along[0].midpoint(along[1])
            + v * across[0].midpoint(across[1])
            + w * w.dot(&moments.centroid);
        let halves = [along, across].map(|[low, high]| 0.5 * (high - low));
        let (slit, radius) = (halves[0] - halves[1], 0.5 * halves[0].min(halves[1]));
        let axes = if slit < 0.0 { [v, -u] } else { [u, v] };
        Self { centre, axes, slit: slit.abs(), radius }
    }

    /// The ray at a given share of the way around.
    fn ray(&self, share: f64) -> Ray {
        let [u, v] = self.axes;
        let (straight, bend) = (2.0 * self.slit, PI * self.radius);
        let half = straight + bend;
        // The halves are equal up to a rotation by 180°.
        let way = 2.0 * share.rem_euclid(1.0);
        let (sign, way) = if way < 1.0 { (1.0, way * half) } else { (-1.0, (way - 1.0) * half) };
        let (place, angle) = if way < straight {
            (self.slit - way, FRAC_PI_2)
        } else {
            (-self.slit, FRAC_PI_2 + (way - straight) / self.radius)
        };
        let (sine, cosine) = angle.sin_cos();
        Ray {
            origin: self.centre + u * (sign * place),
            outward: (u * cosine + v * sine) * sign,
            onward: (v * cosine - u * sine) * sign,
        }
    }
}

impl Ray {
    fn ahead(&self, x: &Vec3) -> f64 {
        self.outward.dot(&(x - self.origin))
    }

    fn left(&self, x: &Vec3) -> f64 {
        self.onward.dot(&(x - self.origin))
    }
}

/// The direction in which a fan tapers: that of the third moment of its area in its own plane.
pub(super) fn taper_direction(region: &Region, moments: &AreaMoments) -> Vec3 {
    let [first, second, _] = moments.axes();
    let skew = region.skew(moments.centroid, [first, second]);
    let length = skew.norm();
    if length > 0.0 { skew / length } else { first }
}

/// Planes that contain the thin axis of a sheet and meet in an apex, or are parallel.
struct Pencil {
    origin: Vec3,
    along: Vec3,
    across: Vec3,
    /// Distance of the apex from the origin along the sheet, mm; none if the planes are parallel.
    apex: Option<f64>,
    /// Number of lanes that the shape needs.
    lanes: usize,
}

impl Pencil {
    fn new(region: &Region, moments: &AreaMoments, towards: Vec3) -> Self {
        let thin = moments.axes()[2];
        let along = (towards - thin * thin.dot(&towards)).normalize();
        let across = thin.cross(&along);
        let mut pencil = Self { origin: moments.centroid, along, across, apex: None, lanes: 1 };
        for _ in 0..AIMS {
            pencil = pencil.aimed(region);
        }
        pencil
    }

    /// The pencil with the apex at which the widths of slices across it extrapolate to zero.
    fn aimed(self, region: &Region) -> Self {
        let mut slices = self.slices(region);
        let widest = |slices: &[Slice]| {
            let order = |i: &usize, j: &usize| slices[*i].width.total_cmp(&slices[*j].width);
            (0..slices.len()).max_by(order).unwrap_or(0)
        };
        // A rounded wide end also tapers: only the part between the widest slice and the tip counts.
        let fitted = slices.split_off(widest(&slices));
        let Some(Taper { width, middle }) = Taper::of(&fitted) else { return self };
        let [low, high] = region.range(&self.along).map(|s| s - self.along.dot(&self.origin));
        let (length, broad) = (high - low, fitted[0].width);
        let by_width = (LANE_SLENDERNESS * broad / length).ceil() as usize;
        if -width[1] * length < PARALLEL_TAPER * broad {
            return Self { apex: None, lanes: by_width.clamp(1, MOST_LANES), ..self };
        }
        let ahead = (-width[0] / width[1]).max(high + APEX_MARGIN * length);
        let aim = self.along * ahead + self.across * (middle[0] + middle[1] * ahead);
        let opening = 2.0 * (0.5 * broad / (ahead - fitted[0].place)).atan();
        let by_opening = (opening / TURN_PER_LANE).ceil() as usize;
        let thin = self.along.cross(&self.across);
        let along = aim.normalize();
        Self {
            along,
            across: thin.cross(&along),
            apex: Some(aim.norm()),
            lanes: by_width.max(by_opening).clamp(1, MOST_LANES),
            ..self
        }
    }

    /// Slices of equal area across the pencil, from the wide end to the tip.
    fn slices(&self, region: &Region) -> Vec<Slice> {
        let (mut rest, mut slices) = (region.clone(), Vec::with_capacity(TAPER_SLICES));
        for left in (1..=TAPER_SLICES).rev() {
            let along = |x: &Vec3| self.place(x)[0];
            let offset = rest.offset(along, 1.0 / left as f64);
            let [slice, others] = rest.split(|x| along(x) - offset);
            rest = others;
            slices.extend(slice.moments().map(|m| {
                let [place, middle] = self.place(&m.centroid);
                let variance = self.across.dot(&(m.covariance * self.across)).max(0.0);
                Slice { place, middle, width: EXTENT_PER_DEVIATION * variance.sqrt() }
            }));
        }
        slices
    }

    fn place(&self, x: &Vec3) -> [f64; 2] {
        let x = x - self.origin;
        [self.along.dot(&x), self.across.dot(&x)]
    }

    /// A function that is constant on each plane.
    fn slope(&self, x: &Vec3) -> f64 {
        let [s, v] = self.place(x);
        self.apex.map_or(v, |apex| v / (apex - s))
    }

    /// Signed height above the plane of a slope, linear in x.
    fn height(&self, x: &Vec3, slope: f64) -> f64 {
        let [s, v] = self.place(x);
        self.apex.map_or(v - slope, |apex| v - slope * (apex - s))
    }
}

/// One slice across a pencil, mm: its position along it, its centre and width across it.
struct Slice {
    place: f64,
    middle: f64,
    width: f64,
}

/// Width and centre as linear functions of the position: value at 0 and slope.
struct Taper {
    width: [f64; 2],
    middle: [f64; 2],
}

impl Taper {
    /// The least-squares lines; none if there are fewer than two positions.
    fn of(slices: &[Slice]) -> Option<Self> {
        let n = slices.len() as f64;
        let mean = slices.iter().map(|s| s.place).sum::<f64>() / n;
        let spread: f64 = slices.iter().map(|s| (s.place - mean).powi(2)).sum();
        let line = |value: fn(&Slice) -> f64| {
            let average = slices.iter().map(value).sum::<f64>() / n;
            let slope = slices.iter().map(|s| (s.place - mean) * value(s)).sum::<f64>() / spread;
            [average - slope * mean, slope]
        };
        (spread > 0.0).then(|| Self { width: line(|s| s.width), middle: line(|s| s.middle) })
    }
}
