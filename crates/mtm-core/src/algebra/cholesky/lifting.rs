//! Rows at the end of the factor that each plan holds or frees, so that one factor serves all plans.
//!
//! The factor T Tᵀ ends with the rows L, of which a plan holds P and frees Q. G is the flexibility of the sliding rows
//! S while all of L is held, X carries forces on S to L, and H = T_LL T_LLᵀ is the stiffness of L. Under forces f,
//!
//!   H_QQ u_Q = r_Q,   u_P = 0,   r = f_L − X f_S,   u_S = G f_S − Xᵀ u_L.
//!
//! The flexibility of S is thus G + Vᵀ V with V = C⁻¹ X_Q and C Cᵀ = H_QQ: freed rows only add to it, so that no
//! digits cancel.

use std::sync::Arc;

use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, Mat, MatMut, MatRef};

use super::symmetric::{
    COLUMNS_AT_ONCE as AT_ONCE, DenseFactor, DenseSymmetric, DotsAndAdd, Number, add_scaled, dot,
};
use super::workspace::parallelism;

/// X and H of all rows that may be held.
pub(super) struct Liftable {
    /// Unknowns of S and of L.
    width: usize,
    size: usize,
    /// X, row by row.
    carried: Vec<f64>,
    /// H, column by column.
    stiffness: Vec<f64>,
}

impl Liftable {
    /// From X, and from T_LL, row by row.
    pub fn new(width: usize, carried: Vec<f64>, own: &[f64]) -> Self {
        let (size, mut stiffness) = (own.len().isqrt(), vec![0.0; own.len()]);
        let to = MatMut::from_column_major_slice_mut(&mut stiffness, size, size);
        let rows = MatRef::from_column_major_slice(own, size, size);
        matmul(to, Accum::Replace, rows.transpose(), rows, 1.0, parallelism(size));
        Self { width, size, carried, stiffness }
    }

    /// Row `l` of X.
    fn row(&self, l: usize) -> &[f64] {
        &self.carried[l * self.width..(l + 1) * self.width]
    }

    /// H v.
    fn forces(&self, v: &[f64]) -> Vec<f64> {
        self.stiffness.chunks_exact(self.size).map(|column| dot(column, v)).collect()
    }

    /// r ← r − X f.
    fn take_carried(&self, f: &[f64], r: &mut [f64]) {
        r.iter_mut().enumerate().for_each(|(l, r)| *r -= dot(self.row(l), f));
    }

    /// y ← y − Xᵀ u.
    pub fn take_back(&self, u: &[f64], y: &mut [f64]) {
        u.iter().enumerate().for_each(|(l, &u)| add_scaled(self.row(l), -u, y));
    }
}

/// Those rows with the ones that a plan frees.
pub(super) struct Lifted {
    pub all: Arc<Liftable>,
    /// Unknowns of Q, and of P, among those of L.
    free: Vec<usize>,
    held: Vec<usize>,
    /// C.
    factor: DenseFactor,
    /// V.
    pub more: LowRank,
}

impl Lifted {
    /// With the rows `held`, by their places in L; on failure, the place of the first row without a positive pivot.
    pub fn new(all: Arc<Liftable>, held: &[usize]) -> Result<Self, usize> {
        let (held, free): (Vec<usize>, Vec<usize>) =
            (0..all.size).partition(|l| held.binary_search(&(l / 3)).is_ok());
        let matrix = DenseSymmetric::from_columns(free.len(), |c, column| {
            for (to, &r) in column.iter_mut().zip(&free[c..]) {
                *to = all.stiffness[free[c] * all.size + r];
            }
        });
        let factor = matrix.factor().map_err(|at| free[at] / 3)?;
        let mut rows: Vec<f64> = free.iter().flat_map(|&l| all.row(l)).copied().collect();
        if !rows.is_empty() {
            let v = MatMut::from_row_major_slice_mut(&mut rows, free.len(), all.width);
            solve_lower_triangular_in_place(factor.lower(), v, parallelism(all.width));
        }
        let more = LowRank::new(all.width, rows);
        Ok(Self { all, free, held, factor, more })
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let Liftable { carried, stiffness, .. } = &*self.all;
        8 * (self.more.rows.len() + carried.len() + stiffness.len()) + self.factor.bytes()
    }

