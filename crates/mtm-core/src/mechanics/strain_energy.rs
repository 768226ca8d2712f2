//! Strain energy of a body under large rotation: its value, its first derivative (the internal forces) and its
//! second derivative (the tangent stiffness), on the pattern of the tensors.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::algebra::blocks::{BlockMatrix, RowTask};
use crate::error::Result;
use crate::mechanics::density::{Density, definite, volumetric};
use crate::mechanics::element::ElementNodes;
use crate::mechanics::hyperelastic::Tangent;
use crate::mechanics::kinematics::Kinematics;
use crate::mechanics::nodal_pressure::split;
use crate::mechanics::tensors::MassTensors;

/// Nodes per parallel task.
const NODES_PER_TASK: usize = 256;

/// Which tangent stiffness is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TangentKind {
    /// The second derivatives of the energy.
    Exact,
    /// Without the negative curvature of individual points: positive semi-definite, with smaller steps.
    Definite,
}

/// Energy of a body that rotates and stretches.
#[derive(Debug)]
pub struct StrainEnergy {
    tensors: Arc<MassTensors>,
    kinematics: Kinematics,
    /// Energy density of each tet, or of all of them.
    densities: Vec<Density>,
}

/// Energy and internal forces of a state.
#[derive(Debug, Clone)]
pub struct EnergyState {
    /// Strain energy, N mm.
    pub energy: f64,
    /// Internal force of every node, N.
    pub forces: Vec<[f64; 3]>,
}

/// Volumetric strain of every tet, and the pressure from its averages.
struct Averaged {
    slopes: Vec<Matrix3<f64>>,
    pressures: Vec<f64>,
    energy: f64,
}

impl StrainEnergy {
    /// The energy of the body of `tensors` under `kinematics`, which must not be linear.
    pub fn new(tensors: Arc<MassTensors>, kinematics: Kinematics) -> Self {
        let tissue = tensors.tissue();
        let densities = (0..tissue.n_rows())
            .into_par_iter()
            .map(|t| {
                let material = tissue.of_tet(t);
                if tensors.patches().is_some() {
                    Density::new(&split(&material).rest.material(), kinematics)
                } else {
                    Density::new(&material, kinematics)
                }
            })
            .collect();
        Self { tensors, kinematics, densities }
    }

    /// The kinematics.
    pub fn kinematics(&self) -> Kinematics {
        self.kinematics
    }

    fn nodes(&self) -> &ElementNodes {
        self.tensors.element_nodes()
    }

    fn density(&self, t: usize) -> &Density {
        &self.densities[if self.densities.len() == 1 { 0 } else { t }]
    }

    /// F = I + Σ_a u_a ⊗ ∇N_a of tet `t` at each quadrature point, in the order of the points.
    fn gradients(&self, t: usize, u: &[[f64; 3]]) -> impl Iterator<Item = Matrix3<f64>> {
        let nodes = self.nodes();
        let geometry = nodes.mesh().geometry(t);
        let own: Vec<Vector3<f64>> =
            nodes.of_tet(t).iter().map(|&j| u[j as usize].into()).collect();
        (0..nodes.n_points()).map(move |point| {
            let (gradients, _) = nodes.gradients(&geometry, point);
            let mut f = Matrix3::identity();
            for (u, g) in own.iter().zip(gradients) {
                f += u * Vector3::from(g).transpose();
            }
            f
        })
    }

    /// Energy and forces under displacements of all nodes, mm.
    ///
    /// # Errors
    /// Displacements of the wrong number, or not finite.
    pub fn state(&self, u: &[[f64; 3]]) -> Result<EnergyState> {
        self.tensors.check_displacements(u)?;
        let nodes = self.nodes();
        let mesh = nodes.mesh();
        let averaged = self.averaged(u);
        let share = 1.0 / nodes.n_points() as f64;
        let points: Vec<(f64, Vec<Matrix3<f64>>)> = (0..mesh.n_tets())
            .into_par_iter()
            .map(|t| {
                let pressure = averaged.as_ref().map_or(0.0, |a| a.pressures[t]);
                let (mut energy, mut stresses) = (0.0, Vec::with_capacity(nodes.n_points()));
                for f in self.gradients(t, u) {
                    let found = self.density(t).response(&f, self.kinematics, pressure);
                    energy += found.energy;
                    stresses.push(found.stress);
                }
                (energy * share * mesh.volumes()[t], stresses)
            })
            .collect();
        let forces = (0..nodes.n_nodes())
            .into_par_iter()
            .with_min_len(NODES_PER_TASK)
            .map(|j| {
                let mut sum = Vector3::zeros();
                for &t in nodes.tets_of_node(j) {
                    let t = t as usize;
                    let geometry = mesh.geometry(t);
                    let Some(a) = nodes.of_tet(t).iter().position(|&v| v as usize == j) else {
                        continue;
                    };
                    for (point, stress) in points[t].1.iter().enumerate() {
                        let g = nodes.gradients(&geometry, point).0[a];
                        sum += stress * Vector3::from(g) * (share * geometry.volume);
                    }
                }
                sum.into()
            })
            .collect();
        let energy: f64 = points.iter().map(|p| p.0).sum();
        Ok(EnergyState { energy: energy + averaged.map_or(0.0, |a| a.energy), forces })
    }

