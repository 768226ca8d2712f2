//! `TetMesh`, `MeshQuality`, `Surface` and `SurfaceMotion` for Python.

use std::sync::Arc;

use mtm_core::{
    ErrorKind, MeshQuality, Surface, SurfaceMotion, TetMesh, TubeEnd, WindingTree,
    decimated as core_decimated, rigid_matrix as core_rigid_matrix, smoothed as core_smoothed,
    tube_levels as core_tube_levels,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyDict;

use crate::arrays::{self, Named};
use crate::errors::{self, Failure};
use crate::running::{attempted, detached};

const MESH: ErrorKind = ErrorKind::Mesh;

/// Vertices and triangles of a surface, in the core and for Python.
type Triangles = (Vec<[f64; 3]>, Vec<[u32; 3]>);
type TriangleArrays<'py> = (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<u32>>);

/// Checked tetrahedral mesh of the soft tissue.
///
/// Parameters
/// ----------
/// nodes : (n, 3) array_like, mm
///     Node positions.
/// tets : (m, 4) array_like of int
///     Node indices of each tet, positively oriented.
///
/// Raises
/// ------
/// MeshError
///     Empty arrays, NaN or infinity, indices out of range, tets that repeat a node, are inverted or
///     degenerate, two tets on the same nodes, nodes that no tet uses.
///
/// Examples
/// --------
/// >>> import cmfsim
/// >>> mesh = cmfsim.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
/// >>> float(mesh.volumes[0] * 6)
/// 1.0
#[pyclass(frozen, module = "cmfsim", name = "TetMesh")]
pub struct PyTetMesh {
    pub core: Arc<TetMesh>,
    nodes: PyOnceLock<Py<PyArray2<f64>>>,
    tets: PyOnceLock<Py<PyArray2<u32>>>,
    volumes: PyOnceLock<Py<PyArray1<f64>>>,
}

#[pymethods]
impl PyTetMesh {
    #[new]
    fn new(py: Python<'_>, nodes: &Bound<'_, PyAny>, tets: &Bound<'_, PyAny>) -> PyResult<Self> {
        let nodes = arrays::points(nodes, Named("nodes", MESH))?;
        let tets = arrays::tets(tets, Named("tets", MESH))?;
        let core = attempted(py, || TetMesh::new(nodes, tets))?;
        Ok(Self::wrap(Arc::new(core)))
    }

    /// Node positions, (n, 3) float64, mm, read-only.
    #[getter]
    fn nodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let make =
            || PyResult::Ok(arrays::frozen(arrays::rows(py, self.core.nodes().to_vec()))?.unbind());
        Ok(self.nodes.get_or_try_init(py, make)?.bind(py).clone())
    }

    /// Node indices of each tet, (m, 4) uint32, read-only.
    #[getter]
    fn tets<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u32>>> {
        let make =
            || PyResult::Ok(arrays::frozen(arrays::table(py, self.core.tets().to_vec()))?.unbind());
        Ok(self.tets.get_or_try_init(py, make)?.bind(py).clone())
    }

    /// Volume of each tet, (m,) float64, mm³, read-only.
    #[getter]
    fn volumes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let make = || {
            PyResult::Ok(arrays::frozen(self.core.volumes().to_vec().into_pyarray(py))?.unbind())
        };
        Ok(self.volumes.get_or_try_init(py, make)?.bind(py).clone())
    }

    /// Number of nodes.
    #[getter]
    fn n_nodes(&self) -> usize {
        self.core.n_nodes()
    }

    /// Number of tets.
    #[getter]
    fn n_tets(&self) -> usize {
        self.core.n_tets()
    }

    /// Triangles of the boundary, outward, (t, 3) uint32 in mesh node indices.
    fn boundary_triangles<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u32>>> {
        let core = self.core.clone();
        Ok(arrays::table(py, detached(py, move || core.boundary_triangles().to_vec())?))
    }

    /// Nodes on the boundary, (k,) uint32, ascending: vertex i of `surface()` is node i of these.
    fn boundary_nodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<u32>>> {
        Ok(detached(py, || boundary_nodes(&self.core))?.into_pyarray(py))
    }

    /// Boundary of the mesh as a `Surface` with outward normals; its vertices are `boundary_nodes()`.
    fn surface(&self, py: Python<'_>) -> PyResult<PySurface> {
        let core = self.core.clone();
        let surface = attempted(py, move || {
            let nodes = boundary_nodes(&core);
            let vertices = nodes.iter().map(|&j| core.nodes()[j as usize]).collect();
            let local = |j: u32| nodes.partition_point(|&k| k < j) as u32;
            let triangles = core.boundary_triangles().iter().map(|t| t.map(local)).collect();
            Surface::new(vertices, triangles)
        })?;
        Ok(PySurface::wrap(surface))
    }

    /// Dihedral angles and edge ratio of every tet.
    fn quality(&self, py: Python<'_>) -> PyResult<PyMeshQuality> {
        let core = self.core.clone();
        Ok(PyMeshQuality { core: detached(py, move || core.quality())? })
    }

    fn __repr__(&self) -> String {
        format!("TetMesh({} nodes, {} tets)", self.core.n_nodes(), self.core.n_tets())
    }
}

