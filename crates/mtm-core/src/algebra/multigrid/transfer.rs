//! Prolongation and restriction between two levels, in short numbers.

use rayon::prelude::*;

use crate::algebra::simd::{Kernel, widest};

use super::block_rows::{RowsPart, split_rows};
use super::precision::{Precision, Real, Stored};
use super::prolongator::{Prolongator, TransposedIndex};
use super::rigid_modes::MODES;
use super::scaling::Scaling;
use super::small_blocks::{add_transposed_product, block_row_product};

/// Prolongation and restriction between two levels, both in scaled unknowns.
#[derive(Debug)]
pub(super) struct Transfer<const N: usize, P: Precision> {
    fine_start: Vec<usize>,
    fine_columns: Vec<u32>,
    /// Blocks of P by columns.
    fine_blocks: Vec<[[P::Stored; N]; MODES]>,
    coarse_start: Vec<usize>,
    coarse_columns: Vec<u32>,
    /// Blocks of Pᵀ by columns.
    coarse_blocks: Vec<[[P::Stored; MODES]; N]>,
    /// Largest number of each column of P, by which its blocks are divided; empty if they are stored as they are.
    largest: Vec<[P::Real; MODES]>,
    rows_per_task: usize,
    coarse_per_task: usize,
}

impl<const N: usize, P: Precision> Transfer<N, P> {
    /// Lᵀ P' Sᵀ with L the fine factors, P' `p` and S the coarse inverse factors: between scaled unknowns.
    pub(super) fn new(
        mut p: Prolongator<N>,
        transposed: TransposedIndex,
        fine: &Scaling<N>,
        coarse: &Scaling<MODES>,
        rows_per_task: usize,
    ) -> Self {
        let parts = split_rows(&mut p.blocks, &p.row_start, rows_per_task);
        parts.into_par_iter().for_each(|part| {
            let (row_start, columns) = (&p.row_start, &p.columns);
            widest(ScaledProlongatorRows { row_start, columns, fine, coarse, part });
        });
        let largest = if P::Stored::IS_BOUNDED {
            largest_of_columns(&p.blocks, &transposed)
        } else {
            Vec::new()
        };
        let fine_blocks: Vec<[[P::Stored; N]; MODES]> = p
            .blocks
            .par_iter()
            .zip(&p.columns)
            .with_min_len(1024)
            .map(|(block, &column)| {
                let largest = largest.get(column as usize).unwrap_or(&[1.0; MODES]);
                let mut out = [[P::Stored::default(); N]; MODES];
                for c in 0..MODES {
                    let scale = 1.0 / largest[c];
                    for r in 0..N {
                        out[c][r] = P::Stored::nearest(scale * block[r][c]);
                    }
                }
                out
            })
            .collect();
        drop(p.blocks);
        let coarse_blocks = transposed
            .positions
            .par_iter()
            .with_min_len(1024)
            .map(|&position| {
                let block = &fine_blocks[position as usize];
                std::array::from_fn(|r| std::array::from_fn(|c| block[c][r]))
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
            largest: largest.into_iter().map(|column| column.map(P::Real::of)).collect(),
            rows_per_task,
            coarse_per_task,
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.fine_columns.len() * (8 + 2 * size_of::<P::Stored>() * MODES * N)
            + (self.fine_start.len() + self.coarse_start.len()) * 8
            + self.largest.len() * size_of::<P::Real>() * MODES
    }

    /// `coarse = Pᵀ fine`.
    pub(super) fn restrict(&self, fine: &[[P::Real; N]], coarse: &mut [[P::Real; MODES]]) {
        coarse.par_chunks_mut(self.coarse_per_task).enumerate().for_each(|(chunk, out)| {
            let first = chunk * self.coarse_per_task;
            let start = &self.coarse_start[first..];
            let (columns, blocks) = (&self.coarse_columns[..], &self.coarse_blocks[..]);
            widest(Products { start, columns, blocks, x: fine, out: &mut *out });
            if let Some(largest) = self.largest.get(first..) {
                multiply(out, largest);
            }
        });
    }

    /// `fine = P coarse`; the numbers of `coarse` are overwritten.
    pub(super) fn prolong(&self, coarse: &mut [[P::Real; MODES]], fine: &mut [[P::Real; N]]) {
        multiply(coarse, &self.largest);
        let x = &*coarse;
        fine.par_chunks_mut(self.rows_per_task).enumerate().for_each(|(chunk, out)| {
            let start = &self.fine_start[chunk * self.rows_per_task..];
            let (columns, blocks) = (&self.fine_columns[..], &self.fine_blocks[..]);
            widest(Products { start, columns, blocks, x, out });
        });
    }
}

/// Largest magnitude in each column of P; 1 for an empty column.
fn largest_of_columns<const N: usize>(
    blocks: &[[[f64; MODES]; N]],
    transposed: &TransposedIndex,
) -> Vec<[f64; MODES]> {
    transposed
        .start
        .par_windows(2)
        .with_min_len(64)
        .map(|range| {
            let mut largest = [0.0_f64; MODES];
            for &position in &transposed.positions[range[0]..range[1]] {
                for row in &blocks[position as usize] {
                    for (most, v) in largest.iter_mut().zip(row) {
                        *most = most.max(v.abs());
                    }
                }
            }
            largest.map(|most| if most > 0.0 { most } else { 1.0 })
        })
        .collect()
}

/// `x` times `factors`, number by number, as far as there are factors.
fn multiply<F: Real>(x: &mut [[F; MODES]], factors: &[[F; MODES]]) {
    for (x, factors) in x.iter_mut().zip(factors) {
        for (x, factor) in x.iter_mut().zip(factors) {
            *x = *x * *factor;
        }
    }
}

/// A range of rows of P', which become those between scaled unknowns.
struct ScaledProlongatorRows<'a, const N: usize> {
    row_start: &'a [usize],
    columns: &'a [u32],
    fine: &'a Scaling<N>,
    coarse: &'a Scaling<MODES>,
    part: RowsPart<'a, [[f64; MODES]; N]>,
}

impl<const N: usize> Kernel for ScaledProlongatorRows<'_, N> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { row_start, columns, fine, coarse, part } = self;
        let first = row_start[part.rows.start];
        for i in part.rows {
            for k in row_start[i]..row_start[i + 1] {
                let block = &mut part.data[k - first];
                let mut scaled = [[0.0; MODES]; N];
                add_transposed_product(&mut scaled, &fine.factors[i], block);
                let s = &coarse.inverse_factors[columns[k] as usize];
                for r in 0..N {
                    for c in 0..MODES {
                        // Row c of the lower triangular S.
                        let mut sum = 0.0;
                        for m in 0..=c {
                            sum += scaled[r][m] * s[c][m];
                        }
                        block[r][c] = sum;
                    }
                }
            }
        }
    }
}

/// The products of a range of rows of blocks, which begins at `start`.
struct Products<'a, const C: usize, const R: usize, T, F> {
    start: &'a [usize],
    columns: &'a [u32],
    blocks: &'a [[[T; R]; C]],
    x: &'a [[F; C]],
    out: &'a mut [[F; R]],
}

impl<const C: usize, const R: usize, T: Stored, F: Real> Kernel for Products<'_, C, R, T, F> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        for (out, range) in self.out.iter_mut().zip(self.start.windows(2)) {
            let range = range[0]..range[1];
            *out = block_row_product(&self.columns[range.clone()], &self.blocks[range], self.x);
        }
    }
}
