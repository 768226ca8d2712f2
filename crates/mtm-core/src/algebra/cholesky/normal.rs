//! Contact forces under normals that change from one solve to the next.
//!
//! The normal flexibility Nᵀ S⁻¹ N of a solve differs from that of an earlier one only by the rotation of the
//! normals in between: conjugate gradients preconditioned with the earlier one need a few products.

use std::sync::Arc;

use super::symmetric::{DenseFactor, DenseSymmetric, Rough, dot};

/// Number of steps from which the total is predicted: later steps converge at least as fast.
const TRIAL_STEPS: usize = 5;
/// Share of the residual down to which approximate products are trusted.
pub const ROUGH: f64 = 1e-6;
/// Marks a constraint that has no row in the kept factorisation.
const NO_ROW: u32 = u32::MAX;

/// A constraint row: tail node, and how many rows of the same node precede it.
pub type RowKey = (usize, usize);

/// A solver for the normal flexibility of some constraint rows, and a preconditioner for similar ones.
pub struct NormalFactor {
    answer: SolvedBy,
    keys: Vec<RowKey>,
}

/// How a right-hand side is solved for.
enum SolvedBy {
    /// By the factor: cheap to compute.
    Factor(DenseFactor),
    /// By the inverse, in single precision: cheap to apply.
    Inverse(Rough),
}

impl NormalFactor {
    /// The factorisation of `flexibility`, whose rows are `keys`; on failure, the first row without a positive
    /// pivot.
    pub fn new(flexibility: DenseSymmetric, keys: Vec<RowKey>) -> Result<Self, usize> {
        Ok(Self { answer: SolvedBy::Factor(flexibility.factor()?), keys })
    }

    /// The same by its inverse, for many right-hand sides: in single precision, which is enough for a
    /// [`FactorPreconditioner`].
    pub fn inverse(self) -> Self {
        let answer = match self.answer {
            SolvedBy::Factor(factor) => SolvedBy::Inverse(Rough::of(&factor.inverse())),
            inverse @ SolvedBy::Inverse(_) => inverse,
        };
        Self { answer, ..self }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        match &self.answer {
            SolvedBy::Factor(factor) => factor.bytes(),
            SolvedBy::Inverse(inverse) => inverse.bytes(),
        }
    }

    /// A⁻¹ b of the matrix that was factorised.
    pub fn solve(&self, mut b: Vec<f64>) -> Vec<f64> {
        match &self.answer {
            SolvedBy::Factor(factor) => {
                factor.solve(&mut b);
                b
            }
            SolvedBy::Inverse(inverse) => inverse.multiply(&b),
        }
    }
}

/// Accuracy of a product.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ProductAccuracy {
    /// To six digits.
    Rough,
    /// To rounding.
    Exact,
}

/// Forces along rows, found by conjugate gradients.
pub struct RowForces {
    /// Force of each row.
    pub forces: Vec<f64>,
    /// Their whole product: displacement along each row, and along whatever else the product gives.
    pub along: Vec<f64>,
    /// Displacement along each row that is still missing.
    pub left: Vec<f64>,
}

/// Progress of conjugate gradients.
pub struct Progress {
    /// Steps done.
    pub step: usize,
    /// Norm of the residual relative to that at the start.
    pub fallen: f64,
    /// The same at which the iteration ends.
    pub goal: f64,
}

/// Whether more steps than `most` are needed, judged by the decrease of the residual so far.
pub fn hopeless(progress: &Progress, most: usize) -> bool {
    let Progress { step, fallen, goal } = *progress;
    step >= most || step >= TRIAL_STEPS && fallen.powf(most as f64 / step as f64) > goal
}

/// x with A x = `goals` by conjugate gradients, until what is missing measures `enough` or less, see
/// [`FactorPreconditioner::measure`].
///
/// `product`: displacement along each row under forces along them, and along anything else of interest.
///
/// # Errors
/// What is missing over what was at the start, if `give_up` held, or if `product` proved not to be that of a
/// positive definite matrix.
pub fn conjugate_gradients(
    mut product: impl FnMut(&[f64]) -> Vec<f64>,
    preconditioner: &FactorPreconditioner,
    goals: &[f64],
    enough: f64,
    give_up: impl Fn(&Progress) -> bool,
) -> Result<RowForces, f64> {
    let (mut x, mut along, mut r) = (vec![0.0; goals.len()], Vec::new(), goals.to_vec());
    let mut z = preconditioner.apply(&r);
    let mut p = z.clone();
    let mut rz = dot(&r, &z);
    let (first, mut step) = (rz, 0);
    loop {
        // At least one step, so that the product is known.
        if rz == 0.0 || step > 0 && rz.sqrt() <= enough {
            if along.is_empty() {
                along = product(&x);
            }
            return Ok(RowForces { forces: x, along, left: r });
        }
        let fallen = (rz / first).sqrt();
        if give_up(&Progress { step, fallen, goal: enough / first.sqrt() }) {
            return Err(fallen);
        }
        let moved = product(&p);
        along.resize(moved.len(), 0.0);
        let curvature = dot(&p, &moved[..p.len()]);
        // Also false for NaN.
        if !(curvature > 0.0 && rz.is_finite()) {
            return Err(fallen);
        }
        let alpha = rz / curvature;
        for i in 0..x.len() {
            x[i] += alpha * p[i];
            r[i] -= alpha * moved[i];
        }
        for (to, v) in along.iter_mut().zip(&moved) {
            *to += alpha * v;
        }
        z = preconditioner.apply(&r);
        let next = dot(&r, &z);
        let beta = next / rz;
        rz = next;
        for (p, z) in p.iter_mut().zip(&z) {
            *p = z + beta * *p;
        }
        step += 1;
    }
}

