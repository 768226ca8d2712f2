"""Muscles moved into the tissue: room, volume, strain, mirror images, real heads."""

import dataclasses
import functools

import numpy as np
import pytest

import cmfsim
from cmfsim.muscles.fitting.room import Room, known_part
from cmfsim.muscles.fitting.solving import Lattice
from real_heads import anatomy as real_anatomy
from real_heads import landmarks as real_landmarks

MIRROR = np.array([-1.0, 1.0, 1.0])
# Landmarks of the cube that the small template is carried by.
CORNERS = {f"corner_{i}": corner for i, corner in enumerate(np.indices((2, 2, 2)).reshape(3, 8).T)}


def ellipsoid(centre, axes, n=24):
    """A closed surface, outward."""
    pv = pytest.importorskip("pyvista")
    sphere = pv.Sphere(radius=1.0, theta_resolution=n, phi_resolution=n)
    faces = sphere.regular_faces
    return cmfsim.SurfaceData(np.asarray(sphere.points, dtype=float) * axes + centre, faces)


def slab(thickness, spacing=1.0, size=60):
    """Bone below z = 0, skin at z = thickness in the middle, both cut off along x and y.

    The skin is a dome that falls by r² / 150 mm: a flat one would be where the data end.
    """
    height = (np.arange(-20, 41) * spacing).reshape(1, 1, -1)
    across = (np.arange(size) - 0.5 * size) * spacing
    dome = (across[:, None, None] ** 2 + across[None, :, None] ** 2) / 150.0
    origin = (across[0], across[0], height.min())
    bone = np.broadcast_to(-height, (size, size, height.size))

    def level(values):
        return cmfsim.ImageData(values.astype(np.float32), [spacing] * 3, origin)

    return cmfsim.Anatomy(level(thickness - dome - height), {"skull": level(bone)})


def carried(*surfaces, bone=-10.0):
    """Muscles that landmarks leave where they are, over a template's bone at a height."""
    plate = ellipsoid((0.0, 0.0, bone - 30.0), (900.0, 900.0, 30.0))
    muscles = tuple(
        cmfsim.MuscleSurface(f"muscle_{i}", "both", surface) for i, surface in enumerate(surfaces)
    )
    points = {name: 50.0 * (corner - 0.5) for name, corner in CORNERS.items()}
    template = cmfsim.MuscleTemplate(
        name="slab",
        muscles=muscles,
        skull=plate,
        landmarks=points,
        definitions=dict.fromkeys(points, "corner"),
        licence="none",
    )
    return template.morph(points)


def enclosed(surface):
    return cmfsim.Surface(surface.vertices, surface.triangles).volume


def test_a_muscle_in_bone_is_moved_out_with_its_volume():
    muscles = carried(ellipsoid((0.0, 0.0, 2.0), (14.0, 10.0, 4.0)))
    fit = cmfsim.fit_muscles(muscles, slab(15.0))
    heights = np.asarray(fit.musculature["muscle_0"].surface.vertices)[:, 2]
    # Two of the four mm above its lower end are lost to bone: it is moved up by about these.
    assert heights.min() > -0.5
    done = fit.muscles["muscle_0"]
    assert done.outside_before == pytest.approx(0.16, abs=0.04)  # a cap of a quarter of the height
    assert done.outside_after < 0.01
    before = enclosed(muscles["muscle_0"].surface)
    after = enclosed(fit.musculature["muscle_0"].surface)
    assert after == pytest.approx(before, rel=0.05)
    assert done.volume_change == pytest.approx(after / before - 1.0, abs=1e-9)


def test_a_muscle_outside_the_skin_is_moved_in():
    muscles = carried(ellipsoid((0.0, 0.0, 13.0), (14.0, 10.0, 4.0)))
    fit = cmfsim.fit_muscles(muscles, slab(14.0))
    assert np.asarray(fit.musculature["muscle_0"].surface.vertices)[:, 2].max() < 14.5
    assert fit.muscles["muscle_0"].outside_after < 0.01 < fit.muscles["muscle_0"].outside_before


def test_muscles_that_lie_right_stay():
    muscles = carried(ellipsoid((0.0, 0.0, 8.0), (14.0, 10.0, 4.0)))
    fit = cmfsim.fit_muscles(muscles, slab(16.0))
    assert fit.muscles["muscle_0"].largest_move < 1e-9
    assert not fit.helps


def test_a_muscle_thicker_than_its_tissue_is_thinned_and_reported():
    muscles = carried(ellipsoid((0.0, 0.0, 1.5), (14.0, 10.0, 5.0)))
    fit = cmfsim.fit_muscles(muscles, slab(3.0))
    done = fit.muscles["muscle_0"]
    assert done.outside_after > 0.15
    assert "muscle-does-not-fit" in {f.code for f in fit.findings}
    assert fit.stretches[0] > 0.3


def test_attachments_follow_their_bone():
    """The template's muscle touches its bone; the patient's bone lies 2 mm lower."""
    muscles = carried(ellipsoid((0.0, 0.0, 6.2), (14.0, 10.0, 4.0)), bone=2.0)
    fit = cmfsim.fit_muscles(muscles, slab(25.0))
    before = np.asarray(muscles["muscle_0"].surface.vertices)[:, 2].min()
    after = np.asarray(fit.musculature["muscle_0"].surface.vertices)[:, 2].min()
    assert before == pytest.approx(2.2)
    assert -0.3 < after < 1.2
    free = cmfsim.fit_muscles(carried(muscles["muscle_0"].surface), slab(25.0))
    assert free.muscles["muscle_0"].largest_move < 1e-9


