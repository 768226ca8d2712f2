"""The border between numpy and the core: dtypes, orders, strides, errors, threads."""

import _thread
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes

ONE_NODES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
ONE_TET = np.array([[0, 1, 2, 3]], dtype=np.uint32)
FAMILY = (
    cmfsim.MeshError,
    cmfsim.MaterialError,
    cmfsim.BoundaryError,
    cmfsim.ContactError,
    cmfsim.SolverError,
    cmfsim.RegistrationError,
    cmfsim.LandmarkError,
    cmfsim.CaseError,
    cmfsim.ImageError,
)


def test_arrays_come_back_in_their_contract():
    """Float64 and uint32 in C order with the documented shapes."""
    nodes, tets = meshes.random_body(30)
    n, m = len(nodes), len(tets)
    mesh = cmfsim.TetMesh(nodes, tets)
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(1.0, 0.3))
    u = np.zeros((n, 3))
    e = len(tensors.edges)
    quality = mesh.quality()
    surface = mesh.surface()
    closest = surface.closest(nodes)
    expected = [
        (mesh.nodes, (n, 3), np.float64),
        (mesh.tets, (m, 4), np.uint32),
        (mesh.volumes, (m,), np.float64),
        (mesh.boundary_triangles(), (len(surface.triangles), 3), np.uint32),
        (mesh.boundary_nodes(), (len(surface.vertices),), np.uint32),
        (quality.min_dihedral, (m,), np.float64),
        (quality.max_dihedral, (m,), np.float64),
        (quality.edge_ratio, (m,), np.float64),
        (tensors.vertex, (n, 3, 3), np.float64),
        (tensors.edges, (e, 2), np.uint32),
        (tensors.edge, (e, 3, 3), np.float64),
        (tensors.force(u), (n, 3), np.float64),
        (tensors.strain(u), (m, 6), np.float64),
        (tensors.stress(u), (m, 6), np.float64),
        (tensors.volume_change(u), (m,), np.float64),
        (tensors.tissue.stiffness(), (1, 6, 6), np.float64),
        (closest[0], (n, 3), np.float64),
        (closest[1], (n, 3), np.float64),
        (closest[2], (n,), np.uint32),
        (surface.winding_number(nodes), (n,), np.float64),
    ]
    for array, shape, dtype in expected:
        assert array.shape == shape
        assert array.dtype == dtype
        assert array.flags.c_contiguous
    np.testing.assert_array_equal(mesh.nodes, nodes)
    np.testing.assert_array_equal(mesh.tets, tets)
    np.testing.assert_allclose(mesh.volumes, meshes.volumes(nodes, tets), rtol=1e-12)
    assert isinstance(tensors.energy(u), float)


def variants(array):
    """The same values in every layout that numpy knows."""
    padded = np.zeros((2 * array.shape[0], 2 * array.shape[1]), dtype=array.dtype)
    padded[::2, ::2] = array
    read_only = array.copy()
    read_only.setflags(write=False)
    unaligned = np.frombuffer(b"\0" + array.tobytes(), dtype=array.dtype, offset=1)
    return {
        "C": array,
        "Fortran": np.asfortranarray(array),
        "strided view": padded[::2, ::2],
        "reversed view": array[::-1].copy()[::-1],
        "transposed": np.ascontiguousarray(array.T).T,
        "read-only": read_only,
        "unaligned": unaligned.reshape(array.shape),
        "big-endian": array.astype(array.dtype.newbyteorder(">")),
        "list": array.tolist(),
    }


NODES, TETS = meshes.random_body(20, seed=1)


