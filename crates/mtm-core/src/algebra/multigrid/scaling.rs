//! The Cholesky factors of the diagonal blocks, which scale a level.

use rayon::prelude::*;

use super::block_rows::SystemRows;
use super::small_blocks::add_product;

/// Pivot, relative to its diagonal entry, below which an unknown counts as dependent.
pub(super) const PIVOT_TOLERANCE: f64 = 1e-13;

/// Diagonal blocks A_jj = L Lᵀ and S = L⁻¹; dependent unknowns have zero rows in S.
#[derive(Debug)]
pub(super) struct Scaling<const N: usize> {
    pub(super) factors: Vec<[[f64; N]; N]>,
    pub(super) inverse_factors: Vec<[[f64; N]; N]>,
    pub(super) not_positive: Option<usize>,
}

impl<const N: usize> Scaling<N> {
    pub(super) fn new(a: &impl SystemRows<N>) -> Self {
        let n = a.n_rows();
        let mut factors = vec![[[0.0; N]; N]; n];
        let mut inverse_factors = factors.clone();
        let not_positive = factors
            .par_iter_mut()
            .zip(&mut inverse_factors)
            .enumerate()
            .with_min_len(1024)
            .filter_map(|(j, (l, s))| {
                let dependent;
                (*l, *s, dependent) = factor(&a.block(a.diagonal(j)));
                dependent.then_some(j)
            })
            .min();
        Self { factors, inverse_factors, not_positive }
    }
}

/// `L`, `L⁻¹` and whether a pivot was not positive.
fn factor<const N: usize>(a: &[[f64; N]; N]) -> ([[f64; N]; N], [[f64; N]; N], bool) {
    let mut l = [[0.0; N]; N];
    let mut s = [[0.0; N]; N];
    let mut dependent = false;
    for k in 0..N {
        let mut pivot = a[k][k];
        for m in 0..k {
            pivot -= l[k][m] * l[k][m];
        }
        let independent = pivot > PIVOT_TOLERANCE * a[k][k] && pivot.is_finite();
        if !independent {
            dependent = true;
            // Column k of L and row k of S stay zero; row k of L keeps what it shares with others.
            continue;
        }
        let root = pivot.sqrt();
        l[k][k] = root;
        for i in k + 1..N {
            let mut sum = a[i][k];
            for m in 0..k {
                sum -= l[i][m] * l[k][m];
            }
            l[i][k] = sum / root;
        }
        for c in 0..=k {
            let mut sum = if c == k { 1.0 } else { 0.0 };
            for m in c..k {
                sum -= l[k][m] * s[m][c];
            }
            s[k][c] = sum / root;
        }
    }
    (l, s, dependent)
}

/// `S_i A S_jᵀ`, associated so that the block at the transposed position is its transpose in every bit.
#[inline(always)]
pub(super) fn scaled_block<const N: usize>(
    s_i: &[[f64; N]; N],
    a: &[[f64; N]; N],
    s_j: &[[f64; N]; N],
    upper: bool,
) -> [[f64; N]; N] {
    let mut inner = [[0.0; N]; N];
    let mut out = [[0.0; N]; N];
    if upper {
        add_product(&mut inner, s_i, a);
        for r in 0..N {
            for c in 0..N {
                for m in 0..N {
                    out[r][c] += inner[r][m] * s_j[c][m];
                }
            }
        }
    } else {
        for r in 0..N {
            for c in 0..N {
                for m in 0..N {
                    inner[r][c] += a[r][m] * s_j[c][m];
                }
            }
        }
        add_product(&mut out, s_i, &inner);
    }
    out
}
