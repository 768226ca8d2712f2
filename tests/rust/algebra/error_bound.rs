//! Extreme eigenvalues.

use mtm_core::internals::tridiagonal_extremes;

#[test]
fn extremes_of_a_known_tridiagonal_matrix() {
    // 2 on the diagonal, −1 next to it: eigenvalues 2 − 2 cos(kπ/(n+1)).
    let n = 50;
    let [low, high] = tridiagonal_extremes(&vec![2.0; n], &vec![1.0; n - 1]);
    let angle = std::f64::consts::PI / (n + 1) as f64;
    assert!((low / (2.0 - 2.0 * angle.cos()) - 1.0).abs() < 1e-8);
    assert!((high / (2.0 + 2.0 * angle.cos()) - 1.0).abs() < 1e-8);
}
