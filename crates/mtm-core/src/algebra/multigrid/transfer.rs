//! Prolongation and restriction between two levels, in single precision.

use rayon::prelude::*;

use crate::algebra::simd::{Kernel, widest};

use super::block_rows::{RowsPart, split_rows};
use super::prolongator::{Prolongator, TransposedIndex};
use super::rigid_modes::MODES;
use super::scaling::Scaling;
use super::small_blocks::{add_transposed_product, block_row_product};

/// Prolongation and restriction between two levels, both in scaled unknowns.
#[derive(Debug)]
pub(super) struct Transfer<const N: usize> {
    fine_start: Vec<usize>,
    fine_columns: Vec<u32>,
    /// Blocks of P by columns.
    fine_blocks: Vec<[[f32; N]; MODES]>,
    coarse_start: Vec<usize>,
    coarse_columns: Vec<u32>,
    /// Blocks of Pᵀ by columns.
    coarse_blocks: Vec<[[f32; MODES]; N]>,
    rows_per_task: usize,
    coarse_per_task: usize,
}

impl<const N: usize> Transfer<N> {
    /// Lᵀ P' Sᵀ with L the fine factors, P' `p` and S the coarse inverse factors: between scaled unknowns.
    pub(super) fn new(
        p: Prolongator<N>,
        transposed: TransposedIndex,
        fine: &Scaling<N>,
        coarse: &Scaling<MODES>,
        rows_per_task: usize,
    ) -> Self {
        let mut fine_blocks = vec![[[0.0_f32; N]; MODES]; p.blocks.len()];
        split_rows(&mut fine_blocks, &p.row_start, rows_per_task)
            .into_par_iter()
            .for_each(|part| widest(ScaledRows { p: &p, fine, coarse, part }));
        drop(p.blocks);
        let coarse_blocks = transposed
            .positions
            .par_iter()
            .with_min_len(1024)
            .map(|&position| {
                let block = &fine_blocks[position as usize];
                let mut out = [[0.0; MODES]; N];
                for r in 0..N {
                    for c in 0..MODES {
                        out[r][c] = block[c][r];
                    }
                }
                out
            })
            .collect();
        let n_coarse = transposed.start.len() - 1;
        let coarse_per_task = (rows_per_task * n_coarse / p.row_start.len()).max(1);
        Self {
            fine_start: p.row_start,
            fine_columns: p.columns,
            fine_blocks,
            coarse_start: transposed.start,
            coarse_columns: transposed.rows,
            coarse_blocks,
            rows_per_task,
            coarse_per_task,
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.fine_columns.len() * (8 + 8 * MODES * N)
            + (self.fine_start.len() + self.coarse_start.len()) * 8
    }

    /// `coarse = Pᵀ fine`.
    pub(super) fn restrict(&self, fine: &[[f64; N]], coarse: &mut [[f64; MODES]]) {
        coarse.par_chunks_mut(self.coarse_per_task).enumerate().for_each(|(chunk, out)| {
            let start = &self.coarse_start[chunk * self.coarse_per_task..];
            let (columns, blocks) = (&self.coarse_columns[..], &self.coarse_blocks[..]);
            widest(Products { start, columns, blocks, x: fine, out });
        });
    }

    /// `fine = P coarse`.
    pub(super) fn prolong(&self, coarse: &[[f64; MODES]], fine: &mut [[f64; N]]) {
        fine.par_chunks_mut(self.rows_per_task).enumerate().for_each(|(chunk, out)| {
            let start = &self.fine_start[chunk * self.rows_per_task..];
            let (columns, blocks) = (&self.fine_columns[..], &self.fine_blocks[..]);
            widest(Products { start, columns, blocks, x: coarse, out });
        });
    }
}

/// A range of rows of the blocks of [`Transfer::new`].
struct ScaledRows<'a, const N: usize> {
    p: &'a Prolongator<N>,
    fine: &'a Scaling<N>,
    coarse: &'a Scaling<MODES>,
    part: RowsPart<'a, [[f32; N]; MODES]>,
}

impl<const N: usize> Kernel for ScaledRows<'_, N> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { p, fine, coarse, part } = self;
        let first = p.row_start[part.rows.start];
        for i in part.rows {
            for k in p.row_start[i]..p.row_start[i + 1] {
                let mut scaled = [[0.0; MODES]; N];
                add_transposed_product(&mut scaled, &fine.factors[i], &p.blocks[k]);
                let s = &coarse.inverse_factors[p.columns[k] as usize];
                let out = &mut part.data[k - first];
                for c in 0..MODES {
                    for r in 0..N {
                        // Row c of the lower triangular S.
                        let mut sum = 0.0;
                        for m in 0..=c {
                            sum += scaled[r][m] * s[c][m];
                        }
                        out[c][r] = sum as f32;
                    }
                }
            }
        }
    }
}

/// The products of a range of rows of blocks, which begins at `start`.
struct Products<'a, const C: usize, const R: usize> {
    start: &'a [usize],
    columns: &'a [u32],
    blocks: &'a [[[f32; R]; C]],
    x: &'a [[f64; C]],
    out: &'a mut [[f64; R]],
}

impl<const C: usize, const R: usize> Kernel for Products<'_, C, R> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        for (out, range) in self.out.iter_mut().zip(self.start.windows(2)) {
            let range = range[0]..range[1];
            *out = block_row_product(&self.columns[range.clone()], &self.blocks[range], self.x);
        }
    }
}
