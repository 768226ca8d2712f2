//! Newton's method with contact settled in every step: the tangent system is solved under the contact
//! conditions themselves, not under their slope. Each step then costs what a plan of a linear body costs,
//! where contact round Newton's method would cost a whole run of it for every set of normals.

use crate::boundary::Motion;
use crate::contact::{ContactState, Sliding};
use crate::equilibrium::{
    Equilibrium, MAX_STEPS, NEAR_REST, Pose, STEP_SHARE, TangentSolver, Target, moved_by, reach,
};
use crate::error::{MtmError, Result};
use crate::iterative::Effort;
use crate::mesh::{add, dot, norm, scaled, sub};
use crate::method::{Interrupt, Method, StaticOptions};
use crate::reduction::Reduction;
use crate::restraint::Held;
use crate::solution::Clock;
use crate::strain_energy::TangentKind::{self, Definite, Exact};
use crate::system::{Begin, System};

/// Sliding nodes of a body with what their solver asks.
pub(crate) struct Slide<'a> {
    pub sliding: &'a Sliding,
    /// One of each segment.
    pub motions: &'a [&'a Motion],
    /// How the body is held.
    pub held: Held,
}

impl Slide<'_> {
    /// Largest motion of a sliding node that clings to its segment, mm.
    fn far(&self) -> Result<f64> {
        let surfaces = self.sliding.moved_surfaces(self.motions)?;
        let (carried, _) = self.sliding.carried(self.motions, &surfaces);
        let moved = carried.iter().zip(&self.sliding.positions).map(|(c, x)| norm(sub(*c, *x)));
        Ok(moved.fold(0.0, f64::max))
    }
}

impl Equilibrium {
    /// The state that `target` asks for with contact settled, from rest.
    ///
    /// # Errors
    /// `NotConverged` where the steps do not end, whatever contact and the solver report.
    pub(super) fn slide(
        &self,
        reduction: &Reduction,
        target: &Target<'_>,
        slide: &Slide<'_>,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, ContactState)> {
        let rest = self.pose(reduction, vec![[0.0; 3]; target.prescribed.len()], target)?;
        let mut change = target.prescribed.to_vec();
        for &j in &reduction.unknowns {
            change[j as usize] = [0.0; 3];
        }
        // Walls move the body also where no node is joined to one.
        let far = slide.far()?.max(reach(&rest, target));
        let first = (Exact, STEP_SHARE * far);
        let (step, mut contact) = self.settled_step(
            reduction,
            &rest,
            target,
            Some(&change),
            slide,
            None,
            first,
            interrupted,
        )?;
        effort.iterations += 1;
        let ahead: Vec<[f64; 3]> = rest.u.iter().zip(&change).map(|(a, b)| add(*a, *b)).collect();
        let mut pose = self.pose(reduction, moved_by(reduction, &ahead, &step, 1.0), target)?;
        // Error of a step that leaves contact as settled as it was asked for, mm.
        let fine = self.options.contact.tolerance * slide.sliding.diagonal;
        let (mut length, mut last, mut before) = (f64::INFINITY, false, first.1);
        for _ in 0..MAX_STEPS {
            if interrupted() {
                return Err(MtmError::Interrupted);
            }
            let mut allowed = self.allowed(&pose, target, length);
            if last {
                allowed = allowed.min(fine);
            }
            let near = length <= NEAR_REST * reach(&pose, target);
            let by_factor = matches!(self.solver, TangentSolver::Cholesky(_));
            let kind = if near || by_factor { Exact } else { Definite };
            let (step, state) = self.settled_step(
                reduction,
                &pose,
                target,
                None,
                slide,
                Some(&contact),
                (kind, allowed),
                interrupted,
            )?;
            effort.iterations += 1;
            contact = ContactState { iterations: contact.iterations + state.iterations, ..state };
            length = step.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
            effort.history.push(length);
            last = length + allowed <= self.options.tolerance * reach(&pose, target);
            if last && allowed <= fine {
                effort.error_bound = length + allowed;
                return Ok((moved_by(reduction, &pose.u, &step, 1.0), contact));
            }
            // Walls do no work along themselves, and what they do through gaps is not of the body.
            let slope: f64 = step.iter().zip(&pose.slope).map(|(&d, &s)| dot(d, s)).sum();
            let gaps = 2.0 * allowed.max(before).max(fine);
            let through: f64 = contact.forces.iter().map(|f| f.abs() * gaps).sum();
            before = allowed;
            pose = self.search(reduction, pose, target, &step, slope.min(0.0), through)?;
        }
        Err(self.lost(length, target.scale))
    }

    /// The step of the rows that solves the tangent system at `pose` with contact settled.
    ///
    /// `change`: how far the other nodes go. `begin`: where contact was.
    fn settled_step(
        &self,
        reduction: &Reduction,
        pose: &Pose,
        target: &Target<'_>,
        change: Option<&[[f64; 3]]>,
        slide: &Slide<'_>,
        begin: Option<&ContactState>,
        (kind, allowed): (TangentKind, f64),
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, ContactState)> {
        let here = reduction.rows(&pose.u);
        let solve = |kind: TangentKind| {
            let full = self.energy.stiffness(&pose.u, kind)?;
            // K (x − u) = −slope: the contact conditions are on x, the whole displacement.
            let mut b: Vec<[f64; 3]> = pose.slope.iter().map(|&s| scaled(s, -1.0)).collect();
            if let Some(change) = change {
                for (b, f) in b.iter_mut().zip(reduction.rows(&full.multiply(change))) {
                    *b = sub(*b, f);
                }
            }
            let matrix = reduction.matrix(&full);
            drop(full);
            for (b, f) in b.iter_mut().zip(matrix.multiply(&here)) {
                *b = add(*b, f);
            }
            // Closest points settle no nearer than the solves are.
            let far = reach(pose, target);
            let share = if far > 0.0 { allowed / far } else { STEP_SHARE };
            let mut options = self.step_options(share);
            let loose = allowed / slide.sliding.diagonal;
            options.contact.tolerance = options.contact.tolerance.max(loose);
            let (system, _) = System::new(
                matrix,
                &reduction.rows(self.tensors.element_nodes().positions()),
                Some(slide.sliding),
                slide.held,
                self.tensors.tissue().largest_lame_ratio(),
                &options,
                &mut Clock::new(),
                interrupted,
            )?;
            let begin = begin.map(|contact| Begin { rows: &here, contact });
            let (x, state, _) = system.solve_with_contact(
                &b,
                slide.sliding,
                slide.motions,
                begin,
                &options,
                target.scale,
                &mut Effort::default(),
                interrupted,
            )?;
            let step: Vec<[f64; 3]> = x.iter().zip(&here).map(|(x, u)| sub(*x, *u)).collect();
            Ok((step, state))
        };
        match solve(kind) {
            Err(MtmError::NotPositiveDefinite { .. } | MtmError::NotConverged { .. })
                if kind == Exact =>
            {
                solve(Definite)
            }
            other => other,
        }
    }

    /// Options of the system of one step, whose error may be `share` of the reach.
    fn step_options(&self, share: f64) -> StaticOptions {
        let method = match self.solver {
            TangentSolver::Cholesky(_) => Method::Cholesky,
            TangentSolver::Pcg => Method::Pcg,
        };
        StaticOptions { method, tolerance: share.max(f64::EPSILON), ..self.options }
    }
}
