//! Plans of bodies with parts that may touch: rounds of the method of multipliers, with the plan applied in
//! steps.
//!
//! Contact is detected by closest points, so no step of the plan may take one part through another: bones move
//! by two tissue edges at a time. Each step first uses the tangent planes at its start, which move with the bones
//! and have no far side, and then the surfaces actually met by the nodes. Intermediate steps do few, approximate
//! rounds; at the end of the plan the rounds continue until nothing penetrates and nothing changes.

use std::sync::Arc;

use crate::boundary::Motion;
use crate::contact::links::Link;
use crate::contact::pairs::{Left, Pairs, Round, Touching};
use crate::contact::planes::Planes;
use crate::contact::{ContactResult, ContactStart, SlidingNode};
use crate::error::{MtmError, Result};
use crate::geometry::motion::SurfaceMotion;
use crate::mesh::TetMesh;
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::iterative::Extremes;
use crate::statics::linear::system::{BodyRows, System};
use crate::statics::plans::settling::{ContactSolve, RowLinks, WarmStart};
use crate::statics::solution::{Clock, SolvedRows, TouchResult};
use crate::statics::solver::StaticSolver;
use crate::vector::{add, norm, scaled, sub};

/// Motion of the bones in one step, over the mean edge of the tissue that may be touched.
const STEP_EDGES: f64 = 2.0;
/// Depth, over the same edge, that a node may reach in a step; if it goes deeper, the step is halved.
const DEEP_EDGES: f64 = 0.75;
/// Shortest step, as a share of the plan.
const SHORTEST_STEP: f64 = 1.0 / 512.0;
/// Largest accepted distance between a node and the surface that it presses on, mm, and the same over the
/// diagonal of the mesh, for small scenes.
const CLOSE: f64 = 0.01;
const CLOSE_SHARE: f64 = 4e-5;
/// Largest accepted distance over the tolerance of contact, which is smaller only on request.
const CLOSE_TOLERANCES: f64 = 100.0;
/// Multiples of the distance that counts as touching which are accepted in intermediate steps, and at the end with
/// a warning: the latter is half a millimetre, at a node on a fold inside the mouth.
const LOOSE: f64 = 5.0;
const SEEN: f64 = 50.0;
/// Multiple of that distance by which a node may lie inside a tet of other tissue, where edges meet; beyond it,
/// the node has passed through the surface.
const THROUGH: f64 = 15.0;
/// Maximum number of rounds of an intermediate step, which the next step continues, and of the last step.
const MOST_ROUNDS_ON_THE_WAY: usize = 1;
const MOST_ROUNDS: usize = 60;
/// Number of rounds, at the end of the maximum, that are solved to the tolerance.
const LAST_ROUNDS: usize = 5;
/// Change of a node in a round, over the distance that counts as touching, up to which the node counts as
/// still.
const STILL: f64 = 4.0;
/// Rounds of a step that use the normals as they are found; after that, oscillating normals are damped.
const SHARP_ROUNDS: usize = 6;
/// Rounds of a step with the planes at its start, and the depth behind them, over the mean edge, at which they
/// end.
const MOST_ROUNDS_AHEAD: usize = 8;
const AHEAD_EDGES: f64 = 0.15;
/// Share of the first residual, in the energy norm, that a round before the last ones may leave.
const ROUGH_SHARE: f64 = 0.1;
/// Error of the solves that end a plan, over the distance that counts as touching, which is at most this share of
/// the motion of the bones here.
const SOLVED_SHARE: f64 = 0.01;
const SMALL_SHARE: f64 = 1e-3;
/// Iterations of a round above which the next one gets a hierarchy that knows the links that push: setting one up
/// takes as long as some twenty iterations.
const WORN: usize = 25;
/// Maximum number of nodes listed in an error.
const NAMED_NODES: usize = 10;

/// The body and its contact after some share of the plan.
#[derive(Clone)]
struct PartialState {
    /// Displacement of every node, mm.
    u: Vec<[f64; 3]>,
    /// Displacements of the unknown rows.
    rows: Vec<[f64; 3]>,
    contact: Option<ContactResult>,
    touching: Touching,
}

