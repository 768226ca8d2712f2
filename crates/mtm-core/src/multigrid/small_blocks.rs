//! Products of small dense blocks.

/// Sum of the products of a row of blocks, stored by columns, with the rows of `x` they meet.
#[inline]
pub(super) fn block_row_product<const C: usize, const R: usize>(
    columns: &[u32],
    blocks: &[[[f32; R]; C]],
    x: &[[f64; C]],
) -> [f64; R] {
    // Three sums at once: one alone would wait for its own last addition, three times a block.
    let mut sums = [[0.0; R]; 3];
    for (&j, block) in columns.iter().zip(blocks) {
        let x = &x[j as usize];
        for c in 0..C {
            for r in 0..R {
                sums[c % 3][r] += f64::from(block[c][r]) * x[c];
            }
        }
    }
    let mut sum = sums[0];
    for r in 0..R {
        sum[r] += sums[1][r] + sums[2][r];
    }
    sum
}

/// `out += a b`.
#[inline]
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
#[inline]
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
