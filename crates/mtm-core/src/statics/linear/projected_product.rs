//! The system under contact constraints as a matrix product: all that conjugate gradients need of P A P,
//! without a copy of A.

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::constraints::Constraint;
use crate::algebra::krylov::Operator;
use crate::contact::Spring;
use crate::contact::links::Link;
use crate::vector::{add, dot, norm, scaled, sub};

/// Length of a projected vector, relative to the original, below which only rounding errors are left of it.
const PROJECTION_ROUNDING: f64 = 16.0 * f64::EPSILON;

/// Share of the stiffness of the body along a direction that must remain with the springs.
const LEAST_HOLD: f64 = 0.05;

/// P (A + Σ k a⊗a + Σ k c⊗c) P on the vectors without a component along the normals of held rows.
///
/// The springs k, a lie across the normals of their rows; the links k, c join several rows.
pub struct ProjectedProduct<'a> {
    matrix: &'a BlockMatrix,
    /// Orthonormal on each row.
    constraints: &'a [Constraint],
    /// Row and spring.
    springs: &'a [(usize, Spring)],
    links: &'a [Link],
}

impl<'a> ProjectedProduct<'a> {
    /// The product of `matrix` with `springs` under `constraints`, orthonormal on each row.
    pub fn new(
        matrix: &'a BlockMatrix,
        constraints: &'a [Constraint],
        springs: &'a [(usize, Spring)],
    ) -> Self {
        Self { matrix, constraints, springs, links: &[] }
    }

    /// The same with `links` between rows.
    pub fn with_links(self, links: &'a [Link]) -> Self {
        Self { links, ..self }
    }
}

impl Operator for ProjectedProduct<'_> {
    fn n_rows(&self) -> usize {
        self.matrix.n_rows()
    }

    fn multiply_into(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) {
        self.matrix.multiply_into(x, y);
        for (row, spring) in self.springs {
            let pull = spring.stiffness * dot(spring.axis, x[*row]);
            y[*row] = add(y[*row], scaled(spring.axis, pull));
        }
        for link in self.links {
            link.add(link.stiffness * link.along(x), y);
        }
        self.project(y);
    }

    /// Springs may cancel most of the stiffness of the body, but not all of it.
    fn least_curvature(&self, p: &[[f64; 3]]) -> f64 {
        let taken = |(row, s): &(usize, Spring)| -s.stiffness * dot(s.axis, p[*row]).powi(2);
        let unstable = self.springs.iter().filter(|(_, s)| s.stiffness < 0.0);
        LEAST_HOLD / (1.0 - LEAST_HOLD) * unstable.map(taken).sum::<f64>()
    }

    fn project(&self, x: &mut [[f64; 3]]) {
        for held in self.constraints.chunk_by(|a, b| a.row == b.row) {
            let row = held[0].row;
            let least = PROJECTION_ROUNDING * norm(x[row]);
            for &Constraint { normal, .. } in held {
                x[row] = sub(x[row], scaled(normal, dot(normal, x[row])));
            }
            // The rounding errors left by the projection point anywhere, and may be all that is left at a held
            // node.
            if norm(x[row]) <= least {
                x[row] = [0.0; 3];
            }
        }
    }
}