def test_muscles_one_above_the_other_do_not_meet():
    """Only the lower one is in bone; one displacement for all moves the upper out of its way."""
    low = ellipsoid((0.0, 0.0, 0.0), (14.0, 10.0, 3.0))
    high = ellipsoid((0.0, 0.0, 6.2), (14.0, 10.0, 3.0))
    fit = cmfsim.fit_muscles(carried(low, high), slab(20.0))
    first, second = (np.asarray(m.surface.vertices) for m in fit.musculature)
    lower = cmfsim.Surface(first, low.triangles)
    assert np.abs(lower.winding_number(second)).max() < 0.5
    assert fit.stretches[0] > 0.3


def test_fibre_lines_move_with_their_muscle():
    surface = ellipsoid((0.0, 0.0, 1.0), (14.0, 10.0, 4.0))
    line = np.array([[-10.0, 0.0, 1.0], [0.0, 0.0, 1.0], [10.0, 0.0, 1.0]])
    muscles = carried(surface)
    muscle = dataclasses.replace(muscles.muscles[0], course=(line,))
    muscles = dataclasses.replace(muscles, muscles=(muscle,))
    fit = cmfsim.fit_muscles(muscles, slab(15.0))
    (moved,) = fit.musculature["muscle_0"].course
    shift = np.asarray(fit.musculature["muscle_0"].surface.vertices) - surface.vertices
    assert moved[1, 2] - line[1, 2] == pytest.approx(shift[:, 2].mean(), abs=0.5)
    assert moved[1, 2] - line[1, 2] > 1.0


def test_what_lies_beyond_the_end_of_the_data_is_not_moved_by_it():
    """The slab ends at x = 30 mm because the scan does, not because the head does."""
    low, high = known_part(slab(15.0).skin)
    assert (low[:2] == -29.0).all()
    assert (high[:2] == 28.0).all()
    assert high[2] == np.inf
    fit = cmfsim.fit_muscles(carried(ellipsoid((32.0, 0.0, 7.0), (9.0, 6.0, 3.0))), slab(15.0))
    done = fit.muscles["muscle_0"]
    assert done.unseen > 0.5
    assert done.largest_move < 1e-6
    assert done.outside_before == 0.0


def test_distances_to_the_room_are_those_of_the_slab():
    room = Room.of(slab(9.3), np.array([[-10.0, -10.0, 0.0], [10.0, 10.0, 9.0]]))
    heights = np.linspace(-3.0, 12.0, 61)
    points = np.column_stack([np.zeros((61, 2)), heights])
    exact = np.minimum(heights, 9.3 - heights)
    assert np.abs(room.tissue.sample(points) - exact).max() < 0.8
    near = np.abs(exact) < 1.0
    assert np.abs(room.tissue.sample(points) - exact)[near].max() < 0.3


def test_the_lattice_reproduces_affine_maps_and_its_derivative():
    rng = np.random.default_rng(0)
    points = rng.uniform(-30.0, 30.0, (200, 3))
    lattice = Lattice.round(points, 10.0)
    places = np.argwhere(lattice.number >= 0)
    # A coefficient lies in the middle of its spline: one and a half cells on, less the reach.
    middles = lattice.origin + lattice.spacing * (places - 0.5)
    a = rng.normal(size=(3, 3))
    coefficients = np.zeros((lattice.size, 3))
    coefficients[lattice.number[tuple(places.T)]] = middles @ a.T
    np.testing.assert_allclose(lattice.basis(points) @ coefficients, points @ a.T, atol=1e-10)
    for axis in range(3):
        slope = lattice.basis(points, axis) @ coefficients
        np.testing.assert_allclose(slope, np.tile(a[:, axis], (200, 1)), atol=1e-10)
    first, second = lattice.differences()
    assert np.abs(second @ coefficients).max() < 1e-9
    assert np.abs(first @ coefficients).max() > 0.1


@functools.cache
def synthetic():
    head = cmfsim.make_head(cmfsim.HeadParameters(scale=1.05, fat_thickness=-1.0))
    return head.anatomy(3.0), dict(head.skull_landmarks)


def test_mirrored_heads_get_mirrored_muscles():
    anatomy, landmarks = synthetic()
    template = cmfsim.MuscleTemplate.load("default")
    names = ("masseter_L", "masseter_R", "zygomaticus_major_L", "zygomaticus_major_R")
    muscles = template.morph(landmarks)
    muscles = dataclasses.replace(muscles, muscles=tuple(muscles[name] for name in names))
    muscles = dataclasses.replace(
        muscles,
        template=dataclasses.replace(
            template, muscles=tuple(m for m in template.muscles if m.name in names)
        ),
    )
    fit = cmfsim.fit_muscles(muscles, anatomy)
    for name in ("masseter", "zygomaticus_major"):
        left, right = (fit.muscles[f"{name}_{side}"] for side in "LR")
        assert left.largest_move == pytest.approx(right.largest_move, abs=0.15)
        assert left.volume_after == pytest.approx(right.volume_after, rel=0.01)


@pytest.mark.parametrize(("head", "most"), [("ct_phantom", 0.05), ("atlas_head", 0.04)])
def test_real_heads_get_muscles_in_their_tissue(head, most):
    template = cmfsim.MuscleTemplate.load("default")
    fit = cmfsim.fit_muscles(template.morph(real_landmarks(head)), real_anatomy(head))
    summary = fit.summary()
    assert summary["outside_before"] > 0.1
    assert summary["outside_after"] < most
    assert 0.5 < fit.stretches[0] < fit.stretches[1] < 1.6
    for name, muscle in fit.muscles.items():
        assert abs(muscle.volume_change) < 0.05, name
        assert muscle.outside_after < muscle.outside_before + 0.1, name
