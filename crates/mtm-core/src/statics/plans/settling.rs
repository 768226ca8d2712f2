//! A body under contact conditions: systems solved again for each set of them, and the responses of bodies by a
//! kept flexibility or by iteration.

use std::borrow::Cow;
use std::sync::Arc;

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::cholesky::{Factor, Symbolic};
use crate::algebra::constraints::{Constraint, add_offsets, projected_rhs};
use crate::algebra::krylov::StepAccuracy;
use crate::algebra::row_sums::in_pool;
use crate::boundary::{Boundary, Motion};
use crate::contact::links::Link;
use crate::contact::{Body, Constraints, ContactResult, ContactStart, Response, Sliding};
use crate::error::{ErrorKind, MtmError, Result};
use crate::mechanics::kinematics::Kinematics;
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::iterative::{Advance, Iterative, KeptForNext, SolveMemory};
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::options::{Method, StaticOptions};
use crate::statics::plans::reaction::{Answers, ContactFactor};
use crate::statics::solution::{Clock, SolvedRows};
use crate::vector::{between, dot, norm, sub};

/// Tolerance of contact as a share of the error allowed in an iterative solve: contact cannot converge further
/// than successive solves agree.
const CONTACT_SHARE: f64 = 0.1;

/// Multiple of a factorisation's trial error that is taken as the error of any solution by it. A factor of ten
/// was too small for one solution in 300 of `benches/stability/error_estimate.rs`, most of them with contact.
const TRIAL_SAFETY: f64 = 100.0;

/// Multiple of the largest remaining contact gap that is taken as the error of a solution with contact.
const GAP_SAFETY: f64 = 10.0;

/// The matrix of a system that is solved again for each set of constraints.
pub(crate) enum Unfactored {
    /// By factorisations with the same structure, whose values change with the contact normals.
    Refactored { symbolic: Arc<Symbolic>, matrix: BlockMatrix },
    /// By iteration.
    Iterative(Box<Iterative>),
}

impl Unfactored {
    /// The matrix without constraints.
    pub fn matrix(&self) -> &BlockMatrix {
        match self {
            Self::Iterative(iterative) => &iterative.matrix,
            Self::Refactored { matrix, .. } => matrix,
        }
    }

    /// Displacements of the rows at contact equilibrium.
    pub fn settled(
        &self,
        b: &[[f64; 3]],
        settle: &ContactSolve<'_>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<SolvedRows> {
        let clock = Clock::new();
        let ContactSolve { sliding, motions, begin, options, linked } = settle;
        let rows = begin.as_ref().map_or(&[][..], |b| b.rows);
        let first = begin.as_ref().map(|b| &b.contact);
        let mut contact = options.contact;
        if let Self::Iterative(_) = self {
            let far = solve.scale.max(sliding.farthest(motions));
            contact.allowed = contact.allowed.max(CONTACT_SHARE * options.tolerance * far);
        }
        let trail = SolveMemory::starting(rows.to_vec());
        let interrupted = solve.interrupted;
        let linked = *linked;
        let mut body = Projected { system: self, b, linked, sliding, trail, solve, last: None };
        let state = sliding.solve(motions, first, &contact, interrupted, &mut body)?;
        // At least one step is always made, so there is a state.
        let rows = body.last.map_or_else(Vec::new, |last| last.to);
        // A step that need not be exact estimates its own error, whatever the contrast.
        if let Self::Iterative(iterative) = self
            && iterative.doubtful
            && linked.share.is_none()
        {
            iterative.check_worth(&rows, body.solve)?;
        }
        body.solve.leaves(left_by(&state));
        Ok(SolvedRows::new(rows, Some(state), clock.total()))
    }

    /// Rows of the projected system, P A P + k (I − P), P = I − n⊗n on held nodes.
    pub fn solve_projected(
        &self,
        b: &[[f64; 3]],
        (sliding, linked): (&Sliding, RowLinks<'_>),
        c: &Constraints<'_>,
        trail: &mut SolveMemory,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Advance> {
        let conditions = RowConditions::new(sliding, c);
        if let (Self::Iterative(iterative), Some(pressing)) = (self, linked.pressing()) {
            let start = std::mem::take(&mut trail.rows);
            return iterative.press(b, conditions, pressing, start, solve);
        }
        let b = linked.pulled(b, &conditions.constraints);
        let mut rhs = projected_rhs(self.matrix(), &b, &conditions.constraints);
        conditions.add_pull(&mut rhs);
        let offsets = conditions.constraints.clone();
        let mut found = match self {
            Self::Iterative(iterative) => {
                let enough = match linked.share {
                    Some(rough) => Some(StepAccuracy::Energy(rough)),
                    None => (c.share > 0.0).then_some(StepAccuracy::Error(c.share)),
                };
                let leave = KeptForNext { reach: c.reach, enough, links: linked.links };
                iterative.solve_projected(rhs, conditions, leave, trail, solve)?
            }
            Self::Refactored { .. } if !linked.links.is_empty() => {
                return Err(touching_needs_pcg(Method::Cholesky));
            }
            Self::Refactored { symbolic, matrix } => {
                let factor = symbolic.factor(&conditions.applied_to(matrix))?;
                let rows = factor.solve(&rhs);
                solve.error_estimate = direct_error(&factor, &rows);
                Advance { rows, solved: true, is_carried: false }
            }
        };
        add_offsets(&mut found.rows, &offsets);
        Ok(found)
    }
}

/// Input of a contact solve.
pub(crate) struct ContactSolve<'a> {
    pub sliding: &'a Sliding,
    /// One motion per segment.
    pub motions: &'a [&'a Motion],
    pub begin: Option<WarmStart<'a>>,
    pub options: &'a StaticOptions,
    pub linked: RowLinks<'a>,
}

