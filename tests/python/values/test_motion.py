"""Rigid motions against Rodrigues' formula and their inverse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import cmfsim
from benches.scenes import meshes

numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers)
axes = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3)


@given(translation=vectors, angle=st.floats(-720, 720), axis=axes, centre=vectors)
def test_a_motion_turns_about_its_axis_through_its_centre(translation, angle, axis, centre):
    """X ↦ R (x − c) + c + t with R = exp(θ [k]×) (Rodrigues 1840)."""
    m = cmfsim.rigid_motion(translation, angle, axis, centre)
    r = m[:3, :3]
    np.testing.assert_allclose(r, meshes.rotation(axis, angle), rtol=0, atol=1e-12)
    np.testing.assert_allclose(r.T @ r, np.eye(3), rtol=0, atol=1e-14)
    centre_goes = m @ [*centre, 1.0]
    np.testing.assert_allclose(centre_goes[:3], np.add(centre, translation), rtol=0, atol=1e-10)
    assert m[3].tolist() == [0.0, 0.0, 0.0, 1.0]


@given(translation=vectors, angle=st.floats(0, 180), axis=axes, centre=vectors)
def test_decomposing_a_motion_gives_it_back(translation, angle, axis, centre):
    """rigid_motion(decompose_motion(M)) = M, at half turns too."""
    m = cmfsim.rigid_motion(translation, angle, axis, centre)
    found = cmfsim.decompose_motion(m, centre)
    assert 0.0 <= found.angle <= 180.0
    assert np.linalg.norm(found.axis) == pytest.approx(1.0, abs=1e-14)
    assert found.angle == pytest.approx(angle, abs=1e-6)
    again = cmfsim.rigid_motion(found.translation, found.angle, found.axis, found.centre)
    np.testing.assert_allclose(again, m, rtol=0, atol=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 1), (-1, 2, 1e-9)])
@pytest.mark.parametrize("angle", [179.0, 179.999999, 180.0])
def test_half_turns_decompose(axis, angle):
    """The antisymmetric part of R vanishes at 180°: the axis comes from its symmetric part."""
    m = cmfsim.rigid_motion(angle=angle, axis=axis)
    found = cmfsim.decompose_motion(m)
    assert found.angle == pytest.approx(angle, abs=1e-9)
    unit = np.array(axis) / np.linalg.norm(axis)
    assert abs(found.axis @ unit) == pytest.approx(1.0, abs=1e-12)
    if angle < 180.0:
        assert found.axis @ unit > 0.0


def test_right_hand_rule_and_exact_quarter_turns():
    """+90° about z takes x to y, without a trace of cos 90° = 6e-17."""
    for turns in range(-5, 6):
        m = cmfsim.rigid_motion(angle=90.0 * turns, axis=(0, 0, 3))
        expected = [[1, 0], [0, 1], [-1, 0], [0, -1]][turns % 4]
        assert m[:2, 0].tolist() == expected


@pytest.mark.parametrize("length", [1e-300, 1e-200, 1e200])
def test_any_length_of_axis_serves(length):
    """The axis is scaled before it is squared."""
    m = cmfsim.rigid_motion(angle=30, axis=(0, length, 0))
    np.testing.assert_allclose(m[:3, :3], meshes.rotation((0, 1, 0), 30), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        ({"angle": 10, "axis": (0, 0, 0)}, "axis is"),
        ({"axis": (0, 0)}, r"axis has shape \(2,\)"),
        ({"translation": 5}, r"translation has shape \(\)"),
        ({"translation": (0, np.nan, 0)}, r"translation\[1\] is nan"),
        ({"centre": ("a", "b", "c")}, "centre is not three numbers"),
        ({"angle": np.inf}, "angle is inf"),
        ({"angle": "ten"}, "angle is not a number"),
    ],
)
def test_bad_numbers_are_named(arguments, pattern):
    """Which argument, which entry, which value."""
    with pytest.raises(cmfsim.BoundaryError, match=pattern) as caught:
        cmfsim.rigid_motion(**arguments)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("matrix", "pattern"),
    [
        (np.eye(3), r"\(3, 3\)"),
        (np.diag([1, 1, 1, np.nan]), r"entry \[3\]\[3\] .* is NaN"),
        (np.diag([1, 1, 2, 1.0]), "not rigid"),
        (np.diag([1, 1, -1.0, 1]), "mirrors"),
        (np.diag([1, 1, 1, 2.0]), r"bottom row .* 2\.0\]: it must be 0 0 0 1"),
    ],
)
def test_what_is_no_rigid_motion_is_refused(matrix, pattern):
    """Shape, NaN, scale, mirror, last row."""
    with pytest.raises(cmfsim.BoundaryError, match=pattern):
        cmfsim.decompose_motion(matrix)


TURN = cmfsim.rigid_motion((1.0, -5.0, 0.5), 7.0, (0.3, 1.0, -0.2), (2.0, -30.0, 860.0))
NODES = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]


def scene_of(matrix):
    return cmfsim.Scene(
        nodes=NODES,
        tets=[[0, 1, 2, 3]],
        tissue=cmfsim.TissueData("isotropic", young=1.0, poisson=0.3),
        fixed=[0, 1, 2],
        segments={"jaw": cmfsim.SegmentData(joined=[3])},
        plan={"jaw": matrix},
    )


def solved(matrix):
    scene = scene_of(np.eye(4))
    return cmfsim.scene_solver(scene).solve({"jaw": matrix}).displacements[3]


@pytest.mark.parametrize("decimals", [4, 5, 6, 7])
def test_typed_rotations_are_the_same_exact_rotation_for_whoever_reads_them(decimals):
    """Scene, solver, surface, decomposition: one check lets them pass and makes them rigid."""
    typed = TURN.round(decimals)
    exact = cmfsim.rigid_matrix(typed)
    assert np.abs(exact[:3, :3].T @ exact[:3, :3] - np.eye(3)).max() < 2e-15
    assert np.linalg.det(exact[:3, :3]) > 0
    np.testing.assert_array_equal(exact[:, 3], typed[:, 3])
    # Polar factor: R sqrt(RᵀR)⁻¹, here from the singular vectors.
    u, _, v = np.linalg.svd(typed[:3, :3])
    np.testing.assert_allclose(exact[:3, :3], u @ v, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(scene_of(typed).plan["jaw"], exact)
    np.testing.assert_array_equal(solved(typed), solved(exact))
    found = cmfsim.decompose_motion(typed)
    assert found.angle == cmfsim.decompose_motion(exact).angle == pytest.approx(7.0, abs=0.01)
    surface = cmfsim.Surface(NODES[:3], [[0, 1, 2]])
    np.testing.assert_array_equal(
        surface.transformed(typed).vertices, surface.transformed(exact).vertices
    )


GATES = {
    "rigid_matrix": cmfsim.rigid_matrix,
    "decompose_motion": cmfsim.decompose_motion,
    "Scene": scene_of,
    "StaticSolver.solve": solved,
    "Surface.transformed": cmfsim.Surface(NODES[:3], [[0, 1, 2]]).transformed,
    "icp": lambda m: cmfsim.icp(np.eye(4)[:, :3], np.eye(4)[:, :3], initial=m),
    "achieved_plan": lambda m: cmfsim.achieved_plan(
        {"jaw": cmfsim.SurfaceData(NODES[:3], [[0, 1, 2]])}, {}, alignment=m
    ),
}


@pytest.mark.parametrize("gate", GATES)
@pytest.mark.parametrize(
    ("change", "figure"),
    [
        (np.diag([1.0002, 1.0002, 1.0002, 1]), r"4\.00\de-4.*lengths change by \+0\.020 % to"),
        (np.diag([1.1, 1, 1, 1]), r"2\.1\d\de-1.*to \+10\.000 %"),
        (np.diag([-1.0, 1, 1, 1]), "mirrors"),
    ],
)
def test_what_scales_or_mirrors_is_refused_at_every_gate_with_the_same_figure(gate, change, figure):
    """No gate is wider than another: nothing passes the first and fails at the last."""
    with pytest.raises(ValueError, match=figure):
        GATES[gate](TURN @ change)


@given(
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    st.floats(-400, 400),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: max(map(abs, a)) > 1e-3),
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_motions_in_numbers_pass_bit_for_bit(translation, angle, axis, centre):
    """What `rigid_motion` makes is exact already, and the check changes nothing."""
    matrix = cmfsim.rigid_motion(translation, angle, axis, centre)
    np.testing.assert_array_equal(cmfsim.rigid_matrix(matrix), matrix)


@pytest.mark.parametrize("name", ["translation", "centre", "axis"])
def test_numbers_of_many_digits_are_refused_by_name(name):
    """A TOML integer may have any number of digits; float() of one overflows."""
    with pytest.raises(cmfsim.BoundaryError, match=f"{name} holds a number of more than 308"):
        cmfsim.rigid_motion(**{name: (10**400, 0, 0)})
    with pytest.raises(cmfsim.BoundaryError, match="angle is a number of more than 308"):
        cmfsim.rigid_motion(angle=-(10**400))


def test_a_centre_that_overflows_is_refused():
    """Never NaN out: c + t − R c of 1e308 is no number."""
    with pytest.raises(cmfsim.BoundaryError, match="overflows"):
        cmfsim.rigid_motion(angle=180, axis=(0, 0, 1), centre=(1.7e308, 0, 0))
