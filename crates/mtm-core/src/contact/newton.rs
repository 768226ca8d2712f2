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

use crate::boundary::Motion;
use crate::contact::seat::{Seats, Touch};
use crate::contact::{
    Body, Constraints, ContactMode, ContactOptions, ContactRow, ContactStart, ContactState,
    Response, Sliding, Spring,
};
use crate::error::{ErrorKind, MtmError, Result};
use crate::vector::{Vec3, add, between, dot, norm, scaled, sub};

/// Maximum number of nodes listed in an error.
const NAMED_NODES: usize = 10;
/// Share of a node's own stiffness below which a step ignores the change of direction of its contact force;
/// second, the same for a plan operator.
const SPRING_SHARE: f64 = 1e-2;
const FROZEN_SPRING_SHARE: f64 = 1e-3;
/// How far contact forces may carry nodes in the first step, and in any step, over the reach of the surfaces.
const FIRST_CARRY: f64 = 1.0;
const MOST_CARRY: f64 = 4.0;
/// Limits of the relative accuracy of a step, which is what the last step left open, over the spacing of the
/// surfaces: the next conditions differ by about as much.
const ROUGH_SHARE: f64 = 0.1;
const FINE_SHARE: f64 = 1e-4;
/// Smallest relative error of the forces of springs in a step, which the next step corrects; and their error in
/// what may be the last step, over the imbalance allowed at its end.
const SPRING_ERROR: f64 = 1e-3;
const LAST_SPRING_SHARE: f64 = 0.01;
/// Number of steps at the beginning after which nodes far off their surfaces may be moved back onto them.
const MOST_APPROACHES: usize = 8;
/// Maximum number of moves along the normals that bring nodes back onto their surfaces.
const RETRACTIONS: usize = 8;
/// Distance up to which nodes are moved back, over the reach of the surfaces: from further away they may meet
/// the wrong surface.
const MOST_RETRACTION: f64 = 10.0;
/// Initial penalty of the merit function over the own stiffness of each node.
const FIRST_PENALTY: f64 = 10.0;
/// Largest penalty over the own stiffness: above it, steps would only follow the surface.
const MOST_PENALTY: f64 = 1e4;
/// How much all other terms may increase the merit, as a share of the decrease due to closing gaps.
const CLOSING_SHARE: f64 = 0.5;
/// Number of consecutive steps without progress that is tolerated.
const MOST_STALLS: usize = 3;
/// Share of its slope by which the merit must decrease (Armijo 1966).
const DESCENT: f64 = 1e-4;
/// Share of its largest gap that a step may leave if the gap exceeds the reach of the surfaces.
const STEADY_GAP: f64 = 0.6;
/// Shortest step over the full one.
const SHORTEST: f64 = 1.0 / 64.0;
/// Rounding error of the merit over the work of all contact forces along the step.
const MERIT_ROUNDING: f64 = 1e-9;
/// Share of the tolerance by which the remaining tangential force may move a node on its own.
const BALANCE_SHARE: f64 = 0.1;
/// Ratio of the imbalance to its limit below which the next step is solved to full accuracy, since it reduces
/// the imbalance far more.
const NEAR: f64 = 30.0;
/// Share of the limit of the imbalance below which a step from far away may be the last.
const CHANCE_SHARE: f64 = 0.01;
/// Gap and imbalance too small to be visible on a face, in mm and over the diagonal of the mesh: a state within
/// these limits is returned even if the steps run out.
const UNSEEN: f64 = 0.02;
const UNSEEN_SHARE: f64 = 1e-4;
/// Largest tolerance over the diagonal of the mesh, for small scenes.
const MOST_TOLERANCE: f64 = 1e-5;
/// Rounding error that a displacement accumulates, in roundings of a coordinate.
const ROUNDINGS: f64 = 64.0;

/// A state of the sliding nodes.
struct State {
    displacements: Vec<[f64; 3]>,
    touches: Vec<Touch>,
    /// Forces of the bone; none before the first response of the body.
    reactions: Vec<[f64; 3]>,
    /// Contact forces along the normals, 0 for nodes in the air.
    forces: Vec<f64>,
}

