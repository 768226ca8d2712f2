//! Elements on the tets of a mesh: which nodes carry unknowns and how displacement varies between them.

use std::sync::Arc;

use rayon::prelude::*;

use crate::error::{ErrorKind, Result};
use crate::mesh::{Incidence, TET_EDGES, TetGeometry, TetMesh, ascending};
use crate::vector::{add, scaled};

/// How displacement and pressure vary in a tet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Element {
    /// Linear displacement on the corners: the mass-tensor model.
    Linear,
    /// Linear displacement, with the volumetric part averaged around each corner.
    NodalPressure,
    /// Quadratic displacement: corners and midpoints of straight edges.
    Quadratic,
}

/// Maximum number of nodes of a tet.
pub const MOST_NODES: usize = 10;

/// Barycentric coordinates of the four points of a rule that is exact to degree two, with weights V/4
/// (Hammer & Stroud 1956): (5 + 3√5)/20 at one corner, (5 − √5)/20 at the others.
const QUADRATIC_POINTS: [f64; 2] = [0.585_410_196_624_968_5, 0.138_196_601_125_010_5];

impl Element {
    /// Every element.
    pub const ALL: [Self; 3] = [Self::Linear, Self::NodalPressure, Self::Quadratic];

    /// The element called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        ErrorKind::Mesh.named("element", name, Self::ALL.map(|element| (element.name(), element)))
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Linear => "p1",
            Self::NodalPressure => "anp",
            Self::Quadratic => "p2",
        }
    }
}

/// The nodes of an element on a mesh: the corners first, as the mesh numbers them, then the midpoint of each
/// edge if the element is quadratic.
#[derive(Debug, Clone)]
pub struct ElementNodes {
    element: Element,
    mesh: Arc<TetMesh>,
    middles: Option<Middles>,
}

/// Mid-edge nodes of a quadratic element.
#[derive(Debug, Clone)]
struct Middles {
    /// Corners at the ends of each edge, lower first, ascending.
    edges: Vec<[u32; 2]>,
    /// Corners and mid-edge nodes of each tet.
    tets: Vec<[u32; MOST_NODES]>,
    incident: Incidence,
    positions: Vec<[f64; 3]>,
}

/// Gradients of the shape functions of a tet at one point, one for each of its nodes.
pub type Gradients = ([[f64; 3]; MOST_NODES], usize);

impl ElementNodes {
    /// The nodes of `element` on `mesh`.
    pub fn new(element: Element, mesh: Arc<TetMesh>) -> Self {
        let middles = (element == Element::Quadratic).then(|| Middles::new(&mesh));
        Self { element, mesh, middles }
    }

    /// The element.
    pub fn element(&self) -> Element {
        self.element
    }

    /// The mesh.
    pub fn mesh(&self) -> &Arc<TetMesh> {
        &self.mesh
    }

    /// Positions of all nodes at rest, mm.
    pub fn positions(&self) -> &[[f64; 3]] {
        self.middles.as_ref().map_or(self.mesh.nodes(), |m| &m.positions)
    }

    /// Number of nodes, mid-edge nodes included.
    pub fn n_nodes(&self) -> usize {
        self.positions().len()
    }

    /// Corners at the ends of each mid-edge node's edge; its node i has number `n_corners + i`.
    pub fn mid_edges(&self) -> &[[u32; 2]] {
        self.middles.as_ref().map_or(&[], |m| &m.edges)
    }

    /// Nodes of tet `t`, corners first.
    pub fn of_tet(&self, t: usize) -> &[u32] {
        self.middles.as_ref().map_or(&self.mesh.tets()[t][..], |m| &m.tets[t][..])
    }

    /// Tets that use node `j`, ascending.
    pub fn tets_of_node(&self, j: usize) -> &[u32] {
        self.middles.as_ref().map_or_else(|| self.mesh.tets_of_node(j), |m| m.incident.of(j))
    }

    /// Number of quadrature points of a tet, each with the same share of its volume.
    pub fn n_points(&self) -> usize {
        if self.middles.is_some() { 4 } else { 1 }
    }

    /// Shape gradients at quadrature point `point` of a tet with the corner gradients of `geometry`, 1/mm.
    ///
    /// Linear: g_i. Quadratic, with barycentric coordinates λ: (4λ_i − 1) g_i at corners and 4 (λ_i g_j + λ_j
    /// g_i) at the midpoint of edge ij.
    pub fn gradients(&self, geometry: &TetGeometry, point: usize) -> Gradients {
        let g = geometry.gradients;
        let mut out = [[0.0; 3]; MOST_NODES];
        if self.middles.is_none() {
            out[..4].copy_from_slice(&g);
            return (out, 4);
        }
        let [near, far] = QUADRATIC_POINTS;
        let at = |i: usize| if i == point { near } else { far };
        for i in 0..4 {
            out[i] = scaled(g[i], 4.0 * at(i) - 1.0);
        }
        for (e, [i, j]) in TET_EDGES.into_iter().enumerate() {
            out[4 + e] = add(scaled(g[j], 4.0 * at(i)), scaled(g[i], 4.0 * at(j)));
        }
        (out, MOST_NODES)
    }
}

impl Middles {
    fn new(mesh: &TetMesh) -> Self {
        let mut edges: Vec<[u32; 2]> = mesh
            .tets()
            .par_iter()
            .flat_map_iter(|tet| TET_EDGES.map(|[i, j]| ascending(tet[i], tet[j])))
            .collect();
        edges.par_sort_unstable();
        edges.dedup();
        let n_corners = mesh.n_nodes();
        let tets: Vec<[u32; MOST_NODES]> = mesh
            .tets()
            .par_iter()
            .map(|tet| {
                let mut out = [0; MOST_NODES];
                out[..4].copy_from_slice(tet);
                for (e, [i, j]) in TET_EDGES.into_iter().enumerate() {
                    let edge = ascending(tet[i], tet[j]);
                    // Every edge of a tet is in the list.
                    let at = edges.partition_point(|other| *other < edge);
                    out[4 + e] = (n_corners + at) as u32;
                }
                out
            })
            .collect();
        let mut positions = mesh.nodes().to_vec();
        positions.extend(
            edges.iter().map(|&[a, b]| {
                scaled(add(mesh.nodes()[a as usize], mesh.nodes()[b as usize]), 0.5)
            }),
        );
        let incident = Incidence::new(positions.len(), &tets);
        Self { edges, tets, incident, positions }
    }
}
