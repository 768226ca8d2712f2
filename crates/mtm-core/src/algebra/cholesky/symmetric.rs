//! Dense symmetric matrices stored as their lower triangle: product with a vector, and Cholesky factor.

use std::iter::Sum;
use std::ops::{AddAssign, Mul, Range};

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_inverse::invert_lower_triangular;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, Mat, MatMut, MatRef};
use rayon::prelude::*;

use super::workspace::parallelism;
use crate::algebra::simd::{Kernel, LANES, widest};

/// Number of parts of a product that threads may share: fixed, so that the result does not depend on the number
/// of threads.
const PARTS: usize = 16;
/// Number of rows below which a product is not worth sharing.
pub const ROWS_TO_SHARE: usize = 512;
/// Columns that a product processes at once: one by one, it would spend more time on its vectors than on the
/// matrix.
pub(super) const COLUMNS_AT_ONCE: usize = 4;
/// Independent sums in a scalar product: the width of two vector registers.
const SUMS: usize = 8;

/// Number type of a product: doubles, or floats if reading half as much matters more.
pub trait Number: Copy + Default + Send + Sync + AddAssign + Mul<Output = Self> + Sum {
    /// Runs [`DotsAndAdd`] in as many lanes as a register has.
    fn dots_and_add(pass: DotsAndAdd<'_, Self>) -> [Self; COLUMNS_AT_ONCE];
    /// The nearest one.
    fn of(value: f64) -> Self;
}

impl Number for f64 {
    fn of(value: f64) -> Self {
        value
    }
    fn dots_and_add(pass: DotsAndAdd<'_, Self>) -> [Self; COLUMNS_AT_ONCE] {
        pass.in_lanes::<LANES>()
    }
}

impl Number for f32 {
    fn of(value: f64) -> Self {
        value as f32
    }
    fn dots_and_add(pass: DotsAndAdd<'_, Self>) -> [Self; COLUMNS_AT_ONCE] {
        pass.in_lanes::<{ 2 * LANES }>()
    }
}

/// Dense symmetric matrix, lower triangle by columns.
pub struct DenseSymmetric<T = f64> {
    size: usize,
    /// Column by column, each from the diagonal down.
    values: Vec<T>,
}

/// L of A = L Lᵀ.
pub struct DenseFactor {
    size: usize,
    /// Column by column, `size` each; entries above the diagonal are not read.
    values: Vec<f64>,
}

/// Where column `c` of a triangle of `size` columns begins.
#[inline(always)]
fn column_start(size: usize, c: usize) -> usize {
    c * (2 * size + 1 - c) / 2
}

impl DenseSymmetric {
    /// The lower triangle of `values`, `size` columns of `size` entries.
    fn from_square(size: usize, mut values: Vec<f64>) -> Self {
        for c in 0..size {
            values.copy_within(c * size + c..(c + 1) * size, column_start(size, c));
        }
        values.truncate(column_start(size, size));
        values.shrink_to_fit();
        Self { size, values }
    }

    /// Number of rows.
    pub fn size(&self) -> usize {
        self.size
    }

