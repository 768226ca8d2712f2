//! Tissue that may touch what it does not slide on: lip against lip, and each lip against the teeth of both jaws.
//!
//! A node of a pair may not enter the surface that it faces, without friction: g(u) = φ(x + u) − min(φ at rest, 0)
//! ≥ 0 with φ the signed distance from the surface, which is that of a bone, moved by the plan, or a part of the
//! boundary of the tissue itself, deformed with it. Solved by the method of multipliers (Hestenes 1969, Powell
//! 1969; for inequalities Rockafellar 1973; for contact Simo & Laursen 1992): each round takes the least of
//!
//! ```text
//! E(u) + Σ ½ k (g(u) − λ/k)²     over the nodes with λ − k g > 0,
//! ```
//!
//! g linearised at the last state, and follows it by λ ← max(0, λ − k g). The stiffness k only says how many rounds
//! it takes: forces and gaps at the end do not depend on it.

use std::collections::HashMap;
use std::sync::Arc;

use rayon::prelude::*;

use crate::boundary::{Against, Boundary, Motion};
use crate::error::{ErrorKind, MtmError, Result};
use crate::geometry::motion::RigidMotion;
use crate::geometry::surface::{Closest, Surface};
use crate::mesh::TetMesh;
use crate::vector::{add, dot, norm, scaled, sub};

/// Row of a node that is no unknown.
const NO_ROW: u32 = u32::MAX;
/// Stiffness of a link over that of its node by itself: with more, each round takes more iterations, with less
/// there are more rounds.
const LINK_STIFFNESS: f64 = 10.0;
/// Way to the surface, over its mean edge, below which its direction is that of the continuous normal: the way
/// itself turns from facet to facet, and means nothing at the surface.
const NEAR_SHARE: f64 = 0.5;

/// Share of the links that may come and go while forces are adjusted: a node at the rim meets now one facet, now the
/// next.
const RIM_SHARE: f64 = 0.05;
/// Way past the border of an open surface, over its mean edge, up to which a node may still touch it.
const BORDER_REACH: f64 = 0.25;
/// Farthest that a gap shrinks in a round where a node goes through its surface, over the mean edge: bones go no
/// farther in a step.
const JUMP_SHARE: f64 = 1.0;
/// Depth behind a surface, over its mean edge, from which a node that was past its border has come round it.
const ROUND_SHARE: f64 = 0.1;
/// Depth behind a surface, over its mean edge, from which a node counts as on the far side of it: it is not pushed
/// back through.
const DEEPEST: f64 = 2.0;

/// A spring between an unknown node and up to three others, or none: ½ k (c·u − goal)².
#[derive(Debug, Clone)]
pub(crate) struct Link {
    /// Row and coefficient of each unknown node.
    pub ends: Vec<(u32, [f64; 3])>,
    /// k, N/mm.
    pub stiffness: f64,
    /// mm.
    pub goal: f64,
}

impl Link {
    /// c·x of rows x, mm.
    pub fn along(&self, x: &[[f64; 3]]) -> f64 {
        self.ends.iter().map(|(row, c)| dot(*c, x[*row as usize])).sum()
    }

    /// k (goal − c·x): the force that it puts on c at x, N.
    pub fn pull(&self, x: &[[f64; 3]]) -> f64 {
        self.stiffness * (self.goal - self.along(x))
    }

    /// Adds k (c·x) c to rows y.
    pub fn add_product(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) {
        self.add(self.stiffness * self.along(x), y);
    }

    /// Adds k goal c to the right-hand side `b`.
    pub fn add_goal(&self, b: &mut [[f64; 3]]) {
        self.add(self.stiffness * self.goal, b);
    }

    /// Adds k (goal − c·x) c to rows y: the force that it puts on them at x, N.
    pub fn add_force(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) {
        self.add(self.pull(x), y);
    }

    /// Takes it off again.
    pub fn take_force(&self, x: &[[f64; 3]], y: &mut [[f64; 3]]) {
        self.add(-self.pull(x), y);
    }

    fn add(&self, force: f64, y: &mut [[f64; 3]]) {
        for (row, c) in &self.ends {
            y[*row as usize] = add(y[*row as usize], scaled(*c, force));
        }
    }
}

/// A node that may meet a surface.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    node: u32,
    /// Its surface.
    wall: usize,
    /// Signed distance down to which it may go, mm: 0, or what it has at rest behind the surface.
    allowed: f64,
    /// Stiffness of its link, N/mm.
    stiffness: f64,
    /// Gap at rest, mm; none past the border of its surface.
    at_rest: Option<f64>,
}

