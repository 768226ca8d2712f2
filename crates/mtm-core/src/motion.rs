//! Motions that a plan prescribes: of a rigid segment, or of a surface whose vertices moved one by
//! one.

use nalgebra::{Matrix3, Rotation2};
use rayon::prelude::*;

use crate::error::{MtmError, Result};
use crate::surface::{Closest, Surface};
use crate::triangle::Vec3;

/// Largest entry by which RᵀR may differ from I, and the bottom row from 0 0 0 1.
///
/// Matrices written with seven digits or more pass. They are used as given, not made orthogonal:
/// within this tolerance a point 200 mm from the origin moves by at most about 2e-4 mm too much.
pub const RIGID_TOLERANCE: f64 = 1e-6;

/// Points a thread takes at once.
const POINTS_PER_TASK: usize = 64;

/// A rigid motion x' = R x + t.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidMotion {
    matrix: [[f64; 4]; 4],
}

impl RigidMotion {
    /// Motion of the named segment by a 4×4 matrix, row by row, t in mm.
    ///
    /// # Errors
    /// [`MtmError::Plan`] with the segment's name if an entry is not finite, the bottom row is not
    /// 0 0 0 1, R mirrors, or RᵀR differs from I by more than [`RIGID_TOLERANCE`].
    pub fn new(segment: &str, matrix: &[[f64; 4]; 4]) -> Result<Self> {
        match rigid_problem(matrix) {
            None => Ok(Self { matrix: *matrix }),
            Some(problem) => Err(MtmError::Plan { segment: segment.to_owned(), problem }),
        }
    }

    /// The motion that leaves everything in place.
    pub fn identity() -> Self {
        let mut matrix = [[0.0; 4]; 4];
        for (i, row) in matrix.iter_mut().enumerate() {
            row[i] = 1.0;
        }
        Self { matrix }
    }

    /// The 4×4 matrix, row by row, as it was given.
    pub fn matrix(&self) -> &[[f64; 4]; 4] {
        &self.matrix
    }

    /// Position of `point` after the motion: R x + t, mm.
    pub fn apply(&self, point: [f64; 3]) -> [f64; 3] {
        let moved = Vec3::from(point) + Vec3::from(self.displacement(point));
        moved.into()
    }

    /// Displacement of `point`: (R − I) x + t, mm.
    pub fn displacement(&self, point: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = point;
        [0, 1, 2].map(|i| {
            let mut row = self.matrix[i];
            row[i] -= 1.0;
            row[0] * x + row[1] * y + row[2] * z + row[3]
        })
    }

    /// Position that the motion takes to `point`: R⁻¹ (x − t), mm, with the true inverse of R as given.
    pub fn apply_inverse(&self, point: [f64; 3]) -> [f64; 3] {
        let m = &self.matrix;
        let r = Matrix3::from_fn(|i, j| m[i][j]);
        let shifted = nalgebra::Vector3::from_fn(|i, _| point[i] - m[i][3]);
        r.lu().solve(&shifted).map_or(point, |x| [x[0], x[1], x[2]])
    }

    /// The direction `vector` turned by the motion: R v.
    pub fn rotate(&self, vector: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = vector;
        [0, 1, 2].map(|i| {
            let row = &self.matrix[i];
            row[0] * x + row[1] * y + row[2] * z
        })
    }
}

/// What keeps a matrix from being a rigid motion, with the mend.
pub(crate) fn rigid_problem(matrix: &[[f64; 4]; 4]) -> Option<String> {
    for (i, row) in matrix.iter().enumerate() {
        if let Some(j) = row.iter().position(|value| !value.is_finite()) {
            let value = row[j];
            return Some(format!(
                "entry [{i}][{j}] of its 4x4 motion is {value}: every entry must be finite"
            ));
        }
    }
    let bottom = matrix[3];
    let off = |value: f64, ideal: f64| (value - ideal).abs() > RIGID_TOLERANCE;
    if off(bottom[0], 0.0) || off(bottom[1], 0.0) || off(bottom[2], 0.0) || off(bottom[3], 1.0) {
        return Some(format!(
            "the bottom row of its 4x4 motion is {bottom:?}: it must be 0 0 0 1 within \
             {RIGID_TOLERANCE:.0e}; if the translation stands there, transpose the matrix"
        ));
    }
    let r = Matrix3::from_fn(|i, j| matrix[i][j]);
    let deviation = (r.transpose() * r - Matrix3::identity()).amax();
    let determinant = r.determinant();
    if determinant < 0.0 {
        return Some(format!(
            "its 4x4 motion is a reflection (determinant {determinant:.6}): bone cannot be mirrored; \
             check the signs of the axes (RAS and LPS differ by a rotation, never by a mirror)"
        ));
    }
    // Entries so large that the product overflows give NaN.
    if deviation.is_nan() || deviation > RIGID_TOLERANCE {
        return Some(format!(
            "its 4x4 motion is not rigid: R^T R differs from the identity by {deviation:.3e}, allowed is \
             {RIGID_TOLERANCE:.0e}; remove scaling and shear, and write at least seven digits"
        ));
    }
    None
}

