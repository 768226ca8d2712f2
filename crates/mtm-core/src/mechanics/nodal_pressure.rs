//! Averaged nodal pressure: the volumetric strain of linear tets is averaged around each corner, so that they
//! do not lock near ν = 0.5 (Bonet & Burton 1998; for several materials Joldes, Wittek & Miller 2009).
//!
//! A stiffness is split as C = C_r + κ I⊗I with C_r positive definite. Each tet keeps C_r; κ acts on the mean
//! volumetric strain θ_a = Σ V_t θ_t / Σ V_t of the tets of one material around a corner a:
//!
//! W = Σ_t ½ V_t ε_t : C_r ε_t + Σ_a ½ w_a θ_a²,  w_a = Σ_t ¼ V_t κ_t.
//!
//! The second sum is never negative, so K is positive definite if C_r on the same mesh is. A quarter of each
//! tet belongs to each corner, so that uniform strain stores the energy of C.

use nalgebra::{Matrix3, Vector6};

use crate::algebra::blocks::{Block, BlockMatrix};
use crate::mechanics::material::{Lame, Spencer, Voigt, voigt_eigenvalues, voigt_matrix};
use crate::mechanics::tissue::{TetMaterial, Tissue};
use crate::mesh::TetMesh;
use crate::vector::{add, distinct};

/// The volumetric split of a material, κ and C − κ I⊗I, which is positive definite: κ = K_R − e/3 with K_R = 1/(I : C⁻¹ : I) its bulk modulus under pressure
/// and e the smallest eigenvalue of C; λ if the tissue is isotropic and λ ≥ 0.
///
/// K_R is the largest κ for which C − κ I⊗I has no negative eigenvalue. The direction that then has a zero
/// eigenvalue, C⁻¹ I, is not a shear: reducing κ by e/3 makes it positive. e ≤ 3 K_R, so κ ≥ 0.
///
/// `memory`: where the rest of a stiffness without structure is written.
pub(crate) fn split<'a>(
    material: &TetMaterial<'_>,
    memory: &'a mut Voigt,
) -> (f64, TetMaterial<'a>) {
    match material {
        TetMaterial::Isotropic(l) => {
            let bulk = l.lambda_.max(0.0);
            (bulk, TetMaterial::Isotropic(Lame { lambda_: l.lambda_ - bulk, mu: l.mu }))
        }
        TetMaterial::Spencer(c, a) => {
            // In the fibre frame pressure only involves C11, C12 and C22 + C23.
            let c12 = c.lambda_ + c.alpha;
            let c11 = c.lambda_ + 2.0 * (c.mu_across + c.alpha) + 4.0 * c.mu_difference + c.beta;
            let pair = 2.0 * (c.lambda_ + c.mu_across);
            let pressed = (c11 * pair - 2.0 * c12 * c12) / (pair - 4.0 * c12 + 2.0 * c11);
            let bulk = (pressed - c.eigenvalue_range().0 / 3.0).max(0.0);
            let rest = Spencer { lambda_: c.lambda_ - bulk, ..*c };
            (bulk, TetMaterial::Spencer(rest, *a))
        }
        TetMaterial::General(c) => {
            let pressure = Vector6::new(1.0, 1.0, 1.0, 0.0, 0.0, 0.0);
            // Checked for positive definiteness when the tissue was constructed.
            let pressed = nalgebra::Cholesky::new(voigt_matrix(c))
                .map_or(0.0, |l| 1.0 / pressure.dot(&l.solve(&pressure)));
            let bulk = (pressed - voigt_eigenvalues(c).0 / 3.0).max(0.0);
            *memory = **c;
            for row in memory.iter_mut().take(3) {
                for value in row.iter_mut().take(3) {
                    *value -= bulk;
                }
            }
            (bulk, TetMaterial::General(memory))
        }
    }
}

/// Class of a tet's material for averaging: the octaves of its bulk and shear stiffness. Strain is averaged
/// over tets whose stiffnesses lie in the same octaves; across a jump of stiffness, the soft side would
/// compensate for volume changes of the stiff one.
type Octaves = [i32; 2];

