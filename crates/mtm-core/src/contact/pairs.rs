//! Contact of tissue with anything but its sliding surface: lip against lip, and each lip against the teeth of
//! both jaws.
//!
//! A node of a pair may not enter the surface it faces; there is no friction:
//! g(u) = φ(x + u) − min(φ at rest, 0) ≥ 0, where φ is the signed distance from the surface. The surface
//! belongs to a bone, moved by the plan, or is a part of the boundary of the tissue itself, deformed with it.
//! The problem is solved by the method of multipliers (Hestenes 1969, Powell 1969; for inequalities
//! Rockafellar 1973; for contact Simo & Laursen 1992). Each round minimises
//!
//! ```text
//! E(u) + Σ ½ k ⟨λ/k − g(u)⟩₊²,
//! ```
//!
//! with g linearised about the last state, and then updates λ ← max(0, λ − k g). The stiffness k only affects
//! the number of rounds: the final forces and gaps do not depend on it.

use rayon::prelude::*;

use crate::boundary::{Against, Boundary, Motion};
use crate::contact::links::Link;
use crate::contact::overlap::Overlap;
use crate::contact::planes::{Meeting, Plane, Planes};
use crate::contact::walls::{MovedWall, Outside, Wall};
use crate::error::{ErrorKind, Result};
use crate::geometry::motion::RigidMotion;
use crate::geometry::surface::Closest;
use crate::mesh::TetMesh;
use crate::vector::{add, dot, norm, scaled, sub};

/// Row of a node that is not an unknown.
pub(crate) const NO_ROW: u32 = u32::MAX;
/// Stiffness of a link over the own stiffness of its node: a larger value makes each round take more
/// iterations, a smaller one requires more rounds.
const LINK_STIFFNESS: f64 = 1.0;
/// Distance to the surface, over its mean edge, below which the continuous normal is used as direction: that to
/// the closest point jumps from facet to facet, and is undefined at the surface.
const NEAR_SHARE: f64 = 0.5;
/// Distance beyond the border of an open surface, over its mean edge, up to which a node may still touch it.
pub(super) const BORDER_REACH: f64 = 0.25;
/// Largest decrease of a gap in one round for a node that passes through its surface, over the mean edge: while
/// bones move, the planes that move with them stop it earlier.
const JUMP_SHARE: f64 = 1.0;
/// Depth behind a surface, over its mean edge, from which a node that was beyond its border is taken to have
/// come around it.
const ROUND_SHARE: f64 = 0.1;
/// Depth behind a surface, over its mean edge, from which a node counts as being on its far side, and is not
/// pushed back through it.
const DEEPEST: f64 = 2.0;

/// A node that may meet a surface.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    node: u32,
    /// Its surface.
    wall: usize,
    /// Smallest signed distance allowed, mm: 0, or the distance at rest if the node is behind the surface
    /// there.
    allowed: f64,
    /// Stiffness of its link, N/mm.
    stiffness: f64,
    /// Gap at rest, mm; none beyond the border of its surface.
    at_rest: Option<f64>,
}

/// The surfaces of a scene that may touch, and the nodes that may touch them.
#[derive(Debug)]
pub(crate) struct Pairs {
    candidates: Vec<Candidate>,
    walls: Vec<Wall>,
    positions: Vec<[f64; 3]>,
    row_of: Vec<u32>,
    /// The candidates that lie in no other tissue at rest.
    pub overlap: Overlap,
}

/// Contact forces, carried from one round to the next.
#[derive(Debug, Clone)]
pub(crate) struct Touching {
    /// λ of each candidate, N.
    multipliers: Vec<f64>,
    /// Last gap of each candidate, mm; none beyond the border of its surface.
    pub gaps: Vec<Option<f64>>,
}

/// A round of the method of multipliers.
pub(crate) struct Round {
    /// Link of each candidate under pressure.
    number: Vec<Option<u32>>,
    pub links: Vec<Link>,
}

impl Round {
    /// The force on candidate `i` at displacements `rows` of the unknown nodes, N; zero if nothing pushes it.
    pub fn force(&self, i: usize, rows: &[[f64; 3]]) -> f64 {
        self.number[i].map_or(0.0, |k| self.links[k as usize].pull(rows).max(0.0))
    }
}

