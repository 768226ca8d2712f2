//! Strain energy of a body under large rotation: its value, its first derivative (the internal forces) and its
//! second derivative (the tangent stiffness), on the pattern of the tensors.

mod part;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::algebra::blocks::{Block, BlockMatrix, RowTask};
use crate::algebra::simd::{Kernel, widest};
use crate::error::Result;
use crate::mechanics::density::{Density, volumetric};
use crate::mechanics::element::{ElementNodes, MOST_NODES};
use crate::mechanics::hyperelastic::Tangent;
use crate::mechanics::kinematics::Kinematics;
use crate::mechanics::material::Voigt;
use crate::mechanics::nodal_pressure::split;
use crate::mechanics::tensors::MassTensors;
use crate::vector::add;

pub use part::Part;

/// Nodes per parallel task.
const NODES_PER_TASK: usize = 256;
/// Change of any entry of F up to which a definite tangent may be kept. Such a tangent is not that of the energy
/// anyway, and after a few steps most tissue hardly moves.
pub const LAG: f64 = 1e-3;

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
    densities: Arc<[Density]>,
    memory: Arc<Memory>,
}

/// Memory that is used again: clearing new pages takes longer than computing forces.
#[derive(Debug, Default)]
struct Memory {
    /// Of the last state and matrix.
    values: Mutex<TetValues>,
    /// Of the tangents of an earlier series.
    tangents: Mutex<PointTangents>,
}

/// Values of every tet, kept for their memory only.
#[derive(Debug, Default)]
struct TetValues {
    /// Internal force on each node of each tet, N.
    forces: Vec<[f64; 3]>,
    /// Tangent stiffness, N/mm.
    matrix: Option<BlockMatrix>,
}

