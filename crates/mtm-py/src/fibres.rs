//! `MuscleFibres` for Python.

use std::sync::Arc;

use mtm_core::{ErrorKind, MOST_BOXES, MuscleFibres, MuscleKind, OrientedBox};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;

use crate::arrays::{self, Named};
use crate::errors::Failure;
use crate::geometry::PySurface;
use crate::running::{attempted, detached};

const MESH: ErrorKind = ErrorKind::Mesh;
/// Why kind and extents are known, for `expect`.
const FROM_SURFACE: &str = "made from a surface";

/// Fibre directions of one muscle, from oriented boxes of its surface (Kim et al. 2010, section 2.2) or
/// from known lines.
///
/// Parameters
/// ----------
/// surface : Surface
///     Surface of the muscle. Only areas count: it may have holes and flipped triangles.
/// kind : str, default "strap"
///     "strap": along the muscle, in boxes that follow its bends; "fan": lanes that converge to
///     its narrow end; "ring": around the opening; "sheet": lanes along the longest axis.
/// boxes : int or None
///     Number of boxes, 1 to 64: in series, side by side in a fan, around a ring (3 or more). None: as
///     many as the shape needs.
/// course : sequence of (n, 3) array_like, mm
///     Known fibre lines; if there are any, they are used instead of the boxes.
///
/// Raises
/// ------
/// MeshError
///     An unknown kind, too few or too many boxes, NaN or infinity, a line without two different points.
///
/// Examples
/// --------
/// >>> import cmfsim
/// >>> bar = cmfsim.Surface(
/// ...     [[0, 0, 0], [9, 0, 0], [9, 2, 0], [0, 2, 0]], [[0, 1, 2], [0, 2, 3]]
/// ... )
/// >>> fibres = cmfsim.MuscleFibres(bar)
/// >>> abs(fibres.directions([[4.0, 1.0, 0.0]])[0, 0]) > 0.999
/// True
#[pyclass(frozen, module = "cmfsim", name = "MuscleFibres")]
pub struct PyMuscleFibres {
    pub core: Arc<MuscleFibres>,
    lines: Vec<Vec<[f64; 3]>>,
}

#[pymethods]
impl PyMuscleFibres {
    #[new]
    #[pyo3(signature = (surface, kind = "strap", boxes = None, course = Vec::new()))]
    fn new(
        py: Python<'_>,
        surface: &Bound<'_, PySurface>,
        kind: &str,
        boxes: Option<&Bound<'_, PyAny>>,
        course: Vec<Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let kind = MuscleKind::parse(kind).map_err(Failure)?;
        let most = MOST_BOXES as i64;
        let boxes =
            boxes.map(|count| arrays::whole(count, Named("boxes", MESH), 1..=most)).transpose()?;
        let line = |(i, line): (usize, &Bound<'_, PyAny>)| {
            arrays::points(line, Named(&format!("course {i}"), MESH))
        };
        let lines = course.iter().enumerate().map(line).collect::<PyResult<Vec<_>>>()?;
        let surface = surface.get().core.clone();
        let core = attempted(py, || {
            let fibres = MuscleFibres::from_surface(&surface, kind, boxes)?;
            if lines.is_empty() { Ok(fibres) } else { fibres.with_courses(&lines) }
        })?;
        Ok(Self { core: Arc::new(core), lines })
    }

    /// Unit directions at `points` ((k, 3), mm), (k, 3) float64; their sign has no meaning.
    fn directions<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let points = arrays::points(points, Named("points", MESH))?;
        let core = self.core.clone();
        Ok(arrays::rows(py, detached(py, move || core.directions(&points))?))
    }

    /// The oriented boxes of the surface: centres (b, 3) mm, axes (b, 3, 3) as rows with the fibres along
    /// the first, half extents (b, 3) mm.
    #[getter]
    #[allow(clippy::type_complexity)]
    fn boxes<'py>(
        &self,
        py: Python<'py>,
    ) -> (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray3<f64>>, Bound<'py, PyArray2<f64>>) {
        let boxes = self.core.boxes();
        let flat = |b: &OrientedBox| {
            let [u, v, w] = b.axes;
            [u[0], u[1], u[2], v[0], v[1], v[2], w[0], w[1], w[2]]
        };
        (
            arrays::rows(py, boxes.iter().map(|b| b.centre).collect()),
            arrays::blocks(py, boxes.iter().map(flat).collect()),
            arrays::rows(py, boxes.iter().map(|b| b.half_extents).collect()),
        )
    }

    /// The known fibre lines, (n, 3) float64 mm each.
    #[getter]
    fn course<'py>(&self, py: Python<'py>) -> Vec<Bound<'py, PyArray2<f64>>> {
        self.lines.iter().map(|line| arrays::rows(py, line.clone())).collect()
    }

    /// The kind of muscle that was assumed: "strap", "fan", "ring" or "sheet".
    #[getter]
    fn kind(&self) -> &'static str {
        self.core.kind().expect(FROM_SURFACE).name()
    }

    /// Extents of the whole muscle along its principal axes, (3,) float64, mm.
    #[getter]
    fn extents<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.extents().expect(FROM_SURFACE).to_vec().into_pyarray(py)
    }

    /// Second extent of the whole muscle over the first.
    #[getter]
    fn sheet_ratio(&self) -> f64 {
        self.core.sheet_ratio().expect(FROM_SURFACE)
    }

    /// Whether the outline hardly determines the direction: a sheet without known lines, or a strap whose two
    /// longest extents are nearly equal.
    #[getter]
    fn is_sheet(&self) -> bool {
        self.core.is_sheet()
    }

    fn __repr__(&self) -> String {
        let kind = self.kind();
        match self.lines.len() {
            0 => format!("MuscleFibres({kind}, {} boxes)", self.core.boxes().len()),
            lines => format!("MuscleFibres({kind}, {lines} lines)"),
        }
    }
}
