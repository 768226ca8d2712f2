//! Normal constraints n·u = g on rows of the system, by projection: the sparsity pattern is unchanged, and the
//! constraints hold to rounding.

use crate::algebra::blocks::BlockMatrix;
use crate::vector::{dot, scaled, sub};

/// n·u = offset on one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Constraint {
    /// Row of the system.
    pub row: usize,
    /// Unit normal n.
    pub normal: [f64; 3],
    /// Prescribed component along the normal, mm.
    pub offset: f64,
}

/// P A P + k (I − P) with P = I − Σ n⊗n on the constrained rows, k the mean diagonal of each.
///
/// The normals of one row are orthonormal.
pub fn projected(matrix: &BlockMatrix, constraints: &[Constraint]) -> BlockMatrix {
    let mut normals: Vec<&[Constraint]> = vec![&[]; matrix.n_rows()];
    for chunk in constraints.chunk_by(|a, b| a.row == b.row) {
        normals[chunk[0].row] = chunk;
    }
    let mut out = matrix.clone();
    for j in 0..out.n_rows() {
        for at in out.row_start[j]..out.row_start[j + 1] {
            let k = out.columns[at] as usize;
            let block = &mut out.blocks[at];
            let stiffness = (block[0] + block[4] + block[8]) / 3.0;
            for &Constraint { normal: n, .. } in normals[j] {
                for c in 0..3 {
                    let along = n[0] * block[c] + n[1] * block[3 + c] + n[2] * block[6 + c];
                    for r in 0..3 {
                        block[3 * r + c] -= n[r] * along;
                    }
                }
            }
            for &Constraint { normal: n, .. } in normals[k] {
                for r in 0..3 {
                    let along = dot([block[3 * r], block[3 * r + 1], block[3 * r + 2]], n);
                    for c in 0..3 {
                        block[3 * r + c] -= along * n[c];
                    }
                }
            }
            let own = if k == j { normals[j] } else { &[] };
            for &Constraint { normal: n, .. } in own {
                for r in 0..3 {
                    for c in 0..3 {
                        block[3 * r + c] += stiffness * n[r] * n[c];
                    }
                }
            }
        }
    }
    out
}

/// P (b − A g n): the right-hand side of the projected system for w = u − g n.
pub fn projected_rhs(
    matrix: &BlockMatrix,
    b: &[[f64; 3]],
    constraints: &[Constraint],
) -> Vec<[f64; 3]> {
    let mut shift = vec![[0.0; 3]; b.len()];
    add_offsets(&mut shift, constraints);
    let mut rhs = matrix.multiply(&shift);
    for (r, b) in rhs.iter_mut().zip(b) {
        *r = sub(*b, *r);
    }
    for &Constraint { row, normal: n, .. } in constraints {
        let along = dot(n, rhs[row]);
        rhs[row] = sub(rhs[row], scaled(n, along));
    }
    rhs
}

/// Sets the component of each constrained row of `x` along its normal to the constraint's value.
pub fn add_offsets(x: &mut [[f64; 3]], constraints: &[Constraint]) {
    for &Constraint { row, normal: n, offset } in constraints {
        let along = dot(n, x[row]);
        x[row] = [0, 1, 2].map(|i| x[row][i] + (offset - along) * n[i]);
    }
}
