//! The smoothed prolongator in double precision, and its transpose.

use rayon::prelude::*;

use crate::algebra::blocks::running_sum;
use crate::algebra::simd::{Kernel, widest};

use super::aggregation::{Aggregates, UNASSIGNED};
use super::block_rows::{RowsPart, split_rows};
use super::precision::Stored;
use super::rigid_modes::MODES;
use super::scaled_matrix::ScaledMatrix;
use super::scaling::Scaling;
use super::small_blocks::add_transposed_product;

/// A prolongator in double precision, rows of N×6 blocks, to unknowns that are not scaled.
#[derive(Debug)]
pub(super) struct Prolongator<const N: usize> {
    pub(super) row_start: Vec<usize>,
    pub(super) columns: Vec<u32>,
    pub(super) blocks: Vec<[[f64; MODES]; N]>,
    pub(super) n_coarse: usize,
}

impl<const N: usize> Prolongator<N> {
    /// P' = Sᵀ P with P = (I − ω Ã) P₀, one row of blocks per fine row; Ã is `a`, P₀ `tentative`, ω `damping` and
    /// S `scaling`: from coarse unknowns to those that are not scaled.
    pub(super) fn smoothed<T: Stored>(
        a: &ScaledMatrix<N, T>,
        aggregates: &Aggregates,
        tentative: &[[[f64; MODES]; N]],
        damping: f64,
        scaling: &Scaling<N>,
    ) -> Self {
        let of = &aggregates.of_row;
        let n = a.n_rows();
        let counts: Vec<usize> = (0..n)
            .into_par_iter()
            .with_min_len(256)
            .map_init(Vec::new, |seen: &mut Vec<u32>, i| {
                seen.clear();
                for &j in &a.columns[a.row_start[i]..a.row_start[i + 1]] {
                    let aggregate = of[j as usize];
                    if aggregate != UNASSIGNED && !seen.contains(&aggregate) {
                        seen.push(aggregate);
                    }
                }
                seen.len()
            })
            .collect();
        let row_start = running_sum(counts);
        let total = row_start[n];
        let mut columns = vec![0_u32; total];
        let mut blocks = vec![[[0.0; MODES]; N]; total];
        split_rows(&mut columns, &row_start, a.rows_per_task)
            .into_par_iter()
            .zip(split_rows(&mut blocks, &row_start, a.rows_per_task))
            .for_each(|(columns, blocks)| {
                let row_start = &row_start[columns.rows.start..=columns.rows.end];
                widest(SmoothedRows {
                    a,
                    of,
                    tentative,
                    damping,
                    scaling,
                    row_start,
                    columns,
                    blocks,
                });
            });
        Self { row_start, columns, blocks, n_coarse: aggregates.count }
    }

    /// Positions of the blocks of Pᵀ in P.
    pub(super) fn transposed(&self) -> TransposedIndex {
        let mut sizes = vec![0; self.n_coarse];
        for &c in &self.columns {
            sizes[c as usize] += 1;
        }
        let start = running_sum(sizes);
        let mut next = start.clone();
        let mut rows = vec![0; self.columns.len()];
        let mut positions = vec![0; self.columns.len()];
        for i in 0..self.row_start.len() - 1 {
            for k in self.row_start[i]..self.row_start[i + 1] {
                let slot = &mut next[self.columns[k] as usize];
                rows[*slot] = i as u32;
                positions[*slot] = k as u32;
                *slot += 1;
            }
        }
        TransposedIndex { start, rows, positions }
    }
}

/// A range of rows of [`Prolongator::smoothed`], which begins at `row_start`.
struct SmoothedRows<'a, const N: usize, T> {
    a: &'a ScaledMatrix<N, T>,
    of: &'a [u32],
    tentative: &'a [[[f64; MODES]; N]],
    damping: f64,
    scaling: &'a Scaling<N>,
    row_start: &'a [usize],
    columns: RowsPart<'a, u32>,
    blocks: RowsPart<'a, [[f64; MODES]; N]>,
}

impl<const N: usize, T: Stored> Kernel for SmoothedRows<'_, N, T> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { a, of, tentative, damping, scaling, row_start, columns, blocks } = self;
        for (i, range) in columns.rows.clone().zip(row_start.windows(2)) {
            let range = range[0] - row_start[0]..range[1] - row_start[0];
            let columns = &mut columns.data[range.clone()];
            let blocks = &mut blocks.data[range];
            let mut used = 0;
            for k in a.row_start[i]..a.row_start[i + 1] {
                let j = a.columns[k] as usize;
                let aggregate = of[j];
                if aggregate == UNASSIGNED {
                    continue;
                }
                let slot = columns[..used].iter().position(|&c| c == aggregate);
                let slot = slot.unwrap_or_else(|| {
                    columns[used] = aggregate;
                    used += 1;
                    used - 1
                });
                // Blocks of Ã are stored by columns.
                let step = a.block(k).map(|column| column.map(|v| -damping * v));
                add_transposed_product(&mut blocks[slot], &step, &tentative[j]);
                if i == j {
                    for (out, row) in
                        blocks[slot].as_flattened_mut().iter_mut().zip(tentative[i].as_flattened())
                    {
                        *out += row;
                    }
                }
            }
            for block in blocks {
                let smoothed = *block;
                *block = [[0.0; MODES]; N];
                add_transposed_product(block, &scaling.inverse_factors[i], &smoothed);
            }
        }
    }
}

/// For each coarse row, the fine rows connected to it and the positions of their blocks.
#[derive(Debug)]
pub(super) struct TransposedIndex {
    pub(super) start: Vec<usize>,
    pub(super) rows: Vec<u32>,
    pub(super) positions: Vec<u32>,
}
