//! Sliding contact by the dense end of the factor: the flexibility of the sliding nodes and its normal part.

use super::symmetric::{DenseFactor, DenseSymmetric, Rough};

/// The flexibility of the tail nodes: the whole interaction of the sliding nodes.
pub struct TailFlexibility {
    /// S⁻¹, mm/N.
    flexibility: DenseSymmetric,
    /// The same in single precision, for intermediate displacements.
    rough: Rough,
    /// Row of the system of each tail node.
    rows: Vec<u32>,
}

impl TailFlexibility {
    /// The flexibility of the tail from `lower`, its part of the factor; `rows` is the row of the system of
    /// each tail node.
    pub(super) fn new(lower: &DenseFactor, rows: Vec<u32>) -> Self {
        let flexibility = lower.inverse();
        Self { rough: Rough::of(&flexibility), flexibility, rows }
    }

    /// Row of the system of tail node `i`.
    pub fn row(&self, i: usize) -> usize {
        self.rows[i] as usize
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.flexibility.bytes() + self.rough.bytes()
    }

    /// Flexibility of tail node `i` on its own along the unit vector `axis`, mm/N.
    pub fn own(&self, i: usize, axis: [f64; 3]) -> f64 {
        let [c0, c1, c2] = [0, 1, 2].map(|b| self.flexibility.column(3 * i + b));
        let [x, y, z] = axis;
        x * x * c0[0]
            + y * y * c1[0]
            + z * z * c2[0]
            + 2.0 * (x * y * c0[1] + x * z * c0[2] + y * z * c1[1])
    }

    /// Displacements of the tail nodes under forces on them alone, S⁻¹ f.
    pub fn respond(&self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        vectors(&self.flexibility.multiply(forces.as_flattened()))
    }

    /// The same to six digits of the largest, in half the time.
    pub fn respond_roughly(&self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        vectors(&self.rough.multiply(forces.as_flattened()))
    }

    /// Normal flexibility n_rᵀ S⁻¹_ij n_s of constraint rows: row r constrains tail node i = `nodes[r]` along
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
            // S⁻¹ n_j for node j and those after it. The columns begin on the diagonal, and the part of the
            // block there that is missing in the second and third is in the first.
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

fn vectors(values: &[f64]) -> Vec<[f64; 3]> {
    values.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect()
}
