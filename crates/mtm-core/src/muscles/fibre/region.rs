//! A piece of a surface as unconnected triangles: exact moments of its area, and cuts by planes.
//!
//! Only areas count, so that holes and flipped triangles do no harm.

use nalgebra::{Matrix3, SymmetricEigen};

use crate::geometry::surface::Surface;
use crate::vector::Vec3;

/// Bisection steps in the search for a plane with a given share of the area: the offset is then exact to a
/// millionth of the extent, far below the size of a box.
const HALVINGS: usize = 20;

/// Triangles, mm, that need not be connected.
#[derive(Debug, Clone)]
pub(super) struct Region {
    triangles: Vec<[Vec3; 3]>,
}

/// Centroid and covariance of the area of a region.
#[derive(Debug, Clone, Copy)]
pub(super) struct AreaMoments {
    /// mm.
    pub centroid: Vec3,
    /// Mean of (x − c)(x − c)ᵀ over the area, mm².
    pub covariance: Matrix3<f64>,
}

impl Region {
    /// All triangles of a surface.
    pub fn new(surface: &Surface) -> Self {
        let triangles = (0..surface.triangles().len()).map(|t| surface.corners(t)).collect();
        Self { triangles }
    }

    /// Exact moments; none for a region without area.
    ///
    /// Over a triangle of area A with corners v and their sum s: ∫ x = A s/3 and
    /// ∫ x xᵀ = A/12 (Σ v vᵀ + s sᵀ).
    pub fn moments(&self) -> Option<AreaMoments> {
        let origin = self.triangles.first()?[0];
        let (mut area, mut first, mut second) = (0.0, Vec3::zeros(), Matrix3::zeros());
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|v| v - origin);
            let weight = 0.5 * (b - a).cross(&(c - a)).norm();
            let s = a + b + c;
            area += weight;
            first += s * (weight / 3.0);
            second +=
                (a * a.transpose() + b * b.transpose() + c * c.transpose() + s * s.transpose())
                    * (weight / 12.0);
        }
        (area > 0.0).then(|| {
            let mean = first / area;
            AreaMoments {
                centroid: origin + mean,
                covariance: second / area - mean * mean.transpose(),
            }
        })
    }

    /// Mean of |q|² q over the area, q the part of x − `centre` in the plane of two unit `axes`.
    ///
    /// It points to the side on which the area tapers off. Computed with the rule of degree 3 on triangles
    /// (Strang & Fix 1973), so it is exact.
    pub fn skew(&self, centre: Vec3, axes: [Vec3; 2]) -> Vec3 {
        let mut sum = Vec3::zeros();
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|v| {
                let x = v - centre;
                axes[0] * axes[0].dot(&x) + axes[1] * axes[1].dot(&x)
            });
            let area = 0.5 * (triangle[1] - triangle[0]).cross(&(triangle[2] - triangle[0])).norm();
            let cube = |q: Vec3| q * q.norm_squared();
            let inner = cube(a * 0.6 + (b + c) * 0.2)
                + cube(b * 0.6 + (c + a) * 0.2)
                + cube(c * 0.6 + (a + b) * 0.2);
            sum += (inner * 25.0 - cube((a + b + c) / 3.0) * 27.0) * (area / 48.0);
        }
        sum
    }

    /// Minimum and maximum of `axis`·x.
    pub fn range(&self, axis: &Vec3) -> [f64; 2] {
        self.triangles
            .iter()
            .flatten()
            .map(|v| axis.dot(v))
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
                [low.min(value), high.max(value)]
            })
    }

    /// The pieces where `height` is below and above 0; `height` is linear in x.
    pub fn split(&self, height: impl Fn(&Vec3) -> f64) -> [Self; 2] {
        let (mut below, mut above) = (Vec::new(), Vec::new());
        for triangle in &self.triangles {
            let heights = [0, 1, 2].map(|k| height(&triangle[k]));
            if heights.iter().all(|&h| h <= 0.0) {
                below.push(*triangle);
            } else if heights.iter().all(|&h| h >= 0.0) {
                above.push(*triangle);
            } else {
                clip(triangle, heights, -1.0, &mut below);
                clip(triangle, heights, 1.0, &mut above);
            }
        }
        [Self { triangles: below }, Self { triangles: above }]
    }

    /// The offset below which `height` leaves a `share` of the area.
    pub fn offset(&self, height: impl Fn(&Vec3) -> f64, share: f64) -> f64 {
        let pieces: Vec<([f64; 3], f64)> = self
            .triangles
            .iter()
            .map(|triangle| {
                let mut h = [0, 1, 2].map(|k| height(&triangle[k]));
                h.sort_by(f64::total_cmp);
                let [a, b, c] = *triangle;
                (h, (b - a).cross(&(c - a)).norm())
            })
            .collect();
        let total: f64 = pieces.iter().map(|(_, area)| area).sum();
        let mut low = pieces.iter().map(|(h, _)| h[0]).fold(f64::INFINITY, f64::min);
        let mut high = pieces.iter().map(|(h, _)| h[2]).fold(f64::NEG_INFINITY, f64::max);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            let below: f64 = pieces.iter().map(|(h, area)| area * share_below(h, middle)).sum();
            if below < share * total {
                low = middle;
            } else {
                high = middle;
            }
        }
        0.5 * (low + high)
    }
}

