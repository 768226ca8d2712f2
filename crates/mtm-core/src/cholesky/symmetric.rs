//! Dense symmetric matrices by their lower triangle: product with a vector, and Cholesky factor.

use std::ops::Range;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_inverse::invert_lower_triangular;
use faer::{Accum, Mat, MatMut, MatRef};
use rayon::prelude::*;

use super::workspace::parallelism;
use crate::simd::{Kernel, LANES, widest};

/// Parts of a product that threads may share: fixed, so that the bits do not depend on the threads.
const PARTS: usize = 16;
/// Rows below which a product is not worth sharing.
const ROWS_TO_SHARE: usize = 512;
/// Columns that a product takes at once: one by one it would wait for its own vectors more than for the matrix.
const COLUMNS_AT_ONCE: usize = 4;
/// Sums that run side by side in a scalar product: the width of two vector registers.
const SUMS: usize = 8;

/// Dense symmetric matrix, lower triangle by columns.
pub struct DenseSymmetric {
    size: usize,
    /// Column by column, `size` each; what stands above the diagonal is not read.
    values: Vec<f64>,
}

/// L of A = L Lᵀ.
pub struct DenseFactor {
    size: usize,
    values: Vec<f64>,
}

impl DenseSymmetric {
    /// The matrix of `size` rows whose columns `fill` writes from the diagonal down, in parallel: it gets
    /// the column's number and its zeros.
    pub fn from_columns(size: usize, fill: impl Fn(usize, &mut [f64]) + Sync) -> Self {
        let mut values = vec![0.0; size * size];
        values
            .par_chunks_mut(size.max(1))
            .enumerate()
            .for_each(|(c, column)| fill(c, &mut column[c..]));
        Self { size, values }
    }

    /// The lower triangle of `values`, `size` columns of `size` entries.
    pub(super) fn from_lower(size: usize, values: Vec<f64>) -> Self {
        Self { size, values }
    }

    /// Number of rows.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        8 * self.values.len()
    }

    /// Column `c` from the diagonal down.
    #[inline(always)]
    pub fn column(&self, c: usize) -> &[f64] {
        &self.values[c * self.size + c..(c + 1) * self.size]
    }

    /// A x: each entry below the diagonal is read once and used twice.
    pub fn multiply(&self, x: &[f64]) -> Vec<f64> {
        let n = self.size;
        if n < ROWS_TO_SHARE {
            let mut y = vec![0.0; n];
            self.add_columns(0..n, x, &mut y);
            return y;
        }
        // Column c holds n − c entries: parts of equal area end where (n − c)² falls evenly.
        let end = |part: usize| {
            let left = (PARTS - part) as f64 / PARTS as f64;
            n - (n as f64 * left.sqrt()).round() as usize
        };
        let parts: Vec<(usize, Vec<f64>)> = (0..PARTS)
            .into_par_iter()
            .map(|part| {
                let (first, last) = (end(part), end(part + 1));
                let mut y = vec![0.0; n - first];
                self.add_columns(first..last, &x[first..], &mut y);
                (first, y)
            })
            .collect();
        let mut y = vec![0.0; n];
        for (first, part) in parts {
            for (y, v) in y[first..].iter_mut().zip(part) {
                *y += v;
            }
        }
        y
    }

    /// Adds what `columns` bring to A x; `x` and `y` begin at the first of them.
    fn add_columns(&self, columns: Range<usize>, x: &[f64], y: &mut [f64]) {
        widest(AddColumns { matrix: self, columns, x, y });
    }

    /// The Cholesky factor; the row of the first pivot that is not positive on failure.
    pub fn factor(self) -> Result<DenseFactor, usize> {
        let Self { size: n, mut values } = self;
        if n == 0 {
            return Ok(DenseFactor { size: n, values });
        }
        let par = parallelism(4 * n);
        let need = llt::factor::cholesky_in_place_scratch::<f64>(n, par, Default::default());
        let mut memory = MemBuffer::new(need);
        llt::factor::cholesky_in_place(
            MatMut::from_column_major_slice_mut(&mut values, n, n),
            Default::default(),
            par,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .map_err(|llt::factor::LltError::NonPositivePivot { index }| index)?;
        Ok(DenseFactor { size: n, values })
    }
}

