//! `Boundary`, `StaticSolver`, `Solution` and `PlanOperator` for Python.

use std::sync::Arc;

use mtm_core::{
    Against, Boundary, Change, Conflicts, ContactMode, ContactOptions, ErrorKind, Gap, Kinematics,
    Method, Motion, MtmError, Plan, PlanOperator, RigidMotion, Segment, Solution, StaticOptions,
    StaticSolver, Timings, TouchingPair,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};

use crate::arrays::{self, Named};
use crate::errors::{self, Failure};
use crate::geometry::{PySurface, PySurfaceMotion};
use crate::materials::PyMassTensors;
use crate::running::{attempted, interruptible};

const BOUNDARY: ErrorKind = ErrorKind::Boundary;
const SOLVER: ErrorKind = ErrorKind::Solver;
/// Maximum number of iterations that may be requested; no tissue needs so many.
const MOST_ITERATIONS: i64 = 1_000_000_000;
/// Share of the free memory that a factorisation may take by default.
const MEMORY_SHARE: f64 = 0.8;

/// Kinds of the nodes: fixed, joined to a bone segment, sliding on one; all others are free.
///
/// Parameters
/// ----------
/// fixed : (k,) array_like of int, optional
///     Nodes that do not move.
/// joined : dict of str to (k,) array_like of int, optional
///     Nodes that move with each segment.
/// sliding : dict of str to (k,) array_like of int, optional
///     Nodes that slide on the contact surface of each segment.
/// contact : dict of str to Surface, optional
///     Contact surface of each segment with sliding nodes, at rest, normals out of the bone.
/// gap : dict of str to float, (k,) array_like or "rest", optional
///     Distance that sliding nodes keep from the surface, mm, negative behind it; 0 is on the surface,
///     "rest" keeps the offset that each has at rest, moved with its segment.
/// touching : sequence of (nodes, triangles), optional
///     Nodes that may touch a part of the tissue's own boundary, and separate again: (k,) int, and (m, 3) int, the
///     nodes of boundary triangles with outward normals. They may not enter the tissue behind these; no friction.
/// obstacles : sequence of (nodes, segment, Surface), optional
///     Nodes that may touch bone without being sliding nodes of it: they may not go behind the surface, which is
///     given at rest with normals out of the bone and moves with the named segment; None for fixed bone.
/// conflicts : {"error", "resolve"}
///     A node of two kinds is an error, or fixed takes precedence over joined and joined over sliding.
///
/// Raises
/// ------
/// BoundaryError
///     A node of two kinds, a negative index, sliding nodes without a contact surface, an empty segment.
#[pyclass(frozen, module = "cmfsim", name = "Boundary")]
pub struct PyBoundary {
    pub core: Arc<Boundary>,
}