impl AreaMoments {
    /// Unit principal axes, the longest first, right-handed.
    ///
    /// The largest component of the first two is positive, so that the axes do not depend on the
    /// order of the triangles.
    pub fn axes(&self) -> [Vec3; 3] {
        principal_axes(self.covariance)
    }

    /// Unit axes with the given first one; the others are principal in the plane across it.
    pub fn axes_about(&self, first: Vec3) -> [Vec3; 3] {
        let across = Matrix3::identity() - first * first.transpose();
        // The first axis keeps the largest variance, whatever the distribution in the plane.
        let largest = self.covariance.trace();
        let flat = across * self.covariance * across + first * first.transpose() * (2.0 * largest);
        let second = principal_axes(flat)[1];
        let second = (second - first * first.dot(&second)).normalize();
        [first, second, first.cross(&second)]
    }
}

fn principal_axes(covariance: Matrix3<f64>) -> [Vec3; 3] {
    let eigen = SymmetricEigen::new(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let [first, second] = [0, 1].map(|k| {
        let axis: Vec3 = eigen.eigenvectors.column(order[k]).into_owned();
        if axis[axis.iamax()] < 0.0 { -axis } else { axis }
    });
    [first, second, first.cross(&second)]
}

/// Share of a triangle's area below `level`, from its ascending corner heights.
fn share_below([low, middle, high]: &[f64; 3], level: f64) -> f64 {
    if level <= *low {
        0.0
    } else if level >= *high {
        1.0
    } else if level < *middle {
        (level - low).powi(2) / ((middle - low) * (high - low))
    } else {
        1.0 - (high - level).powi(2) / ((high - middle) * (high - low))
    }
}

/// The part of a triangle where the height has the sign of `side`, as one or two triangles.
fn clip(triangle: &[Vec3; 3], heights: [f64; 3], side: f64, kept: &mut Vec<[Vec3; 3]>) {
    let mut corners: Vec<Vec3> = Vec::with_capacity(4);
    for k in 0..3 {
        let next = (k + 1) % 3;
        let (h, g) = (heights[k] * side, heights[next] * side);
        if h >= 0.0 {
            corners.push(triangle[k]);
        }
        if (h > 0.0 && g < 0.0) || (h < 0.0 && g > 0.0) {
            corners.push(triangle[k] + (triangle[next] - triangle[k]) * (h / (h - g)));
        }
    }
    for k in 2..corners.len() {
        kept.push([corners[0], corners[k - 1], corners[k]]);
    }
}
