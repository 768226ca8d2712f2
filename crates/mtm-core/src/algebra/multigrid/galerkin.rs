//! The Galerkin product, in double precision throughout.

use rayon::prelude::*;

use super::block_rows::{ENTRIES_PER_TASK, SystemRows, row_index, running_sum, split_rows};
use super::prolongator::{Prolongator, TransposedIndex};
use super::rigid_modes::{MODES, ModeBlock};
use super::scaling::Scaling;
use super::small_blocks::{add_product, add_transposed_product};

/// A column that has not occurred in the row.
const UNSEEN: u32 = u32::MAX;

/// A coarse matrix in double precision, kept only until the next level is built.
#[derive(Debug)]
pub(super) struct CoarseMatrix {
    pub(super) row_start: Vec<usize>,
    pub(super) columns: Vec<u32>,
    pub(super) blocks: Vec<ModeBlock>,
    diagonal: Vec<usize>,
}

impl SystemRows<MODES> for CoarseMatrix {
    fn row_start(&self) -> &[usize] {
        &self.row_start
    }
    fn columns(&self) -> &[u32] {
        &self.columns
    }
    #[inline]
    fn block(&self, position: usize) -> ModeBlock {
        self.blocks[position]
    }
    fn diagonal(&self, row: usize) -> usize {
        self.diagonal[row]
    }
}

/// Pᵀ (S A Sᵀ) P, computed as P'ᵀ A P' with P' = Sᵀ P. The upper triangle is summed and the lower one mirrored,
/// so that the result is symmetric in every bit.
pub(super) fn galerkin<const N: usize>(
    a: &impl SystemRows<N>,
    scaling: &Scaling<N>,
    p: &Prolongator<N>,
) -> (CoarseMatrix, TransposedIndex) {
    let n = a.n_rows();
    let rows_per_task = (ENTRIES_PER_TASK / (N * N * 64)).max(1);

    let mut unscaled = vec![[[0.0; MODES]; N]; p.blocks.len()];
    split_rows(&mut unscaled, &p.row_start, 4 * rows_per_task).into_par_iter().for_each(|part| {
        let first = p.row_start[part.rows.start];
        for i in part.rows.clone() {
            for k in p.row_start[i]..p.row_start[i + 1] {
                add_transposed_product(
                    &mut part.data[k - first],
                    &scaling.inverse_factors[i],
                    &p.blocks[k],
                );
            }
        }
    });

    // A P', pattern first.
    let markers = || vec![UNSEEN; p.n_coarse];
    let counts: Vec<usize> = (0..n)
        .into_par_iter()
        .with_min_len(rows_per_task)
        .map_init(
            || (markers(), Vec::<u32>::new()),
            |(marker, row), i| {
                collect_row(a, p, i, marker, row);
                row.len()
            },
        )
        .collect();
    let ap_start = running_sum(&counts);
    let mut ap_columns = vec![0_u32; ap_start[n]];
    let mut ap_blocks = vec![[[0.0; MODES]; N]; ap_start[n]];
    split_rows(&mut ap_columns, &ap_start, rows_per_task)
        .into_par_iter()
        .zip(split_rows(&mut ap_blocks, &ap_start, rows_per_task))
        .for_each_init(
            || (markers(), Vec::new()),
            |(marker, row), (columns, blocks)| {
                let first = ap_start[columns.rows.start];
                for i in columns.rows.clone() {
                    collect_row(a, p, i, marker, row);
                    let base = ap_start[i] - first;
                    columns.data[base..base + row.len()].copy_from_slice(row);
                    for (slot, &c) in row.iter().enumerate() {
                        marker[c as usize] = row_index(slot);
                    }
                    let out = &mut blocks.data[base..base + row.len()];
                    for k in a.row_start()[i]..a.row_start()[i + 1] {
                        let j = a.columns()[k] as usize;
                        let block = a.block(k);
                        for l in p.row_start[j]..p.row_start[j + 1] {
                            let slot = marker[p.columns[l] as usize] as usize;
                            add_product(&mut out[slot], &block, &unscaled[l]);
                        }
                    }
                    for &c in row.iter() {
                        marker[c as usize] = UNSEEN;
                    }
                }
            },
        );

    let transposed = p.transposed();
    // Pattern first again: growing the rows one by one would contend for the allocator's locks.
    let counts: Vec<usize> = (0..p.n_coarse)
        .into_par_iter()
        .with_min_len(16)
        .map_init(
            || (markers(), Vec::<u32>::new()),
            |(marker, row), coarse| {
                collect_upper(&transposed, &ap_start, &ap_columns, coarse, marker, row);
                row.len()
            },
        )
        .collect();
    let row_start = running_sum(&counts);
    let mut columns = vec![0_u32; row_start[p.n_coarse]];
    let mut blocks = vec![[[0.0; MODES]; MODES]; columns.len()];
    split_rows(&mut columns, &row_start, 32)
        .into_par_iter()
        .zip(split_rows(&mut blocks, &row_start, 32))
        .for_each_init(
            || (markers(), Vec::new()),
            |(marker, row), (columns, blocks)| {
                let first = row_start[columns.rows.start];
                for coarse in columns.rows.clone() {
                    collect_upper(&transposed, &ap_start, &ap_columns, coarse, marker, row);
                    let base = row_start[coarse] - first;
                    columns.data[base..base + row.len()].copy_from_slice(row);
                    for (slot, &c) in row.iter().enumerate() {
                        marker[c as usize] = row_index(slot);
                    }
                    let out = &mut blocks.data[base..base + row.len()];
                    for t in transposed.start[coarse]..transposed.start[coarse + 1] {
                        let i = transposed.rows[t] as usize;
                        let block = &unscaled[transposed.positions[t] as usize];
                        for k in ap_start[i]..ap_start[i + 1] {
                            let c = ap_columns[k] as usize;
                            if c >= coarse {
                                let slot = marker[c] as usize;
                                add_transposed_product(&mut out[slot], block, &ap_blocks[k]);
                            }
                        }
                    }
                    for &c in row.iter() {
                        marker[c as usize] = UNSEEN;
                    }
                }
            },
        );
    (mirror(&row_start, &columns, &blocks), transposed)
}

