//! `Solution` for Python: displacements, forces, contact, and how they were reached.

use mtm_core::{ErrorKind, Solution};
use numpy::{IntoPyArray, PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Named};
use crate::statics::timings;

/// Displacements under one plan.
#[pyclass(frozen, module = "cmfsim", name = "Solution")]
pub struct PySolution {
    core: Solution,
    n_nodes: usize,
    displacements: NodalField,
    forces: NodalField,
}

#[pymethods]
impl PySolution {
    /// Displacement of every node of the mesh, (n, 3) float64, mm, read-only.
    #[getter]
    fn displacements<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        self.displacements.corners.bind(py).clone()
    }

    /// Internal force of every node of the mesh (K u if linear), (n, 3) float64, N, read-only; zero at free
    /// nodes without loads.
    #[getter]
    fn forces<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        self.forces.corners.bind(py).clone()
    }

    /// Displacement of every node of `MassTensors.nodes`, mid-edge nodes included, (n + e, 3) float64, mm,
    /// read-only.
    #[getter]
    fn all_displacements<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        self.displacements.all.bind(py).clone()
    }

    /// Internal force of every node of `MassTensors.nodes`, (n + e, 3) float64, N, read-only.
    #[getter]
    fn all_forces<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        self.forces.all.bind(py).clone()
    }

    /// Residual force relative to the forces that the plan introduces.
    #[getter]
    fn residual(&self) -> f64 {
        self.core.residual
    }

    /// Estimate of the largest nodal error of the linear solve, mm; not a bound.
    ///
    /// For conjugate gradients it follows from the residual and the observed spectrum, confirmed on a known
    /// solution if stiff and soft tissue are mixed; for Cholesky it is a hundred times the error with which the
    /// factorisation recovered a known solution, or ten times the largest gap of contact; with large rotations
    /// it follows from the last Newton step. Rounding of the stiffness itself is not included.
    /// `benches/stability/error_estimate.rs` measures how often the estimate is too small.
    #[getter]
    fn error_estimate(&self) -> f64 {
        self.core.error_estimate
    }

    /// Iterations of the linear solver, summed over all contact iterations; 0 for Cholesky.
    #[getter]
    fn iterations(&self) -> usize {
        self.core.iterations
    }

    /// Residual (pcg) or largest step in mm (relaxation) of each iteration, (k,) float64.
    #[getter]
    fn residual_history<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.residual_history.clone().into_pyarray(py)
    }

    /// Largest distance of a held sliding node from its position on the moved surface, mm; 0 if there are none.
    #[getter]
    fn contact_gap(&self) -> f64 {
        self.core.contact_gap()
    }

    /// Outer iterations of the contact solver.
    #[getter]
    fn contact_iterations(&self) -> usize {
        self.core.contact_iterations
    }

    /// The sliding nodes, (s,) uint32, segment by segment; with "p2" including mid-edge nodes.
    #[getter]
    fn contact_nodes<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.core.contact.nodes.clone().into_pyarray(py)
    }

    /// Closest point of the moved contact surface to each sliding node, (s, 3) float64, mm.
    #[getter]
    fn contact_points<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.contact.points.clone())
    }

    /// Unit normal of the contact at each sliding node, out of the bone, (s, 3) float64.
    #[getter]
    fn contact_normals<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.contact.normals.clone())
    }

    /// Contact force along the normal, (s,) float64, N; positive pushes the tissue off the bone.
    #[getter]
    fn contact_forces<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.contact.forces.clone().into_pyarray(py)
    }

    /// Distance from the surface minus the prescribed gap, (s,) float64, mm; positive where lifted off.
    #[getter]
    fn contact_gaps<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.contact.gaps.clone().into_pyarray(py)
    }

    /// Largest distance, mm, by which the remaining tangential force would move a sliding node on its own.
    #[getter]
    fn contact_unbalanced(&self) -> f64 {
        self.core.contact.unbalanced
    }

    /// Whether gaps and forces of the sliding nodes are within the tolerance. If not, they are below 0.02 mm:
    /// too small to be visible on a face.
    #[getter]
    fn contact_converged(&self) -> bool {
        self.core.contact.converged
    }

    /// Nodes in contact with a surface of their pair, (t,) uint32, pair by pair; a node may touch several
    /// surfaces.
    #[getter]
    fn touching_nodes<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.core.touching.nodes.clone().into_pyarray(py)
    }

    /// Distance of each from its surface, minus any penetration at rest, (t,) float64, mm; negative where it
    /// penetrates.
    #[getter]
    fn touching_gaps<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.touching.gaps.clone().into_pyarray(py)
    }

    /// Unit normal of the surface at each, (t, 3) float64.
    #[getter]
    fn touching_normals<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.touching.normals.clone())
    }

    /// Force along the normal on each, (t,) float64, N; 0 where they are separated.
    #[getter]
    fn touching_forces<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.touching.forces.clone().into_pyarray(py)
    }

    /// Rounds of the method of multipliers for touching parts; 0 if nothing may touch.
    #[getter]
    fn touching_rounds(&self) -> usize {
        self.core.touching.rounds
    }

    /// Whether touching parts are in equilibrium within 0.05 mm and no node went through; False if only within
    /// 0.5 mm.
    #[getter]
    fn touching_converged(&self) -> bool {
        self.core.touching.converged || self.core.touching.rounds == 0
    }

    /// Largest depth of a node behind its surface, or inside a deformed tet of other tissue, mm.
    #[getter]
    fn penetration(&self) -> f64 {
        self.core.touching.penetration()
    }

    /// Seconds of each stage, set-up included; exactly 0 for stages that the scene does not need.
    #[getter]
    fn timings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        timings(py, &self.core.timings)
    }

    fn __repr__(&self) -> String {
        format!(
            "Solution({} nodes, residual {:.1e}, contact gap {:.1e} mm)",
            self.n_nodes,
            self.core.residual,
            self.core.contact_gap()
        )
    }
}

impl PySolution {
    pub(super) fn wrap(py: Python<'_>, mut core: Solution, n_nodes: usize) -> PyResult<Self> {
        let displacements = NodalField::new(py, std::mem::take(&mut core.displacements), n_nodes)?;
        let forces = NodalField::new(py, std::mem::take(&mut core.forces), n_nodes)?;
        Ok(Self { core, n_nodes, displacements, forces })
    }

    /// The solution, with its displacements held by Python.
    pub(super) fn whole(&self, py: Python<'_>) -> PyResult<Solution> {
        let rows = self.displacements.all.bind(py);
        let displacements = arrays::points(rows.as_any(), Named("start", ErrorKind::Boundary))?;
        Ok(Solution { displacements, ..self.core.clone() })
    }
}

/// A field on all nodes and on those of the mesh; one array if these are the same.
struct NodalField {
    all: Py<PyArray2<f64>>,
    corners: Py<PyArray2<f64>>,
}

impl NodalField {
    /// Read-only arrays of `rows` and of the first `n` of them.
    fn new(py: Python<'_>, rows: Vec<[f64; 3]>, n: usize) -> PyResult<Self> {
        let first = (rows.len() > n).then(|| rows[..n].to_vec());
        let all = arrays::frozen(arrays::rows(py, rows))?.unbind();
        let corners = match first {
            Some(first) => arrays::frozen(arrays::rows(py, first))?.unbind(),
            None => all.clone_ref(py),
        };
        Ok(Self { all, corners })
    }
}