#[pymethods]
impl PyBoundary {
    #[new]
    #[pyo3(signature = (
        fixed = None, joined = None, sliding = None, contact = None, *, gap = None, touching = None,
        obstacles = None, conflicts = "error"
    ))]
    #[expect(clippy::too_many_arguments, reason = "one for each keyword of the Python signature")]
    fn new(
        fixed: Option<&Bound<'_, PyAny>>,
        joined: Option<&Bound<'_, PyAny>>,
        sliding: Option<&Bound<'_, PyAny>>,
        contact: Option<&Bound<'_, PyAny>>,
        gap: Option<&Bound<'_, PyAny>>,
        touching: Option<&Bound<'_, PyAny>>,
        obstacles: Option<&Bound<'_, PyAny>>,
        conflicts: &str,
    ) -> PyResult<Self> {
        let fixed = fixed.map_or(Ok(Vec::new()), |f| arrays::nodes(f, Named("fixed", BOUNDARY)))?;
        let mut segments: Vec<Segment> = Vec::new();
        for (name, ids) in entries(joined, "joined")? {
            let what = format!("joined[\"{name}\"]");
            let ids = arrays::nodes(&ids, Named(&what, BOUNDARY))?;
            segment(&mut segments, &name).joined = ids;
        }
        for (name, ids) in entries(sliding, "sliding")? {
            let what = format!("sliding[\"{name}\"]");
            let ids = arrays::nodes(&ids, Named(&what, BOUNDARY))?;
            segment(&mut segments, &name).sliding = ids;
        }
        for (name, surface) in entries(contact, "contact")? {
            let surface = surface.cast::<PySurface>().map_err(|_| {
                errors::input(BOUNDARY, format!("contact[\"{name}\"] must be a cmfsim.Surface"))
            })?;
            segment(&mut segments, &name).contact = Some(surface.get().core.clone());
        }
        for (name, value) in entries(gap, "gap")? {
            let gap = if let Ok(text) = value.cast::<PyString>() {
                match text.to_str()? {
                    "rest" => Gap::Rest,
                    other => {
                        let problem =
                            format!("gap[\"{name}\"] is \"{other}\": give mm or \"rest\"");
                        return Err(errors::input(BOUNDARY, problem));
                    }
                }
            } else {
                let what = format!("gap[\"{name}\"]");
                let values = arrays::values(&value, Named(&what, BOUNDARY))?;
                if values.len() == 1 { Gap::Uniform(values[0]) } else { Gap::PerNode(values) }
            };
            let Some(segment) = segments.iter_mut().find(|s| s.name == name) else {
                let problem = format!("gap[\"{name}\"]: no such segment");
                return Err(errors::input(BOUNDARY, problem));
            };
            segment.gap = gap;
        }
        let conflicts = match conflicts {
            "error" => Conflicts::Refuse,
            "resolve" => Conflicts::Resolve,
            other => {
                let problem = format!("conflicts is \"{other}\": use \"error\" or \"resolve\"");
                return Err(errors::input(BOUNDARY, problem));
            }
        };
        let mut pairs = touching_pairs(touching)?;
        pairs.extend(obstacle_pairs(obstacles)?);
        let core = Boundary::new(fixed, segments, conflicts)
            .and_then(|boundary| boundary.with_touching(pairs))
            .map_err(Failure)?;
        Ok(Self { core: Arc::new(core) })
    }

    /// Nodes that do not move, (k,) uint32.
    #[getter]
    fn fixed<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.core.fixed().to_vec().into_pyarray(py)
    }

    /// Nodes that move with each segment, dict of (k,) uint32.
    #[getter]
    fn joined<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.by_segment(py, |s| (!s.joined.is_empty()).then(|| s.joined.clone().into_pyarray(py)))
    }

    /// Nodes that slide on each segment, dict of (k,) uint32.
    #[getter]
    fn sliding<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.by_segment(py, |s| (!s.sliding.is_empty()).then(|| s.sliding.clone().into_pyarray(py)))
    }

    /// Contact surface of each segment that has one, dict of Surface.
    #[getter]
    fn contact<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        for s in self.core.segments() {
            if let Some(surface) = &s.contact {
                out.set_item(&s.name, PySurface::wrap(surface.as_ref().clone()))?;
            }
        }
        Ok(out)
    }

    /// Prescribed gap of the sliding nodes of each segment, dict of (k,) float64, mm, or "rest".
    #[getter]
    fn gap<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        for s in self.core.segments().iter().filter(|s| !s.sliding.is_empty()) {
            match &s.gap {
                Gap::Uniform(value) => {
                    out.set_item(&s.name, vec![*value; s.sliding.len()].into_pyarray(py))?;
                }
                Gap::PerNode(values) => out.set_item(&s.name, values.clone().into_pyarray(py))?,
                _ => out.set_item(&s.name, "rest")?,
            }
        }
        Ok(out)
    }

    /// Names of the segments.
    #[getter]
    fn segments(&self) -> Vec<String> {
        self.core.segments().iter().map(|s| s.name.clone()).collect()
    }

    /// Number of nodes that were given two kinds, one of which was dropped (with `conflicts="resolve"`).
    #[getter]
    fn conflicts(&self) -> usize {
        self.core.conflicts()
    }

    fn __repr__(&self) -> String {
        let parts: Vec<String> = self
            .core
            .segments()
            .iter()
            .map(|s| format!("{}: {} joined, {} sliding", s.name, s.joined.len(), s.sliding.len()))
            .collect();
        format!("Boundary({} fixed; {})", self.core.fixed().len(), parts.join("; "))
    }
}

impl PyBoundary {
    fn by_segment<'py>(
        &self,
        py: Python<'py>,
        get: impl Fn(&Segment) -> Option<Bound<'py, PyArray1<u32>>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        for s in self.core.segments() {
            if let Some(ids) = get(s) {
                out.set_item(&s.name, ids)?;
            }
        }
        Ok(out)
    }
}

/// Items of an optional dict with text keys.
fn entries<'py>(
    value: Option<&Bound<'py, PyAny>>,
    what: &str,
) -> PyResult<Vec<(String, Bound<'py, PyAny>)>> {
    let Some(value) = value else { return Ok(Vec::new()) };
    let wrong = || errors::input(BOUNDARY, format!("{what} must be a dict of segment names"));
    let dict = value.cast::<PyDict>().map_err(|_| wrong())?;
    dict.iter().map(|(k, v)| Ok((k.extract::<String>().map_err(|_| wrong())?, v))).collect()
}

