//! Sparse symmetric matrices of 3×3 blocks in block rows: the system that every solver shares.

use rayon::prelude::*;

/// A 3×3 block, row by row.
pub type Block = [f64; 9];

/// Rows a parallel product hands to a thread at once: large enough to hide the hand-over.
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

    /// Adds `stiffness` n⊗n to the diagonal block of row `j`.
    pub fn add_to_diagonal(&mut self, j: usize, n: [f64; 3], stiffness: f64) {
        let block = &mut self.blocks[self.diagonal[j]];
        for r in 0..3 {
            for c in 0..3 {
                block[3 * r + c] += stiffness * n[r] * n[c];
            }
        }
    }

    /// `y = A x`, parallel over rows; each row sums in column order, so the bits do not depend on threads.
    pub fn multiply_into(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) {
        y.par_chunks_mut(ROWS_PER_TASK).enumerate().for_each(|(chunk, rows)| {
            for (offset, out) in rows.iter_mut().enumerate() {
                *out = self.row_product(chunk * ROWS_PER_TASK + offset, x);
            }
        });
    }

    /// `A x`.
    pub fn multiply(&self, x: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut y = vec![[0.0; 3]; x.len()];
        self.multiply_into(x, &mut y);
        y
    }

    /// Row `j` of `A x`.
    pub fn row_product(&self, j: usize, x: &[[f64; 3]]) -> [f64; 3] {
        let (columns, blocks) = self.row(j);
        let mut sum = [0.0; 3];
        for (&k, b) in columns.iter().zip(blocks) {
            let v = x[k as usize];
            sum[0] += b[0] * v[0] + b[1] * v[1] + b[2] * v[2];
            sum[1] += b[3] * v[0] + b[4] * v[1] + b[5] * v[2];
            sum[2] += b[6] * v[0] + b[7] * v[1] + b[8] * v[2];
        }
        sum
    }
}
