//! The outer loop of sliding contact: closest points and constrained solves by turns, until every held
//! node lies on its surface with no force along it.
//!
//! With normals taken as they were, the contact force f n of a node misses how it turns with the node:
//! by f ∂n/∂x, which may be stiffer than the tissue. Where that holds the node back (a pull on convex
//! bone, a push into a hollow) the plain loop overshoots and swings for ever; there a spring as stiff,
//! tied to where the node was, stands in for it. It is force-free once the node rests: the end is the
//! same, and each step goes downhill in energy (convex–concave splitting; Yuille & Rangarajan 2003).

use std::collections::HashSet;

use rayon::prelude::*;

use crate::acceleration::Anderson;
use crate::boundary::Motion;
use crate::contact::{
    Constraints, ContactMode, ContactOptions, ContactState, Response, Sliding, Spring,
};
use crate::crease::{ContactRow, Foot, MovedSurface, Push, Seat, Walls};
use crate::error::{ErrorKind, MtmError, Result};
use crate::mesh::{add, dot, norm, scaled, sub};

/// Most nodes an error names.
const NAMED_NODES: usize = 10;
/// Share of a node's own stiffness below which a spring would change little.
const SPRING_SHARE: f64 = 0.05;
/// Roundings of a coordinate that a displacement gathers on its way.
const ROUNDINGS: f64 = 64.0;
/// Cosine of the angle by which a normal may turn in one step for the steps to be combined.
const SLIGHT_TURN: f64 = 0.5;

