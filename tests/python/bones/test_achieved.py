"""The achieved plan: known motions of made and of real bones, by vertices and by closest points."""

import functools
import json

import numpy as np
import pytest

import cmfsim
import real_heads
from cmfsim.bones.achieved import motion_by_vertices
from pebbles import apart, joined, moved, pebble, without

MOTION = cmfsim.rigid_motion((1.0, -5.0, 2.0), 4.0, (1, 0.2, 0), (0, -30, 0))


def test_the_same_triangles_say_a_rigid_motion_at_once():
    bone = pebble()
    found = motion_by_vertices(bone, moved(bone, MOTION), centre=(0, -30, 0))
    np.testing.assert_allclose(found.matrix, MOTION, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.motion.translation, [1.0, -5.0, 2.0], rtol=0, atol=1e-9)
    assert found.motion.angle == pytest.approx(4.0, abs=1e-9)
    assert found.is_rigid
    assert found.worst < 1e-9
    assert found.plan is found.matrix


def test_the_same_triangles_say_when_a_motion_is_not_rigid():
    """A jaw that was bent: the plan is the moved surface, the residual what bending leaves."""
    bone = pebble()
    vertices = np.asarray(bone.vertices)
    bent = vertices + np.outer((vertices[:, 0] / 25.0) ** 2, [0.0, -1.0, 0.0])
    found = motion_by_vertices(bone, cmfsim.SurfaceData(bent, bone.triangles))
    assert not found.is_rigid
    assert isinstance(found.plan, cmfsim.MovedSurface)
    np.testing.assert_array_equal(found.plan.moved_vertices, bent)
    rest = np.linalg.norm(vertices @ found.matrix[:3, :3].T + found.matrix[:3, 3] - bent, axis=1)
    assert found.worst == pytest.approx(rest.max())
    assert found.rms == pytest.approx(np.sqrt((rest**2).mean()))


def scene(noise=0.0, hole=False):
    """Cranium and jaw before, and both as one bone after, of other triangles and in another frame.

    Returns segments before, bone after, and the motion that takes after's frame to before's.
    """
    cranium = [pebble(n, 1, (0, 40, 40)) for n in (4, 5)]
    jaw = [pebble(n, 2, (0, -30, -20)) for n in (4, 5)]
    after = moved(jaw[1], MOTION)
    if hole:
        after = without(after, np.asarray(after.vertices)[:, 0] < 12.0)
    bone = joined(cranium[1], after)
    rng = np.random.default_rng(5)
    bone = cmfsim.SurfaceData(
        np.asarray(bone.vertices) + rng.normal(0, noise, bone.vertices.shape), bone.triangles
    )
    frame = cmfsim.rigid_motion((15, -8, 5), 8, (1, 2, 3))
    return {"cranium": cranium[0], "jaw": jaw[0]}, moved(bone, np.linalg.inv(frame)), frame


@pytest.mark.parametrize(("noise", "hole", "limit"), [(0, False, 0.02), (0.1, True, 0.1)])
def test_segments_are_found_on_the_bone_of_another_scan(noise, hole, limit):
    """With noise and a fifth of the jaw gone; vertices of the coarser mesh lie on the finer."""
    segments, bone, frame = scene(noise, hole)
    found = cmfsim.achieved_plan(segments, bone, alignment=frame)
    centre = np.asarray(segments["jaw"].vertices).mean(axis=0)
    assert max(apart(found.motions["jaw"].matrix, MOTION, centre)) < limit
    assert max(apart(found.motions["cranium"].matrix, np.eye(4), (0, 40, 40))) < limit
    # All vertices but those over the hole have their partner.
    assert found.motions["cranium"].share > 0.9
    assert found.motions["jaw"].share > 0.5
    assert "jaw" in found.text()
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False)) == found.as_dict()
    assert found.plan["jaw"] is found.motions["jaw"].matrix


