//! Muscle fraction and fibre of each tet, for Python.

use std::sync::Arc;

use mtm_core::{
    ErrorKind, InsideTest, MOST_SAMPLES, Mixing, Muscle, MuscleShares, Preset, SamplingOptions,
    Share, sample_muscles,
};
use numpy::{IntoPyArray, PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Named};
use crate::errors::Failure;
use crate::fibres::PyMuscleFibres;
use crate::geometry::{PySurface, PyTetMesh};
use crate::materials::PyTissue;
use crate::running::{attempted, interruptible};

const MATERIAL: ErrorKind = ErrorKind::Material;

/// Muscle in a mesh, tet by tet; returned by `sample_muscles`.
#[pyclass(frozen, module = "cmfsim._core", name = "MuscleShares")]
pub struct PyMuscleShares {
    core: Arc<MuscleShares>,
}

/// Volume fraction and fibre direction of the muscles in every tet.
///
/// Parameters
/// ----------
/// mesh : TetMesh
/// muscles : sequence of (Surface, MuscleFibres)
/// samples : int
///     Points in each tet that a surface crosses.
/// seed : int
///     From 0 on.
/// inside : {"winding", "normal"}
///
/// Raises
/// ------
/// MaterialError
///     `samples`, `seed` or `inside` out of range.
#[pyfunction(name = "sample_muscles")]
#[pyo3(signature = (mesh, muscles, *, samples, seed, inside))]
pub fn sample(
    py: Python<'_>,
    mesh: &Bound<'_, PyTetMesh>,
    muscles: Vec<(Bound<'_, PySurface>, Bound<'_, PyMuscleFibres>)>,
    samples: &Bound<'_, PyAny>,
    seed: &Bound<'_, PyAny>,
    inside: &str,
) -> PyResult<PyMuscleShares> {
    let mesh = mesh.get().core.clone();
    let muscles: Vec<Muscle> = muscles
        .iter()
        .map(|(surface, fibres)| Muscle {
            surface: surface.get().core.clone(),
            fibres: fibres.get().core.clone(),
        })
        .collect();
    let options = SamplingOptions {
        samples: arrays::whole(samples, Named("samples", MATERIAL), 1..=MOST_SAMPLES as i64)?,
        seed: arrays::whole(seed, Named("seed", MATERIAL), 0..=i64::MAX)?,
        inside: InsideTest::from_name(inside).map_err(Failure)?,
    };
    let core = interruptible(py, move |stop| sample_muscles(&mesh, &muscles, &options, stop))?;
    Ok(PyMuscleShares { core: Arc::new(core) })
}

#[pymethods]
impl PyMuscleShares {
    /// Volume fraction of muscle in each tet, (m,) float64.
    #[getter]
    fn fraction<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.fraction.clone().into_pyarray(py)
    }

    /// Standard error of the fraction, (m,) float64.
    #[getter]
    fn error<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.error.clone().into_pyarray(py)
    }

    /// Direction of the fibres of each tet, (m, 3) float64: unit vectors, zero without muscle.
    #[getter]
    fn fibre<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.fibre.iter().map(|f| f.direction).collect())
    }

    /// How clearly one direction dominates in each tet, (m,) float64: 1 if all are parallel, 0 if none does.
    #[getter]
    fn coherence<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.fibre.iter().map(|f| f.coherence).collect::<Vec<_>>().into_pyarray(py)
    }

    /// Volumes of each muscle as a dict of lists: `inside`, `shared`, `error` (mm³), `enclosed` (mm³ or
    /// None), `was_turned`.
    #[getter]
    fn volumes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let volumes = &self.core.volumes;
        let out = PyDict::new(py);
        out.set_item("inside", volumes.iter().map(|v| v.inside).collect::<Vec<_>>())?;
        out.set_item("shared", volumes.iter().map(|v| v.shared).collect::<Vec<_>>())?;
        out.set_item("error", volumes.iter().map(|v| v.error).collect::<Vec<_>>())?;
        out.set_item("enclosed", volumes.iter().map(|v| v.enclosed).collect::<Vec<_>>())?;
        out.set_item("was_turned", volumes.iter().map(|v| v.was_turned).collect::<Vec<_>>())?;
        Ok(out)
    }

    /// Each muscle's part of each tet: tet (k,) uint32 ascending, muscle (k,) uint32, fraction inside (k,)
    /// float64, its share (k,) float64, fibre (k, 3) float64.
    #[getter]
    #[allow(clippy::type_complexity)]
    fn shares<'py>(
        &self,
        py: Python<'py>,
    ) -> (
        Bound<'py, PyArray1<u32>>,
        Bound<'py, PyArray1<u32>>,
        Bound<'py, PyArray1<f64>>,
        Bound<'py, PyArray1<f64>>,
        Bound<'py, PyArray2<f64>>,
    ) {
        let rows: Vec<(u32, &Share)> =
            self.core.tets.iter().flat_map(|t| t.shares.iter().map(|s| (t.tet, s))).collect();
        let column = |value: fn(&Share) -> f64| -> Vec<f64> {
            rows.iter().map(|(_, share)| value(share)).collect()
        };
        (
            rows.iter().map(|(tet, _)| *tet).collect::<Vec<_>>().into_pyarray(py),
            rows.iter().map(|(_, share)| share.muscle).collect::<Vec<_>>().into_pyarray(py),
            column(|share| share.inside).into_pyarray(py),
            column(|share| share.fraction).into_pyarray(py),
            arrays::rows(py, rows.iter().map(|(_, share)| share.fibre.direction).collect()),
        )
    }

    /// Work involved, as a dict: `points`, `pairs`, `crossed`.
    #[getter]
    fn counts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counts = &self.core.counts;
        let out = PyDict::new(py);
        out.set_item("points", counts.points)?;
        out.set_item("pairs", counts.pairs)?;
        out.set_item("crossed", counts.crossed)?;
        Ok(out)
    }

    /// Time taken, as a dict, s: `trees`, `crossing`, `sampling`.
    #[getter]
    fn timings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let timings = &self.core.timings;
        let out = PyDict::new(py);
        out.set_item("trees", timings.trees)?;
        out.set_item("crossing", timings.crossing)?;
        out.set_item("sampling", timings.sampling)?;
        Ok(out)
    }

    /// Tissue of the tets with the constants of a preset, mixed by "moduli" or "stiffness".
    #[pyo3(signature = (preset, *, mixing))]
    fn tissue(&self, py: Python<'_>, preset: &str, mixing: &str) -> PyResult<PyTissue> {
        let preset = Preset::from_name(preset).map_err(Failure)?;
        let mixing = Mixing::from_name(mixing).map_err(Failure)?;
        Ok(PyTissue::wrap(attempted(py, || self.core.tissue(preset, mixing))?))
    }
}