impl Sliding {
    /// Runs the outer loop for `motions` (one per segment), solving with `solve`.
    ///
    /// `begin`: where contact was for the same motions and a body a little different; from where the nodes
    /// would be if they clung to their segment if none.
    ///
    /// # Errors
    /// `ContactCycle` where closest points or the set of held nodes do not settle, `ContactSurface`
    /// where a node ends past the border of its surface, whatever `solve` reports.
    pub fn settle(
        &self,
        motions: &[&Motion],
        begin: Option<&ContactState>,
        options: &ContactOptions,
        interrupted: &(dyn Fn() -> bool + Sync),
        mut solve: impl FnMut(&Constraints<'_>) -> Result<Response>,
    ) -> Result<ContactState> {
        let surfaces = self.moved_surfaces(motions)?;
        let n = self.nodes.len();
        let limit = self.gap_limit(options);
        let spared = |i: usize| options.allowed * self.stiffness[i];
        let (mut start, seats) = self.carried(motions, &surfaces);
        let mut forces = vec![0.0_f64; n];
        if let Some(begin) = begin {
            for (place, (x, u)) in
                start.iter_mut().zip(self.positions.iter().zip(&begin.displacements))
            {
                *place = add(*x, *u);
            }
            forces.clone_from(&begin.forces);
        }
        let mut walls: Vec<Walls> =
            self.feet(&surfaces, &seats, &start).into_iter().map(Walls::new).collect();
        let mut held = Held::new(n, options.mode);
        let rounding = self.force_rounding();
        let mut anderson = Anderson::new(n);
        let edges = surfaces.iter().map(MovedSurface::mean_edge).filter(|&edge| edge > 0.0);
        let reach = edges.fold(f64::INFINITY, f64::min);
        let mut state = None;
        for iteration in 1..=options.max_iterations {
            if interrupted() {
                return Err(MtmError::Interrupted);
            }
            let mut rows: Vec<ContactRow> = (0..n)
                .filter(|&i| held.active[i])
                .flat_map(|i| {
                    let row = |f: &Foot| ContactRow { node: i, normal: f.normal, point: f.point };
                    walls[i].feet.iter().map(row).collect::<Vec<_>>()
                })
                .collect();
            let offsets: Vec<f64> =
                rows.iter().map(|r| dot(r.normal, sub(r.point, self.positions[r.node]))).collect();
            let springs: Vec<Spring> = (0..n)
                .filter(|&i| held.active[i] && walls[i].feet.len() == 1)
                .flat_map(|i| self.springs(i, &surfaces, &walls[i].feet[0], forces[i]))
                .collect();
            let response =
                solve(&Constraints { rows: &rows, offsets: &offsets, springs: &springs })?;

            let reached: Vec<[f64; 3]> =
                (0..n).map(|i| add(self.positions[i], response.displacements[i])).collect();
            let nearest = self.feet(&surfaces, &seats, &reached);
            let gaps: Vec<f64> = nearest.iter().map(|f| f.gap).collect();
            let surface = |i: usize| &surfaces[self.nodes[i].segment];
            let new_feet: Vec<Vec<Foot>> = (0..n)
                .map(|i| walls[i].feet_at(surface(i), &seats[i], reached[i], nearest[i]))
                .collect();
            let largest_force = response.forces.iter().fold(0.0_f64, |m, f| m.max(f.abs()));
            let mut gap =
                (0..n).filter(|&i| held.active[i]).fold(0.0_f64, |m, i| m.max(gaps[i].abs()));
            let mut turned = springs.iter().fold(0.0_f64, |m, s| {
                let stretch = dot(s.axis, response.displacements[s.node]) - s.goal;
                m.max(s.stiffness * stretch.abs() - spared(s.node))
            });
            let mut pushes = vec![Push::default(); n];
            for (row, &force) in rows.iter_mut().zip(&response.forces) {
                let i = row.node;
                let foot = &new_feet[i][pushes[i].forces.len()];
                gap = gap.max(foot.height(reached[i]).abs());
                let turn = force.abs() * norm(sub(foot.normal, row.normal));
                turned = turned.max(turn - spared(i));
                row.point = foot.point;
                pushes[i].add(row.normal, force);
            }
            let normals;
            (normals, forces) =
                pushes.iter().zip(&walls).map(|(p, w)| p.along(w.feet[0].normal)).unzip();
            let mut rebuilt = false;
            for i in (0..n).filter(|&i| held.active[i]) {
                let let_go = held.unilateral && walls[i].let_go(&pushes[i].forces);
                let left = !let_go
                    && gaps[i].abs() > limit
                    && nearest[i].triangle != walls[i].feet[0].triangle
                    && walls[i].leave(surface(i), &seats[i], reached[i], nearest[i]);
                rebuilt |= left || let_go;
            }
            let active = held.active.clone();
            let changed = held.update(&forces, &gaps, limit) || rebuilt;
            let balance = (options.tolerance * largest_force).max(rounding);
            let settled = response.solved && !changed && gap <= limit && turned <= balance;
            let last = ContactState {
                displacements: response.displacements,
                points: nearest.iter().zip(&seats).map(|(f, s)| sub(f.point, s.offset)).collect(),
                normals,
                forces: forces.clone(),
                walls: pushes.iter().map(|p| p.forces.len() as u8).collect(),
                rows,
                gaps,
                active,
                iterations: iteration,
            };
            if settled {
                self.check_border(&nearest, &reached, &surfaces, options)?;
                return Ok(last);
            }
            if held.cycled {
                return Err(self.cycle(&last, &nearest, &walls, iteration));
            }
            for i in (0..n).filter(|&i| !held.active[i]) {
                walls[i] = Walls::new(nearest[i]);
            }
            let previous = walls.clone();
            // Where a node leaps, steps say nothing of the next. Nodes that lift off or rest in creases
            // follow the others: they are not carried ahead.
            let steady = !changed
                && walls.iter().zip(reached.iter().zip(&nearest)).all(|(w, (&r, f))| {
                    let old = &w.feet[0];
                    let near = norm(sub(r, old.point)) <= reach;
                    w.feet.len() > 1 || near && dot(old.normal, f.normal) > SLIGHT_TURN
                });
            let (next, ends) = if steady {
                let plain = |i: usize| held.active[i] && walls[i].feet.len() == 1;
                let start: Vec<[f64; 3]> = (0..n)
                    .map(|i| if plain(i) { walls[i].feet[0].point } else { reached[i] })
                    .collect();
                let next = anderson.next(&start, &reached, reach);
                let ends = self.feet(&surfaces, &seats, &next);
                (next, ends)
            } else {
                anderson.restart();
                (reached, nearest.clone())
            };
            for i in 0..n {
                let feet = walls[i].feet_at(surface(i), &seats[i], next[i], ends[i]);
                walls[i].follow(&feet);
            }
            state = Some((last, nearest, previous));
        }
        match state {
            Some((last, new, previous)) => {
                Err(self.cycle(&last, &new, &previous, options.max_iterations))
            }
            None => Err(MtmError::OutOfRange {
                what: "contact_iterations".into(),
                index: 0,
                value: 0.0,
                allowed: "1 or more",
                kind: ErrorKind::Solver,
            }),
        }
    }

    /// Gap up to which a held node counts as on its surface, mm.
    pub fn gap_limit(&self, options: &ContactOptions) -> f64 {
        options.allowed.max(options.tolerance * self.diagonal)
    }

    /// Force that rounding of the positions alone may bring, N: at rest all forces are smaller.
    fn force_rounding(&self) -> f64 {
        let furthest = self.positions.iter().flatten().fold(0.0_f64, |m, x| m.max(x.abs()));
        let stiffest = self.stiffness.iter().fold(0.0_f64, |m, &k| m.max(k));
        ROUNDINGS * f64::EPSILON * furthest * stiffest
    }

    /// Springs that stand in for how the contact force of node `i` at `foot` turns against it.
    fn springs(
        &self,
        i: usize,
        surfaces: &[MovedSurface],
        foot: &Foot,
        force: f64,
    ) -> impl Iterator<Item = Spring> {
        let home = sub(foot.point, self.positions[i]);
        let least = SPRING_SHARE * self.stiffness[i];
        surfaces[self.nodes[i].segment]
            .curvatures(foot)
            .map(|(curvature, axis)| (-force * curvature, axis))
            .into_iter()
            .filter(move |(stiffness, _)| *stiffness > least)
            .map(move |(stiffness, axis)| Spring {
                node: i,
                axis,
                stiffness,
                goal: dot(axis, home),
            })
    }

    fn feet(&self, surfaces: &[MovedSurface], seats: &[Seat], at: &[[f64; 3]]) -> Vec<Foot> {
        (0..at.len())
            .into_par_iter()
            .with_min_len(64)
            .map(|i| surfaces[self.nodes[i].segment].foot(&seats[i], at[i]))
            .collect()
    }

    /// Refuses nodes that slid past the border of an open surface by more than the options allow.
    fn check_border(
        &self,
        feet: &[Foot],
        reached: &[[f64; 3]],
        surfaces: &[MovedSurface],
        options: &ContactOptions,
    ) -> Result<()> {
        for (i, foot) in feet.iter().enumerate().filter(|(_, f)| f.on_border) {
            let away = sub(reached[i], foot.point);
            let past = norm(sub(away, scaled(foot.normal, dot(foot.normal, away))));
            let s = self.nodes[i].segment;
            let reach = options.border_reach * surfaces[s].mean_edge();
            if past > reach {
                return Err(MtmError::ContactSurface {
                    segment: self.names[s].clone(),
                    problem: format!(
                        "is open and node {} ends {past:.4} mm past its border, near ({:.3}, {:.3}, \
                         {:.3}) (allowed {reach:.4} mm): extend or close the surface there, or let \
                         the node be free",
                        self.nodes[i].node, foot.point[0], foot.point[1], foot.point[2]
                    ),
                });
            }
        }
        Ok(())
    }

    fn cycle(
        &self,
        last: &ContactState,
        new: &[Foot],
        old: &[Walls],
        iterations: usize,
    ) -> MtmError {
        let mut order: Vec<usize> = (0..self.nodes.len()).collect();
        let badness = |i: usize| {
            let old = &old[i].feet[0];
            let turned = last.forces[i].abs() * norm(sub(new[i].normal, old.normal));
            let jumped = if new[i].triangle == old.triangle { 0.0 } else { f64::MIN_POSITIVE };
            let gap = if last.active[i] { last.gaps[i].abs() } else { 0.0 };
            gap / self.diagonal + turned + jumped
        };
        order.sort_by(|&a, &b| badness(b).total_cmp(&badness(a)).then(a.cmp(&b)));
        let gap = (0..order.len())
            .filter(|&i| last.active[i])
            .fold(0.0_f64, |m, i| m.max(last.gaps[i].abs()));
        let nodes = order.iter().take(NAMED_NODES).map(|&i| self.nodes[i].node as usize).collect();
        MtmError::ContactCycle { iterations, nodes, gap }
    }
}

/// Which sliding nodes are held, and the guard against cycling.
struct Held {
    active: Vec<bool>,
    unilateral: bool,
    /// Sets seen before; a repeated one means that changing many nodes at once goes in circles.
    seen: HashSet<Vec<bool>>,
    one_at_a_time: bool,
    cycled: bool,
}

impl Held {
    fn new(n: usize, mode: ContactMode) -> Self {
        Self {
            active: vec![true; n],
            unilateral: mode == ContactMode::Unilateral,
            seen: HashSet::new(),
            one_at_a_time: false,
            cycled: false,
        }
    }

