//! Newton's steps downhill: which tangent each takes, and how far it goes.

use std::borrow::Cow;

use crate::algebra::constraints::Constraint;
use crate::algebra::line_search::{Descent, first_of_halves};
use crate::error::{MtmError, Result};
use crate::mechanics::strain_energy::TangentKind::{self, Definite, Exact};
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::newton::{
    Equilibrium, Iterate, MAX_STEPS, STIFF_PARTS, TangentSolver, Target, along_slope, lost,
    moved_by, reach,
};
use crate::vector::{add, dot, norm};

/// Shortest step of the line search relative to the full one.
const SHORTEST: f64 = 1.0 / 1024.0;
/// Rounding error of the energy relative to its parts: a smaller decrease cannot be detected.
const ENERGY_ROUNDING: f64 = 1e-12;
/// Longest step of the search relative to the full one.
const LONGEST: f64 = 16.0;
/// Length of a step, relative to the length at which the exact tangent was not positive definite, below which
/// it is tried again.
const RETRY_EXACT: f64 = 0.5;
/// Length of a step with the exact tangent, relative to the step before, above which the tangent counts as
/// indefinite unless the whole step goes downhill: near the solution steps become shorter.
const LONGER: f64 = 8.0;
/// Length of a step over all displacements, below which conjugate gradients use the exact tangent: at rest it
/// is positive definite, and further away they would detect indefiniteness only by chance.
const NEAR_REST: f64 = 0.05;
/// Steps over which convergence is judged with such parts.
const WINDOW: usize = 3;
/// Length of a step relative to the one before, or to the error asked for, below which the step counts as the
/// whole error with such parts as well: Newton's method converges quadratically, or only rounding is left.
const QUADRATIC: f64 = 1e-3;

/// Error relative to the reach below which a state is near enough to its equilibrium for tissue to resist being
/// squeezed flat: more exact, its equilibrium without that energy is of no use.
const NEAR_ENOUGH: f64 = 1e-3;

/// A step of Newton's method.
pub(super) struct NewtonStep {
    pub rows: Vec<[f64; 3]>,
    /// Slope of the merit along it.
    pub slope: f64,
    /// Increase of the merit that is accepted, N mm.
    pub slack: f64,
}

/// How the boundary moves in a step: displacement of each constrained row along its normal, and displacements of the
/// nodes that are not unknowns; none if they do not move.
pub(super) type BoundaryMotion<'a> = (&'a [Constraint], Option<&'a [[f64; 3]]>);

/// Newton's steps under the conditions at the boundary.
pub(super) trait StepRule {
    /// The step from `pose` with this tangent, and with this error, mm.
    ///
    /// # Errors
    /// Those of the solver and of contact.
    fn next(&mut self, pose: &Iterate, how: (TangentKind, f64)) -> Result<NewtonStep>;

    /// The conditions of the last step on its rows, whose constraints move no further.
    fn conditions(&self) -> Cow<'_, RowConditions>;

    /// Nodes have moved to `pose` since the last step.
    fn resume(&mut self, pose: &Iterate);
}

