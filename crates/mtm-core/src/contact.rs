//! Sliding contact: nodes stay on the moved surface of their bone segment and feel no force along it.
//!
//! A sliding node x keeps n·(x + u − c) = g, with c the closest point of the moved contact surface and
//! n its continuous unit normal there (Kim et al. 2010, section 2.5 and eq. 2: forces act in the tangent
//! plane). The outer loop alternates closest point and constrained solve until both settle.

use std::sync::Arc;

use rayon::prelude::*;

use crate::boundary::{Boundary, Gap, Motion};
use crate::crease::{ContactRow, Foot, MovedSurface, Push, Walls};
use crate::error::{MtmError, Result};
use crate::mesh::{TetMesh, add, dot, norm, scaled, sub};
use crate::surface::Surface;

/// Smallest step of a damped node towards its new position.
const LEAST_STEP: f64 = 1.0 / 64.0;
/// A node whose step reverses and keeps more than this share of its length is damped.
const REVERSAL: f64 = 0.5;
/// Most nodes an error names.
const NAMED_NODES: usize = 10;
/// Share of sliding nodes that may face away from the contact surface before it counts as inverted.
const MOSTLY: f64 = 0.5;
/// Rounding of the area vector round a node, relative to the areas summed: less has no direction.
const FACING_ROUNDING: f64 = 1e-12;

/// Whether nodes may lift off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ContactMode {
    /// Nodes stay on the surface, pushed or pulled (the paper).
    Bilateral,
    /// Nodes may lift off, never penetrate: pressure is not negative at the end.
    Unilateral,
}

/// When the contact loop stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactOptions {
    /// Whether nodes may lift off.
    pub mode: ContactMode,
    /// Largest gap over the diagonal of the mesh, and largest tangential share of the contact force.
    pub tolerance: f64,
    /// Outer iterations after which the loop gives up.
    pub max_iterations: usize,
    /// How far past the border of an open contact surface a node may end, over the surface's mean edge.
    pub border_reach: f64,
}

impl Default for ContactOptions {
    fn default() -> Self {
        Self {
            mode: ContactMode::Bilateral,
            tolerance: 1e-9,
            max_iterations: 100,
            border_reach: 0.25,
        }
    }
}

/// One sliding node.
#[derive(Debug, Clone, Copy)]
pub struct SlidingNode {
    /// The node.
    pub node: u32,
    /// Its row among the unknown nodes.
    pub row: u32,
    /// Its segment.
    pub segment: usize,
    /// Distance it keeps along the normal, mm.
    pub gap: f64,
}

/// The sliding nodes of a scene with their contact surfaces at rest.
#[derive(Debug)]
pub struct Sliding {
    nodes: Vec<SlidingNode>,
    positions: Vec<[f64; 3]>,
    rest_normals: Vec<[f64; 3]>,
    surfaces: Vec<Option<Arc<Surface>>>,
    names: Vec<String>,
    diagonal: f64,
}

/// Where the sliding nodes ended.
#[derive(Debug, Clone)]
pub struct ContactState {
    /// Displacement of each sliding node, mm.
    pub displacements: Vec<[f64; 3]>,
    /// Closest point of the moved surface, mm.
    pub points: Vec<[f64; 3]>,
    /// Unit normal that the contact force follows.
    pub normals: Vec<[f64; 3]>,
    /// Contact force along the normal, N; positive pushes the tissue away from the bone.
    pub forces: Vec<f64>,
    /// Walls that hold each node: one on a smooth part, two in a crease, three in a corner, none where it
    /// has lifted off.
    pub walls: Vec<u8>,
    /// Normal and closest point of each of these walls, node by node.
    pub rows: Vec<ContactRow>,
    /// n·(x + u − c) − g at the end, mm.
    pub gaps: Vec<f64>,
    /// Whether the node is held to the surface.
    pub active: Vec<bool>,
    /// Outer iterations done.
    pub iterations: usize,
}

