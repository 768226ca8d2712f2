//! Vertex and edge tensors of the mass-tensor model, in block rows: built once per patient and used for every
//! plan. Internal force = K u.

use std::sync::Arc;

use rayon::prelude::*;

use crate::algebra::blocks::{Block, BlockMatrix, running_sum};
use crate::error::{ErrorKind, Result, check_displacements};
use crate::mechanics::element::{Element, ElementNodes};
use crate::mechanics::material::{Lame, Spencer, Voigt};
use crate::mechanics::nodal_pressure::{Patches, split};
use crate::mechanics::quadratic::quadratic_tensor;
use crate::mechanics::tissue::{TetMaterial, Tissue};
use crate::mesh::{TetGeometry, TetMesh};
use crate::vector::dot;

/// Nodes per parallel assembly task.
const NODES_PER_TASK: usize = 256;

/// Tensors K_jj and K_jk of a mesh with its tissue (Cotin et al. 2000; Picinbono et al. 2003; Mollemans
/// et al. 2007): the linear finite-element stiffness exactly, N/mm.
#[derive(Debug, Clone)]
pub struct MassTensors {
    nodes: ElementNodes,
    tissue: Arc<Tissue>,
    /// Where volumetric strain is averaged.
    patches: Option<Patches>,
    matrix: BlockMatrix,
}

/// Edges (j < k) with their tensors K_jk; K_kj is the transpose.
#[derive(Debug, Clone)]
pub struct EdgeTensors {
    /// Node pairs, j < k, ascending.
    pub edges: Vec<[u32; 2]>,
    /// K_jk of each pair, N/mm.
    pub tensors: Vec<Block>,
}

impl MassTensors {
    /// The tensors of `mesh` filled with `tissue`, on linear tets.
    ///
    /// Each row sums its tets in ascending order, so the result is bitwise identical for any number of threads,
    /// and K_kj is bitwise the transpose of K_jk.
    ///
    /// # Errors
    /// A tissue whose number of rows differs from the number of tets.
    pub fn new(mesh: Arc<TetMesh>, tissue: Arc<Tissue>) -> Result<Self> {
        Self::with_element(mesh, tissue, Element::Linear)
    }