/// A surface that nodes may not enter.
#[derive(Debug)]
enum Wall {
    /// A part of the boundary of the tissue, and the node of each vertex.
    Tissue { surface: Surface, nodes: Vec<u32> },
    /// That of a segment, or of bone that stays where it is.
    Bone { surface: Arc<Surface>, segment: Option<usize> },
}

impl Wall {
    fn surface(&self) -> &Surface {
        match self {
            Self::Tissue { surface, .. } => surface,
            Self::Bone { surface, .. } => surface,
        }
    }
}

/// What may touch what in a scene.
#[derive(Debug)]
pub(crate) struct Pairs {
    candidates: Vec<Candidate>,
    walls: Vec<Wall>,
    positions: Vec<[f64; 3]>,
    row_of: Vec<u32>,
}

/// Where a candidate is with respect to its surface.
#[derive(Debug, Clone, Copy)]
struct Meeting {
    /// g, mm.
    gap: f64,
    /// Unit vector away from the surface.
    normal: [f64; 3],
    /// Nodes of the triangle that is met, with the weights of the closest point; none on bone.
    facing: Option<([u32; 3], [f64; 3])>,
}

/// Forces between what touches, from one round to the next.
#[derive(Debug, Clone)]
pub(crate) struct Touching {
    /// λ of each candidate, N.
    pub multipliers: Vec<f64>,
    /// Gap of each where it was last, mm; none past the border of its surface.
    gaps: Vec<Option<f64>>,
}

/// A round of the method of multipliers: what it is linearised about, and the links that follow.
pub(crate) struct Round {
    meetings: Vec<Option<Meeting>>,
    active: Vec<bool>,
    pub links: Vec<Link>,
}

/// What a round left.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Left {
    /// Deepest that a node is behind its surface, mm.
    pub penetration: f64,
    /// Largest gap under a force, mm.
    pub gap: f64,
    /// Nodes that touch now and did not before, or the other way round.
    pub changed: usize,
}

impl Left {
    /// The larger of penetration and gap, mm.
    pub fn distance(&self) -> f64 {
        self.penetration.max(self.gap)
    }
}

/// A node that met its surface at the end.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Met {
    /// The node.
    pub node: u32,
    /// Distance from the surface less what it has behind it at rest, mm; negative where it penetrates.
    pub gap: f64,
    /// Unit normal of the surface.
    pub normal: [f64; 3],
    /// Force along it, N, not negative.
    pub force: f64,
}

impl Pairs {
    /// The pairs of `boundary`, or nothing where it has none.
    ///
    /// `places`: position of each node at rest. `row_of`: row of each node among the unknowns. `stiffness`: of each
    /// node by itself, N/mm.
    ///
    /// # Errors
    /// Triangles that are no boundary of the mesh, or face into the tissue; a triangle without area.
    pub fn new(
        boundary: &Boundary,
        mesh: &TetMesh,
        places: &[[f64; 3]],
        row_of: &[u32],
        stiffness: impl Fn(usize) -> f64,
    ) -> Result<Option<Self>> {
        if boundary.touching().is_empty() {
            return Ok(None);
        }
        let mut out = Self {
            candidates: Vec::new(),
            walls: Vec::new(),
            positions: places.to_vec(),
            row_of: row_of.to_vec(),
        };
        let outside = Outside::new(mesh);
        for (p, pair) in boundary.touching().iter().enumerate() {
            let wall = match &pair.against {
                Against::Tissue(triangles) => {
                    outside.check(p, triangles)?;
                    tissue_wall(places, triangles)?
                }
                Against::Bone { surface, segment } => {
                    let segments = boundary.segments();
                    let number = segment
                        .as_ref()
                        .and_then(|name| segments.iter().position(|s| s.name == *name));
                    Wall::Bone { surface: surface.clone(), segment: number }
                }
            };
            let own: &[u32] = match &wall {
                Wall::Tissue { nodes, .. } => nodes,
                Wall::Bone { .. } => &[],
            };
            for &node in pair.nodes.iter().filter(|node| own.binary_search(node).is_err()) {
                let Some(&place) = places.get(node as usize) else {
                    return Err(out_of_range(p, node, places.len()));
                };
                let closest = wall.surface().closest_one(place);
                let mean_edge = wall.surface().mean_edge_length();
                let way = sub(place, closest.point);
                let distance = over(&closest, way, mean_edge);
                let behind = distance.map_or(0.0, |d| d.min(0.0));
                if behind < -DEEPEST * mean_edge {
                    continue;
                }
                out.candidates.push(Candidate {
                    node,
                    wall: out.walls.len(),
                    allowed: behind,
                    stiffness: LINK_STIFFNESS * stiffness(node as usize),
                    at_rest: distance.map(|d| d - behind),
                });
            }
            out.walls.push(wall);
        }
        Ok(Some(out))
    }

