//! The centre line of a long region: a polynomial through the centroids of its slices.

use nalgebra::{DMatrix, DVector};

use super::region::{AreaMoments, Region};
use crate::vector::Vec3;

/// Slices of equal area whose centroids the line is fitted to.
const SLICES: usize = 16;

/// Number of times that the region is cut across the line and the line fitted again; the first cuts are across
/// the longest axis. A strap bent by a right angle converges to within a tenth of a degree.
const ROUNDS: usize = 5;

/// Length over width needed for each degree of the line in that direction: in a shorter region, deviations from
/// a straight line come from the shape of its ends, not from a bend.
const SLENDERNESS_PER_DEGREE: f64 = 2.0;

/// How much less the slices at the ends count than those in the middle: an oblique end removes one side of
/// them, which shifts their centroids to the other.
const END_DOUBT: f64 = 0.9;

/// Number of slices at each end that take the tangent of their neighbour: a polynomial oscillates at its ends.
const END_SLICES: f64 = 1.0;

/// Highest degree of the line: two bends.
const HIGHEST_DEGREE: usize = 4;

/// Extent of a bar over the standard deviation of its points.
pub(super) const EXTENT_PER_DEVIATION: f64 = 3.464_101_615_137_754_6; // √12

/// A line along the middle of a region, parametrised by the share of the area before a position.
#[derive(Debug, Clone)]
pub(super) struct CentreLine {
    /// Coefficients of 1, t, t², …, mm.
    coefficients: Vec<Vec3>,
    /// t at the middle of each slice, ascending from −1 to 1.
    places: Vec<f64>,
}

impl CentreLine {
    /// The line of a region with these moments.
    ///
    /// The longer the region is relative to its width in a direction, the more the line may bend in that
    /// direction.
    pub fn new(region: &Region, moments: &AreaMoments) -> Self {
        let axes = moments.axes();
        let mut line = Self::straight(axes[0]);
        for _ in 0..ROUNDS {
            let slices = line.cut(region, SLICES);
            let found: Vec<(Vec3, AreaMoments)> = slices
                .iter()
                .enumerate()
                .filter_map(|(i, slice)| {
                    let share = (i as f64 + 0.5) / SLICES as f64;
                    slice.moments().map(|moments| (line.tangent(share), moments))
                })
                .collect();
            line = match Self::fitted(&found, axes) {
                Some(line) => line,
                // A region whose slices have no area or length is straight.
                None => return Self::straight(axes[0]),
            };
        }
        line
    }

    fn straight(axis: Vec3) -> Self {
        let places = (0..SLICES).map(|i| 2.0 * i as f64 / (SLICES as f64 - 1.0) - 1.0).collect();
        Self { coefficients: vec![Vec3::zeros(), axis], places }
    }

    /// The least-squares line through the centroids of slices with their normals.
    fn fitted(slices: &[(Vec3, AreaMoments)], axes: [Vec3; 3]) -> Option<Self> {
        if slices.len() < SLICES {
            return None;
        }
        let mut lengths = vec![0.0];
        for pair in slices.windows(2) {
            let step = (pair[1].1.centroid - pair[0].1.centroid).norm();
            lengths.push(lengths[lengths.len() - 1] + step);
        }
        let whole = lengths[lengths.len() - 1];
        if whole <= 0.0 {
            return None;
        }
        let places: Vec<f64> = lengths.iter().map(|l| 2.0 * l / whole - 1.0).collect();
        let degree = |axis: &Vec3| {
            let width = slices.iter().map(|(normal, m)| width_across(axis, normal, m)).sum::<f64>()
                / slices.len() as f64;
            ((whole / (SLENDERNESS_PER_DEGREE * width)) as usize).clamp(1, HIGHEST_DEGREE)
        };
        let across = [degree(&axes[1]), degree(&axes[2])];
        let degrees = [across[0].max(across[1]), across[0], across[1]];
        let mut coefficients = vec![Vec3::zeros(); degrees[0] + 1];
        for (axis, degree) in axes.iter().zip(degrees) {
            let doubt = if degree == 1 { END_DOUBT } else { 0.0 };
            let weight = |i: usize| 1.0 - doubt * places[i].powi(2);
            let powers =
                DMatrix::from_fn(SLICES, degree + 1, |i, k| weight(i) * places[i].powi(k as i32));
            let values =
                DVector::from_fn(SLICES, |i, _| weight(i) * axis.dot(&slices[i].1.centroid));
            // Distinct positions make the columns independent, so that QR has a solution.
            let qr = powers.qr();
            let solution = qr.r().solve_upper_triangular(&(qr.q().transpose() * values))?;
            for (coefficient, &value) in coefficients.iter_mut().zip(&solution) {
                *coefficient += axis * value;
            }
        }
        Some(Self { coefficients, places })
    }

    /// Unit tangent at the position with `share` (0 to 1) of the area before it.
    pub fn tangent(&self, share: f64) -> Vec3 {
        let last = self.places.len() - 1;
        let at =
            (share * self.places.len() as f64 - 0.5).clamp(END_SLICES, last as f64 - END_SLICES);
        let i = (at as usize).min(last - 1);
        let t = self.places[i] + (at - i as f64) * (self.places[i + 1] - self.places[i]);
        let mut slope = Vec3::zeros();
        for (k, coefficient) in self.coefficients.iter().enumerate().skip(1) {
            slope += coefficient * (k as f64 * t.powi(k as i32 - 1));
        }
        slope.normalize()
    }

    /// Angle by which the tangent turns from one end to the other, rad.
    pub fn turning(&self) -> f64 {
        let tangents: Vec<Vec3> =
            (0..SLICES).map(|i| self.tangent((i as f64 + 0.5) / SLICES as f64)).collect();
        tangents.windows(2).map(|pair| pair[0].angle(&pair[1])).sum()
    }

    /// The region in `count` slices of equal area, cut across the line, in order along it.
    ///
    /// By recursive halving, so that a plane only cuts what is near it along the line.
    pub fn cut(&self, region: &Region, count: usize) -> Vec<Region> {
        let mut slices = Vec::with_capacity(count);
        self.cut_between(region.clone(), [0, count], count, &mut slices);
        slices
    }

    fn cut_between(
        &self,
        region: Region,
        [from, to]: [usize; 2],
        count: usize,
        out: &mut Vec<Region>,
    ) {
        if to - from == 1 {
            out.push(region);
            return;
        }
        let middle = from.midpoint(to);
        let normal = self.tangent(middle as f64 / count as f64);
        let height = |x: &Vec3| normal.dot(x);
        let offset = region.offset(height, (middle - from) as f64 / (to - from) as f64);
        let [below, above] = region.split(|x| height(x) - offset);
        self.cut_between(below, [from, middle], count, out);
        self.cut_between(above, [middle, to], count, out);
    }
}

/// Extent of a slice along `axis` as seen in the plane across `normal`, mm.
fn width_across(axis: &Vec3, normal: &Vec3, moments: &AreaMoments) -> f64 {
    let flat = axis - normal * normal.dot(axis);
    EXTENT_PER_DEVIATION * flat.dot(&(moments.covariance * flat)).max(0.0).sqrt()
}