    /// The Cholesky factor; on failure, the row of the first pivot that is not positive.
    pub fn factor(self) -> Result<DenseFactor, usize> {
        let n = self.size;
        let mut values = vec![0.0; n * n];
        for c in 0..n {
            values[c * n + c..(c + 1) * n].copy_from_slice(self.column(c));
        }
        drop(self);
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

impl<T: Number> DenseSymmetric<T> {
    /// The matrix of `size` rows whose columns `fill` writes from the diagonal down, in parallel: `fill`
    /// receives the column index and a slice of zeros.
    pub fn from_columns(size: usize, fill: impl Fn(usize, &mut [T]) + Sync) -> Self {
        Self::from_columns_in(Vec::new(), size, fill)
    }

    /// The same in `values`, memory of an earlier matrix: `fill` receives what it holds.
    pub fn from_columns_in(
        mut values: Vec<T>,
        size: usize,
        fill: impl Fn(usize, &mut [T]) + Sync,
    ) -> Self {
        values.resize(column_start(size, size), T::default());
        let mut columns = Vec::with_capacity(size);
        let mut rest = &mut values[..];
        for c in 0..size {
            let (column, after) = rest.split_at_mut(size - c);
            columns.push(column);
            rest = after;
        }
        columns.into_par_iter().enumerate().for_each(|(c, column)| fill(c, column));
        Self { size, values }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.values[..])
    }

    /// Column `c` from the diagonal down.
    #[inline(always)]
    pub fn column(&self, c: usize) -> &[T] {
        let start = column_start(self.size, c);
        &self.values[start..start + self.size - c]
    }

    /// A x: each entry below the diagonal is read once and used twice.
    pub fn multiply(&self, x: &[T]) -> Vec<T> {
        let n = self.size;
        if n < ROWS_TO_SHARE {
            let mut y = vec![T::default(); n];
            self.add_columns(0..n, x, &mut y);
            return y;
        }
        // Column c holds n − c entries: parts of equal area end where (n − c)² decreases in equal steps.
        let end = |part: usize| {
            let left = (PARTS - part) as f64 / PARTS as f64;
            n - (n as f64 * left.sqrt()).round() as usize
        };
        let parts: Vec<(usize, Vec<T>)> = (0..PARTS)
            .into_par_iter()
            .map(|part| {
                let (first, last) = (end(part), end(part + 1));
                let mut y = vec![T::default(); n - first];
                self.add_columns(first..last, &x[first..], &mut y);
                (first, y)
            })
            .collect();
        let mut y = vec![T::default(); n];
        for (first, part) in parts {
            for (y, v) in y[first..].iter_mut().zip(part) {
                *y += v;
            }
        }
        y
    }

    /// Adds the contribution of `columns` to A x; `x` and `y` begin at the first of them.
    fn add_columns(&self, columns: Range<usize>, x: &[T], y: &mut [T]) {
        let (first, mut c) = (columns.start, columns.start);
        while c + COLUMNS_AT_ONCE <= columns.end {
            let (x, y) = (&x[c - first..], &mut y[c - first..]);
            // The triangle at the top of the columns, then the rows that all of them have.
            for k in 0..COLUMNS_AT_ONCE {
                let top = &self.column(c + k)[..COLUMNS_AT_ONCE - k];
                y[k] += top[0] * x[k];
                for (r, &a) in (k + 1..).zip(&top[1..]) {
                    y[k] += a * x[r];
                    y[r] += a * x[k];
                }
            }
            let a = std::array::from_fn(|k| &self.column(c + k)[COLUMNS_AT_ONCE - k..]);
            let weights = std::array::from_fn(|k| x[k]);
            let (own, y) = y.split_at_mut(COLUMNS_AT_ONCE);
            let sums = T::dots_and_add(DotsAndAdd { a, x: &x[COLUMNS_AT_ONCE..], weights, y });
            for (y, sum) in own.iter_mut().zip(sums) {
                *y += sum;
            }
            c += COLUMNS_AT_ONCE;
        }
        for c in c..columns.end {
            let column = self.column(c);
            let (x, y) = (&x[c - first..], &mut y[c - first..]);
            y[0] += column[0] * x[0];
            for (r, &a) in (1..).zip(&column[1..]) {
                y[0] += a * x[r];
                y[r] += a * x[0];
            }
        }
    }
}

/// A positive definite matrix in single precision: half as much to read.
pub struct Rough {
    /// Scaled to ones on the diagonal, so that its numbers are in range whatever the units.
    pub(super) matrix: DenseSymmetric<f32>,
    /// Square root of each diagonal entry.
    pub(super) scale: Vec<f64>,
}

impl Rough {
    /// The memory of the matrix, for another.
    pub fn into_memory(self) -> Vec<f32> {
        self.matrix.values
    }

    /// `matrix` to seven digits.
    pub fn of(matrix: &DenseSymmetric) -> Self {
        let n = matrix.size;
        let scale: Vec<f64> = (0..n).map(|c| matrix.column(c)[0].sqrt()).collect();
        let matrix = DenseSymmetric::from_columns(n, |c, column| {
            for ((to, v), s) in column.iter_mut().zip(matrix.column(c)).zip(&scale[c..]) {
                *to = (v / (s * scale[c])) as f32;
            }
        });
        Self { matrix, scale }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.matrix.bytes() + size_of_val(&self.scale[..])
    }

    /// A x to six or seven digits of the contribution of the largest entries.
    pub fn multiply(&self, x: &[f64]) -> Vec<f64> {
        let scaled = || x.iter().zip(&self.scale).map(|(x, s)| x * s);
        let largest = scaled().fold(f64::MIN_POSITIVE, |m, v| m.max(v.abs()));
        let x: Vec<f32> = scaled().map(|v| (v / largest) as f32).collect();
        let y = self.matrix.multiply(&x);
        y.iter().zip(&self.scale).map(|(&y, s)| f64::from(y) * (s * largest)).collect()
    }
}

impl DenseFactor {
    /// A⁻¹ = L⁻ᵀ L⁻¹: for many products, each of which reads it once, whereas a solution reads L twice.
    pub fn inverse(self) -> DenseSymmetric {
        let Self { size, mut values } = self;
        let par = parallelism(size);
        let lower = MatRef::from_column_major_slice(&values, size, size);
        let mut inverse = Mat::<f64>::zeros(size, size);
        invert_lower_triangular(inverse.as_mut(), lower, par);
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
        DenseSymmetric::from_square(size, values)
    }