    /// No forces yet.
    pub fn at_rest(&self) -> Touching {
        Touching {
            multipliers: vec![0.0; self.candidates.len()],
            gaps: self.candidates.iter().map(|c| c.at_rest).collect(),
        }
    }

    /// Mean edge of the surfaces of tissue, mm, or of all where there is none of tissue.
    pub fn mean_edge(&self) -> f64 {
        let mean = |walls: Vec<&Wall>| {
            let sum: f64 = walls.iter().map(|w| w.surface().mean_edge_length()).sum();
            sum / walls.len() as f64
        };
        let tissue: Vec<&Wall> =
            self.walls.iter().filter(|w| matches!(w, Wall::Tissue { .. })).collect();
        if tissue.is_empty() { mean(self.walls.iter().collect()) } else { mean(tissue) }
    }

    /// Where every candidate is under displacements `u` of all nodes; nothing for those past a border, and for those
    /// that came behind their surface round its border or past an edge of it: farther from their gaps `before` than
    /// a step takes them, they did not go through it.
    ///
    /// # Errors
    /// A triangle of the tissue that has collapsed.
    fn meetings(
        &self,
        u: &[[f64; 3]],
        motions: &[&Motion],
        before: &[Option<f64>],
    ) -> Result<Vec<Option<Meeting>>> {
        let there = |j: u32| add(self.positions[j as usize], u[j as usize]);
        let mut moved = Vec::with_capacity(self.walls.len());
        for wall in &self.walls {
            moved.push(match wall {
                Wall::Tissue { surface, nodes } => {
                    Moved::Deformed(surface.moved(nodes.iter().map(|&j| there(j)).collect())?)
                }
                Wall::Bone { surface, segment } => match segment.map(|s| motions[s]) {
                    None => Moved::Rigid(surface, RigidMotion::identity()),
                    Some(Motion::Rigid(rigid)) => Moved::Rigid(surface, *rigid),
                    Some(Motion::Surface(motion)) => {
                        let way = motion.displacement(surface.vertices());
                        let vertices = surface.vertices().iter().zip(way);
                        Moved::Deformed(surface.moved(vertices.map(|(x, w)| add(*x, w)).collect())?)
                    }
                    // Refused by `Boundary::motions` for segments that nodes may touch.
                    Some(Motion::Nodes(_)) => Moved::Rigid(surface, RigidMotion::identity()),
                },
            });
        }
        let meet = |(c, before): (&Candidate, &Option<f64>)| {
            let edge = self.walls[c.wall].surface().mean_edge_length();
            let through = before.map_or(0.0, |gap| gap - JUMP_SHARE * edge);
            let deepest = through.min(-ROUND_SHARE * edge);
            self.meet(c, &moved[c.wall], there(c.node)).filter(|m| m.gap >= deepest)
        };
        Ok(self.candidates.par_iter().zip(before).with_min_len(64).map(meet).collect())
    }

    /// Where candidate `c` at `place` is; nothing past the border of its surface.
    fn meet(&self, c: &Candidate, wall: &Moved<'_>, place: [f64; 3]) -> Option<Meeting> {
        let (closest, mean_edge) = match wall {
            Moved::Rigid(surface, rigid) => {
                let mut found = surface.closest_one(rigid.apply_inverse(place));
                found.point = rigid.apply(found.point);
                found.normal = rigid.rotate(found.normal);
                (found, surface.mean_edge_length())
            }
            Moved::Deformed(surface) => (surface.closest_one(place), surface.mean_edge_length()),
        };
        let way = sub(place, closest.point);
        let distance = over(&closest, way, mean_edge)?;
        if distance < c.allowed - DEEPEST * mean_edge {
            return None;
        }
        let far = !closest.on_border && norm(way) > NEAR_SHARE * mean_edge;
        let normal = if far { scaled(way, distance.signum() / norm(way)) } else { closest.normal };
        let facing = match &self.walls[c.wall] {
            Wall::Tissue { surface, nodes } => {
                let corners = surface.triangles()[closest.triangle as usize];
                Some((corners.map(|v| nodes[v as usize]), closest.barycentric))
            }
            Wall::Bone { .. } => None,
        };
        Some(Meeting { gap: distance - c.allowed, normal, facing })
    }

