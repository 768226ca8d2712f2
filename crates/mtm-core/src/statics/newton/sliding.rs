//! Newton's method with contact solved in every step: the tangent system is solved under the contact conditions
//! themselves, not under their linearisation. Each step then costs as much as a plan of a linear body, whereas
//! contact iterations around Newton's method would cost a whole Newton run for every set of normals.

use std::borrow::Cow;

use crate::boundary::Motion;
use crate::contact::{ContactResult, Sliding};
use crate::error::Result;
use crate::mechanics::strain_energy::TangentKind::{self, Definite, Exact};
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::linear::system::{BodyRows, System};
use crate::statics::newton::descent::{NewtonStep, StepRule, by_tangent};
use crate::statics::newton::hierarchy::HierarchyResult;
use crate::statics::newton::{
    Equilibrium, Iterate, STEP_SHARE, STEP_TOLERANCE, TangentSolver, Target, along_slope, moved_by,
    reach,
};
use crate::statics::options::{Interrupt, Method, StaticOptions};
use crate::statics::plans::settling::{ContactSolve, RowLinks, WarmStart};
use crate::statics::restraint::Support;
use crate::statics::solution::Clock;
use crate::vector::{add, sub};

/// Sliding nodes of a body, with the input of their solver.
pub(crate) struct SlidingBody<'a> {
    pub sliding: &'a Sliding,
    /// One motion per segment.
    pub motions: &'a [&'a Motion],
    /// How the body is held.
    pub held: Support,
}

/// Starting state of a step: displacements of the nodes that are not unknowns, none if they do not move, and the
/// previous contact state.
type Start<'a> = (Option<&'a [[f64; 3]]>, Option<&'a ContactResult>);

/// Steps of a body in contact.
struct InContact<'a, 'i> {
    equilibrium: &'a Equilibrium,
    target: &'a Target<'a>,
    slide: &'a SlidingBody<'a>,
    /// State after the last step.
    contact: ContactResult,
    /// Error allowed in the last step, and that which keeps contact within its required accuracy, mm.
    before: f64,
    fine: f64,
    interrupted: Interrupt<'i>,
}

impl StepRule for InContact<'_, '_> {
    fn next(&mut self, pose: &Iterate, how: (TangentKind, f64)) -> Result<NewtonStep> {
        let (body, start) = ((self.target, self.slide), (None, Some(&self.contact)));
        let (rows, state) = self.equilibrium.settled(pose, body, start, how, self.interrupted)?;
        let iterations = self.contact.iterations + state.iterations;
        self.contact = ContactResult { iterations, ..state };
        // Walls do no work along themselves, and their work across gaps does not enter the energy of the body.
        let gaps = 2.0 * how.1.max(self.before).max(self.fine);
        self.before = how.1;
        let slack = self.contact.forces.iter().map(|f| f.abs() * gaps).sum();
        Ok(NewtonStep { slope: along_slope(&rows, pose).min(0.0), slack, rows })
    }

    fn conditions(&self) -> Cow<'_, RowConditions> {
        Cow::Owned(RowConditions::of_state(self.slide.sliding, &self.contact))
    }

    fn resume(&mut self, pose: &Iterate) {
        let ContactResult { displacements, reactions, .. } = &mut self.contact;
        let nodes = &self.slide.sliding.nodes;
        for ((node, u), force) in nodes.iter().zip(displacements).zip(reactions) {
            (*u, *force) = (pose.u[node.node as usize], pose.slope[node.row as usize]);
        }
    }
}

