"""Large deformation by conjugate gradients, whose tangents share a multigrid hierarchy."""

import numpy as np
import pytest

import cmfsim
from benches.scenes.meshes import box, plane

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


@pytest.mark.parametrize("method", ["pcg", "cholesky"])
@pytest.mark.parametrize("plan", [np.eye(4), cmfsim.rigid_motion((4.0, 6.0, 0.0))])
def test_stiff_bands_cost_no_steps_where_the_first_is_exact(method, plan):
    found = banded_bar(dict.fromkeys(["left", "right"], plan), method=method, tolerance=0.1)
    assert found.iterations == 2
    np.testing.assert_allclose(found.displacements - plan[:3, 3], 0.0, atol=1e-4)


def stretched_bar(*, method, tolerance):
    """The solution of a bar with one end in place and the other turned."""
    turned = cmfsim.rigid_motion((4.0, 6.0, 0.0), 20.0, (0.0, 0.0, 1.0), (64.0, 6.0, 6.0))
    return banded_bar({"left": np.eye(4), "right": turned}, method=method, tolerance=tolerance)


def banded_bar(plan, *, method, tolerance):
    """The solution of a bar with bands 1e5 times as stiff as the others; `plan` moves its ends."""
    length, width = 64.0, 12.0  # mm
    nodes, tets = box((16, 4, 4), (length, width, width), jitter=0.15)
    band = np.floor(nodes[tets].mean(axis=1)[:, 0] / 8.0)
    bar = cmfsim.Scene(
        nodes,
        tets,
        tissue=cmfsim.TissueData(
            "isotropic", young=np.where(band % 2 == 1, 300.0, 0.003), poisson=0.45
        ),
        segments={
            "left": cmfsim.SegmentData(joined=np.flatnonzero(nodes[:, 0] == 0.0)),
            "right": cmfsim.SegmentData(joined=np.flatnonzero(nodes[:, 0] == length)),
        },
        plan=plan,
        options=cmfsim.SolverOptions(kinematics="hyperelastic", method=method, tolerance=tolerance),
    )
    return cmfsim.scene_solver(bar).solve(plan)
