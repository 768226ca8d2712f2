//! Rotation and stretch of a deformation gradient, also defined for inverted tets.

use nalgebra::{Matrix3, Vector3};

/// F = Q Σ Vᵀ with rotations Q and V: R = Q Vᵀ is the rotation nearest to F, U = V Σ Vᵀ its stretch.
///
/// If F inverts, the smallest stretch is negative, and R is still a proper rotation (Irving, Teran & Fedkiw
/// 2004).
#[derive(Debug, Clone, Copy)]
pub struct Polar {
    /// Principal directions after the deformation.
    pub q: Matrix3<f64>,
    /// Principal directions at rest.
    pub v: Matrix3<f64>,
    /// Principal stretches.
    pub stretch: Vector3<f64>,
}

/// Sweeps over the three pairs of columns; they converge quadratically, after four or five.
const MOST_SWEEPS: usize = 16;

impl Polar {
    /// The decomposition of `f`, by rotations of pairs of columns until they are perpendicular (one-sided Jacobi;
    /// Hestenes 1958); the stretches are NaN if an entry of `f` is not finite.
    pub fn new(f: &Matrix3<f64>) -> Self {
        let mut v = Matrix3::identity();
        let size = f.amax();
        if f.iter().any(|x| !x.is_finite()) {
            return Self { q: v, v, stretch: Vector3::repeat(f64::NAN) };
        }
        if size == 0.0 {
            return Self { q: v, v, stretch: Vector3::zeros() };
        }
        // Squares neither overflow nor vanish.
        let mut b = f / size;
        for _ in 0..MOST_SWEEPS {
            let mut turned = false;
            for (i, j) in [(0, 1), (1, 2), (0, 2)] {
                let (first, second) = (b.column(i), b.column(j));
                let (own, other) = (first.norm_squared(), second.norm_squared());
                let overlap = first.dot(&second);
                if overlap.abs() > f64::EPSILON * (own * other).sqrt() {
                    let tangent = small_tangent(0.5 * (other - own) / overlap);
                    turn_columns(&mut b, (i, j), tangent);
                    turn_columns(&mut v, (i, j), tangent);
                    turned = true;
                }
            }
            if !turned {
                break;
            }
        }
        let lengths = [b.column(0).norm(), b.column(1).norm(), b.column(2).norm()];
        let least = if lengths[2] <= lengths[0].min(lengths[1]) {
            2
        } else {
            usize::from(lengths[1] < lengths[0])
        };
        // The other two in cyclic order, so that the cross product completes a rotation.
        let (next, last) = ((least + 1) % 3, (least + 2) % 3);
        let (long, short) =
            if lengths[next] >= lengths[last] { (next, last) } else { (last, next) };
        let mut q = Matrix3::zeros();
        q.set_column(long, &(b.column(long) / lengths[long]));
        q.set_column(short, &across(q.column(long).into(), b.column(short).into()));
        q.set_column(least, &q.column(next).cross(&q.column(last)));
        let stretch = Vector3::from_fn(|i, _| size * q.column(i).dot(&b.column(i)));
        Self { q, v, stretch }
    }

    /// R.
    pub fn rotation(&self) -> Matrix3<f64> {
        self.q * self.v.transpose()
    }
}

/// The root t of t² + 2 t `cotangent` = 1 that is at most 1 in size: the tangent of half an angle with that
/// cotangent. A cotangent whose square overflows gives 0.
pub(crate) fn small_tangent(cotangent: f64) -> f64 {
    cotangent.signum() / (cotangent.abs() + (1.0 + cotangent * cotangent).sqrt())
}

/// Turns columns `i` and `j` of `m` in their plane by the angle with this tangent.
fn turn_columns(m: &mut Matrix3<f64>, (i, j): (usize, usize), tangent: f64) {
    let cosine = 1.0 / (1.0 + tangent * tangent).sqrt();
    let sine = cosine * tangent;
    for r in 0..3 {
        let (a, b) = (m[(r, i)], m[(r, j)]);
        m[(r, i)] = cosine * a - sine * b;
        m[(r, j)] = sine * a + cosine * b;
    }
}

/// The unit vector of the part of `v` across the unit vector `axis`; any one across it if there is no such part.
fn across(axis: Vector3<f64>, v: Vector3<f64>) -> Vector3<f64> {
    let part = v - axis * axis.dot(&v);
    if part.norm() > f64::EPSILON {
        // The rounding error of a short part along the axis is not small against it.
        let part = part.normalize();
        return (part - axis * axis.dot(&part)).normalize();
    }
    let mut other = Vector3::zeros();
    other[axis.iamin()] = 1.0;
    (other - axis * axis.dot(&other)).normalize()
}
