"""Invariants over random bodies, materials and motions, and constructors over random rubbish."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

import cmfsim
from benches.scenes import meshes

moduli = st.floats(1e-3, 1e3)
ratios = st.floats(0.0, 0.495)
seeds = st.integers(0, 2**31)
units = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
angles = st.floats(-180, 180)


@st.composite
def bodies(draw):
    """A random body between two planes, with a material and a motion."""
    seed = draw(seeds)
    nodes, tets = meshes.box((3, 2, 3), (6.0, 5.0, 7.0), jitter=0.2, seed=seed)
    fibre = np.array(draw(units))
    tissue = cmfsim.Tissue.transversely_isotropic(
        draw(moduli), draw(moduli), draw(ratios), fibre / np.linalg.norm(fibre)
    )
    return nodes, cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), tissue)


def split(nodes):
    return (meshes.nodes_where(nodes[:, 2] == z) for z in (0.0, 7.0))


@given(body=bodies(), seed=seeds)
def test_energy_is_positive_and_the_product_symmetric(body, seed):
    """½ u·K u ≥ 0 and v·K u = u·K v for every admissible material (Betti)."""
    nodes, tensors = body
    u, v = np.random.default_rng(seed).normal(size=(2, *nodes.shape))
    assert tensors.energy(u) > 0.0
    a, b = np.sum(v * tensors.force(u)), np.sum(u * tensors.force(v))
    scale = np.linalg.norm(v) * np.linalg.norm(tensors.force(u))
    assert abs(a - b) <= 1e-12 * scale


@given(body=bodies(), axis=units, angle=angles, factor=st.floats(-3, 3))
def test_the_solution_is_linear_in_the_prescribed_displacements(body, axis, angle, factor):
    """u(f d) = f u(d): the model is linear in d, whatever its size."""
    nodes, tensors = body
    low, high = split(nodes)
    solver = cmfsim.StaticSolver(tensors, cmfsim.Boundary(low, {"bone": high}))
    d = meshes.rotation(axis, angle) @ nodes[high].T
    d = d.T - nodes[high]
    one = solver.solve({"bone": d}).displacements
    many = solver.solve({"bone": factor * d}).displacements
    assert np.abs(many - factor * one).max() <= 1e-9 * max(np.abs(d).max(), 1e-9) * 3


@given(body=bodies(), axis=units, angle=st.floats(-20, 20), seed=seeds)
def test_operator_and_solve_agree(body, axis, angle, seed):
    """Twelve columns per segment are exact for any finite rigid motion."""
    nodes, tensors = body
    low, high = split(nodes)
    solver = cmfsim.StaticSolver(tensors, cmfsim.Boundary(low, {"bone": high}), "cholesky")
    translation = np.random.default_rng(seed).uniform(-5, 5, 3)
    plan = {"bone": cmfsim.rigid_motion(translation, angle, axis, (3, 2, 7))}
    found = solver.plan_operator()(plan)
    assert np.abs(found - solver.solve(plan).displacements).max() < 1e-9


@given(seed=seeds, axis=units, angle=angles, along=moduli, across=moduli, poisson=ratios)
def test_turning_the_whole_scene_turns_the_answer(seed, axis, angle, along, across, poisson):
    """Frame indifference: u(R scene) = R u(scene) for nodes, fibre and prescribed displacements."""
    nodes, tets = meshes.box((3, 2, 3), (6.0, 5.0, 7.0), jitter=0.2, seed=seed)
    low, high = split(nodes)
    fibre = meshes.unit_vectors(len(tets), seed)
    d = np.random.default_rng(seed).uniform(-1, 1, (len(high), 3))
    r = meshes.rotation(axis, angle)
    answers = []
    for turn in (np.eye(3), r):
        mesh = cmfsim.TetMesh(nodes @ turn.T, tets)
        tissue = cmfsim.Tissue.transversely_isotropic(along, across, poisson, fibre @ turn.T)
        solver = cmfsim.StaticSolver(
            cmfsim.MassTensors(mesh, tissue), cmfsim.Boundary(low, {"bone": high}), "cholesky"
        )
        answers.append(solver.solve({"bone": d @ turn.T}).displacements)
    contrast = max(along / across, across / along)
    assert np.abs(answers[1] - answers[0] @ r.T).max() < 1e-9 * max(1.0, 1e-3 * contrast)


@given(along=moduli, across=moduli, poisson=st.floats(-0.9, 0.4999), fibre=units)
def test_every_admissible_fibre_tissue_is_positive_definite(along, across, poisson, fibre):
    """1 − ν_tt − 2 ν_lt ν_tl ≥ (1+ν)(1−2ν) > 0 for ν ≥ 0, any ratio of moduli."""
    a = np.array(fibre) / np.linalg.norm(fibre)
    try:
        tissue = cmfsim.Tissue.transversely_isotropic(along, across, poisson, a)
    except cmfsim.MaterialError as error:
        assert poisson < 0.0, error  # noqa: PT017
        return
    assert tissue.smallest_eigenvalues()[0] > 0.0
    assert np.linalg.eigvalsh(tissue.stiffness()[0])[0] > 0.0


rubbish = st.one_of(
    st.none(),
    st.text(max_size=3),
    st.integers(-5, 5),
    st.floats(),
    st.lists(st.floats(), max_size=4),
    npst.arrays(
        st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.complex128]),
        npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5),
    ),
)


@settings(max_examples=300)
@given(nodes=rubbish, tets=rubbish)
def test_rubbish_makes_no_mesh(nodes, tets):
    """A named error or a valid mesh, never anything else."""
    try:
        mesh = cmfsim.TetMesh(nodes, tets)
    except cmfsim.MeshError as error:
        assert isinstance(error, ValueError)  # noqa: PT017
    else:
        assert (mesh.volumes > 0.0).all()


@settings(max_examples=300)
@given(
    tets=npst.arrays(
        np.int64, st.tuples(st.integers(0, 6), st.just(4)), elements=st.integers(-1, 9)
    ),
    nodes=npst.arrays(
        np.float64,
        st.tuples(st.integers(0, 9), st.just(3)),
        elements=st.sampled_from([0.0, 1.0, -1.0, 2.0, 1e-9, 1e9, np.nan, np.inf]),
    ),
)
def test_nearly_right_meshes_are_right_or_refused(nodes, tets):
    """What passes has positive volumes and uses all its nodes."""
    try:
        mesh = cmfsim.TetMesh(nodes, tets)
    except cmfsim.MeshError:
        return
    assert (meshes.volumes(nodes, tets) > 0.0).all()
    assert set(range(len(nodes))) == set(tets.ravel().tolist())
    assert mesh.n_tets == len(tets)


@settings(max_examples=200)
@given(a=rubbish, b=rubbish, c=rubbish)
def test_rubbish_makes_no_tissue_boundary_or_surface(a, b, c):
    """Constructors raise errors of the family, or type errors for what is no argument."""
    for call in (
        lambda: cmfsim.Tissue.isotropic(a, b),
        lambda: cmfsim.Tissue.transversely_isotropic(a, b, c, a),
        lambda: cmfsim.Tissue.from_stiffness(a),
        lambda: cmfsim.Tissue.preset("kim2010", a, b),
        lambda: cmfsim.Surface(a, b),
        lambda: cmfsim.Boundary(a, {"x": b}),
        lambda: cmfsim.Boundary(None, a, b, c),
    ):
        try:
            call()
        except (cmfsim.CmfsimError, TypeError):
            continue


@settings(max_examples=200)
@given(plan=st.one_of(rubbish, st.dictionaries(st.sampled_from(["bone", "x"]), rubbish)))
def test_rubbish_is_no_plan(plan):
    """A plan is refused, or the answer is finite."""
    nodes, tets = meshes.box((1, 1, 1))
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(1.0, 0.3))
    solver = cmfsim.StaticSolver(tensors, cmfsim.Boundary([0, 1, 2, 4], {"bone": [7]}))
    try:
        result = solver.solve(plan)
    except (cmfsim.BoundaryError, TypeError):
        return
    assert np.isfinite(result.displacements).all()


@given(points=npst.arrays(np.float64, (20, 3), elements=st.floats(-3, 3)))
def test_closest_points_equal_brute_force(points):
    """Against the distance to every triangle by sampling its plane, edges and corners."""
    vertices, triangles = meshes.icosphere(1, 1.0)
    surface = cmfsim.Surface(vertices, triangles)
    found, normals, at = surface.closest(points)
    distance = np.linalg.norm(points - found, axis=1)
    best = np.full(len(points), np.inf)
    for triangle in vertices[triangles]:
        best = np.minimum(best, brute_distance(points, triangle))
    np.testing.assert_allclose(distance, best, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=0, atol=1e-12)
    assert at.max() < len(triangles)


def brute_distance(points, triangle):
    """Distance to a triangle: its plane where the foot falls inside, else its three edges."""
    a, b, c = triangle
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n)
    height = (points - a) @ n
    foot = points - height[:, None] * n
    inside = np.ones(len(points), dtype=bool)
    edges = np.full(len(points), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.cross(q - p, foot - p) @ n >= 0.0
        t = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0)
        edges = np.minimum(edges, np.linalg.norm(points - (p + t[:, None] * (q - p)), axis=1))
    return np.where(inside, np.abs(height), edges)


@given(matrix=npst.arrays(np.float64, (4, 4), elements=st.floats(-10, 10)))
def test_only_rigid_matrices_are_taken(matrix):
    """A random matrix is no rigid motion: refused by planning and by the core alike."""
    with pytest.raises(cmfsim.BoundaryError):
        cmfsim.decompose_motion(matrix)