/// The motion of a surface whose vertices moved one by one, carried on to points near it.
#[derive(Debug, Clone)]
pub struct SurfaceMotion {
    rest: Surface,
    moved: Surface,
}

impl SurfaceMotion {
    /// Motion that takes the vertices of `rest` to `moved_vertices` (mm, in the same order).
    ///
    /// # Errors
    /// Those of [`Surface::moved`]: another count of vertices, one that is not finite, or a
    /// triangle that collapses.
    pub fn new(rest: Surface, moved_vertices: Vec<[f64; 3]>) -> Result<Self> {
        let moved = rest.moved(moved_vertices)?;
        Ok(Self { rest, moved })
    }

    /// The surface before the motion.
    pub fn rest(&self) -> &Surface {
        &self.rest
    }

    /// The surface after the motion.
    pub fn moved(&self) -> &Surface {
        &self.moved
    }

    /// Displacement of each point (mm, at rest, finite), mm, in the order of `points`.
    ///
    /// A point x keeps its place relative to its closest triangle: x' = c' + R (x − c), with c its
    /// closest point, c' the same place on the moved triangle, and R the rotation of the triangle
    /// (the polar factor of its tangent map extended by the normals). So a rigid motion is followed
    /// exactly, on the surface and off it. On the surface the displacement is continuous; off it,
    /// it jumps with R between triangles that turn differently, by the distance to the surface
    /// times the difference of R. Parallel; the result does not depend on the number of threads.
    pub fn displacement(&self, points: &[[f64; 3]]) -> Vec<[f64; 3]> {
        points
            .par_iter()
            .with_min_len(POINTS_PER_TASK)
            .map(|&point| self.follow(point, &self.rest.closest_one(point)))
            .collect()
    }

    fn follow(&self, point: [f64; 3], closest: &Closest) -> [f64; 3] {
        let triangle = closest.triangle as usize;
        let (rest, moved) = (self.rest.corners(triangle), self.moved.corners(triangle));
        let mut carried = Vec3::zeros();
        for k in 0..3 {
            carried += (moved[k] - rest[k]) * closest.barycentric[k];
        }
        let offset = Vec3::from(point) - Vec3::from(closest.point);
        let from = plane_frame(&rest, self.rest.facet_normal(triangle));
        let to = plane_frame(&moved, self.moved.facet_normal(triangle));
        // u = (c' − c) + (R − I)(x − c), which stays exact for points on the surface.
        let displacement = carried + turn(&from, &to) * offset - offset;
        displacement.into()
    }
}

/// A triangle in its own plane.
struct PlaneFrame {
    /// Columns: direction of edge ab, its perpendicular in the plane, normal.
    axes: Matrix3<f64>,
    /// Corner b = (b, 0) and corner c = (c, height) from corner a, mm.
    b: f64,
    c: f64,
    height: f64,
}

fn plane_frame([a, b, c]: &[Vec3; 3], normal: Vec3) -> PlaneFrame {
    let (ab, ac) = (b - a, c - a);
    let length = ab.norm();
    let along = ab / length;
    let across = normal.cross(&along);
    PlaneFrame {
        axes: Matrix3::from_columns(&[along, across, normal]),
        b: length,
        c: ac.dot(&along),
        height: ac.dot(&across),
    }
}

/// Rotation of a triangle from one shape to another: the polar factor of F = Q' (A ⊕ 1) Qᵀ.
///
/// In the plane A takes (b, 0) to (b', 0) and (c, h) to (c', h'), so A = [b'/b, s; 0, h'/h] with s
/// = (c' − c b'/b)/h, and its polar angle is atan2(A₂₁ − A₁₂, A₁₁ + A₂₂). Both diagonal entries are
/// positive, so the angle is always defined.
fn turn(from: &PlaneFrame, to: &PlaneFrame) -> Matrix3<f64> {
    let stretch = to.b / from.b;
    let shear = (to.c - from.c * stretch) / from.height;
    let angle = (-shear).atan2(stretch + to.height / from.height);
    let in_plane = Rotation2::new(angle).matrix().to_homogeneous();
    to.axes * in_plane * from.axes.transpose()
}
