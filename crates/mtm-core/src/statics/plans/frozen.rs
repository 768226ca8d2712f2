//! Contact conditions that stay the same for several right-hand sides, as for the columns of a plan operator:
//! solved by factorisation, provided that the flexibility of the sliding nodes is known.
//!
//! Forces λ along the rows N, and loads z along the axes A of springs of negative stiffness −k, follow from Nᵀ
//! F N λ + Nᵀ F A z = g − Nᵀ u and Aᵀ F N λ + (Aᵀ F A − k⁻¹) z = goal − Aᵀ u, where F is the flexibility and u
//! the displacements without them. λ is eliminated; the remaining matrix for z is positive definite if the body
//! is stable with the springs.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use crate::algebra::cholesky::{DenseFactor, DenseSymmetric, TailFlexibility};
use crate::contact::{ContactRow, Spring};
use crate::error::Result;
use crate::statics::plans::reaction::{ConditionRows, singular, unheld};
use crate::vector::{add, dot, scaled};

/// The factors for conditions that stay the same.
pub(crate) struct FrozenContact {
    rows: ConditionRows,
    /// Nᵀ F N.
    normal: DenseFactor,
    unstable: Vec<Spring>,
    /// Nᵀ F A, a column for each unstable spring.
    coupling: Vec<Vec<f64>>,
    /// k⁻¹ − Aᵀ F A + Aᵀ F N (Nᵀ F N)⁻¹ Nᵀ F A.
    held: Option<Cholesky<f64, Dyn>>,
}

impl FrozenContact {
    /// The factors for `rows` and `springs`.
    ///
    /// # Errors
    /// `NotPositiveDefinite` if the rows are degenerate, or if springs drive nodes by more than the body can
    /// resist.
    pub fn new(tail: &TailFlexibility, rows: &[ContactRow], springs: &[Spring]) -> Result<Self> {
        let rows = ConditionRows::new(rows, &vec![0.0; rows.len()], springs);
        let unstable: Vec<Spring> = springs.iter().filter(|s| s.stiffness < 0.0).copied().collect();
        let n = rows.rows.len();
        let all = rows.directions(&unstable);
        let mut softness = rows.softness.clone();
        softness.resize(all.len(), 0.0);
        let whole = tail.normal_flexibility(&all, &softness);
        let part = DenseSymmetric::from_columns(n, |c, column| {
            column.copy_from_slice(&whole.column(c)[..n - c]);
        });
        let factor = part.factor().map_err(|at| singular(tail.row(rows.rows[at].node) as u32))?;
        let coupling: Vec<Vec<f64>> = (0..unstable.len())
            .map(|m| (0..n).map(|c| whole.column(c)[n + m - c]).collect())
            .collect();
        let by_rows = factor.projected(coupling.concat());
        let held = DMatrix::from_fn(unstable.len(), unstable.len(), |a, b| {
            let (low, high) = (a.min(b), a.max(b));
            let own = if a == b { -1.0 / unstable[a].stiffness } else { 0.0 };
            own - whole.column(n + low)[high - low] + by_rows.column(low)[high - low]
        });
        let held = match unstable.is_empty() {
            true => None,
            false => Some(Cholesky::new(held).ok_or_else(unheld)?),
        };
        Ok(Self { rows, normal: factor, unstable, coupling, held })
    }

    /// Force on each sliding node, N: `free` are the displacements without contact, `offsets` those prescribed for
    /// the rows, mm; `springs` have their goals.
    pub fn forces(&self, free: &[[f64; 3]], offsets: &[f64], springs: &[Spring]) -> Vec<[f64; 3]> {
        let contact = &self.rows.rows[..offsets.len()];
        let mut along = ConditionRows::new(contact, offsets, springs).missing(free);
        self.normal.solve(&mut along);
        let mut out = vec![[0.0; 3]; free.len()];
        if let Some(held) = &self.held {
            let asked = springs.iter().filter(|s| s.stiffness < 0.0);
            let open = asked.zip(&self.coupling).map(|(s, column)| {
                let by_rows: f64 = column.iter().zip(&along).map(|(g, f)| g * f).sum();
                dot(s.axis, free[s.node]) - s.goal + by_rows
            });
            let loads = held.solve(&DVector::from_iterator(self.unstable.len(), open));
            let mut pull = vec![0.0; along.len()];
            for (column, z) in self.coupling.iter().zip(loads.iter()) {
                for (p, g) in pull.iter_mut().zip(column) {
                    *p += g * z;
                }
            }
            self.normal.solve(&mut pull);
            for (f, p) in along.iter_mut().zip(pull) {
                *f -= p;
            }
            for (s, z) in self.unstable.iter().zip(loads.iter()) {
                out[s.node] = add(out[s.node], scaled(s.axis, *z));
            }
        }
        for (row, f) in self.rows.rows.iter().zip(&along) {
            out[row.node] = add(out[row.node], scaled(row.normal, *f));
        }
        out
    }
}
