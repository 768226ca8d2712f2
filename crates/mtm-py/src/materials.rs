//! `Tissue` and `MassTensors` for Python.

use std::sync::Arc;

use mtm_core::{
    BlockMatrix, EdgeTensors, Elastic, Element, ErrorKind, FibreElastic, FibreLaw, Kinematics,
    MassTensors, Mixing, MtmError, Preset, StrainEnergy, TangentKind, Tissue,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;

use crate::arrays::{self, Named};
use crate::errors::Failure;
use crate::geometry::PyTetMesh;
use crate::running::{attempted, detached};

const MATERIAL: ErrorKind = ErrorKind::Material;

/// Elastic constants of every tet, or of all of them, in MPa; rejected unless positive definite.
///
/// Constructed by `isotropic`, `transversely_isotropic`, `from_stiffness` or `preset`.
#[pyclass(frozen, module = "cmfsim", name = "Tissue")]
pub struct PyTissue {
    pub core: Arc<Tissue>,
}

/// Values of one array at a row: a single value applies to all rows.
fn at(values: &[f64], row: usize) -> f64 {
    if values.len() == 1 { values[0] } else { values[row] }
}

/// The common number of rows of arrays that have one row each, or all the same number.
fn common_rows(arrays: &[(&str, usize)]) -> Result<usize, Failure> {
    let rows = arrays.iter().map(|a| a.1).max().unwrap_or(0);
    for &(what, found) in arrays {
        if found != 1 && found != rows || found == 0 {
            return Err(Failure(MtmError::Length {
                what: what.into(),
                found,
                expected: rows.max(1),
                why: "one value for all tets, or one per tet",
                kind: MATERIAL,
            }));
        }
    }
    Ok(rows)
}

#[pymethods]
impl PyTissue {
    /// Isotropic tissue.
    ///
    /// Parameters
    /// ----------
    /// young : float or (m,) array_like, MPa
    ///     Young's modulus, positive.
    /// poisson : float or (m,) array_like
    ///     Poisson's ratio, -1 < nu < 0.5.
    ///
    /// Raises
    /// ------
    /// MaterialError
    ///     A value out of range, with its index.
    #[staticmethod]
    fn isotropic(
        py: Python<'_>,
        young: &Bound<'_, PyAny>,
        poisson: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let young = arrays::values(young, Named("young", MATERIAL))?;
        let poisson = arrays::values(poisson, Named("poisson", MATERIAL))?;
        let m = common_rows(&[("young", young.len()), ("poisson", poisson.len())])?;
        let rows: Vec<Elastic> =
            (0..m).map(|t| Elastic { young: at(&young, t), poisson: at(&poisson, t) }).collect();
        Ok(Self::wrap(attempted(py, || Tissue::isotropic(&rows))?))
    }

    /// Transversely isotropic tissue with its stiff or soft direction along a fibre.
    ///
    /// Parameters
    /// ----------
    /// young_along, young_across : float or (m,) array_like, MPa
    /// poisson : float or (m,) array_like
    ///     For loading along the stiffer direction.
    /// fibre : (3,) or (m, 3) array_like
    ///     Unit vectors.
    /// law : {"spencer", "picinbono"}
    ///     Spencer (1984) completed by the major-Poisson and Saint-Venant rules, or Picinbono et al.
    ///     (2003), which is rejected if it is indefinite.
    ///
    /// Raises
    /// ------
    /// MaterialError
    ///     A value out of range, a fibre that is not a unit vector, an indefinite stiffness with its
    ///     tet, constants and eigenvalue.
    #[staticmethod]
    #[pyo3(signature = (young_along, young_across, poisson, fibre, law = "spencer"))]
    fn transversely_isotropic(
        py: Python<'_>,
        young_along: &Bound<'_, PyAny>,
        young_across: &Bound<'_, PyAny>,
        poisson: &Bound<'_, PyAny>,
        fibre: &Bound<'_, PyAny>,
        law: &str,
    ) -> PyResult<Self> {
        let law = FibreLaw::from_name(law).map_err(Failure)?;
        let along = arrays::values(young_along, Named("young_along", MATERIAL))?;
        let across = arrays::values(young_across, Named("young_across", MATERIAL))?;
        let poisson = arrays::values(poisson, Named("poisson", MATERIAL))?;
        let fibre = fibres(fibre)?;
        let m = common_rows(&[
            ("young_along", along.len()),
            ("young_across", across.len()),
            ("poisson", poisson.len()),
        ])?;
        let rows: Vec<FibreElastic> = (0..m)
            .map(|t| FibreElastic {
                young_along: at(&along, t),
                young_across: at(&across, t),
                poisson: at(&poisson, t),
            })
            .collect();
        Ok(Self::wrap(attempted(py, || Tissue::transversely_isotropic(&rows, &fibre, law))?))
    }

    /// Tissue of any stiffness ((6, 6) or (m, 6, 6), MPa, Voigt xx yy zz yz xz xy, engineering shears).
    ///
    /// Raises
    /// ------
    /// MaterialError
    ///     A stiffness that is not symmetric or not positive definite, with its tet.
    #[staticmethod]
    fn from_stiffness(py: Python<'_>, stiffness: &Bound<'_, PyAny>) -> PyResult<Self> {
        let rows = arrays::stiffness(stiffness, Named("stiffness", MATERIAL))?;
        Ok(Self::wrap(attempted(py, || Tissue::from_stiffness(rows))?))
    }

    /// Fat with a muscle fraction in each tet.
    ///
    /// Parameters
    /// ----------
    /// name : {"passive", "kim2010", "kim2010-swapped"}
    ///     Muscle at rest (0.03 MPa across, 0.06 along, nu 0.43) in fat that can lose volume (0.003
    ///     MPa, nu 0.40); Table 1 of Kim et al. (2010) as printed (muscle 0.79 MPa across, 0.5 along,
    ///     nu 0.43; fat 0.003 MPa, nu 0.46), or with its muscle's moduli exchanged.
    /// fraction : float or (m,) array_like
    ///     Muscle volume fraction, 0 to 1.
    /// fibre : (3,) or (m, 3) array_like, optional
    ///     Unit vectors; required if the fraction is positive.
    /// mixing : {"moduli", "stiffness"}
    ///     Linear in Young's moduli and Poisson's ratio (the paper, 2.3), or in the stiffness.
    #[staticmethod]
    #[pyo3(signature = (name, fraction, fibre = None, *, mixing = "moduli"))]
    fn preset(
        py: Python<'_>,
        name: &str,
        fraction: &Bound<'_, PyAny>,
        fibre: Option<&Bound<'_, PyAny>>,
        mixing: &str,
    ) -> PyResult<Self> {
        let preset = Preset::from_name(name).map_err(Failure)?;
        let mixing = Mixing::from_name(mixing).map_err(Failure)?;
        let fraction = arrays::values(fraction, Named("fraction", MATERIAL))?;
        // Without directions, a tet with muscle is rejected for its zero fibre, by index.
        let fibre = fibre.map_or(Ok(vec![[0.0; 3]; fraction.len()]), fibres)?;
        Ok(Self::wrap(attempted(py, || Tissue::mixture(&fraction, &fibre, preset, mixing))?))
    }

    /// Stiffness in global axes, (m, 6, 6) float64, MPa, Voigt; (1, 6, 6) if uniform.
    fn stiffness<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let core = self.core.clone();
        Ok(arrays::voigt(py, detached(py, move || core.stiffness())?))
    }

    /// Smallest eigenvalue of each stiffness (Mandel form), (m,) float64, MPa; (1,) if uniform.
    fn smallest_eigenvalues<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let core = self.core.clone();
        Ok(detached(py, move || core.smallest_eigenvalues())?.into_pyarray(py))
    }

    /// Number of rows of constants: 1 for a uniform tissue.
    #[getter]
    fn n_tets(&self) -> usize {
        self.core.n_rows()
    }

    fn __repr__(&self) -> String {
        match self.core.n_rows() {
            1 => "Tissue(uniform)".into(),
            m => format!("Tissue({m} tets)"),
        }
    }
}