/// Pairs of nodes and triangles of the tissue.
fn touching_pairs(value: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<TouchingPair>> {
    let wrong =
        || errors::input(BOUNDARY, "touching must be a sequence of (nodes, triangles)".to_owned());
    let Some(value) = value else { return Ok(Vec::new()) };
    let entries = value.try_iter().map_err(|_| wrong())?;
    let pair = |(i, entry): (usize, PyResult<Bound<'_, PyAny>>)| {
        let (nodes, triangles): (Bound<'_, PyAny>, Bound<'_, PyAny>) =
            entry?.extract().map_err(|_| wrong())?;
        let what = [format!("touching[{i}] nodes"), format!("touching[{i}] triangles")];
        Ok(TouchingPair {
            nodes: arrays::nodes(&nodes, Named(&what[0], BOUNDARY))?,
            against: Against::Tissue(arrays::triangles(&triangles, Named(&what[1], BOUNDARY))?),
        })
    };
    entries.enumerate().map(pair).collect()
}

/// Pairs of nodes and surfaces of bone.
fn obstacle_pairs(value: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<TouchingPair>> {
    let wrong = || {
        errors::input(
            BOUNDARY,
            "obstacles must be a sequence of (nodes, segment name or None, Surface)".to_owned(),
        )
    };
    let Some(value) = value else { return Ok(Vec::new()) };
    let entries = value.try_iter().map_err(|_| wrong())?;
    let pair = |(i, entry): (usize, PyResult<Bound<'_, PyAny>>)| {
        let (nodes, segment, surface): (Bound<'_, PyAny>, Option<String>, Bound<'_, PyAny>) =
            entry?.extract().map_err(|_| wrong())?;
        let surface = surface.cast::<PySurface>().map_err(|_| wrong())?.get().core.clone();
        let what = format!("obstacles[{i}] nodes");
        Ok(TouchingPair {
            nodes: arrays::nodes(&nodes, Named(&what, BOUNDARY))?,
            against: Against::Bone { surface, segment },
        })
    };
    entries.enumerate().map(pair).collect()
}

/// The segment called `name`, added if it is new.
fn segment<'a>(segments: &'a mut Vec<Segment>, name: &str) -> &'a mut Segment {
    let at = segments.iter().position(|s| s.name == name).unwrap_or_else(|| {
        segments.push(Segment {
            name: name.to_owned(),
            joined: Vec::new(),
            sliding: Vec::new(),
            contact: None,
            gap: Gap::Uniform(0.0),
        });
        segments.len() - 1
    });
    &mut segments[at]
}

/// Motions by segment: (4, 4) rigid, (k, 3) displacements of joined nodes, or a SurfaceMotion.
fn plan(value: &Bound<'_, PyAny>) -> PyResult<Plan> {
    entries(Some(value), "plan")?
        .into_iter()
        .map(|(name, motion)| {
            if let Ok(surface) = motion.cast::<PySurfaceMotion>() {
                return Ok((name, Motion::Surface(surface.get().core.clone())));
            }
            let what = format!("plan[\"{name}\"]");
            let named = Named(&what, BOUNDARY);
            if let Some(matrix) = arrays::matrix4(&motion, named)? {
                let rigid = RigidMotion::new(&name, &matrix).map_err(Failure)?;
                return Ok((name, Motion::Rigid(rigid)));
            }
            let rows = arrays::points(&motion, named).map_err(|e| {
                let problem = format!(
                    "{what} must be a (4, 4) rigid matrix, (k, 3) displacements of its joined nodes, or a \
                     SurfaceMotion ({e})"
                );
                errors::input(BOUNDARY, problem)
            })?;
            Ok((name, Motion::Nodes(rows)))
        })
        .collect()
}

