"""The shape model fitted to the head that it is made of, in another pose and with an open mouth."""

import dataclasses

import numpy as np
import pytest

import cmfsim
from cmfsim.imaging.bones.model_seeds import bite_shifts
from cmfsim.registration.proposed.shape_model.fitted_head import LYING, fit_head
from cmfsim.registration.proposed.shape_model.model import HINGE
from cmfsim.registration.proposed.shape_model.samples import cut_planes, samples_of
from cmfsim.registration.proposed.template_head import average_head
from cmfsim.values.motion import rigid_motion
from cmfsim.values.surface_data import joined_surface

pytest.importorskip("scipy")

OPENING = rigid_motion(angle=14.0, axis=(1, 0, 0), centre=HINGE)
NOD = rigid_motion(angle=25.0, axis=(1, 0, 0), centre=(0, 0, 0))
# LPS.
TOWARDS = {
    "left": (1, 0, 0), "right": (-1, 0, 0), "front": (0, -1, 0), "back": (0, 1, 0),
    "up": (0, 0, 1), "down": (0, 0, -1),
}  # fmt: skip


def _moved(surface, matrix):
    vertices = np.asarray(surface.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    return dataclasses.replace(surface, vertices=vertices)


@pytest.fixture(scope="module")
def nodding():
    """The fit to undivided bone and skin that nod by 25° with the mouth open."""
    head = average_head()
    jaw = _moved(head.bones["mandible"], OPENING)
    bone = joined_surface([head.bones["cranium"], jaw])
    return fit_head(samples_of(_moved(bone, NOD), _moved(head.skin, NOD)))


def test_a_nodding_head_with_an_open_mouth_has_its_sites(nodding):
    for name, place in average_head().skull.items():
        if name in {"nasion", "suborbital_L", "supraglenoid_R", "menton", "infradentale"}:
            jaw = name in {"menton", "infradentale"}
            own = OPENING[:3, :3] @ place + OPENING[:3, 3] if jaw else place
            gap = nodding.sites["skull", name] - NOD[:3, :3] @ own
            assert np.linalg.norm(gap) < 2.0 * nodding.errors["skull", name], name


def test_a_head_that_lies_on_its_side_is_refused_with_how_it_lies():
    head = average_head()
    turn = rigid_motion(angle=90.0, axis=(0, 0, 1), centre=(0, 0, 0))
    bone = joined_surface([*head.bones.values()])
    with pytest.raises(cmfsim.LandmarkError, match="the head lies with its face to the left"):
        fit_head(samples_of(_moved(bone, turn), _moved(head.skin, turn)))


@pytest.mark.parametrize("how", LYING)
def test_a_head_is_turned_upright_from_where_its_name_says_that_it_lies(how):
    turn = LYING[how]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    lies = {"face": TOWARDS["front"], "vertex": TOWARDS["up"]}
    for part, upright in lies.items():
        for way in (way for way in TOWARDS if f"{part} to the {way}" in how):
            np.testing.assert_allclose(turn @ TOWARDS[way], upright, atol=1e-12)
    if "upside down" in how:
        np.testing.assert_allclose(turn @ TOWARDS["down"], TOWARDS["up"], atol=1e-12)
    else:
        assert "to the" in how


def _rows(tilt, gap=1.0):
    """Voxels of two rows of crowns: half as much bone in the bite, which leans by `tilt` mm."""
    along, heights = (
        axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 30), np.arange(-20, 20, 0.5))
    )
    bite = 2.0 + tilt * along
    return heights, along, np.where(np.abs(heights - bite) < gap, 0.5, 1.0)


@pytest.mark.parametrize("tilt", [-3.0, 0.0, 4.0])
def test_the_bite_is_the_layer_with_least_bone(tilt):
    front, end = bite_shifts(*_rows(tilt), (8.0, 8.0), 1.0)
    assert abs(front - 2.0) < 0.6
    assert abs(end - front - tilt) < 0.8


def test_the_bite_is_not_where_the_jaw_ends():
    """Below the crowns of a lower jaw cut off there is less bone than in a bite full of metal."""
    heights, along, dense = _rows(0.0)
    front, end = bite_shifts(heights, along, np.where(heights < -6.0, 0.1, dense), (8.0, 8.0), 1.0)
    assert abs(front - 2.0) < 0.6
    assert abs(end - 2.0) < 0.8


def test_rows_without_a_poorer_layer_show_no_bite():
    heights, along, dense = _rows(0.0)
    assert bite_shifts(heights, along, np.ones_like(dense), (8.0, 8.0), 1.0) is None


TILTED = np.array([0.3, 0.5, -1.0]) / np.linalg.norm([0.3, 0.5, -1.0])


def _ball(height, *, is_capped=False, radius=90.0, around=48):
    """A ball that ends at a height along a tilted direction, by rings about it."""
    side = np.cross(TILTED, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    turns = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    circle = np.outer(np.cos(turns), side) + np.outer(np.sin(turns), np.cross(TILTED, side))
    heights = -radius * np.cos(np.linspace(0.0, np.arccos(-height / radius), 40)[1:])
    rings = [np.sqrt(max(radius**2 - h**2, 0.0)) * circle + h * TILTED for h in heights]
    points = np.vstack([-radius * TILTED, *rings, heights[-1] * TILTED])
    one = np.arange(around)
    two = (one + 1) % around
    strips = [np.column_stack([np.zeros_like(one), 1 + two, 1 + one])]
    for k in range(len(rings) - 1):
        a, b = 1 + k * around, 1 + (k + 1) * around
        strips += [np.column_stack([a + one, a + two, b + one])]
        strips += [np.column_stack([a + two, b + two, b + one])]
    if is_capped:
        last = len(points) - 1 - around
        strips += [np.column_stack([last + one, last + two, np.full_like(one, len(points) - 1)])]
    return cmfsim.SurfaceData(points, np.vstack(strips).astype(np.uint32))


@pytest.mark.parametrize("is_capped", [True, False])
def test_a_surface_ends_at_an_oblique_plane(is_capped):
    (cut,) = cut_planes([_ball(50.0, is_capped=is_capped)])
    assert cut.name == "bottom"
    assert cut.normal @ TILTED == pytest.approx(1.0, abs=1e-6)
    assert cut.place == pytest.approx(50.0, abs=0.01)


def test_no_end_is_flat_that_is_round_or_beyond_which_another_surface_goes_on():
    assert cut_planes([_ball(89.999, is_capped=True)]) == ()
    assert cut_planes([_ball(50.0), _ball(79.999, radius=80.0)]) == ()