def test_a_reference_takes_the_error_of_the_alignment_off():
    """The volumes were laid 1 mm and 1° off: all motions would be, without the cranium's."""
    segments, bone, frame = scene()
    off = cmfsim.rigid_motion((0.8, -0.5, 0.3), 1.0, (0, 1, 1)) @ frame
    centre = np.asarray(segments["jaw"].vertices).mean(axis=0)
    wrong = cmfsim.achieved_plan(segments, bone, alignment=off)
    assert max(apart(wrong.motions["jaw"].matrix, MOTION, centre)) > 0.5
    right = cmfsim.achieved_plan(segments, bone, alignment=off, reference="cranium")
    assert max(apart(right.motions["jaw"].matrix, MOTION, centre)) < 0.02
    assert max(apart(right.alignment, frame, centre)) < 0.05
    assert right.correction.angle == pytest.approx(1.0, abs=0.02)
    assert wrong.correction is None


def test_surfaces_of_the_same_triangles_need_no_search():
    """Segment by segment, in another frame: exact, whatever the size of the motion."""
    segments, _, frame = scene()
    far = cmfsim.rigid_motion((40, 30, -20), 70, (1, 1, 1))
    true = {"cranium": np.eye(4), "jaw": far}
    back = np.linalg.inv(frame)
    after = {n: moved(s, back @ true[n]) for n, s in segments.items()}
    found = cmfsim.achieved_plan(
        segments, after, alignment=frame, reference="cranium", centres={"jaw": (0, -30, -20)}
    )
    for name, matrix in true.items():
        assert found.motions[name].method == "vertices"
        np.testing.assert_allclose(found.motions[name].matrix, matrix, rtol=0, atol=1e-9)
    assert found.motions["jaw"].motion.centre.tolist() == [0, -30, -20]


@functools.cache
def real_bone():
    """The atlas' segments after a bimaxillary operation, as one surface of other triangles."""
    pv = pytest.importorskip("pyvista")
    names = ("cranium", "mandible")
    segments = {n: real_heads.read_ply("atlas_head", n) for n in names}
    surfaces = []
    for name in names:
        matrix = MANDIBLE if name == "mandible" else np.eye(4)
        after = moved(segments[name], matrix)
        mesh = pv.PolyData.from_regular_faces(
            np.asarray(after.vertices), np.asarray(after.triangles).astype(np.int64)
        ).decimate(0.4)
        surfaces.append(cmfsim.SurfaceData(np.asarray(mesh.points, float), mesh.regular_faces))
    return segments, joined(*surfaces)


MANDIBLE = cmfsim.rigid_motion((1.5, -6.0, 1.0), 3.0, (1, 0, 0.3), (0, -130, 1470))


def test_the_real_mandible_is_found_where_it_was_taken():
    """Table 2's numbers, to 0.1 mm and 0.1°, from a decimated bone that shares no triangle."""
    segments, bone = real_bone()
    found = cmfsim.achieved_plan(
        {"mandible": segments["mandible"]}, bone, centres={"mandible": (0, -130, 1470)}
    )
    motion = found.motions["mandible"]
    assert max(apart(motion.matrix, MANDIBLE, (0, -150, 1460))) < 0.1
    np.testing.assert_allclose(motion.motion.translation, [1.5, -6.0, 1.0], rtol=0, atol=0.1)
    assert motion.motion.angle == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        ({"segments": {}}, "segments is empty"),
        ({"postoperative": {"cranium": None}}, "no post-operative surface: jaw"),
        ({"reference": "skull"}, "use one of cranium, jaw"),
        ({"centres": {"chin": (0, 0, 0)}}, "use one of cranium, jaw"),
        ({"alignment": np.diag([2.0, 2, 2, 1])}, "not rigid"),
    ],
)
def test_bad_plans_are_named(arguments, pattern):
    segments = {"cranium": pebble(1, 1), "jaw": pebble(1, 2)}
    given = {"segments": segments, "postoperative": pebble(2, 1), **arguments}
    with pytest.raises(cmfsim.CmfsimError, match=pattern) as caught:
        cmfsim.achieved_plan(given.pop("segments"), given.pop("postoperative"), **given)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        ({"trim": 1.0}, "trim is 1"),
        ({"reach": -1.0}, "reach is -1"),
        ({"max_angle": 0.0}, "max_angle is 0"),
    ],
)
def test_bad_options_are_named(options, pattern):
    with pytest.raises(cmfsim.CmfsimError, match=pattern):
        cmfsim.MatchOptions(**options)


def test_other_triangles_are_refused():
    with pytest.raises(
        cmfsim.RegistrationError, match="different triangles: 80 on 42 vertices before"
    ):
        motion_by_vertices(pebble(1), pebble(2))