/// The distinct columns of row `coarse` of Pᵀ A P on and above the diagonal; resets `marker`.
fn collect_upper(
    transposed: &TransposedIndex,
    ap_start: &[usize],
    ap_columns: &[u32],
    coarse: usize,
    marker: &mut [u32],
    row: &mut Vec<u32>,
) {
    row.clear();
    for &i in &transposed.rows[transposed.start[coarse]..transposed.start[coarse + 1]] {
        for &c in &ap_columns[ap_start[i as usize]..ap_start[i as usize + 1]] {
            if c as usize >= coarse && marker[c as usize] == UNSEEN {
                marker[c as usize] = 0;
                row.push(c);
            }
        }
    }
    for &c in row.iter() {
        marker[c as usize] = UNSEEN;
    }
}

/// The distinct coarse columns in row `i` of A P; resets `marker`.
fn collect_row<const N: usize>(
    a: &impl SystemRows<N>,
    p: &Prolongator<N>,
    i: usize,
    marker: &mut [u32],
    row: &mut Vec<u32>,
) {
    row.clear();
    for &j in &a.columns()[a.row_start()[i]..a.row_start()[i + 1]] {
        for &c in &p.columns[p.row_start[j as usize]..p.row_start[j as usize + 1]] {
            if marker[c as usize] == UNSEEN {
                marker[c as usize] = 0;
                row.push(c);
            }
        }
    }
    for &c in row.iter() {
        marker[c as usize] = UNSEEN;
    }
}

/// The full matrix, columns ascending, from its upper triangle in any column order.
fn mirror(
    upper_start: &[usize],
    upper_columns: &[u32],
    upper_blocks: &[ModeBlock],
) -> CoarseMatrix {
    let n = upper_start.len() - 1;
    let mut sizes = vec![0; n];
    for i in 0..n {
        sizes[i] += upper_start[i + 1] - upper_start[i];
        for &j in &upper_columns[upper_start[i]..upper_start[i + 1]] {
            if j as usize != i {
                sizes[j as usize] += 1;
            }
        }
    }
    let row_start = running_sum(&sizes);
    // Column of each block and its position in the upper triangle.
    let mut sources = vec![(0_u32, 0_u32); row_start[n]];
    let mut next = row_start.clone();
    for i in 0..n {
        for k in upper_start[i]..upper_start[i + 1] {
            let j = upper_columns[k];
            sources[next[i]] = (j, row_index(k));
            next[i] += 1;
            if j as usize != i {
                sources[next[j as usize]] = (row_index(i), row_index(k));
                next[j as usize] += 1;
            }
        }
    }
    let parts = split_rows(&mut sources, &row_start, 64);
    parts.into_par_iter().for_each(|part| {
        let first = row_start[part.rows.start];
        for i in part.rows.clone() {
            part.data[row_start[i] - first..row_start[i + 1] - first]
                .sort_unstable_by_key(|source| source.0);
        }
    });
    let columns: Vec<u32> = sources.iter().map(|s| s.0).collect();
    let mut diagonal = vec![0; n];
    for i in 0..n {
        for k in row_start[i]..row_start[i + 1] {
            if columns[k] as usize == i {
                diagonal[i] = k;
            }
        }
    }
    let blocks = sources.par_iter().map(|&(_, position)| upper_blocks[position as usize]).collect();
    let mut coarse = CoarseMatrix { row_start, columns, blocks, diagonal };
    coarse.transpose_lower();
    coarse
}

impl CoarseMatrix {
    /// Transposes the blocks below the diagonal, which were copied from above it, and makes the diagonal blocks
    /// symmetric in every bit.
    fn transpose_lower(&mut self) {
        let (row_start, columns) = (&self.row_start, &self.columns);
        split_rows(&mut self.blocks, row_start, 64).into_par_iter().for_each(|part| {
            let first = row_start[part.rows.start];
            for i in part.rows.clone() {
                for k in row_start[i]..row_start[i + 1] {
                    let block = &mut part.data[k - first];
                    let j = columns[k] as usize;
                    for r in 0..MODES {
                        for c in 0..r {
                            let (upper, lower) = (block[c][r], block[r][c]);
                            if j < i {
                                block[c][r] = lower;
                                block[r][c] = upper;
                            } else if j == i {
                                block[r][c] = upper;
                            }
                        }
                    }
                }
            }
        });
    }
}