impl Sliding {
    /// The contact state of `body` under `motions` (one per segment).
    ///
    /// `begin`: contact state for similar motions or a similar body; if none, the nodes start where they would
    /// be if they were attached to their segment.
    ///
    /// # Errors
    /// `ContactNotConverged` if the steps run out far from a solution, `ContactSurface` if a node ends beyond
    /// the border of its surface, and any error of the body.
    pub fn solve(
        &self,
        motions: &[&Motion],
        begin: Option<&ContactStart>,
        options: &ContactOptions,
        interrupted: &(dyn Fn() -> bool + Sync),
        body: &mut dyn Body,
    ) -> Result<ContactState> {
        if options.max_iterations == 0 {
            return Err(MtmError::OutOfRange {
                what: "contact_iterations".into(),
                index: 0,
                value: 0.0,
                allowed: "1 or more",
                kind: ErrorKind::Solver,
            });
        }
        let seats = Seats::new(self, motions)?;
        let problem = Problem { sliding: self, seats: &seats, options };
        let mut state = problem.start(begin);
        let mut active = problem.held(&state, None);
        let mut penalty = FIRST_PENALTY;
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
            let shares = problem.shares(left, near);
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
                    return Err(problem.far(&state, &active, iteration, gap));
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

/// One contact problem.
struct Problem<'a> {
    sliding: &'a Sliding,
    seats: &'a Seats<'a>,
    options: &'a ContactOptions,
}

/// A step of the nodes with its contact forces, before the line search.
struct Way<'a> {
    state: &'a State,
    /// Which nodes are held during the step.
    active: &'a [bool],
    /// Force on each node at its end, N.
    forces: Vec<f64>,
    /// Displacement of each node over it, mm.
    ways: Vec<[f64; 3]>,
}

