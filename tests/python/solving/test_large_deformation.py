"""Large deformation by conjugate gradients, whose tangents share a multigrid hierarchy."""

import numpy as np
import pytest

import cmfsim
from meshes import box, plane

SIZE = (30.0, 24.0, 18.0)  # mm
FIRST = cmfsim.rigid_motion((0.0, 4.0, -3.0))
SECOND = cmfsim.rigid_motion((2.0, -3.0, 1.0))


def solve(scene, *motions):
    """The last solution of one solver under these motions of the top; a floor stays."""
    solver = cmfsim.scene_solver(scene)
    rest = dict.fromkeys(scene.segments, np.eye(4))
    return [solver.solve(rest | {"top": motion}) for motion in motions][-1]


def scene(*, slides, tolerance=1e-6, method="pcg"):
    """A block whose top moves; its bottom is fixed or slides on a floor, its one side is fixed."""
    nodes, tets = box((8, 6, 5), SIZE, jitter=0.15)
    low, high = nodes[:, 2] == 0.0, nodes[:, 2] == SIZE[2]
    side = (nodes[:, 0] == 0.0) & ~low & ~high
    segments = {"top": cmfsim.SegmentData(joined=np.flatnonzero(high))}
    fixed = side | low
    if slides:
        vertices, triangles = plane(80.0, 2)
        floor = cmfsim.SurfaceData(vertices, triangles)
        segments["floor"] = cmfsim.SegmentData(sliding=np.flatnonzero(low), contact=floor)
        fixed = side
    return cmfsim.Scene(
        nodes,
        tets,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
        fixed=np.flatnonzero(fixed),
        segments=segments,
        plan=dict.fromkeys(segments, np.eye(4)),
        options=cmfsim.SolverOptions(kinematics="hyperelastic", method=method, tolerance=tolerance),
    )


@pytest.mark.parametrize("slides", [False, True], ids=["joined", "sliding"])
def test_an_answer_does_not_depend_on_the_plans_before_it(slides):
    after = solve(scene(slides=slides), FIRST, SECOND)
    alone = solve(scene(slides=slides), SECOND)
    np.testing.assert_array_equal(after.displacements, alone.displacements)


@pytest.mark.parametrize("slides", [False, True], ids=["joined", "sliding"])
def test_conjugate_gradients_agree_with_factorisations(slides):
    found = solve(scene(slides=slides), FIRST)
    exact = solve(scene(slides=slides, method="cholesky"), FIRST)
    off = np.linalg.norm(found.displacements - exact.displacements, axis=1).max()
    assert off < 1e-4, off
    assert np.linalg.norm(exact.displacements, axis=1).max() > 4.9


@pytest.mark.parametrize("tolerance", [0.2, 0.02, 1e-3])
def test_the_error_is_within_the_tolerance(tolerance):
    rough = solve(scene(slides=False, tolerance=tolerance), FIRST)
    exact = solve(scene(slides=False, method="cholesky"), FIRST)
    off = np.linalg.norm(rough.displacements - exact.displacements, axis=1).max()
    assert off <= rough.error_estimate <= tolerance * 5.01, (off, rough.error_estimate)


@pytest.mark.parametrize("tolerance", [0.1, 0.01, 1e-3])
@pytest.mark.parametrize("method", ["pcg", "cholesky"])
def test_the_estimate_holds_where_stiff_bands_turn_on_soft_ones(method, tolerance):
    # A step of Newton's method is then no bound of the error: longer ones follow it.
    rough = stretched_bar(method=method, tolerance=tolerance)
    exact = stretched_bar(method="cholesky", tolerance=1e-9)
    off = np.linalg.norm(rough.displacements - exact.displacements, axis=1).max()
    assert off <= rough.error_estimate <= tolerance * 16.0, (off, rough.error_estimate)


def stretched_bar(*, method, tolerance):
    """A bar with bands 1e5 times as stiff as those between; one end is fixed, the other turned."""
    length, width = 64.0, 12.0  # mm
    nodes, tets = box((16, 4, 4), (length, width, width), jitter=0.15)
    band = np.floor(nodes[tets].mean(axis=1)[:, 0] / 8.0)
    bar = cmfsim.Scene(
        nodes,
        tets,
        tissue=cmfsim.TissueData(
            "isotropic", young=np.where(band % 2 == 1, 300.0, 0.003), poisson=0.45
        ),
        fixed=np.flatnonzero(nodes[:, 0] == 0.0),
        segments={"top": cmfsim.SegmentData(joined=np.flatnonzero(nodes[:, 0] == length))},
        plan={"top": np.eye(4)},
        options=cmfsim.SolverOptions(kinematics="hyperelastic", method=method, tolerance=tolerance),
    )
    end = (length, 0.5 * width, 0.5 * width)
    return solve(bar, cmfsim.rigid_motion((4.0, 6.0, 0.0), 20.0, (0.0, 0.0, 1.0), end))
