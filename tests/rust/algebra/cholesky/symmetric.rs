//! Dense symmetric matrices: products, factors, single precision.

use mtm_core::internals::{DenseSymmetric, ROWS_TO_SHARE, Rough};
use nalgebra::{DMatrix, DVector};

/// A diagonally dominant matrix of no special structure, its triangle and a right-hand side.
fn example(n: usize) -> (DMatrix<f64>, DenseSymmetric, DVector<f64>) {
    let wave = |i: usize, j: usize| ((1 + i * j + i + j) as f64 * 0.37).sin();
    let dense = DMatrix::from_fn(n, n, |i, j| if i == j { n as f64 } else { wave(i, j) });
    let lower = DenseSymmetric::from_columns(n, |c, column| {
        for (r, v) in column.iter_mut().enumerate() {
            *v = dense[(c + r, c)];
        }
    });
    (dense, lower, DVector::from_fn(n, |i, _| wave(i, i)))
}

#[test]
fn product_and_solution_equal_the_dense_ones() {
    for n in [1, 2, 7, 9, 100, ROWS_TO_SHARE + 13] {
        let (dense, lower, x) = example(n);
        let product = DVector::from_vec(lower.multiply(x.as_slice()));
        let exact = &dense * &x;
        assert!((product - &exact).amax() <= 1e-13 * exact.amax(), "{n}");
        let mut found = exact.as_slice().to_vec();
        let factor = lower.factor().unwrap();
        factor.solve(&mut found);
        assert!((DVector::from_vec(found) - &x).amax() <= 1e-12, "{n}");
        // Of A itself and of x: A, A x and xᵀ A x.
        let columns: Vec<f64> = dense.iter().chain(&exact).copied().collect();
        let projected = factor.projected(columns);
        for c in 0..n {
            let column = projected.column(c);
            for (r, v) in (c..n).zip(column) {
                assert!((v - dense[(r, c)]).abs() <= 1e-12 * n as f64, "{n}");
            }
            assert!((column[n - c] - exact[c]).abs() <= 1e-12 * exact.amax(), "{n}");
        }
        assert!((projected.column(n)[0] - x.dot(&exact)).abs() <= 1e-12 * n as f64 * n as f64);
    }
}

/// Six digits, even if the rows are of very different size.
#[test]
fn rough_product_equals_the_dense_one_to_single_precision() {
    let (dense, ..) = example(ROWS_TO_SHARE + 13);
    let size = |i: usize| 10.0_f64.powi(17 * (i % 5) as i32 - 40);
    let lower = DenseSymmetric::from_columns(dense.nrows(), |c, column| {
        for (r, v) in (c..).zip(column.iter_mut()) {
            *v = dense[(r, c)] * size(r) * size(c);
        }
    });
    let x: Vec<f64> = (0..dense.nrows()).map(|i| (i as f64).cos() / size(i)).collect();
    let (exact, rough) = (lower.multiply(&x), Rough::of(&lower).multiply(&x));
    let own = |i: usize| dense[(i, i)] * size(i);
    for (i, (a, b)) in exact.iter().zip(&rough).enumerate() {
        assert!((a - b).abs() <= 1e-6 * own(i), "{a:e} {b:e}");
    }
}

#[test]
fn product_has_the_same_bits_for_any_number_of_threads() {
    let (_, lower, x) = example(ROWS_TO_SHARE + 13);
    let answers = [1, 2, 3].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| lower.multiply(x.as_slice()))
    });
    assert!(answers[0] == answers[1] && answers[0] == answers[2]);
}

#[test]
fn pivot_that_is_not_positive_is_named() {
    let lower = DenseSymmetric::from_columns(3, |c, column| {
        column[0] = if c == 1 { -1.0 } else { 1.0 };
    });
    assert_eq!(lower.factor().err(), Some(1));
}
