//! Sliding contact: nodes stay on the moved surface of their bone segment and feel no force along it.
//!
//! A sliding node x keeps its distance from the moved contact surface, |x + u − c| = g with c the closest
//! point, and its force follows the continuous unit normal n there (Kim et al. 2010, section 2.5 and eq. 2:
//! forces act in the tangent plane). What the outer loop needs is here; the loop is in `settling`.

use std::sync::Arc;

use crate::boundary::{Boundary, Gap, Motion};
use crate::crease::{ContactRow, MovedSurface, Seat};
use crate::error::{MtmError, Result};
use crate::mesh::{TetMesh, add, dot, norm, scaled, sub};
use crate::surface::{Closest, Surface};

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
    /// Gap that is allowed whatever the tolerance says, and tangential force over the node's own stiffness, mm:
    /// for a state that is only a step on the way.
    pub allowed: f64,
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
            allowed: 0.0,
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
}

/// The sliding nodes of a scene with their contact surfaces at rest.
#[derive(Debug)]
pub struct Sliding {
    pub(crate) nodes: Vec<SlidingNode>,
    pub(crate) positions: Vec<[f64; 3]>,
    rest: Vec<Closest>,
    rest_normals: Vec<[f64; 3]>,
    /// Prescribed distance of each node, mm; none where it keeps its place at rest.
    gaps: Vec<Option<f64>>,
    /// Stiffness of each node by itself, N/mm.
    pub(crate) stiffness: Vec<f64>,
    surfaces: Vec<Option<Arc<Surface>>>,
    pub(crate) names: Vec<String>,
    pub(crate) diagonal: f64,
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
    /// Distance of each node from its surface at the end, out of the bone, mm.
    pub gaps: Vec<f64>,
    /// Whether the node is held to the surface.
    pub active: Vec<bool>,
    /// Outer iterations done.
    pub iterations: usize,
}

impl ContactState {
    /// Largest distance of a held node from its surface, mm.
    pub(crate) fn largest_gap(&self) -> f64 {
        let held = self.gaps.iter().zip(&self.active).filter(|(_, active)| **active);
        held.fold(0.0, |m, (gap, _)| m.max(gap.abs()))
    }
}

/// Constraints n_r·u_i = offset_r on the sliding nodes that are held.
pub struct Constraints<'a> {
    /// Node and normal of each constraint, nodes ascending.
    pub rows: &'a [ContactRow],
    /// Offset of every row, mm.
    pub offsets: &'a [f64],
    /// Springs across the normals of nodes with one row.
    pub springs: &'a [Spring],
}

/// A spring on one sliding node along an axis of its tangent plane.
#[derive(Debug, Clone, Copy)]
pub struct Spring {
    /// Index among the sliding nodes.
    pub node: usize,
    /// Unit vector.
    pub axis: [f64; 3],
    /// N/mm.
    pub stiffness: f64,
    /// Displacement along the axis at which it is slack, mm.
    pub goal: f64,
}

/// Displacements (mm) of all sliding nodes and contact forces (N) along the rows.
pub struct Response {
    /// Displacement of every sliding node.
    pub displacements: Vec<[f64; 3]>,
    /// Contact force of each of `Constraints::rows`.
    pub forces: Vec<f64>,
    /// Whether they are within the tolerance of the solver: contact cannot end before that.
    pub solved: bool,
}

impl Sliding {
    /// The sliding nodes of `boundary`, or nothing where no node slides.
    ///
    /// `places`: position of each node at rest, those in the middle of edges included. `row_of`: row of
    /// each node among the unknowns. `stiffness`: of each node by itself, N/mm.
    ///
    /// # Errors
    /// A contact surface that faces away from the tissue where that matters.
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
        let mut sliding = Self {
            nodes: Vec::new(),
            positions: Vec::new(),
            rest: Vec::new(),
            rest_normals: Vec::new(),
            gaps: Vec::new(),
            stiffness: Vec::new(),
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
                segment.sliding.iter().map(|&j| places[j as usize]).collect();
            let closest = surface.closest(&positions);
            let normals: Vec<[f64; 3]> = closest.iter().map(|c| c.normal).collect();
            check_facing(mesh, &segment.name, &segment.sliding, surface, &normals, mode)?;
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

    /// Where the sliding nodes would be if they clung to their segment, and where their surfaces lie.
    ///
    /// A node without a prescribed gap slides on the contact surface shifted to where it lies itself: by
    /// its offset at rest, carried with the segment. However far off the contact surface it lies, its
    /// own surface is as smooth; the surface at its distance may fold.
    pub(crate) fn carried(
        &self,
        motions: &[&Motion],
        surfaces: &[MovedSurface],
    ) -> (Vec<[f64; 3]>, Vec<Seat>) {
        let out = self.clinging(motions);
        let seats = (0..self.nodes.len())
            .map(|i| match self.gaps[i] {
                Some(gap) => Seat { offset: [0.0; 3], gap },
                None => {
                    let foot = surfaces[self.nodes[i].segment].carried(&self.rest[i]);
                    Seat { offset: sub(out[i], foot), gap: 0.0 }
                }
            })
            .collect();
        (out, seats)
    }

    /// Where the sliding nodes would be if they clung to their segment.
    fn clinging(&self, motions: &[&Motion]) -> Vec<[f64; 3]> {
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

    /// Largest motion of a sliding node that clings to its segment, mm.
    pub(crate) fn farthest(&self, motions: &[&Motion]) -> f64 {
        let clinging = self.clinging(motions);
        let moved = clinging.iter().zip(&self.positions).map(|(c, x)| norm(sub(*c, *x)));
        moved.fold(0.0, f64::max)
    }

    pub(crate) fn moved_surfaces(&self, motions: &[&Motion]) -> Result<Vec<MovedSurface>> {
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
    let corners = nodes.iter().filter(|&&j| (j as usize) < mesh.n_nodes()).count();
    let away: Vec<u32> = nodes
        .iter()
        .zip(normals)
        .filter(|&(&j, _)| (j as usize) < mesh.n_nodes())
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