impl Problem<'_> {
    fn count(&self) -> usize {
        self.sliding.nodes.len()
    }

    fn is_unilateral(&self) -> bool {
        self.options.mode == ContactMode::Unilateral
    }

    /// Distance, mm, by which the remaining tangential force may move each node on its own.
    fn balance(&self) -> f64 {
        BALANCE_SHARE * self.sliding.gap_limit(self.options)
    }

    /// Gap and imbalance too small to be visible on a face, mm.
    fn unseen(&self) -> f64 {
        UNSEEN.min(UNSEEN_SHARE * self.sliding.diagonal).max(self.options.allowed)
    }

    fn places(&self, displacements: &[[f64; 3]]) -> Vec<[f64; 3]> {
        self.sliding.positions.iter().zip(displacements).map(|(x, u)| add(*x, *u)).collect()
    }

    fn start(&self, begin: Option<&ContactStart>) -> State {
        let (places, reactions) = match begin {
            Some(begin) => (&begin.places, begin.reactions.clone()),
            None => (&self.seats.clinging, vec![[0.0; 3]; self.count()]),
        };
        let displacements: Vec<[f64; 3]> =
            places.iter().zip(&self.sliding.positions).map(|(p, x)| sub(*p, *x)).collect();
        let touches = self.seats.touches(&self.places(&displacements));
        let forces = along(&reactions, &touches);
        State { displacements, touches, reactions, forces }
    }

    /// Which nodes are held: all of them, or those whose pressure outweighs their gap.
    fn held(&self, state: &State, before: Option<&[bool]>) -> Vec<bool> {
        if !self.is_unilateral() {
            return vec![true; self.count()];
        }
        let limit = self.sliding.gap_limit(self.options);
        (0..self.count())
            .map(|i| {
                let (gap, force) = (state.touches[i].gap, state.forces[i]);
                match before {
                    // No contact force is known yet.
                    None => gap <= limit,
                    Some(before) if before[i] => force >= 0.0,
                    Some(_) => gap < -limit,
                }
            })
            .collect()
    }

    /// The response of the body to the conditions linearised about `state`.
    fn step(
        &self,
        state: &State,
        active: &[bool],
        reach: f64,
        (share, spring_share): (f64, f64),
        body: &mut dyn Body,
    ) -> Result<Response> {
        let rows = self.rows(state, active);
        let offsets: Vec<f64> = rows
            .iter()
            .map(|r| dot(r.normal, sub(r.point, self.sliding.positions[r.node])))
            .collect();
        let mut springs = self.springs(state, active, SPRING_SHARE);
        if reach == 0.0 {
            springs.retain(|s| s.stiffness > 0.0);
        }
        loop {
            let conditions = Constraints {
                rows: &rows,
                offsets: &offsets,
                springs: &springs,
                about: &state.displacements,
                share,
                spring_share,
                reach,
            };
            match body.respond(&conditions) {
                // The contact forces drive their nodes by more than the body can resist: solve without that
                // effect.
                Err(MtmError::NotPositiveDefinite { .. })
                    if springs.iter().any(|s| s.stiffness < 0.0) =>
                {
                    springs.retain(|s| s.stiffness > 0.0);
                }
                answer => return answer,
            }
        }
    }

    /// Relative accuracy of the next step, `left` mm from a solution, and that of the forces of its springs.
    fn shares(&self, left: f64, near: bool) -> (f64, f64) {
        if near {
            // What the springs leave open must fit into the balance.
            let needed = LAST_SPRING_SHARE * self.balance() / left;
            return (0.0, needed.clamp(SPRING_ERROR, ROUGH_SHARE));
        }
        let share = match self.options.mode {
            // Small forces decide which nodes lift off.
            ContactMode::Unilateral => FINE_SHARE,
            ContactMode::Bilateral => (left / self.seats.reach()).clamp(FINE_SHARE, ROUGH_SHARE),
        };
        (share, share.max(SPRING_ERROR))
    }

    /// The state with nodes that have left their surfaces moved back onto them; none if they are near enough,
    /// or too far away.
    fn put_back(&self, response: &Response, active: &[bool]) -> Option<State> {
        let reach = self.seats.reach();
        let mut displacements = response.displacements.clone();
        let mut touches = self.seats.touches(&self.places(&displacements));
        let gap = farthest(&touches, active);
        if gap <= reach || gap > MOST_RETRACTION * reach {
            return None;
        }
        for _ in 0..RETRACTIONS {
            for i in (0..self.count()).filter(|&i| active[i]) {
                let back = scaled(touches[i].normal, touches[i].gap);
                displacements[i] = sub(displacements[i], back);
            }
            touches = self.seats.touches(&self.places(&displacements));
        }
        (farthest(&touches, active) <= reach)
            .then(|| self.reached(displacements, touches, response.reactions.clone(), active))
    }

    fn rows(&self, state: &State, active: &[bool]) -> Vec<ContactRow> {
        (0..self.count())
            .filter(|&i| active[i])
            .map(|i| {
                let touch = &state.touches[i];
                let place = add(self.sliding.positions[i], state.displacements[i]);
                let point = sub(place, scaled(touch.normal, touch.gap));
                ContactRow { node: i, normal: touch.normal, point }
            })
            .collect()
    }

    /// How the contact forces change direction as held nodes slide: −f H across the normals.
    ///
    /// `least`: share of a node's own stiffness below which the springs are omitted.
    fn springs(&self, state: &State, active: &[bool], least: f64) -> Vec<Spring> {
        let mut out = Vec::new();
        for i in (0..self.count()).filter(|&i| active[i] && state.forces[i] != 0.0) {
            let touch = &state.touches[i];
            let own = self.sliding.stiffness[i];
            for (curvature, axis) in curvatures(touch) {
                let stiffness = -state.forces[i] * curvature;
                if stiffness.abs() > least * own {
                    let goal = dot(axis, state.displacements[i]);
                    out.push(Spring { node: i, axis, stiffness, goal });
                }
            }
        }
        out
    }

    /// The state at the end of the step to `response`, shortened until the merit decreases, and the accepted
    /// share; none if the merit decreases for no length.
    fn search(
        &self,
        state: &State,
        active: &[bool],
        response: &Response,
        near: bool,
        penalty: &mut f64,
    ) -> Option<(State, f64)> {
        let target = along(&response.reactions, &state.touches);
        let ends = response.displacements.iter().zip(&state.displacements);
        let way = Way {
            state,
            active,
            forces: (0..self.count()).map(|i| if active[i] { target[i] } else { 0.0 }).collect(),
            ways: ends.map(|(to, from)| sub(*to, *from)).collect(),
        };
        let reach = (STEADY_GAP * farthest(&state.touches, active)).max(self.seats.reach());
        // For the last steps, changes of the merit are mostly rounding errors.
        let negligible = BALANCE_SHARE * self.sliding.gap_limit(self.options);
        let is_tiny = near || way.ways.iter().all(|way| norm(*way) <= negligible);
        let slope = match response.slopes {
            Some((first, _)) if !is_tiny => self.slope(&way, first, penalty)?,
            _ => 0.0,
        };
        let work = state.reactions.iter().zip(&response.reactions).zip(&way.ways);
        let work: f64 = work.map(|((a, b), way)| (norm(*a) + norm(*b)) * norm(*way)).sum();
        let rounding = MERIT_ROUNDING * work;
        let mut share = 1.0;
        while share >= SHORTEST {
            let displacements = between(&state.displacements, &response.displacements, share);
            let touches = self.seats.touches(&self.places(&displacements));
            let within = farthest(&touches, active) <= reach;
            let falls = || match response.slopes {
                Some(slopes) if !is_tiny => {
                    let rise = self.rise(&way, &touches, slopes, share, *penalty);
                    rise <= DESCENT * share * slope + rounding
                }
                _ => true,
            };
            if within && falls() {
                let reactions = between(&state.reactions, &response.reactions, share);
                return Some((self.reached(displacements, touches, reactions, active), share));
            }
            share *= 0.5;
        }
        None
    }

    /// Slope of the merit at the start of a step, made negative by increasing the penalty; none if no penalty
    /// achieves that.
    ///
    /// `energy`: the slope of the elastic energy.
    fn slope(&self, way: &Way<'_>, energy: f64, penalty: &mut f64) -> Option<f64> {
        let Way { state, active, forces, ways } = way;
        let at = |penalty: f64| {
            let (mut slope, mut closing) = (energy, 0.0);
            for i in 0..self.count() {
                let own = self.sliding.stiffness[i];
                let touch = &state.touches[i];
                let rate = touch.level_rate(ways[i]);
                let turn = touch.multiplier(forces[i] - state.forces[i]);
                let multiplier = touch.multiplier(state.forces[i]);
                let (by_level, by_force) =
                    self.merit_slopes(multiplier, touch.level(), penalty * own);
                slope += by_level * rate + by_force * turn;
                if active[i] {
                    closing -= own * touch.level() * rate;
                }
            }
            (slope, closing)
        };
        let (slope, closing) = at(*penalty);
        // Terms independent of the penalty, and the decrease due to closing gaps: the latter must clearly
        // dominate.
        let rest = slope + *penalty * closing;
        if rest <= CLOSING_SHARE * *penalty * closing {
            return Some(slope).filter(|slope| *slope < 0.0);
        }
        let needed = rest / (CLOSING_SHARE * closing);
        if !(needed > *penalty && needed <= MOST_PENALTY) {
            return Some(slope).filter(|slope| *slope < 0.0);
        }
        *penalty = needed;
        Some(at(needed).0).filter(|slope| *slope < 0.0)
    }

    /// Increase of the merit over `share` of a step to the state with the contact values `touches`.
    ///
    /// `slopes`: slopes of the elastic energy at the start and at the end of the whole step.
    fn rise(
        &self,
        way: &Way<'_>,
        touches: &[Touch],
        (first, last): (f64, f64),
        share: f64,
        penalty: f64,
    ) -> f64 {
        let Way { state, forces, .. } = way;
        let mut rise = share * first + 0.5 * share * share * (last - first);
        for i in 0..self.count() {
            let rho = penalty * self.sliding.stiffness[i];
            let (here, there) = (&state.touches[i], &touches[i]);
            let start = here.multiplier(state.forces[i]);
            let end = start + share * here.multiplier(forces[i] - state.forces[i]);
            let before = self.merit(start, here.level(), rho);
            let after = self.merit(end, there.level(), rho);
            rise += after - before;
        }
        rise
    }

    fn reached(
        &self,
        displacements: Vec<[f64; 3]>,
        touches: Vec<Touch>,
        reactions: Vec<[f64; 3]>,
        active: &[bool],
    ) -> State {
        let mut forces = along(&reactions, &touches);
        for (force, held) in forces.iter_mut().zip(active) {
            if !held {
                *force = 0.0;
            }
        }
        State { displacements, touches, reactions, forces }
    }

    /// Term of one node in the augmented Lagrangian.
    fn merit(&self, multiplier: f64, level: f64, rho: f64) -> f64 {
        if self.is_unilateral() && multiplier < rho * level {
            return -0.5 * multiplier * multiplier / rho;
        }
        (0.5 * rho * level - multiplier) * level
    }

    /// Its derivatives with respect to level and multiplier.
    fn merit_slopes(&self, multiplier: f64, level: f64, rho: f64) -> (f64, f64) {
        if self.is_unilateral() && multiplier < rho * level {
            return (0.0, -multiplier / rho);
        }
        (rho * level - multiplier, -level)
    }

    /// Largest gap of a held node, and largest distance, mm, by which the tangential force would move a node.
    fn left(&self, state: &State, active: &[bool]) -> (f64, f64) {
        let (mut gap, mut unbalanced) = (0.0_f64, 0.0_f64);
        for (i, &held) in active.iter().enumerate() {
            let (own_gap, own_way) = self.left_of(state, i, held);
            gap = gap.max(own_gap);
            unbalanced = unbalanced.max(own_way);
        }
        (gap, unbalanced)
    }

    /// The same for node `i`: a node in the air may be above its surface, and must be free of any force.
    fn left_of(&self, state: &State, i: usize, held: bool) -> (f64, f64) {
        let (touch, reaction) = (&state.touches[i], state.reactions[i]);
        let (gap, left) = if held {
            let across = sub(reaction, scaled(touch.normal, dot(reaction, touch.normal)));
            (touch.gap.abs(), across)
        } else {
            ((-touch.gap).max(0.0), reaction)
        };
        (gap, norm(left) / self.sliding.stiffness[i])
    }

    fn end(
        &self,
        state: State,
        active: &[bool],
        unbalanced: f64,
        converged: bool,
        iterations: usize,
    ) -> Result<ContactState> {
        let places = self.places(&state.displacements);
        let closest: Vec<_> =
            places.iter().enumerate().map(|(i, &x)| self.seats.closest(i, x)).collect();
        for (i, (found, past)) in closest.iter().enumerate().filter(|(i, _)| active[*i]) {
            let s = self.sliding.nodes[i].segment;
            let reach = self.options.border_reach * self.seats.mean_edge(s);
            if let Some(past) = past.filter(|&past| past > reach) {
                return Err(MtmError::ContactSurface {
                    segment: self.sliding.names[s].clone(),
                    problem: format!(
                        "is open and node {} ends {past:.4} mm past its border, near ({:.3}, {:.3}, \
                         {:.3}) (allowed {reach:.4} mm): extend or close the surface there, or let \
                         the node be free",
                        self.sliding.nodes[i].node, found.point[0], found.point[1], found.point[2]
                    ),
                });
            }
        }
        let rows = self.rows(&state, active);
        let springs = self.springs(&state, active, FROZEN_SPRING_SHARE);
        Ok(ContactState {
            points: closest.iter().map(|(found, _)| found.point).collect(),
            normals: state.touches.iter().map(|t| t.normal).collect(),
            gaps: state.touches.iter().map(|t| t.gap).collect(),
            displacements: state.displacements,
            reactions: state.reactions,
            forces: state.forces,
            rows,
            springs,
            active: active.to_vec(),
            iterations,
            unbalanced,
            converged,
        })
    }

    /// The error for steps that ran out far from a solution, with the nodes that are furthest from one.
    fn far(&self, state: &State, active: &[bool], iterations: usize, gap: f64) -> MtmError {
        let badness = |i: usize| {
            let (gap, way) = self.left_of(state, i, active[i]);
            gap + way
        };
        let mut order: Vec<usize> = (0..self.count()).collect();
        order.sort_by(|&a, &b| badness(b).total_cmp(&badness(a)).then(a.cmp(&b)));
        let nodes = order.iter().take(NAMED_NODES);
        let nodes = nodes.map(|&i| self.sliding.nodes[i].node as usize).collect();
        MtmError::ContactNotConverged { iterations, nodes, gap }
    }
}

