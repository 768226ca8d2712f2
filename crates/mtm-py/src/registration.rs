//! Thin-plate splines, rigid fits and iterative closest points for Python.

use std::sync::Arc;

use mtm_core::{
    ErrorKind, Fixed, Folds, IcpFit, IcpMethod, IcpOptions, PointTree, RigidFit, RigidFitOptions,
    Surface, ThinPlateSpline, icp as core_icp, rigid_fit as core_rigid_fit,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;

use crate::arrays::{self, Named};
use crate::errors::Failure;
use crate::geometry::PySurface;
use crate::running::{attempted, detached, interruptible};

const REGISTRATION: ErrorKind = ErrorKind::Registration;

/// Smooth map that takes landmarks to their targets with the least bending (thin-plate spline).
///
/// Bookstein (1989) in three dimensions: kernel U(r) = r and an affine part. Called with points
/// ((k, 3), mm) it gives their images, (k, 3) float64, mm. Affine maps are reproduced exactly.
///
/// Parameters
/// ----------
/// source, target : (n, 3) array_like, mm
///     Landmarks in the same order, at least four and not coplanar.
/// smoothing : float, mm
///     0: every source landmark is mapped to its target. λ above 0: it may miss it, by λ times
///     its weight; the spline minimises Σ |y − f(s)|² + λ/8π · bending_energy. The `smoothing` of
///     scipy's `RBFInterpolator` with kernel "linear" and degree 1.
///
/// Raises
/// ------
/// RegistrationError
///     (also `ValueError`) Sets of different length, fewer than four landmarks, all coplanar,
///     two at the same position, NaN or infinity, a negative smoothing.
///
/// Examples
/// --------
/// >>> import cmfsim
/// >>> source = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
/// >>> warp = cmfsim.ThinPlateSpline(source, [[2 * x, y, z + 5] for x, y, z in source])
/// >>> warp([[0.5, 0.5, 0.5]]).round(12).tolist()
/// [[1.0, 0.5, 5.5]]
#[pyclass(frozen, module = "cmfsim", name = "ThinPlateSpline")]
pub struct PyThinPlateSpline {
    pub core: Arc<ThinPlateSpline>,
}

#[pymethods]
impl PyThinPlateSpline {
    #[new]
    #[pyo3(signature = (source, target, smoothing = 0.0))]
    fn new(
        py: Python<'_>,
        source: &Bound<'_, PyAny>,
        target: &Bound<'_, PyAny>,
        smoothing: f64,
    ) -> PyResult<Self> {
        let source = arrays::points(source, Named("source", REGISTRATION))?;
        let target = arrays::points(target, Named("target", REGISTRATION))?;
        let core = attempted(py, || ThinPlateSpline::new(source, target, smoothing))?;
        Ok(Self { core: Arc::new(core) })
    }

    fn __call__<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let points = arrays::points(points, Named("points", REGISTRATION))?;
        let images = attempted(py, || self.core.warp(&points))?;
        Ok(arrays::rows(py, images))
    }

    /// Jacobian at each of `points` ((k, 3), mm), (k, 3, 3) float64: [i, j] is ∂f_i/∂x_j.
    ///
    /// A landmark has one-sided derivatives only: J e + w from the direction e, with w its weight.
    /// J, their mean, is returned there.
    fn jacobian<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let points = arrays::points(points, Named("points", REGISTRATION))?;
        let found = attempted(py, || self.core.jacobian(&points))?;
        let flat = found
            .into_iter()
            .map(|[a, b, c]| [a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]]);
        Ok(arrays::blocks(py, flat.collect()))
    }

    /// Where the map turns space inside out among `points` ((k, 3), mm).
    fn folds(&self, py: Python<'_>, points: &Bound<'_, PyAny>) -> PyResult<PyFolds> {
        let points = arrays::points(points, Named("points", REGISTRATION))?;
        Ok(PyFolds { core: attempted(py, || self.core.folds(&points))? })
    }

    /// Smallest determinant in the limit at each landmark, over all directions of approach.
    fn landmark_folds(&self, py: Python<'_>) -> PyResult<PyFolds> {
        Ok(PyFolds { core: detached(py, || self.core.landmark_folds())? })
    }

    /// Landmarks before the map, (n, 3) float64, mm, read-only.
    #[getter]
    fn source<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::frozen(arrays::rows(py, self.core.source().to_vec()))
    }

    /// Target landmarks, (n, 3) float64, mm, read-only.
    #[getter]
    fn target<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::frozen(arrays::rows(py, self.core.target().to_vec()))
    }

    /// Smoothing, mm.
    #[getter]
    fn smoothing(&self) -> f64 {
        self.core.smoothing()
    }

    /// Distance of each landmark's image from its target, (n,) float64, mm, read-only.
    #[getter]
    fn residuals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        arrays::frozen(self.core.residuals().to_vec().into_pyarray(py))
    }

    /// Integral of the squared second derivatives over all space, mm; 0 for an affine map.
    #[getter]
    fn bending_energy(&self) -> f64 {
        self.core.bending_energy()
    }

    /// Weight of each landmark in f(x) = A x + b + Σ w |x − s|, (n, 3) float64, read-only.
    #[getter]
    fn weights<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::frozen(arrays::rows(py, self.core.weights()))
    }

    /// Affine part x ↦ A x + b, (4, 4) float64, read-only.
    #[getter]
    fn affine<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::motion(py, &self.core.affine())
    }

    fn __repr__(&self) -> String {
        let n = self.core.source().len();
        format!("ThinPlateSpline({n} landmarks, smoothing={})", self.core.smoothing())
    }
}