impl PyTissue {
    /// The Python object of a core tissue, or its error.
    pub fn wrap(core: Tissue) -> Self {
        Self { core: Arc::new(core) }
    }
}

/// One direction (3,) or one per tet (m, 3).
fn fibres(value: &Bound<'_, PyAny>) -> PyResult<Vec<[f64; 3]>> {
    let name = Named("fibre", MATERIAL);
    let numpy = value.py().import("numpy")?;
    let ndim: usize = numpy.call_method1("ndim", (value,))?.extract()?;
    if ndim == 1 {
        let row = numpy.call_method1("atleast_2d", (value,))?;
        return arrays::points(&row, name);
    }
    arrays::points(value, name)
}

/// Vertex and edge tensors of a mesh with its tissue, N/mm; internal force = K u.
///
/// Parameters
/// ----------
/// mesh : TetMesh
/// tissue : Tissue
/// element : {"p1", "anp", "p2"}
///     Linear tets; linear tets whose volumetric strain is averaged around each corner, which do not lock
///     near nu = 0.5; or quadratic tets on the same corners with a node at the midpoint of each edge.
///
/// Raises
/// ------
/// MaterialError
///     A tissue whose number of rows differs from the number of tets.
/// MeshError
///     An unknown element.
///
/// Notes
/// -----
/// Cotin, Delingette & Ayache (2000); Picinbono et al. (2003); Mollemans et al. (2007). The tensors are
/// the linear finite-element stiffness exactly. "anp": Bonet & Burton (1998); Joldes, Wittek & Miller
/// (2009). With "p2" every (n, 3) array of these methods has one row per node of `nodes`.
///
/// Examples
/// --------
/// >>> import cmfsim
/// >>> mesh = cmfsim.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
/// >>> tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.003, 0.49), element="p2")
/// >>> tensors.nodes.shape, tensors.mid_edges.shape
/// ((10, 3), (6, 2))
#[pyclass(frozen, module = "cmfsim", name = "MassTensors")]
pub struct PyMassTensors {
    pub core: Arc<MassTensors>,
    edges: PyOnceLock<EdgeTensors>,
}

