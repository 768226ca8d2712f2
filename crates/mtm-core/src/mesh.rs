//! Tetrahedral mesh: checks at construction, volumes, shape gradients, neighbours, boundary, quality.

use std::sync::OnceLock;

use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result, check_coordinates};
use crate::vector::{add, cross, dot, norm, scaled, sub};

/// Volume over longest edge cubed below which a tet counts as degenerate. A sliver with a smallest
/// dihedral angle of 0.1° is near 2e-4; f64 geometry keeps about three digits at this limit.
pub const DEGENERATE_RELATIVE_VOLUME: f64 = 1e-12;

/// Minimum length of the longest edge of a tet, mm: products of shorter lengths are outside the range of normal
/// numbers.
const SHORTEST_EDGE: f64 = 1e-9;

/// The four faces of a tet, outward when the tet is positively oriented.
pub(crate) const FACES: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];
/// Corners at the ends of each edge of a tet, in the order of its mid-edge nodes.
pub(crate) const TET_EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
/// The same edges with the two vertices opposite each.
const EDGES: [[usize; 4]; 6] =
    [[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2], [1, 2, 0, 3], [1, 3, 0, 2], [2, 3, 0, 1]];

/// Checked tetrahedral mesh; lengths in mm.
#[derive(Debug, Clone)]
pub struct TetMesh {
    nodes: Vec<[f64; 3]>,
    tets: Vec<[u32; 4]>,
    volumes: Vec<f64>,
    incident: Incidence,
    /// Found when first asked for: models of a patient share it.
    boundary: OnceLock<Vec<[u32; 3]>>,
}

/// Tets around each node, ascending.
#[derive(Debug, Clone)]
pub(crate) struct Incidence {
    start: Vec<u32>,
    tets: Vec<u32>,
}

/// Shape gradients and volume of one tet.
#[derive(Debug, Clone, Copy)]
pub struct TetGeometry {
    /// Gradient of each linear shape function, 1/mm.
    pub gradients: [[f64; 3]; 4],
    /// Volume, mm³.
    pub volume: f64,
}

/// Shape measures of every tet.
#[derive(Debug, Clone)]
pub struct MeshQuality {
    /// Smallest dihedral angle of each tet, radians.
    pub min_dihedral: Vec<f64>,
    /// Largest dihedral angle of each tet, radians.
    pub max_dihedral: Vec<f64>,
    /// Longest over shortest edge of each tet.
    pub edge_ratio: Vec<f64>,
}

impl TetMesh {
    /// The mesh of positively oriented tets on `nodes` (mm).
    ///
    /// # Errors
    /// Empty arrays, values that are not finite or beyond 1e6 mm, node indices out of range, tets that repeat a node,
    /// are inverted or degenerate, two tets on the same nodes, nodes that no tet uses.
    pub fn new(nodes: Vec<[f64; 3]>, tets: Vec<[u32; 4]>) -> Result<Self> {
        ErrorKind::Mesh.require_entries("nodes", nodes.len())?;
        ErrorKind::Mesh.require_entries("tets", tets.len())?;
        check_coordinates("nodes", &nodes, ErrorKind::Mesh)?;
        for (row, tet) in tets.iter().enumerate() {
            if let Some(&node) = tet.iter().find(|&&v| v as usize >= nodes.len()) {
                return Err(ErrorKind::Mesh.no_such(("tets", row), "node", node, nodes.len()));
            }
            for a in 0..3 {
                if tet[a + 1..].contains(&tet[a]) {
                    return Err(MtmError::DuplicateNode { tet: row, node: tet[a], nodes: *tet });
                }
            }
        }
        let volumes: Vec<f64> = tets.par_iter().map(|t| signed_volume(&nodes, t)).collect();
        check_volumes(&nodes, &tets, &volumes)?;
        let incident = Incidence::new(nodes.len(), &tets);
        let mut unused = (0..nodes.len()).filter(|&j| incident.of(j).is_empty());
        if let Some(node) = unused.next() {
            return Err(MtmError::UnusedNode { node, count: 1 + unused.count() });
        }
        check_duplicates(&tets, &incident)?;
        Ok(Self { nodes, tets, volumes, incident, boundary: OnceLock::new() })
    }

    /// Node positions, mm.
    pub fn nodes(&self) -> &[[f64; 3]] {
        &self.nodes
    }

    /// Node indices of each tet.
    pub fn tets(&self) -> &[[u32; 4]] {
        &self.tets
    }

    /// Volume of each tet, mm³, positive.
    pub fn volumes(&self) -> &[f64] {
        &self.volumes
    }

    /// Number of nodes.
    pub fn n_nodes(&self) -> usize {
        self.nodes.len()
    }