/// Links between the rows of touching nodes.
#[derive(Clone, Copy, Default)]
pub(crate) struct RowLinks<'a> {
    pub links: &'a [Link],
    /// Error allowed relative to the change that the links cause, in the energy norm; none for an answer within
    /// the tolerance.
    pub share: Option<f64>,
}

impl RowLinks<'_> {
    /// The links and the share, where links only push: before an answer within the tolerance is wanted.
    pub fn pressing(&self) -> Option<(&[Link], f64)> {
        self.share.filter(|_| !self.links.is_empty()).map(|share| (self.links, share))
    }

    /// `b` with the forces of the links, where rows satisfy their constraints.
    fn pulled<'b>(&self, b: &'b [[f64; 3]], constraints: &[Constraint]) -> Cow<'b, [[f64; 3]]> {
        if self.links.is_empty() {
            return Cow::Borrowed(b);
        }
        let (mut shift, mut out) = (vec![[0.0; 3]; b.len()], b.to_vec());
        add_offsets(&mut shift, constraints);
        for link in self.links {
            link.add(link.pull(&shift), &mut out);
        }
        Cow::Owned(out)
    }
}

/// Starting state of a solve with contact: the end of a solve for a similar plan or body.
pub(crate) struct WarmStart<'a> {
    /// Displacements of the rows.
    pub rows: &'a [[f64; 3]],
    pub contact: ContactStart,
}

/// Displacements of the rows at contact equilibrium, found from the flexibility of the sliding nodes.
pub(crate) fn settled_by_flexibility(
    factor: &Factor,
    contact: &ContactFactor,
    b: &[[f64; 3]],
    settle: &ContactSolve<'_>,
    solve: &mut PlanSolve<'_>,
) -> Result<SolvedRows> {
    let clock = Clock::new();
    let ContactSolve { sliding, motions, begin, options, .. } = settle;
    let first = begin.as_ref().map(|b| &b.contact);
    // Run on a thread of the pool, so that inner loops start without a hand-over; but one at a time, since
    // interrupts must be checked on the calling thread.
    let answers = in_pool(|| contact.answers(factor, b));
    let tolerance = sliding.gap_limit(&options.contact) / sliding.diagonal;
    let mut body = Flexible { answers, tolerance, last: None, is_known: false };
    let state = sliding.solve(motions, first, &options.contact, solve.interrupted, &mut body)?;
    let contact_seconds = clock.total();
    let rows = in_pool(|| body.answers.of_all(&state.reactions));
    solve.error_estimate = direct_error(factor, &rows).max(left_by(&state));
    Ok(SolvedRows::new(rows, Some(state), contact_seconds))
}

/// The body reduced to its sliding nodes: every other node follows them exactly.
struct Flexible<'a> {
    answers: Answers<'a>,
    tolerance: f64,
    last: Option<RowStep>,
    /// Whether the forces at the start of the last step are known.
    is_known: bool,
}

/// A step of some rows with the residual forces at its ends, N.
pub(crate) struct RowStep {
    from: Vec<[f64; 3]>,
    pub to: Vec<[f64; 3]>,
    forces_from: Vec<[f64; 3]>,
    forces_to: Vec<[f64; 3]>,
}

impl RowStep {
    /// Slopes of the energy along the step, at its start and at its end.
    fn slopes(&self) -> (f64, f64) {
        let (mut first, mut last) = (0.0, 0.0);
        let forces = self.forces_from.iter().zip(&self.forces_to);
        for ((a, b), (f, g)) in self.from.iter().zip(&self.to).zip(forces) {
            let way = sub(*b, *a);
            first += dot(*f, way);
            last += dot(*g, way);
        }
        (first, last)
    }

    /// Shortens the step to `share` of its length; the energy is quadratic, the forces are linear.
    fn shorten(&mut self, share: f64) {
        self.to = between(&self.from, &self.to, share);
        self.forces_to = between(&self.forces_from, &self.forces_to, share);
    }
}