impl Equilibrium {
    /// The result of Newton's `steps` from `pose`; near it where the energy of `target` is one without the barrier
    /// and tissue is at the barrier.
    ///
    /// `finest`: the error allowed in the last step, mm; `on_walls`: the rows that no step carries further than
    /// computed.
    pub(super) fn descend(
        &self,
        mut pose: Iterate,
        target: &Target<'_>,
        (finest, on_walls): (f64, &[u32]),
        steps: &mut impl StepRule,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        let by_factor = matches!(self.solver, TangentSolver::Cholesky(_));
        // Step length below which the exact tangent is worth trying.
        let mut near = if by_factor { f64::INFINITY } else { NEAR_REST * reach(&pose, target) };
        let mut length = f64::INFINITY;
        // Error of the state once it is small enough: a step as accurate as the last one must be is still to come.
        let mut ending = None;
        // Steps of earlier descents are no sign of how this one converges.
        let start = solve.history.len();
        for _ in 0..MAX_STEPS {
            if (solve.interrupted)() {
                return Err(MtmError::Interrupted);
            }
            let allowed = self.allowed(&pose, target, length);
            let allowed = ending.map_or(allowed, |_| allowed.min(finest));
            let first = if length <= near { Exact } else { Definite };
            let (step, kind) = self.safe_step((&pose, target), (first, allowed), length, steps)?;
            if kind != first {
                near = RETRY_EXACT * length;
            }
            solve.iterations += 1;
            let before = std::mem::replace(&mut length, step.length());
            solve.history.push(length);
            let goal = self.options.tolerance * reach(&pose, target);
            let (lengths, is_stiff) = (&solve.history[start..], self.tissue.contrast > STIFF_PARTS);
            let left =
                if is_stiff { left_after(lengths, goal) } else { left_at_rate(length, before) };
            let bound = ending.filter(|_| length <= goal).unwrap_or(left + allowed);
            ending = (bound <= goal).then_some(bound);
            if ending.is_some() && allowed <= finest {
                let end = moved_by(&self.reduction, &pose.u, &step.rows, 1.0);
                let bound = bound / (1.0 - self.rate(&pose, &end, target, &steps.conditions())?);
                if bound <= goal {
                    solve.error_estimate = bound;
                    return Ok(end);
                }
                ending = None;
            }
            pose = self.search(pose, target, &step, kind, on_walls)?;
            let (next, has_moved) = self.eased(pose, target, &steps.conditions())?;
            pose = next;
            if has_moved {
                steps.resume(&pose);
            }
            let is_near = bound <= NEAR_ENOUGH * reach(&pose, target);
            if is_near && self.has_barrier_ahead(target) && self.energy.is_at_barrier(&pose.u) {
                return Ok(pose.u);
            }
        }
        let limit = self.options.tolerance * reach(&pose, target);
        Err(lost("the estimated error of a node", length, limit, " mm"))
    }

    /// The step from `pose` with the tangent `first` and the error `allowed`, mm, or with the definite tangent
    /// where the exact one is indefinite; and the tangent used. `before`: length of the step before, mm.
    fn safe_step(
        &self,
        (pose, target): (&Iterate, &Target<'_>),
        (first, allowed): (TangentKind, f64),
        before: f64,
        steps: &mut impl StepRule,
    ) -> Result<(NewtonStep, TangentKind)> {
        let (step, kind) = by_tangent(first, |kind| steps.next(pose, (kind, allowed)))?;
        // Conjugate gradients do not always notice that a tangent is indefinite.
        let by_factor = matches!(self.solver, TangentSolver::Cholesky(_));
        let is_long = !by_factor && kind == Exact && step.length() > LONGER * before;
        if is_long && !self.descends_fully(pose, target, &step) {
            return Ok((steps.next(pose, (Definite, allowed))?, Definite));
        }
        Ok((step, kind))
    }

    /// Share of the error of `pose` that is left at `end`, after a step: that of the row furthest from equilibrium
    /// on its own. Where tets are squeezed flat, a short step may be followed by a longer one.
    fn rate(
        &self,
        pose: &Iterate,
        end: &[[f64; 3]],
        target: &Target<'_>,
        conditions: &RowConditions,
    ) -> Result<f64> {
        let goal = self.options.tolerance * reach(pose, target);
        let end = self.pose(end.to_vec(), target)?;
        let (before, after) = (self.furthest(pose, conditions), self.furthest(&end, conditions));
        // What is left may be rounding.
        Ok(if after <= QUADRATIC * goal { 0.0 } else { (after / before).min(1.0) })
    }

    /// Whether the whole `step` goes downhill.
    fn descends_fully(&self, pose: &Iterate, target: &Target<'_>, step: &NewtonStep) -> bool {
        let end = moved_by(&self.reduction, &pose.u, &step.rows, 1.0);
        // Without an energy at its end it does not.
        self.pose(end, target).is_ok_and(|end| step.descends(pose, &end, 1.0))
    }

    /// The state at the end of `step`, shortened until it lies downhill, up to the slack of the step.
    ///
    /// If the tangent is not that of the energy, steps are lengthened as long as the energy keeps decreasing: a
    /// curvature with its sign reversed limits how far the quadratic model can be trusted, but does not locate
    /// the minimum. Rows `on_walls` stay at the end of the step.
    fn search(
        &self,
        pose: Iterate,
        target: &Target<'_>,
        step: &NewtonStep,
        kind: TangentKind,
        on_walls: &[u32],
    ) -> Result<Iterate> {
        let at = |share: f64| {
            let mut u = moved_by(&self.reduction, &pose.u, &step.rows, share);
            if share > 1.0 {
                for &row in on_walls {
                    let j = self.reduction.unknowns[row as usize] as usize;
                    u[j] = add(pose.u[j], step.rows[row as usize]);
                }
            }
            self.pose(u, target)
        };
        let found = first_of_halves(SHORTEST, |share| match at(share) {
            Ok(next) => step.descends(&pose, &next, share).then_some(Ok(next)),
            Err(error) => Some(Err(error)),
        });
        let Some((next, mut share)) = found else {
            let quantity = "the share of the last step that lowers the energy";
            return Err(lost(quantity, 0.5 * SHORTEST, SHORTEST, ""));
        };
        let mut next = next?;
        while kind == Definite
            && (1.0..LONGEST).contains(&share)
            && still_falls(&step.rows, &next, on_walls)
        {
            share *= 2.0;
            let further = at(share)?;
            if further.merit >= next.merit - rounding(&pose, &next) {
                break;
            }
            next = further;
        }
        Ok(next)
    }
}

impl NewtonStep {
    /// Largest displacement, mm.
    pub(super) fn length(&self) -> f64 {
        self.rows.iter().fold(0.0, |m, v| m.max(norm(*v)))
    }