fn octaves(bulk: f64, rest: &TetMaterial<'_>) -> Octaves {
    let shear = match rest {
        TetMaterial::Isotropic(l) => l.mu,
        TetMaterial::Spencer(c, _) => c.mu_across,
        TetMaterial::General(c) => (c[3][3] + c[4][4] + c[5][5]) / 3.0,
    };
    [bulk, shear].map(|stiffness| stiffness.log2().floor() as i32)
}

/// Tets of one material around a corner, for every corner and material.
#[derive(Debug, Clone)]
pub(crate) struct Patches {
    /// First tet of each patch; one more entry than patches.
    start: Vec<u32>,
    tets: Vec<u32>,
    /// w_a, N/mm².
    weights: Vec<f64>,
    /// Σ V_t, mm³.
    volumes: Vec<f64>,
    /// Patches of each tet, by corner; none where κ is zero.
    of_tet: Vec<[u32; 4]>,
}

/// Means "no patch": the tet has no volumetric stiffness to average.
const NO_PATCH: u32 = u32::MAX;

/// ∂θ_a/∂u_j of one patch for each of its nodes, 1/mm, nodes ascending.
#[derive(Debug, Clone)]
pub(crate) struct PatchGradients {
    start: Vec<usize>,
    nodes: Vec<u32>,
    gradients: Vec<[f64; 3]>,
}

impl Patches {
    /// The patches of `mesh` filled with `tissue`.
    pub fn new(mesh: &TetMesh, tissue: &Tissue) -> Self {
        let n_rows = tissue.n_rows();
        let rows: Vec<(f64, Octaves)> = (0..n_rows)
            .map(|t| {
                let mut memory = Voigt::default();
                let (bulk, rest) = split(&tissue.of_tet(t), &mut memory);
                (bulk, octaves(bulk, &rest))
            })
            .collect();
        let row = |t: u32| &rows[if n_rows == 1 { 0 } else { t as usize }];
        let mut out = Self {
            start: vec![0],
            tets: Vec::new(),
            weights: Vec::new(),
            volumes: Vec::new(),
            of_tet: vec![[NO_PATCH; 4]; mesh.n_tets()],
        };
        for j in 0..mesh.n_nodes() {
            let mut star: Vec<(Octaves, u32)> = mesh
                .tets_of_node(j)
                .iter()
                .filter(|&&t| row(t).0 > 0.0)
                .map(|&t| (row(t).1, t))
                .collect();
            star.sort_unstable();
            for group in star.chunk_by(|a, b| a.0 == b.0) {
                let patch = out.weights.len() as u32;
                let (mut weight, mut volume) = (0.0, 0.0);
                for &(_, t) in group {
                    weight += 0.25 * mesh.volumes()[t as usize] * row(t).0;
                    volume += mesh.volumes()[t as usize];
                    let corner = mesh.tets()[t as usize].iter().position(|&v| v as usize == j);
                    if let Some(corner) = corner {
                        out.of_tet[t as usize][corner] = patch;
                    }
                    out.tets.push(t);
                }
                out.weights.push(weight);
                out.volumes.push(volume);
                out.start.push(out.tets.len() as u32);
            }
        }
        out
    }

    fn tets_of(&self, patch: usize) -> &[u32] {
        &self.tets[self.start[patch] as usize..self.start[patch + 1] as usize]
    }

    /// θ_a of every patch from θ_t of every tet.
    pub fn averages(&self, mesh: &TetMesh, volumetric: &[f64]) -> Vec<f64> {
        (0..self.weights.len())
            .map(|p| {
                let sum: f64 = self
                    .tets_of(p)
                    .iter()
                    .map(|&t| mesh.volumes()[t as usize] * volumetric[t as usize])
                    .sum();
                sum / self.volumes[p]
            })
            .collect()
    }

