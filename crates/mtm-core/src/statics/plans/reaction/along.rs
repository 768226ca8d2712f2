//! How contact rows and the axes of unstable springs respond to forces along themselves.

use crate::algebra::cholesky::{LowRank, Rough, TailFlexibility};
use crate::contact::Spring;
use crate::statics::plans::reaction::rows::ConditionRows;

/// The flexibility Bᵀ F B of the directions B of rows, and of unstable springs after them, in single precision.
///
/// It has a few rows where F has three for each node: all iterations of a step run in it, and only their sum is
/// applied to the nodes.
pub(super) struct Along {
    /// With the directions in the order of their nodes.
    matrix: Rough,
    /// What lifted nodes add to it.
    more: Option<LowRank<f32>>,
    /// The direction at each of its rows.
    order: Vec<usize>,
}

impl Along {
    /// Assembled from `tail`, in `memory` of an earlier one.
    pub fn new(
        tail: &TailFlexibility,
        rows: &ConditionRows,
        unstable: &[Spring],
        memory: Vec<f32>,
    ) -> Self {
        let directions = rows.directions(unstable);
        let mut order: Vec<usize> = (0..directions.len()).collect();
        order.sort_by_key(|&i| directions[i].0);
        let sorted: Vec<(usize, [f64; 3])> = order.iter().map(|&i| directions[i]).collect();
        let soft = |i: usize| rows.softness.get(i).copied().unwrap_or(0.0);
        let softness: Vec<f64> = order.iter().map(|&i| soft(i)).collect();
        let more = tail.more_along(&sorted);
        Self { matrix: tail.rough_flexibility(&sorted, &softness, memory), more, order }
    }

    /// Displacement along each direction, mm, under `forces` along the first of them, N: rows, or rows and axes.
    pub fn multiply(&self, forces: &[f64]) -> Vec<f64> {
        let sorted: Vec<f64> =
            self.order.iter().map(|&i| forces.get(i).copied().unwrap_or(0.0)).collect();
        let mut moved = self.matrix.multiply(&sorted);
        if let Some(more) = &self.more {
            more.add_roughly(&sorted, &mut moved);
        }
        let mut out = vec![0.0; moved.len()];
        for (&i, v) in self.order.iter().zip(moved) {
            out[i] = v;
        }
        out
    }

    /// Memory for the next one.
    pub fn into_memory(self) -> Vec<f32> {
        self.matrix.into_memory()
    }
}
