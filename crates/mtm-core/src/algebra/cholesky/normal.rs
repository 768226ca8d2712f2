//! Contact forces under normals that change from one solve to the next.
//!
//! The normal flexibility Nᵀ S⁻¹ N of a solve differs from that of an earlier one only by the rotation of the
//! normals in between: conjugate gradients preconditioned with the earlier one need a few products. Each
//! product also gives the displacements, so that the matrix need not be assembled.
//!
//! Products may be approximate: their error is detected by an exact product, from which the steps continue
//! (iterative refinement; Wilkinson 1963).

use super::symmetric::{DenseFactor, DenseSymmetric, Rough, dot};

/// Number of steps after which a new factorisation is cheaper than further steps.
const MOST_STEPS: usize = 12;
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
    answer: Answer,
    keys: Vec<RowKey>,
}

/// How a right-hand side is solved for.
enum Answer {
    /// By the factor: cheap to compute.
    Factor(DenseFactor),
    /// By the inverse, in single precision: cheap to apply.
    Inverse(Rough),
}

impl NormalFactor {
    /// The factorisation of `flexibility`, whose rows are `keys`; on failure, the first row without a positive
    /// pivot.
    pub fn new(flexibility: DenseSymmetric, keys: Vec<RowKey>) -> Result<Self, usize> {
        Ok(Self { answer: Answer::Factor(flexibility.factor()?), keys })
    }

    /// The same by its inverse, for many right-hand sides: in single precision, which is enough for a
    /// [`Preconditioner`].
    pub fn inverse(self) -> Self {
        let answer = match self.answer {
            Answer::Factor(factor) => Answer::Inverse(Rough::of(&factor.inverse())),
            inverse @ Answer::Inverse(_) => inverse,
        };
        Self { answer, ..self }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        match &self.answer {
            Answer::Factor(factor) => factor.bytes(),
            Answer::Inverse(inverse) => inverse.bytes(),
        }
    }

    /// A⁻¹ b of the matrix that was factorised.
    pub fn solve(&self, mut b: Vec<f64>) -> Vec<f64> {
        match &self.answer {
            Answer::Factor(factor) => {
                factor.solve(&mut b);
                b
            }
            Answer::Inverse(inverse) => inverse.multiply(&b),
        }
    }
}

/// Accuracy of a product.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Precision {
    /// To six digits.
    Rough,
    /// To rounding.
    Exact,
}

/// The effect of forces along the rows.
pub struct Moved {
    /// Displacement along each row, mm.
    pub along: Vec<f64>,
    /// Displacement of every node, mm.
    pub nodes: Vec<[f64; 3]>,
    /// Accuracy of the displacements.
    pub precision: Precision,
}

/// Starting point of conjugate gradients.
pub struct Begun {
    /// Force of each row.
    pub forces: Vec<f64>,
    /// Their effect.
    pub moved: Moved,
}

/// Forces along the rows, N, and their effect.
pub struct NormalForces {
    /// Force of each row.
    pub forces: Vec<f64>,
    /// Displacement of every node under them, mm.
    pub nodes: Vec<[f64; 3]>,
    /// Accuracy of these displacements.
    pub precision: Precision,
    /// Whether the forces are [`Wanted::exact`] under exact products.
    pub solved: bool,
}

/// Accuracy required of a solution.
#[derive(Clone, Copy)]
pub struct Wanted {
    /// Relative error in the energy norm at which the solution counts as exact.
    pub exact: f64,
    /// Norm of the residual, see [`Preconditioner::measure`], that suffices for now; 0 if none does.
    pub enough: f64,
}

/// Progress of conjugate gradients.
pub struct Progress {
    /// Steps done.
    pub step: usize,
    /// Norm of the residual relative to that at the start.
    pub fallen: f64,
    /// Relative error in the energy norm.
    pub error: f64,
    /// The error at which the iteration ends.
    pub goal: f64,
}