    /// The tensors of `mesh` filled with `tissue`, on the tets of `element`.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn with_element(mesh: Arc<TetMesh>, tissue: Arc<Tissue>, element: Element) -> Result<Self> {
        let rows = tissue.n_rows();
        if rows != 1 && rows != mesh.n_tets() {
            let why = "one row for all tets, or one per tet of the mesh";
            return Err(ErrorKind::Material.length("tissue", rows, mesh.n_tets(), why));
        }
        let patches = (element == Element::NodalPressure).then(|| Patches::new(&mesh, &tissue));
        let nodes = ElementNodes::new(element, mesh);
        let mut matrix = pattern(&nodes, patches.as_ref());
        matrix.fill_rows(|j, columns, blocks| assemble_row(&nodes, &tissue, j, columns, blocks));
        if let Some(patches) = &patches {
            let gradients = patches.gradients(nodes.mesh(), |_| nalgebra::Matrix3::identity());
            patches.add_to(nodes.mesh(), &gradients, &mut matrix);
        }
        Ok(Self { nodes, tissue, patches, matrix })
    }

    /// The mesh.
    pub fn mesh(&self) -> &Arc<TetMesh> {
        self.nodes.mesh()
    }

    /// The tissue.
    pub fn tissue(&self) -> &Arc<Tissue> {
        &self.tissue
    }

    /// The element.
    pub fn element(&self) -> Element {
        self.nodes.element()
    }

    /// The nodes that carry unknowns: the corners of the mesh, then the middles of its edges if quadratic.
    pub fn element_nodes(&self) -> &ElementNodes {
        &self.nodes
    }

    pub(crate) fn patches(&self) -> Option<&Patches> {
        self.patches.as_ref()
    }

    /// K in block rows, both triangles, N/mm.
    pub fn matrix(&self) -> &BlockMatrix {
        &self.matrix
    }

    /// Vertex tensors K_jj = −Σ_k K_jk, N/mm.
    pub fn vertex_tensors(&self) -> Vec<Block> {
        (0..self.matrix.n_rows()).map(|j| *self.matrix.diagonal_block(j)).collect()
    }

    /// Edge tensors, each edge once.
    pub fn edge_tensors(&self) -> EdgeTensors {
        let mut out = EdgeTensors { edges: Vec::new(), tensors: Vec::new() };
        for j in 0..self.matrix.n_rows() {
            let (columns, blocks) = self.matrix.row(j);
            for (&k, block) in columns.iter().zip(blocks).filter(|(k, _)| **k as usize > j) {
                out.edges.push([j as u32, k]);
                out.tensors.push(*block);
            }
        }
        out
    }

    /// Internal force f_j = K_jj u_j + Σ_k K_jk u_k (Kim et al. 2010, eq. 1), N, for displacements in mm.
    pub fn internal_force(&self, displacements: &[[f64; 3]]) -> Result<Vec<[f64; 3]>> {
        self.check_displacements(displacements)?;
        Ok(self.matrix.multiply(displacements))
    }

    /// Elastic energy ½ uᵀ K u, N mm.
    pub fn energy(&self, displacements: &[[f64; 3]]) -> Result<f64> {
        if self.element() != Element::Linear {
            let forces = self.internal_force(displacements)?;
            return Ok(
                0.5 * displacements.iter().zip(&forces).map(|(&u, &f)| dot(u, f)).sum::<f64>()
            );
        }
        let strain = self.strain(displacements)?;
        let stress = self.stress(displacements)?;
        let volumes = self.mesh().volumes();
        Ok((0..strain.len())
            .map(|t| {
                let work: f64 = (0..6).map(|i| strain[t][i] * stress[t][i]).sum();
                0.5 * volumes[t] * work
            })
            .sum())
    }

    /// Linear strain of each tet (its mean if it varies), Voigt with engineering shears.
    pub fn strain(&self, displacements: &[[f64; 3]]) -> Result<Vec<[f64; 6]>> {
        self.check_displacements(displacements)?;
        Ok((0..self.mesh().n_tets())
            .into_par_iter()
            .map(|t| {
                let h = displacement_gradient(&self.nodes, t, displacements);
                [h[0][0], h[1][1], h[2][2], h[1][2] + h[2][1], h[0][2] + h[2][0], h[0][1] + h[1][0]]
            })
            .collect())
    }

    /// Stress C ε of each tet (its mean if it varies), with averaged pressure if the element uses it; Voigt,
    /// MPa.
    pub fn stress(&self, displacements: &[[f64; 3]]) -> Result<Vec<[f64; 6]>> {
        let mut rows = self.strain(displacements)?;
        let averages = self.patches.as_ref().map(|patches| {
            let volumetric: Vec<f64> = rows.iter().map(|e| e[0] + e[1] + e[2]).collect();
            patches.averages(self.mesh(), &volumetric)
        });
        rows.par_iter_mut().enumerate().for_each(|(t, row)| {
            let material = self.tissue.of_tet(t);
            let c = match &averages {
                Some(_) => split(&material, &mut Voigt::default()).1.voigt(),
                None => material.voigt(),
            };
            let strain = *row;
            *row = [0, 1, 2, 3, 4, 5].map(|i| (0..6).map(|j| c[i][j] * strain[j]).sum());
            if let (Some(patches), Some(averages)) = (&self.patches, &averages) {
                let pressure = patches.pressure(t, averages);
                for value in row.iter_mut().take(3) {
                    *value += pressure;
                }
            }
        });
        Ok(rows)
    }

    /// Relative volume change det(I + ∇u) − 1 of each tet, at its centre; −1 or less means a collapsed or
    /// inverted tet.
    pub fn volume_change(&self, displacements: &[[f64; 3]]) -> Result<Vec<f64>> {
        self.check_displacements(displacements)?;
        Ok((0..self.mesh().n_tets())
            .into_par_iter()
            .map(|t| {
                let h = displacement_gradient(&self.nodes, t, displacements);
                nalgebra::Matrix3::from_fn(|i, j| h[i][j] + f64::from(u8::from(i == j)))
                    .determinant()
                    - 1.0
            })
            .collect())
    }

    pub(crate) fn check_displacements(&self, displacements: &[[f64; 3]]) -> Result<()> {
        let kind = ErrorKind::Mesh;
        let why = "one row per node, mid-edge nodes included";
        kind.require_length("displacements", displacements.len(), self.nodes.n_nodes(), why)?;
        check_displacements("displacements", displacements, kind)
    }
}

