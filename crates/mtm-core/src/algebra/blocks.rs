//! Sparse symmetric matrices of 3×3 blocks in block rows: the system that every solver shares.

use rayon::prelude::*;

use crate::algebra::simd::{Kernel, LANES, add_products, whole_lanes, widest};

/// A 3×3 block, row by row.
pub type Block = [f64; 9];

/// Rows per parallel task of a product: enough to hide the cost of the hand-over.
const ROWS_PER_TASK: usize = 512;

/// Square sparse matrix of 3×3 blocks, both triangles stored, columns ascending in each row.
#[derive(Debug, Clone)]
pub struct BlockMatrix {
    /// First block of each row; one more entry than rows.
    pub row_start: Vec<usize>,
    /// Column of each block, ascending within a row.
    pub columns: Vec<u32>,
    /// The blocks, in the order of `columns`.
    pub blocks: Vec<Block>,
    /// Position of the diagonal block of each row in `blocks`.
    pub diagonal: Vec<usize>,
}

/// A run of rows whose blocks one thread may write.
pub struct RowTask<'a> {
    /// First row of the run.
    pub first: usize,
    /// Row starts of the run, one more than rows, as in the whole matrix.
    pub start: &'a [usize],
    /// Columns of the run.
    pub columns: &'a [u32],
    /// Blocks of the run.
    pub blocks: &'a mut [Block],
}

impl BlockMatrix {
    /// The zero matrix on a pattern with ascending columns that holds every diagonal.
    pub fn from_pattern(row_start: Vec<usize>, columns: Vec<u32>) -> Self {
        let diagonal = row_start
            .windows(2)
            .enumerate()
            .map(|(j, w)| w[0] + columns[w[0]..w[1]].partition_point(|&k| (k as usize) < j))
            .collect();
        let blocks = vec![[0.0; 9]; columns.len()];
        Self { row_start, columns, blocks, diagonal }
    }

    /// Runs of rows that cover the matrix, to be filled in parallel.
    pub fn row_tasks(&mut self) -> Vec<RowTask<'_>> {
        let n = self.row_start.len() - 1;
        let (mut tasks, mut rest) = (Vec::new(), &mut self.blocks[..]);
        for first in (0..n).step_by(ROWS_PER_TASK) {
            let start = &self.row_start[first..=n.min(first + ROWS_PER_TASK)];
            let (begin, end) = (start[0], start[start.len() - 1]);
            let (blocks, tail) = rest.split_at_mut(end - begin);
            rest = tail;
            tasks.push(RowTask { first, start, columns: &self.columns[begin..end], blocks });
        }
        tasks
    }

    /// Calls `fill` with the number, columns and blocks of each row, in parallel.
    pub(crate) fn fill_rows(&mut self, fill: impl Fn(usize, &[u32], &mut [Block]) + Sync) {
        self.row_tasks().into_par_iter().for_each(|task| {
            for (offset, window) in task.start.windows(2).enumerate() {
                let row = window[0] - task.start[0]..window[1] - task.start[0];
                fill(task.first + offset, &task.columns[row.clone()], &mut task.blocks[row]);
            }
        });
    }

    /// Number of block rows.
    pub fn n_rows(&self) -> usize {
        self.row_start.len() - 1
    }

    /// Columns and blocks of row `j`.
    pub fn row(&self, j: usize) -> (&[u32], &[Block]) {
        let range = self.row_start[j]..self.row_start[j + 1];
        (&self.columns[range.clone()], &self.blocks[range])
    }

    /// Diagonal block of row `j`.
    pub fn diagonal_block(&self, j: usize) -> &Block {
        &self.blocks[self.diagonal[j]]
    }

    /// The block of row `j` in `column`, which the pattern holds.
    pub fn block_mut(&mut self, j: usize, column: u32) -> &mut Block {
        let first = self.row_start[j];
        let own = &self.columns[first..self.row_start[j + 1]];
        &mut self.blocks[first + own.partition_point(|&k| k < column)]
    }

    /// Adds `stiffness` n⊗n to the diagonal block of row `j`.
    pub fn add_to_diagonal(&mut self, j: usize, n: [f64; 3], stiffness: f64) {
        let block = &mut self.blocks[self.diagonal[j]];
        for r in 0..3 {
            for c in 0..3 {
                block[3 * r + c] += stiffness * n[r] * n[c];
            }
        }
    }

    /// `y = A x`, parallel over rows; each row is summed in column order, so the result is bitwise identical
    /// for any number of threads.
    pub fn multiply_into(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) {
        y.par_chunks_mut(ROWS_PER_TASK).enumerate().for_each(|(chunk, rows)| {
            self.multiply_rows(chunk * ROWS_PER_TASK, x, rows);
        });
    }

    /// `A x`.
    pub fn multiply(&self, x: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut y = vec![[0.0; 3]; x.len()];
        self.multiply_into(x, &mut y);
        y
    }

    /// The rows of `A x` from `first` on, as many as `out` has, on this thread.
    pub(crate) fn multiply_rows(&self, first: usize, x: &[[f64; 3]], out: &mut [[f64; 3]]) {
        widest(RowProducts { matrix: self, first, x, out });
    }

    /// Row `j` of `A x`.
    #[inline(always)]
    pub fn row_product(&self, j: usize, x: &[[f64; 3]]) -> [f64; 3] {
        let (columns, blocks) = self.row(j);
        // One sum per row of the block, with the components of x in its lanes. The fourth lane is loaded
        // because the memory exists, and dropped at the end; the last row does so with its first lane.
        let mut sums = [[0.0; LANES]; 3];
        for (&k, b) in columns.iter().zip(blocks) {
            let v = x[k as usize];
            let (head, tail) = ([v[0], v[1], v[2], 0.0], [0.0, v[0], v[1], v[2]]);
            add_products(&mut sums[0], [b[0], b[1], b[2], b[3]], head);
            add_products(&mut sums[1], [b[3], b[4], b[5], b[6]], head);
            add_products(&mut sums[2], [b[5], b[6], b[7], b[8]], tail);
        }
        let sums = whole_lanes(sums);
        [
            sums[0][0] + sums[0][1] + sums[0][2],
            sums[1][0] + sums[1][1] + sums[1][2],
            sums[2][1] + sums[2][2] + sums[2][3],
        ]
    }
}

/// A range of rows of a product.
struct RowProducts<'a> {
    matrix: &'a BlockMatrix,
    first: usize,
    x: &'a [[f64; 3]],
    out: &'a mut [[f64; 3]],
}

impl Kernel for RowProducts<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        for (offset, out) in self.out.iter_mut().enumerate() {
            *out = self.matrix.row_product(self.first + offset, self.x);
        }
    }
}

/// 0, c₀, c₀ + c₁, …
pub(crate) fn running_sum(counts: impl IntoIterator<Item = usize>) -> Vec<usize> {
    let ends = counts.into_iter().scan(0, |sum, count| {
        *sum += count;
        Some(*sum)
    });
    std::iter::once(0).chain(ends).collect()
}