/// Residuals of a round.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Left {
    /// Largest depth of a node behind its surface, mm.
    pub penetration: f64,
    /// The same for surfaces of bone alone.
    pub in_bone: f64,
    /// Largest gap under a force, mm.
    pub gap: f64,
}

impl Left {
    /// The larger of penetration of bone and gap, mm: where tissue meets tissue, the closest point of a node
    /// that has slid past the border of the other part may lie on its far side, and only deformed tets show
    /// whether it is inside.
    pub fn beside_tissue(&self) -> f64 {
        self.in_bone.max(self.gap)
    }
}

/// A node that touches its surface in the result.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Met {
    /// The node.
    pub node: u32,
    /// Distance from the surface minus any penetration at rest, mm; negative where the node penetrates.
    pub gap: f64,
    /// Unit normal of the surface.
    pub normal: [f64; 3],
    /// Force along it, N, zero or positive.
    pub force: f64,
    /// Whether the surface is that of a bone.
    pub is_bone: bool,
}

impl Pairs {
    /// The pairs of `boundary`, or nothing if it has none.
    ///
    /// `places`: position of each node at rest. `row_of`: row of each node among the unknowns. `stiffness`:
    /// stiffness of each node on its own, N/mm.
    ///
    /// # Errors
    /// Triangles that are not on the boundary of the mesh, or face into the tissue; a triangle without area.
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
        let (mut candidates, mut walls) = (Vec::new(), Vec::new());
        let outside = Outside::new(mesh);
        for (p, pair) in boundary.touching().iter().enumerate() {
            let wall = match &pair.against {
                Against::Tissue(triangles) => {
                    outside.check(p, triangles)?;
                    Wall::of_tissue(places, triangles)?
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
                    let what = format!("nodes of touching pair {p}");
                    return Err(ErrorKind::Boundary.no_such((what, 0), "node", node, places.len()));
                };
                let closest = wall.surface().closest_one(place);
                let mean_edge = wall.surface().mean_edge_length();
                let way = sub(place, closest.point);
                let distance = over(&closest, way, mean_edge);
                let behind = distance.map_or(0.0, |d| d.min(0.0));
                if behind < -DEEPEST * mean_edge {
                    continue;
                }
                candidates.push(Candidate {
                    node,
                    wall: walls.len(),
                    allowed: behind,
                    stiffness: LINK_STIFFNESS * stiffness(node as usize),
                    at_rest: distance.map(|d| d - behind),
                });
            }
            walls.push(wall);
        }
        let overlap = Overlap::new(mesh, candidates.iter().map(|c| c.node).collect());
        let (positions, row_of) = (places.to_vec(), row_of.to_vec());
        Ok(Some(Self { candidates, walls, positions, row_of, overlap }))
    }

    /// No forces yet.
    pub fn at_rest(&self) -> Touching {
        Touching {
            multipliers: vec![0.0; self.candidates.len()],
            gaps: self.candidates.iter().map(|c| c.at_rest).collect(),
        }
    }

    /// Mean edge of the tissue surfaces, mm, or of all surfaces if none is of tissue.
    pub fn mean_edge(&self) -> f64 {
        let mean = |walls: Vec<&Wall>| {
            let sum: f64 = walls.iter().map(|w| w.surface().mean_edge_length()).sum();
            sum / walls.len() as f64
        };
        let tissue: Vec<&Wall> =
            self.walls.iter().filter(|w| matches!(w, Wall::Tissue { .. })).collect();
        if tissue.is_empty() { mean(self.walls.iter().collect()) } else { mean(tissue) }
    }

    /// The position of every candidate relative to its surface under displacements `u` of all nodes. Nothing
    /// for candidates beyond a border, and for those that came behind their surface around its border or past
    /// one of its edges: they are further from their gaps `before` than one step can take them, so they did not
    /// pass through the surface.
    ///
    /// # Errors
    /// A triangle of the tissue that has collapsed.
    fn meetings(
        &self,
        mesh: &TetMesh,
        u: &[[f64; 3]],
        motions: &[&Motion],
        before: &[Option<f64>],
    ) -> Result<Vec<Option<Meeting>>> {
        let there = |j: u32| add(self.positions[j as usize], u[j as usize]);
        let mut moved = Vec::with_capacity(self.walls.len());
        for wall in &self.walls {
            moved.push(match wall {
                Wall::Tissue { surface, nodes } => {
                    MovedWall::Deformed(surface.moved(nodes.iter().map(|&j| there(j)).collect())?)
                }
                Wall::Bone { surface, segment } => match segment.map(|s| motions[s]) {
                    None => MovedWall::Rigid(surface, RigidMotion::identity()),
                    Some(Motion::Rigid(rigid)) => MovedWall::Rigid(surface, *rigid),
                    Some(Motion::Surface(motion)) => MovedWall::Deformed(motion.carry(surface)?),
                    // `Boundary::motions` rejects this for segments that nodes may touch.
                    Some(Motion::Nodes(_)) => MovedWall::Rigid(surface, RigidMotion::identity()),
                },
            });
        }
        let meet = |(c, before): (&Candidate, &Option<f64>)| {
            let edge = self.walls[c.wall].surface().mean_edge_length();
            let through = before.map_or(0.0, |gap| gap - JUMP_SHARE * edge);
            let deepest = through.min(-ROUND_SHARE * edge);
            self.meet(c, &moved[c.wall], there(c.node)).filter(|m| m.gap >= deepest)
        };
        let mut found: Vec<Option<Meeting>> =
            self.candidates.par_iter().zip(before).with_min_len(64).map(meet).collect();
        self.leave_out_passed(mesh, u, &mut found);
        Ok(found)
    }

    /// Removes the meetings of nodes deep behind tissue that lie in no tet of it: they have slid past its
    /// border, and their closest point is on its far side.
    fn leave_out_passed(&self, mesh: &TetMesh, u: &[[f64; 3]], found: &mut [Option<Meeting>]) {
        let is_deep = |c: &Candidate, meeting: &Option<Meeting>| {
            let wall = &self.walls[c.wall];
            let least = -ROUND_SHARE * wall.surface().mean_edge_length();
            matches!(wall, Wall::Tissue { .. }) && meeting.as_ref().is_some_and(|m| m.gap < least)
        };
        let deep: Vec<usize> =
            (0..found.len()).filter(|&i| is_deep(&self.candidates[i], &found[i])).collect();
        if deep.is_empty() {
            return;
        }
        let nodes: Vec<u32> = deep.iter().map(|&i| self.candidates[i].node).collect();
        for (i, is_outside) in deep.into_iter().zip(self.overlap.are_outside(mesh, u, &nodes)) {
            if is_outside {
                found[i] = None;
            }
        }
    }

    /// The position of candidate `c` at `place` relative to its surface; nothing beyond the border of the
    /// surface.
    fn meet(&self, c: &Candidate, wall: &MovedWall<'_>, place: [f64; 3]) -> Option<Meeting> {
        let (closest, mean_edge) = match wall {
            MovedWall::Rigid(surface, rigid) => {
                (rigid.closest(surface, place), surface.mean_edge_length())
            }
            MovedWall::Deformed(surface) => {
                (surface.closest_one(place), surface.mean_edge_length())
            }
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
        Some(Meeting { gap: distance - c.allowed, point: closest.point, normal, facing })
    }

    /// The planes at displacements `u` of all nodes under motions `from`, moved with the bones to motions `to`:
    /// closest points are meaningless where a bone has moved into the tissue that follows it.
    ///
    /// # Errors
    /// A triangle of the tissue that has collapsed.
    pub fn planes(
        &self,
        mesh: &TetMesh,
        u: &[[f64; 3]],
        (from, to): (&[&Motion], &[&Motion]),
        touching: &Touching,
    ) -> Result<Planes> {
        let meetings = self.meetings(mesh, u, from, &touching.gaps)?;
        let plane = |(c, meeting): (&Candidate, Option<Meeting>)| {
            let mut meeting = meeting?;
            if let Wall::Bone { segment: Some(s), .. } = &self.walls[c.wall] {
                let place = add(self.positions[c.node as usize], u[c.node as usize]);
                meeting.carry(from[*s], to[*s], place);
            }
            Some(Plane::new(c.node, &meeting, u))
        };
        Ok(Planes { at: self.candidates.iter().zip(meetings).map(plane).collect() })
    }

    /// The round at displacements `u` of all nodes, prescribed ones at their target, with the forces of
    /// `touching`: links of `all` candidates, which only push, or of those under pressure.
    pub fn round(&self, planes: &Planes, u: &[[f64; 3]], touching: &Touching, all: bool) -> Round {
        let (mut links, mut number) = (Vec::new(), vec![None; self.candidates.len()]);
        for (i, c) in self.candidates.iter().enumerate() {
            let Some(plane) = &planes.at[i] else { continue };
            let force = touching.multipliers[i];
            if !all && force - c.stiffness * plane.at(u) <= 0.0 {
                continue;
            }
            let row = |(j, n): &(u32, [f64; 3])| (self.row_of[*j as usize], *n);
            let known: f64 = plane
                .ends
                .iter()
                .filter(|(j, _)| self.row_of[*j as usize] == NO_ROW)
                .map(|(j, n)| dot(*n, u[*j as usize]))
                .sum();
            number[i] = Some(links.len() as u32);
            links.push(Link {
                ends: plane.ends.iter().map(row).filter(|(row, _)| *row != NO_ROW).collect(),
                stiffness: c.stiffness,
                goal: force / c.stiffness - plane.offset - known,
            });
        }
        Round { number, links }
    }

    /// The residuals of `round` at displacements `rows` of the unknown nodes, given the `gap` of each plane.
    pub fn left(
        &self,
        planes: &Planes,
        round: &Round,
        rows: &[[f64; 3]],
        gap: impl Fn(&Plane) -> f64,
    ) -> Left {
        let mut left = Left { penetration: 0.0, in_bone: 0.0, gap: 0.0 };
        for (i, (c, plane)) in self.candidates.iter().zip(&planes.at).enumerate() {
            let Some(plane) = plane else { continue };
            let gap = gap(plane);
            left.penetration = left.penetration.max(-gap);
            if matches!(self.walls[c.wall], Wall::Bone { .. }) {
                left.in_bone = left.in_bone.max(-gap);
            }
            if round.force(i, rows) > 0.0 {
                left.gap = left.gap.max(gap);
            }
        }
        left
    }

    /// The `most` nodes with the largest contact forces.
    pub fn pressed(&self, touching: &Touching, most: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.candidates.len()).collect();
        let force = |i: usize| touching.multipliers[i];
        order.sort_by(|&a, &b| force(b).total_cmp(&force(a)).then(a.cmp(&b)));
        order.iter().take(most).map(|&i| self.candidates[i].node as usize).collect()
    }

    /// The nodes that touch at the end of `round`, at displacements `rows` of the unknown nodes about which
    /// `planes` are linearised.
    pub fn met(&self, planes: &Planes, round: &Round, rows: &[[f64; 3]]) -> Vec<Met> {
        let each = self.candidates.iter().zip(&planes.at).enumerate();
        each.filter_map(|(i, (c, plane))| {
            let Plane { gap, normal, .. } = plane.as_ref()?;
            let is_bone = matches!(self.walls[c.wall], Wall::Bone { .. });
            let force = round.force(i, rows);
            Some(Met { node: c.node, gap: *gap, normal: *normal, force, is_bone })
        })
        .collect()
    }
}

impl Touching {
    /// Updates the multipliers after `round` to the forces of its links at displacements `rows` of the unknown
    /// nodes.
    pub fn follow(&mut self, round: &Round, rows: &[[f64; 3]]) {
        for (i, force) in self.multipliers.iter_mut().enumerate() {
            *force = round.force(i, rows);
        }
    }
}

/// Signed distance of a point at offset `way` from its closest point; nothing beyond the border of the surface.
fn over(closest: &Closest, way: [f64; 3], mean_edge: f64) -> Option<f64> {
    if !closest.on_border {
        return Some(closest.signed_distance);
    }
    let along = dot(closest.normal, way);
    let aside = norm(sub(way, scaled(closest.normal, along)));
    (aside <= BORDER_REACH * mean_edge).then_some(along)
}