    /// The round at displacements `u` of all nodes, with the forces of `touching`.
    ///
    /// # Errors
    /// A triangle of the tissue that has collapsed.
    pub fn round(&self, u: &[[f64; 3]], motions: &[&Motion], touching: &Touching) -> Result<Round> {
        let meetings = self.meetings(u, motions, &touching.gaps)?;
        let (mut links, mut active) = (Vec::new(), vec![false; self.candidates.len()]);
        for (i, c) in self.candidates.iter().enumerate() {
            let Some(meeting) = &meetings[i] else { continue };
            let force = touching.multipliers[i];
            if force - c.stiffness * meeting.gap <= 0.0 {
                continue;
            }
            active[i] = true;
            let ends = self.ends(c, meeting);
            let here: f64 = ends.iter().map(|(j, n)| dot(*n, u[*j as usize])).sum();
            let row = |(j, n): &(u32, [f64; 3])| (self.row_of[*j as usize], *n);
            let known: f64 = ends
                .iter()
                .filter(|(j, _)| self.row_of[*j as usize] == NO_ROW)
                .map(|(j, n)| dot(*n, u[*j as usize]))
                .sum();
            links.push(Link {
                ends: ends.iter().map(row).filter(|(row, _)| *row != NO_ROW).collect(),
                stiffness: c.stiffness,
                goal: here - known - meeting.gap + force / c.stiffness,
            });
        }
        Ok(Round { meetings, active, links })
    }

    /// Nodes of a meeting with the change of its gap by each.
    fn ends(&self, c: &Candidate, meeting: &Meeting) -> Vec<(u32, [f64; 3])> {
        let mut ends = vec![(c.node, meeting.normal)];
        if let Some((nodes, weights)) = meeting.facing {
            ends.extend((0..3).map(|k| (nodes[k], scaled(meeting.normal, -weights[k]))));
        }
        ends
    }

    /// Σ ½ k ⟨λ/k − g⟩₊² at displacements `u` of all nodes, N mm: what pressing adds to the elastic energy.
    ///
    /// # Errors
    /// A triangle of the tissue that has collapsed.
    pub fn energy(&self, u: &[[f64; 3]], motions: &[&Motion], touching: &Touching) -> Result<f64> {
        let meetings = self.meetings(u, motions, &touching.gaps)?;
        let each = self.candidates.iter().zip(&meetings).zip(&touching.multipliers);
        Ok(each
            .map(|((c, meeting), force)| {
                let deep = meeting.map_or(0.0, |m| (force / c.stiffness - m.gap).max(0.0));
                0.5 * c.stiffness * deep * deep
            })
            .sum())
    }

    /// Follows `round` by the forces that gaps at displacements `u` ask for, where these are the `is_whole` step of the
    /// round; what is left open.
    ///
    /// # Errors
    /// A triangle of the tissue that has collapsed.
    pub fn follow(
        &self,
        round: &Round,
        u: &[[f64; 3]],
        motions: &[&Motion],
        touching: &mut Touching,
        is_whole: bool,
    ) -> Result<Left> {
        let meetings = self.meetings(u, motions, &touching.gaps)?;
        touching.gaps = gaps(&meetings);
        let mut left = Left { penetration: 0.0, gap: 0.0, changed: 0 };
        let mut forces = touching.multipliers.clone();
        for (i, c) in self.candidates.iter().enumerate() {
            let Some(meeting) = &meetings[i] else {
                left.changed += usize::from(round.active[i]);
                forces[i] = 0.0;
                continue;
            };
            forces[i] = (forces[i] - c.stiffness * meeting.gap).max(0.0);
            left.changed += usize::from((forces[i] > 0.0) != round.active[i]);
            left.penetration = left.penetration.max(-meeting.gap);
            if forces[i] > 0.0 {
                left.gap = left.gap.max(meeting.gap);
            }
        }
        // Forces follow once it is known what touches under the last ones, but for a few nodes at the rim.
        if is_whole && left.changed as f64 <= RIM_SHARE * round.links.len() as f64 {
            touching.multipliers = forces;
        }
        Ok(left)
    }

