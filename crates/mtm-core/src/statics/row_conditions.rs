//! Contact conditions on the rows of the system.

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::constraints::{Constraint, projected};
use crate::contact::{Constraints, ContactRow, ContactState, Sliding, Spring};
use crate::vector::{add, scaled};

/// Constraints and springs on rows of the system.
#[derive(Clone, Default)]
pub(crate) struct RowConditions {
    /// Orthonormal on each row.
    pub constraints: Vec<Constraint>,
    /// Row and spring, across the normals of that row.
    pub springs: Vec<(usize, Spring)>,
}

impl RowConditions {
    /// The conditions that `c` sets for the sliding nodes.
    pub fn new(sliding: &Sliding, c: &Constraints<'_>) -> Self {
        let row = |node: usize| sliding.nodes()[node].row as usize;
        let rows = c.rows.iter().zip(c.offsets);
        Self {
            constraints: rows
                .map(|(r, &offset)| Constraint { row: row(r.node), normal: r.normal, offset })
                .collect(),
            springs: c.springs.iter().map(|&s| (row(s.node), s)).collect(),
        }
    }

    /// The conditions of `state`: nodes that are held move no further along their normals.
    pub fn of_state(sliding: &Sliding, state: &ContactState) -> Self {
        let row = |node: usize| sliding.nodes()[node].row as usize;
        let held = |r: &ContactRow| Constraint { row: row(r.node), normal: r.normal, offset: 0.0 };
        Self {
            constraints: state.rows.iter().map(held).collect(),
            springs: state.springs.iter().map(|&s| (row(s.node), s)).collect(),
        }
    }

    /// The projected matrix, P A P + k (I − P), with the springs.
    pub fn applied_to(&self, matrix: &BlockMatrix) -> BlockMatrix {
        let mut system = projected(matrix, &self.constraints);
        for (row, s) in &self.springs {
            system.add_to_diagonal(*row, s.axis, s.stiffness);
        }
        system
    }

    /// Adds the forces of the springs at rest to the right-hand side `b`, N.
    pub fn add_pull(&self, b: &mut [[f64; 3]]) {
        for (row, s) in &self.springs {
            b[*row] = add(b[*row], scaled(s.axis, s.stiffness * s.goal));
        }
    }
}