#[pymethods]
impl PyMassTensors {
    #[new]
    #[pyo3(signature = (mesh, tissue, *, element = "p1"))]
    fn new(
        py: Python<'_>,
        mesh: &Bound<'_, PyTetMesh>,
        tissue: &Bound<'_, PyTissue>,
        element: &str,
    ) -> PyResult<Self> {
        let (mesh, tissue) = (mesh.get().core.clone(), tissue.get().core.clone());
        let element = Element::from_name(element).map_err(Failure)?;
        let core = attempted(py, || MassTensors::with_element(mesh, tissue, element))?;
        Ok(Self::wrap(Arc::new(core)))
    }

    /// The element: "p1", "anp" or "p2".
    #[getter]
    fn element(&self) -> &'static str {
        self.core.element().name()
    }

    /// Positions of the nodes, (n, 3) float64, mm: those of the mesh, then the middles of `mid_edges`.
    #[getter]
    fn nodes<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.element_nodes().positions().to_vec())
    }

    /// Corners at the ends of the edge of each mid-edge node, (e, 2) uint32; empty unless "p2".
    #[getter]
    fn mid_edges<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<u32>> {
        arrays::table(py, self.core.element_nodes().mid_edges().to_vec())
    }

    /// The mesh.
    #[getter]
    fn mesh(&self) -> PyTetMesh {
        PyTetMesh::wrap(self.core.mesh().clone())
    }

    /// The tissue.
    #[getter]
    fn tissue(&self) -> PyTissue {
        PyTissue { core: self.core.tissue().clone() }
    }

    /// Vertex tensors K_jj, (n, 3, 3) float64, N/mm.
    #[getter]
    fn vertex<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray3<f64>> {
        arrays::blocks(py, self.core.vertex_tensors())
    }

    /// Node pairs (j < k) of the edges, (e, 2) uint32.
    #[getter]
    fn edges<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<u32>> {
        arrays::table(py, self.edge_tensors(py).edges.clone())
    }

    /// Edge tensors K_jk, (e, 3, 3) float64, N/mm; K_kj is the transpose.
    #[getter]
    fn edge<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray3<f64>> {
        arrays::blocks(py, self.edge_tensors(py).tensors.clone())
    }

    /// Internal force f_j = K_jj u_j + sum_k K_jk u_k of each node (Kim et al. 2010, eq. 1).
    ///
    /// Parameters
    /// ----------
    /// u : (n, 3) array_like, mm
    /// kinematics : {"linear", "corotational", "hyperelastic"}
    ///     See `StaticSolver`.
    ///
    /// Returns
    /// -------
    /// (n, 3) float64, N
    #[pyo3(signature = (u, *, kinematics = "linear"))]
    fn force<'py>(
        &self,
        py: Python<'py>,
        u: &Bound<'py, PyAny>,
        kinematics: &str,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let u = arrays::points(u, Named("u", ErrorKind::Mesh))?;
        let kinematics = Kinematics::from_name(kinematics).map_err(Failure)?;
        let core = self.core.clone();
        let forces = attempted(py, move || match kinematics {
            Kinematics::Linear => core.internal_force(&u),
            large => Ok(StrainEnergy::new(core, large).state(&u)?.forces),
        })?;
        Ok(arrays::rows(py, forces))
    }

    /// Elastic energy of displacements ((n, 3), mm), N mm: u.K u / 2 if linear.
    #[pyo3(signature = (u, *, kinematics = "linear"))]
    fn energy(&self, py: Python<'_>, u: &Bound<'_, PyAny>, kinematics: &str) -> PyResult<f64> {
        let u = arrays::points(u, Named("u", ErrorKind::Mesh))?;
        let kinematics = Kinematics::from_name(kinematics).map_err(Failure)?;
        let core = self.core.clone();
        attempted(py, move || match kinematics {
            Kinematics::Linear => core.energy(&u),
            large => Ok(StrainEnergy::new(core, large).state(&u)?.energy),
        })
    }

    /// Tangent stiffness under displacements, a `scipy.sparse.bsr_matrix`, (3n, 3n), N/mm.
    ///
    /// Parameters
    /// ----------
    /// u : (n, 3) array_like, mm
    /// kinematics : {"linear", "corotational", "hyperelastic"}
    ///     The stiffness of "linear" does not depend on u.
    #[pyo3(signature = (u, *, kinematics = "linear"))]
    fn tangent<'py>(
        &self,
        py: Python<'py>,
        u: &Bound<'py, PyAny>,
        kinematics: &str,
    ) -> PyResult<Bound<'py, PyAny>> {
        let u = arrays::points(u, Named("u", ErrorKind::Mesh))?;
        let kinematics = Kinematics::from_name(kinematics).map_err(Failure)?;
        let core = self.core.clone();
        let matrix = attempted(py, move || match kinematics {
            Kinematics::Linear => core.internal_force(&u).map(|_| core.matrix().clone()),
            large => StrainEnergy::new(core, large).stiffness(&u, TangentKind::Exact),
        })?;
        sparse(py, &matrix)
    }

    /// Linear strain of each tet, (m, 6) float64, Voigt with engineering shears.
    fn strain<'py>(
        &self,
        py: Python<'py>,
        u: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let u = arrays::points(u, Named("u", ErrorKind::Mesh))?;
        Ok(arrays::table(py, attempted(py, || self.core.strain(&u))?))
    }

    /// Stress of each tet, (m, 6) float64, MPa, Voigt.
    fn stress<'py>(
        &self,
        py: Python<'py>,
        u: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let u = arrays::points(u, Named("u", ErrorKind::Mesh))?;
        Ok(arrays::table(py, attempted(py, || self.core.stress(&u))?))
    }

    /// Relative volume change det(I + grad u) - 1 of each tet, (m,) float64; -1 or less means a collapsed tet.
    fn volume_change<'py>(
        &self,
        py: Python<'py>,
        u: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let u = arrays::points(u, Named("u", ErrorKind::Mesh))?;
        Ok(attempted(py, || self.core.volume_change(&u))?.into_pyarray(py))
    }

    /// K in block rows: `indptr` (n+1,) int64, `columns` (b,) int32, `blocks` (b, 3, 3) float64, N/mm.
    fn block_rows<'py>(&self, py: Python<'py>) -> BlockRows<'py> {
        block_rows(py, self.core.matrix())
    }

    /// K as a `scipy.sparse.bsr_matrix`, (3n, 3n), N/mm; unknown 3 j + axis.
    fn to_scipy<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        sparse(py, self.core.matrix())
    }

    fn __repr__(&self) -> String {
        let mesh = self.core.mesh();
        let element = match self.core.element() {
            Element::Linear => String::new(),
            other => format!(", element=\"{}\"", other.name()),
        };
        format!("MassTensors({} nodes, {} tets{element})", mesh.n_nodes(), mesh.n_tets())
    }
}