/// A plan on a body whose parts may touch.
struct TouchingPlan<'a> {
    body: &'a StaticSolver,
    rows: BodyRows<'a>,
    system: &'a System,
    pairs: &'a Pairs,
    /// One motion per segment.
    motions: &'a [&'a Motion],
    /// Load on every node, N.
    loads: Option<&'a [[f64; 3]]>,
}

/// The target of a step of the plan.
struct StepTarget<'a> {
    motions: &'a [&'a Motion],
    /// Displacements of all nodes with the prescribed ones filled in, mm.
    prescribed: &'a [[f64; 3]],
    /// Forces on the rows, N.
    b: &'a [[f64; 3]],
}

/// The rounds of one step.
struct Done {
    planes: Planes,
    round: Round,
    left: Left,
    rounds: usize,
    /// Largest change of a node in the last round, mm.
    change: f64,
    converged: bool,
}

impl StaticSolver {
    /// The body at the end of a plan of one motion per segment.
    pub(super) fn solve_touching(
        &self,
        (system, pairs): (&System, &Pairs),
        motions: &[&Motion],
        loads: Option<&[[f64; 3]]>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<SolvedRows> {
        let rows = BodyRows {
            positions: &self.reduction.rows(self.tensors.element_nodes().positions()),
            sliding: self.sliding.as_deref(),
            held: self.held,
            liftable: (&[], &[]),
            tissue: Extremes::of(self.tensors.tissue()),
            multigrid: None,
        };
        TouchingPlan { body: self, rows, system, pairs, motions, loads }.solve(solve)
    }
}

impl TouchingPlan<'_> {
    /// The body at the end of the plan.
    ///
    /// # Errors
    /// `ContactNotConverged` if the rounds run out with a gap or penetration that would be visible on a face,
    /// or if a step penetrates however short it is; those of the solves.
    fn solve(&self, solve: &mut PlanSolve<'_>) -> Result<SolvedRows> {
        let clock = Clock::new();
        let sliding = self.rows.sliding;
        let farthest = sliding.map_or(0.0, |s| s.farthest(self.motions)).max(solve.scale);
        let mut step = 1.0 / (farthest / (STEP_EDGES * self.pairs.mean_edge())).ceil().max(1.0);
        let (mut pose, mut here, mut rounds) = (self.rest(), 0.0, 0);
        solve.allowed = SOLVED_SHARE * self.sought().min(SMALL_SHARE * farthest);
        loop {
            let there = if here + 1.5 * step >= 1.0 { 1.0 } else { here + step };
            let shorter = step > SHORTEST_STEP;
            let next = match self.advance(&pose, (here, there), solve) {
                // Sliding nodes may find no equilibrium with what touches them after a long step.
                Err(MtmError::ContactNotConverged { .. }) if shorter => None,
                other => other?,
            };
            match next {
                Some((next, done)) if there == 1.0 => {
                    rounds += done.rounds;
                    let solved = self.end(next, &done, rounds, solve)?;
                    return Ok(SolvedRows { contact_seconds: clock.total(), ..solved });
                }
                Some((next, done)) => {
                    rounds += done.rounds;
                    (pose, here) = (next, there);
                }
                None if shorter => step *= 0.5,
                None => return Err(self.lost(&pose, rounds, DEEP_EDGES * self.pairs.mean_edge())),
            }
        }
    }

    fn mesh(&self) -> &TetMesh {
        self.body.tensors.mesh()
    }

    fn rest(&self) -> PartialState {
        PartialState {
            u: vec![[0.0; 3]; self.body.reduction.row_of.len()],
            rows: vec![[0.0; 3]; self.body.reduction.unknowns.len()],
            contact: None,
            touching: self.pairs.at_rest(),
        }
    }

    /// Distance that counts as touching, mm.
    fn close(&self) -> f64 {
        CLOSE.min(CLOSE_SHARE * self.mesh().diagonal())
    }

    /// The same at the end of the plan, mm: less if the tolerance of contact asks for it.
    fn sought(&self) -> f64 {
        self.close().min(CLOSE_TOLERANCES * self.body.options.contact.tolerance)
    }

