//! `StaticSolver` for Python: options in, solutions and operators out.

use std::sync::Arc;

use mtm_core::{
    ContactMode, ContactOptions, ErrorKind, Kinematics, Method, MtmError, StaticOptions,
    StaticSolver,
};
use numpy::PyArray2;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Named};
use crate::boundary::PyBoundary;
use crate::errors::{self, Failure};
use crate::materials::PyMassTensors;
use crate::plans;
use crate::running::interruptible;
use crate::statics::{PyPlanOperator, PySolution, timings};

const BOUNDARY: ErrorKind = ErrorKind::Boundary;
const SOLVER: ErrorKind = ErrorKind::Solver;
/// Maximum number of iterations that may be requested; no tissue needs so many.
const MOST_ITERATIONS: i64 = 1_000_000_000;
/// Share of the free memory that a factorisation may take by default.
const MEMORY_SHARE: f64 = 0.8;

/// A patient's tensors and node kinds, ready for any plan; everything that does not depend on the plan is kept.
///
/// Parameters
/// ----------
/// tensors : MassTensors
/// boundary : Boundary
/// method : {"auto", "cholesky", "pcg", "relaxation"}
///     Sparse Cholesky; conjugate gradients with multigrid, stopped by an error bound; the node-wise
///     iteration of the literature; or chosen by size and memory: Cholesky up to 100 000 unknowns,
///     otherwise conjugate gradients. Choose "cholesky" for many plans of one large case.
/// contact : {"bilateral", "unilateral"}
///     Sliding nodes stay on the surface (the paper), or may lift off but never penetrate.
/// tolerance : float
///     Estimated error of the iterative methods over the largest prescribed displacement; contact converges to a
///     tenth of it if that is larger than `contact_tolerance`.
/// max_iterations : int, optional
///     Of the iterative methods.
/// contact_tolerance : float
///     Largest distance of a held node from its contact surface, mm. The tangential force remaining at any
///     node must be too small to move that node, on its own, by more than a tenth of this.
/// contact_iterations : int
///     Maximum number of Newton steps of the contact solver. If they run out above the tolerance, a state with
///     gaps and imbalance too small to be visible on a face (0.02 mm) is returned with `contact_converged` False.
/// memory_limit : float, optional
///     MB that a factorisation may take; by default 80 % of the free memory, if that is known.
/// kinematics : {"linear", "corotational", "hyperelastic"}
///     Linear strain (the paper); stretch without rotation, with the constants of the tissue; or stable
///     neo-Hookean tissue with its fibres (Smith, de Goes & Kim 2018), equal to it for small strain. The
///     latter two use Newton's method, and cannot be combined with "relaxation".
///
/// Raises
/// ------
/// BoundaryError
///     A node index past the mesh, a body that is not constrained (with its free rigid modes).
/// ContactError
///     An inverted contact surface.
/// SolverError
///     Options out of range, a factorisation that fails or does not fit in memory.
#[pyclass(frozen, module = "cmfsim", name = "StaticSolver")]
pub struct PyStaticSolver {
    core: Arc<StaticSolver>,
}