impl PyTetMesh {
    /// The Python object of a core mesh.
    pub fn wrap(core: Arc<TetMesh>) -> Self {
        let (nodes, tets, volumes) = (PyOnceLock::new(), PyOnceLock::new(), PyOnceLock::new());
        Self { core, nodes, tets, volumes }
    }
}

fn boundary_nodes(mesh: &TetMesh) -> Vec<u32> {
    let mut nodes: Vec<u32> = mesh.boundary_triangles().as_flattened().to_vec();
    nodes.sort_unstable();
    nodes.dedup();
    nodes
}

/// Shape measures of every tet.
#[pyclass(frozen, module = "cmfsim", name = "MeshQuality")]
pub struct PyMeshQuality {
    core: MeshQuality,
}

#[pymethods]
impl PyMeshQuality {
    /// Smallest dihedral angle of each tet, (m,) float64, degrees.
    #[getter]
    fn min_dihedral<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        degrees(&self.core.min_dihedral).into_pyarray(py)
    }

    /// Largest dihedral angle of each tet, (m,) float64, degrees.
    #[getter]
    fn max_dihedral<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        degrees(&self.core.max_dihedral).into_pyarray(py)
    }

    /// Longest over shortest edge of each tet, (m,) float64.
    #[getter]
    fn edge_ratio<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.core.edge_ratio.clone().into_pyarray(py)
    }

    /// Worst values as a dict: `min_dihedral`, `max_dihedral` (degrees), `edge_ratio`.
    fn summary<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let least = |v: &[f64]| v.iter().copied().fold(f64::INFINITY, f64::min);
        let most = |v: &[f64]| v.iter().copied().fold(0.0, f64::max);
        let out = PyDict::new(py);
        out.set_item("min_dihedral", least(&self.core.min_dihedral).to_degrees())?;
        out.set_item("max_dihedral", most(&self.core.max_dihedral).to_degrees())?;
        out.set_item("edge_ratio", most(&self.core.edge_ratio))?;
        Ok(out)
    }
}

fn degrees(radians: &[f64]) -> Vec<f64> {
    radians.iter().map(|a| a.to_degrees()).collect()
}

/// Triangle surface with outward normals.
///
/// Parameters
/// ----------
/// vertices : (v, 3) array_like, mm
/// triangles : (t, 3) array_like of int
///     Outward by the right-hand rule.
/// crease_angle : float, degrees, default 60
///     Normals are continuous across edges with a smaller angle between facets, and jump across others.
///
/// Raises
/// ------
/// MeshError
///     Empty arrays, NaN or infinity, indices out of range, degenerate triangles.
#[pyclass(frozen, module = "cmfsim", name = "Surface")]
pub struct PySurface {
    pub core: Arc<Surface>,
    winding: PyOnceLock<WindingTree>,
}

#[pymethods]
impl PySurface {
    #[new]
    #[pyo3(signature = (vertices, triangles, *, crease_angle = 60.0))]
    fn new(
        py: Python<'_>,
        vertices: &Bound<'_, PyAny>,
        triangles: &Bound<'_, PyAny>,
        crease_angle: f64,
    ) -> PyResult<Self> {
        let vertices = arrays::points(vertices, Named("vertices", MESH))?;
        let triangles = arrays::triangles(triangles, Named("triangles", MESH))?;
        let crease = crease_angle.to_radians();
        let core = attempted(py, || Surface::with_crease_angle(vertices, triangles, crease))?;
        Ok(Self::wrap(core))
    }

