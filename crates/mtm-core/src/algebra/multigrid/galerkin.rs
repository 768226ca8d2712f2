//! The Galerkin product, in double precision throughout.

use rayon::prelude::*;

use crate::algebra::simd::{Kernel, widest};

use super::block_rows::{SystemRows, row_index, running_sum, split_rows};
use super::prolongator::{Prolongator, TransposedIndex};
use super::rigid_modes::{MODES, ModeBlock};
use super::small_blocks::add_transposed_product;

/// A row that has no place in a [`Sums`].
const UNSEEN: u32 = u32::MAX;
/// Coarse rows per parallel task: with about 25 blocks in a row, its result stays below the size from which the
/// system's allocator maps fresh pages for each request.
const ROWS_PER_TASK: usize = 16;

/// A coarse matrix in double precision, kept only until the next level is built.
#[derive(Debug)]
pub(super) struct CoarseMatrix {
    pub(super) row_start: Vec<usize>,
    pub(super) columns: Vec<u32>,
    pub(super) blocks: Vec<ModeBlock>,
    diagonal: Vec<usize>,
    /// Operations of the product.
    pub(super) flops: usize,
}

impl SystemRows<MODES> for CoarseMatrix {
    fn row_start(&self) -> &[usize] {
        &self.row_start
    }
    fn columns(&self) -> &[u32] {
        &self.columns
    }
    #[inline(always)]
    fn block(&self, position: usize) -> ModeBlock {
        self.blocks[position]
    }
    fn diagonal(&self, row: usize) -> usize {
        self.diagonal[row]
    }
}

/// P'ᵀ A P'. The upper triangle is summed and the lower one mirrored, so that the result is symmetric in every
/// bit.
///
/// Row I is summed as Σ_j V_jᵀ P'_jJ with V_j = Σ_i A_ijᵀ P'_iI: the V_j of one row fit into the caches of one
/// thread, and A P' is never stored.
pub(super) fn galerkin<const N: usize, A: SystemRows<N>>(
    a: &A,
    p: &Prolongator<N>,
    transposed: &TransposedIndex,
) -> CoarseMatrix {
    let tasks = p.n_coarse.div_ceil(ROWS_PER_TASK);
    let upper: Vec<UpperRows> = (0..tasks)
        .into_par_iter()
        .map_init(
            || Scratch {
                images: Sums::new(a.n_rows()),
                products: Sums::new(p.n_coarse),
                blocks: Vec::new(),
            },
            |scratch, task| {
                let first = task * ROWS_PER_TASK;
                let rows = first..p.n_coarse.min(first + ROWS_PER_TASK);
                widest(Product { a, p, transposed, rows, scratch })
            },
        )
        .collect();
    mirror(p.n_coarse, &upper)
}

/// Rows of the upper triangle, columns in any order.
struct UpperRows {
    lengths: Vec<usize>,
    columns: Vec<u32>,
    blocks: Vec<ModeBlock>,
    flops: usize,
}

/// A sparse column of R×6 blocks that is being summed.
struct Sums<const R: usize> {
    /// Place of each row in `blocks`, or [`UNSEEN`].
    place: Vec<u32>,
    rows: Vec<u32>,
    blocks: Vec<[[f64; MODES]; R]>,
}

impl<const R: usize> Sums<R> {
    fn new(n_rows: usize) -> Self {
        Self { place: vec![UNSEEN; n_rows], rows: Vec::new(), blocks: Vec::new() }
    }

    /// The block of `row`, zero at first.
    #[inline(always)]
    fn at(&mut self, row: u32) -> &mut [[f64; MODES]; R] {
        let place = &mut self.place[row as usize];
        if *place == UNSEEN {
            *place = row_index(self.rows.len());
            self.rows.push(row);
            self.blocks.push([[0.0; MODES]; R]);
        }
        &mut self.blocks[*place as usize]
    }

    fn clear(&mut self) {
        for &row in &self.rows {
            self.place[row as usize] = UNSEEN;
        }
        self.rows.clear();
        self.blocks.clear();
    }
}

/// Buffers of one thread.
struct Scratch<const N: usize> {
    /// V_j of one row.
    images: Sums<N>,
    /// One row of the product.
    products: Sums<MODES>,
    /// The rows of one task: a buffer that grows with every task would ask for memory again and again.
    blocks: Vec<ModeBlock>,
}