/// Tangents of a series of states of one body, each near the one before.
#[derive(Debug, Default)]
pub struct PointTangents {
    /// Change of any entry of F up to which a definite tangent is kept.
    lag: f64,
    /// Tangent of each quadrature point times its volume, N mm.
    values: Vec<Tangent>,
    /// F of each quadrature point at its tangent; none unless they are definite ones.
    at: Vec<Matrix3<f64>>,
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

impl PointTangents {
    /// Keeps no tangent: the energy changes.
    pub fn forget(&mut self) {
        self.at.clear();
    }
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
                    Density::new(&split(&material, &mut Voigt::default()).1, kinematics)
                } else {
                    Density::new(&material, kinematics)
                }
            })
            .collect();
        Self { tensors, kinematics, densities, memory: Arc::default() }
    }

    /// The energy of the same body without that by which hyperelastic tissue resists being squeezed flat.
    pub(crate) fn without_barrier(&self) -> Self {
        let kinematics = match self.kinematics {
            Kinematics::Hyperelastic(law) => Kinematics::Hyperelastic(law.without_barrier()),
            other => other,
        };
        let (tensors, densities) = (self.tensors.clone(), self.densities.clone());
        Self { tensors, kinematics, densities, memory: self.memory.clone() }
    }

    /// Whether that energy is not zero anywhere under displacements of all nodes, mm.
    pub(crate) fn is_at_barrier(&self, u: &[[f64; 3]]) -> bool {
        let Kinematics::Hyperelastic(law) = self.kinematics else { return false };
        (0..self.nodes().mesh().n_tets())
            .into_par_iter()
            .any(|t| self.gradients(t, u).any(|f| law.is_at_barrier(&f)))
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
        let mut own = [[0.0; 3]; MOST_NODES];
        for (own, &j) in own.iter_mut().zip(nodes.of_tet(t)) {
            *own = u[j as usize];
        }
        (0..nodes.n_points()).map(move |point| {
            let (gradients, count) = nodes.gradients(&geometry, point);
            let mut f = Matrix3::identity();
            for (u, g) in own.iter().zip(&gradients[..count]) {
                f += Vector3::from(*u) * Vector3::from(*g).transpose();
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
        let averaged = self.averaged(u);
        let n_own = nodes.of_tet(0).len();
        // Another thread's call meanwhile starts with none.
        let mut scratch = std::mem::take(&mut *locked(&self.memory.values));
        scratch.forces.resize(nodes.mesh().n_tets() * n_own, [0.0; 3]);
        let energies: Vec<f64> = scratch
            .forces
            .par_chunks_mut(n_own)
            .enumerate()
            .map(|(t, own)| {
                let pressure = averaged.as_ref().map_or(0.0, |a| a.pressures[t]);
                self.respond(t, u, pressure, own)
            })
            .collect();
        let forces = (0..nodes.n_nodes())
            .into_par_iter()
            .with_min_len(NODES_PER_TASK)
            .map(|j| {
                let mut sum = [0.0; 3];
                for &t in nodes.tets_of_node(j) {
                    let t = t as usize;
                    if let Some(a) = nodes.of_tet(t).iter().position(|&v| v as usize == j) {
                        sum = add(sum, scratch.forces[t * n_own + a]);
                    }
                }
                sum
            })
            .collect();
        *locked(&self.memory.values) = scratch;
        let energy: f64 = energies.iter().sum();
        Ok(EnergyState { energy: energy + averaged.map_or(0.0, |a| a.energy), forces })
    }

    /// Energy of tet `t`, N mm; `forces` become the internal forces on its nodes, N.
    fn respond(&self, t: usize, u: &[[f64; 3]], pressure: f64, forces: &mut [[f64; 3]]) -> f64 {
        let nodes = self.nodes();
        let (density, geometry) = (self.density(t), nodes.mesh().geometry(t));
        let weight = geometry.volume / nodes.n_points() as f64;
        let mut energy = 0.0;
        forces.fill([0.0; 3]);
        for (point, f) in self.gradients(t, u).enumerate() {
            let found = density.response(&f, self.kinematics, pressure);
            energy += found.energy;
            let stress = found.stress * weight;
            for (force, g) in forces.iter_mut().zip(nodes.gradients(&geometry, point).0) {
                *force = (Vector3::from(*force) + stress * Vector3::from(g)).into();
            }
        }
        energy * weight
    }

    /// Tangent at a quadrature point of tet `t` times its volume, N mm.
    fn tangent(&self, t: usize, f: &Matrix3<f64>, kind: TangentKind, pressure: f64) -> Tangent {
        let (density, nodes) = (self.density(t), self.nodes());
        let tangent = match kind {
            TangentKind::Definite => density.definite(f, self.kinematics, pressure),
            TangentKind::Exact => density.tangent(f, self.kinematics, pressure),
        };
        nodes.mesh().volumes()[t] / nodes.n_points() as f64 * tangent
    }

    /// Begins a series of states, in the memory of an earlier one. What it finds does not depend on other series.
    ///
    /// `lag`: the change of any entry of F up to which a definite tangent is kept.
    #[doc(hidden)]
    pub fn begin(&self, lag: f64) -> PointTangents {
        let mut tangents = std::mem::take(&mut *locked(&self.memory.tangents));
        tangents.at.clear();
        tangents.lag = lag;
        tangents
    }

    /// Ends a series, whose memory the next one uses.
    #[doc(hidden)]
    pub fn end(&self, tangents: PointTangents) {
        *locked(&self.memory.tangents) = tangents;
    }

    /// Tangent stiffness under displacements of all nodes, N/mm, on the pattern of the tensors.
    ///
    /// # Errors
    /// Displacements of the wrong number, or not finite.
    pub fn stiffness(&self, u: &[[f64; 3]], kind: TangentKind) -> Result<BlockMatrix> {
        let mut tangents = self.begin(0.0);
        let matrix = self.with_stiffness(u, kind, &mut tangents, BlockMatrix::clone);
        self.end(tangents);
        matrix
    }

    /// The result of `read` for the tangent stiffness under displacements of all nodes, the next of a series.
    #[doc(hidden)]
    pub fn with_stiffness<T>(
        &self,
        u: &[[f64; 3]],
        kind: TangentKind,
        tangents: &mut PointTangents,
        read: impl FnOnce(&BlockMatrix) -> T,
    ) -> Result<T> {
        self.tensors.check_displacements(u)?;
        let (nodes, averaged) = (self.nodes(), self.averaged(u));
        self.find_tangents(u, averaged.as_ref(), kind, tangents);
        let mut scratch = std::mem::take(&mut *locked(&self.memory.values));
        let pattern = self.tensors.matrix();
        let mut matrix = scratch.matrix.take().unwrap_or_else(|| {
            BlockMatrix::from_pattern(pattern.row_start.clone(), pattern.columns.clone())
        });
        matrix.row_tasks().into_par_iter().for_each(|task| {
            widest(Fill { nodes, tangents: &tangents.values, task });
        });
        if let (Some(patches), Some(averaged)) = (self.tensors.patches(), &averaged) {
            let gradients = patches.gradients(nodes.mesh(), |t| averaged.slopes[t]);
            patches.add_to(nodes.mesh(), &gradients, &mut matrix);
        }
        let result = read(&matrix);
        *locked(&self.memory.values) = TetValues { matrix: Some(matrix), ..scratch };
        Ok(result)
    }

    /// The `tangents` at displacements `u`. Definite ones are kept where F has hardly changed; with pressures,
    /// which change everywhere, none are.
    fn find_tangents(
        &self,
        u: &[[f64; 3]],
        averaged: Option<&Averaged>,
        kind: TangentKind,
        tangents: &mut PointTangents,
    ) {
        let n_points = self.nodes().n_points();
        let n = self.nodes().mesh().n_tets() * n_points;
        let PointTangents { values, at, lag } = tangents;
        let lag = *lag;
        values.resize(n, Tangent::zeros());
        let found = |t: usize, f: &Matrix3<f64>| {
            let pressure = averaged.map_or(0.0, |a| a.pressures[t]);
            self.tangent(t, f, kind, pressure)
        };
        if kind == TangentKind::Exact || averaged.is_some() {
            at.clear();
            values.par_chunks_mut(n_points).enumerate().for_each(|(t, own)| {
                for (out, f) in own.iter_mut().zip(self.gradients(t, u)) {
                    *out = found(t, &f);
                }
            });
            return;
        }
        // Nothing is near NaN.
        at.resize(n, Matrix3::repeat(f64::NAN));
        let own = values.par_chunks_mut(n_points).zip(at.par_chunks_mut(n_points));
        own.enumerate().for_each(|(t, (values, at))| {
            for ((out, at), f) in values.iter_mut().zip(at).zip(self.gradients(t, u)) {
                let is_near = at.iter().zip(&f).all(|(a, b)| (a - b).abs() <= lag);
                if !is_near {
                    (*out, *at) = (found(t, &f), f);
                }
            }
        });
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

fn locked<T>(memory: &Mutex<T>) -> MutexGuard<'_, T> {
    memory.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The rows of `task`: g_aᵀ H g_b of every tet around them.
struct Fill<'a> {
    nodes: &'a ElementNodes,
    /// Tangents of all quadrature points, tet by tet.
    tangents: &'a [Tangent],
    task: RowTask<'a>,
}

impl Kernel for Fill<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { nodes, tangents, task } = self;
        let n_points = nodes.n_points();
        let origin = task.start[0];
        for (offset, window) in task.start.windows(2).enumerate() {
            let row = window[0] - origin..window[1] - origin;
            let (columns, blocks) = (&task.columns[row.clone()], &mut task.blocks[row]);
            blocks.fill([0.0; 9]);
            let j = task.first + offset;
            for &t in nodes.tets_of_node(j) {
                let t = t as usize;
                let geometry = nodes.mesh().geometry(t);
                let own = nodes.of_tet(t);
                let Some(a) = own.iter().position(|&v| v as usize == j) else { continue };
                let mut at = [None; MOST_NODES];
                for (at, k) in at.iter_mut().zip(own) {
                    *at = columns.binary_search(k).ok();
                }
                for (point, tangent) in tangents[t * n_points..][..n_points].iter().enumerate() {
                    let (gradients, _) = nodes.gradients(&geometry, point);
                    let left = left_contracted(tangent, gradients[a]);
                    for (at, g) in at.iter().zip(&gradients) {
                        let Some(at) = *at else { continue };
                        add_contracted(&mut blocks[at], &left, *g);
                    }
                }
            }
        }
    }
}

/// Σ_m H_(rm)(cn) g_m: for each component n the entries (r, c), row by row.
#[inline(always)]
fn left_contracted(tangent: &Tangent, g: [f64; 3]) -> [Block; 3] {
    // H is symmetric: its columns are its rows, and contiguous.
    let columns = tangent.as_slice();
    let mut out = [[0.0; 9]; 3];
    for r in 0..3 {
        let mut sum = [0.0; 9];
        for m in 0..3 {
            let column = &columns[9 * (3 * r + m)..][..9];
            for (sum, value) in sum.iter_mut().zip(column) {
                *sum += value * g[m];
            }
        }
        for c in 0..3 {
            for n in 0..3 {
                out[n][3 * r + c] = sum[3 * c + n];
            }
        }
    }
    out
}

/// Adds Σ_n `left`_n g_n to `block`.
#[inline(always)]
fn add_contracted(block: &mut Block, left: &[Block; 3], g: [f64; 3]) {
    for (i, entry) in block.iter_mut().enumerate() {
        *entry += left[0][i] * g[0] + left[1][i] * g[1] + left[2][i] * g[2];
    }
}
