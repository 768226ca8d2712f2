//! Sums over the rows of vectors, bitwise identical for any number of threads.

use rayon::prelude::*;

use crate::algebra::blocks::BlockMatrix;

/// Rows in one partial sum: fixed, so that a dot product is bitwise identical for any number of threads.
pub(crate) const ROWS_PER_SUM: usize = 1024;

/// Runs `f` on a thread of the pool, so that the parallel loops inside start without a hand-over.
pub(crate) fn in_pool<R: Send>(f: impl FnOnce() -> R + Send) -> R {
    rayon::scope(|_| f())
}

/// `xᵀy`, summed in fixed chunks.
pub(crate) fn dot<const N: usize>(x: &[[f64; N]], y: &[[f64; N]]) -> f64 {
    let chunks = x.par_chunks(ROWS_PER_SUM).zip(y.par_chunks(ROWS_PER_SUM));
    in_order(chunks.map(|(x, y)| chunk_dot(x, y)))
}

/// The sum of `parts`, added in their order.
fn in_order(parts: impl IndexedParallelIterator<Item = f64>) -> f64 {
    parts.collect::<Vec<f64>>().iter().sum()
}

fn chunk_dot<const N: usize>(x: &[[f64; N]], y: &[[f64; N]]) -> f64 {
    let mut sums = [0.0; N];
    for (x, y) in x.iter().zip(y) {
        for i in 0..N {
            sums[i] += x[i] * y[i];
        }
    }
    sums.iter().sum()
}

/// `rᵀz` and the largest Euclidean row norm of `z`.
pub(crate) fn dot_and_largest(r: &[[f64; 3]], z: &[[f64; 3]]) -> (f64, f64) {
    let partial: Vec<(f64, f64)> = r
        .par_chunks(ROWS_PER_SUM)
        .zip(z.par_chunks(ROWS_PER_SUM))
        .map(|(r, z)| {
            let largest = z.iter().fold(0.0, |m: f64, z| {
                let square = z[0] * z[0] + z[1] * z[1] + z[2] * z[2];
                if square > m || square.is_nan() { square } else { m }
            });
            (chunk_dot(r, z), largest)
        })
        .collect();
    let sum = partial.iter().map(|p| p.0).sum();
    let largest =
        partial.iter().fold(0.0, |m: f64, p| if p.1 > m || p.1.is_nan() { p.1 } else { m });
    (sum, largest.sqrt())
}

/// Largest Euclidean distance between the rows of `x` and `y`; NaN if one of them is.
pub(crate) fn farthest(x: &[[f64; 3]], y: &[[f64; 3]]) -> f64 {
    let most = |m: f64, d: f64| if d > m || d.is_nan() { d } else { m };
    let partial: Vec<f64> = x
        .par_chunks(ROWS_PER_SUM)
        .zip(y.par_chunks(ROWS_PER_SUM))
        .map(|(x, y)| {
            x.iter().zip(y).fold(0.0, |m, (x, y)| {
                most(m, (0..3).map(|i| (x[i] - y[i]) * (x[i] - y[i])).sum::<f64>())
            })
        })
        .collect();
    partial.into_iter().fold(0.0, most).sqrt()
}

/// `q = A p` and `pᵀq` in one sweep.
pub(crate) fn multiply_and_dot(a: &BlockMatrix, p: &[[f64; 3]], q: &mut [[f64; 3]]) -> f64 {
    in_order(q.par_chunks_mut(ROWS_PER_SUM).enumerate().map(|(chunk, q)| {
        let first = chunk * ROWS_PER_SUM;
        a.multiply_rows(first, p, q);
        chunk_dot(&p[first..first + q.len()], q)
    }))
}

/// `x += α p`, `r −= α q`; returns `rᵀr`.
pub(crate) fn advance(
    alpha: f64,
    p: &[[f64; 3]],
    q: &[[f64; 3]],
    x: &mut [[f64; 3]],
    r: &mut [[f64; 3]],
) -> f64 {
    let directions = p.par_chunks(ROWS_PER_SUM).zip(q.par_chunks(ROWS_PER_SUM));
    let rows = x.par_chunks_mut(ROWS_PER_SUM).zip(r.par_chunks_mut(ROWS_PER_SUM));
    in_order(rows.zip(directions).map(|((x, r), (p, q))| {
        for (((x, r), p), q) in x.iter_mut().zip(r.iter_mut()).zip(p).zip(q) {
            for i in 0..3 {
                x[i] += alpha * p[i];
                r[i] -= alpha * q[i];
            }
        }
        chunk_dot(r, r)
    }))
}
