//! Arrays and matrices in block rows, split into runs of rows that threads fill in parallel.

use std::ops::Range;

use crate::algebra::blocks::BlockMatrix;

/// Entries (blocks × rows × columns) per parallel task.
pub(super) const ENTRIES_PER_TASK: usize = 64 * 1024;

/// A square f64 matrix of N×N blocks in rows, from which the levels are built.
pub(super) trait SystemRows<const N: usize>: Sync {
    fn row_start(&self) -> &[usize];
    fn columns(&self) -> &[u32];
    fn block(&self, position: usize) -> [[f64; N]; N];
    fn diagonal(&self, row: usize) -> usize;
    fn n_rows(&self) -> usize {
        self.row_start().len() - 1
    }
}

impl SystemRows<3> for BlockMatrix {
    fn row_start(&self) -> &[usize] {
        &self.row_start
    }
    fn columns(&self) -> &[u32] {
        &self.columns
    }
    #[inline(always)]
    fn block(&self, position: usize) -> [[f64; 3]; 3] {
        let b = &self.blocks[position];
        [[b[0], b[1], b[2]], [b[3], b[4], b[5]], [b[6], b[7], b[8]]]
    }
    fn diagonal(&self, row: usize) -> usize {
        self.diagonal[row]
    }
}

/// Rows `rows` of an array in block rows.
pub(super) struct RowsPart<'a, T> {
    pub(super) rows: Range<usize>,
    pub(super) data: &'a mut [T],
}

/// Splits an array in block rows into parts of `rows_per_part` rows, to be filled in parallel.
pub(super) fn split_rows<'a, T>(
    data: &'a mut [T],
    row_start: &[usize],
    rows_per_part: usize,
) -> Vec<RowsPart<'a, T>> {
    let n = row_start.len() - 1;
    let mut parts = Vec::with_capacity(n / rows_per_part + 1);
    let mut rest = data;
    let mut first = 0;
    while first < n {
        let end = (first + rows_per_part).min(n);
        let (part, after) = rest.split_at_mut(row_start[end] - row_start[first]);
        parts.push(RowsPart { rows: first..end, data: part });
        rest = after;
        first = end;
    }
    parts
}
