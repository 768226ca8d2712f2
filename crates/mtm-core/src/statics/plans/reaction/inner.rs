//! Forces along contact rows, by conjugate gradients in the flexibility along them.

use std::sync::Arc;

use super::along::Along;
use super::rows::ConditionRows;
use crate::algebra::cholesky::{
    FactorPreconditioner, NormalFactor, Progress, TailFlexibility, conjugate_gradients, hopeless,
};
use crate::error::{MtmError, Result, Shortfall};

pub(super) use crate::algebra::cholesky::RowForces;

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
    along: Along,
    rows: &'a ConditionRows,
    diagonal: Vec<f64>,
    /// The factorisation that preconditions, and whether it was made for these rows.
    pub kept: Arc<NormalFactor>,
    pub is_made: bool,
    preconditioner: FactorPreconditioner,
    most: usize,
    /// The flexibility for a new factorisation.
    tail: &'a TailFlexibility,
}

impl<'a> Inner<'a> {
    /// `most`: number of steps above which a new factorisation takes less time.
    pub fn new(
        along: Along,
        rows: &'a ConditionRows,
        (diagonal, kept): (Vec<f64>, Arc<NormalFactor>),
        most: usize,
        tail: &'a TailFlexibility,
    ) -> Self {
        let preconditioner = FactorPreconditioner::new(diagonal.clone(), &rows.keys, kept.clone());
        Self { along, rows, diagonal, kept, is_made: false, preconditioner, most, tail }
    }

    /// Displacement along each row and axis under forces along them.
    pub fn multiply(&self, forces: &[f64]) -> Vec<f64> {
        self.along.multiply(forces)
    }

    /// Size of displacements along the rows: the energy norm of the forces that the preconditioner takes for
    /// their cause.
    pub fn measure(&self, open: &[f64]) -> f64 {
        self.preconditioner.measure(open)
    }

    /// Forces along the rows that cause the displacements `goals` along them.
    ///
    /// # Errors
    /// `NotPositiveDefinite` if the rows are degenerate, `NotConverged`.
    pub fn solve(&mut self, goals: &[f64], aim: ForceAccuracy) -> Result<RowForces> {
        let enough = |inner: &Self| match aim {
            ForceAccuracy::Share(share) => share * inner.measure(goals),
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

    fn iterate(&mut self, goals: &[f64], enough: f64) -> Result<RowForces> {
        let Self { along, preconditioner, most, .. } = self;
        let give_up = |progress: &Progress| hopeless(progress, *most);
        let product = |forces: &[f64]| along.multiply(forces);
        conjugate_gradients(product, preconditioner, goals, enough, give_up).map_err(|left| {
            MtmError::NotConverged {
                method: "contact forces",
                iterations: *most,
                shortfall: Shortfall {
                    quantity: "the error of the contact nodes, relative to the change",
                    value: left,
                    limit: enough,
                    unit: "",
                },
                advice: "use method=\"pcg\"; contact normals may be degenerate",
            }
        })
    }

    /// Memory for the next one.
    pub fn into_memory(self) -> Vec<f32> {
        self.along.into_memory()
    }
}