/// Constraints n_r·u_i = offset_r on the sliding nodes that are held.
pub struct Constraints<'a> {
    /// Node and normal of each constraint, nodes ascending.
    pub rows: &'a [ContactRow],
    /// Offset of every row, mm.
    pub offsets: &'a [f64],
}

/// Displacements (mm) of all sliding nodes and contact forces (N) along the rows.
pub struct Response {
    /// Displacement of every sliding node.
    pub displacements: Vec<[f64; 3]>,
    /// Contact force of each of `Constraints::rows`.
    pub forces: Vec<f64>,
}

impl Sliding {
    /// The sliding nodes of `boundary`, or nothing where no node slides.
    ///
    /// `row_of`: row of each node among the unknowns.
    ///
    /// # Errors
    /// A contact surface that faces away from the tissue where that matters.
    pub fn new(
        boundary: &Boundary,
        mesh: &TetMesh,
        row_of: &[u32],
        mode: ContactMode,
    ) -> Result<Option<Self>> {
        if !boundary.has_sliding() {
            return Ok(None);
        }
        let mut sliding = Self {
            nodes: Vec::new(),
            positions: Vec::new(),
            rest_normals: Vec::new(),
            surfaces: Vec::new(),
            names: Vec::new(),
            diagonal: mesh.diagonal(),
        };
        for (s, segment) in boundary.segments().iter().enumerate() {
            sliding.names.push(segment.name.clone());
            let (false, Some(surface)) = (segment.sliding.is_empty(), &segment.contact) else {
                sliding.surfaces.push(None);
                continue;
            };
            let positions: Vec<[f64; 3]> =
                segment.sliding.iter().map(|&j| mesh.nodes()[j as usize]).collect();
            let closest = surface.closest(&positions);
            let normals: Vec<[f64; 3]> = closest.iter().map(|c| c.normal).collect();
            check_facing(mesh, &segment.name, &segment.sliding, surface, &normals, mode)?;
            for (i, &node) in segment.sliding.iter().enumerate() {
                let gap = match &segment.gap {
                    Gap::Uniform(value) => *value,
                    Gap::PerNode(values) => values[i],
                    Gap::Rest => dot(normals[i], sub(positions[i], closest[i].point)),
                };
                let row = row_of[node as usize];
                sliding.nodes.push(SlidingNode { node, row, segment: s, gap });
            }
            sliding.positions.extend(positions);
            sliding.rest_normals.extend(normals);
            sliding.surfaces.push(Some(surface.clone()));
        }
        Ok(Some(sliding))
    }

    /// The sliding nodes, segment by segment.
    pub fn nodes(&self) -> &[SlidingNode] {
        &self.nodes
    }

    /// Unit normal of the contact surface at rest for each sliding node.
    pub fn rest_normals(&self) -> &[[f64; 3]] {
        &self.rest_normals
    }

