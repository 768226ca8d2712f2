//! Equilibrium of the few nodes that a step has left far from it, while all others stay.
//!
//! A tet that is squeezed flat makes Newton's steps short for the whole body, and each of them costs as much as
//! a linear plan. On their own its nodes reach equilibrium at next to no cost, before the next step of the body
//! (nonlinear elimination; Lanzkron, Rose & Wilkes 1996; Cai & Li 2011).

use std::sync::Arc;

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::cholesky::{Factor, Symbolic};
use crate::algebra::constraints::{Constraint, add_offsets, projected};
use crate::algebra::line_search::{Descent, first_of_halves};
use crate::contact::Spring;
use crate::error::Result;
use crate::mechanics::strain_energy::TangentKind::{self, Definite, Exact};
use crate::mechanics::strain_energy::{EnergyState, Part};
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::newton::{Equilibrium, Iterate, Target, reach};
use crate::statics::reduction::NO_ROW;
use crate::vector::{add, distinct, dot, norm, scaled, sub};

/// Largest number of nodes that move, and the same relative to all: more are no small part of the body. Neighbours
/// of the last one may be added.
const MOST: usize = 2000;
const MOST_SHARE: f64 = 0.05;
/// Rings of neighbours that move with a node far from equilibrium.
const RINGS: usize = 2;
/// Distance of a node from equilibrium, relative to the error asked for, from which it is far.
const FAR: f64 = 0.02;
/// The same relative to the furthest one.
const OF_FURTHEST: f64 = 0.02;
/// Largest share of far nodes: more are no small part of the body.
const FEW: f64 = 0.05;
/// Length of a step relative to the error asked for, after which none follows.
const SHORT: f64 = 1e-3;
/// Largest number of steps.
const STEPS: usize = 30;
/// Shortest step of the line search relative to the full one.
const SHORTEST: f64 = 1.0 / 256.0;

/// Nodes that move on their own.
struct Local<'a> {
    part: Part<'a>,
    /// Forces on its rows, N.
    loads: Option<Vec<[f64; 3]>>,
    /// Conditions on its rows.
    conditions: RowConditions,
}

impl Equilibrium {
    /// `pose` with the nodes furthest from equilibrium moved there while all others stay, and whether any moved.
    /// They keep `conditions`.
    pub(super) fn eased(
        &self,
        pose: Iterate,
        target: &Target<'_>,
        conditions: &RowConditions,
    ) -> Result<(Iterate, bool)> {
        let goal = self.options.tolerance * reach(&pose, target);
        let rows = self.far_rows(&pose, FAR * goal, conditions);
        if rows.is_empty() {
            return Ok((pose, false));
        }
        let nodes = rows.iter().map(|&row| self.reduction.unknowns[row as usize]).collect();
        let Some(part) = Part::new(target.energy, nodes) else { return Ok((pose, false)) };
        let local = Local {
            loads: target.loads.map(|l| part.nodes().iter().map(|&j| l[j as usize]).collect()),
            conditions: within(conditions, &rows),
            part,
        };
        let mut u = pose.u.clone();
        local.settle(&mut u, SHORT * goal);
        let next = self.pose(u, target)?;
        // Springs may let nodes slide uphill.
        Ok(if next.merit < pose.merit { (next, true) } else { (pose, false) })
    }

    /// Distance of the furthest row from equilibrium on its own, mm.
    pub(super) fn furthest(&self, pose: &Iterate, conditions: &RowConditions) -> f64 {
        self.distances(pose, conditions).into_iter().fold(0.0, f64::max)
    }

    /// Distance of each row from equilibrium on its own, mm, estimated by its stiffness at rest.
    fn distances(&self, pose: &Iterate, conditions: &RowConditions) -> Vec<f64> {
        let stiffness = self.tensors.matrix();
        let mut forces = pose.slope.clone();
        add_offsets(&mut forces, &conditions.constraints);
        forces
            .iter()
            .zip(&self.reduction.unknowns)
            .map(|(&force, &node)| {
                let own = stiffness.diagonal_block(node as usize);
                3.0 * norm(force) / (own[0] + own[4] + own[8])
            })
            .collect()
    }

    /// Rows further than `limit`, mm, from equilibrium on their own, and those around them, ascending: the
    /// furthest ones, if they are many.
    fn far_rows(&self, pose: &Iterate, limit: f64, conditions: &RowConditions) -> Vec<u32> {
        let distances = self.distances(pose, conditions);
        let furthest = distances.iter().fold(0.0_f64, |m, d| m.max(*d));
        let mut far: Vec<(f64, u32)> = distances
            .iter()
            .copied()
            .zip(0..)
            .filter(|(d, _)| *d > OF_FURTHEST * furthest)
            .collect();
        // Where all of a body is far from equilibrium, a part of it would find one that the body does not have.
        if furthest < limit || far.len() as f64 > FEW * distances.len() as f64 {
            return Vec::new();
        }
        far.sort_unstable_by(|(a, i), (b, j)| b.total_cmp(a).then(i.cmp(j)));
        let most = MOST.min((MOST_SHARE * distances.len() as f64) as usize);
        let (mut found, mut is_found) = (Vec::new(), vec![false; distances.len()]);
        for (_, row) in far {
            if found.len() >= most {
                break;
            }
            for row in self.around(row) {
                if !std::mem::replace(&mut is_found[row as usize], true) {
                    found.push(row);
                }
            }
        }
        found.sort_unstable();
        found
    }

