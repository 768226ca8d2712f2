//! Sliding contact: nodes stay on the moved surface of their bone segment, with no force tangential to it.
//!
//! A sliding node x keeps its distance from the moved contact surface, φ(x + u) = g, and its force acts along
//! the gradient of φ (Kim et al. 2010, section 2.5 and eq. 2: no force acts in the tangent plane). The smooth
//! distance φ is in `field`, the position of each node on it in `seat`, the solver in `newton`.

pub(crate) mod field;
pub(crate) mod links;
mod newton;
pub(crate) mod overlap;
pub(crate) mod pairs;
pub(crate) mod planes;
mod seat;
mod walls;

use crate::boundary::{Boundary, Gap, Motion};
use crate::error::{MtmError, Result};
use crate::geometry::motion::RigidMotion;
use crate::geometry::surface::{Closest, Surface};
use crate::mesh::TetMesh;
use crate::vector::{add, dot, norm, scaled, sub};
use field::Field;

/// Share of sliding nodes that may face away from the contact surface before the surface counts as inverted.
const MOSTLY: f64 = 0.5;
/// Rounding error of the area vector around a node, relative to the areas summed: a shorter vector has no
/// direction.
const FACING_ROUNDING: f64 = 1e-12;
/// Distance at rest, over the diagonal of the mesh, beyond which a surface is none that nodes can slide on.
const FARTHEST: f64 = 0.25;

/// Lattice spacing of a contact field over the mean edge of the adjacent tissue: the nodes of the tissue cannot
/// follow sharper features.
const LATTICE_SHARE: f64 = 0.5;

/// Whether nodes may lift off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ContactMode {
    /// Nodes stay on the surface, under pressure or tension (the paper).
    Bilateral,
    /// Nodes may lift off but never penetrate: no contact pressure is negative in the result.
    Unilateral,
}

/// When the contact problem counts as solved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactOptions {
    /// Whether nodes may lift off.
    pub mode: ContactMode,
    /// Largest distance of a held node from its surface, mm. The tangential force remaining at any node must be
    /// too small to move that node, on its own, by more than a tenth of this.
    pub tolerance: f64,
    /// Distance that is accepted even if the tolerance is smaller, mm: for intermediate states.
    pub allowed: f64,
    /// Maximum number of Newton steps.
    pub max_iterations: usize,
}

