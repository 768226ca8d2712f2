"""Meshes and images of other libraries in memory are those of their files."""

import numpy as np
import pytest

import cmfsim
from cmfsim.errors import CaseInputError, ImageInputError

CORNERS = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4], [4, 4, 4]], dtype=float)
# The second is negative.
TETS = [[0, 1, 2, 3], [1, 2, 4, 3]]
TRIANGLES = [[0, 2, 1], [0, 1, 3], [1, 2, 3]]


def meshio_mesh(points, cells):
    meshio = pytest.importorskip("meshio", reason="needs meshio")
    return meshio.Mesh(points, cells)


def test_tets_of_meshio_are_oriented_and_their_triangles_left_out():
    mesh = cmfsim.from_meshio(meshio_mesh(CORNERS, [("triangle", TRIANGLES), ("tetra", TETS)]))
    assert isinstance(mesh, cmfsim.TetMesh)
    assert np.array_equal(mesh.nodes, CORNERS)
    assert mesh.tets.tolist() == [[0, 1, 2, 3], [1, 2, 3, 4]]
    assert (mesh.volumes > 0.0).all()


def test_a_surface_of_meshio_is_that_of_its_file(tmp_path):
    mesh = meshio_mesh(np.repeat(CORNERS[:4], 2, axis=0), [("triangle", 2 * np.array(TRIANGLES))])
    mesh.write(tmp_path / "surface.vtu")
    given, read = cmfsim.from_meshio(mesh), cmfsim.read_surface(tmp_path / "surface.vtu")
    assert len(given.vertices) == 4
    assert np.array_equal(given.vertices, read.vertices)
    assert np.array_equal(given.triangles, read.triangles)


def test_what_is_no_mesh_of_tets_or_triangles_is_refused():
    cubes = ("hexahedron", [[0, 1, 2, 3, 4, 0, 1, 2]])
    with pytest.raises(CaseInputError, match=r"meshio mesh: linear tets are needed.*hexahedron"):
        cmfsim.from_meshio(meshio_mesh(CORNERS, [("tetra", TETS), cubes]))
    with pytest.raises(CaseInputError, match="found nothing"):
        cmfsim.from_meshio(meshio_mesh(CORNERS, []))
    with pytest.raises(CaseInputError, match="names point 9"):
        cmfsim.from_meshio(meshio_mesh(CORNERS, [("triangle", [[0, 1, 9]])]))


def test_what_other_arrays_would_be_cut_to_is_refused():
    """Indices of 0.5 became 0, and the imaginary part of points was dropped."""
    for points, tets, words in (
        (CORNERS, np.array(TETS) + 0.5, "tetra cells have dtype float64: whole numbers"),
        (CORNERS.astype(complex), TETS, "points has dtype complex128"),
        (CORNERS.astype(str), TETS, "points has dtype <U"),
    ):
        with pytest.raises(CaseInputError, match=words):
            cmfsim.from_meshio(meshio_mesh(points, [("tetra", tets)]))
    second = ("tetra10", [[0, 1, 2, 3, 4, 0, 1, 2, 3, 4]])
    with pytest.raises(CaseInputError, match=r"found tetra10: convert .* linear_copy\(\)"):
        cmfsim.from_meshio(meshio_mesh(CORNERS, [second]))


def test_what_is_no_mesh_is_named():
    pv = pytest.importorskip("pyvista", reason="needs PyVista")
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: np.array(TETS)}, CORNERS)
    for given, words in (
        ("tissue.vtu", "of type str: a PyVista data set is needed; read_tet_mesh and"),
        (None, "of type NoneType"),
        (pv.MultiBlock([grid]), "is a MultiBlock: give one of its blocks"),
        (meshio_mesh(CORNERS, [("tetra", TETS)]), "of type Mesh: a PyVista data set is needed"),
    ):
        with pytest.raises(CaseInputError, match=words):
            cmfsim.from_pyvista(given)
    for given in ("tissue.vtu", grid):
        with pytest.raises(CaseInputError, match=r"a meshio\.Mesh is needed"):
            cmfsim.from_meshio(given)


def test_meshes_of_pyvista_come_back_as_they_went():
    pv = pytest.importorskip("pyvista", reason="needs PyVista")
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: np.array(TETS)}, CORNERS)
    mesh = cmfsim.from_pyvista(grid)
    assert mesh.tets.tolist() == [[0, 1, 2, 3], [1, 2, 3, 4]]
    ball = pv.Sphere(radius=30.0)
    surface = cmfsim.from_pyvista(ball)
    assert np.array_equal(surface.vertices, ball.points.astype(float))
    assert np.array_equal(surface.triangles, ball.regular_faces)
    # Quads are split.
    assert len(cmfsim.from_pyvista(pv.Plane(i_resolution=2, j_resolution=3)).triangles) == 12
    with pytest.raises(CaseInputError, match=r"PyVista mesh: linear tets or tri.*triangulate"):
        cmfsim.from_pyvista(pv.ImageData(dimensions=(3, 3, 3)))


@pytest.fixture
def nib():
    return pytest.importorskip("nibabel", reason="needs nibabel")