/// A range of rows of the upper triangle of the product.
struct Product<'a, const N: usize, A: SystemRows<N>> {
    a: &'a A,
    p: &'a Prolongator<N>,
    transposed: &'a TransposedIndex,
    rows: std::ops::Range<usize>,
    scratch: &'a mut Scratch<N>,
}

impl<const N: usize, A: SystemRows<N>> Kernel for Product<'_, N, A> {
    type Output = UpperRows;
    #[inline(always)]
    fn run(self) -> UpperRows {
        let Self { a, p, transposed, rows, scratch } = self;
        let Scratch { images, products, blocks } = scratch;
        let (row_start, columns) = (a.row_start(), a.columns());
        blocks.clear();
        let mut upper = UpperRows {
            lengths: Vec::with_capacity(rows.len()),
            columns: Vec::new(),
            blocks: Vec::new(),
            flops: 0,
        };
        let (mut fine_products, mut coarse_products) = (0, 0);
        for coarse in rows {
            for t in transposed.start[coarse]..transposed.start[coarse + 1] {
                let i = transposed.rows[t] as usize;
                let block = &p.blocks[transposed.positions[t] as usize];
                fine_products += row_start[i + 1] - row_start[i];
                for k in row_start[i]..row_start[i + 1] {
                    add_transposed_product(images.at(columns[k]), &a.block(k), block);
                }
            }
            for (&j, image) in images.rows.iter().zip(&images.blocks) {
                for l in p.row_start[j as usize]..p.row_start[j as usize + 1] {
                    let column = p.columns[l];
                    if column as usize >= coarse {
                        coarse_products += 1;
                        add_transposed_product(products.at(column), image, &p.blocks[l]);
                    }
                }
            }
            upper.lengths.push(products.rows.len());
            upper.columns.extend_from_slice(&products.rows);
            blocks.extend_from_slice(&products.blocks);
            images.clear();
            products.clear();
        }
        upper.flops = 2 * MODES * N * (N * fine_products + MODES * coarse_products);
        upper.blocks = blocks.clone();
        upper
    }
}

/// The full matrix, columns ascending, from its upper triangle.
fn mirror(n: usize, upper: &[UpperRows]) -> CoarseMatrix {
    let lengths: Vec<usize> = upper.iter().flat_map(|rows| &rows.lengths).copied().collect();
    let upper_start = running_sum(&lengths);
    let upper_columns: Vec<u32> = upper.iter().flat_map(|rows| &rows.columns).copied().collect();
    let mut sizes = lengths;
    for i in 0..n {
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
    let mut columns = vec![0_u32; row_start[n]];
    let mut blocks = vec![[[0.0; MODES]; MODES]; row_start[n]];
    split_rows(&mut sources, &row_start, ROWS_PER_TASK)
        .into_par_iter()
        .zip(split_rows(&mut columns, &row_start, ROWS_PER_TASK))
        .zip(split_rows(&mut blocks, &row_start, ROWS_PER_TASK))
        .for_each(|((sources, columns), blocks)| {
            let first = row_start[sources.rows.start];
            for i in sources.rows.clone() {
                let range = row_start[i] - first..row_start[i + 1] - first;
                sources.data[range.clone()].sort_unstable_by_key(|source| source.0);
                for k in range {
                    let (column, position) = sources.data[k];
                    let task = i.min(column as usize) / ROWS_PER_TASK;
                    let offset = upper_start[task * ROWS_PER_TASK];
                    let block = &upper[task].blocks[position as usize - offset];
                    columns.data[k] = column;
                    blocks.data[k] = mirrored(block, i, column as usize);
                }
            }
        });
    let diagonal = (0..n)
        .map(|i| {
            let row = &columns[row_start[i]..row_start[i + 1]];
            row_start[i] + row.partition_point(|&j| (j as usize) < i)
        })
        .collect();
    let flops = upper.iter().map(|rows| rows.flops).sum();
    CoarseMatrix { row_start, columns, blocks, diagonal, flops }
}

/// The block at row `i`, column `j`, from the one in the upper triangle: transposed below the diagonal, and on
/// it symmetric in every bit.
fn mirrored(upper: &ModeBlock, i: usize, j: usize) -> ModeBlock {
    let mut block = *upper;
    for r in 0..MODES {
        for c in 0..MODES {
            if j < i || (j == i && c < r) {
                block[r][c] = upper[c][r];
            }
        }
    }
    block
}