impl Default for ContactOptions {
    fn default() -> Self {
        Self { mode: ContactMode::Bilateral, tolerance: 1e-4, allowed: 0.0, max_iterations: 50 }
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
}

/// The sliding nodes of a scene with their contact surfaces at rest.
#[derive(Debug, Default)]
pub struct Sliding {
    /// Segment by segment.
    pub(crate) nodes: Vec<SlidingNode>,
    pub(crate) positions: Vec<[f64; 3]>,
    rest: Vec<Closest>,
    /// Unit normal of the contact surface at rest for each.
    pub(crate) rest_normals: Vec<[f64; 3]>,
    /// Prescribed distance of each node, mm; none for a node that keeps its offset at rest.
    gaps: Vec<Option<f64>>,
    /// Stiffness of each node on its own, N/mm.
    pub(crate) stiffness: Vec<f64>,
    /// Distance field of the contact surface of each segment that has one.
    fields: Vec<Option<Field>>,
    pub(crate) names: Vec<String>,
    /// Diagonal of the mesh, mm.
    pub(crate) diagonal: f64,
}

/// Contact at the sliding nodes after a solve.
#[derive(Debug, Clone, Default)]
pub struct ContactResult {
    /// The sliding nodes, segment by segment.
    pub nodes: Vec<u32>,
    /// Displacement of each, mm.
    pub(crate) displacements: Vec<[f64; 3]>,
    /// Force that the bone exerts on each, N: along the normal, to within the tolerance.
    pub(crate) reactions: Vec<[f64; 3]>,
    /// Closest point of the moved contact surface, mm.
    pub points: Vec<[f64; 3]>,
    /// Unit normal along which the contact force acts, out of the bone.
    pub normals: Vec<[f64; 3]>,
    /// Contact force along the normal, N; positive pushes the tissue away from the bone.
    pub forces: Vec<f64>,
    /// Distance from the surface minus the prescribed gap, mm; for nodes that keep their offset at rest,
    /// distance from the surface shifted by that offset.
    pub gaps: Vec<f64>,
    /// Whether the node is held to the surface.
    pub active: Vec<bool>,
    /// Constraint of each held node.
    pub(crate) rows: Vec<ContactRow>,
    /// How the forces change direction as held nodes slide.
    pub(crate) springs: Vec<Spring>,
    /// Newton steps done.
    pub(crate) iterations: usize,
    /// Largest distance, mm, by which the remaining tangential force would move a sliding node on its own.
    pub unbalanced: f64,
    /// The nodes moved back with their segments to the position at rest; none if a segment is deformed.
    pub at_rest: Option<ContactStart>,
    /// Whether gaps and forces are within the tolerance. If not, they are still too small to be visible on a
    /// face.
    pub converged: bool,
}

impl ContactResult {
    /// Largest distance of a held node from its surface, mm.
    pub(crate) fn largest_gap(&self) -> f64 {
        let held = self.gaps.iter().zip(&self.active).filter(|(_, active)| **active);
        held.fold(0.0, |m, (gap, _)| m.max(gap.abs()))
    }
}

/// State of the sliding nodes that a solve starts from.
#[derive(Debug, Clone)]
pub struct ContactStart {
    /// Position of each sliding node, mm.
    pub places: Vec<[f64; 3]>,
    /// Force that the bone exerts on each, N.
    pub reactions: Vec<[f64; 3]>,
}

/// Linearised constraint of one sliding node: n·(x + u − p) = 0.
#[derive(Debug, Clone, Copy)]
pub struct ContactRow {
    /// Index among the sliding nodes.
    pub node: usize,
    /// Unit normal n.
    pub normal: [f64; 3],
    /// Point p of the surface that the node slides on, mm.
    pub point: [f64; 3],
}

/// Contact conditions linearised about a state: n_r·u_i = offset_r at the sliding nodes that are held.
pub struct Constraints<'a> {
    /// Node and normal of each constraint, nodes ascending.
    pub rows: &'a [ContactRow],
    /// Offset of every row, mm.
    pub offsets: &'a [f64],
    /// How the contact forces change direction as nodes slide, across the normals of their rows.
    pub springs: &'a [Spring],
    /// Displacements of all sliding nodes about which the conditions are linearised, mm.
    pub about: &'a [[f64; 3]],
    /// Error that the answer may have, as a share of the change that the conditions cause; 0 for an answer
    /// within the tolerance of the solver.
    pub share: f64,
    /// Error that the forces of springs of negative stiffness may have, as a share of their change.
    pub spring_share: f64,
    /// How far, mm, springs of negative stiffness may carry any node from its position in the body without
    /// them.
    pub reach: f64,
}

/// A spring on one sliding node along an axis of its tangent plane.
#[derive(Debug, Clone, Copy)]
pub struct Spring {
    /// Index among the sliding nodes.
    pub node: usize,
    /// Unit vector.
    pub axis: [f64; 3],
    /// N/mm; negative where the force drives the node further along the axis.
    pub stiffness: f64,
    /// Displacement along the axis at which the spring exerts no force, mm.
    pub goal: f64,
}

/// Response of a body to linearised contact conditions.
pub struct Response {
    /// Displacement of every sliding node, mm.
    pub displacements: Vec<[f64; 3]>,
    /// Internal force minus loads at every sliding node, N: the force that the bone has to exert.
    pub reactions: Vec<[f64; 3]>,
    /// Slope of the elastic energy along the step from the previous state to this one, at its start and at its
    /// end, N mm; none if the body does not know it.
    pub slopes: Option<(f64, f64)>,
    /// Whether the displacements are within the tolerance of the solver: contact cannot end before that.
    pub solved: bool,
    /// Whether springs would have carried nodes beyond their reach, or without limit: contact cannot end there.
    pub is_carried: bool,
}

