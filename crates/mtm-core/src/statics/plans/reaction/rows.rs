//! Conditions of contact as rows of the normal system.

use crate::algebra::cholesky::{DenseSymmetric, NormalFactor, RowKey, TailFlexibility};
use crate::contact::{ContactRow, Spring};
use crate::error::{MtmError, Result};
use crate::vector::{add, dot, scaled};

/// Constraint rows, followed by one row for each spring: a spring of stiffness k adds a column along its axis,
/// with 1/k on the diagonal.
pub(crate) struct ConditionRows {
    pub rows: Vec<ContactRow>,
    /// Prescribed displacement of each row, mm.
    goals: Vec<f64>,
    /// Softness added to the diagonal, mm/N.
    pub softness: Vec<f64>,
    pub keys: Vec<RowKey>,
}

impl ConditionRows {
    /// Of contact `rows` with their `offsets`, and of the `springs` that hold nodes back.
    pub fn new(rows: &[ContactRow], offsets: &[f64], springs: &[Spring]) -> Self {
        let (mut rows, mut goals) = (rows.to_vec(), offsets.to_vec());
        let mut softness = vec![0.0; rows.len()];
        for spring in springs.iter().filter(|s| s.stiffness > 0.0) {
            rows.push(ContactRow { node: spring.node, normal: spring.axis, point: [0.0; 3] });
            goals.push(spring.goal);
            softness.push(1.0 / spring.stiffness);
        }
        let most = rows.iter().map(|r| r.node + 1).max().unwrap_or(0);
        let mut count = vec![0; most];
        let key = |r: &ContactRow| {
            count[r.node] += 1;
            (r.node, count[r.node] - 1)
        };
        let keys = rows.iter().map(key).collect();
        Self { rows, goals, softness, keys }
    }

    /// Node and unit vector of each row, and after them those of the `springs` that have no row.
    pub fn directions(&self, springs: &[Spring]) -> Vec<(usize, [f64; 3])> {
        let rows = self.rows.iter().map(|r| (r.node, r.normal));
        rows.chain(springs.iter().map(|s| (s.node, s.axis))).collect()
    }

    /// Displacements that contact forces have to add to `free`, mm.
    pub fn missing(&self, free: &[[f64; 3]]) -> Vec<f64> {
        self.rows.iter().zip(&self.goals).map(|(r, g)| g - dot(r.normal, free[r.node])).collect()
    }

    /// Displacement along each row that is missing if the nodes have moved by `displacements` under `forces`
    /// along the rows.
    pub(super) fn open(&self, displacements: &[[f64; 3]], forces: &[f64]) -> Vec<f64> {
        let missing = self.missing(displacements);
        missing.iter().zip(self.softness.iter().zip(forces)).map(|(v, (s, f))| v - s * f).collect()
    }

    /// Forces along the rows to start from: those of the nodes along the first `n_contact` rows; springs are
    /// linearised about a state in which they exert none.
    pub(super) fn turned(&self, forces: &[[f64; 3]], n_contact: usize) -> Vec<f64> {
        let contact = self.rows[..n_contact].iter().map(|r| dot(r.normal, forces[r.node]));
        contact.chain(self.rows[n_contact..].iter().map(|_| 0.0)).collect()
    }

    /// Nᵀ S⁻¹ N with the softness.
    pub(super) fn flexibility(&self, tail: &TailFlexibility) -> DenseSymmetric {
        tail.normal_flexibility(&self.directions(&[]), &self.softness)
    }

    /// The factor of the flexibility.
    pub(super) fn factor(&self, tail: &TailFlexibility) -> Result<NormalFactor> {
        NormalFactor::new(self.flexibility(tail), self.keys.clone())
            .map_err(|at| self.singular(tail, at))
    }

    pub(super) fn singular(&self, tail: &TailFlexibility, at: usize) -> MtmError {
        singular(tail.row(self.rows[at].node) as u32)
    }
}

/// Force vector of each of `n` sliding nodes from the forces along the rows.
pub(super) fn pushes(n: usize, rows: &[ContactRow], forces: &[f64]) -> Vec<[f64; 3]> {
    let mut out = vec![[0.0; 3]; n];
    for (r, &force) in rows.iter().zip(forces) {
        out[r.node] = add(out[r.node], scaled(r.normal, force));
    }
    out
}

/// The error for a flexibility without a positive pivot at a row of the system.
pub(crate) fn singular(row: u32) -> MtmError {
    MtmError::not_definite(row as usize, "the flexibility of the sliding nodes is singular")
}
