//! Dense factorisations for sliding contact: the flexibility of the sliding nodes and its normal part.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_inverse::invert_lower_triangular;
use faer::linalg::triangular_solve::{
    solve_lower_triangular_in_place, solve_upper_triangular_in_place,
};
use faer::{Accum, Mat, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::workspace::parallelism;

/// The end of the factor and its inverse, for contact: everything that sliding nodes do to one another.
pub struct TailFactor {
    /// L_SS.
    lower: Mat<f64>,
    /// S⁻¹, mm/N.
    flexibility: Mat<f64>,
    /// First tail unknown in elimination order.
    first: usize,
    /// Row of the system of each tail node.
    rows: Vec<u32>,
}

impl TailFactor {
    /// The flexibility of the tail from `lower`, its part of the factor; `first` is the first tail unknown
    /// in elimination order, `rows` the row of the system of each tail node.
    pub(super) fn new(lower: Mat<f64>, first: usize, rows: Vec<u32>) -> Self {
        let size = lower.nrows();
        let par = parallelism(size);
        let mut inverse = Mat::<f64>::zeros(size, size);
        invert_lower_triangular(inverse.as_mut(), lower.as_ref(), par);
        let mut flexibility = Mat::<f64>::zeros(size, size);
        triangular::matmul(
            flexibility.as_mut(),
            BlockStructure::TriangularLower,
            Accum::Replace,
            inverse.as_ref().transpose(),
            BlockStructure::TriangularUpper,
            inverse.as_ref(),
            BlockStructure::TriangularLower,
            1.0,
            par,
        );
        for c in 0..size {
            for r in 0..c {
                flexibility[(r, c)] = flexibility[(c, r)];
            }
        }
        Self { lower, flexibility, first, rows }
    }

    /// Row of the system of tail node `i`.
    pub fn row(&self, i: usize) -> usize {
        self.rows[i] as usize
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        16 * self.lower.nrows() * self.lower.nrows()
    }

    /// Displacements of the tail nodes without contact forces, from x = L⁻¹ P b.
    pub fn free_displacements(&self, forward: &[f64]) -> Vec<[f64; 3]> {
        let mut y = forward[self.first..].to_vec();
        let size = y.len();
        solve_upper_triangular_in_place(
            self.lower.as_ref().transpose(),
            MatMut::from_column_major_slice_mut(&mut y, size, 1),
            Par::Seq,
        );
        y.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect()
    }

    /// Adds L_SS⁻¹ f for forces on the tail nodes to x = L⁻¹ P b, so that a backward sweep gives the
    /// displacements with those forces.
    pub fn add_forces(&self, forward: &mut [f64], forces: &[[f64; 3]]) {
        let mut f = forces.as_flattened().to_vec();
        let size = f.len();
        solve_lower_triangular_in_place(
            self.lower.as_ref(),
            MatMut::from_column_major_slice_mut(&mut f, size, 1),
            Par::Seq,
        );
        for (x, v) in forward[self.first..].iter_mut().zip(f) {
            *x += v;
        }
    }

    /// Displacements of the tail nodes under forces on them alone, S⁻¹ f.
    pub fn respond(&self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let n = forces.len();
        let columns: Vec<(usize, &[f64; 3])> =
            forces.iter().enumerate().filter(|(_, f)| f.iter().any(|&v| v != 0.0)).collect();
        let rows: Vec<[f64; 3]> = (0..n)
            .into_par_iter()
            .map(|i| {
                // S⁻¹ is symmetric: row i is read down its columns, which are contiguous.
                [0, 1, 2].map(|a| {
                    let column = self.flexibility.col(3 * i + a);
                    columns
                        .iter()
                        .map(|(j, f)| (0..3).map(|b| column[3 * j + b] * f[b]).sum::<f64>())
                        .sum()
                })
            })
            .collect();
        rows
    }

    /// Normal flexibility n_rᵀ S⁻¹_ij n_s of constraint rows: row r holds tail node i = `nodes[r]` along
    /// the unit normal `normals[r]`; a node may have several rows. `softness[r]` (mm/N) is added to the
    /// diagonal.
    pub fn normal_flexibility(
        &self,
        nodes: &[usize],
        normals: &[[f64; 3]],
        softness: &[f64],
    ) -> DenseSymmetric {
        let k = nodes.len();
        let mut values = vec![0.0; k * k];
        values.par_chunks_mut(k.max(1)).enumerate().for_each(|(c, column)| {
            let j = nodes[c];
            let n_j = normals[c];
            let [c0, c1, c2] = [0, 1, 2].map(|b| self.flexibility.col(3 * j + b));
            for (r, out) in column.iter_mut().enumerate().skip(c) {
                let i = nodes[r];
                let n_i = normals[r];
                *out = (0..3)
                    .map(|a| {
                        let row = 3 * i + a;
                        n_i[a] * (c0[row] * n_j[0] + c1[row] * n_j[1] + c2[row] * n_j[2])
                    })
                    .sum();
            }
            column[c] += softness[c];
        });
        DenseSymmetric { size: k, values }
    }
}

/// Dense symmetric matrix, lower triangle by columns.
pub struct DenseSymmetric {
    size: usize,
    values: Vec<f64>,
}

impl DenseSymmetric {
    /// A⁻¹ b by Cholesky; the row of the first pivot that is not positive on failure.
    pub fn solve(mut self, b: &mut [f64]) -> std::result::Result<(), usize> {
        let n = self.size;
        if n == 0 {
            return Ok(());
        }
        let par = parallelism(4 * n);
        let need = llt::factor::cholesky_in_place_scratch::<f64>(n, par, Default::default());
        let mut memory = MemBuffer::new(need);
        let mut a = MatMut::from_column_major_slice_mut(&mut self.values, n, n);
        llt::factor::cholesky_in_place(
            a.as_mut(),
            Default::default(),
            par,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .map_err(|llt::factor::LltError::NonPositivePivot { index }| index)?;
        llt::solve::solve_in_place(
            MatRef::from_column_major_slice(&self.values, n, n),
            MatMut::from_column_major_slice_mut(b, n, 1),
            Par::Seq,
            MemStack::new(&mut memory),
        );
        Ok(())
    }
}