/// An elastic body in contact, as the contact solver sees it.
pub trait Body {
    /// The response of the body to `conditions`, starting from its previous state.
    ///
    /// # Errors
    /// `NotPositiveDefinite` if the springs make the body unstable and it does not know how far to go; those of
    /// its solver.
    fn respond(&mut self, conditions: &Constraints<'_>) -> Result<Response>;

    /// Shortens the last step to `share` of its length.
    fn shorten(&mut self, share: f64);

    /// Discards the last step: the next one starts from the state about which its conditions are linearised.
    fn restart(&mut self);
}

impl Sliding {
    /// The sliding nodes of `boundary`, or nothing if no node slides.
    ///
    /// `places`: position of each node at rest, mid-edge nodes included. `row_of`: row of each node among the
    /// unknowns. `stiffness`: stiffness of each node on its own, N/mm.
    ///
    /// # Errors
    /// A contact surface that faces away from the tissue, if the side matters.
    pub fn new(
        boundary: &Boundary,
        mesh: &TetMesh,
        places: &[[f64; 3]],
        row_of: &[u32],
        stiffness: impl Fn(usize) -> f64,
        mode: ContactMode,
    ) -> Result<Option<Self>> {
        if !boundary.has_sliding() {
            return Ok(None);
        }
        let mut sliding = Self { diagonal: mesh.diagonal(), ..Self::default() };
        for (s, segment) in boundary.segments().iter().enumerate() {
            sliding.names.push(segment.name.clone());
            let (false, Some(surface)) = (segment.sliding.is_empty(), &segment.contact) else {
                sliding.fields.push(None);
                continue;
            };
            let positions: Vec<[f64; 3]> =
                segment.sliding.iter().map(|&j| places[j as usize]).collect();
            let closest = surface.closest(&positions);
            let normals: Vec<[f64; 3]> = closest.iter().map(|c| c.normal).collect();
            check_facing(mesh, &segment.name, &segment.sliding, surface, &normals, mode)?;
            let far = closest.iter().position(|c| c.distance > FARTHEST * sliding.diagonal);
            if let (Gap::Rest, Some(i)) = (&segment.gap, far) {
                let (node, away) = (segment.sliding[i], closest[i].distance);
                let problem = format!(
                    "lies {away:.1} mm from sliding node {node}, more than {FARTHEST} of the mesh's diagonal: are \
                     both in the same frame and unit? A gap in mm instead of \"rest\" pulls the nodes to it"
                );
                return Err(MtmError::ContactSurface { segment: segment.name.clone(), problem });
            }
            for (i, &node) in segment.sliding.iter().enumerate() {
                sliding.gaps.push(match &segment.gap {
                    Gap::Uniform(value) => Some(*value),
                    Gap::PerNode(values) => Some(values[i]),
                    Gap::Rest => None,
                });
                sliding.stiffness.push(stiffness(node as usize));
                let row = row_of[node as usize];
                sliding.nodes.push(SlidingNode { node, row, segment: s });
            }
            sliding.rest.extend(closest);
            sliding.rest_normals.extend(normals);
            let (origin, spacing) = lattice(mesh, &segment.sliding, &positions, surface);
            sliding.fields.push(Some(Field::new(surface.clone(), origin, spacing)));
            sliding.positions.extend(positions);
        }
        Ok(Some(sliding))
    }

    /// Positions of the sliding nodes if they were attached to their segment.
    fn clinging(&self, motions: &[&Motion]) -> Vec<[f64; 3]> {
        let mut out = self.positions.clone();
        for (s, motion) in motions.iter().enumerate() {
            let members: Vec<usize> =
                (0..self.nodes.len()).filter(|&i| self.nodes[i].segment == s).collect();
            let points: Vec<[f64; 3]> = members.iter().map(|&i| self.positions[i]).collect();
            // `Boundary::motions` rejects displacements of joined nodes for segments with sliding nodes.
            let moved = motion.displacements(&points).unwrap_or_default();
            for (i, u) in members.into_iter().zip(moved) {
                out[i] = add(self.positions[i], u);
            }
        }
        out
    }

    /// The sliding nodes of `state` under `motions`, moved back with their segments to the position at rest;
    /// none if a segment is deformed.
    pub(crate) fn carried_back(
        &self,
        motions: &[&Motion],
        state: &ContactResult,
    ) -> Option<ContactStart> {
        self.moved(motions, &self.start_of(state), |rigid, place, force| {
            (rigid.apply_inverse(place), rigid.rotate_inverse(force))
        })
    }