type BlockRows<'py> =
    (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<i64>>, Bound<'py, PyArray3<f64>>);

fn block_rows<'py>(py: Python<'py>, matrix: &BlockMatrix) -> BlockRows<'py> {
    let start: Vec<i64> = matrix.row_start.iter().map(|&v| v as i64).collect();
    let columns: Vec<i64> = matrix.columns.iter().map(|&v| i64::from(v)).collect();
    (start.into_pyarray(py), columns.into_pyarray(py), arrays::blocks(py, matrix.blocks.clone()))
}

fn sparse<'py>(py: Python<'py>, matrix: &BlockMatrix) -> PyResult<Bound<'py, PyAny>> {
    let (start, columns, blocks) = block_rows(py, matrix);
    let size = 3 * matrix.n_rows();
    let options = pyo3::types::PyDict::new(py);
    options.set_item("shape", (size, size))?;
    py.import("scipy.sparse")?.call_method(
        "bsr_matrix",
        ((blocks, columns, start),),
        Some(&options),
    )
}

impl PyMassTensors {
    /// The Python object of core tensors.
    pub fn wrap(core: Arc<MassTensors>) -> Self {
        Self { core, edges: PyOnceLock::new() }
    }

    fn edge_tensors(&self, py: Python<'_>) -> &EdgeTensors {
        self.edges.get_or_init(py, || self.core.edge_tensors())
    }
}