    /// Lets go of nodes that are pulled and holds those that penetrate; whether any changed.
    ///
    /// Primal-dual active set (Hintermüller, Ito & Kunisch 2002); where a set comes back, only the
    /// worst node changes at a time, which cannot cycle while closest points stay put.
    fn update(&mut self, forces: &[f64], gaps: &[f64], gap_limit: f64) -> bool {
        if !self.unilateral {
            return false;
        }
        let largest = forces.iter().fold(0.0_f64, |m, f| m.max(f.abs())).max(f64::MIN_POSITIVE);
        let deepest = gaps.iter().fold(0.0_f64, |m, g| m.max(-g)).max(f64::MIN_POSITIVE);
        let wrong = |i: usize| {
            if self.active[i] {
                (forces[i] < 0.0).then(|| -forces[i] / largest)
            } else {
                (gaps[i] < -gap_limit).then(|| -gaps[i] / deepest)
            }
        };
        let list: Vec<(usize, f64)> =
            (0..self.active.len()).filter_map(|i| wrong(i).map(|w| (i, w))).collect();
        if list.is_empty() {
            return false;
        }
        let before = self.active.clone();
        if self.one_at_a_time {
            if let Some(&(i, _)) =
                list.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
            {
                self.active[i] = !self.active[i];
            }
        } else {
            for (i, _) in list {
                self.active[i] = !self.active[i];
            }
        }
        if !self.seen.insert(before) {
            self.cycled = self.one_at_a_time;
            self.one_at_a_time = true;
            self.seen.clear();
        }
        true
    }
}