/// The kept factorisation on the rows it contains, the diagonal on the others: positive definite for any rows.
pub struct FactorPreconditioner {
    kept: Arc<NormalFactor>,
    /// Row of the factorisation that corresponds to each row of the matrix.
    row: Vec<u32>,
    diagonal: Vec<f64>,
}

impl FactorPreconditioner {
    /// `kept` on those of `keys` that it contains, `diagonal` (above 0) on the others.
    pub fn new(diagonal: Vec<f64>, keys: &[RowKey], kept: Arc<NormalFactor>) -> Self {
        let mut places: Vec<(RowKey, u32)> =
            kept.keys.iter().enumerate().map(|(row, &key)| (key, row as u32)).collect();
        places.sort_unstable();
        let find = |key: &RowKey| {
            places.binary_search_by(|(k, _)| k.cmp(key)).map_or(NO_ROW, |at| places[at].1)
        };
        let row = keys.iter().map(find).collect();
        Self { kept, row, diagonal }
    }

    /// √(rᵀ z), where z is the approximation of A⁻¹ r.
    pub fn measure(&self, r: &[f64]) -> f64 {
        dot(r, &self.apply(r)).max(0.0).sqrt()
    }

    fn apply(&self, r: &[f64]) -> Vec<f64> {
        let mut own = vec![0.0; self.kept.keys.len()];
        for (&row, &v) in self.row.iter().zip(r).filter(|(row, _)| **row != NO_ROW) {
            own[row as usize] = v;
        }
        let own = self.kept.solve(own);
        let of = |(i, &row): (usize, &u32)| match row {
            NO_ROW => r[i] / self.diagonal[i],
            row => own[row as usize],
        };
        self.row.iter().enumerate().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// Flexibility of points on a line that decays with their distance, each pushed along a direction in the
    /// plane that is rotated by `turn`: similar to a normal flexibility.
    fn turned(n: usize, turn: f64) -> DMatrix<f64> {
        let angle = |i: usize| turn * (0.5 + 0.5 * (i as f64 * 0.3).sin());
        DMatrix::from_fn(n, n, |i, j| {
            let near = 1.0 / (1.0 + i.abs_diff(j) as f64).powi(2);
            near * (angle(i) - angle(j)).cos() + if i == j { 0.2 } else { 0.0 }
        })
    }

    fn lower(dense: &DMatrix<f64>) -> DenseSymmetric {
        DenseSymmetric::from_columns(dense.nrows(), |c, column| {
            for (r, v) in column.iter_mut().enumerate() {
                *v = dense[(c + r, c)];
            }
        })
    }

    fn keys(n: usize) -> Vec<RowKey> {
        (0..n).map(|i| (i, 0)).collect()
    }

    /// As accurate as contact requires at its end.
    const EXACT: f64 = 1e-12;
    const MOST: usize = 12;

    /// Forces by conjugate gradients, preconditioned with `kept`; the product also gives twice itself.
    fn found(
        now: &DMatrix<f64>,
        keys: &[RowKey],
        goals: &[f64],
        kept: &Arc<NormalFactor>,
        share: f64,
    ) -> Result<RowForces, f64> {
        let matrix = lower(now);
        let diagonal = (0..now.nrows()).map(|i| now[(i, i)]).collect();
        let product = |x: &[f64]| {
            let along = matrix.multiply(x);
            let twice: Vec<f64> = along.iter().map(|v| 2.0 * v).collect();
            [along, twice].concat()
        };
        let preconditioner = FactorPreconditioner::new(diagonal, keys, kept.clone());
        let enough = share * preconditioner.measure(goals);
        let give_up = |progress: &Progress| hopeless(progress, MOST);
        conjugate_gradients(product, &preconditioner, goals, enough, give_up)
    }

    /// Rows that the kept factorisation contains, rows that it lacks, and rows that have been removed: each
    /// time the dense solution, and the displacements that follow from it.
    #[test]
    fn forces_by_another_factor_equal_the_dense_ones() {
        let n = 60;
        let (rest, now) = (turned(n, 0.0), turned(n, 0.5));
        let factor = || NormalFactor::new(lower(&rest), keys(n)).unwrap();
        let goals = DVector::from_fn(n, |i, _| (i as f64 * 0.7).cos());
        let some: Vec<usize> = (0..n).filter(|i| i % 7 != 3).collect();
        let all: Vec<usize> = (0..n).collect();
        for (rows, second_wall) in [(&all, false), (&some, false), (&some, true)] {
            let picked = DMatrix::from_fn(rows.len(), rows.len(), |i, j| now[(rows[i], rows[j])]);
            let b = DVector::from_fn(rows.len(), |i, _| goals[rows[i]]);
            let mut keys: Vec<RowKey> = rows.iter().map(|&i| (i, 0)).collect();
            if second_wall {
                keys[5].1 = 1;
            }
            let exact = picked.clone().cholesky().unwrap().solve(&b);
            for kept in [factor(), factor().inverse()] {
                let found = found(&picked, &keys, b.as_slice(), &Arc::new(kept), EXACT).unwrap();
                let error = (DVector::from_vec(found.forces.clone()) - &exact).amax();
                assert!(error <= 1e-10 * exact.amax(), "{error:e}");
                let moved = &picked * DVector::from_vec(found.forces);
                for (i, g) in moved.iter().enumerate() {
                    assert!((found.along[i] - g).abs() <= 1e-13);
                    assert!((found.along[rows.len() + i] - 2.0 * g).abs() <= 2e-13);
                    assert!((found.left[i] - (b[i] - g)).abs() <= 1e-13);
                }
            }
        }
    }

    /// What is missing is as small as requested, but not much smaller: no step is wasted.
    #[test]
    fn forces_are_as_good_as_wanted() {
        let n = 60;
        let (now, b) = (turned(n, 0.5), DVector::from_fn(n, |i, _| (i as f64 * 0.7).cos()));
        let kept = Arc::new(NormalFactor::new(lower(&turned(n, 0.0)), keys(n)).unwrap());
        let preconditioner = FactorPreconditioner::new(vec![1.0; n], &keys(n), kept.clone());
        let first = preconditioner.measure(b.as_slice());
        let found = found(&now, &keys(n), b.as_slice(), &kept, 1e-3).unwrap();
        let left = &b - &now * DVector::from_vec(found.forces);
        let measure = preconditioner.measure(left.as_slice());
        assert!(measure <= 1.001e-3 * first && measure >= 1e-9 * first, "{measure:e}");
    }

    /// Without displacements to cause there are no forces, and no division by zero.
    #[test]
    fn no_goals_need_no_forces() {
        let kept = Arc::new(NormalFactor::new(lower(&turned(9, 0.0)), keys(9)).unwrap());
        let found = found(&turned(9, 0.5), &keys(9), &[0.0; 9], &kept, EXACT).unwrap();
        assert_eq!((found.forces, found.along), (vec![0.0; 9], vec![0.0; 18]));
    }

    /// An unsuitable factorisation is given up; a new one solves the system, as does its inverse.
    #[test]
    fn factor_that_does_not_help_is_given_up() {
        let n = 60;
        let size = |i: usize| 10.0_f64.powi((i % 9) as i32 - 4);
        let other = DMatrix::from_fn(n, n, |i, j| if i == j { size(i) } else { 0.0 });
        let kept = Arc::new(NormalFactor::new(lower(&other), keys(n)).unwrap());
        let now = turned(n, 0.5);
        let b = DVector::from_element(n, 1.0);
        assert!(found(&now, &keys(n), b.as_slice(), &kept, EXACT).is_err());
        let made = NormalFactor::new(lower(&now), keys(n)).unwrap();
        let exact = now.cholesky().unwrap().solve(&b);
        let by_factor = DVector::from_vec(made.solve(b.as_slice().to_vec()));
        let by_inverse = DVector::from_vec(made.inverse().solve(b.as_slice().to_vec()));
        for (found, digits) in [(by_factor, 1e-12), (by_inverse, 1e-5)] {
            assert!((found - &exact).amax() <= digits * exact.amax());
        }
    }

    #[test]
    fn indefinite_flexibility_is_refused_with_its_row() {
        let kept = Arc::new(NormalFactor::new(lower(&DMatrix::identity(3, 3)), keys(3)).unwrap());
        let mut now = DMatrix::identity(3, 3);
        now[(2, 2)] = -1.0;
        assert!(found(&now, &keys(3), &[1.0; 3], &kept, EXACT).is_err());
        assert_eq!(NormalFactor::new(lower(&now), keys(3)).err(), Some(2));
    }
}