    /// The nodes that press most, `most` of them.
    pub fn pressed(&self, touching: &Touching, most: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.candidates.len()).collect();
        let force = |i: usize| touching.multipliers[i];
        order.sort_by(|&a, &b| force(b).total_cmp(&force(a)).then(a.cmp(&b)));
        order.iter().take(most).map(|&i| self.candidates[i].node as usize).collect()
    }

    /// What met at the end of `round`: at displacements `u` of all nodes.
    ///
    /// # Errors
    /// A triangle of the tissue that has collapsed.
    pub fn met(
        &self,
        round: &Round,
        u: &[[f64; 3]],
        motions: &[&Motion],
        rows: &[[f64; 3]],
    ) -> Result<Vec<Met>> {
        let meetings = self.meetings(u, motions, &gaps(&round.meetings))?;
        let mut links = round.links.iter();
        let mut out = Vec::new();
        for (i, c) in self.candidates.iter().enumerate() {
            let link = if round.active[i] { links.next() } else { None };
            let force = link.map_or(0.0, |l| l.pull(rows));
            if let Some(meeting) = meetings[i].or(round.meetings[i]) {
                let (gap, normal) = (meeting.gap, meeting.normal);
                out.push(Met { node: c.node, gap, normal, force });
            }
        }
        Ok(out)
    }
}

/// Signed distance of a point that lies by `way` from its closest point; nothing past the border of the surface.
fn over(closest: &Closest, way: [f64; 3], mean_edge: f64) -> Option<f64> {
    if !closest.on_border {
        return Some(closest.signed_distance);
    }
    let along = dot(closest.normal, way);
    let aside = norm(sub(way, scaled(closest.normal, along)));
    (aside <= BORDER_REACH * mean_edge).then_some(along)
}

fn out_of_range(pair: usize, node: u32, count: usize) -> MtmError {
    MtmError::IndexOutOfRange {
        what: format!("nodes of touching pair {pair}"),
        row: 0,
        item: "node",
        index: node as usize,
        count,
        kind: ErrorKind::Boundary,
    }
}

/// Gap of each meeting, mm.
fn gaps(meetings: &[Option<Meeting>]) -> Vec<Option<f64>> {
    meetings.iter().map(|m| m.map(|m| m.gap)).collect()
}

/// A surface under a plan.
enum Moved<'a> {
    /// Points are carried back to it.
    Rigid(&'a Surface, RigidMotion),
    Deformed(Surface),
}

/// The wall of `triangles` of nodes, its vertices numbered by ascending node.
fn tissue_wall(places: &[[f64; 3]], triangles: &[[u32; 3]]) -> Result<Wall> {
    let mut nodes: Vec<u32> = triangles.iter().flatten().copied().collect();
    nodes.sort_unstable();
    nodes.dedup();
    let number = |j: u32| nodes.partition_point(|&n| n < j) as u32;
    let rows = triangles.iter().map(|t| t.map(number)).collect();
    let vertices = nodes.iter().map(|&j| places[j as usize]).collect();
    Ok(Wall::Tissue { surface: Surface::new(vertices, rows)?, nodes })
}

/// The boundary triangles of a mesh, however they are turned.
struct Outside {
    triangles: HashMap<[u32; 3], [u32; 3]>,
}

impl Outside {
    fn new(mesh: &TetMesh) -> Self {
        let sorted = |mut t: [u32; 3]| {
            t.sort_unstable();
            t
        };
        Self { triangles: mesh.boundary_triangles().iter().map(|&t| (sorted(t), t)).collect() }
    }

    /// Refuses triangles of a pair that are no boundary of the tissue, or face into it.
    fn check(&self, pair: usize, triangles: &[[u32; 3]]) -> Result<()> {
        for (row, triangle) in triangles.iter().enumerate() {
            let mut key = *triangle;
            key.sort_unstable();
            let problem = match self.triangles.get(&key) {
                None => "is no triangle of the mesh's boundary",
                Some(out) if !same_turn(out, triangle) => {
                    "faces into the tissue: reverse the order of its nodes"
                }
                Some(_) => continue,
            };
            let problem = format!("has triangle {row} of nodes {triangle:?}, which {problem}");
            return Err(MtmError::TouchingPair { pair, problem });
        }
        Ok(())
    }
}

/// Whether two triangles of the same nodes have them in the same cyclic order.
fn same_turn(a: &[u32; 3], b: &[u32; 3]) -> bool {
    let at = a.iter().position(|v| *v == b[0]).unwrap_or(0);
    a[(at + 1) % 3] == b[1]
}