/// Mean ∂u_i/∂x_j of tet `t`.
fn displacement_gradient(nodes: &ElementNodes, t: usize, u: &[[f64; 3]]) -> [[f64; 3]; 3] {
    let geometry = nodes.mesh().geometry(t);
    let share = 1.0 / nodes.n_points() as f64;
    let mut h = [[0.0; 3]; 3];
    for point in 0..nodes.n_points() {
        let (gradients, _) = nodes.gradients(&geometry, point);
        for (&node, g) in nodes.of_tet(t).iter().zip(&gradients) {
            let v = u[node as usize];
            for i in 0..3 {
                for j in 0..3 {
                    h[i][j] += share * (v[i] * g[j]);
                }
            }
        }
    }
    h
}

/// Block rows of the graph of nodes that share a tet or a patch, with blocks still zero.
fn pattern(nodes: &ElementNodes, patches: Option<&Patches>) -> BlockMatrix {
    let n = nodes.n_nodes();
    let (lengths, columns): (Vec<Vec<usize>>, Vec<Vec<u32>>) = (0..n.div_ceil(NODES_PER_TASK))
        .into_par_iter()
        .map(|task| {
            let (mut lengths, mut columns, mut row) = (Vec::new(), Vec::new(), Vec::new());
            for j in task * NODES_PER_TASK..n.min((task + 1) * NODES_PER_TASK) {
                row.clear();
                for &t in nodes.tets_of_node(j) {
                    row.extend_from_slice(nodes.of_tet(t as usize));
                }
                if let Some(patches) = patches {
                    patches.neighbours(nodes.mesh(), j, &mut row);
                }
                row.sort_unstable();
                row.dedup();
                lengths.push(row.len());
                columns.extend_from_slice(&row);
            }
            (lengths, columns)
        })
        .unzip();
    BlockMatrix::from_pattern(running_sum(lengths.concat()), columns.concat())
}

fn assemble_row(
    nodes: &ElementNodes,
    tissue: &Tissue,
    j: usize,
    columns: &[u32],
    blocks: &mut [Block],
) {
    for &t in nodes.tets_of_node(j) {
        let tet = nodes.of_tet(t as usize);
        let geometry = nodes.mesh().geometry(t as usize);
        let material = tissue.of_tet(t as usize);
        let mut memory = Voigt::default();
        let material = match nodes.element() {
            Element::NodalPressure => split(&material, &mut memory).1,
            Element::Linear | Element::Quadratic => material,
        };
        let corners = (nodes.element() == Element::Quadratic).then(|| {
            [0, 1, 2, 3].map(|p| [0, 1, 2, 3].map(|q| tet_tensor(&geometry, &material, p, q)))
        });
        let Some(a) = tet.iter().position(|&v| v as usize == j) else { continue };
        for (b, &k) in tet.iter().enumerate() {
            let Ok(at) = columns.binary_search(&k) else { continue };
            // Both directions of an edge are computed from the tensor of its lower node, so that they are
            // transposes in every bit.
            let transposed = k < tet[a];
            let (lo, hi) = if transposed { (b, a) } else { (a, b) };
            let tensor = match &corners {
                Some(corners) => quadratic_tensor(corners, lo, hi),
                None => tet_tensor(&geometry, &material, lo, hi),
            };
            let out = &mut blocks[at];
            for r in 0..3 {
                for c in 0..3 {
                    out[3 * r + c] +=
                        if transposed { tensor[3 * c + r] } else { tensor[3 * r + c] };
                }
            }
        }
    }
}

