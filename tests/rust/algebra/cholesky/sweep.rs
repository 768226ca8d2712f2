//! Sweeps of the factor, whole and of some rows.

use std::sync::Arc;

use mtm_core::{BlockMatrix, Symbolic};

/// A grid of nodes coupled to their neighbours: positive definite, with 3×3 blocks that differ.
fn grid(n: usize) -> BlockMatrix {
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

/// One column shared by 1, 2 and 3 threads: bitwise identical, and equal to the result for several columns
/// at once; for dense and sparse right-hand sides, with and without rows kept last.
#[test]
fn sweeps_equal_those_of_several_columns_for_any_number_of_threads() {
    let n = 40;
    let matrix = grid(n);
    let tail: Vec<u32> = (0..n as u32).map(|i| n as u32 * i + 7).collect();
    for (tail, every) in [(&tail[..], 1), (&[], 1), (&tail, 400), (&[], 400)] {
        let symbolic = Arc::new(Symbolic::new(&matrix, tail).unwrap());
        let factor = symbolic.factor(&matrix).unwrap();
        let sweep = factor.sweep().with_threads_from(1000).unwrap();
        let force = |j: usize| if j.is_multiple_of(every) { (j as f64).cos() } else { 0.0 };
        let b: Vec<[f64; 3]> = (0..n * n).map(|j| [force(j), 0.0, -force(j)]).collect();
        let answers = [1, 2, 3].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut x = factor.permuted(&b);
            pool.install(|| {
                sweep.forward(&mut x);
                sweep.backward(&mut x);
            });
            factor.unpermuted(&x)
        });
        assert!(answers[0] == answers[1] && answers[0] == answers[2]);
        let mut several = vec![b.clone(), b];
        factor.solve_many(&mut several);
        let largest = several[0].as_flattened().iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        for (v, w) in answers[0].as_flattened().iter().zip(several[0].as_flattened()) {
            assert!((v - w).abs() <= 1e-13 * largest, "{v:e} {w:e}");
        }
    }
}

/// Rows anywhere in the order, and rows kept last that are free: what both do under forces, and with more forces
/// on the former, equals whole solutions.
#[test]
fn responses_of_some_rows_equal_whole_solutions() {
    let n = 40;
    let matrix = grid(n);
    let tail: Vec<u32> = (0..n as u32).map(|i| n as u32 * i + 7).collect();
    let chosen: Vec<u32> = (0..n as u32).rev().map(|i| n as u32 * i + 2 * (i % 3)).collect();
    for tail in [&tail[..], &[]] {
        let symbolic = Arc::new(Symbolic::new(&matrix, tail).unwrap());
        let factor = symbolic.factor(&matrix).unwrap();
        let flexibility = factor.flexibility(&chosen, &[]).unwrap();
        let mut b: Vec<[f64; 3]> =
            (0..n * n).map(|j| [(j as f64).cos(), 1.0, (2.0 * j as f64).sin()]).collect();
        let forces: Vec<[f64; 3]> = (0..n).map(|j| [0.0, j as f64, -1.0]).collect();
        let mut swept = factor.swept(&b);
        let moved = factor.of_rows(swept.clone(), &chosen);
        let lifted = flexibility.lifted_by(factor.on_tail(&swept));
        let mut at_chosen = flexibility.following(moved, &lifted);
        same(&at_chosen, &of(&chosen, &factor.solve(&b)));
        factor.push(&chosen, &forces, &mut swept);
        let lifted = flexibility.lifted_by(factor.on_tail(&swept));
        let found = factor.above_tail(swept, &lifted);
        for ((to, more), (&row, f)) in
            at_chosen.iter_mut().zip(flexibility.respond(&forces)).zip(chosen.iter().zip(&forces))
        {
            *to = [0, 1, 2].map(|axis| to[axis] + more[axis]);
            for (b, f) in b[row as usize].iter_mut().zip(f) {
                *b += f;
            }
        }
        let whole = factor.solve(&b);
        same(&found, &whole);
        same(&at_chosen, &of(&chosen, &whole));
    }
}

fn of(rows: &[u32], all: &[[f64; 3]]) -> Vec<[f64; 3]> {
    rows.iter().map(|&row| all[row as usize]).collect()
}

fn same(found: &[[f64; 3]], whole: &[[f64; 3]]) {
    let largest = whole.as_flattened().iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    for (v, w) in found.as_flattened().iter().zip(whole.as_flattened()) {
        assert!((v - w).abs() <= 1e-12 * largest, "{v:e} {w:e}");
    }
}
