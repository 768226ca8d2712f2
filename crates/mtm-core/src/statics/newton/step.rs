//! A step of Newton's method, and the choice of its tangent.

use crate::algebra::constraints::Constraint;
use crate::error::{MtmError, Result};
use crate::mechanics::strain_energy::TangentKind::{self, Definite, Exact};
use crate::vector::norm;

/// A step of Newton's method.
pub(super) struct NewtonStep {
    pub rows: Vec<[f64; 3]>,
    /// Slope of the merit along it.
    pub slope: f64,
    /// Increase of the merit that is accepted, N mm.
    pub slack: f64,
}

impl NewtonStep {
    /// Largest displacement, mm.
    pub(super) fn length(&self) -> f64 {
        self.rows.iter().fold(0.0, |m, v| m.max(norm(*v)))
    }
}

/// How the boundary moves in a step: displacement of each constrained row along its normal, and displacements of the
/// nodes that are not unknowns; none if they do not move.
pub(super) type BoundaryMotion<'a> = (&'a [Constraint], Option<&'a [[f64; 3]]>);

/// The result of `solve` with the tangent `first`, or with the definite one if the exact one is not positive
/// definite; and the tangent used.
pub(super) fn by_tangent<T>(
    first: TangentKind,
    mut solve: impl FnMut(TangentKind) -> Result<T>,
) -> Result<(T, TangentKind)> {
    match solve(first) {
        Err(MtmError::NotPositiveDefinite { .. } | MtmError::NotConverged { .. })
            if first == Exact =>
        {
            Ok((solve(Definite)?, Definite))
        }
        other => Ok((other?, first)),
    }
}