    /// Σ_a ½ w_a θ_a², N mm.
    pub fn energy(&self, averages: &[f64]) -> f64 {
        self.weights.iter().zip(averages).map(|(w, a)| 0.5 * w * a * a).sum()
    }

    /// Pressure that the averages exert on tet `t`, ∂W/∂θ_t over its volume: Σ_a w_a θ_a / V_a, MPa.
    pub fn pressure(&self, t: usize, averages: &[f64]) -> f64 {
        self.of_tet[t]
            .iter()
            .filter(|&&p| p != NO_PATCH)
            .map(|&p| {
                let p = p as usize;
                self.weights[p] * averages[p] / self.volumes[p]
            })
            .sum()
    }

    /// ∂θ_a/∂u_j = Σ_t V_t D_t g_j / V_a with D_t = ∂θ_t/∂F of each tet.
    pub fn gradients(
        &self,
        mesh: &TetMesh,
        slope: impl Fn(usize) -> Matrix3<f64>,
    ) -> PatchGradients {
        let mut out = PatchGradients { start: vec![0], nodes: Vec::new(), gradients: Vec::new() };
        let mut parts: Vec<(u32, [f64; 3])> = Vec::new();
        for p in 0..self.weights.len() {
            parts.clear();
            for &t in self.tets_of(p) {
                let t = t as usize;
                let geometry = mesh.geometry(t);
                let share = slope(t) * (geometry.volume / self.volumes[p]);
                for (&node, g) in mesh.tets()[t].iter().zip(geometry.gradients) {
                    let d = share * nalgebra::Vector3::from(g);
                    parts.push((node, d.into()));
                }
            }
            // Stable sort: parts of one node stay in the order of their tets.
            parts.sort_by_key(|part| part.0);
            for group in parts.chunk_by(|a, b| a.0 == b.0) {
                out.nodes.push(group[0].0);
                out.gradients.push(group.iter().fold([0.0; 3], |sum, part| add(sum, part.1)));
            }
            out.start.push(out.nodes.len());
        }
        out
    }

    /// Patches that contain corner `j`, ascending.
    fn round(&self, mesh: &TetMesh, j: usize) -> Vec<u32> {
        let all = mesh.tets_of_node(j).iter().flat_map(|&t| self.of_tet[t as usize]);
        distinct(all.filter(|&p| p != NO_PATCH))
    }

    /// Nodes that share a patch with corner `j`, appended to `out`.
    pub fn neighbours(&self, mesh: &TetMesh, j: usize, out: &mut Vec<u32>) {
        for p in self.round(mesh, j) {
            for &t in self.tets_of(p as usize) {
                out.extend_from_slice(&mesh.tets()[t as usize]);
            }
        }
    }

    /// Adds Σ_a w_a d_j⊗d_k to the blocks of row `j`.
    fn add_row(
        &self,
        mesh: &TetMesh,
        gradients: &PatchGradients,
        j: usize,
        columns: &[u32],
        blocks: &mut [Block],
    ) {
        for p in self.round(mesh, j) {
            let p = p as usize;
            let range = gradients.start[p]..gradients.start[p + 1];
            let (nodes, rows) = (&gradients.nodes[range.clone()], &gradients.gradients[range]);
            let Ok(own) = nodes.binary_search(&(j as u32)) else { continue };
            let dj = rows[own];
            for (k, dk) in nodes.iter().zip(rows) {
                let Ok(at) = columns.binary_search(k) else { continue };
                for r in 0..3 {
                    for c in 0..3 {
                        // The product of both gradients first: K_kj is then the transpose in every bit.
                        blocks[at][3 * r + c] += self.weights[p] * (dj[r] * dk[c]);
                    }
                }
            }
        }
    }

    /// Adds Σ_a w_a d⊗d to a matrix whose pattern contains all neighbours.
    pub fn add_to(&self, mesh: &TetMesh, gradients: &PatchGradients, matrix: &mut BlockMatrix) {
        matrix.fill_rows(|j, columns, blocks| self.add_row(mesh, gradients, j, columns, blocks));
    }
}
