//! The Galerkin product, in double precision throughout.

use rayon::prelude::*;

use crate::algebra::blocks::running_sum;
use crate::algebra::simd::{Kernel, widest};

use super::block_rows::{SystemRows, split_rows};
use super::prolongator::{Prolongator, TransposedIndex};
use super::rigid_modes::{MODES, ModeBlock};
use super::small_blocks::add_transposed_product;

/// A row that has no place in a [`Sums`].
const UNSEEN: u32 = u32::MAX;
/// Coarse rows per parallel task: with about 25 blocks in a row, its result stays below the size from which the
/// system's allocator maps fresh pages for each request.
const ROWS_PER_TASK: usize = 16;

/// A symmetric coarse matrix in double precision, of which the upper triangle is stored; kept only until the next
/// level is built.
#[derive(Debug)]
pub(super) struct CoarseMatrix {
    pub(super) row_start: Vec<usize>,
    pub(super) columns: Vec<u32>,
    places: Vec<BlockPlace>,
    upper: Vec<UpperRows>,
    diagonal: Vec<usize>,
}

/// Where a block stands in the upper triangle.
#[derive(Debug, Clone, Copy)]
struct BlockPlace {
    task: u32,
    offset: u32,
    /// Whether the block is below the diagonal, and the transpose of the stored one.
    is_below: bool,
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
        let BlockPlace { task, offset, is_below } = self.places[position];
        let block = &self.upper[task as usize].blocks[offset as usize];
        if is_below { transposed_block(block) } else { *block }
    }
    fn diagonal(&self, row: usize) -> usize {
        self.diagonal[row]
    }
}

/// P'ᵀ A P', of which the upper triangle is summed.
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
    in_order(p.n_coarse, upper)
}

/// Rows of the upper triangle, columns in any order.
#[derive(Debug)]
struct UpperRows {
    lengths: Vec<usize>,
    columns: Vec<u32>,
    blocks: Vec<ModeBlock>,
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
            *place = self.rows.len() as u32;
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
        };
        for coarse in rows {
            for t in transposed.start[coarse]..transposed.start[coarse + 1] {
                let i = transposed.rows[t] as usize;
                let block = &p.blocks[transposed.positions[t] as usize];
                for k in row_start[i]..row_start[i + 1] {
                    add_transposed_product(images.at(columns[k]), &a.block(k), block);
                }
            }
            for (&j, image) in images.rows.iter().zip(&images.blocks) {
                for l in p.row_start[j as usize]..p.row_start[j as usize + 1] {
                    let column = p.columns[l];
                    if column as usize >= coarse {
                        add_transposed_product(products.at(column), image, &p.blocks[l]);
                    }
                }
            }
            upper.lengths.push(products.rows.len());
            upper.columns.extend_from_slice(&products.rows);
            blocks.extend_from_slice(&products.blocks);
            if let Some(diagonal) = products.rows.iter().position(|&j| j as usize == coarse) {
                let at = blocks.len() - products.rows.len() + diagonal;
                make_symmetric(&mut blocks[at]);
            }
            images.clear();
            products.clear();
        }
        upper.blocks = blocks.clone();
        upper
    }
}

/// The whole matrix, columns ascending, from its upper triangle.
fn in_order(n: usize, upper: Vec<UpperRows>) -> CoarseMatrix {
    let mut sizes: Vec<usize> = upper.iter().flat_map(|rows| &rows.lengths).copied().collect();
    for_each_block(&upper, |i, j, _| {
        if j != i {
            sizes[j] += 1;
        }
    });
    let row_start = running_sum(sizes);
    let mut entries =
        vec![(0_u32, BlockPlace { task: 0, offset: 0, is_below: false }); row_start[n]];
    let mut next = row_start.clone();
    for_each_block(&upper, |i, j, place| {
        entries[next[i]] = (j as u32, place);
        next[i] += 1;
        if j != i {
            entries[next[j]] = (i as u32, BlockPlace { is_below: true, ..place });
            next[j] += 1;
        }
    });
    split_rows(&mut entries, &row_start, ROWS_PER_TASK).into_par_iter().for_each(|part| {
        let first = row_start[part.rows.start];
        for i in part.rows {
            part.data[row_start[i] - first..row_start[i + 1] - first]
                .sort_unstable_by_key(|entry| entry.0);
        }
    });
    let (columns, places): (Vec<u32>, Vec<BlockPlace>) = entries.into_iter().unzip();
    let diagonal = (0..n)
        .map(|i| {
            let row = &columns[row_start[i]..row_start[i + 1]];
            row_start[i] + row.partition_point(|&j| (j as usize) < i)
        })
        .collect();
    CoarseMatrix { row_start, columns, places, upper, diagonal }
}

/// Calls `visit` with row, column and place of every block of the upper triangle.
fn for_each_block(upper: &[UpperRows], mut visit: impl FnMut(usize, usize, BlockPlace)) {
    let mut row = 0;
    for (task, rows) in upper.iter().enumerate() {
        let mut offset = 0;
        for &length in &rows.lengths {
            for &column in &rows.columns[offset..offset + length] {
                let place =
                    BlockPlace { task: task as u32, offset: offset as u32, is_below: false };
                visit(row, column as usize, place);
                offset += 1;
            }
            row += 1;
        }
    }
}

/// Copies the upper triangle of a diagonal block to the lower one: symmetric in every bit.
fn make_symmetric(block: &mut ModeBlock) {
    for r in 0..MODES {
        for c in 0..r {
            block[r][c] = block[c][r];
        }
    }
}

#[inline(always)]
fn transposed_block(block: &ModeBlock) -> ModeBlock {
    let mut out = [[0.0; MODES]; MODES];
    for r in 0..MODES {
        for c in 0..MODES {
            out[r][c] = block[c][r];
        }
    }
    out
}
