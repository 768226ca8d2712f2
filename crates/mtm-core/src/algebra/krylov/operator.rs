//! What conjugate gradients need: a matrix, and an approximation of its inverse.

use rayon::prelude::*;

use crate::algebra::blocks::{Block, BlockMatrix};
use crate::algebra::row_sums::{ROWS_PER_SUM, dot, multiply_and_dot};
use crate::error::{MtmError, Result};

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

/// The inverse diagonal blocks as a preconditioner: for tiny systems and for comparison.
#[derive(Debug, Clone)]
pub struct BlockJacobi {
    inverses: Vec<Block>,
}

impl BlockJacobi {
    /// The inverted diagonal blocks of `a`.
    ///
    /// # Errors
    /// [`MtmError::NotPositiveDefinite`] with the first row whose diagonal block is not.
    pub fn new(a: &BlockMatrix) -> Result<Self> {
        let inverses = (0..a.n_rows())
            .map(|j| {
                let b = a.diagonal_block(j);
                let m = nalgebra::Matrix3::from_row_slice(b);
                let inverse = nalgebra::Cholesky::new(m).map(|c| c.inverse()).ok_or_else(|| {
                    MtmError::NotPositiveDefinite {
                        node: j,
                        detail: format!("its diagonal block {b:?} is not positive definite"),
                    }
                })?;
                let mut out = [0.0; 9];
                out.copy_from_slice(inverse.as_slice());
                Ok(out)
            })
            .collect::<Result<_>>()?;
        Ok(Self { inverses })
    }
}

impl Preconditioner for BlockJacobi {
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]) {
        z.par_chunks_mut(ROWS_PER_SUM)
            .zip(r.par_chunks(ROWS_PER_SUM).zip(self.inverses.par_chunks(ROWS_PER_SUM)))
            .for_each(|(z, (r, inverses))| {
                for ((z, r), m) in z.iter_mut().zip(r).zip(inverses) {
                    for i in 0..3 {
                        z[i] = m[3 * i] * r[0] + m[3 * i + 1] * r[1] + m[3 * i + 2] * r[2];
                    }
                }
            });
    }
}