    /// Tangent stiffness under displacements of all nodes, N/mm, on the pattern of the tensors.
    ///
    /// # Errors
    /// Displacements of the wrong number, or not finite.
    pub fn stiffness(&self, u: &[[f64; 3]], kind: TangentKind) -> Result<BlockMatrix> {
        self.tensors.check_displacements(u)?;
        let nodes = self.nodes();
        let mesh = nodes.mesh();
        let averaged = self.averaged(u);
        let tangents: Vec<Vec<Tangent>> = (0..mesh.n_tets())
            .into_par_iter()
            .map(|t| {
                let pressure = averaged.as_ref().map_or(0.0, |a| a.pressures[t]);
                let weight = mesh.volumes()[t] / nodes.n_points() as f64;
                let density = self.density(t);
                self.gradients(t, u)
                    .map(|f| {
                        let tangent = density.tangent(&f, self.kinematics, pressure);
                        let kept = match kind {
                            TangentKind::Definite => definite(tangent, self.kinematics),
                            TangentKind::Exact => tangent,
                        };
                        kept * weight
                    })
                    .collect()
            })
            .collect();
        let pattern = self.tensors.matrix();
        let mut matrix =
            BlockMatrix::from_pattern(pattern.row_start.clone(), pattern.columns.clone());
        matrix.row_tasks().into_par_iter().for_each(|task| self.fill(&tangents, task));
        if let (Some(patches), Some(averaged)) = (self.tensors.patches(), &averaged) {
            let gradients = patches.gradients(mesh, |t| averaged.slopes[t]);
            patches.add_to(mesh, &gradients, &mut matrix);
        }
        Ok(matrix)
    }

    /// Adds g_aᵀ H g_b of every tet around the rows of `task`.
    fn fill(&self, tangents: &[Vec<Tangent>], task: RowTask<'_>) {
        let nodes = self.nodes();
        let origin = task.start[0];
        for (offset, window) in task.start.windows(2).enumerate() {
            let row = window[0] - origin..window[1] - origin;
            let (columns, blocks) = (&task.columns[row.clone()], &mut task.blocks[row]);
            let j = task.first + offset;
            for &t in nodes.tets_of_node(j) {
                let t = t as usize;
                let geometry = nodes.mesh().geometry(t);
                let own = nodes.of_tet(t);
                let Some(a) = own.iter().position(|&v| v as usize == j) else { continue };
                for (point, tangent) in tangents[t].iter().enumerate() {
                    let (gradients, _) = nodes.gradients(&geometry, point);
                    let left = left_contracted(tangent, gradients[a]);
                    for (&k, g) in own.iter().zip(&gradients) {
                        let Ok(at) = columns.binary_search(&k) else { continue };
                        for r in 0..3 {
                            for c in 0..3 {
                                let h = &left[r][c];
                                blocks[at][3 * r + c] += h[0] * g[0] + h[1] * g[1] + h[2] * g[2];
                            }
                        }
                    }
                }
            }
        }
    }

    fn averaged(&self, u: &[[f64; 3]]) -> Option<Averaged> {
        let patches = self.tensors.patches()?;
        let mesh = self.nodes().mesh();
        let found: Vec<_> = (0..mesh.n_tets())
            .into_par_iter()
            .map(|t| {
                let f = self.gradients(t, u).fold(Matrix3::zeros(), |sum, f| sum + f);
                volumetric(&f, self.kinematics)
            })
            .collect();
        let values: Vec<f64> = found.iter().map(|v| v.value).collect();
        let averages = patches.averages(mesh, &values);
        Some(Averaged {
            slopes: found.iter().map(|v| v.slope).collect(),
            pressures: (0..values.len()).map(|t| patches.pressure(t, &averages)).collect(),
            energy: patches.energy(&averages),
        })
    }
}

/// Σ_m H_(rm)(cn) g_m: for each pair of components (r, c) the vector over n.
fn left_contracted(tangent: &Tangent, g: [f64; 3]) -> [[[f64; 3]; 3]; 3] {
    let mut out = [[[0.0; 3]; 3]; 3];
    for r in 0..3 {
        for c in 0..3 {
            for n in 0..3 {
                out[r][c][n] = (0..3).map(|m| tangent[(3 * r + m, 3 * c + n)] * g[m]).sum();
            }
        }
    }
    out
}