@pytest.mark.parametrize("layout", variants(NODES))
def test_any_layout_gives_the_same_bits(layout):
    """A Fortran-ordered array passes `as_slice` scrambled: every layout arrives as seen."""
    expected = cmfsim.MassTensors(cmfsim.TetMesh(NODES, TETS), cmfsim.Tissue.isotropic(1.0, 0.3))
    mesh = cmfsim.TetMesh(variants(NODES)[layout], variants(TETS)[layout])
    np.testing.assert_array_equal(mesh.nodes, NODES)
    np.testing.assert_array_equal(mesh.tets, TETS)
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(1.0, 0.3))
    u = np.random.default_rng(0).normal(size=NODES.shape)
    np.testing.assert_array_equal(tensors.force(variants(u)[layout]), expected.force(u))
    matrix = cmfsim.rigid_motion((1, 2, 3), 30, (1, 2, 3))
    surface = mesh.surface()
    np.testing.assert_array_equal(
        surface.transformed(variants(matrix)[layout]).vertices, surface.transformed(matrix).vertices
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.int64, np.uint64])
def test_any_integer_dtype_serves_as_index(dtype):
    """Indices are read as whole numbers of any width."""
    mesh = cmfsim.TetMesh(ONE_NODES.astype(np.float32), ONE_TET.astype(dtype))
    assert mesh.tets.dtype == np.uint32


def test_inputs_are_copied_not_shared():
    """Changing the caller's array later changes nothing."""
    nodes = ONE_NODES.copy()
    mesh = cmfsim.TetMesh(nodes, ONE_TET)
    nodes[0] = 99.0
    np.testing.assert_array_equal(mesh.nodes, ONE_NODES)


def test_outputs_cannot_change_what_they_came_from():
    """Arrays out of frozen values are read-only, or copies of their own."""
    mesh = cmfsim.TetMesh(ONE_NODES, ONE_TET)
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(1.0, 0.3))
    solver = cmfsim.StaticSolver(tensors, cmfsim.Boundary([0, 1, 2], {"tip": [3]}))
    result = solver.solve({"tip": cmfsim.rigid_motion((0, 0, 0.1))})
    for owner, name in (
        (mesh, "nodes"),
        (mesh, "tets"),
        (mesh, "volumes"),
        (tensors, "vertex"),
        (tensors, "edge"),
        (result, "displacements"),
        (result, "forces"),
    ):
        array = getattr(owner, name)
        before = array.copy()
        if array.flags.writeable:
            array[...] = 7
        np.testing.assert_array_equal(getattr(owner, name), before, err_msg=name)


def test_values_are_frozen():
    """No attribute of a value can be set."""
    mesh = cmfsim.TetMesh(ONE_NODES, ONE_TET)
    with pytest.raises(AttributeError):
        mesh.nodes = ONE_NODES
    with pytest.raises((AttributeError, TypeError)):
        mesh.extra = 1