    /// Runs the outer loop for `motions` (one per segment), solving with `solve`.
    ///
    /// # Errors
    /// `ContactCycle` where closest points or the set of held nodes do not settle, `ContactSurface`
    /// where a node ends past the border of its surface, whatever `solve` reports.
    pub fn settle(
        &self,
        motions: &[&Motion],
        options: &ContactOptions,
        interrupted: &(dyn Fn() -> bool + Sync),
        mut solve: impl FnMut(&Constraints<'_>) -> Result<Response>,
    ) -> Result<ContactState> {
        let surfaces = self.moved_surfaces(motions)?;
        let n = self.nodes.len();
        let gap_limit = options.tolerance * self.diagonal;
        let mut at: Vec<[f64; 3]> = self.carried(motions);
        let mut walls: Vec<Walls> = self.feet(&surfaces, &at).into_iter().map(Walls::new).collect();
        let mut held = Held::new(n, options.mode);
        let (mut step, mut damping) = (vec![[0.0; 3]; n], vec![1.0_f64; n]);
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
            let offsets: Vec<f64> = rows
                .iter()
                .map(|r| {
                    dot(r.normal, sub(r.point, self.positions[r.node])) + self.nodes[r.node].gap
                })
                .collect();
            let response = solve(&Constraints { rows: &rows, offsets: &offsets })?;

            let reached: Vec<[f64; 3]> =
                (0..n).map(|i| add(self.positions[i], response.displacements[i])).collect();
            let nearest = self.feet(&surfaces, &reached);
            let gaps: Vec<f64> =
                (0..n).map(|i| nearest[i].height(reached[i]) - self.nodes[i].gap).collect();
            let surface = |i: usize| &surfaces[self.nodes[i].segment];
            let new_feet: Vec<Vec<Foot>> =
                (0..n).map(|i| walls[i].feet_at(surface(i), reached[i], nearest[i])).collect();
            let largest_force = response.forces.iter().fold(0.0_f64, |m, f| m.max(f.abs()));
            let mut gap =
                (0..n).filter(|&i| held.active[i]).fold(0.0_f64, |m, i| m.max(gaps[i].abs()));
            let mut turned = 0.0_f64;
            let mut pushes = vec![Push::default(); n];
            for (row, &force) in rows.iter_mut().zip(&response.forces) {
                let i = row.node;
                let foot = &new_feet[i][pushes[i].forces.len()];
                gap = gap.max((foot.height(reached[i]) - self.nodes[i].gap).abs());
                turned = turned.max(force.abs() * norm(sub(foot.normal, row.normal)));
                row.point = foot.point;
                pushes[i].add(row.normal, force);
            }
            let (normals, forces): (Vec<[f64; 3]>, Vec<f64>) =
                pushes.iter().zip(&walls).map(|(p, w)| p.along(w.feet[0].normal)).unzip();
            let mut rebuilt = false;
            for i in (0..n).filter(|&i| held.active[i]) {
                let let_go = held.unilateral && walls[i].let_go(&pushes[i].forces);
                let left = !let_go
                    && gaps[i].abs() > gap_limit
                    && nearest[i].triangle != walls[i].feet[0].triangle
                    && walls[i].leave(surface(i), reached[i], nearest[i]);
                if left || let_go {
                    (damping[i], rebuilt) = (1.0, true);
                }
            }
            let active = held.active.clone();
            let changed = held.update(&forces, &gaps, gap_limit) || rebuilt;
            let settled =
                !changed && gap <= gap_limit && turned <= options.tolerance * largest_force;
            let last = ContactState {
                displacements: response.displacements,
                points: nearest.iter().map(|f| f.point).collect(),
                normals,
                forces,
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
            // Nodes that swing back and forth between triangles approach their new place in part.
            let mut moved = at.clone();
            for i in 0..n {
                let new_step = sub(reached[i], at[i]);
                let reversed = dot(new_step, step[i]) < 0.0
                    && norm(new_step) > REVERSAL * norm(step[i])
                    && norm(new_step) > gap_limit;
                damping[i] = if reversed {
                    (0.5 * damping[i]).max(LEAST_STEP)
                } else {
                    (1.5 * damping[i]).min(1.0)
                };
                step[i] = new_step;
                moved[i] = add(at[i], scaled(new_step, damping[i]));
            }
            for i in (0..n).filter(|&i| !held.active[i]) {
                walls[i] = Walls::new(nearest[i]);
            }
            let next = if damping.iter().all(|&d| d == 1.0) {
                nearest
            } else {
                self.feet(&surfaces, &moved)
            };
            at = moved;
            let previous = walls.clone();
            for i in 0..n {
                let feet = walls[i].feet_at(surface(i), at[i], next[i]);
                walls[i].follow(&feet);
            }
            state = Some((last, next, previous));
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
                kind: crate::error::ErrorKind::Solver,
            }),
        }
    }

    /// Where the sliding nodes would be if they clung to their segment.
    fn carried(&self, motions: &[&Motion]) -> Vec<[f64; 3]> {
        let mut out = self.positions.clone();
        for (s, motion) in motions.iter().enumerate() {
            let members: Vec<usize> =
                (0..self.nodes.len()).filter(|&i| self.nodes[i].segment == s).collect();
            match motion {
                Motion::Rigid(rigid) => {
                    for i in members {
                        out[i] = rigid.apply(self.positions[i]);
                    }
                }
                Motion::Surface(surface) => {
                    let points: Vec<[f64; 3]> =
                        members.iter().map(|&i| self.positions[i]).collect();
                    for (i, u) in members.into_iter().zip(surface.displacement(&points)) {
                        out[i] = add(self.positions[i], u);
                    }
                }
                // Refused by `Boundary::motions` for segments with sliding nodes.
                Motion::Nodes(_) => {}
            }
        }
        out
    }

    fn moved_surfaces(&self, motions: &[&Motion]) -> Result<Vec<MovedSurface>> {
        self.surfaces
            .iter()
            .zip(motions)
            .map(|(surface, motion)| {
                Ok(match (surface, motion) {
                    (None, _) | (_, Motion::Nodes(_)) => MovedSurface::Unused,
                    (Some(rest), Motion::Rigid(rigid)) => MovedSurface::Rigid(rest.clone(), *rigid),
                    (Some(rest), Motion::Surface(surface)) => {
                        let u = surface.displacement(rest.vertices());
                        let moved =
                            rest.vertices().iter().zip(u).map(|(&x, u)| add(x, u)).collect();
                        MovedSurface::Moved(rest.moved(moved)?)
                    }
                })
            })
            .collect()
    }

    fn feet(&self, surfaces: &[MovedSurface], at: &[[f64; 3]]) -> Vec<Foot> {
        (0..at.len())
            .into_par_iter()
            .with_min_len(64)
            .map(|i| surfaces[self.nodes[i].segment].foot(at[i]))
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
    seen: std::collections::HashSet<Vec<bool>>,
    one_at_a_time: bool,
    cycled: bool,
}

