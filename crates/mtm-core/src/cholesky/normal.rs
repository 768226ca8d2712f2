//! Contact forces under normals that change from one solve to the next.
//!
//! The normal flexibility Nᵀ S⁻¹ N of a solve differs from that of an earlier one by how far the normals
//! turned in between. Its own Cholesky factor costs m³/3; conjugate gradients that the earlier factor
//! preconditions need a few products of m². Where they need many, the factor is made anew and kept.

use super::symmetric::{DenseFactor, DenseSymmetric, dot};

/// Error in the energy norm, relative to the solution, at which conjugate gradients end: rounding.
const ENERGY_ERROR: f64 = 1e-14;
/// Steps after which a new factor is cheaper than more of them.
const MOST_STEPS: usize = 12;
/// Steps that tell how many it will take: later ones gain no less.
const TRIAL_STEPS: usize = 5;
/// Row of the kept factor that a constraint has none in.
const NO_ROW: u32 = u32::MAX;

/// A constraint row: tail node, and how many rows of the same node stand before it.
pub type RowKey = (usize, usize);

/// Factor of the normal flexibility of some constraint rows, for these and others like them.
pub struct NormalFactor {
    factor: DenseFactor,
    keys: Vec<RowKey>,
}

/// Forces along the rows, N, and what it took to find them.
pub struct NormalForces {
    /// Force of each row.
    pub forces: Vec<f64>,
    /// The factor of this matrix, where one was made.
    pub made: Option<NormalFactor>,
}

impl NormalFactor {
    /// The factor of `flexibility`, whose rows are `keys`; the first row without a positive pivot on
    /// failure.
    pub fn new(flexibility: DenseSymmetric, keys: Vec<RowKey>) -> Result<Self, usize> {
        Ok(Self { factor: flexibility.factor()?, keys })
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.factor.bytes()
    }

    /// A⁻¹ b of the matrix that was factored, in place.
    pub fn solve(&self, b: &mut [f64]) {
        self.factor.solve(b);
    }
}

/// Solution of `flexibility` f = `goals`, begun at `start`, with the factor `kept` of another matrix as
/// preconditioner; the first row without a positive pivot where the matrix is not positive definite.
pub fn solve_normal(
    flexibility: DenseSymmetric,
    keys: Vec<RowKey>,
    goals: &[f64],
    start: Vec<f64>,
    kept: &NormalFactor,
) -> Result<NormalForces, usize> {
    let diagonal = (0..flexibility.size()).map(|c| flexibility.column(c)[0]).collect();
    let product = |x: &[f64]| flexibility.multiply(x);
    let near = conjugate_gradients(product, diagonal, &keys, goals, start, kept, hopeless);
    if let Ok(forces) = near {
        return Ok(NormalForces { forces, made: None });
    }
    let made = NormalFactor::new(flexibility, keys)?;
    let mut forces = goals.to_vec();
    made.solve(&mut forces);
    Ok(NormalForces { forces, made: Some(made) })
}

/// Whether more steps cost more than a factor, judged by how the error has fallen so far.
fn hopeless(progress: &Progress) -> bool {
    let Progress { step, fallen, error } = *progress;
    let rest = (MOST_STEPS as f64 - step as f64) / step.max(1) as f64;
    step >= MOST_STEPS || step >= TRIAL_STEPS && error * fallen.powf(rest) > ENERGY_ERROR
}

/// How far conjugate gradients have come.
pub struct Progress {
    /// Steps done.
    pub step: usize,
    /// Measure of the residual over that at the start.
    pub fallen: f64,
    /// Relative error in the energy norm.
    pub error: f64,
}

/// x with A x = `goals` by conjugate gradients from `start`, preconditioned by `kept` on the rows that it
/// has and by `diagonal` (above 0) on the others.
///
/// # Errors
/// The relative error in the energy norm that was left where `give_up` held, or where `product` proved
/// not to be that of a positive definite matrix.
pub fn conjugate_gradients(
    mut product: impl FnMut(&[f64]) -> Vec<f64>,
    diagonal: Vec<f64>,
    keys: &[RowKey],
    goals: &[f64],
    start: Vec<f64>,
    kept: &NormalFactor,
    give_up: impl Fn(&Progress) -> bool,
) -> Result<Vec<f64>, f64> {
    let preconditioner = Preconditioner::new(diagonal, keys, kept);
    let mut x = start;
    let mut r = goals.to_vec();
    if x.iter().any(|&v| v != 0.0) {
        for (r, v) in r.iter_mut().zip(product(&x)) {
            *r -= v;
        }
    }
    let mut z = preconditioner.apply(&r);
    let mut p = z.clone();
    let mut rz = dot(&r, &z);
    let first = rz;
    for step in 0.. {
        // xᵀA x = xᵀ(g − r): how large the solution is in the same norm.
        let size: f64 = x.iter().zip(goals.iter().zip(&r)).map(|(x, (g, r))| x * (g - r)).sum();
        let error = (rz / size).sqrt();
        if rz == 0.0 || error <= ENERGY_ERROR {
            break;
        }
        if give_up(&Progress { step, fallen: (rz / first).sqrt(), error }) {
            return Err(error);
        }
        let ap = product(&p);
        let curvature = dot(&p, &ap);
        // Also false for NaN.
        if !(curvature > 0.0 && rz.is_finite()) {
            return Err(error);
        }
        let alpha = rz / curvature;
        for i in 0..x.len() {
            x[i] += alpha * p[i];
            r[i] -= alpha * ap[i];
        }
        z = preconditioner.apply(&r);
        let next = dot(&r, &z);
        let beta = next / rz;
        rz = next;
        for (p, z) in p.iter_mut().zip(&z) {
            *p = z + beta * *p;
        }
    }
    Ok(x)
}