    /// Number of tets.
    pub fn n_tets(&self) -> usize {
        self.tets.len()
    }

    /// Tets that use node `j`, ascending.
    pub fn tets_of_node(&self, j: usize) -> &[u32] {
        self.incident.of(j)
    }

    /// Mean of the nodes, mm.
    pub fn centre(&self) -> [f64; 3] {
        let share = 1.0 / self.nodes.len() as f64;
        self.nodes.iter().fold([0.0; 3], |c, &x| add(c, scaled(x, share)))
    }

    /// Length of the diagonal of the bounding box, mm: the reference length of relative tolerances.
    pub fn diagonal(&self) -> f64 {
        let (lo, hi) = bounds(&self.nodes);
        norm(sub(hi, lo))
    }

    /// Shape gradients and volume of tet `t`.
    ///
    /// g_j is the inward normal of the face opposite j over the height of j: with edges e_k from
    /// vertex 0 and V the volume, g_1 = e_2 × e_3 / 6V and cyclic, g_0 = −(g_1 + g_2 + g_3).
    pub fn geometry(&self, t: usize) -> TetGeometry {
        let tet = &self.tets[t];
        let x0 = self.nodes[tet[0] as usize];
        let [e1, e2, e3] = [1, 2, 3].map(|k| sub(self.nodes[tet[k] as usize], x0));
        let volume = self.volumes[t];
        let scale = 1.0 / (6.0 * volume);
        let g1 = cross(e2, e3).map(|v| v * scale);
        let g2 = cross(e3, e1).map(|v| v * scale);
        let g3 = cross(e1, e2).map(|v| v * scale);
        let g0 = [0, 1, 2].map(|i| -(g1[i] + g2[i] + g3[i]));
        TetGeometry { gradients: [g0, g1, g2, g3], volume }
    }

    /// Triangles that belong to one tet only, outward, in mesh node indices, in order of their tet.
    pub fn boundary_triangles(&self) -> &[[u32; 3]] {
        self.boundary.get_or_init(|| {
            (0..self.tets.len())
                .into_par_iter()
                .flat_map_iter(|t| {
                    FACES.iter().filter_map(move |face| {
                        let tri = face.map(|v| self.tets[t][v]);
                        (self.neighbour_across(t as u32, tri).is_none()).then_some(tri)
                    })
                })
                .collect()
        })
    }

    /// Edges of the boundary triangles, each with its lower node first, ascending.
    pub(crate) fn boundary_edges(&self) -> Vec<[u32; 2]> {
        let sides = |&[a, b, c]: &[u32; 3]| [ascending(a, b), ascending(b, c), ascending(c, a)];
        let mut edges: Vec<[u32; 2]> = self.boundary_triangles().iter().flat_map(sides).collect();
        edges.par_sort_unstable();
        edges.dedup();
        edges
    }

    /// The other tet on the face `tri` of tet `t`.
    pub(crate) fn neighbour_across(&self, t: u32, tri: [u32; 3]) -> Option<u32> {
        let smallest = tri.iter().min_by_key(|&&v| self.incident.of(v as usize).len())?;
        self.incident
            .of(*smallest as usize)
            .iter()
            .copied()
            .find(|&other| other != t && tri.iter().all(|v| self.tets[other as usize].contains(v)))
    }

    /// Tets that share a face with tet `t`.
    pub(crate) fn face_neighbours(&self, t: usize) -> impl Iterator<Item = u32> + '_ {
        FACES
            .iter()
            .filter_map(move |face| self.neighbour_across(t as u32, face.map(|v| self.tets[t][v])))
    }

    /// Dihedral angles and edge ratio of every tet.
    pub fn quality(&self) -> MeshQuality {
        let rows: Vec<[f64; 3]> =
            (0..self.tets.len()).into_par_iter().map(|t| self.tet_quality(t)).collect();
        MeshQuality {
            min_dihedral: rows.iter().map(|r| r[0]).collect(),
            max_dihedral: rows.iter().map(|r| r[1]).collect(),
            edge_ratio: rows.iter().map(|r| r[2]).collect(),
        }
    }

    fn tet_quality(&self, t: usize) -> [f64; 3] {
        let x = self.tets[t].map(|v| self.nodes[v as usize]);
        let (mut lo, mut hi) = (f64::INFINITY, 0.0_f64);
        let (mut shortest, mut longest) = (f64::INFINITY, 0.0_f64);
        for [a, b, c, d] in EDGES {
            let e = sub(x[b], x[a]);
            let length = norm(e);
            shortest = shortest.min(length);
            longest = longest.max(length);
            // Angle between the two faces at the edge, from their in-plane perpendiculars.
            let n1 = cross(e, sub(x[c], x[a]));
            let n2 = cross(e, sub(x[d], x[a]));
            let angle = norm(cross(n1, n2)).atan2(dot(n1, n2));
            lo = lo.min(angle);
            hi = hi.max(angle);
        }
        [lo, hi, longest / shortest]
    }
}