    /// `pose`, reached at the share `from` of the plan, advanced to the share `to`; nothing if the step is too
    /// large for closest points.
    fn advance(
        &self,
        pose: &PartialState,
        (from, to): (f64, f64),
        solve: &mut PlanSolve<'_>,
    ) -> Result<Option<(PartialState, Done)>> {
        let (before, after) = (self.partial(from)?, self.partial(to)?);
        let before: Vec<&Motion> = before.iter().collect();
        let motions: Vec<&Motion> = after.iter().collect();
        let prescribed = self.body.prescribed(&motions)?;
        let b = self.forces(&prescribed, to);
        let goal = StepTarget { motions: &motions, prescribed: &prescribed, b: &b };
        let planes = |pose: &PartialState, from: &[&Motion]| {
            self.pairs.planes(self.mesh(), &pose.u, (from, &motions), &pose.touching)
        };
        let ahead = planes(pose, &before)?;
        let contact = self.carried(pose, &before, &motions);
        // Displacements are nearly proportional to the plan.
        let more = if from > 0.0 { to / from } else { 1.0 };
        let mut pose = pose.clone();
        pose.rows.iter_mut().for_each(|v| *v = scaled(*v, more));
        let (pose, rounds) = self.go_ahead(pose, &ahead, contact, &goal, solve)?;
        let planes = planes(&pose, &motions)?;
        if planes.deepest() > DEEP_EDGES * self.pairs.mean_edge() {
            return Ok(None);
        }
        self.rounds(pose, planes, &goal, (rounds, to == 1.0), solve).map(Some)
    }

    /// `pose` with the bones at their position in the `goal`, solved against the planes that were found `ahead`
    /// of their motion, and the number of rounds. Planes are infinite, so nodes cannot pass around them.
    fn go_ahead(
        &self,
        mut pose: PartialState,
        ahead: &Planes,
        mut contact: Option<ContactStart>,
        goal: &StepTarget<'_>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<(PartialState, usize)> {
        // The targets of prescribed nodes are known before anything is solved.
        pose.u = self.body.reduction.filled(goal.prescribed, &pose.rows);
        let deep = AHEAD_EDGES * self.pairs.mean_edge();
        for round in 1..=MOST_ROUNDS_AHEAD {
            let links = self.pairs.round(ahead, &pose.u, &pose.touching, true);
            let (rows, found) = self.linked(&links, (&pose, contact), goal, true, solve)?;
            pose = self.moved(&pose, rows, found, goal);
            pose.touching.follow(&links, &pose.rows);
            if self.left(ahead, &links, &pose).penetration <= deep {
                return Ok((pose, round));
            }
            contact = self.begun(&pose);
        }
        Ok((pose, MOST_ROUNDS_AHEAD))
    }

    /// Rounds from `pose` under the motions of the `goal`, starting with `planes`, until nothing is open;
    /// `before` rounds were already done.
    ///
    /// A node on an edge of the surface that it touches would alternate between two facets for ever: normals
    /// that oscillate are therefore allowed to turn less and less.
    fn rounds(
        &self,
        mut pose: PartialState,
        mut planes: Planes,
        goal: &StepTarget<'_>,
        (before, is_last): (usize, bool),
        solve: &mut PlanSolve<'_>,
    ) -> Result<(PartialState, Done)> {
        let most = if is_last { MOST_ROUNDS } else { MOST_ROUNDS_ON_THE_WAY };
        let close = if is_last { self.sought() } else { LOOSE * self.close() };
        let (mut rough, mut count) = (true, 0);
        loop {
            count += 1;
            pose.touching.gaps = planes.gaps();
            let round = self.pairs.round(&planes, &pose.u, &pose.touching, rough);
            let begun = self.begun(&pose);
            let (rows, contact) = self.linked(&round, (&pose, begun), goal, rough, solve)?;
            let next = self.moved(&pose, rows, contact, goal);
            let change = largest_change(&pose.u, &next.u);
            pose = next;
            let motions = (goal.motions, goal.motions);
            let mut met = self.pairs.planes(self.mesh(), &pose.u, motions, &pose.touching)?;
            if count > SHARP_ROUNDS {
                met.steady(&planes, &pose.u, |i| round.force(i, &pose.rows) > 0.0);
            }
            let left = self.left(&met, &round, &pose);
            pose.touching.follow(&round, &pose.rows);
            let near = left.penetration.max(left.gap) <= close && change <= STILL * close;
            let converged = near && !rough;
            let over = converged || count >= most || (near && !is_last);
            if over {
                pose.touching.gaps = met.gaps();
                let rounds = before + count;
                let left = self.pairs.left(&met, &round, &pose.rows, |plane| plane.gap);
                let converged = converged && left.beside_tissue() <= LOOSE * self.close();
                return Ok((pose, Done { planes: met, round, left, rounds, change, converged }));
            }
            planes = met;
            rough = !(is_last && (near || count + LAST_ROUNDS >= most));
        }
    }

