"""The seam between the lips: on faces whose mouth is known, and on heads with landmarks."""

import dataclasses

import numpy as np
import pytest

import cmfsim
import lip_head
import real_heads
from cmfsim.errors import CaseError
from cmfsim.meshing.lips import seam
from cmfsim.meshing.lips.crease import MouthLine

pytest.importorskip("scipy", reason="needs scipy (pip install '.[imaging]')")


def height_at(surface, points):
    """How far points lie above a surface, mm."""
    closest, normals, _ = cmfsim.Surface(surface.vertices, surface.triangles).closest(points)
    return np.einsum("na,na->n", points - closest, normals)


def from_the_line(seam):
    """How far the seam lies from the line that the face was made with, on its skin, mm."""
    vertices = np.asarray(seam.surface.vertices)
    x, y, z = vertices.T
    skin = (y < lip_head.FACE + x**2 / lip_head.CURVE + lip_head.CREASE) & (
        np.abs(x) < lip_head.MOUTH - 2.0
    )
    assert np.count_nonzero(skin) > 60
    return np.abs(z - lip_head.line(x))[skin]


def test_the_seam_follows_the_crease_between_closed_lips_to_half_a_millimetre():
    seam = cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES, lip_head.landmarks())
    assert seam.source == "crease"
    assert not seam.findings
    vertices = np.asarray(seam.surface.vertices)
    assert from_the_line(seam).max() < 0.5
    # From corner to corner, in front of the lips, and past the face of the teeth.
    corners = np.array(seam.summary["corners"])
    assert corners[:, 0] == pytest.approx([-lip_head.MOUTH, lip_head.MOUTH], abs=0.2)
    middle = vertices[np.abs(vertices[:, 0]) < 1.0, 1]
    assert middle.min() < lip_head.FACE - 0.5
    assert lip_head.TEETH + 6.0 < middle.max() < lip_head.TEETH + 12.0
    assert seam.summary["thickness"] == pytest.approx(8.0 - lip_head.CREASE, abs=1.5)
    assert seam.summary["gap"] == 0.0
    assert max(seam.summary["landmark_distances"].values()) < 3.2


def test_normals_of_the_seam_look_towards_the_upper_lip_and_its_triangles_do_not_overlap():
    seam = cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES).surface
    vertices, triangles = np.asarray(seam.vertices), np.asarray(seam.triangles)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    # Seen from above all triangles have one sense, so that no two rows cross.
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()


def test_corners_are_found_without_landmarks():
    seam = cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES)
    corners = np.array(seam.summary["corners"])
    assert corners[:, 0] == pytest.approx([-lip_head.MOUTH, lip_head.MOUTH], abs=3.0)
    assert seam.summary["landmark_distances"] == {}


def test_a_mirrored_face_has_a_mirrored_seam():
    seams = [
        cmfsim.lip_seam(lip_head.head(sign=sign), lip_head.ARCHES, lip_head.landmarks(sign))
        for sign in (1.0, -1.0)
    ]
    one, other = (np.asarray(seam.surface.vertices) for seam in seams)
    flipped = other * [-1.0, 1.0, 1.0]
    count = np.unique(np.round(one[:, 0], 6)).size
    assert count > 20
    order = [np.lexsort(np.round(places, 4).T) for places in (one, flipped)]
    assert np.abs(one[order[0]] - flipped[order[1]]).max() < 1e-3


def test_a_smooth_face_has_no_seam_and_the_finding_says_what_to_do():
    smooth = lip_head.head(crease=0.0)
    marks = lip_head.landmarks()
    del marks["labiale_superius"]
    for given in ({}, marks):
        seam = cmfsim.lip_seam(smooth, lip_head.ARCHES, given)
        assert seam.surface is None
        assert seam.source == "none"
        (finding,) = seam.findings
        assert (finding.severity, finding.code) == ("warning", "lip-seam-not-found")
        assert "labiale_superius" in finding.what
        assert "[lips]" in finding.fix
    without = cmfsim.lip_seam(lip_head.head(), {}, lip_head.landmarks())
    assert without.surface is None
    assert "arches" in without.findings[0].what


def test_landmarks_place_the_seam_where_the_skin_shows_nothing():
    seam = cmfsim.lip_seam(lip_head.head(crease=0.0), lip_head.ARCHES, lip_head.landmarks())
    assert seam.source == "landmarks"
    assert [f.code for f in seam.findings] == ["lip-seam-doubtful"]
    # A parabola leaves the straight line through its ends by a quarter of its rise.
    assert from_the_line(seam).max() < 0.3 * lip_head.SLANT * lip_head.MOUTH
    asked = cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES, lip_head.landmarks(), way="landmarks")
    assert asked.source == "landmarks"
    assert not asked.findings


def test_landmarks_far_from_the_crease_are_reported_and_do_not_move_it():
    marks = lip_head.landmarks()
    marks["cheilion_L"] = marks["cheilion_L"] + [0.0, 0.0, -11.0]
    marks["labiale_inferius"] = marks["labiale_inferius"] + [0.0, 0.0, 11.0]
    seam = cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES, marks)
    assert sorted(f.code for f in seam.findings) == ["lip-seam-doubtful", "lip-seam-doubtful"]
    assert from_the_line(seam).max() < 0.5


def test_wrong_input_is_refused():
    with pytest.raises(CaseError, match="way of the lip seam"):
        cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES, way="guess")
    with pytest.raises(CaseError, match="cheilion_L"):
        cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES, {"cheilion_L": [0.0, np.nan, 0.0]})


