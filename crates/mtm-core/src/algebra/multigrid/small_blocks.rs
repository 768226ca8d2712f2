//! Products of small dense blocks.

use crate::algebra::simd::whole_lanes;

use super::precision::{Real, Stored};

/// Sum of the products of a row of blocks, stored by columns, with the corresponding rows of `x`.
#[inline(always)]
pub(super) fn block_row_product<T: Stored, F: Real, const C: usize, const R: usize>(
    columns: &[u32],
    blocks: &[[[T; R]; C]],
    x: &[[F; C]],
) -> [F; R] {
    // Eight singles fill the vector register that holds four doubles.
    if R > 4 && size_of::<F>() == 4 {
        in_lanes::<T, F, C, R, 8>(columns, blocks, x)
    } else {
        in_lanes::<T, F, C, R, 4>(columns, blocks, x)
    }
}

/// [`block_row_product`] in sums of `L` numbers.
///
/// A column of R values is loaded as its first L and, if R is not L, its last L: with fewer rows than lanes, the
/// first columns also load the start of the next one, and the last column the end of the previous one.
#[inline(always)]
fn in_lanes<T: Stored, F: Real, const C: usize, const R: usize, const L: usize>(
    columns: &[u32],
    blocks: &[[[T; R]; C]],
    x: &[[F; C]],
) -> [F; R] {
    // Separate sums of even and odd columns: a single sum would wait for its own last addition.
    let (mut heads, mut tails) = ([[F::default(); L]; 2], [[F::default(); L]; 2]);
    for (&j, block) in columns.iter().zip(blocks) {
        let x = &x[j as usize];
        let values = block.as_flattened();
        for c in 0..C {
            if R >= L || c + 1 < C {
                add_scaled(&mut heads[c % 2], &values[c * R..c * R + L], x[c]);
            }
            if R > L || c + 1 == C {
                add_scaled(&mut tails[c % 2], &values[c * R + R - L..c * R + R], x[c]);
            }
        }
    }
    let (heads, tails) = whole_lanes((heads, tails));
    let mut sum = [F::default(); R];
    for r in 0..R {
        if R <= L || r < L {
            sum[r] += heads[0][r] + heads[1][r];
        }
        if R <= L || r >= L {
            let lane = r + L - R;
            sum[r] += tails[0][lane] + tails[1][lane];
        }
    }
    sum.map(|value| F::of(1.0 / T::ONE) * value)
}

/// `sum += a x`, lane by lane.
#[inline(always)]
fn add_scaled<T: Stored, F: Real, const L: usize>(sum: &mut [F; L], a: &[T], x: F) {
    for (sum, a) in sum.iter_mut().zip(a) {
        *sum += a.raw::<F>() * x;
    }
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
