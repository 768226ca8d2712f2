//! Forces across the normals by conjugate gradients with a factor that is kept.

use std::sync::Arc;

use mtm_core::internals::{
    DenseSymmetric, FactorPreconditioner, NormalFactor, Progress, RowForces, RowKey,
    conjugate_gradients, hopeless,
};
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