impl Held {
    fn new(n: usize, mode: ContactMode) -> Self {
        Self {
            active: vec![true; n],
            unilateral: mode == ContactMode::Unilateral,
            seen: std::collections::HashSet::new(),
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

/// Refuses a contact surface that faces away from the tissue, where the side matters: always if nodes
/// may lift off, and for closed surfaces turned inside out.
fn check_facing(
    mesh: &TetMesh,
    segment: &str,
    nodes: &[u32],
    surface: &Surface,
    normals: &[[f64; 3]],
    mode: ContactMode,
) -> Result<()> {
    let inside_out = surface.volume().is_some_and(|v| v < 0.0);
    if mode == ContactMode::Bilateral && !inside_out {
        return Ok(());
    }
    let away: Vec<u32> = nodes
        .iter()
        .zip(normals)
        .filter(|&(&j, &n)| {
            // Σ_t V_t ∇φ_j = ∫ φ_j dA over the boundary round j: a third of its area vector, out of the
            // tissue, whatever the shape of the tets; zero but for rounding inside the body.
            let (mut out, mut size) = ([0.0; 3], 0.0);
            for &t in mesh.tets_of_node(j as usize) {
                let Some(a) = mesh.tets()[t as usize].iter().position(|&v| v == j) else {
                    continue;
                };
                let geometry = mesh.geometry(t as usize);
                let part = scaled(geometry.gradients[a], geometry.volume);
                out = add(out, part);
                size += norm(part);
            }
            dot(out, n) > FACING_ROUNDING * size
        })
        .map(|(&j, _)| j)
        .collect();
    if away.len() as f64 <= MOSTLY * nodes.len() as f64 {
        return Ok(());
    }
    Err(MtmError::ContactSurface {
        segment: segment.to_owned(),
        problem: format!(
            "is inverted: its normals point away from the tissue at {} of {} sliding nodes (for example \
             node {}); normals point out of the bone: reverse the order of each triangle's vertices",
            away.len(),
            nodes.len(),
            away[0]
        ),
    })
}
