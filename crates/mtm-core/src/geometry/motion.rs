//! Motions that a plan prescribes: of a rigid segment, or of a surface whose vertices moved individually.

use nalgebra::{Matrix3, Rotation2, Rotation3};

use crate::error::{ErrorKind, MtmError, Result};
use crate::geometry::surface::{Closest, Surface};
use crate::vector::{Vec3, add, of_each};

/// Largest entry by which RᵀR of a matrix that is to be read as a rigid motion may differ from I.
///
/// Entries written with four decimals have errors of at most 5e-5, which change RᵀR by 2 · √3 · 5e-5 = 1.8e-4:
/// every rotation written with four or more decimals is accepted, and lengths that change by more than 0.01 %
/// are not. Accepted matrices are made orthogonal, see [`rigid_matrix`].
pub const RIGID_TOLERANCE: f64 = 2e-4;

/// Largest entry by which the bottom row of such a matrix may differ from 0 0 0 1.
pub const BOTTOM_ROW_TOLERANCE: f64 = 1e-6;

/// Deviation of RᵀR from I that is due to rounding: such matrices are used unchanged.
///
/// Far above what products and inverses of rotations accumulate, and so small that a point 1 m from the origin
/// moves by only 1e-11 mm.
const ROUNDING: f64 = 1e-14;

/// A rigid motion x' = R x + t.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidMotion {
    matrix: [[f64; 4]; 4],
}

