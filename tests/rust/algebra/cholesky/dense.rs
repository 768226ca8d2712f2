//! The flexibility of rows between directions at them.

use mtm_core::internals::{DenseSymmetric, TailFlexibility};

/// Several directions at a node, none at another, softness, and memory of a larger matrix: as assembled in
/// double precision, to six digits.
#[test]
fn rough_flexibility_between_directions_equals_the_exact_one() {
    let wave = |i: usize, j: usize| ((1 + i * j + i + j) as f64 * 0.37).sin();
    let n = 21;
    let matrix = DenseSymmetric::from_columns(n, |c, column| {
        for (r, v) in (c..).zip(column.iter_mut()) {
            let size = |i: usize| 10.0_f64.powi((i % 5) as i32 - 2);
            *v = size(r) * size(c) * if r == c { n as f64 } else { wave(r, c) };
        }
    });
    let rows = (0..n as u32 / 3).collect();
    let tail = TailFlexibility::new(matrix, rows, (Vec::new(), Vec::new()), &[]).unwrap();
    let unit = |a: f64, b: f64| [a.sin() * b.cos(), a.sin() * b.sin(), a.cos()];
    let directions: Vec<(usize, [f64; 3])> = [0, 0, 1, 2, 2, 2, 4, 6, 6]
        .iter()
        .enumerate()
        .map(|(k, &node)| (node, unit(0.3 + k as f64, 1.7 * k as f64)))
        .collect();
    let softness: Vec<f64> = (0..directions.len()).map(|k| (k % 3) as f64 * 0.4).collect();
    let exact = tail.normal_flexibility(&directions, &softness);
    let rough = tail.rough_flexibility(&directions, &softness, vec![f32::NAN; 400]);
    let x: Vec<f64> =
        (0..directions.len()).map(|k| (k as f64).cos() / exact.column(k)[0].sqrt()).collect();
    let expected = exact.multiply(&x);
    for (k, (a, b)) in expected.iter().zip(rough.multiply(&x)).enumerate() {
        assert!((a - b).abs() <= 1e-6 * exact.column(k)[0].sqrt(), "{k}: {a:e} {b:e}");
    }
}