#[pymethods]
impl PyStaticSolver {
    #[expect(clippy::too_many_arguments, reason = "one for each keyword of the Python signature")]
    #[new]
    #[pyo3(
        signature = (
            tensors, boundary, method = "auto", *, contact = "bilateral", tolerance = 1e-8,
            max_iterations = None, contact_tolerance = 1e-4, contact_iterations = None,
            memory_limit = None, kinematics = "linear"
        ),
        text_signature = "(tensors, boundary, method='auto', *, contact='bilateral', tolerance=1e-08, \
                          max_iterations=None, contact_tolerance=0.0001, contact_iterations=50, \
                          memory_limit=None, kinematics='linear')"
    )]
    fn new(
        py: Python<'_>,
        tensors: &Bound<'_, PyMassTensors>,
        boundary: &Bound<'_, PyBoundary>,
        method: &str,
        contact: &str,
        tolerance: f64,
        max_iterations: Option<&Bound<'_, PyAny>>,
        contact_tolerance: f64,
        contact_iterations: Option<&Bound<'_, PyAny>>,
        memory_limit: Option<f64>,
        kinematics: &str,
    ) -> PyResult<Self> {
        let mode = match contact {
            "bilateral" => ContactMode::Bilateral,
            "unilateral" => ContactMode::Unilateral,
            found => {
                return Err(Failure(MtmError::UnknownName {
                    what: "contact",
                    found: found.into(),
                    known: "bilateral, unilateral".into(),
                    kind: ErrorKind::Solver,
                })
                .into());
            }
        };
        let memory_limit = memory_bytes(memory_limit)?;
        let count = |value: Option<&Bound<'_, PyAny>>, name| {
            value
                .map(|v| arrays::whole::<usize>(v, Named(name, SOLVER), 1..=MOST_ITERATIONS))
                .transpose()
        };
        let contact_defaults = ContactOptions::default();
        let max_iterations = count(max_iterations, "max_iterations")?;
        let contact_iterations = count(contact_iterations, "contact_iterations")?
            .unwrap_or(contact_defaults.max_iterations);
        let options = StaticOptions {
            method: Method::from_name(method).map_err(Failure)?,
            tolerance,
            max_iterations,
            contact: ContactOptions {
                mode,
                tolerance: contact_tolerance,
                max_iterations: contact_iterations,
                ..contact_defaults
            },
            memory_limit,
            kinematics: Kinematics::from_name(kinematics).map_err(Failure)?,
        };
        let (tensors, boundary) = (tensors.get().core.clone(), boundary.get().core.clone());
        let core =
            interruptible(py, move |stop| StaticSolver::new(tensors, boundary, options, stop))?;
        Ok(Self { core: Arc::new(core) })
    }

    /// Displacements under a plan; depends only on its arguments.
    ///
    /// Parameters
    /// ----------
    /// plan : dict
    ///     For every segment: (4, 4) rigid transform, (k, 3) displacements of its joined nodes in mm,
    ///     or a SurfaceMotion.
    /// loads : (n, 3) array_like, N, optional
    ///     Forces on the nodes of the mesh, or on all of `MassTensors.nodes`.
    /// start : Solution, optional
    ///     Solution of this solver for a similar plan: sliding nodes start at their positions on the segments
    ///     in it, which takes fewer steps. If there is only one equilibrium, the result is the same within the
    ///     tolerances. Large deformation always starts from rest.
    ///
    /// Returns
    /// -------
    /// Solution
    ///
    /// Raises
    /// ------
    /// BoundaryError
    ///     A plan that does not fit.
    /// ContactError
    ///     Contact that does not converge, a node that slides beyond the border of an open surface.
    /// SolverError
    ///     An iteration that does not converge.
    #[pyo3(signature = (plan, *, loads = None, start = None))]
    fn solve(
        &self,
        py: Python<'_>,
        plan: &Bound<'_, PyAny>,
        loads: Option<&Bound<'_, PyAny>>,
        start: Option<PyRef<'_, PySolution>>,
    ) -> PyResult<PySolution> {
        let plan = plans::plan(plan)?;
        let start = start.map(|start| start.whole(py)).transpose()?;
        let loads = loads.map(|l| arrays::points(l, Named("loads", BOUNDARY))).transpose()?;
        let core = self.core.clone();
        let solution = interruptible(py, move |stop| {
            core.solve_from(start.as_ref(), &plan, loads.as_deref(), stop)
        })?;
        PySolution::wrap(py, solution, self.core.tensors().mesh().n_nodes())
    }

    /// The solver of the same body that holds these of the boundary's liftable nodes, and frees all others of them.
    ///
    /// The factor is shared, so that this takes a small share of the time of a new solver; its solutions are the same
    /// to rounding.
    ///
    /// Parameters
    /// ----------
    /// nodes : (k,) array_like of int
    ///
    /// Returns
    /// -------
    /// StaticSolver
    ///
    /// Raises
    /// ------
    /// BoundaryError
    ///     A node that is not liftable.
    fn holding(&self, py: Python<'_>, nodes: &Bound<'_, PyAny>) -> PyResult<Self> {
        let nodes = arrays::nodes(nodes, Named("nodes", BOUNDARY))?;
        let core = self.core.clone();
        let core = interruptible(py, move |_| core.holding(&nodes))?;
        Ok(Self { core: Arc::new(core) })
    }

    /// Exact map from rigid plans to the displacements of `nodes` (all by default): 12 columns per segment.
    ///
    /// With sliding nodes, contact is frozen at its equilibrium under `plan` (at rest by default).
    #[pyo3(signature = (nodes = None, *, plan = None))]
    fn plan_operator(
        &self,
        py: Python<'_>,
        nodes: Option<&Bound<'_, PyAny>>,
        plan: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PyPlanOperator> {
        let nodes = nodes.map(|n| arrays::nodes(n, Named("nodes", BOUNDARY))).transpose()?;
        let plan = plan.map(plans::plan).transpose()?;
        let core = self.core.clone();
        let operator =
            interruptible(py, move |stop| core.plan_operator(nodes, plan.as_ref(), stop))?;
        Ok(PyPlanOperator { core: operator })
    }

    /// Displacements that small changes add to a solution, to first order: one linear solve for each, with
    /// contact continued to first order and the set of held sliding nodes unchanged.
    ///
    /// Parameters
    /// ----------
    /// solution : Solution
    ///     Of this solver.
    /// plan : dict
    ///     The plan that it solves.
    /// changes : sequence
    ///     Per unit of a parameter, (n, 3) array_like, N: forces on the nodes; or dict of str to (4, 4)
    ///     array_like: the change of the motion x' = R x + t of a segment, its last row zero.
    /// accuracy : float
    ///     Error that an iterative solve may leave, in the energy norm, as a share of the change; above 0, below 1.
    ///
    /// Returns
    /// -------
    /// list of (n, 3) float64, mm
    ///     Displacements of the nodes of the mesh.
    ///
    /// Raises
    /// ------
    /// BoundaryError
    ///     Loads or rates that do not fit.
    /// SolverError
    ///     Large deformation, touching pairs, a linear solve that fails.
    #[pyo3(signature = (solution, plan, changes, *, accuracy = 1e-4))]
    fn responses<'py>(
        &self,
        py: Python<'py>,
        solution: PyRef<'_, PySolution>,
        plan: &Bound<'_, PyAny>,
        changes: &Bound<'_, PyAny>,
        accuracy: f64,
    ) -> PyResult<Vec<Bound<'py, PyArray2<f64>>>> {
        let (plan, solution) = (plans::plan(plan)?, solution.whole(py)?);
        let changes = plans::changes(changes)?;
        let core = self.core.clone();
        let found = interruptible(py, move |stop| {
            core.responses((&plan, &solution), &changes, accuracy, stop)
        })?;
        let n_nodes = self.core.tensors().mesh().n_nodes();
        let corners = |mut rows: Vec<[f64; 3]>| {
            rows.truncate(n_nodes);
            arrays::rows(py, rows)
        };
        Ok(found.into_iter().map(corners).collect())
    }

    /// The method in use.
    #[getter]
    fn method(&self) -> &'static str {
        self.core.method().name()
    }

    /// The kinematics: "linear", "corotational" or "hyperelastic".
    #[getter]
    fn kinematics(&self) -> &'static str {
        self.core.kinematics().name()
    }

    /// The boundary.
    #[getter]
    fn boundary(&self) -> PyBoundary {
        PyBoundary { core: self.core.boundary().clone() }
    }

    /// The tensors.
    #[getter]
    fn tensors(&self) -> PyMassTensors {
        PyMassTensors::wrap(self.core.tensors().clone())
    }

    /// Number of unknowns: three per free or sliding node.
    #[getter]
    fn n_unknowns(&self) -> usize {
        self.core.n_unknowns()
    }

    /// Bytes of the factor or preconditioner that is kept.
    #[getter]
    fn factor_bytes(&self) -> usize {
        self.core.factor_bytes()
    }

    /// Seconds of each stage of the set-up; 0 for stages that the scene does not need.
    #[getter]
    fn timings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        timings(py, self.core.timings())
    }

    fn __repr__(&self) -> String {
        let method = self.core.method().name();
        format!("StaticSolver({} unknowns, method=\"{method}\")", self.core.n_unknowns())
    }
}

/// Free memory of the machine in bytes, if the system reports it.
fn available_memory() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find(|l| l.starts_with("MemAvailable:"))?;
    line.split_whitespace().nth(1)?.parse::<f64>().ok().map(|kb| 1024.0 * kb)
}

/// The limit of memory in bytes; without one in MB, a share of what is available.
fn memory_bytes(limit: Option<f64>) -> PyResult<Option<usize>> {
    match limit {
        Some(mb) if mb.is_finite() && mb > 0.0 => Ok(Some((mb * 1e6) as usize)),
        Some(value) => {
            let problem = format!("memory_limit is {value}: allowed is a positive number of MB");
            Err(errors::input(ErrorKind::Solver, problem))
        }
        None => Ok(available_memory().map(|bytes| (MEMORY_SHARE * bytes) as usize)),
    }
}
