//! What a solution reports of itself: the residual of its forces, and the state of its contact.

use crate::boundary::Motion;
use crate::contact::ContactResult;
use crate::statics::solver::StaticSolver;
use crate::vector::{dot, scaled, sub};

impl StaticSolver {
    /// Residual force at the unknown nodes relative to the forces that the plan introduces: forces of joined
    /// nodes and loads on the unknown rows, contact forces, and the force that each held node alone would need
    /// to follow its walls. Without the last term, walls that move a body without straining it would introduce
    /// no force.
    pub(super) fn residual(
        &self,
        forces: &[[f64; 3]],
        loads: Option<&[[f64; 3]]>,
        (contact, touching): (Option<&ContactResult>, &[[f64; 3]]),
        b: &[[f64; 3]],
    ) -> f64 {
        let mut rest: Vec<[f64; 3]> = self
            .reduction
            .unknowns
            .iter()
            .map(|&j| {
                let f = forces[j as usize];
                loads.map_or(f, |rows| sub(f, rows[j as usize]))
            })
            .collect();
        self.held_rows().for_each(|row| rest[row] = [0.0; 3]);
        let mut scale: f64 = b.iter().map(|v| dot(*v, *v)).sum();
        for (rest, push) in rest.iter_mut().zip(touching) {
            *rest = sub(*rest, *push);
        }
        if let (Some(sliding), Some(state)) = (&self.sliding, contact) {
            for (i, node) in sliding.nodes.iter().enumerate() {
                let push = scaled(state.normals[i], state.forces[i]);
                rest[node.row as usize] = sub(rest[node.row as usize], push);
                scale += dot(push, push);
            }
            for row in &state.rows {
                let j = sliding.nodes[row.node].node as usize;
                let k = self.tensors.matrix().diagonal_block(j);
                let way = scaled(row.normal, dot(row.normal, state.displacements[row.node]));
                let alone = [0, 1, 2].map(|i| dot([k[3 * i], k[3 * i + 1], k[3 * i + 2]], way));
                scale += dot(alone, alone);
            }
        }
        let sum: f64 = rest.iter().map(|v| dot(*v, *v)).sum();
        if sum == 0.0 { 0.0 } else { (sum / scale.max(f64::MIN_POSITIVE)).sqrt() }
    }

    /// The state of the sliding nodes; empty without any.
    pub(super) fn contact_result(
        &self,
        state: Option<ContactResult>,
        motions: &[&Motion],
    ) -> ContactResult {
        let (Some(sliding), Some(mut state)) = (&self.sliding, state) else {
            return ContactResult { converged: true, ..ContactResult::default() };
        };
        state.at_rest = sliding.carried_back(motions, &state);
        state
    }
}