impl Body for Flexible<'_> {
    fn respond(&mut self, c: &Constraints<'_>) -> Result<Response> {
        let Self { answers, tolerance, .. } = self;
        let mut response = in_pool(|| answers.respond(c, *tolerance))?;
        let (to, forces_to) = (response.displacements.clone(), response.reactions.clone());
        let before = self.last.take().map(|last| (last.to, last.forces_to));
        self.is_known = before.is_some();
        let (from, forces_from) = before.unwrap_or_else(|| (to.clone(), forces_to.clone()));
        let step = RowStep { from, to, forces_from, forces_to };
        response.slopes = self.is_known.then(|| step.slopes());
        self.last = Some(step);
        Ok(response)
    }

    fn shorten(&mut self, share: f64) {
        if !self.is_known {
            // The response after a shortened step depends on the forces at its start.
            self.last = None;
        } else if let Some(step) = &mut self.last {
            step.shorten(share);
        }
    }

    fn restart(&mut self) {
        self.last = None;
    }
}

/// The body with all its rows, those of held nodes projected.
pub(crate) struct Projected<'a, 'i> {
    pub system: &'a Unfactored,
    pub b: &'a [[f64; 3]],
    pub linked: RowLinks<'a>,
    pub sliding: &'a Sliding,
    pub trail: SolveMemory,
    pub solve: &'a mut PlanSolve<'i>,
    pub last: Option<RowStep>,
}

impl Projected<'_, '_> {
    /// Residual forces of all rows, A x − b minus those of the links.
    fn forces(&self, x: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut out = self.system.matrix().multiply(x);
        for (f, b) in out.iter_mut().zip(self.b) {
            *f = sub(*f, *b);
        }
        for link in self.linked.links {
            let force = link.pull(x);
            let only_pushes = self.linked.share.is_some();
            link.add(if only_pushes { -force.max(0.0) } else { -force }, &mut out);
        }
        out
    }
}

impl Body for Projected<'_, '_> {
    fn respond(&mut self, c: &Constraints<'_>) -> Result<Response> {
        let (from, forces_from) = match self.last.take() {
            Some(last) => (last.to, last.forces_to),
            None => {
                let mut rows = std::mem::take(&mut self.trail.rows);
                rows.resize(self.b.len(), [0.0; 3]);
                for (node, &u) in self.sliding.nodes.iter().zip(c.about) {
                    rows[node.row as usize] = u;
                }
                let forces = self.forces(&rows);
                (rows, forces)
            }
        };
        self.trail.rows.clone_from(&from);
        let nodes = (self.sliding, self.linked);
        let found = self.system.solve_projected(self.b, nodes, c, &mut self.trail, self.solve);
        let Advance { rows: x, solved, is_carried } = match found {
            Ok(found) => found,
            Err(error) => {
                let (to, forces_to) = (from.clone(), forces_from.clone());
                self.last = Some(RowStep { from, to, forces_from, forces_to });
                return Err(error);
            }
        };
        let forces = self.forces(&x);
        let of = |rows: &[[f64; 3]]| {
            self.sliding.nodes.iter().map(|n| rows[n.row as usize]).collect::<Vec<_>>()
        };
        let (displacements, reactions) = (of(&x), of(&forces));
        let step = RowStep { from, to: x, forces_from, forces_to: forces };
        let slopes = Some(step.slopes());
        self.last = Some(step);
        // An approximate round is solved once it is as accurate as requested.
        let solved = solved || self.linked.share.is_some();
        Ok(Response { displacements, reactions, slopes, solved, is_carried })
    }

    fn shorten(&mut self, share: f64) {
        if let Some(step) = &mut self.last {
            step.shorten(share);
        }
    }

    fn restart(&mut self) {
        if let Some(last) = self.last.take() {
            self.trail.rows = last.to;
        }
    }
}

/// Error left by contact, mm.
pub(crate) fn left_by(state: &ContactResult) -> f64 {
    GAP_SAFETY * state.largest_gap().max(state.unbalanced)
}

/// Estimate of the largest nodal error of a solution by factorisation, mm.
pub(crate) fn direct_error(factor: &Factor, x: &[[f64; 3]]) -> f64 {
    TRIAL_SAFETY * factor.trial_error * x.iter().fold(0.0_f64, |m, v| m.max(norm(*v)))
}

/// The error for a method that cannot solve for parts that touch.
pub(crate) fn touching_needs_pcg(method: Method) -> MtmError {
    not_touching(("method", method.name()), "auto or pcg")
}

fn not_touching(found: (&'static str, &str), needed: &'static str) -> MtmError {
    ErrorKind::Solver.not_together(found, "a boundary with touching pairs", needed)
}

/// The method for `boundary`: with pairs that may touch, every round changes the matrix, and would need a new
/// factorisation.
pub(crate) fn method_for(boundary: &Boundary, options: &StaticOptions) -> Result<Method> {
    if boundary.touching().is_empty() {
        return Ok(options.method);
    }
    if options.kinematics != Kinematics::Linear {
        return Err(not_touching(("kinematics", options.kinematics.name()), "linear"));
    }
    match options.method {
        Method::Auto | Method::Pcg => Ok(Method::Pcg),
        other => Err(touching_needs_pcg(other)),
    }
}