impl Equilibrium {
    /// The state of `target` with contact at equilibrium, from rest.
    ///
    /// # Errors
    /// `NotConverged` if the steps do not converge, and any error of contact and of the solver.
    pub(super) fn slide(
        &self,
        target: &Target<'_>,
        slide: &SlidingBody<'_>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<(Vec<[f64; 3]>, ContactResult)> {
        let interrupted = solve.interrupted;
        let rest = self.pose(vec![[0.0; 3]; target.prescribed.len()], target)?;
        let mut change = target.prescribed.to_vec();
        for &j in &self.reduction.unknowns {
            change[j as usize] = [0.0; 3];
        }
        // Walls move the body even if no node is joined to one.
        let far = slide.sliding.farthest(slide.motions).max(reach(&rest, target));
        let first = far * STEP_SHARE.max(STEP_TOLERANCE * self.options.tolerance);
        let ((rows, contact), _) = by_tangent(Exact, |kind| {
            let start = (Some(&change[..]), None);
            self.settled(&rest, (target, slide), start, (kind, first), interrupted)
        })?;
        target.hierarchy.leave_rest(&self.at_rest);
        solve.iterations += 1;
        let ahead: Vec<[f64; 3]> = rest.u.iter().zip(&change).map(|(a, b)| add(*a, *b)).collect();
        let pose = self.pose(moved_by(&self.reduction, &ahead, &rows, 1.0), target)?;
        // Error of a step that keeps contact within its required accuracy, mm.
        let fine = slide.sliding.gap_limit(&self.options.contact);
        let on_walls: Vec<u32> = slide.sliding.nodes.iter().map(|n| n.row).collect();
        let (equilibrium, before) = (self, first);
        let mut steps =
            InContact { equilibrium, target, slide, contact, before, fine, interrupted };
        let u = self.descend(pose, target, (fine, &on_walls), &mut steps, solve)?;
        if !self.energy.is_at_barrier(&u) {
            return Ok((u, steps.contact));
        }
        let target =
            &Target { energy: &self.energy, conditions: RowConditions::default(), ..*target };
        target.tangents.borrow_mut().forget();
        let mut steps = InContact { target, ..steps };
        let pose = self.pose(u, target)?;
        let (pose, has_moved) = self.eased(pose, target, &steps.conditions())?;
        if has_moved {
            steps.resume(&pose);
        }
        let u = self.descend(pose, target, (fine, &on_walls), &mut steps, solve)?;
        Ok((u, steps.contact))
    }

    /// The step of the rows that solves the tangent system at `pose` with contact at equilibrium.
    ///
    /// `how`: the tangent, and the error allowed in the step, mm.
    fn settled(
        &self,
        pose: &Iterate,
        (target, slide): (&Target<'_>, &SlidingBody<'_>),
        (change, contact): Start<'_>,
        (kind, allowed): (TangentKind, f64),
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, ContactResult)> {
        let here = self.reduction.rows(&pose.u);
        // Closest points cannot converge further than the solves do.
        let far = reach(pose, target);
        let share = if far > 0.0 { allowed / far } else { STEP_SHARE };
        let mut options = self.step_options(share);
        options.contact.allowed = allowed;
        let positions = self.reduction.rows(self.tensors.element_nodes().positions());
        target.hierarchy.serve(kind == Definite, |multigrid| {
            let (matrix, mut b) = self.tangent((pose, target), kind, change)?;
            // K (x − u) = −slope: the contact conditions apply to x, the whole displacement.
            for (b, f) in b.iter_mut().zip(matrix.multiply(&here)) {
                *b = add(*b, f);
            }
            let body = BodyRows {
                positions: &positions,
                sliding: Some(slide.sliding),
                held: slide.held,
                liftable: (&[], &[]),
                tissue: self.tissue,
                multigrid,
            };
            let (system, _) = System::new(matrix, &body, &options, &mut Clock::new(), interrupted)?;
            let contact = contact.map(|state| slide.sliding.start_of(state));
            let settle = ContactSolve {
                sliding: slide.sliding,
                motions: slide.motions,
                begin: contact.map(|contact| WarmStart { rows: &here, contact }),
                options: &options,
                linked: RowLinks::default(),
            };
            let mut solve = PlanSolve::new(target.scale, interrupted);
            let found = system.solve_with_contact(&b, &settle, &mut solve)?;
            let (rows, contact) = (found.rows, found.contact.expect("a solve with contact"));
            let step = rows.iter().zip(&here).map(|(x, u)| sub(*x, *u)).collect();
            // Under contact only the hierarchy at rest is kept, for other plans: iterations with that of an earlier
            // tangent cost more than a new one.
            let multigrid = change.and_then(|_| system.multigrid().cloned());
            let iterations = solve.iterations;
            Ok(HierarchyResult { value: (step, contact), multigrid, iterations })
        })
    }

    /// Options of the system of one step, with an error of at most `share` of the reach.
    fn step_options(&self, share: f64) -> StaticOptions {
        let method = match self.solver {
            TangentSolver::Cholesky(_) => Method::Cholesky,
            TangentSolver::Pcg => Method::Pcg,
        };
        StaticOptions { method, tolerance: share.max(f64::EPSILON), ..self.options }
    }
}
