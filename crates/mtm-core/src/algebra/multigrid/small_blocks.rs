//! Products of small dense blocks.

use crate::algebra::simd::{LANES, add_scaled};

/// Sum of the products of a row of blocks, stored by columns, with the corresponding rows of `x`.
///
/// A column of R values is loaded as its first four and, if R is not four, its last four: with three rows, the
/// first columns also load the start of the next one, and the last column the end of the previous one.
#[inline(always)]
pub(super) fn block_row_product<const C: usize, const R: usize>(
    columns: &[u32],
    blocks: &[[[f32; R]; C]],
    x: &[[f64; C]],
) -> [f64; R] {
    // Separate sums of even and odd columns: a single sum would wait for its own last addition.
    let (mut heads, mut tails) = ([[0.0; LANES]; 2], [[0.0; LANES]; 2]);
    for (&j, block) in columns.iter().zip(blocks) {
        let x = &x[j as usize];
        let values = block.as_flattened();
        let four = |at: usize| [0, 1, 2, 3].map(|lane| f64::from(values[at + lane]));
        for c in 0..C {
            if R >= LANES || c + 1 < C {
                add_scaled(&mut heads[c % 2], four(c * R), x[c]);
            }
            if R > LANES || c + 1 == C {
                add_scaled(&mut tails[c % 2], four(c * R + R - LANES), x[c]);
            }
        }
    }
    let mut sum = [0.0; R];
    for r in 0..R {
        if R <= LANES || r < LANES {
            sum[r] += heads[0][r] + heads[1][r];
        }
        if R <= LANES || r >= LANES {
            let lane = r + LANES - R;
            sum[r] += tails[0][lane] + tails[1][lane];
        }
    }
    sum
}

/// `out += a b`.
#[inline(always)]
pub(super) fn add_product<const R: usize, const K: usize, const C: usize>(
    out: &mut [[f64; C]; R],
    a: &[[f64; K]; R],
    b: &[[f64; C]; K],
) {
    for r in 0..R {
        for k in 0..K {
            for c in 0..C {
                out[r][c] += a[r][k] * b[k][c];
            }
        }
    }
}

/// `out += aᵀ b`.
#[inline(always)]
pub(super) fn add_transposed_product<const K: usize, const R: usize, const C: usize>(
    out: &mut [[f64; C]; R],
    a: &[[f64; R]; K],
    b: &[[f64; C]; K],
) {
    for k in 0..K {
        for r in 0..R {
            for c in 0..C {
                out[r][c] += a[k][r] * b[k][c];
            }
        }
    }
}

/// `S r`.
#[inline]
pub(super) fn times(s: &[[f64; 3]; 3], r: &[f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| s[i][0] * r[0] + s[i][1] * r[1] + s[i][2] * r[2])
}

/// `Sᵀ x`.
#[inline]
pub(super) fn transposed_times(s: &[[f64; 3]; 3], x: &[f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| s[0][i] * x[0] + s[1][i] * x[1] + s[2][i] * x[2])
}