    /// Bᵀ A⁻¹ B, for the columns of B one after the other.
    pub fn projected(&self, mut columns: Vec<f64>) -> DenseSymmetric {
        let size = columns.len() / self.size.max(1);
        let par = parallelism(self.size);
        // B ← L⁻¹ B, then Bᵀ B.
        let b = MatMut::from_column_major_slice_mut(&mut columns, self.size, size);
        solve_lower_triangular_in_place(self.lower(), b, par);
        let b = MatRef::from_column_major_slice(&columns, self.size, size);
        let mut values = vec![0.0; size * size];
        triangular::matmul(
            MatMut::from_column_major_slice_mut(&mut values, size, size),
            BlockStructure::TriangularLower,
            Accum::Replace,
            b.transpose(),
            BlockStructure::Rectangular,
            b,
            BlockStructure::Rectangular,
            1.0,
            par,
        );
        DenseSymmetric::from_square(size, values)
    }

    /// L; entries above the diagonal are not to be read.
    pub(super) fn lower(&self) -> MatRef<'_, f64> {
        MatRef::from_column_major_slice(&self.values, self.size, self.size)
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        8 * self.values.len()
    }

    /// A⁻¹ b, in place. The time for one column is that of reading L, which plain sweeps do at full speed.
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

/// Adds Σ `weights` · `a` to `y` and returns each aᵀx, in one pass over all: x and y are read once for all
/// four.
pub struct DotsAndAdd<'a, T> {
    pub(super) a: [&'a [T]; COLUMNS_AT_ONCE],
    pub(super) x: &'a [T],
    pub(super) weights: [T; COLUMNS_AT_ONCE],
    pub(super) y: &'a mut [T],
}

impl<T: Number> DotsAndAdd<'_, T> {
    fn in_lanes<const LANES: usize>(self) -> [T; COLUMNS_AT_ONCE] {
        let Self { a, x, weights, y } = self;
        let whole = x.len() / LANES * LANES;
        let (y_lanes, y_rest) = y.as_chunks_mut::<LANES>();
        let lanes =
            InLanes { a: a.map(|a| a.as_chunks().0), x: x.as_chunks().0, weights, y: y_lanes };
        let mut sums = widest(lanes).map(|lanes| lanes.into_iter().sum());
        for (i, y) in (whole..).zip(y_rest) {
            for k in 0..COLUMNS_AT_ONCE {
                sums[k] += a[k][i] * x[i];
                *y += weights[k] * a[k][i];
            }
        }
        sums
    }
}

/// The rows of a pass that fill registers.
///
/// Its inputs are copied before its outputs are written, and the lanes are summed outside: both keep the sums
/// in registers, which makes it three times as fast.
struct InLanes<'a, T, const LANES: usize> {
    a: [&'a [[T; LANES]]; COLUMNS_AT_ONCE],
    x: &'a [[T; LANES]],
    weights: [T; COLUMNS_AT_ONCE],
    y: &'a mut [[T; LANES]],
}

impl<T: Number, const LANES: usize> Kernel for InLanes<'_, T, LANES> {
    type Output = [[T; LANES]; COLUMNS_AT_ONCE];
    #[inline(always)]
    fn run(self) -> Self::Output {
        let Self { a: [a0, a1, a2, a3], x, weights, y } = self;
        let mut sums = [[T::default(); LANES]; COLUMNS_AT_ONCE];
        for (((((x, y), a0), a1), a2), a3) in x.iter().zip(y).zip(a0).zip(a1).zip(a2).zip(a3) {
            let (x, a, mut there) = (*x, [*a0, *a1, *a2, *a3], *y);
            for k in 0..COLUMNS_AT_ONCE {
                for lane in 0..LANES {
                    sums[k][lane] += a[k][lane] * x[lane];
                }
            }
            for k in 0..COLUMNS_AT_ONCE {
                for lane in 0..LANES {
                    there[lane] += weights[k] * a[k][lane];
                }
            }
            *y = there;
        }
        sums
    }
}