    /// The residuals of `round` in `pose`, with respect to the planes.
    fn left(&self, planes: &Planes, round: &Round, pose: &PartialState) -> Left {
        self.pairs.left(planes, round, &pose.rows, |plane| plane.at(&pose.u))
    }

    /// `pose` moved to `rows`.
    fn moved(
        &self,
        pose: &PartialState,
        rows: Vec<[f64; 3]>,
        contact: Option<ContactResult>,
        goal: &StepTarget<'_>,
    ) -> PartialState {
        let u = self.body.reduction.filled(goal.prescribed, &rows);
        PartialState { u, rows, contact, touching: pose.touching.clone() }
    }

    /// Positions of the sliding nodes in `pose`.
    fn begun(&self, pose: &PartialState) -> Option<ContactStart> {
        let (sliding, state) = (self.rows.sliding?, pose.contact.as_ref()?);
        let at = |node: &SlidingNode, place: &[f64; 3]| add(*place, pose.rows[node.row as usize]);
        let places = sliding.nodes.iter().zip(&sliding.positions).map(|(n, x)| at(n, x));
        Some(ContactStart { places: places.collect(), reactions: state.reactions.clone() })
    }

    /// The body under the links of a `round` from `pose`: displacements of the rows, and contact if nodes
    /// slide.
    ///
    /// `rough`: one step of Newton's method for the sliding nodes, wherever it ends: in an intermediate round,
    /// what touches changes as much.
    fn linked(
        &self,
        round: &Round,
        (pose, contact): (&PartialState, Option<ContactStart>),
        goal: &StepTarget<'_>,
        rough: bool,
        solve: &mut PlanSolve<'_>,
    ) -> Result<(Vec<[f64; 3]>, Option<ContactResult>)> {
        let rows = &pose.rows[..];
        let linked = RowLinks { links: &round.links, share: rough.then_some(ROUGH_SHARE) };
        let before = solve.iterations;
        let (rows, contact) = if let Some(sliding) = self.rows.sliding {
            let mut options = self.body.options;
            if rough {
                options.contact.allowed = f64::INFINITY;
            }
            let begin = contact.map(|contact| WarmStart { rows, contact });
            let motions = goal.motions;
            let settle = ContactSolve { sliding, motions, begin, options: &options, linked };
            let found = self.system.solve_with_contact(goal.b, &settle, solve)?;
            (found.rows, found.contact)
        } else {
            (self.system.solve_linked(goal.b, linked, rows, solve)?, None)
        };
        if rough && solve.iterations > before + WORN {
            let pushing = round.links.iter().filter(|link| link.pull(&rows) > 0.0);
            let links: Vec<Link> = pushing.cloned().collect();
            solve.multigrid = Some(self.system.multigrid_with(&links, &self.rows)?);
        }
        Ok((rows, contact))
    }