    /// The result of [`carried_back`](Self::carried_back), moved with the segments under other `motions`; none
    /// if a segment is deformed.
    pub(crate) fn carried(&self, motions: &[&Motion], rest: &ContactStart) -> Option<ContactStart> {
        self.moved(motions, rest, |rigid, place, force| (rigid.apply(place), rigid.rotate(force)))
    }

    /// Each position and reaction, transformed by `way` with the motion of its segment; none if a motion is not
    /// rigid.
    fn moved(
        &self,
        motions: &[&Motion],
        start: &ContactStart,
        way: impl Fn(&RigidMotion, [f64; 3], [f64; 3]) -> ([f64; 3], [f64; 3]),
    ) -> Option<ContactStart> {
        let each = self.nodes.iter().zip(start.places.iter().zip(&start.reactions));
        let moved = each.map(|(node, (&place, &force))| {
            motions[node.segment].rigid().map(|rigid| way(rigid, place, force))
        });
        let (places, reactions) = moved.collect::<Option<Vec<_>>>()?.into_iter().unzip();
        Some(ContactStart { places, reactions })
    }

    /// The positions of the sliding nodes in `state`, and the forces on them.
    pub(crate) fn start_of(&self, state: &ContactResult) -> ContactStart {
        let places = self.positions.iter().zip(&state.displacements).map(|(x, u)| add(*x, *u));
        ContactStart { places: places.collect(), reactions: state.reactions.clone() }
    }

    /// Distance of node `i` from its contact surface at rest, mm; beyond a border, from the tangent plane
    /// there.
    fn rest_distance(&self, i: usize) -> f64 {
        let rest = &self.rest[i];
        if rest.on_border {
            return dot(rest.normal, sub(self.positions[i], rest.point));
        }
        rest.signed_distance
    }

    /// Largest displacement of a sliding node that is attached to its segment, mm.
    pub(crate) fn farthest(&self, motions: &[&Motion]) -> f64 {
        let clinging = self.clinging(motions);
        let moved = clinging.iter().zip(&self.positions).map(|(c, x)| norm(sub(*c, *x)));
        moved.fold(0.0, f64::max)
    }
}

/// A point of the lattice of a contact field, and its spacing, mm.
///
/// The point moves with the nodes, so that a translated head, or its mirror image, has the same field.
fn lattice(
    mesh: &TetMesh,
    nodes: &[u32],
    positions: &[[f64; 3]],
    surface: &Surface,
) -> ([f64; 3], f64) {
    let count = positions.len() as f64;
    let centre = positions.iter().fold([0.0; 3], |c, &x| add(c, scaled(x, 1.0 / count)));
    let (mut sum, mut edges) = (0.0, 0.0);
    for &j in nodes.iter().filter(|&&j| (j as usize) < mesh.n_nodes()) {
        for &t in mesh.tets_of_node(j as usize) {
            for &k in mesh.tets()[t as usize].iter().filter(|&&k| k != j) {
                sum += norm(sub(mesh.nodes()[k as usize], mesh.nodes()[j as usize]));
                edges += 1.0;
            }
        }
    }
    let edge = if edges > 0.0 { sum / edges } else { surface.mean_edge_length() };
    (centre, LATTICE_SHARE * edge)
}

/// Rejects a contact surface that faces away from the tissue if the side matters: always if nodes may lift off,
/// and for closed surfaces turned inside out.
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
    let corners = nodes.iter().filter(|&&j| (j as usize) < mesh.n_nodes()).count();
    let away: Vec<u32> = nodes
        .iter()
        .zip(normals)
        .filter(|&(&j, _)| (j as usize) < mesh.n_nodes())
        .filter(|&(&j, &n)| {
            // Σ_t V_t ∇φ_j = ∫ φ_j dA over the boundary around j: a third of its area vector, pointing out of
            // the tissue, for any shape of the tets; zero up to rounding inside the body.
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
    if away.len() as f64 <= MOSTLY * corners as f64 {
        return Ok(());
    }
    Err(MtmError::ContactSurface {
        segment: segment.to_owned(),
        problem: format!(
            "is inverted: its normals point away from the tissue at {} of {} sliding nodes (for example \
             node {}); normals point out of the bone: reverse the order of each triangle's vertices",
            away.len(),
            corners,
            away[0]
        ),
    })
}
