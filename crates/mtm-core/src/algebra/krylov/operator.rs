//! What conjugate gradients need: a matrix, and an approximation of its inverse.

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::row_sums::{dot, multiply_and_dot};

/// A symmetric positive definite matrix, as conjugate gradients see it.
///
/// It may be defined on a subspace only: [`Operator::project`] then defines which.
pub trait Operator: Sync {
    /// Number of block rows.
    fn n_rows(&self) -> usize;

    /// Writes `y = A x` for an `x` of the subspace; `y` lies in it too.
    fn multiply_into(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]);

    /// Writes `y = A x` and returns `xᵀ y`. The result must not depend on the number of threads.
    fn multiply_and_dot(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) -> f64 {
        self.multiply_into(x, y);
        dot(x, y)
    }

    /// Smallest pᵀ A p of a direction that counts as constrained.
    fn least_curvature(&self, _p: &[[f64; 3]]) -> f64 {
        0.0
    }

    /// Replaces `x` by its nearest vector of the subspace; does nothing if that is the whole space.
    fn project(&self, _x: &mut [[f64; 3]]) {}
}

impl Operator for BlockMatrix {
    fn n_rows(&self) -> usize {
        self.n_rows()
    }

    fn multiply_into(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) {
        self.multiply_into(x, y);
    }

    fn multiply_and_dot(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) -> f64 {
        multiply_and_dot(self, x, y)
    }
}

/// A symmetric positive definite approximation of `A⁻¹`.
pub trait Preconditioner: Sync {
    /// Writes `z = M⁻¹ r`.
    ///
    /// `r`, `z`: one row of three per block row. `z` must not depend, even in its bits, on the number of
    /// threads.
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]);
}
