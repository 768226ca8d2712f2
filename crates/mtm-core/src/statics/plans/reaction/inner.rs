//! Forces along contact rows, by conjugate gradients in the flexibility along them.

use std::sync::Arc;

use super::along::Along;
use super::rows::ConditionRows;
use crate::algebra::cholesky::{
    FactorPreconditioner, NormalFactor, Progress, TailFlexibility, conjugate_gradients, hopeless,
};
use crate::error::{MtmError, Result, Shortfall};

pub(super) use crate::algebra::cholesky::RowForces;

/// Maximum number of conjugate gradient steps: a new factorisation takes as long as sixty products of the matrix.
const MOST_PRODUCTS: usize = 60;

/// Accuracy required of the forces.
#[derive(Clone, Copy)]
pub(super) enum ForceAccuracy {
    /// Relative to what the rows ask for.
    Share(f64),
    /// Absolute, in the norm of the preconditioner.
    Measure(f64),
}

/// The rows of one step with their preconditioner.
pub(super) struct Inner<'a> {
    pub along: Along,
    rows: &'a ConditionRows,
    diagonal: Vec<f64>,
    /// The factorisation that preconditions, and whether it was made for these rows.
    pub kept: Arc<NormalFactor>,
    pub is_made: bool,
    pub preconditioner: FactorPreconditioner,
    /// The flexibility for a new factorisation.
    tail: &'a TailFlexibility,
}

impl<'a> Inner<'a> {
    pub fn new(
        along: Along,
        rows: &'a ConditionRows,
        (diagonal, kept): (Vec<f64>, Arc<NormalFactor>),
        tail: &'a TailFlexibility,
    ) -> Self {
        let preconditioner = FactorPreconditioner::new(diagonal.clone(), &rows.keys, kept.clone());
        Self { along, rows, diagonal, kept, is_made: false, preconditioner, tail }
    }

    /// Forces along the rows that cause the displacements `goals` along them.
    ///
    /// # Errors
    /// `NotPositiveDefinite` if the rows are degenerate, `NotConverged`.
    pub fn solve(&mut self, goals: &[f64], aim: ForceAccuracy) -> Result<RowForces> {
        let enough = |inner: &Self| match aim {
            ForceAccuracy::Share(share) => share * inner.preconditioner.measure(goals),
            ForceAccuracy::Measure(enough) => enough,
        };
        let first = self.iterate(goals, enough(self));
        if first.is_ok() || self.is_made {
            return first;
        }
        self.kept = Arc::new(self.rows.factor(self.tail)?);
        self.is_made = true;
        let diagonal = self.diagonal.clone();
        self.preconditioner =
            FactorPreconditioner::new(diagonal, &self.rows.keys, self.kept.clone());
        self.iterate(goals, enough(self))
    }

    fn iterate(&self, goals: &[f64], enough: f64) -> Result<RowForces> {
        let give_up = |progress: &Progress| hopeless(progress, MOST_PRODUCTS);
        let product = |forces: &[f64]| self.along.multiply(forces);
        let found = conjugate_gradients(product, &self.preconditioner, goals, enough, give_up);
        let quantity = "the error of the contact nodes, relative to the change";
        found.map_err(|left| MtmError::NotConverged {
            method: "contact forces",
            iterations: MOST_PRODUCTS,
            shortfall: Shortfall::new(quantity, left, enough, ""),
            advice: "use method=\"pcg\"; contact normals may be degenerate",
        })
    }
}