/// Whether further steps cost more than a factorisation, judged by the decrease of the error so far.
pub fn hopeless(progress: &Progress) -> bool {
    let Progress { step, fallen, error, goal } = *progress;
    let rest = (MOST_STEPS as f64 - step as f64) / step.max(1) as f64;
    step >= MOST_STEPS || step >= TRIAL_STEPS && error * fallen.powf(rest) > goal
}

/// x with A x = `goals` by conjugate gradients, starting from `begun`.
///
/// `product`: the effect of forces along the rows, including A x along them.
///
/// # Errors
/// The remaining relative error in the energy norm, if `give_up` held, or if `product` proved not to be that of
/// a positive definite matrix.
pub fn conjugate_gradients(
    mut product: impl FnMut(&[f64], Precision) -> Moved,
    preconditioner: &Preconditioner<'_>,
    goals: &[f64],
    begun: Begun,
    wanted: Wanted,
    give_up: impl Fn(&Progress) -> bool,
) -> Result<NormalForces, f64> {
    let Begun { forces: mut x, moved: Moved { along, mut nodes, mut precision } } = begun;
    let open = |along: Vec<f64>| goals.iter().zip(along).map(|(g, v)| g - v).collect();
    let mut r: Vec<f64> = open(along);
    let mut z = preconditioner.apply(&r);
    let mut p = z.clone();
    let mut rz = dot(&r, &z);
    let (first, mut renewed, mut step) = (rz, rz, 0);
    let mut enough = wanted.enough;
    loop {
        // xᵀA x = xᵀ(g − r): the size of the solution in the same norm.
        let size: f64 = x.iter().zip(goals.iter().zip(&r)).map(|(x, (g, r))| x * (g - r)).sum();
        let error = (rz / size).sqrt();
        let solved = rz == 0.0 || error <= wanted.exact;
        if !solved && rz.sqrt() <= enough || solved && precision == Precision::Exact {
            return Ok(NormalForces { forces: x, nodes, precision, solved });
        }
        let goal = wanted.exact.max(enough / size.sqrt());
        if give_up(&Progress { step, fallen: (rz / first).sqrt(), error, goal }) {
            return Err(error);
        }
        let doubtful = solved || rz.sqrt() <= ROUGH * renewed.sqrt();
        if doubtful && precision == Precision::Rough {
            let there = product(&x, Precision::Exact);
            (nodes, precision) = (there.nodes, there.precision);
            r = open(there.along);
            z = preconditioner.apply(&r);
            rz = dot(&r, &z);
            renewed = rz;
            // This close to the end, the solution is completed instead of continuing with another set of
            // normals.
            enough = 0.0;
            p.clone_from(&z);
            continue;
        }
        let Moved { along, nodes: moved, precision: of_step } = product(&p, Precision::Rough);
        precision = precision.min(of_step);
        let curvature = dot(&p, &along);
        // Also false for NaN.
        if !(curvature > 0.0 && rz.is_finite()) {
            return Err(error);
        }
        let alpha = rz / curvature;
        for i in 0..x.len() {
            x[i] += alpha * p[i];
            r[i] -= alpha * along[i];
        }
        for (to, v) in nodes.as_flattened_mut().iter_mut().zip(moved.as_flattened()) {
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
pub struct Preconditioner<'a> {
    kept: &'a NormalFactor,
    /// Row of the factorisation that corresponds to each row of the matrix.
    row: Vec<u32>,
    diagonal: Vec<f64>,
}

impl<'a> Preconditioner<'a> {
    /// `kept` on those of `keys` that it contains, `diagonal` (above 0) on the others.
    pub fn new(diagonal: Vec<f64>, keys: &[RowKey], kept: &'a NormalFactor) -> Self {
        let mut places: Vec<(RowKey, u32)> =
            kept.keys.iter().enumerate().map(|(row, &key)| (key, row as u32)).collect();
        places.sort_unstable();
        let find = |key: &RowKey| {
            places.binary_search_by(|(k, _)| k.cmp(key)).map_or(NO_ROW, |at| places[at].1)
        };
        let row = keys.iter().map(find).collect();
        Self { kept, row, diagonal }
    }

    /// Approximation of A⁻¹ r, and its norm √(rᵀz).
    pub fn measure(&self, r: &[f64]) -> (Vec<f64>, f64) {
        let z = self.apply(r);
        let measure = dot(r, &z).sqrt();
        (z, measure)
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

    /// At least as exact as contact requires at its end.
    const EXACT: Wanted = Wanted { exact: 1e-12, enough: 0.0 };

    /// Forces by conjugate gradients from zero, preconditioned with `kept`.
    fn found(
        now: &DMatrix<f64>,
        keys: &[RowKey],
        goals: &[f64],
        kept: &NormalFactor,
        wanted: Wanted,
    ) -> Result<NormalForces, f64> {
        let matrix = lower(now);
        let diagonal = (0..now.nrows()).map(|i| now[(i, i)]).collect();
        let rough = Rough::of(&matrix);
        let product = |x: &[f64], precision| {
            let along = match precision {
                Precision::Rough => rough.multiply(x),
                Precision::Exact => matrix.multiply(x),
            };
            let nodes = along.iter().map(|&v| [v, 2.0 * v, 0.0]).collect();
            Moved { nodes, along, precision }
        };
        let preconditioner = Preconditioner::new(diagonal, keys, kept);
        let forces = vec![0.0; goals.len()];
        let begun = Begun { moved: product(&forces, Precision::Exact), forces };
        conjugate_gradients(product, &preconditioner, goals, begun, wanted, hopeless)
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
                let found = found(&picked, &keys, b.as_slice(), &kept, EXACT).unwrap();
                assert!(found.solved);
                let error = (DVector::from_vec(found.forces.clone()) - &exact).amax();
                assert!(error <= 1e-10 * exact.amax(), "{error:e}");
                let moved = &picked * DVector::from_vec(found.forces);
                for (v, g) in found.nodes.iter().zip(&moved) {
                    assert!((v[0] - g).abs() <= 1e-14 && (v[1] - 2.0 * g).abs() <= 1e-14);
                }
            }
        }
    }

    /// A solution that suffices for now is not exact, and is marked so; its residual is as small as requested.
    #[test]
    fn forces_are_as_good_as_wanted() {
        let n = 60;
        let (now, b) = (turned(n, 0.5), DVector::from_fn(n, |i, _| (i as f64 * 0.7).cos()));
        let kept = NormalFactor::new(lower(&turned(n, 0.0)), keys(n)).unwrap();
        let preconditioner = Preconditioner::new(vec![1.0; n], &keys(n), &kept);
        let (_, first) = preconditioner.measure(b.as_slice());
        let wanted = Wanted { enough: 1e-3 * first, ..EXACT };
        let found = found(&now, &keys(n), b.as_slice(), &kept, wanted).unwrap();
        let left = &b - &now * DVector::from_vec(found.forces);
        let (_, measure) = preconditioner.measure(left.as_slice());
        assert!(!found.solved && measure <= 1.001 * wanted.enough, "{measure:e}");
    }

    /// An unsuitable factorisation is given up; a new one solves the system, as does its inverse.
    #[test]
    fn factor_that_does_not_help_is_given_up() {
        let n = 60;
        let size = |i: usize| 10.0_f64.powi((i % 9) as i32 - 4);
        let other = DMatrix::from_fn(n, n, |i, j| if i == j { size(i) } else { 0.0 });
        let kept = NormalFactor::new(lower(&other), keys(n)).unwrap();
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
        let kept = NormalFactor::new(lower(&DMatrix::identity(3, 3)), keys(3)).unwrap();
        let mut now = DMatrix::identity(3, 3);
        now[(2, 2)] = -1.0;
        assert!(found(&now, &keys(3), &[1.0; 3], &kept, EXACT).is_err());
        assert_eq!(NormalFactor::new(lower(&now), keys(3)).err(), Some(2));
    }
}
