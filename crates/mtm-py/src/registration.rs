//! Thin-plate splines for Python.

use std::sync::Arc;

use mtm_core::error::ErrorKind;
use mtm_core::registration::thin_plate::{Folds, ThinPlateSpline};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;

use crate::arrays::{self, Named};
use crate::errors::Failure;

const REGISTRATION: ErrorKind = ErrorKind::Registration;

/// Smooth map that takes landmarks to landmarks with the least bending (thin-plate spline).
///
/// Bookstein (1989) in three dimensions: kernel U(r) = r and an affine part. Called with points
/// ((k, 3), mm) it gives their images, (k, 3) float64, mm. Affine maps are reproduced exactly.
///
/// Parameters
/// ----------
/// source, target : (n, 3) array_like, mm
///     Landmarks in the same order, four at least and not in one plane.
/// smoothing : float, mm
///     0: every source landmark goes to its target. λ above 0: it may stay away from it, by λ times
///     its weight; the spline minimises Σ |y − f(s)|² + λ/8π · bending_energy. The `smoothing` of
///     scipy's `RBFInterpolator` with kernel "linear" and degree 1.
///
/// Raises
/// ------
/// RegistrationError
///     (also `ValueError`) Sets of different length, fewer than four landmarks, all in one plane,
///     two at one place, NaN or infinity, a negative smoothing.
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
        let core =
            py.detach(|| ThinPlateSpline::new(source, target, smoothing)).map_err(Failure)?;
        Ok(Self { core: Arc::new(core) })
    }

    fn __call__<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let points = arrays::points(points, Named("points", REGISTRATION))?;
        let images = py.detach(|| self.core.warp(&points)).map_err(Failure)?;
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
        let found = py.detach(|| self.core.jacobian(&points)).map_err(Failure)?;
        let flat = found
            .into_iter()
            .map(|[a, b, c]| [a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]]);
        Ok(arrays::blocks(py, flat.collect()))
    }

    /// Where the map turns space inside out among `points` ((k, 3), mm).
    fn folds(&self, py: Python<'_>, points: &Bound<'_, PyAny>) -> PyResult<PyFolds> {
        let points = arrays::points(points, Named("points", REGISTRATION))?;
        Ok(PyFolds { core: py.detach(|| self.core.folds(&points)).map_err(Failure)? })
    }

    /// Smallest determinant on the way to each landmark, over all directions.
    fn landmark_folds(&self) -> PyFolds {
        PyFolds { core: self.core.landmark_folds() }
    }

    /// Landmarks before the map, (n, 3) float64, mm, read-only.
    #[getter]
    fn source<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::frozen(arrays::rows(py, self.core.source().to_vec()))
    }

    /// Landmarks that the map goes to, (n, 3) float64, mm, read-only.
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