def test_a_segment_that_is_not_there_is_an_error(monkeypatch):
    """Another bone in its place fits badly, and says how badly; so does one cut differently."""
    monkeypatch.setattr("cmfsim.bones.pairs.coherent_motion.MAX_RMS", 0.1)
    with pytest.raises(cmfsim.RegistrationError, match=r"segment 'jaw' does not fit .* mm rms"):
        cmfsim.achieved_plan({"jaw": pebble(3, 2)}, pebble(4, 1))
    scrap = without(pebble(4, 2), np.asarray(pebble(4, 2).vertices)[:, 0] > 20.0)
    with pytest.raises(cmfsim.RegistrationError, match="segment 'jaw'"):
        cmfsim.achieved_plan({"jaw": pebble(3, 2)}, scrap)


# Pieces that the fit leaves out.

FRONT = -10.0


def jaw_after(chin="still", noise=0.0):
    """A jaw before, and after: its front went with it, was advanced, or was removed."""
    before, fine = pebble(4, 2), pebble(5, 2)
    vertices = np.array(fine.vertices)
    front = vertices[:, 1] < FRONT
    if chin == "advanced":
        vertices[front] += [0.0, -5.0, 0.0]
    elif chin == "resected":
        vertices[front, 1] = FRONT
    vertices += np.random.default_rng(3).normal(0.0, noise, vertices.shape)
    return before, moved(cmfsim.SurfaceData(vertices, fine.triangles), MOTION)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_sound_bone_has_no_stray_piece(noise):
    before, after = jaw_after(noise=noise)
    found = cmfsim.achieved_plan({"jaw": before}, after).motions["jaw"]
    assert found.stray == ()
    assert found.median <= found.p95 < 3.0 * noise + 0.1


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize(("chin", "has_bone"), [("advanced", True), ("resected", False)])
def test_a_piece_off_the_bone_is_named_with_area_place_and_distance(chin, has_bone, noise):
    """Motion of the rest unharmed; area against the triangles that went; place in front."""
    before, after = jaw_after(chin, noise)
    found = cmfsim.achieved_plan({"jaw": before}, after).motions["jaw"]
    assert apart(found.matrix, MOTION, (0, 0, 0))[0] < 0.3
    (patch,) = found.stray
    assert patch.has_bone == has_bone
    assert patch.place[1] < FRONT
    corners = np.asarray(before.vertices)[np.asarray(before.triangles)]
    gone = corners[(corners[:, :, 1] < FRONT).all(axis=1)]
    sides = gone[:, 1] - gone[:, 0], gone[:, 2] - gone[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(*sides), axis=1).sum()
    assert 0.4 * area < patch.area < 1.02 * area
    assert 2.0 < patch.distance < 8.0
    assert found.p95 > 1.5 > found.median
    assert json.loads(json.dumps(found.as_dict()))["stray"][0] == patch.as_dict()


def test_a_cut_face_is_not_bone_that_went(monkeypatch):
    """The jaw behind a cut is laid on the healed jaw: no scan shows the face between."""
    whole, after = jaw_after()
    vertices = np.asarray(whole.vertices)
    back, front = vertices.copy(), vertices.copy()
    back[:, 1] = np.maximum(vertices[:, 1], FRONT)
    front[:, 1] = np.minimum(vertices[:, 1], FRONT)
    rear, chin = (cmfsim.SurfaceData(v, whole.triangles) for v in (back, front))
    alone = cmfsim.achieved_plan({"rear": rear}, after).motions["rear"]
    assert alone.stray
    monkeypatch.setattr("cmfsim.bones.pairs.coherent_motion.LEAST_SHARE", 0.2)
    for known in (
        cmfsim.achieved_plan({"rear": rear}, after, beside=[chin]),
        cmfsim.achieved_plan({"rear": rear, "chin": chin}, after),
    ):
        assert known.motions["rear"].stray == ()


def test_the_real_bones_have_no_stray_piece():
    """Thin walls, sinuses and teeth of an atlas against its decimated copy."""
    segments, bone = real_bone()
    found = cmfsim.achieved_plan(segments, bone)
    assert [m.stray for m in found.motions.values()] == [(), ()]
