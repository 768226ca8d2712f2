//! Prolongation and restriction between two levels, in single precision.

use rayon::prelude::*;

use crate::algebra::simd::{Kernel, widest};

use super::prolongator::{Prolongator, TransposedIndex};
use super::rigid_modes::MODES;
use super::scaling::Scaling;
use super::small_blocks::block_row_product;

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
    /// P Sᵀ with the coarse scaling S.
    pub(super) fn new(
        p: &Prolongator<N>,
        transposed: &TransposedIndex,
        scaling: &Scaling<MODES>,
        rows_per_task: usize,
    ) -> Self {
        let fine_blocks: Vec<[[f32; N]; MODES]> = p
            .blocks
            .par_iter()
            .zip(&p.columns)
            .with_min_len(1024)
            .map(|(block, &column)| {
                let s = &scaling.inverse_factors[column as usize];
                let mut out = [[0.0; N]; MODES];
                for c in 0..MODES {
                    for r in 0..N {
                        // Row c of the lower triangular S.
                        let mut sum = 0.0;
                        for m in 0..=c {
                            sum += block[r][m] * s[c][m];
                        }
                        out[c][r] = sum as f32;
                    }
                }
                out
            })
            .collect();
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
            fine_start: p.row_start.clone(),
            fine_columns: p.columns.clone(),
            fine_blocks,
            coarse_start: transposed.start.clone(),
            coarse_columns: transposed.rows.clone(),
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