/// Changes of what drives a body: forces on nodes, or rates of motions by segment.
fn changes(value: &Bound<'_, PyAny>) -> PyResult<Vec<Change>> {
    let wrong = |i: usize| {
        errors::input(
            BOUNDARY,
            format!("changes[{i}] must be (n, 3) forces, N, or a dict of rates"),
        )
    };
    let change = |(i, entry): (usize, PyResult<Bound<'_, PyAny>>)| {
        let entry = entry?;
        if !entry.is_instance_of::<PyDict>() {
            let what = format!("changes[{i}]");
            return Ok(Change::Loads(arrays::points(&entry, Named(&what, BOUNDARY))?));
        }
        let rate = |(name, matrix): (String, Bound<'_, PyAny>)| {
            let what = format!("changes[{i}][\"{name}\"]");
            let found = arrays::matrix4(&matrix, Named(&what, BOUNDARY))?;
            let [x, y, z, last] = found.ok_or_else(|| wrong(i))?;
            if last != [0.0; 4] {
                let problem = format!("{what}: the last row of a rate is zero, not {last:?}");
                return Err(errors::input(BOUNDARY, problem));
            }
            Ok((name, [x, y, z]))
        };
        let rates = entries(Some(&entry), &format!("changes[{i}]"))?.into_iter().map(rate);
        Ok(Change::Rates(rates.collect::<PyResult<_>>()?))
    };
    let listed = value.try_iter().map_err(|_| {
        errors::input(BOUNDARY, "changes must be a sequence of forces and of dicts".to_owned())
    })?;
    listed.enumerate().map(change).collect()
}

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
                    known: "bilateral, unilateral",
                    kind: ErrorKind::Solver,
                })
                .into());
            }
        };
        let memory_limit = match memory_limit {
            Some(mb) if mb.is_finite() && mb > 0.0 => Some((mb * 1e6) as usize),
            Some(value) => {
                let problem =
                    format!("memory_limit is {value}: allowed is a positive number of MB");
                return Err(errors::input(ErrorKind::Solver, problem));
            }
            None => available_memory().map(|bytes| (MEMORY_SHARE * bytes) as usize),
        };
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
        let plan = self::plan(plan)?;
        let start = start.map(|start| start.whole(py)).transpose()?;
        let loads = loads.map(|l| arrays::points(l, Named("loads", BOUNDARY))).transpose()?;
        let core = self.core.clone();
        let solution = interruptible(py, move |stop| {
            core.solve_from(start.as_ref(), &plan, loads.as_deref(), stop)
        })?;
        PySolution::wrap(py, solution, self.core.tensors().mesh().n_nodes())
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
        let plan = plan.map(self::plan).transpose()?;
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
        let (plan, solution) = (self::plan(plan)?, solution.whole(py)?);
        let changes = self::changes(changes)?;
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

/// Displacements under one plan.
#[pyclass(frozen, module = "cmfsim", name = "Solution")]
pub struct PySolution {
    core: Solution,
    n_nodes: usize,
    displacements: Field,
    forces: Field,
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
    /// `benches/error_estimate.rs` measures how often the estimate is too small.
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
    fn wrap(py: Python<'_>, mut core: Solution, n_nodes: usize) -> PyResult<Self> {
        let displacements = Field::new(py, std::mem::take(&mut core.displacements), n_nodes)?;
        let forces = Field::new(py, std::mem::take(&mut core.forces), n_nodes)?;
        Ok(Self { core, n_nodes, displacements, forces })
    }

    /// The solution, with its displacements held by Python.
    fn whole(&self, py: Python<'_>) -> PyResult<Solution> {
        let rows = self.displacements.all.bind(py);
        let displacements = arrays::points(rows.as_any(), Named("start", BOUNDARY))?;
        Ok(Solution { displacements, ..self.core.clone() })
    }
}

/// A field on all nodes and on those of the mesh; one array if these are the same.
struct Field {
    all: Py<PyArray2<f64>>,
    corners: Py<PyArray2<f64>>,
}

impl Field {
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

/// Exact map from rigid plans to displacements of chosen nodes; call it with a plan.
#[pyclass(frozen, module = "cmfsim", name = "PlanOperator")]
pub struct PyPlanOperator {
    core: PlanOperator,
}

#[pymethods]
impl PyPlanOperator {
    /// Displacements of `nodes` under a rigid plan, (k, 3) float64, mm.
    fn __call__<'py>(
        &self,
        py: Python<'py>,
        plan: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let plan = self::plan(plan)?;
        Ok(arrays::rows(py, attempted(py, || self.core.apply(&plan))?))
    }

    /// The nodes whose displacements it returns, (k,) uint32.
    #[getter]
    fn nodes<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.core.nodes().to_vec().into_pyarray(py)
    }

    /// Names of the segments, in the order of the columns.
    #[getter]
    fn segments(&self) -> Vec<String> {
        self.core.segments().to_vec()
    }

    /// Point of each segment about which its columns are defined, (segments, 3) float64, mm.
    #[getter]
    fn centres<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.centres().to_vec())
    }

    /// The columns, (3k, 12 * segments) float64: R - I row by row, then the displacement of the centre.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let shape = [3 * self.core.nodes().len(), 12 * self.core.segments().len()];
        self.core.matrix().to_vec().into_pyarray(py).reshape(shape)
    }

    fn __repr__(&self) -> String {
        format!(
            "PlanOperator({} nodes, segments {:?})",
            self.core.nodes().len(),
            self.core.segments()
        )
    }
}

fn timings<'py>(py: Python<'py>, laps: &Timings) -> PyResult<Bound<'py, PyDict>> {
    let out = PyDict::new(py);
    for (stage, seconds) in laps {
        out.set_item(stage, seconds)?;
    }
    Ok(out)
}

/// Free memory of the machine in bytes, if the system reports it.
fn available_memory() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find(|l| l.starts_with("MemAvailable:"))?;
    line.split_whitespace().nth(1)?.parse::<f64>().ok().map(|kb| 1024.0 * kb)
}