@pytest.mark.parametrize(
    ("nodes", "tets", "pattern"),
    [
        (np.zeros((0, 3)), ONE_TET, "nodes.*empty"),
        (ONE_NODES, np.zeros((0, 4), dtype=np.uint32), "tets.*empty"),
        (ONE_NODES[:, :2], ONE_TET, r"nodes.*\(4, 2\)"),
        (ONE_NODES.ravel(), ONE_TET, r"nodes.*\(12,\)"),
        (ONE_NODES[None], ONE_TET, r"nodes.*\(1, 4, 3\)"),
        (ONE_NODES, ONE_TET[:, :3], r"tets.*\(1, 3\)"),
        (ONE_NODES, ONE_TET.ravel(), r"tets.*\(4,\)"),
        (ONE_NODES, ONE_TET.astype(np.float64), "tets.*float64"),
        (ONE_NODES, ONE_TET.astype(bool), "tets.*bool"),
        (ONE_NODES, [[0, 1, 2, -1]], "-1"),
        (ONE_NODES, [[0, 1, 2, 4]], r"tets.*4"),
        (ONE_NODES, [[0, 1, 2, 2**32]], "4294967296"),
        (ONE_NODES.astype(complex), ONE_TET, "nodes.*complex"),
        (ONE_NODES.astype(str), ONE_TET, "nodes"),
        ([[0, 0, 0], [1, 0]], ONE_TET, "nodes"),
        (None, ONE_TET, "nodes"),
        (ONE_NODES, None, "tets"),
        (object(), ONE_TET, "nodes"),
    ],
)
def test_wrong_arrays_are_named(nodes, tets, pattern):
    """Shape, dtype and range errors say which array and what it is."""
    with pytest.raises(cmfsim.MeshError, match=pattern) as caught:
        cmfsim.TetMesh(nodes, tets)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_found_with_their_index(bad):
    """NaN or infinity in: an error with row and value out, wherever it enters."""
    nodes = ONE_NODES.copy()
    nodes[2, 1] = bad
    text = {np.inf: "inf", -np.inf: "-inf"}.get(bad, "NaN")
    with pytest.raises(cmfsim.MeshError, match=rf"nodes.*2.*{text}"):
        cmfsim.TetMesh(nodes, ONE_TET)
    mesh = cmfsim.TetMesh(ONE_NODES, ONE_TET)
    with pytest.raises(cmfsim.MaterialError, match=text):
        cmfsim.Tissue.isotropic(bad, 0.3)
    with pytest.raises(cmfsim.MaterialError, match=text):
        cmfsim.Tissue.isotropic([1.0], [bad])
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(1.0, 0.3))
    for call in (tensors.force, tensors.energy, tensors.strain, mesh.surface().closest):
        with pytest.raises(cmfsim.CmfsimError, match=text):
            call(nodes)
    boundary = cmfsim.Boundary(fixed=[0, 1, 2], joined={"tip": [3]})
    solver = cmfsim.StaticSolver(tensors, boundary)
    with pytest.raises(cmfsim.BoundaryError, match=text):
        solver.solve({"tip": [[0.0, 0.0, bad]]})
    motion = np.eye(4)
    motion[1, 3] = bad
    with pytest.raises(cmfsim.BoundaryError, match=text):
        solver.solve({"tip": motion})
    with pytest.raises(cmfsim.CmfsimError, match=text):
        solver.solve({"tip": np.eye(4)}, loads=nodes)


def test_every_error_stands_under_cmfsim_error():
    """One family: `except cmfsim.CmfsimError` catches all."""
    for error in FAMILY:
        assert issubclass(error, cmfsim.CmfsimError)
        assert not issubclass(error, ValueError)
    assert issubclass(cmfsim.CmfsimError, Exception)


def test_wrong_types_of_objects_are_type_errors():
    """What is no mesh, tissue or boundary is refused by type."""
    mesh = cmfsim.TetMesh(ONE_NODES, ONE_TET)
    with pytest.raises(TypeError):
        cmfsim.MassTensors(mesh, mesh)
    with pytest.raises(TypeError):
        cmfsim.MassTensors("mesh", cmfsim.Tissue.isotropic(1.0, 0.3))
    with pytest.raises(TypeError):
        cmfsim.Surface(ONE_NODES, [[0, 1, 2]], 60.0)


def test_the_interpreter_runs_on_while_the_core_works():
    """The GIL is released: a Python thread counts while a factorisation runs."""
    nodes, tets = meshes.box((18, 18, 18), (50.0, 50.0, 50.0))
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(0.1, 0.4))
    boundary = cmfsim.Boundary(fixed=meshes.nodes_where(nodes[:, 0] == 0.0))
    ticks = []
    stop = threading.Event()

    def count():
        while not stop.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    counter = threading.Thread(target=count)
    counter.start()
    try:
        started = time.perf_counter()
        cmfsim.StaticSolver(tensors, boundary, "cholesky")
        ended = time.perf_counter()
    finally:
        stop.set()
        counter.join()
    during = [t for t in ticks if started < t < ended]
    assert len(during) >= 3, f"{len(during)} ticks in {ended - started:.3f} s"