    /// Forces on S and L that bring the body from a state in which all of L is free, with displacements `sliding`
    /// and `own` of S and L, to the one in which P is held; `contact`: the forces on S at its displacements there.
    pub fn pushes<E>(
        &self,
        (sliding, own): (&[f64], &[f64]),
        contact: impl Fn(&[f64]) -> Result<Vec<f64>, E>,
    ) -> Result<Vec<f64>, E> {
        let mut r = self.all.forces(own);
        let (mut way, mut free) = (self.hold(&r), sliding.to_vec());
        add_scaled(own, -1.0, &mut way);
        self.all.take_back(&way, &mut free);
        let mut out = contact(&free)?;
        self.all.take_carried(&out, &mut r);
        let reached = self.all.forces(&self.hold(&r));
        let width = out.len();
        out.resize(width + own.len(), 0.0);
        for &l in &self.held {
            out[width + l] = reached[l] - r[l];
        }
        Ok(out)
    }

    /// Displacements of L under forces r, those of P 0.
    pub fn hold(&self, r: &[f64]) -> Vec<f64> {
        let mut free: Vec<f64> = self.free.iter().map(|&l| r[l]).collect();
        self.factor.solve(&mut free);
        let mut out = vec![0.0; r.len()];
        self.free.iter().zip(free).for_each(|(&l, v)| out[l] = v);
        out
    }
}

/// Vᵀ V, for V row by row: a product reads each row once.
pub struct LowRank<T = f64> {
    /// Number of columns.
    count: usize,
    /// Filled up with zeros to whole blocks of rows.
    rows: Vec<T>,
}

impl<T: Number> LowRank<T> {
    fn new(count: usize, mut rows: Vec<T>) -> Self {
        rows.resize(rows.len().next_multiple_of((count * AT_ONCE).max(1)), T::default());
        Self { count, rows }
    }

    /// y ← y + Vᵀ V x.
    pub fn add_product(&self, x: &[T], y: &mut [T]) {
        for rows in self.rows.chunks_exact((self.count * AT_ONCE).max(1)) {
            let a = std::array::from_fn(|k| &rows[k * self.count..(k + 1) * self.count]);
            let none = [T::default(); AT_ONCE];
            let weights = T::dots_and_add(DotsAndAdd { a, x, weights: none, y: &mut *y });
            T::dots_and_add(DotsAndAdd { a, x, weights, y: &mut *y });
        }
    }
}

impl LowRank<f32> {
    /// y ← y + Vᵀ V x to six or seven digits.
    pub fn add_roughly(&self, x: &[f64], y: &mut [f64]) {
        let largest = x.iter().fold(f64::MIN_POSITIVE, |m, v| m.max(v.abs()));
        let x: Vec<f32> = x.iter().map(|v| (v / largest) as f32).collect();
        let mut more = vec![0.0; y.len()];
        self.add_product(&x, &mut more);
        y.iter_mut().zip(more).for_each(|(y, v)| *y += f64::from(v) * largest);
    }
}

impl LowRank {
    /// The same between directions, a node of S and a unit vector each.
    pub fn along<T: Number>(&self, directions: &[(usize, [f64; 3])]) -> LowRank<T> {
        let along =
            |row: &[f64], (node, way): (usize, [f64; 3])| T::of(dot(&row[3 * node..][..3], &way));
        let rows = self.rows.chunks_exact(self.count.max(1));
        let rows =
            rows.flat_map(|row| directions.iter().map(move |&way| along(row, way))).collect();
        LowRank::new(directions.len(), rows)
    }

    /// Vᵀ V itself.
    pub fn product(&self) -> Mat<f64> {
        let rank = self.rows.len() / self.count.max(1);
        let v = MatRef::from_row_major_slice(&self.rows, rank, self.count);
        let mut out = Mat::zeros(self.count, self.count);
        matmul(out.as_mut(), Accum::Replace, v.transpose(), v, 1.0, parallelism(self.count));
        out
    }
}
