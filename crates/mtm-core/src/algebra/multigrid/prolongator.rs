//! The smoothed prolongator in double precision, and its transpose.

use rayon::prelude::*;

use super::aggregation::{Aggregates, UNASSIGNED};
use super::block_rows::{row_index, running_sum, split_rows};
use super::rigid_modes::MODES;
use super::scaled_matrix::ScaledMatrix;

/// A prolongator in double precision, rows of N×6 blocks.
#[derive(Debug)]
pub(super) struct Prolongator<const N: usize> {
    pub(super) row_start: Vec<usize>,
    pub(super) columns: Vec<u32>,
    pub(super) blocks: Vec<[[f64; MODES]; N]>,
    pub(super) n_coarse: usize,
}

impl<const N: usize> Prolongator<N> {
    /// P = (I − ω Ã) P₀, one row of blocks per fine row; Ã is `a`, P₀ `tentative` and ω `damping`.
    pub(super) fn smoothed(
        a: &ScaledMatrix<N>,
        aggregates: &Aggregates,
        tentative: &[[[f64; MODES]; N]],
        damping: f64,
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
        let row_start = running_sum(&counts);
        let total = row_start[n];
        let mut columns = vec![0_u32; total];
        let mut blocks = vec![[[0.0; MODES]; N]; total];
        let column_parts = split_rows(&mut columns, &row_start, a.rows_per_task);
        let block_parts = split_rows(&mut blocks, &row_start, a.rows_per_task);
        column_parts.into_par_iter().zip(block_parts).for_each(|(columns, blocks)| {
            let first = row_start[columns.rows.start];
            for i in columns.rows.clone() {
                let range = row_start[i] - first..row_start[i + 1] - first;
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
                    let out = &mut blocks[slot];
                    let block = &a.blocks[k];
                    for c in 0..N {
                        for r in 0..N {
                            let value = -damping * f64::from(block[c][r]);
                            for m in 0..MODES {
                                out[r][m] += value * tentative[j][c][m];
                            }
                        }
                    }
                    if i == j {
                        for r in 0..N {
                            for m in 0..MODES {
                                out[r][m] += tentative[i][r][m];
                            }
                        }
                    }
                }
            }
        });
        Self { row_start, columns, blocks, n_coarse: aggregates.count }
    }

    /// Positions of the blocks of Pᵀ in P.
    pub(super) fn transposed(&self) -> TransposedIndex {
        let mut sizes = vec![0; self.n_coarse];
        for &c in &self.columns {
            sizes[c as usize] += 1;
        }
        let start = running_sum(&sizes);
        let mut next = start.clone();
        let mut rows = vec![0; self.columns.len()];
        let mut positions = vec![0; self.columns.len()];
        for i in 0..self.row_start.len() - 1 {
            for k in self.row_start[i]..self.row_start[i + 1] {
                let slot = &mut next[self.columns[k] as usize];
                rows[*slot] = row_index(i);
                positions[*slot] = row_index(k);
                *slot += 1;
            }
        }
        TransposedIndex { start, rows, positions }
    }
}

/// For each coarse row, the fine rows connected to it and the positions of their blocks.
#[derive(Debug)]
pub(super) struct TransposedIndex {
    pub(super) start: Vec<usize>,
    pub(super) rows: Vec<u32>,
    pub(super) positions: Vec<u32>,
}