impl Incidence {
    /// Of tets with `N` nodes each on `n_nodes` nodes.
    pub(crate) fn new<const N: usize>(n_nodes: usize, tets: &[[u32; N]]) -> Self {
        let mut start = vec![0_u32; n_nodes + 1];
        for &v in tets.iter().flatten() {
            start[v as usize + 1] += 1;
        }
        for j in 0..n_nodes {
            start[j + 1] += start[j];
        }
        let mut next = start.clone();
        let mut list = vec![0_u32; N * tets.len()];
        for (t, tet) in tets.iter().enumerate() {
            for &v in tet {
                list[next[v as usize] as usize] = t as u32;
                next[v as usize] += 1;
            }
        }
        Self { start, tets: list }
    }

    /// Tets around node `j`.
    pub(crate) fn of(&self, j: usize) -> &[u32] {
        &self.tets[self.start[j] as usize..self.start[j + 1] as usize]
    }
}

fn check_volumes(nodes: &[[f64; 3]], tets: &[[u32; 4]], volumes: &[f64]) -> Result<()> {
    let longest = |t: usize| {
        EDGES.iter().fold(0.0_f64, |m, e| {
            m.max(norm(sub(nodes[tets[t][e[1]] as usize], nodes[tets[t][e[0]] as usize])))
        })
    };
    let worst = (0..tets.len()).into_par_iter().find_map_first(|t| {
        let edge = longest(t);
        let limit = DEGENERATE_RELATIVE_VOLUME * edge * edge * edge;
        let bad = volumes[t].is_nan() || volumes[t] <= limit || edge < SHORTEST_EDGE;
        bad.then_some((t, edge, limit))
    });
    let Some((tet, edge, limit)) = worst else { return Ok(()) };
    if edge < SHORTEST_EDGE {
        let allowed = "1e-9 mm or more; check the units";
        return Err(ErrorKind::Mesh.out_of_range("longest edge of tets", tet, edge, allowed));
    }
    if volumes[tet] < -limit {
        let count = volumes.iter().filter(|&&v| v < 0.0).count();
        return Err(MtmError::InvertedTet { tet, volume: volumes[tet], nodes: tets[tet], count });
    }
    let (volume, limit, nodes) = (volumes[tet], DEGENERATE_RELATIVE_VOLUME, tets[tet]);
    Err(MtmError::DegenerateTet { tet, volume, edge, limit, nodes })
}

fn check_duplicates(tets: &[[u32; 4]], incident: &Incidence) -> Result<()> {
    let found = (0..tets.len()).into_par_iter().find_map_first(|t| {
        let tet = &tets[t];
        // Duplicates share every node, so only the node with the fewest tets has to be searched.
        let node = tet.iter().min_by_key(|&&v| incident.of(v as usize).len())?;
        incident
            .of(*node as usize)
            .iter()
            .find(|&&o| o as usize > t && tet.iter().all(|v| tets[o as usize].contains(v)))
            .map(|&o| (t, o as usize))
    });
    match found {
        None => Ok(()),
        Some((first, second)) => {
            let mut nodes = tets[first];
            nodes.sort_unstable();
            Err(MtmError::DuplicateTet { first, second, nodes })
        }
    }
}

/// Volume of a tet, mm³; negative if it is inverted.
pub(crate) fn signed_volume(nodes: &[[f64; 3]], tet: &[u32; 4]) -> f64 {
    sixfold_volume(tet.map(|v| nodes[v as usize])) / 6.0
}

/// Six times the volume of a tet with these corners.
pub(crate) fn sixfold_volume(x: [[f64; 3]; 4]) -> f64 {
    let [e1, e2, e3] = [1, 2, 3].map(|k| sub(x[k], x[0]));
    dot(cross(e1, e2), e3)
}

/// The edge between two nodes, whichever way it is named.
pub(crate) fn ascending(a: u32, b: u32) -> [u32; 2] {
    [a.min(b), a.max(b)]
}

/// Smallest and largest coordinate along each axis.
pub(crate) fn bounds(points: &[[f64; 3]]) -> ([f64; 3], [f64; 3]) {
    points.iter().fold(([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]), |(lo, hi), p| {
        ([0, 1, 2].map(|i| lo[i].min(p[i])), [0, 1, 2].map(|i| hi[i].max(p[i])))
    })
}
