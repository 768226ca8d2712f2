//! The dense factor of the coarsest level.

use super::block_rows::SystemRows;
use super::galerkin::CoarseMatrix;
use super::precision::Real;
use super::rigid_modes::MODES;
use super::scaling::{PIVOT_TOLERANCE, Scaling, scaled_block};

/// Dense L Lᵀ of the coarsest scaled matrix; dependent unknowns get an infinite pivot, so they stay zero.
#[derive(Debug)]
pub(super) struct DenseCholesky {
    pub(super) size: usize,
    /// Rows of L, `size` entries each.
    factor: Vec<f64>,
}

impl DenseCholesky {
    pub(super) fn new(a: &CoarseMatrix, scaling: &Scaling<MODES>) -> Self {
        let s = &scaling.inverse_factors;
        let size = MODES * a.n_rows();
        let mut l = vec![0.0; size * size];
        for i in 0..a.n_rows() {
            for k in a.row_start[i]..a.row_start[i + 1] {
                let j = a.columns[k] as usize;
                if j > i {
                    continue;
                }
                let block = scaled_block(&s[i], &a.block(k), &s[j], false);
                for r in 0..MODES {
                    for c in 0..MODES {
                        l[(MODES * i + r) * size + MODES * j + c] = block[r][c];
                    }
                }
            }
        }
        for i in 0..size {
            let (above, below) = l.split_at_mut(i * size);
            let row = &mut below[..size];
            for j in 0..i {
                let other = &above[j * size..j * size + j + 1];
                let sum: f64 = short_dot(&row[..j], &other[..j]);
                row[j] = (row[j] - sum) / other[j];
            }
            let before = row[i];
            let pivot = before - short_dot(&row[..i], &row[..i]);
            row[i] = if pivot > PIVOT_TOLERANCE * before { pivot.sqrt() } else { f64::INFINITY };
        }
        Self { size, factor: l }
    }

    pub(super) fn solve<F: Real>(&self, r: &[[F; MODES]], x: &mut [[F; MODES]]) {
        let n = self.size;
        let mut y: Vec<f64> = r.as_flattened().iter().map(|&r| r.into()).collect();
        for i in 0..n {
            let row = &self.factor[i * n..i * n + n];
            y[i] = (y[i] - short_dot(&row[..i], &y[..i])) / row[i];
        }
        for i in (0..n).rev() {
            let row = &self.factor[i * n..i * n + n];
            let value = y[i] / row[i];
            y[i] = value;
            for (y, l) in y[..i].iter_mut().zip(row) {
                *y -= l * value;
            }
        }
        for (x, y) in x.as_flattened_mut().iter_mut().zip(y) {
            *x = F::of(y);
        }
    }
}

/// A dot product in eight interleaved sums, so that it vectorises.
fn short_dot(x: &[f64], y: &[f64]) -> f64 {
    let (x_chunks, x_rest) = x.as_chunks::<8>();
    let (y_chunks, y_rest) = y.as_chunks::<8>();
    let mut sums = [0.0; 8];
    for (x, y) in x_chunks.iter().zip(y_chunks) {
        for m in 0..8 {
            sums[m] += x[m] * y[m];
        }
    }
    let rest: f64 = x_rest.iter().zip(y_rest).map(|(x, y)| x * y).sum();
    sums.iter().sum::<f64>() + rest
}