/// Tensor K_jk = V B_jᵀ C B_k of one tet between its vertices `j` and `k`, N/mm.
pub fn tet_tensor(geometry: &TetGeometry, material: &TetMaterial<'_>, j: usize, k: usize) -> Block {
    let (gj, gk, volume) = (geometry.gradients[j], geometry.gradients[k], geometry.volume);
    match material {
        TetMaterial::Isotropic(lame) => isotropic_tensor(gj, gk, volume, *lame),
        TetMaterial::Spencer(c, a) => spencer_tensor(gj, gk, volume, c, *a),
        TetMaterial::General(c) => general_tensor(gj, gk, volume, c),
    }
}

/// V [λ g_j⊗g_k + μ g_k⊗g_j + μ (g_j·g_k) I] (Cotin et al. 2000).
fn isotropic_tensor(gj: [f64; 3], gk: [f64; 3], volume: f64, lame: Lame) -> Block {
    let (l, m) = (volume * lame.lambda_, volume * lame.mu);
    let diagonal = m * dot(gj, gk);
    let mut out = [0.0; 9];
    for r in 0..3 {
        for c in 0..3 {
            out[3 * r + c] = l * (gj[r] * gk[c]) + m * (gk[r] * gj[c]);
        }
        out[4 * r] += diagonal;
    }
    out
}

/// The isotropic part with μ_T, and with s_j = a·g_j, d = μ_L − μ_T:
/// V { α [s_k g_j⊗a + s_j a⊗g_k] + d [s_j s_k I + s_j g_k⊗a + s_k a⊗g_j + (g_j·g_k) a⊗a] + β s_j s_k a⊗a }.
fn spencer_tensor(gj: [f64; 3], gk: [f64; 3], volume: f64, c: &Spencer, a: [f64; 3]) -> Block {
    let lame = Lame { lambda_: c.lambda_, mu: c.mu_across };
    let mut out = isotropic_tensor(gj, gk, volume, lame);
    let (sj, sk) = (dot(a, gj), dot(a, gk));
    let (alpha, d) = (volume * c.alpha, volume * c.mu_difference);
    let along = volume * c.beta * (sj * sk) + d * dot(gj, gk);
    for r in 0..3 {
        for q in 0..3 {
            out[3 * r + q] += alpha * (sk * (gj[r] * a[q]) + sj * (a[r] * gk[q]))
                + d * (sj * (gk[r] * a[q]) + sk * (a[r] * gj[q]))
                + along * (a[r] * a[q]);
        }
        out[4 * r] += d * (sj * sk);
    }
    out
}

/// V B_jᵀ C B_k with B in Voigt order.
fn general_tensor(gj: [f64; 3], gk: [f64; 3], volume: f64, c: &Voigt) -> Block {
    // Strain rows to which direction i of a vertex with gradient g contributes: (row, value).
    let strain = |g: [f64; 3]| {
        [
            [(0, g[0]), (4, g[2]), (5, g[1])],
            [(1, g[1]), (3, g[2]), (5, g[0])],
            [(2, g[2]), (3, g[1]), (4, g[0])],
        ]
    };
    let (bj, bk) = (strain(gj), strain(gk));
    let mut out = [0.0; 9];
    for r in 0..3 {
        for q in 0..3 {
            let mut sum = 0.0;
            for (row, vj) in bj[r] {
                for (col, vk) in bk[q] {
                    sum += vj * 0.5 * (c[row][col] + c[col][row]) * vk;
                }
            }
            out[3 * r + q] = volume * sum;
        }
    }
    out
}
