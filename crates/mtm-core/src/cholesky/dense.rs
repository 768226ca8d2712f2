//! The dense end of the factor for sliding contact: the flexibility of the sliding nodes and its normal part.

use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_inverse::invert_lower_triangular;
use faer::linalg::triangular_solve::{
    solve_lower_triangular_in_place, solve_upper_triangular_in_place,
};
use faer::{Accum, Mat, MatMut, Par};

use super::symmetric::DenseSymmetric;
use super::workspace::parallelism;

/// The end of the factor and its inverse, for contact: everything that sliding nodes do to one another.
pub struct TailFactor {
    /// L_SS.
    lower: Mat<f64>,
    /// S⁻¹, mm/N.
    flexibility: DenseSymmetric,
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
        let mut flexibility = vec![0.0; size * size];
        triangular::matmul(
            MatMut::from_column_major_slice_mut(&mut flexibility, size, size),
            BlockStructure::TriangularLower,
            Accum::Replace,
            inverse.as_ref().transpose(),
            BlockStructure::TriangularUpper,
            inverse.as_ref(),
            BlockStructure::TriangularLower,
            1.0,
            par,
        );
        let flexibility = DenseSymmetric::from_lower(size, flexibility);
        Self { lower, flexibility, first, rows }
    }

    /// Row of the system of tail node `i`.
    pub fn row(&self, i: usize) -> usize {
        self.rows[i] as usize
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        8 * self.lower.nrows() * self.lower.nrows() + self.flexibility.bytes()
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
        let u = self.flexibility.multiply(forces.as_flattened());
        u.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect()
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
        DenseSymmetric::from_columns(nodes.len(), |c, column| {
            let (j, n_j) = (nodes[c], normals[c]);
            // S⁻¹ n_j for node j and those after it. The columns begin on the diagonal, and what the
            // second and third lack of the block there is in the first.
            let [c0, c1, c2] = [0, 1, 2].map(|b| self.flexibility.column(3 * j + b));
            let mut along: Vec<f64> = c0.iter().map(|v| v * n_j[0]).collect();
            for (out, v) in along[1..].iter_mut().zip(c1) {
                *out += v * n_j[1];
            }
            for (out, v) in along[2..].iter_mut().zip(c2) {
                *out += v * n_j[2];
            }
            along[0] += c0[1] * n_j[1] + c0[2] * n_j[2];
            along[1] += c1[1] * n_j[2];
            for (out, (&i, n_i)) in column.iter_mut().zip(nodes[c..].iter().zip(&normals[c..])) {
                *out = if i >= j {
                    let v = &along[3 * (i - j)..3 * (i - j) + 3];
                    n_i[0] * v[0] + n_i[1] * v[1] + n_i[2] * v[2]
                } else {
                    let entry = |a: usize, b: usize| {
                        n_i[a] * n_j[b] * self.flexibility.column(3 * i + a)[3 * (j - i) + b - a]
                    };
                    (0..3).map(|a| entry(a, 0) + entry(a, 1) + entry(a, 2)).sum()
                };
            }
            column[0] += softness[c];
        })
    }
}
