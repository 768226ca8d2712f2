"""Fibre directions: the phantom's known courses, its boxes, and muscles of a real atlas."""

from functools import cache

import numpy as np
import pytest

import cmfsim
from benches.scenes.angles import angle_of_lines

# Median angle between boxes and true fibres over the volume of a muscle, degrees, and its P95, as
# measured on the phantom and rounded up. Bent ends, converging lines and thin rings are worse.
STRAPS = {
    "zygomaticus_minor_L": (3.0, 5.0),
    "risorius_L": (3.0, 5.0),
    "depressor_labii_inferioris_L": (3.0, 6.0),
    "levator_labii_superioris_L": (3.5, 7.0),
}


@cache
def head():
    return cmfsim.make_head()


def core_surface(data):
    return cmfsim.Surface(data.vertices, data.triangles)


def inside(surface, count=1500):
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    points = np.random.default_rng(0).uniform(low, high, (20 * count, 3))
    return points[surface.winding_number(points) > 0.5][:count]


def test_true_fibres_are_the_tangents_of_the_lines_for_every_muscle():
    """On a line of its own a muscle's fibre is the derivative by arc length (numpy.gradient)."""
    for name, muscle in head().muscles.items():
        for i, line in enumerate(muscle.course):
            if np.allclose(line[0], line[-1]):
                continue
            step = np.linalg.norm(np.diff(line, axis=0), axis=1)
            place = np.concatenate([[0.0], np.cumsum(step)])
            tangent = np.gradient(line, place, axis=0, edge_order=2)
            tangent /= np.linalg.norm(tangent, axis=1)[:, None]
            found = muscle.fibre(line)
            np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
            # Where another line comes nearer than 4 mm both have a say.
            others = [other for k, other in enumerate(muscle.course) if k != i]
            alone = np.ones(len(line), dtype=bool)
            for other in others:
                gap = np.linalg.norm(line[:, None] - other[None], axis=2).min(axis=1)
                alone &= gap > 4.0
            if alone.any():
                assert angle_of_lines(found, tangent)[alone].max() < (1.0 if others else 1e-5), name


def test_streamlines_of_the_true_fibres_run_from_origin_to_insertion():
    for name in ("zygomaticus_major_L", "levator_labii_superioris_R", "risorius_L", "procerus"):
        muscle = head().muscles[name]
        line = muscle.course[0]
        length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
        place, step = line[:1].copy(), length / 200
        for _ in range(200):
            half = place + 0.5 * step * muscle.fibre(place)
            place = place + step * muscle.fibre(half)
        assert np.linalg.norm(place[0] - line[-1]) < 0.01 * length, name


def test_lines_in_the_core_agree_with_the_phantom():
    """Two implementations of one definition: LAPACK here, a closed form in the core."""
    for name in ("temporalis_L", "orbicularis_oculi_R", "masseter_L"):
        muscle = head().muscles[name]
        plate = cmfsim.Surface([[0, 0, 0], [9, 0, 0], [0, 2, 0]], [[0, 1, 2]])
        fibres = cmfsim.MuscleFibres(plate, muscle.kind, course=muscle.course)
        lines = np.vstack(muscle.course)
        points = lines + np.random.default_rng(1).normal(scale=1.5, size=lines.shape)
        found, expected = fibres.directions(points), muscle.fibre(points)
        same = np.abs((found * expected).sum(axis=1))
        np.testing.assert_allclose(same, 1.0, atol=1e-9)


@pytest.mark.parametrize("name", sorted(STRAPS))
def test_boxes_of_a_strap_lie_along_its_known_course(name):
    pytest.importorskip("skimage")
    muscle = head().muscles[name]
    surface = core_surface(head().surface(name, 1.0))
    assert surface.is_closed
    assert surface.volume > 0.0
    fibres = cmfsim.MuscleFibres(surface, muscle.kind)
    points = inside(surface)
    off = angle_of_lines(fibres.directions(points), muscle.fibre(points))
    median, p95 = STRAPS[name]
    assert np.median(off) < median
    assert np.percentile(off, 95) < p95


def test_sheets_are_flagged_with_their_ratio():
    square = cmfsim.Surface([[0, 0, 0], [9, 0, 0], [9, 8, 0], [0, 8, 0]], [[0, 1, 2], [0, 2, 3]])
    strap = cmfsim.MuscleFibres(square)
    assert strap.is_sheet
    assert strap.sheet_ratio == pytest.approx(8.0 / 9.0, rel=0.1)
    assert not cmfsim.MuscleFibres(square, "fan").is_sheet
    assert cmfsim.MuscleFibres(square, "sheet").is_sheet
    line = [[0, 0, 0], [0, 8, 0]]
    known = cmfsim.MuscleFibres(square, "sheet", course=[line])
    assert not known.is_sheet
    np.testing.assert_allclose(np.abs(known.directions([[3.0, 3.0, 0.0]])), [[0, 1, 0]], atol=1e-12)