    /// Vertex positions, (v, 3) float64, mm.
    #[getter]
    fn vertices<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::frozen(arrays::rows(py, self.core.vertices().to_vec()))
    }

    /// Vertex indices of each triangle, (t, 3) uint32.
    #[getter]
    fn triangles<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u32>>> {
        arrays::frozen(arrays::table(py, self.core.triangles().to_vec()))
    }

    /// Unit normal of each vertex, weighted by angles, (v, 3) float64; zero if it has none.
    #[getter]
    fn vertex_normals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::frozen(arrays::rows(py, self.core.vertex_normals()))
    }

    /// Whether every edge has exactly two triangles with consistent orientation.
    #[getter]
    fn is_closed(&self) -> bool {
        self.core.is_closed()
    }

    /// Area, mm².
    #[getter]
    fn area(&self) -> f64 {
        self.core.area()
    }

    /// Enclosed volume, mm³, negative if the normals point inwards; None for an open surface.
    #[getter]
    fn volume(&self) -> Option<f64> {
        self.core.volume()
    }

    /// Number of edges with one triangle only.
    #[getter]
    fn n_border_edges(&self) -> usize {
        self.core.n_border_edges()
    }

    /// Closest points of the surface to `points` ((k, 3), mm).
    ///
    /// Returns
    /// -------
    /// points : (k, 3) float64, mm
    /// normals : (k, 3) float64
    ///     Unit normals, continuous across edges.
    /// triangles : (k,) uint32
    #[allow(clippy::type_complexity)]
    fn closest<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>, Bound<'py, PyArray1<u32>>)>
    {
        let points = arrays::points(points, Named("points", MESH))?;
        let core = self.core.clone();
        let found = detached(py, move || core.closest(&points))?;
        Ok((
            arrays::rows(py, found.iter().map(|c| c.point).collect()),
            arrays::rows(py, found.iter().map(|c| c.normal).collect()),
            found.iter().map(|c| c.triangle).collect::<Vec<_>>().into_pyarray(py),
        ))
    }

    /// Generalised winding number at `points` ((k, 3), mm), (k,) float64: 1 inside, 0 outside a closed
    /// surface, in between near holes (Barill et al. 2018).
    fn winding_number<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let points = arrays::points(points, Named("points", MESH))?;
        let build = || detached(py, || WindingTree::new(&self.core));
        let tree = self.winding.get_or_try_init(py, build)?;
        Ok(detached(py, || tree.winding_number(&points))?.into_pyarray(py))
    }

    /// The same triangles on new vertex positions ((v, 3), mm).
    fn moved(&self, py: Python<'_>, vertices: &Bound<'_, PyAny>) -> PyResult<Self> {
        let vertices = arrays::points(vertices, Named("vertices", MESH))?;
        let core = self.core.clone();
        Ok(Self::wrap(attempted(py, move || core.moved(vertices))?))
    }

    /// The surface after the rigid motion `matrix` ((4, 4)).
    fn transformed(&self, py: Python<'_>, matrix: &Bound<'_, PyAny>) -> PyResult<Self> {
        let name = Named("matrix", ErrorKind::Boundary);
        let matrix = arrays::square4(matrix, name)?;
        let matrix = core_rigid_matrix(name.0, &matrix, name.1).map_err(Failure)?;
        let core = self.core.clone();
        Ok(Self::wrap(attempted(py, move || core.transformed(&matrix))?))
    }

    fn __repr__(&self) -> String {
        format!(
            "Surface({} vertices, {} triangles, {})",
            self.core.vertices().len(),
            self.core.triangles().len(),
            if self.core.is_closed() { "closed" } else { "open" }
        )
    }
}

impl PySurface {
    /// The Python object of a core surface.
    pub fn wrap(core: Surface) -> Self {
        Self { core: Arc::new(core), winding: PyOnceLock::new() }
    }
}

/// The rigid matrix nearest to `matrix`, (4, 4) float64, mm: the only check of whether a matrix is rigid.
///
/// Every plan, transform and alignment is checked by it, so that what the solver uses is exactly rigid. The
/// rotation is replaced by the nearest exact rotation (its polar factor); the translation is kept. A matrix
/// that is already rigid to rounding, such as one of `rigid_motion`, is returned unchanged in every bit.
///
/// Parameters
/// ----------
/// matrix : (4, 4) float64, mm
///     x ↦ R x + t. Every rotation written with four or more decimals is accepted.
/// name : str
///     Name of the matrix in errors.
///
/// Raises
/// ------
/// BoundaryError
///     (also `ValueError`) A wrong shape, NaN or infinity, a bottom row other than 0 0 0 1, a reflection,
///     RᵀR that differs from I by more than 2e-4 (scale or shear), with the figure.
///
/// Examples
/// --------
/// >>> import cmfsim
/// >>> typed = cmfsim.rigid_motion(angle=30, axis=(0, 0, 1)).round(4)
/// >>> exact = cmfsim.rigid_matrix(typed)
/// >>> bool(abs(exact[:3, :3] @ exact[:3, :3].T - [[1, 0, 0], [0, 1, 0], [0, 0, 1]]).max() < 1e-14)
/// True
#[pyfunction]
#[pyo3(signature = (matrix, name = "matrix"))]
pub fn rigid_matrix<'py>(
    py: Python<'py>,
    matrix: &Bound<'py, PyAny>,
    name: &str,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let name = Named(name, ErrorKind::Boundary);
    let matrix = arrays::square4(matrix, name)?;
    let rigid = core_rigid_matrix(name.0, &matrix, name.1).map_err(Failure)?;
    Ok(arrays::table(py, rigid.to_vec()))
}

