//! Contact conditions on the rows of the system.

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::constraints::{Constraint, projected};
use crate::contact::{Constraints, ContactResult, ContactRow, Sliding, Spring};
use crate::vector::{add, dot, scaled};

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
        Self::on_rows(sliding, c.rows.iter().zip(c.offsets.iter().copied()), c.springs)
    }

    /// The conditions of `state`: nodes that are held move no further along their normals.
    pub fn of_state(sliding: &Sliding, state: &ContactResult) -> Self {
        Self::on_rows(sliding, state.rows.iter().map(|r| (r, 0.0)), &state.springs)
    }

    /// The same conditions for steps from a state at which they hold: constraints move no further.
    pub fn still(&self) -> Self {
        let still = |c: &Constraint| Constraint { offset: 0.0, ..*c };
        let constraints = self.constraints.iter().map(still).collect();
        Self { constraints, springs: self.springs.clone() }
    }

    /// `held`: rows of contact, each with its offset, mm.
    fn on_rows<'a>(
        sliding: &Sliding,
        held: impl Iterator<Item = (&'a ContactRow, f64)>,
        springs: &[Spring],
    ) -> Self {
        let row = |node: usize| sliding.nodes[node].row as usize;
        Self {
            constraints: held
                .map(|(r, offset)| Constraint { row: row(r.node), normal: r.normal, offset })
                .collect(),
            springs: springs.iter().map(|&s| (row(s.node), s)).collect(),
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

    /// Adds the energy of the springs, N mm, and its slope, N, under the displacement `u` of each row, mm.
    pub fn add_stretch(
        &self,
        energy: &mut f64,
        slope: &mut [[f64; 3]],
        u: impl Fn(usize) -> [f64; 3],
    ) {
        for (row, s) in &self.springs {
            let stretch = dot(s.axis, u(*row)) - s.goal;
            slope[*row] = add(slope[*row], scaled(s.axis, s.stiffness * stretch));
            *energy += 0.5 * s.stiffness * stretch * stretch;
        }
    }

    /// Adds the forces of the springs at rest to the right-hand side `b`, N.
    pub fn add_pull(&self, b: &mut [[f64; 3]]) {
        for (row, s) in &self.springs {
            b[*row] = add(b[*row], scaled(s.axis, s.stiffness * s.goal));
        }
    }
}