impl RigidMotion {
    /// Motion of the named segment by a 4×4 matrix, row by row, t in mm, made exactly rigid by
    /// [`rigid_matrix`].
    ///
    /// # Errors
    /// [`MtmError::Plan`] with the segment's name if [`rigid_matrix`] rejects the matrix.
    pub fn new(segment: &str, matrix: &[[f64; 4]; 4]) -> Result<Self> {
        match nearest_rigid(matrix) {
            Ok(matrix) => Ok(Self { matrix }),
            Err(problem) => Err(MtmError::Plan { segment: segment.to_owned(), problem }),
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

    /// The 4×4 matrix, row by row: exactly rigid to rounding.
    pub fn matrix(&self) -> &[[f64; 4]; 4] {
        &self.matrix
    }

    /// The part of the motion done at `share` of the way: a rotation by that share of the angle, while the
    /// point `centre` moves along a straight line.
    pub fn partial(&self, share: f64, centre: [f64; 3]) -> Self {
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_fn(|i, j| self.matrix[i][j]));
        let turned = Rotation3::new(rotation.scaled_axis() * share);
        let (c, way) = (Vec3::from(centre), Vec3::from(self.displacement(centre)) * share);
        let shift = c + way - turned * c;
        let mut out = Self::identity();
        for (i, row) in out.matrix.iter_mut().take(3).enumerate() {
            *row = [turned[(i, 0)], turned[(i, 1)], turned[(i, 2)], shift[i]];
        }
        out
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

    /// Position that the motion maps to `point`: R⁻¹ (x − t), mm.
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

    /// Closest point of the moved `surface` to `point`, mm.
    pub(crate) fn closest(&self, surface: &Surface, point: [f64; 3]) -> Closest {
        let found = surface.closest_one(self.apply_inverse(point));
        Closest { point: self.apply(found.point), normal: self.rotate(found.normal), ..found }
    }

    /// R⁻¹ v: the direction before the motion.
    pub fn rotate_inverse(&self, vector: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|i| (0..3).map(|j| self.matrix()[j][i] * vector[j]).sum())
    }
}

/// The rigid matrix nearest to `matrix` (4×4, row by row): the only check of whether a matrix is rigid.
///
/// R is replaced by the rotation nearest to it (its polar factor), the bottom row by 0 0 0 1; t is kept. A
/// matrix that is already rigid to rounding is returned unchanged in every bit, so the function may be applied
/// repeatedly.
///
/// # Errors
/// [`MtmError::NotRigid`] with the error kind `kind` and the name `what` of the matrix: an entry that is not
/// finite, a bottom row that differs from 0 0 0 1 by more than `BOTTOM_ROW_TOLERANCE`, a reflection, or RᵀR
/// that differs from I by more than `RIGID_TOLERANCE` (scale or shear), with the figure.
pub fn rigid_matrix(what: &str, matrix: &[[f64; 4]; 4], kind: ErrorKind) -> Result<[[f64; 4]; 4]> {
    nearest_rigid(matrix).map_err(|problem| MtmError::NotRigid {
        what: what.to_owned(),
        problem,
        kind,
    })
}

/// The nearest rigid matrix, or what is wrong with the given one and how to fix it.
fn nearest_rigid(matrix: &[[f64; 4]; 4]) -> std::result::Result<[[f64; 4]; 4], String> {
    for (i, row) in matrix.iter().enumerate() {
        if let Some(j) = row.iter().position(|value| !value.is_finite()) {
            let value = row[j];
            return Err(format!(
                "entry [{i}][{j}] of the 4x4 matrix is {value}: every entry must be finite"
            ));
        }
    }
    let bottom = matrix[3];
    let off = |value: f64, ideal: f64| (value - ideal).abs() > BOTTOM_ROW_TOLERANCE;
    if off(bottom[0], 0.0) || off(bottom[1], 0.0) || off(bottom[2], 0.0) || off(bottom[3], 1.0) {
        return Err(format!(
            "the bottom row of the 4x4 matrix is {bottom:?}: it must be 0 0 0 1 within \
             {BOTTOM_ROW_TOLERANCE:.0e}; if the translation stands there, transpose the matrix"
        ));
    }
    let r = Matrix3::from_fn(|i, j| matrix[i][j]);
    let product = r.transpose() * r;
    let deviation = (product - Matrix3::identity()).amax();
    let determinant = r.determinant();
    if determinant < 0.0 {
        return Err(format!(
            "the 4x4 matrix mirrors (a reflection, determinant {determinant:.6}): bone cannot be \
             mirrored; check the signs of the axes (RAS and LPS differ by a rotation, never by a mirror)"
        ));
    }
    // Entries so large that the product overflows give NaN.
    if deviation.is_nan() || deviation > RIGID_TOLERANCE {
        return Err(format!(
            "the 4x4 matrix is not rigid: R^T R differs from the identity by {deviation:.3e}, allowed is \
             {RIGID_TOLERANCE:.0e}{}; remove scale and shear, and write at least four decimals",
            length_changes(&product)
        ));
    }
    let mut rigid = *matrix;
    rigid[3] = [0.0, 0.0, 0.0, 1.0];
    if deviation > ROUNDING {
        let r = nearest_rotation(r);
        for (i, row) in rigid.iter_mut().take(3).enumerate() {
            (row[0], row[1], row[2]) = (r[(i, 0)], r[(i, 1)], r[(i, 2)]);
        }
    }
    Ok(rigid)
}

/// The polar factor of a matrix that is orthogonal within [`RIGID_TOLERANCE`].
///
/// Newton–Schulz: R ← R (3 I − RᵀR) / 2 squares the deviation in each step (Higham 2008, Functions of
/// Matrices, section 8.3): 2e-4, 3e-8, 7e-16.
fn nearest_rotation(mut r: Matrix3<f64>) -> Matrix3<f64> {
    for _ in 0..4 {
        r = r * (Matrix3::identity() * 3.0 - r.transpose() * r) * 0.5;
    }
    r
}

/// How much a matrix shortens and lengthens, from RᵀR, in words; nothing if that overflows.
fn length_changes(product: &Matrix3<f64>) -> String {
    // Beyond this, the eigenvalues add nothing to the deviation.
    const LARGEST: f64 = 1e12;
    if !product.iter().all(|entry| entry.abs() < LARGEST) {
        return String::new();
    }
    let change =
        product.symmetric_eigenvalues().map(|square| 100.0 * (square.max(0.0).sqrt() - 1.0));
    format!(" (lengths change by {:+.3} % to {:+.3} %)", change.min(), change.max())
}

/// The motion of a surface whose vertices moved individually, extended to points near it.
#[derive(Debug, Clone)]
pub struct SurfaceMotion {
    rest: Surface,
    moved: Surface,
}

impl SurfaceMotion {
    /// Motion that maps the vertices of `rest` to `moved_vertices` (mm, in the same order).
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
    /// A point x keeps its position relative to its closest triangle: x' = c' + R (x − c), with c its closest
    /// point, c' the same point on the moved triangle, and R the rotation of the triangle (the polar factor of
    /// its tangent map extended by the normals). A rigid motion is therefore reproduced exactly, on the surface
    /// and off it. On the surface the displacement is continuous; off it, it jumps with R between triangles
    /// that rotate differently, by the distance to the surface times the difference of R. Parallel; the result
    /// does not depend on the number of threads.
    pub fn displacement(&self, points: &[[f64; 3]]) -> Vec<[f64; 3]> {
        of_each(points, |point| self.follow(point, &self.rest.closest_one(point)))
    }

    /// `surface`, whose vertices follow the motion.
    ///
    /// # Errors
    /// A triangle that collapses.
    pub(crate) fn carry(&self, surface: &Surface) -> Result<Surface> {
        let moved = surface.vertices().iter().zip(self.displacement(surface.vertices()));
        surface.moved(moved.map(|(&x, u)| add(x, u)).collect())
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