@pytest.fixture(scope="module")
def open_mouth():
    """The synthetic head with its lips apart, and its seam."""
    head = cmfsim.make_head(cmfsim.HeadParameters(lip_gap=2.0, bite_gap=2.5))
    anatomy = head.anatomy(1.5)
    segments = cmfsim.cut_bones(anatomy.bones, []).segments
    arches = cmfsim.dental_arches(anatomy, segments, head.skull_landmarks)
    return head, cmfsim.lip_seam(anatomy, arches.by_jaw, head.skin_landmarks)


def test_the_seam_is_the_middle_of_the_gap_that_was_drawn(open_mouth):
    """Against the formulas of the head, to 0.5 mm on a grid of 1.5 mm."""
    head, seam = open_mouth
    assert seam.source == "gap"
    assert seam.summary["gap"] == pytest.approx(2.0, abs=0.5)
    away = np.arange(-4.0, 4.0, 0.02)
    checked = []
    vertices = np.asarray(seam.surface.vertices)
    columns = vertices[:, None, :] + away[:, None] * [0.0, 0.0, 1.0]
    parts = np.array_split(columns, max(1, len(columns) // 25))
    levels = [head.skin_level(part.reshape(-1, 3)).reshape(len(part), -1) for part in parts]
    for inside in np.concatenate(levels) > 0.0:
        if inside[len(away) // 2]:
            continue
        solid = np.flatnonzero(inside)
        below, above = solid[solid < len(away) // 2], solid[solid > len(away) // 2]
        # In front the gap opens into the air before the lips.
        if len(below) and len(above) and away[above[0]] - away[below[-1]] < 3.0:
            checked.append(0.5 * (away[above[0]] + away[below[-1]]))
    assert len(checked) > 60
    assert np.abs(checked).max() < 0.5


def test_the_seam_of_the_open_mouth_ends_at_its_landmarks(open_mouth):
    head, seam = open_mouth
    corners = np.array(seam.summary["corners"])
    for name, corner in zip(("cheilion_R", "cheilion_L"), corners, strict=True):
        assert np.linalg.norm(corner - head.skin_landmarks[name]) < 2.0
    assert seam.summary["landmark_distances"]["stomion"] < 1.0


@pytest.mark.parametrize("name", real_heads.HEADS)
def test_the_crease_of_real_heads_runs_by_their_landmarks(name):
    """Landmarks are one operator's, right to some 2 mm."""
    anatomy = real_heads.anatomy(name)
    segments = cmfsim.cut_bones(anatomy.bones, []).segments
    arches = cmfsim.dental_arches(anatomy, segments, real_heads.landmarks(name)).by_jaw
    marks = real_heads.landmarks(name, "skin")
    seam = cmfsim.lip_seam(anatomy, arches, marks)
    assert seam.source == "crease"
    assert not seam.findings
    away = seam.summary["landmark_distances"]
    assert max(away["cheilion_L"], away["cheilion_R"]) < 3.5
    assert away["stomion"] < 2.5
    # Between the borders of the lips, with room on both sides.
    for label, sign in (("labiale_superius", -1.0), ("labiale_inferius", 1.0)):
        assert 4.0 < -sign * height_at(seam.surface, marks[label][None])[0] < 15.0
    alone = cmfsim.lip_seam(anatomy, arches)
    corners = np.array(alone.summary["corners"])
    for label, corner in zip(("cheilion_R", "cheilion_L"), corners, strict=True):
        assert np.linalg.norm(corner - marks[label]) < 6.0
    vertices = np.asarray(seam.surface.vertices)
    assert np.abs(height_at(alone.surface, vertices)).max() < 1.0


def test_a_mirrored_real_head_has_a_mirrored_seam():
    anatomy = real_heads.anatomy("ct_phantom")
    segments = cmfsim.cut_bones(anatomy.bones, []).segments
    arches = cmfsim.dental_arches(anatomy, segments, real_heads.landmarks("ct_phantom")).by_jaw
    flip = np.array([-1.0, 1.0, 1.0])

    def mirrored_image(image):
        origin = [-image.highest[0], *image.lowest[1:]]
        return cmfsim.ImageData(np.asarray(image.values)[::-1], image.spacing, origin)

    def mirrored_arch(arch):
        return dataclasses.replace(
            arch,
            tip=arch.tip * flip,
            left=arch.right * flip,
            right=arch.left * flip,
            out=arch.out * flip,
        )

    other = cmfsim.Anatomy(
        mirrored_image(anatomy.skin), {n: mirrored_image(b) for n, b in anatomy.bones.items()}
    )
    one = cmfsim.lip_seam(anatomy, arches).surface
    two = cmfsim.lip_seam(other, {jaw: mirrored_arch(arch) for jaw, arch in arches.items()}).surface
    assert len(one.vertices) == len(two.vertices)
    assert np.abs(height_at(one, np.asarray(two.vertices) * flip)).max() < 0.02


def test_a_line_that_runs_into_an_open_mouth_is_no_seam(monkeypatch):
    """Its rows would start behind the centre that they run to: no direction, and then NaN."""
    across = np.linspace(-22.0, 22.0, 45)
    into = MouthLine(across, np.where(np.abs(across) < 5.0, -35.0, 0.0), np.zeros_like(across))
    monkeypatch.setattr(seam, "_with_corners", lambda *_shown: into)
    found = cmfsim.lip_seam(lip_head.head(), lip_head.ARCHES, lip_head.landmarks())
    assert found.surface is None
    assert "runs 35 mm into an open mouth" in found.findings[0].what