/// The kept factor on the rows it has, the diagonal on the others: positive definite for any rows.
struct Preconditioner<'a> {
    kept: &'a NormalFactor,
    /// Row of the factor that stands for each row of the matrix.
    row: Vec<u32>,
    diagonal: Vec<f64>,
}

impl<'a> Preconditioner<'a> {
    fn new(diagonal: Vec<f64>, keys: &[RowKey], kept: &'a NormalFactor) -> Self {
        let mut places: Vec<(RowKey, u32)> =
            kept.keys.iter().enumerate().map(|(row, &key)| (key, row as u32)).collect();
        places.sort_unstable();
        let find = |key: &RowKey| {
            places.binary_search_by(|(k, _)| k.cmp(key)).map_or(NO_ROW, |at| places[at].1)
        };
        let row = keys.iter().map(find).collect();
        Self { kept, row, diagonal }
    }

    fn apply(&self, r: &[f64]) -> Vec<f64> {
        let mut own = vec![0.0; self.kept.keys.len()];
        for (&row, &v) in self.row.iter().zip(r).filter(|(row, _)| **row != NO_ROW) {
            own[row as usize] = v;
        }
        self.kept.solve(&mut own);
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

    /// Flexibility of points on a line that fades with their distance, each pushed along a direction in
    /// the plane that has turned by `turn`: what a normal flexibility looks like.
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

    /// Rows that the kept factor has, rows it lacks, and rows that have gone: the dense solution each time.
    #[test]
    fn forces_by_another_factor_equal_the_dense_ones() {
        let n = 60;
        let (rest, now) = (turned(n, 0.0), turned(n, 0.5));
        let kept = NormalFactor::new(lower(&rest), keys(n)).unwrap();
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
            let zero = vec![0.0; rows.len()];
            let found = solve_normal(lower(&picked), keys, b.as_slice(), zero, &kept).unwrap();
            assert!(found.made.is_none());
            let exact = picked.cholesky().unwrap().solve(&b);
            let error = (DVector::from_vec(found.forces) - &exact).amax();
            assert!(error <= 1e-12 * exact.amax(), "{error:e}");
        }
    }

    /// A factor that is no help is replaced, and the new one is handed back.
    #[test]
    fn factor_that_does_not_help_is_made_anew() {
        let n = 60;
        let other =
            DMatrix::from_fn(
                n,
                n,
                |i, j| {
                    if i == j { 10.0_f64.powi((i % 9) as i32 - 4) } else { 0.0 }
                },
            );
        let kept = NormalFactor::new(lower(&other), keys(n)).unwrap();
        let now = turned(n, 0.5);
        let b = DVector::from_element(n, 1.0);
        let found = solve_normal(lower(&now), keys(n), b.as_slice(), vec![0.0; n], &kept).unwrap();
        let made = found.made.unwrap();
        let exact = now.cholesky().unwrap().solve(&b);
        assert!((DVector::from_vec(found.forces) - &exact).amax() <= 1e-12 * exact.amax());
        let mut again = b.as_slice().to_vec();
        made.solve(&mut again);
        assert!((DVector::from_vec(again) - &exact).amax() <= 1e-12 * exact.amax());
    }

    #[test]
    fn indefinite_flexibility_is_refused_with_its_row() {
        let kept = NormalFactor::new(lower(&DMatrix::identity(3, 3)), keys(3)).unwrap();
        let mut now = DMatrix::identity(3, 3);
        now[(2, 2)] = -1.0;
        let found = solve_normal(lower(&now), keys(3), &[1.0; 3], vec![0.0; 3], &kept);
        assert_eq!(found.err(), Some(2));
    }
}
