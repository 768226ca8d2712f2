//! A scaled matrix in short numbers: its products and its largest eigenvalue.

use rayon::prelude::*;

use crate::algebra::error_bound::tridiagonal_extremes;
use crate::algebra::row_sums::dot;
use crate::algebra::simd::{Kernel, widest};

use super::block_rows::{ENTRIES_PER_TASK, RowsPart, SystemRows, split_rows};
use super::precision::{Real, Stored};
use super::scaling::{Scaling, scaled_block};
use super::small_blocks::block_row_product;

/// Lanczos steps for the largest eigenvalue of a scaled matrix.
const LANCZOS_STEPS: usize = 10;
/// Length of a Lanczos vector, for eigenvalues of order one, at which the space is exhausted.
const LANCZOS_BREAKDOWN: f64 = 1e-10;
/// Margin on that eigenvalue: Lanczos approaches it from below.
const EIGENVALUE_SAFETY: f64 = 1.05;

/// S A Sᵀ in short numbers, blocks by columns. No entry is above 1: the matrix is positive definite, and its
/// diagonal blocks are identities (Cauchy–Schwarz).
#[derive(Debug)]
pub(super) struct ScaledMatrix<const N: usize, T> {
    pub(super) row_start: Vec<usize>,
    pub(super) columns: Vec<u32>,
    blocks: Vec<[[T; N]; N]>,
    pub(super) largest_eigenvalue: f64,
    pub(super) rows_per_task: usize,
}

impl<const N: usize, T: Stored> ScaledMatrix<N, T> {
    pub(super) fn n_rows(&self) -> usize {
        self.row_start.len() - 1
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.row_start.len() * 8 + self.columns.len() * (4 + size_of::<T>() * N * N)
    }

    /// The system `a`, scaled.
    pub(super) fn new(a: &impl SystemRows<N>, scaling: &Scaling<N>) -> Self {
        let row_start = a.row_start().to_vec();
        let entries = a.columns().len() * N * N;
        let rows_per_task = (ENTRIES_PER_TASK * a.n_rows() / entries.max(1)).max(1);
        let columns = a.columns().to_vec();
        let mut blocks = vec![[[T::default(); N]; N]; columns.len()];
        let s = &scaling.inverse_factors;
        split_rows(&mut blocks, &row_start, rows_per_task)
            .into_par_iter()
            .for_each(|part| widest(ScaledRows { a, s, part }));
        let mut out = Self { row_start, columns, blocks, largest_eigenvalue: 1.0, rows_per_task };
        out.largest_eigenvalue = EIGENVALUE_SAFETY * out.estimate_eigenvalue();
        out
    }

    /// Row `i` of A x.
    #[inline(always)]
    pub(super) fn row_product<F: Real>(&self, i: usize, x: &[[F; N]]) -> [F; N] {
        let range = self.row_start[i]..self.row_start[i + 1];
        block_row_product(&self.columns[range.clone()], &self.blocks[range], x)
    }

    /// Block `k`, by columns.
    #[inline(always)]
    pub(super) fn block(&self, k: usize) -> [[f64; N]; N] {
        self.blocks[k].map(|column| column.map(|v| v.raw::<f64>() * (1.0 / T::ONE)))
    }

    /// Largest eigenvalue of the scaled matrix by a few Lanczos steps from a fixed start.
    fn estimate_eigenvalue(&self) -> f64 {
        let n = self.n_rows();
        // Golden-ratio sequence: equidistributed, and the same on every machine.
        let at = |k: usize| (k as f64 * 0.618_033_988_749_895).fract() - 0.5;
        let mut v: Vec<[f64; N]> =
            (0..n).map(|j| std::array::from_fn(|c| at(j * N + c + 1))).collect();
        let mut previous = vec![[0.0; N]; n];
        let mut w = vec![[0.0; N]; n];
        let mut norm = dot(&v, &v).sqrt();
        let (mut diagonal, mut off_squared) = (Vec::new(), Vec::new());
        let mut beta = 0.0;
        for step in 0..LANCZOS_STEPS {
            let exhausted = norm.is_nan() || norm <= LANCZOS_BREAKDOWN;
            if exhausted {
                break;
            }
            if step > 0 {
                off_squared.push(norm * norm);
                beta = norm;
            }
            let scale = 1.0 / norm;
            v.par_iter_mut().with_min_len(4096).for_each(|v| {
                for value in v {
                    *value *= scale;
                }
            });
            let (v_ref, previous_ref) = (&v, &previous);
            w.par_chunks_mut(self.rows_per_task).enumerate().for_each(|(chunk, out)| {
                let first = chunk * self.rows_per_task;
                widest(LanczosRows { a: self, first, v: v_ref, previous: previous_ref, beta, out });
            });
            let alpha = dot(&w, &v);
            diagonal.push(alpha);
            w.par_iter_mut().zip(&v).with_min_len(4096).for_each(|(w, v)| {
                for c in 0..N {
                    w[c] -= alpha * v[c];
                }
            });
            norm = dot(&w, &w).sqrt();
            std::mem::swap(&mut previous, &mut v);
            std::mem::swap(&mut v, &mut w);
        }
        if diagonal.is_empty() {
            return 1.0;
        }
        tridiagonal_extremes(&diagonal, &off_squared)[1].max(1.0)
    }
}

/// A range of rows of S A Sᵀ.
struct ScaledRows<'a, const N: usize, T, A: SystemRows<N>> {
    a: &'a A,
    s: &'a [[[f64; N]; N]],
    part: RowsPart<'a, [[T; N]; N]>,
}

impl<const N: usize, T: Stored, A: SystemRows<N>> Kernel for ScaledRows<'_, N, T, A> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { a, s, part } = self;
        let (row_start, columns) = (a.row_start(), a.columns());
        let first = row_start[part.rows.start];
        for i in part.rows {
            for k in row_start[i]..row_start[i + 1] {
                let j = columns[k] as usize;
                let scaled = scaled_block(&s[i], &a.block(k), &s[j], i <= j);
                let out = &mut part.data[k - first];
                for c in 0..N {
                    for r in 0..N {
                        out[c][r] = T::nearest(scaled[r][c]);
                    }
                }
            }
        }
    }
}

/// A range of rows of A v − β v₋₁, where v₋₁ is the previous vector.
struct LanczosRows<'a, const N: usize, T> {
    a: &'a ScaledMatrix<N, T>,
    first: usize,
    v: &'a [[f64; N]],
    previous: &'a [[f64; N]],
    beta: f64,
    out: &'a mut [[f64; N]],
}

impl<const N: usize, T: Stored> Kernel for LanczosRows<'_, N, T> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        for (offset, out) in self.out.iter_mut().enumerate() {
            let j = self.first + offset;
            let y = self.a.row_product(j, self.v);
            for c in 0..N {
                out[c] = y[c] - self.beta * self.previous[j][c];
            }
        }
    }
}