/// Some columns of a product.
struct AddColumns<'a> {
    matrix: &'a DenseSymmetric,
    columns: Range<usize>,
    x: &'a [f64],
    y: &'a mut [f64],
}

impl Kernel for AddColumns<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { matrix, columns, x, y } = self;
        let (first, mut c) = (columns.start, columns.start);
        while c + COLUMNS_AT_ONCE <= columns.end {
            let (x, y) = (&x[c - first..], &mut y[c - first..]);
            // The triangle at the top of the columns, then the rows that all of them have.
            for k in 0..COLUMNS_AT_ONCE {
                let top = &matrix.column(c + k)[..COLUMNS_AT_ONCE - k];
                y[k] += top[0] * x[k];
                for (r, a) in (k + 1..).zip(&top[1..]) {
                    y[k] += a * x[r];
                    y[r] += a * x[k];
                }
            }
            let below = std::array::from_fn(|k| &matrix.column(c + k)[COLUMNS_AT_ONCE - k..]);
            let weights = std::array::from_fn(|k| x[k]);
            let (own, rest) = y.split_at_mut(COLUMNS_AT_ONCE);
            let sums = dots_and_add(below, &x[COLUMNS_AT_ONCE..], weights, rest);
            for (y, sum) in own.iter_mut().zip(sums) {
                *y += sum;
            }
            c += COLUMNS_AT_ONCE;
        }
        for c in c..columns.end {
            let column = matrix.column(c);
            let (x, y) = (&x[c - first..], &mut y[c - first..]);
            y[0] += column[0] * x[0];
            for (r, a) in (1..).zip(&column[1..]) {
                y[0] += a * x[r];
                y[r] += a * x[0];
            }
        }
    }
}

impl DenseFactor {
    /// The lower triangle of `values`, `size` columns of `size` entries.
    pub(super) fn from_lower(size: usize, values: Vec<f64>) -> Self {
        Self { size, values }
    }

    /// A⁻¹ = L⁻ᵀ L⁻¹: for many products, each of which reads it once where a solution reads L twice.
    pub fn inverse(&self) -> DenseSymmetric {
        let size = self.size;
        let par = parallelism(size);
        let lower = MatRef::from_column_major_slice(&self.values, size, size);
        let mut inverse = Mat::<f64>::zeros(size, size);
        invert_lower_triangular(inverse.as_mut(), lower, par);
        let mut values = vec![0.0; size * size];
        triangular::matmul(
            MatMut::from_column_major_slice_mut(&mut values, size, size),
            BlockStructure::TriangularLower,
            Accum::Replace,
            inverse.as_ref().transpose(),
            BlockStructure::TriangularUpper,
            inverse.as_ref(),
            BlockStructure::TriangularLower,
            1.0,
            par,
        );
        DenseSymmetric { size, values }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        8 * self.values.len()
    }

    /// A⁻¹ b, in place. One column is bound by reading L, which plain sweeps do at full speed.
    pub fn solve(&self, b: &mut [f64]) {
        let n = self.size;
        let column = |c: usize| &self.values[c * n + c..(c + 1) * n];
        for c in 0..n {
            let column = column(c);
            b[c] /= column[0];
            let weight = -b[c];
            add_scaled(&column[1..], weight, &mut b[c + 1..]);
        }
        for c in (0..n).rev() {
            let column = column(c);
            b[c] = (b[c] - dot(&column[1..], &b[c + 1..])) / column[0];
        }
    }
}