def test_boxes_are_arrays_that_hold_the_surface():
    muscle = core_surface(head().surface("zygomaticus_minor_R", 1.0))
    fibres = cmfsim.MuscleFibres(muscle, boxes=2)
    centres, axes, half_extents = fibres.boxes
    assert centres.shape == half_extents.shape == (2, 3)
    assert axes.shape == (2, 3, 3)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), [np.eye(3)] * 2, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)
    local = np.abs(np.einsum("bij,bvj->bvi", axes, muscle.vertices[None] - centres[:, None]))
    held = (local <= half_extents[:, None] + 1e-9).all(axis=2).any(axis=0)
    assert held.all()
    assert fibres.kind == "strap"
    assert fibres.course == []


def test_bad_input_is_named():
    plate = cmfsim.Surface([[0, 0, 0], [9, 0, 0], [0, 2, 0]], [[0, 1, 2]])
    for kind, boxes, course, text in (
        ("stripe", None, (), "stripe"),
        ("strap", 0, (), "boxes is 0: allowed is 1 to 64"),
        ("strap", -2, (), "boxes is -2"),
        ("strap", 65, (), "boxes is 65: allowed is 1 to 64"),
        ("sheet", 100_000, (), "boxes is 100000: allowed is 1 to 64"),
        ("fan", 10**30, (), "allowed is 1 to 64"),
        ("fan", -(10**5000), (), "allowed is 1 to 64"),
        ("strap", True, (), "boxes is True: a whole number is needed, 1 to 64"),
        ("strap", 2.0, (), "boxes is 2.0: a whole number is needed"),
        ("strap", "2", (), "boxes is '2': a whole number is needed"),
        ("ring", 2, (), "3 to 64"),
        ("strap", None, ([[0.0, 0.0, 0.0]],), "fibre line 0"),
        ("strap", None, ([[0.0, 0.0, float("nan")], [1.0, 0.0, 0.0]],), "course 0"),
    ):
        with pytest.raises(cmfsim.MeshError, match=text) as caught:
            cmfsim.MuscleFibres(plate, kind, boxes, course)
        assert isinstance(caught.value, ValueError)
    with pytest.raises(cmfsim.MeshError, match="points"):
        cmfsim.MuscleFibres(plate).directions([[0.0, 0.0]])


@pytest.mark.parametrize(
    ("boxes", "text"),
    [
        (0, "boxes of masseter_L is 0: allowed is 1 to 64"),
        (65, "boxes of masseter_L is 65: allowed is 1 to 64"),
        (1_000_000, "boxes of masseter_L is 1000000: allowed is 1 to 64"),
        (10**400, "more than 18 digits: allowed is 1 to 64"),
        (True, "is True: a whole number from 1 to 64"),
        (2.0, r"is 2\.0: a whole number from 1 to 64"),
        ("2", "is '2': a whole number from 1 to 64"),
    ],
)
def test_a_muscle_with_too_many_boxes_cannot_be_made(boxes, text):
    """However it is made: from a template, an archive, an atlas or by hand, it is this value."""
    plate = cmfsim.SurfaceData([[0, 0, 0], [9, 0, 0], [0, 2, 0]], [[0, 1, 2]])
    with pytest.raises(cmfsim.CaseError, match=text) as caught:
        cmfsim.MuscleSurface("masseter_L", "L", plate, boxes=boxes)
    assert isinstance(caught.value, ValueError)
    kept = cmfsim.MuscleSurface("masseter_L", "L", plate, boxes=np.int64(64)).boxes
    assert kept == 64
    assert type(kept) is int


def test_the_most_boxes_are_taken_from_every_kind():
    """What is allowed also works: 64 boxes of a small surface are made at once."""
    plate = cmfsim.Surface([[0, 0, 0], [9, 0, 0], [9, 2, 0], [0, 2, 0]], [[0, 1, 2], [0, 2, 3]])
    for kind in ("strap", "fan", "ring", "sheet"):
        fibres = cmfsim.MuscleFibres(plate, kind, 64)
        assert 1 <= len(fibres.boxes[0]) <= 64
        assert np.isfinite(fibres.directions([[1.0, 1.0, 0.0]])).all()