    /// `row` and the rows around it.
    fn around(&self, row: u32) -> Vec<u32> {
        let pattern = self.tensors.matrix();
        let mut found = vec![row];
        for _ in 0..RINGS {
            let next = found
                .iter()
                .flat_map(|&row| pattern.row(self.reduction.unknowns[row as usize] as usize).0)
                .map(|&node| self.reduction.row_of[node as usize])
                .filter(|&row| row != NO_ROW);
            found = distinct(next);
        }
        found
    }
}

/// The `conditions` on `rows`, which are numbered in their order.
fn within(conditions: &RowConditions, rows: &[u32]) -> RowConditions {
    let place = |row: usize| rows.binary_search(&(row as u32)).ok();
    let constraints = conditions.constraints.iter();
    let springs = conditions.springs.iter();
    RowConditions {
        constraints: constraints
            .filter_map(|c| Some(Constraint { row: place(c.row)?, ..*c }))
            .collect(),
        springs: springs.filter_map(|(row, s)| Some((place(*row)?, *s))).collect(),
    }
}

impl Local<'_> {
    /// Moves the nodes in `u` towards equilibrium until a step is shorter than `short`, mm, or none goes
    /// downhill.
    fn settle(&self, u: &mut [[f64; 3]], short: f64) {
        let mut here = self.state(u);
        let mut symbolic = None;
        for _ in 0..STEPS {
            let Some(factor) = self.factor(u, &mut symbolic) else { return };
            let downhill: Vec<[f64; 3]> = here.forces.iter().map(|&f| scaled(f, -1.0)).collect();
            let step = factor.solve(&downhill);
            let length = step.iter().fold(0.0_f64, |m, d| m.max(norm(*d)));
            let slope: f64 = step.iter().zip(&here.forces).map(|(d, f)| dot(*d, *f)).sum();
            let start: Vec<[f64; 3]> = self.part.nodes().iter().map(|&j| u[j as usize]).collect();
            let descent = Descent { slope, slack: 0.0 };
            let found = first_of_halves(SHORTEST, |share| {
                self.place(u, &start, &step, share);
                let next = self.state(u);
                descent.accepts(share, here.energy, next.energy).then_some(next)
            });
            let Some((next, share)) = found else {
                self.place(u, &start, &step, 0.0);
                return;
            };
            here = next;
            if share * length < short {
                return;
            }
        }
    }

    /// Sets the nodes in `u` to `share` of `step` from `start`.
    fn place(&self, u: &mut [[f64; 3]], start: &[[f64; 3]], step: &[[f64; 3]], share: f64) {
        for ((&j, from), d) in self.part.nodes().iter().zip(start).zip(step) {
            u[j as usize] = add(*from, scaled(*d, share));
        }
    }

    /// Energy minus the work of loads, with springs, and its slope across the walls.
    fn state(&self, u: &[[f64; 3]]) -> EnergyState {
        let mut state = self.part.state(u);
        let nodes = self.part.nodes();
        for ((force, &j), load) in
            state.forces.iter_mut().zip(nodes).zip(self.loads.iter().flatten())
        {
            *force = sub(*force, *load);
            state.energy -= dot(*load, u[j as usize]);
        }
        let EnergyState { energy, forces } = &mut state;
        self.conditions.add_stretch(energy, forces, |row| u[nodes[row] as usize]);
        add_offsets(&mut state.forces, &self.conditions.constraints);
        state
    }

    /// The factor of the exact tangent at `u`, or of the definite one if the exact one is not positive definite.
    fn factor(&self, u: &[[f64; 3]], symbolic: &mut Option<Arc<Symbolic>>) -> Option<Factor> {
        let exact = self.tangent(u, Exact);
        if symbolic.is_none() {
            *symbolic = Symbolic::new(&exact, &[]).ok().map(Arc::new);
        }
        let symbolic = symbolic.as_ref()?;
        symbolic.factor(&exact).or_else(|_| symbolic.factor(&self.tangent(u, Definite))).ok()
    }

    fn tangent(&self, u: &[[f64; 3]], kind: TangentKind) -> BlockMatrix {
        let mut matrix = projected(&self.part.stiffness(u, kind), &self.conditions.constraints);
        let holds = |s: &Spring| kind == Exact || s.stiffness > 0.0;
        for (row, spring) in self.conditions.springs.iter().filter(|(_, s)| holds(s)) {
            matrix.add_to_diagonal(*row, spring.axis, spring.stiffness);
        }
        matrix
    }
}