/// aᵀx.
#[inline(always)]
pub(super) fn dot(a: &[f64], x: &[f64]) -> f64 {
    let mut sums = [0.0; SUMS];
    let (a_lanes, a_rest) = a.as_chunks::<SUMS>();
    let (x_lanes, x_rest) = x.as_chunks::<SUMS>();
    for (a, x) in a_lanes.iter().zip(x_lanes) {
        for i in 0..SUMS {
            sums[i] += a[i] * x[i];
        }
    }
    let rest: f64 = a_rest.iter().zip(x_rest).map(|(a, x)| a * x).sum();
    sums.iter().sum::<f64>() + rest
}

/// Adds `weight · a` to `y`.
#[inline(always)]
pub(super) fn add_scaled(a: &[f64], weight: f64, y: &mut [f64]) {
    for (y, a) in y.iter_mut().zip(a) {
        *y += weight * a;
    }
}

/// Adds Σ `weights` · `a` to `y` and gives each aᵀx, in one pass over all: x and y are read once for the four.
#[inline(always)]
fn dots_and_add(
    a: [&[f64]; COLUMNS_AT_ONCE],
    x: &[f64],
    weights: [f64; COLUMNS_AT_ONCE],
    y: &mut [f64],
) -> [f64; COLUMNS_AT_ONCE] {
    let mut sums = [[0.0; LANES]; COLUMNS_AT_ONCE];
    let lanes = a.map(|a| a.as_chunks::<LANES>());
    let (x_lanes, x_rest) = x.as_chunks::<LANES>();
    let (y_lanes, y_rest) = y.as_chunks_mut::<LANES>();
    for (i, (x, y)) in x_lanes.iter().zip(y_lanes).enumerate() {
        for k in 0..COLUMNS_AT_ONCE {
            let a = &lanes[k].0[i];
            for lane in 0..LANES {
                sums[k][lane] += a[lane] * x[lane];
                y[lane] += weights[k] * a[lane];
            }
        }
    }
    for (i, (x, y)) in x_rest.iter().zip(y_rest).enumerate() {
        for k in 0..COLUMNS_AT_ONCE {
            let a = lanes[k].1[i];
            sums[k][0] += a * x;
            *y += weights[k] * a;
        }
    }
    sums.map(|lanes| lanes.iter().sum())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// A diagonally dominant matrix of no special structure, its triangle and a right-hand side.
    fn example(n: usize) -> (DMatrix<f64>, DenseSymmetric, DVector<f64>) {
        let wave = |i: usize, j: usize| ((1 + i * j + i + j) as f64 * 0.37).sin();
        let dense = DMatrix::from_fn(n, n, |i, j| if i == j { n as f64 } else { wave(i, j) });
        let lower = DenseSymmetric::from_columns(n, |c, column| {
            for (r, v) in column.iter_mut().enumerate() {
                *v = dense[(c + r, c)];
            }
        });
        (dense, lower, DVector::from_fn(n, |i, _| wave(i, i)))
    }

    #[test]
    fn product_and_solution_equal_the_dense_ones() {
        for n in [1, 2, 7, 9, 100, ROWS_TO_SHARE + 13] {
            let (dense, lower, x) = example(n);
            let product = DVector::from_vec(lower.multiply(x.as_slice()));
            let exact = &dense * &x;
            assert!((product - &exact).amax() <= 1e-13 * exact.amax(), "{n}");
            let mut found = exact.as_slice().to_vec();
            lower.factor().unwrap().solve(&mut found);
            assert!((DVector::from_vec(found) - &x).amax() <= 1e-12, "{n}");
        }
    }

    #[test]
    fn product_has_the_same_bits_for_any_number_of_threads() {
        let (_, lower, x) = example(ROWS_TO_SHARE + 13);
        let answers = [1, 2, 3].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| lower.multiply(x.as_slice()))
        });
        assert!(answers[0] == answers[1] && answers[0] == answers[2]);
    }

    #[test]
    fn pivot_that_is_not_positive_is_named() {
        let lower = DenseSymmetric::from_columns(3, |c, column| {
            column[0] = if c == 1 { -1.0 } else { 1.0 };
        });
        assert_eq!(lower.factor().err(), Some(1));
    }
}