    /// Each motion at `share` of the plan.
    fn partial(&self, share: f64) -> Result<Vec<Motion>> {
        if share == 1.0 {
            return Ok(self.motions.iter().map(|&m| m.clone()).collect());
        }
        let centre = self.mesh().centre();
        let part = |motion: &&Motion| {
            Ok(match motion {
                Motion::Rigid(rigid) => Motion::Rigid(rigid.partial(share, centre)),
                Motion::Nodes(rows) => {
                    Motion::Nodes(rows.iter().map(|u| scaled(*u, share)).collect())
                }
                Motion::Surface(motion) => {
                    let (rest, moved) = (motion.rest(), motion.moved());
                    let pairs = rest.vertices().iter().zip(moved.vertices());
                    let part = pairs.map(|(x, y)| add(*x, scaled(sub(*y, *x), share))).collect();
                    Motion::Surface(Arc::new(SurfaceMotion::new(rest.clone(), part)?))
                }
            })
        };
        self.motions.iter().map(part).collect()
    }

    /// Forces on the rows at `share` of the plan, N.
    fn forces(&self, prescribed: &[[f64; 3]], share: f64) -> Vec<[f64; 3]> {
        let mut b = self.body.coupled(prescribed);
        if let Some(loads) = self.loads {
            for (b, &j) in b.iter_mut().zip(&self.body.reduction.unknowns) {
                *b = add(*b, scaled(loads[j as usize], share));
            }
        }
        b
    }

    /// Sliding nodes moved with their segments from their positions in `pose`.
    fn carried(
        &self,
        pose: &PartialState,
        from: &[&Motion],
        to: &[&Motion],
    ) -> Option<ContactStart> {
        let sliding = self.rows.sliding?;
        let rest = sliding.carried_back(from, pose.contact.as_ref()?)?;
        sliding.carried(to, &rest)
    }

    /// The answer, or an error if what is left open would be visible on a face.
    fn end(
        &self,
        pose: PartialState,
        done: &Done,
        rounds: usize,
        solve: &mut PlanSolve<'_>,
    ) -> Result<SolvedRows> {
        let inside = self.pairs.overlap.inside(self.mesh(), &pose.u);
        let overlap = inside.iter().fold(0.0, |m: f64, (_, depth)| m.max(*depth));
        let open = done.left.beside_tissue().max(overlap);
        if !done.converged && open > SEEN * self.close() {
            return Err(self.lost(&pose, rounds, open));
        }
        // The motion remaining in the last round may be a node's alternation between two facets, and is at
        // least its error.
        solve.leaves(open.max(done.change));
        let mut met = self.pairs.met(&done.planes, &done.round, &pose.rows);
        // A node that has slid past the border of the other part may have its closest point on the far side.
        let is_inside = |node: u32| inside.binary_search_by_key(&node, |(j, _)| *j).is_ok();
        let close = self.close();
        met.retain(|m| m.is_bone || m.force > 0.0 || m.gap >= -close || is_inside(m.node));
        let mut pushes = vec![[0.0; 3]; pose.rows.len()];
        for link in &done.round.links {
            link.add(link.pull(&pose.rows), &mut pushes);
        }
        let converged = done.converged && overlap <= THROUGH * self.close();
        let touching = TouchResult {
            nodes: met.iter().map(|m| m.node).collect(),
            gaps: met.iter().map(|m| m.gap).collect(),
            normals: met.iter().map(|m| m.normal).collect(),
            forces: met.iter().map(|m| m.force).collect(),
            overlap,
            rounds,
            converged,
        };
        let PartialState { rows, contact, .. } = pose;
        Ok(SolvedRows { rows, contact, touching, pushes, contact_seconds: 0.0 })
    }

    /// The error for touching parts without equilibrium, with the nodes that carry the largest forces.
    fn lost(&self, pose: &PartialState, rounds: usize, gap: f64) -> MtmError {
        let nodes = self.pairs.pressed(&pose.touching, NAMED_NODES);
        let unbalanced = pose.contact.as_ref().map_or(0.0, |contact| contact.unbalanced);
        MtmError::ContactNotConverged { iterations: rounds, nodes, gap, unbalanced }
    }
}

/// Largest change of a node, mm.
fn largest_change(from: &[[f64; 3]], to: &[[f64; 3]]) -> f64 {
    from.iter().zip(to).fold(0.0, |m, (a, b)| m.max(norm(sub(*b, *a))))
}
