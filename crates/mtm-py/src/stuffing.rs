//! Meshes of labels and level images, and level images of surfaces, for Python.

use std::sync::Arc;

use mtm_core::{
    ErrorKind, Grid, Halvings, Joined, LevelImage, Stuffed, StuffingOptions, part, pieces,
    signed_distance, squared_distance, stuff,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Named};
use crate::errors::Failure;
use crate::geometry::{PySurface, PyTetMesh};
use crate::running::interruptible;

const MESH: ErrorKind = ErrorKind::Mesh;

/// The labels of an image, and the sizes of its pieces.
type LabelledImage<'py> = (Bound<'py, PyArray3<i32>>, Bound<'py, PyArray1<isize>>);

/// Mesh of the tissue in a label image or inside a level image, and a dict of figures about it.
///
/// `values`: (nx, ny, nz); bool or integers are labels (non-zero is tissue), real numbers a level
/// (positive inside). `spacing`, `origin`: (3,) mm. `allowed`, `needed`: (nx, ny, nz), how many times the
/// edge may be halved in thin places there (`refinements` if none), and how many times at least (0 if none).
/// The dict has `dropped_parts`, `dropped_volume` (mm³),
/// `dropped_tets`, `level_volume` (mm³), `boundary_error_mean` and `boundary_error_max` (mm).
#[pyfunction]
#[pyo3(signature = (
    values, spacing, edge_length, origin, *, refinements, least_body, allowed = None, needed = None
))]
#[allow(clippy::too_many_arguments)] // one for each argument of its Python caller
pub fn stuff_image<'py>(
    py: Python<'py>,
    values: &Bound<'py, PyAny>,
    spacing: [f64; 3],
    edge_length: f64,
    origin: [f64; 3],
    refinements: &Bound<'py, PyAny>,
    least_body: f64,
    allowed: Option<&Bound<'py, PyAny>>,
    needed: Option<&Bound<'py, PyAny>>,
) -> PyResult<(PyTetMesh, Bound<'py, PyDict>)> {
    let image = arrays::image(values, Named("image", MESH))?;
    let counts = |value: Option<&Bound<'py, PyAny>>, name| {
        value.map(|value| arrays::counts(value, Named(name, MESH))).transpose()
    };
    let (allowed, needed) = (counts(allowed, "allowed")?, counts(needed, "needed")?);
    let refinements = arrays::whole(refinements, Named("refinements", MESH), 0..=u32::MAX.into())?;
    let options = StuffingOptions { edge_length, refinements, least_body };
    let made: Stuffed = interruptible(py, move |_| {
        let level = match image {
            arrays::Image::Labels(shape, inside) => {
                LevelImage::from_labels(Grid::new(shape, spacing, origin)?, &inside)?
            }
            arrays::Image::Level(shape, values) => {
                LevelImage::new(Grid::new(shape, spacing, origin)?, values)?
            }
        };
        let halvings = Halvings { allowed: allowed.as_deref(), needed: needed.as_deref() };
        stuff(&level, &options, &halvings)
    })?;
    let report = PyDict::new(py);
    report.set_item("dropped_parts", made.dropped.parts)?;
    report.set_item("dropped_volume", made.dropped.volume)?;
    report.set_item("dropped_tets", made.dropped_tets)?;
    report.set_item("level_volume", made.level_volume)?;
    report.set_item("boundary_error_mean", made.boundary_error_mean)?;
    report.set_item("boundary_error_max", made.boundary_error_max)?;
    Ok((PyTetMesh::wrap(Arc::new(made.mesh)), report))
}

/// Relative margin on the square of the largest requested distance: more than the rounding of float32.
const DISTANCE_MARGIN: f64 = 1e-6;

/// Distance of every voxel centre to the nearest non-zero one, (nx, ny, nz) float32, mm; infinite if there is none,
/// and where it exceeds `within`.
#[pyfunction]
#[pyo3(signature = (targets, spacing, *, within=f64::INFINITY))]
pub fn distance_image<'py>(
    py: Python<'py>,
    targets: &Bound<'py, PyAny>,
    spacing: [f64; 3],
    within: f64,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let name = Named("targets", MESH);
    let (shape, inside) = arrays::labels(targets, name)?;
    let grid = Grid::new(shape, spacing, [0.0; 3]).map_err(Failure)?;
    let most = (within * within * (1.0 + DISTANCE_MARGIN)) as f32;
    let distances = interruptible(py, move |_| {
        let squared = squared_distance(&grid, most, |index| inside[index]);
        Ok(squared.into_iter().map(f32::sqrt).collect())
    })?;
    arrays::volume(py, shape, distances)
}

/// Number of each voxel's connected piece, (nx, ny, nz) int32, from 1 on in the order of their first voxels and 0
/// outside the mask, and the number of voxels of each piece, (count + 1,) intp, that of 0 being 0.
#[pyfunction]
#[pyo3(signature = (mask, *, corners=false))]
pub fn label_image<'py>(
    py: Python<'py>,
    mask: &Bound<'py, PyAny>,
    corners: bool,
) -> PyResult<LabelledImage<'py>> {
    let (shape, inside) = arrays::labels(mask, Named("mask", MESH))?;
    let grid = Grid::new(shape, [1.0; 3], [0.0; 3]).map_err(Failure)?;
    let joined = if corners { Joined::Corners } else { Joined::Faces };
    let found = interruptible(py, move |_| Ok(pieces(&grid, &inside, joined)))?;
    let sizes: Vec<isize> = found.sizes.into_iter().map(|n| n as isize).collect();
    Ok((found.labels.into_pyarray(py).reshape(shape)?, sizes.into_pyarray(py)))
}

/// Signed distance to a surface on a grid, (nx, ny, nz) float32, mm: positive inside, clipped at ±band.
#[pyfunction]
#[pyo3(signature = (surface, shape, spacing, origin, *, band))]
pub fn signed_distance_image<'py>(
    py: Python<'py>,
    surface: &Bound<'py, PySurface>,
    shape: [usize; 3],
    spacing: [f64; 3],
    origin: [f64; 3],
    band: f64,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let grid = Grid::new(shape, spacing, origin).map_err(Failure)?;
    let surface = surface.get().core.clone();
    let level = interruptible(py, move |_| signed_distance(&surface, grid, band))?;
    arrays::volume(py, shape, level.into_values())
}

/// The mesh split along an open surface, and for each new node the ends of the edge on which it lies, or twice
/// the node that it is a copy of; tuple of mesh and (k, 2) uint32.
#[pyfunction]
pub fn part_mesh<'py>(
    py: Python<'py>,
    mesh: &Bound<'py, PyTetMesh>,
    surface: &Bound<'py, PySurface>,
) -> PyResult<(PyTetMesh, Bound<'py, PyArray2<u32>>)> {
    let (mesh, surface) = (mesh.get().core.clone(), surface.get().core.clone());
    let parted = interruptible(py, move |_| part(&mesh, &surface))?;
    Ok((PyTetMesh::wrap(Arc::new(parted.mesh)), arrays::table(py, parted.parents)))
}
