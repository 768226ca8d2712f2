//! Newton's method under given conditions at the boundary.

use std::borrow::Cow;

use crate::algebra::constraints::Constraint;
use crate::error::Result;
use crate::mechanics::strain_energy::TangentKind::{self, Exact};
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::newton::descent::{NewtonStep, StepRule, by_tangent};
use crate::statics::newton::{Equilibrium, Iterate, Target, along_slope, moved_by};
use crate::statics::options::Interrupt;
use crate::vector::{add, dot, scaled, sub};

/// Steps under the conditions of `target`.
struct UnderConditions<'a, 'i> {
    equilibrium: &'a Equilibrium,
    target: &'a Target<'a>,
    /// Its conditions, whose constraints move no further.
    still: RowConditions,
    interrupted: Interrupt<'i>,
}

impl StepRule for UnderConditions<'_, '_> {
    fn next(&mut self, pose: &Iterate, how: (TangentKind, f64)) -> Result<NewtonStep> {
        let moves = (&self.still.constraints[..], None);
        let rows = self.equilibrium.step(pose, self.target, moves, how, self.interrupted)?;
        Ok(NewtonStep { slope: along_slope(&rows, pose), slack: 0.0, rows })
    }

    fn conditions(&self) -> Cow<'_, RowConditions> {
        Cow::Borrowed(&self.still)
    }

    fn resume(&mut self, _pose: &Iterate) {}
}

impl Equilibrium {
    /// Equilibrium at `part` of the way from the boundary of `u` to that of `target`.
    pub(super) fn advance(
        &self,
        u: &[[f64; 3]],
        target: &Target<'_>,
        part: f64,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        // The boundary moves; the unknowns follow as predicted by the tangent.
        let mut moved = target.prescribed.to_vec();
        for &j in &self.reduction.unknowns {
            moved[j as usize] = u[j as usize];
        }
        let change: Vec<[f64; 3]> =
            moved.iter().zip(u).map(|(a, b)| scaled(sub(*a, *b), part)).collect();
        let start = self.pose(u.to_vec(), target)?;
        let along = |c: &Constraint| dot(c.normal, u[self.reduction.unknowns[c.row] as usize]);
        let constraints: Vec<Constraint> = target
            .conditions
            .constraints
            .iter()
            .map(|c| Constraint { offset: part * (c.offset - along(c)), ..*c })
            .collect();
        let allowed = self.allowed(&start, target, f64::INFINITY);
        let interrupted = solve.interrupted;
        let (rows, _) = by_tangent(Exact, |kind| {
            let moves = (&constraints[..], Some(&change[..]));
            self.step(&start, target, moves, (kind, allowed), interrupted)
        })?;
        target.hierarchy.leave_rest(&self.at_rest);
        let mut ahead = start.u;
        for (value, d) in ahead.iter_mut().zip(&change) {
            *value = add(*value, *d);
        }
        let pose = self.pose(moved_by(&self.reduction, &ahead, &rows, 1.0), target)?;
        solve.iterations += 1;

        self.under_conditions(pose, target, solve)
    }

    /// Equilibrium from `u`, at the boundary of `target`.
    pub(super) fn resist(
        &self,
        u: Vec<[f64; 3]>,
        target: &Target<'_>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        let pose = self.pose(u, target)?;
        let (pose, _) = self.eased(pose, target, &target.conditions.still())?;
        self.under_conditions(pose, target, solve)
    }

    /// Equilibrium from `pose`, at whose boundary the conditions of `target` hold.
    fn under_conditions(
        &self,
        pose: Iterate,
        target: &Target<'_>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        let (still, interrupted) = (target.conditions.still(), solve.interrupted);
        let mut steps = UnderConditions { equilibrium: self, target, still, interrupted };
        self.descend(pose, target, (f64::INFINITY, &[]), &mut steps, solve)
    }
}
