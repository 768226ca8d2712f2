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

    /// √(rᵀ z), where z is the approximation of A⁻¹ r: the energy norm of the forces that it takes for the cause of the
    /// displacements r.
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
