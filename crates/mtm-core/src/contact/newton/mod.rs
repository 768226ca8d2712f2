//! The contact problem, solved by Newton's method: minimum elastic energy among the states whose sliding nodes
//! lie on their surfaces (bilateral), or on or above them (unilateral).
//!
//! Each step solves the body under the conditions linearised about the last state, including the curvature of
//! the surfaces under the contact forces. This is the Hessian of the Lagrangian, so steps near the solution
//! converge quadratically. A step is shortened until it decreases the augmented Lagrangian E − Σ λ φ + ½ Σ ρ φ²
//! (Rockafellar 1973; for inequalities the terms of nodes in the air are −λ²/2ρ), which has its minimum at the
//! solution for any sufficiently large ρ. ρ only grows, so no state is visited twice. Force and gap together
//! decide which nodes are held (primal-dual active set; Hintermüller, Ito & Kunisch 2002).
//!
//! Contact forces on convex bone drive sliding nodes further along, sometimes by more than the tissue can
//! resist: a node slips over an edge. The body then decides how far to go, within a limit (the carry) that
//! grows and shrinks with the length of the accepted steps (a trust region). The first steps of a large plan
//! take nodes far off their surfaces along the tangents at rest; these nodes are moved back onto their surfaces
//! before the next linearisation.

mod merit;
mod problem;

use crate::boundary::Motion;
use crate::contact::newton::problem::{ContactProblem, farthest};
use crate::contact::seat::Seats;
use crate::contact::{Body, ContactOptions, ContactResult, ContactStart, Sliding};
use crate::error::{ErrorKind, MtmError, Result};

/// How far contact forces may carry nodes in the first step, and in any step, over the reach of the surfaces.
const FIRST_CARRY: f64 = 1.0;
const MOST_CARRY: f64 = 4.0;
/// Number of steps at the beginning after which nodes far off their surfaces may be moved back onto them.
const MOST_APPROACHES: usize = 8;
/// Number of consecutive steps without progress that is tolerated.
const MOST_STALLS: usize = 3;
/// Ratio of the imbalance to its limit below which the next step is solved to full accuracy, since it reduces
/// the imbalance far more.
const NEAR: f64 = 30.0;
/// Share of the limit of the imbalance below which a step from far away may be the last.
const CHANCE_SHARE: f64 = 0.01;
/// Largest tolerance over the diagonal of the mesh, for small scenes.
const MOST_TOLERANCE: f64 = 1e-5;
/// Rounding error that a displacement accumulates, in roundings of a coordinate.
const ROUNDINGS: f64 = 64.0;

impl Sliding {
    /// The contact state of `body` under `motions` (one per segment).
    ///
    /// `begin`: contact state for similar motions or a similar body; if none, the nodes start where they would
    /// be if they were attached to their segment.
    ///
    /// # Errors
    /// `ContactNotConverged` if the steps run out where a face would show it, `ContactSurface` if a node ends past
    /// the border of its surface, and any error of the body.
    pub fn solve(
        &self,
        motions: &[&Motion],
        begin: Option<&ContactStart>,
        options: &ContactOptions,
        interrupted: &(dyn Fn() -> bool + Sync),
        body: &mut dyn Body,
    ) -> Result<ContactResult> {
        let has_steps = options.max_iterations > 0;
        ErrorKind::Solver.require(has_steps, "contact_iterations", 0.0, "1 or more")?;
        let seats = Seats::new(self, motions)?;
        let problem = ContactProblem { sliding: self, seats: &seats, options };
        let mut state = problem.start(begin);
        let mut active = problem.held(&state, None);
        let mut penalty = merit::FIRST_PENALTY;
        let (mut stalls, mut near) = (0, false);
        let mut carry = FIRST_CARRY * seats.reach();
        // A plan near the one it starts from is solved as accurately as its first gaps are small.
        let first = begin.map(|_| farthest(&state.touches, &active));
        let (mut left, mut approaches) = (first.unwrap_or(f64::INFINITY), 0);
        let mut iteration = 0;
        loop {
            iteration += 1;
            if interrupted() {
                return Err(MtmError::Interrupted);
            }
            // The last state must be exact throughout the body, and a step that decreases no merit may fail only
            // for the inaccuracy of its solve.
            let accurate = near || stalls > 0 || iteration == options.max_iterations;
            let shares = problem.shares(left, accurate);
            let response = problem.step(&state, &active, carry, shares, body)?;
            let is_first = approaches == iteration - 1 && approaches < MOST_APPROACHES;
            let next = (is_first && iteration < options.max_iterations)
                .then(|| problem.put_back(&response, &active))
                .flatten();
            if let Some(next) = next {
                body.restart();
                (state, approaches) = (next, iteration);
                active = problem.held(&state, Some(&active));
                continue;
            }
            let found = problem.search(&state, &active, &response, near, &mut penalty);
            let way = found.as_ref().map_or(0.0, |(_, way)| *way);
            if way < 1.0 {
                body.shorten(way);
                carry *= way;
            } else if carry == 0.0 {
                carry = FIRST_CARRY * seats.reach();
            } else if response.is_carried {
                carry = (2.0 * carry).min(MOST_CARRY * seats.reach());
            }
            stalls = if way == 0.0 { stalls + 1 } else { 0 };
            if let Some((next, _)) = found {
                state = next;
            }
            let held = problem.held(&state, Some(&active));
            let changed = held != active;
            let (gap, unbalanced) = problem.left(&state, &active);
            left = gap.max(unbalanced);
            // A step from far away that happens to end in balance is followed by one from near, whose end is
            // as accurate as Newton's method makes it.
            let from_near = near || unbalanced <= CHANCE_SHARE * problem.balance();
            near = way == 1.0
                && !changed
                && !response.is_carried
                && gap <= self.gap_limit(options)
                && unbalanced <= NEAR * problem.balance();
            let done = near && from_near && response.solved && unbalanced <= problem.balance();
            if done || iteration == options.max_iterations || stalls > MOST_STALLS {
                let will_do = response.solved && gap.max(unbalanced) <= problem.unseen();
                if !(done || will_do) {
                    return Err(problem.far(&state, &active, iteration, (gap, unbalanced)));
                }
                return problem.end(state, &active, unbalanced, done, iteration);
            }
            active = held;
        }
    }

    /// Gap up to which a held node counts as on its surface, mm.
    pub fn gap_limit(&self, options: &ContactOptions) -> f64 {
        let furthest = self.positions.iter().flatten().fold(0.0_f64, |m, x| m.max(x.abs()));
        let tolerance = options.tolerance.min(MOST_TOLERANCE * self.diagonal);
        options.allowed.max(tolerance).max(ROUNDINGS * f64::EPSILON * furthest)
    }
}