/// Vertices (v, 3) float64 and triangles (t, 3) uint32 of a surface with about `wanted` triangles.
#[pyfunction]
pub fn decimated<'py>(
    py: Python<'py>,
    vertices: &Bound<'py, PyAny>,
    triangles: &Bound<'py, PyAny>,
    wanted: usize,
) -> PyResult<TriangleArrays<'py>> {
    let (points, corners) = triangle_mesh(vertices, triangles)?;
    let (points, corners) = detached(py, move || core_decimated(points, corners, wanted))?;
    Ok((arrays::rows(py, points), arrays::table(py, corners)))
}

/// Vertices (v, 3) float64 of a closed surface after steps towards the means of their neighbours.
#[pyfunction]
pub fn smoothed<'py>(
    py: Python<'py>,
    vertices: &Bound<'py, PyAny>,
    triangles: &Bound<'py, PyAny>,
    steps: Vec<f64>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (points, corners) = triangle_mesh(vertices, triangles)?;
    Ok(arrays::rows(py, detached(py, move || core_smoothed(points, &corners, &steps))?))
}

/// Vertices and triangles, whose indices are checked.
fn triangle_mesh(vertices: &Bound<'_, PyAny>, triangles: &Bound<'_, PyAny>) -> PyResult<Triangles> {
    let points = arrays::points(vertices, Named("vertices", MESH))?;
    let corners = arrays::triangles(triangles, Named("triangles", MESH))?;
    let n = points.len();
    match corners.as_flattened().iter().find(|j| **j as usize >= n) {
        Some(j) => Err(errors::input(MESH, format!("triangles have vertex {j}; there are {n}"))),
        None => Ok((points, corners)),
    }
}

/// Level of the nearest segment of a tube at points, (m,) float64, mm, no less than `outside`: positive inside.
///
/// A row of `segments`, (s, 2, 8) float64, is an end: place, unit normal, half axes along and across the normal.
#[pyfunction]
pub fn tube_levels<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f64>,
    segments: PyReadonlyArray3<'py, f64>,
    outside: f64,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let (points, ends) = (points.as_slice()?, segments.as_slice()?);
    let ends = ends.as_chunks::<8>().0.iter().map(|&[x, y, z, u, v, w, thick, wide]| TubeEnd {
        place: [x, y, z],
        normal: [u, v, w],
        thick,
        wide,
    });
    let ends: Vec<TubeEnd> = ends.collect();
    let (segments, points) = (ends.as_chunks::<2>().0, points.as_chunks::<3>().0);
    Ok(py.detach(|| core_tube_levels(segments, points, outside)).into_pyarray(py))
}

/// Motion of a bone surface vertex by vertex: joined nodes and contact surfaces follow it.
///
/// Parameters
/// ----------
/// surface : Surface
///     The bone before surgery.
/// moved_vertices : (v, 3) array_like, mm
///     The same vertices afterwards.
///
/// Raises
/// ------
/// BoundaryError, MeshError
///     A different number of vertices, NaN or infinity.
#[pyclass(frozen, module = "cmfsim", name = "SurfaceMotion")]
pub struct PySurfaceMotion {
    pub core: Arc<SurfaceMotion>,
}

#[pymethods]
impl PySurfaceMotion {
    #[new]
    fn new(
        py: Python<'_>,
        surface: &Bound<'_, PySurface>,
        moved_vertices: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let kind = ErrorKind::Boundary;
        let moved = arrays::points(moved_vertices, Named("moved_vertices", kind))?;
        let rest = surface.get().core.as_ref().clone();
        let count = rest.vertices().len();
        if moved.len() != count {
            return Err(errors::input(
                kind,
                format!(
                    "moved_vertices has {} rows where the surface has {count} vertices: the surface \
                     before and after must share their topology",
                    moved.len()
                ),
            ));
        }
        let core = attempted(py, || SurfaceMotion::new(rest, moved))?;
        Ok(Self { core: Arc::new(core) })
    }

    /// The surface before the motion.
    #[getter]
    fn surface(&self) -> PySurface {
        PySurface::wrap(self.core.rest().clone())
    }

    /// Vertex positions after the motion, (v, 3) float64, mm.
    #[getter]
    fn moved_vertices<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.moved().vertices().to_vec())
    }

    /// Displacement of points near the surface ((k, 3), mm): each follows its closest triangle.
    fn displacement<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let points = arrays::points(points, Named("points", MESH))?;
        let core = self.core.clone();
        Ok(arrays::rows(py, detached(py, move || core.displacement(&points))?))
    }
}