def test_ctrl_c_stops_a_long_solve():
    """A keyboard interrupt ends a relaxation that would run for minutes."""
    nodes, tets = meshes.box((20, 20, 20), (50.0, 50.0, 50.0))
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(0.1, 0.499))
    x = nodes[:, 0]
    boundary = cmfsim.Boundary(meshes.nodes_where(x == 0.0), {"tip": meshes.nodes_where(x == 50.0)})
    solver = cmfsim.StaticSolver(
        tensors, boundary, "relaxation", tolerance=1e-15, max_iterations=10**9
    )
    timer = threading.Timer(0.3, _thread.interrupt_main)
    started = time.perf_counter()
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        solver.solve({"tip": cmfsim.rigid_motion((0, 0, 1))})
    assert time.perf_counter() - started < 10.0


def test_one_solver_serves_many_threads():
    """Solves from several Python threads at once give the bits of one alone."""
    nodes, tets = meshes.box((6, 6, 6), (10.0, 10.0, 10.0), jitter=0.2)
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(0.1, 0.4))
    boundary = cmfsim.Boundary(
        fixed=meshes.nodes_where(nodes[:, 0] == 0.0),
        joined={"bone": meshes.nodes_where(nodes[:, 0] == 10.0)},
    )
    solver = cmfsim.StaticSolver(tensors, boundary)
    plans = [{"bone": cmfsim.rigid_motion((0, 0, 0.1 * i), i, (1, 0, 0))} for i in range(8)]
    expected = [solver.solve(plan).displacements for plan in plans]
    found = [None] * len(plans)

    def solve(i):
        found[i] = solver.solve(plans[i]).displacements

    threads = [threading.Thread(target=solve, args=(i,)) for i in range(len(plans))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_array_equal(a, b)


def test_import_needs_numpy_alone():
    """Nothing optional is loaded by `import cmfsim`."""
    script = (
        "import sys, cmfsim; "
        "heavy = {'scipy', 'meshio', 'matplotlib', 'pyvista', 'vtk', 'dask', 'skimage'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    out = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True
    ).stdout
    assert out.strip() == "[]"


def test_a_boundary_gives_back_what_it_was_given():
    """Segments in order, nodes, surfaces and gaps by name."""
    surface = cmfsim.Surface(ONE_NODES, [[0, 1, 2]])
    boundary = cmfsim.Boundary(
        fixed=[0],
        joined={"b": [1]},
        sliding={"a": [2, 3], "c": [4], "d": [5, 6]},
        contact={"a": surface, "c": surface, "d": surface},
        gap={"a": [0.1, 0.2], "c": "rest"},
    )
    assert boundary.segments == ["b", "a", "c", "d"]
    assert boundary.joined.keys() == {"b"}
    assert boundary.sliding["a"].tolist() == [2, 3]
    assert boundary.contact.keys() == {"a", "c", "d"}
    assert boundary.gap["a"].tolist() == [0.1, 0.2]
    assert boundary.gap["c"] == "rest"
    assert boundary.gap["d"] == "rest"


def test_pieces_have_scipys_numbers_in_any_order_of_memory() -> None:
    ndimage = pytest.importorskip("scipy.ndimage", reason="needs scipy")
    random = np.random.default_rng(5)
    for share in (0.0, 0.1, 0.3, 0.6, 1.0):
        mask = random.random((9, 12, 7)) < share
        for corners in (False, True):
            structure = ndimage.generate_binary_structure(3, 3 if corners else 1)
            wanted, count = ndimage.label(mask, structure)
            sizes = np.bincount(wanted.ravel(), minlength=count + 1)
            sizes[0] = 0
            for given in (mask, np.asfortranarray(mask), mask[:, ::-1][:, ::-1]):
                labels, found = cmfsim._core.label_image(given, corners=corners)
                assert labels.dtype == np.int32
                assert np.array_equal(labels, wanted)
                assert np.array_equal(found, sizes)