@pytest.mark.parametrize("unit", ["mm", "micron", "meter"])
def test_an_image_of_nibabel_is_that_of_its_file(nib, unit, tmp_path):
    """Scaled voxels, flipped axes and units."""
    pytest.importorskip("SimpleITK", reason="needs SimpleITK")
    size = {"mm": 1.0, "micron": 1000.0, "meter": 0.001}[unit]
    affine = np.diag([-size, 2.0 * size, 0.5 * size, 1.0])
    affine[:3, 3] = size * np.array([10.0, -20.0, 30.0])
    voxels = np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6, 1)
    image = nib.Nifti1Image(voxels, affine)
    image.header.set_xyzt_units(unit)
    image.header.set_slope_inter(2.0, -1000.0)
    nib.save(image, tmp_path / "ct.nii.gz")
    read = cmfsim.read_image(tmp_path / "ct.nii.gz")
    given = cmfsim.from_nibabel(nib.load(tmp_path / "ct.nii.gz"))
    assert given.values.dtype.kind == "f"
    assert np.array_equal(given.values, read.values)
    assert np.allclose(given.spacing, [1.0, 2.0, 0.5])
    assert np.allclose(given.origin, read.origin, atol=1e-4)


def test_images_that_are_no_volume_are_refused(nib):
    voxels = np.zeros((4, 5, 6), dtype=np.float32)
    with pytest.raises(ImageInputError, match="save one volume"):
        cmfsim.from_nibabel(nib.Nifti1Image(np.zeros((4, 5, 6, 2)), np.eye(4)))
    with pytest.raises(ImageInputError, match="not a set of axes"):
        cmfsim.from_nibabel(nib.Nifti1Image(voxels, np.ones((4, 4))))
    voxels[1, 2, 3] = np.inf
    with pytest.raises(ImageInputError, match="1 voxels are NaN or infinite"):
        cmfsim.from_nibabel(nib.Nifti1Image(voxels, np.eye(4)))
    with pytest.raises(ImageInputError, match="no affine"):
        cmfsim.from_nibabel(nib.Nifti1Image(voxels, None))


def test_what_was_assumed_of_an_image_is_logged(nib, caplog):
    """Axes without a code, and voxels that are no number."""
    voxels = np.zeros((4, 5, 6), dtype=np.float32)
    voxels[1, 2, 3], voxels[0] = -1000.0, np.nan
    image = nib.Nifti1Image(voxels, np.eye(4))
    given = cmfsim.from_nibabel(image)
    assert given.values.min() == -1000.0
    assert np.count_nonzero(given.values == -1000.0) == 31
    assert "30 voxels (25.0%) are no number: read as -1000" in caplog.text
    assert "guess" not in caplog.text
    image.set_sform(None, 0)
    image.set_qform(None, 0)
    cmfsim.from_nibabel(image)
    assert "its codes qform and sform are 0" in caplog.text


def test_repaired_tets_are_those_of_a_mesh_with_a_count_of_each_change():
    """One is negative, one flat, one has a node twice; a node is left over."""
    nodes = np.concatenate([CORNERS, [[2, 2, 0], [9, 9, 9]]])
    tets = [[0, 1, 2, 5], [1, 2, 4, 3], [0, 1, 2, 3], [0, 0, 1, 2]]
    with pytest.raises(cmfsim.MeshError):
        cmfsim.TetMesh(nodes, tets)
    found = cmfsim.repair_tets(nodes, tets)
    assert (found.n_turned, found.n_dropped) == (1, 2)
    assert found.kept_nodes.tolist() == [0, 1, 2, 3, 4]
    assert found.kept_tets.tolist() == [1, 2]
    mesh = cmfsim.TetMesh(found.nodes, found.tets)
    assert np.allclose(mesh.volumes.sum(), 64.0 / 6.0 + 128.0 / 6.0)
    again = cmfsim.repair_tets(found.nodes, found.tets)
    assert (again.n_turned, again.n_dropped) == (0, 0)
    assert np.array_equal(again.tets, found.tets)


@pytest.mark.parametrize("height", [1e-15, 4e-12, 8e-12, 1e-9])
def test_a_tet_is_dropped_if_the_mesh_refuses_it(height):
    """The limit is that of `TetMesh`: 1e-12 of the longest edge cubed."""
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, height], [0, 0, -1]])
    tets = [[0, 1, 2, 3], [0, 2, 1, 4]]
    found = cmfsim.repair_tets(nodes, tets)
    assert cmfsim.TetMesh(found.nodes, found.tets).n_tets == 2 - found.n_dropped
    if found.n_dropped:
        with pytest.raises(cmfsim.MeshError, match="tet 0 is degenerate"):
            cmfsim.TetMesh(nodes, tets)


def test_tets_without_any_volume_are_refused():
    with pytest.raises(CaseInputError, match="none of 1 tets has a volume"):
        cmfsim.repair_tets(np.zeros((4, 3)), [[0, 1, 2, 3]])
    with pytest.raises(CaseInputError):
        cmfsim.repair_tets(np.zeros((0, 3)), np.zeros((0, 4), dtype=int))