    /// Whether `end`, at `share` of the step from `pose`, lies downhill, up to the slack of the step.
    fn descends(&self, pose: &Iterate, end: &Iterate, share: f64) -> bool {
        let descent = Descent { slope: self.slope, slack: self.slack + rounding(pose, end) };
        descent.accepts(share, pose.merit, end.merit)
    }
}

/// Bound of the error after steps of these `lengths`, mm, if each of the last ones may have been too short: the
/// longest of the last three, and all that follow at the rate from the three before. `goal` is the error that is
/// asked for, mm.
fn left_after(lengths: &[f64], goal: f64) -> f64 {
    let longest = |lengths: &[f64]| lengths.iter().copied().fold(0.0, f64::max);
    let (earlier, last) = lengths.split_at(lengths.len().saturating_sub(WINDOW));
    if let [before @ .., now] = last
        && *now <= QUADRATIC * before.last().map_or(goal, |before| before.max(goal))
    {
        return *now;
    }
    let before = longest(&earlier[earlier.len().saturating_sub(WINDOW)..]);
    let rate = (longest(last) / before).powf(1.0 / WINDOW as f64);
    if rate < 1.0 { longest(last) / (1.0 - rate) } else { f64::INFINITY }
}

/// Error after a step of a `length` that followed one of the length `before`, mm.
fn left_at_rate(length: f64, before: f64) -> f64 {
    if length == 0.0 {
        return 0.0;
    }
    // Convergence is at least linear, at the rate of the last step: with a tangent that is not that of the energy
    // for good, with the exact one until steps are short.
    length / (1.0 - (length / before).min(1.0))
}

/// Whether the merit of `pose` still falls along `rows`, without those `on_walls`, which go no further.
fn still_falls(rows: &[[f64; 3]], pose: &Iterate, on_walls: &[u32]) -> bool {
    let held: f64 =
        on_walls.iter().map(|&row| dot(rows[row as usize], pose.slope[row as usize])).sum();
    along_slope(rows, pose) < held
}

/// Rounding error of the difference in energy of two states, N mm.
fn rounding(one: &Iterate, other: &Iterate) -> f64 {
    ENERGY_ROUNDING * one.size.max(other.size)
}

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