/// Determinants of a map's Jacobian: zero or less where it folds.
#[pyclass(frozen, module = "cmfsim", name = "Folds")]
pub struct PyFolds {
    core: Folds,
}

#[pymethods]
impl PyFolds {
    /// Determinant at each point, (k,) float64, read-only.
    #[getter]
    fn determinants<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        arrays::frozen(self.core.determinants.clone().into_pyarray(py))
    }

    /// Number of points where the map folds.
    #[getter]
    fn count(&self) -> usize {
        self.core.count
    }

    /// Index of the point with the smallest determinant; None without points.
    #[getter]
    fn worst(&self) -> Option<usize> {
        self.core.worst
    }

    /// Smallest determinant; None without points.
    #[getter]
    fn smallest(&self) -> Option<f64> {
        self.core.smallest()
    }

    fn __repr__(&self) -> String {
        let smallest =
            self.core.smallest().map_or("no points".into(), |d| format!("smallest {d:.4}"));
        format!("Folds({} of {}, {smallest})", self.core.count, self.core.determinants.len())
    }
}

/// Rigid motion that brings paired points closest together, in the least-squares sense.
///
/// Parameters
/// ----------
/// moving, fixed : (n, 3) array_like, mm
///     Pairs in the same order, at least three and not collinear.
/// weights : (n,) array_like, optional
///     Weight of each pair, 0 or more.
/// scale : bool
///     Whether a uniform scale is fitted as well.
///
/// Returns
/// -------
/// RigidFit
///     `matrix` (4, 4), `scale`, `residuals` (n,) and weighted `rms`, mm. The rotation is never a reflection.
///
/// Raises
/// ------
/// RegistrationError
///     (also `ValueError`) Sets of different length, fewer than three pairs, collinear points,
///     several rotations that fit equally well, NaN or infinity, negative weights.
///
/// Notes
/// -----
/// Rotation from the best unit quaternion (Horn 1987), scale by Umeyama (1991, eq. 42).
///
/// Examples
/// --------
/// >>> import cmfsim
/// >>> points = [[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]]
/// >>> fit = cmfsim.rigid_fit(points, [[x + 1, y, z] for x, y, z in points])
/// >>> fit.matrix[:3, 3].round(9).tolist(), fit.rms < 1e-12
/// ([1.0, 0.0, 0.0], True)
#[pyfunction]
#[pyo3(signature = (moving, fixed, *, weights = None, scale = false))]
pub fn rigid_fit(
    py: Python<'_>,
    moving: &Bound<'_, PyAny>,
    fixed: &Bound<'_, PyAny>,
    weights: Option<&Bound<'_, PyAny>>,
    scale: bool,
) -> PyResult<PyRigidFit> {
    let moving = arrays::points(moving, Named("moving", REGISTRATION))?;
    let fixed = arrays::points(fixed, Named("fixed", REGISTRATION))?;
    let weights = match weights {
        Some(weights) => Some(arrays::values(weights, Named("weights", REGISTRATION))?),
        None => None,
    };
    let options = RigidFitOptions { weights: weights.as_deref(), scale };
    let core = attempted(py, || core_rigid_fit(&moving, &fixed, &options))?;
    Ok(PyRigidFit { core })
}

/// The best motion of paired points.
#[pyclass(frozen, module = "cmfsim", name = "RigidFit")]
pub struct PyRigidFit {
    core: RigidFit,
}

#[pymethods]
impl PyRigidFit {
    /// x ↦ s R x + t, (4, 4) float64, mm, read-only.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::motion(py, &self.core.matrix)
    }

    /// s; 1 unless a scale was requested.
    #[getter]
    fn scale(&self) -> f64 {
        self.core.scale
    }

    /// Distance of each moved point from its partner, (n,) float64, mm, read-only.
    #[getter]
    fn residuals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        arrays::frozen(self.core.residuals.clone().into_pyarray(py))
    }

    /// Root of the weighted mean of their squares, mm.
    #[getter]
    fn rms(&self) -> f64 {
        self.core.rms
    }

    fn __repr__(&self) -> String {
        format!("RigidFit(rms={:.4} mm, {} pairs)", self.core.rms, self.core.residuals.len())
    }
}

