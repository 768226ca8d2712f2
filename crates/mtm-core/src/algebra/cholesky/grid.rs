//! The matrix that the tests of this folder factorise.

use crate::algebra::blocks::BlockMatrix;

/// A grid of nodes coupled to their neighbours: positive definite, with 3×3 blocks that differ.
pub fn grid(n: usize) -> BlockMatrix {
    let (mut start, mut columns) = (vec![0], Vec::new());
    for j in 0..n * n {
        let (r, c) = (j / n, j % n);
        let near = |a: usize, b: usize| a.abs_diff(r) <= 1 && b.abs_diff(c) <= 1;
        columns.extend((0..n * n).filter(|k| near(k / n, k % n)).map(|k| k as u32));
        start.push(columns.len());
    }
    let mut matrix = BlockMatrix::from_pattern(start, columns);
    for j in 0..n * n {
        for at in matrix.row_start[j]..matrix.row_start[j + 1] {
            let k = matrix.columns[at] as usize;
            let (low, high) = (j.min(k), j.max(k));
            let mut block = [0, 1, 2, 3, 4, 5, 6, 7, 8]
                .map(|e| -1.0 / 3.0 + 0.1 * ((low * 31 + high * 7 + e) as f64).sin());
            if j > k {
                block = [0, 3, 6, 1, 4, 7, 2, 5, 8].map(|e: usize| block[e]);
            }
            if j == k {
                block = [11.0, 0.5, 0.2, 0.5, 12.0, -0.3, 0.2, -0.3, 13.0];
            }
            matrix.blocks[at] = block;
        }
    }
    matrix
}