/// Largest gap of a held node, mm.
fn farthest(touches: &[Touch], active: &[bool]) -> f64 {
    let held = touches.iter().zip(active).filter(|(_, held)| **held);
    held.fold(0.0, |m, (touch, _)| m.max(touch.gap.abs()))
}

/// Component of each reaction along the normal of its node.
fn along(reactions: &[[f64; 3]], touches: &[Touch]) -> Vec<f64> {
    reactions.iter().zip(touches).map(|(r, t)| dot(*r, t.normal)).collect()
}

/// Principal curvatures of the level through a node, 1/mm, with their unit directions across the normal.
fn curvatures(touch: &Touch) -> [(f64, [f64; 3]); 2] {
    let [x, y] = across(&Vec3::from(touch.normal));
    let times = |a: &Vec3, b: &Vec3| -> f64 {
        (0..3).map(|i| a[i] * (0..3).map(|j| touch.hessian[i][j] * b[j]).sum::<f64>()).sum()
    };
    let (xx, yy, xy) = (times(&x, &x), times(&y, &y), times(&x, &y));
    let (sin, cos) = (0.5 * (2.0 * xy).atan2(xx - yy)).sin_cos();
    let (one, two) = (x * cos + y * sin, y * cos - x * sin);
    let (mean, half) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
    [(mean + half, one.into()), (mean - half, two.into())]
}

/// Two unit vectors that form an orthonormal basis with the unit vector `n`.
fn across(n: &Vec3) -> [Vec3; 2] {
    // Starting from the axis of the smallest component of n keeps the cross product away from zero.
    let mut axis = Vec3::zeros();
    axis[n.abs().imin()] = 1.0;
    let one = n.cross(&axis).normalize();
    [one, n.cross(&one)]
}
