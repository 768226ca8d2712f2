//! How contact rows and the axes of unstable springs respond to forces along themselves.

use crate::algebra::cholesky::{Factor, Reach, Rough, TailFlexibility};
use crate::contact::Spring;
use crate::statics::reaction::rows::Rows;
use crate::vector::{add, dot, scaled};

/// The flexibility Bᵀ F B of the directions B of rows, and of unstable springs after them.
///
/// It has a few rows where F has three for each node: all iterations of a step run in it, and only their sum is
/// applied to the nodes.
pub(super) struct Along<'a> {
    /// Node of each direction, and the unit vector.
    directions: Vec<(usize, [f64; 3])>,
    softness: &'a [f64],
    product: Product<'a>,
}

enum Product<'a> {
    /// Assembled in single precision, directions in the order of their nodes.
    Matrix { matrix: Rough, order: Vec<usize> },
    /// Computed by sweeps.
    Sweeps { factor: &'a Factor, reach: &'a Reach, work: Vec<f64>, nodes: usize },
}

impl<'a> Along<'a> {
    /// Assembled from `tail`, in `memory` of an earlier one.
    pub fn assembled(
        tail: &TailFlexibility,
        rows: &'a Rows,
        unstable: &[Spring],
        memory: Vec<f32>,
    ) -> Self {
        let directions = directions(rows, unstable);
        let mut order: Vec<usize> = (0..directions.len()).collect();
        order.sort_by_key(|&i| directions[i].0);
        let sorted: Vec<(usize, [f64; 3])> = order.iter().map(|&i| directions[i]).collect();
        let soft = |i: usize| rows.softness.get(i).copied().unwrap_or(0.0);
        let softness: Vec<f64> = order.iter().map(|&i| soft(i)).collect();
        let matrix = tail.rough_flexibility(&sorted, &softness, memory);
        Self { directions, softness: &rows.softness, product: Product::Matrix { matrix, order } }
    }

    /// By sweeps through `factor`, for `nodes` sliding nodes.
    pub fn by_sweeps(
        (factor, reach, nodes): (&'a Factor, &'a Reach, usize),
        rows: &'a Rows,
        unstable: &[Spring],
        work: Vec<f64>,
    ) -> Self {
        let product = Product::Sweeps { factor, reach, work, nodes };
        Self { directions: directions(rows, unstable), softness: &rows.softness, product }
    }

    /// Displacement along each direction, mm, under `forces` along the first of them, N: rows, or rows and axes.
    pub fn multiply(&mut self, forces: &[f64]) -> Vec<f64> {
        let Self { directions, softness, product } = self;
        match product {
            Product::Matrix { matrix, order } => {
                let sorted: Vec<f64> =
                    order.iter().map(|&i| forces.get(i).copied().unwrap_or(0.0)).collect();
                let moved = matrix.multiply(&sorted);
                let mut out = vec![0.0; moved.len()];
                for (&i, v) in order.iter().zip(moved) {
                    out[i] = v;
                }
                out
            }
            Product::Sweeps { factor, reach, work, nodes } => {
                let mut pushes = vec![[0.0; 3]; *nodes];
                for ((node, axis), f) in directions.iter().zip(forces) {
                    pushes[*node] = add(pushes[*node], scaled(*axis, *f));
                }
                let moved = factor.respond(reach, &pushes, work);
                let mut out: Vec<f64> =
                    directions.iter().map(|(node, axis)| dot(*axis, moved[*node])).collect();
                for (out, (s, f)) in out.iter_mut().zip(softness.iter().zip(forces)) {
                    *out += s * f;
                }
                out
            }
        }
    }

    /// Memory for the next one: of an assembled matrix, or of sweeps.
    pub fn into_memory(self) -> (Vec<f32>, Vec<f64>) {
        match self.product {
            Product::Matrix { matrix, .. } => (matrix.into_memory(), Vec::new()),
            Product::Sweeps { work, .. } => (Vec::new(), work),
        }
    }
}

fn directions(rows: &Rows, unstable: &[Spring]) -> Vec<(usize, [f64; 3])> {
    let rows = rows.rows.iter().map(|r| (r.node, r.normal));
    rows.chain(unstable.iter().map(|s| (s.node, s.axis))).collect()
}