/// What moving points are aligned with.
enum AlignmentTarget {
    Surface(Arc<Surface>),
    Points(PointTree),
}

/// Rigid motion that aligns points with a surface or with points; see `cmfsim.icp` for details.
///
/// `moving`: (n, 3) mm. `fixed`: a Surface or (k, 3) mm. `normals`: (n, 3), needed for `max_angle` (rad).
#[pyfunction]
#[pyo3(signature = (
    moving, fixed, *, initial, trim, method, max_iterations, tolerance, max_distance, max_angle,
    keep_border, normals
))]
#[allow(clippy::too_many_arguments)] // one for each argument of its Python caller
pub fn icp(
    py: Python<'_>,
    moving: &Bound<'_, PyAny>,
    fixed: &Bound<'_, PyAny>,
    initial: Option<&Bound<'_, PyAny>>,
    trim: f64,
    method: Option<&str>,
    max_iterations: &Bound<'_, PyAny>,
    tolerance: f64,
    max_distance: Option<f64>,
    max_angle: Option<f64>,
    keep_border: bool,
    normals: Option<&Bound<'_, PyAny>>,
) -> PyResult<PyIcpFit> {
    let moving = arrays::points(moving, Named("moving", REGISTRATION))?;
    let normals = match normals {
        Some(normals) => Some(arrays::points(normals, Named("normals", REGISTRATION))?),
        None => None,
    };
    let goal = match fixed.cast::<PySurface>() {
        Ok(surface) => AlignmentTarget::Surface(surface.get().core.clone()),
        Err(_) => {
            let points = arrays::points(fixed, Named("fixed", REGISTRATION))?;
            AlignmentTarget::Points(attempted(py, || PointTree::new(&points))?)
        }
    };
    let defaults = IcpOptions::default();
    let initial = match initial {
        Some(matrix) => arrays::square4(matrix, Named("initial", REGISTRATION))?,
        None => defaults.initial,
    };
    let named = Named("max_iterations", REGISTRATION);
    let max_iterations = arrays::whole(max_iterations, named, 1..=u32::MAX.into())?;
    let method = method.map(IcpMethod::from_name).transpose().map_err(Failure)?;
    let options = IcpOptions {
        method,
        initial,
        trim,
        max_distance,
        max_angle,
        keep_border,
        max_iterations,
        tolerance,
    };
    let core = interruptible(py, move |stop| {
        let fixed = match &goal {
            AlignmentTarget::Surface(surface) => Fixed::Surface(surface),
            AlignmentTarget::Points(tree) => Fixed::Points(tree),
        };
        core_icp(&moving, normals.as_deref(), fixed, &options, stop)
    })?;
    Ok(PyIcpFit { core })
}

/// Outcome of iterative closest points.
#[pyclass(frozen, module = "cmfsim", name = "IcpFit")]
pub struct PyIcpFit {
    core: IcpFit,
}

#[pymethods]
impl PyIcpFit {
    /// Rigid motion of the moving points, (4, 4) float64, mm, read-only.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::motion(py, &self.core.matrix)
    }

    /// Root mean square distance of the pairs that count, mm.
    #[getter]
    fn rms(&self) -> f64 {
        self.core.rms
    }

    /// Steps done.
    #[getter]
    fn iterations(&self) -> usize {
        self.core.iterations
    }

    /// Whether the iteration converged.
    #[getter]
    fn converged(&self) -> bool {
        self.core.converged
    }

    /// Whether the pair of each moving point counts, (n,) bool, read-only.
    #[getter]
    fn kept<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<bool>>> {
        arrays::frozen(self.core.kept.clone().into_pyarray(py))
    }

    /// Share of the pairs that count.
    #[getter]
    fn kept_fraction(&self) -> f64 {
        let kept = self.core.kept.iter().filter(|&&kept| kept).count();
        kept as f64 / self.core.kept.len() as f64
    }

    /// Distance of each moved point from its closest one, (n,) float64, mm, read-only.
    #[getter]
    fn distances<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        arrays::frozen(self.core.distances.clone().into_pyarray(py))
    }

    /// `rms` before the first step and after each, (iterations + 1,) float64, mm, read-only.
    #[getter]
    fn rms_history<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        arrays::frozen(self.core.rms_history.clone().into_pyarray(py))
    }

    fn __repr__(&self) -> String {
        format!("IcpFit(rms={:.4} mm, {} iterations)", self.core.rms, self.core.iterations)
    }
}
