"""Bones given before and after, vertex by vertex: parted where torn, quiet, paired, or refused."""

import re

import numpy as np
import pytest

import cmfsim
from benches.scenes.meshes import icosphere
from cmfsim.bones.motion import missing_patches, moves_as_one, sound_motion, torn_pieces
from cmfsim.bones.pairs.coherent_motion import coherent_motion
from head_case import ELLIPSOIDS, HeadCase

pytest.importorskip("meshio")
pytest.importorskip("scipy")

FORWARDS = cmfsim.rigid_motion((1.0, -5.0, 1.0), 3.0, (1, 0, 0), (3, -160, 1490))
# The lower part of the cranium moves, as a maxilla does below a Le Fort cut.
CUT = 1510.0
MOVED_PLAN = '[plan.mandible]\nmoved = "mandible_post.ply"\n'


def carried(points, matrix):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def ball(level=3, centre=(0.0, 0.0, 0.0), radius=30.0):
    vertices, triangles = icosphere(level, radius)
    return cmfsim.SurfaceData(vertices + np.asarray(centre), triangles)


def torn_ball(noise=0.0):
    """A ball whose lower half moved, with noise; which vertices are of that half."""
    surface = ball()
    vertices = np.asarray(surface.vertices)
    low = vertices[:, 2] < -3.0
    moved = np.where(low[:, None], carried(vertices, cmfsim.rigid_motion((0, -6, 1))), vertices)
    moved = moved + np.random.default_rng(1).normal(0.0, noise, moved.shape)
    return cmfsim.MovedSurface(surface, moved), low


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_bone_that_was_cut_and_moved_is_two_pieces(noise):
    """Every vertex is in the piece that moved as it did; torn triangles are in none."""
    motion, low = torn_ball(noise)
    pieces = torn_pieces(motion)
    assert len(pieces) == 2
    assert sorted(len(p.surface.vertices) for p in pieces) == sorted([low.sum(), (~low).sum()])
    total = sum(len(p.surface.triangles) for p in pieces)
    assert 0 < len(motion.surface.triangles) - total < 200
    for piece in pieces:
        heights = np.asarray(piece.surface.vertices)[:, 2]
        assert (heights < -3.0).all() or (heights >= -3.0).all()


def test_a_turned_a_bent_and_a_noisy_bone_stay_whole():
    surface = ball()
    vertices = np.asarray(surface.vertices)
    noise = np.random.default_rng(2).normal(0.0, 0.3, vertices.shape)
    bent = np.outer((vertices[:, 0] / 15.0) ** 2, [0.0, 1.0, 0.0])
    turn = cmfsim.rigid_motion(angle=15.0, axis=(1, 1, 0), translation=(10, 0, 0))
    for moved in (carried(vertices, turn), vertices + bent, vertices + noise, vertices):
        motion = cmfsim.MovedSurface(surface, moved)
        assert torn_pieces(motion) == (motion,)


def test_islands_stay_with_the_bone_unless_they_moved_otherwise():
    """A surface of two balls: alike they are one piece, apart two."""
    one, other = ball(2), ball(2, (0, 0, 70.0), 20.0)
    n = len(one.vertices)
    both = cmfsim.SurfaceData(
        np.concatenate([one.vertices, other.vertices]),
        np.concatenate([one.triangles, np.asarray(other.triangles) + n]),
    )
    vertices = np.asarray(both.vertices)
    turn = cmfsim.rigid_motion(angle=8.0, axis=(0, 1, 0))
    together = cmfsim.MovedSurface(both, carried(vertices, turn))
    assert len(torn_pieces(together)) == 1
    apart = carried(vertices, turn)
    apart[n:] += [0.0, 4.0, 0.0]
    first, second = torn_pieces(cmfsim.MovedSurface(both, apart))
    assert [len(first.surface.vertices), len(second.surface.vertices)] == [n, len(vertices) - n]
    assert not moves_as_one(first, second)


def test_noise_is_averaged_out_and_what_has_none_is_let_be():
    surface = ball(4)
    vertices = np.asarray(surface.vertices)
    there = carried(vertices, FORWARDS)
    exact = cmfsim.MovedSurface(surface, there)
    found = coherent_motion(exact)
    assert found.noise == 0.0
    np.testing.assert_allclose(found.motion.moved_vertices, there, atol=1e-6)
    noise = np.random.default_rng(3).normal(0.0, 0.2, vertices.shape)
    found = coherent_motion(cmfsim.MovedSurface(surface, there + noise))
    assert found.noise == pytest.approx(0.2 * np.sqrt(3.0), rel=0.1)
    left = np.linalg.norm(np.asarray(found.motion.moved_vertices) - there, axis=1)
    assert np.sqrt((left**2).mean()) < 0.35 * found.noise
    # A smooth bend of 1 mm, along the surface where it is largest: shells do not bend like that, so
    # it may be slip, and is kept but for two thirds there.
    bent = there + np.outer((vertices[:, 0] / 30.0) ** 2, [0.0, 1.0, 0.0])
    found = coherent_motion(cmfsim.MovedSurface(surface, bent))
    assert np.linalg.norm(np.asarray(found.motion.moved_vertices) - bent, axis=1).max() < 0.7


def test_triangles_without_area_are_left_out_on_both_sides():
    surface = ball(1)
    vertices = np.vstack([surface.vertices, surface.vertices[0], [[500.0, 0, 0]]])
    n = len(surface.vertices)
    triangles = np.vstack([surface.triangles, [[0, 1, n]], surface.triangles[:1]])
    moved = cmfsim.MovedSurface(cmfsim.SurfaceData(vertices, triangles), vertices + [0, 1, 0])
    sound = sound_motion(moved)
    assert len(sound.surface.triangles) == len(surface.triangles)
    assert len(sound.surface.vertices) == n
    flat = cmfsim.MovedSurface(surface, np.zeros_like(np.asarray(surface.vertices)))
    with pytest.raises(cmfsim.BoundaryError, match="no triangle of the moved surface"):
        sound_motion(flat)


@pytest.mark.parametrize("ending", ["stl", "ply", "vtp", "obj"])
def test_one_place_with_two_motions_is_two_vertices(ending, tmp_path):
    """A file that was cut open on the computer: STL has no vertices of its own to keep them."""
    before = cmfsim.SurfaceData(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 1, 0], [1, 0, 0]], [[0, 1, 2], [3, 4, 5]]
    )
    there = np.array(before.vertices)
    there[3:] += [0.0, 0.0, 2.0]
    paths = [tmp_path / f"{n}.{ending}" for n in ("before", "after")]
    cmfsim.write_surface(paths[0], before)
    cmfsim.write_surface(paths[1], cmfsim.SurfaceData(there, before.triangles))
    motion = cmfsim.read_moved_surface(*paths, units="cm", frame="RAS")
    corners = np.asarray(motion.moved_vertices)[np.asarray(motion.surface.triangles)]
    np.testing.assert_allclose(corners, there[np.asarray(before.triangles)] * [-10, -10, 10])


def moved_head(change=None, case=None):
    """The ellipsoids with the mandible before and after; `change` spoils the latter."""
    head = case or HeadCase(rounds=2)
    table = head.toml[head.toml.index("[plan.mandible]") : head.toml.index("[tissue]")]
    head.replace(table, MOVED_PLAN)
    mandible = head.surfaces["mandible"]
    vertices = carried(np.asarray(mandible.vertices), FORWARDS)
    triangles = np.asarray(mandible.triangles)
    if change is not None:
        vertices, triangles = change(vertices, triangles)
    head.surfaces["mandible_post"] = cmfsim.SurfaceData(vertices, triangles)
    return head


def shuffled(vertices, triangles):
    return np.random.default_rng(0).permutation(vertices), triangles


SPOILT = {
    "moved-remeshed": [
        (lambda v, t: (v, t[:-1]), "mandible has 319 triangles after and 320 before"),
        (lambda v, t: (v[:-1], t[(t < len(v) - 1).all(axis=1)]), "314 triangles after"),
        (lambda v, t: (v, t[::-1]), "numbers them differently"),
    ],
    "moved-not-paired": [
        (shuffled, "the edges of mandible have other directions"),
        (lambda v, t: (v * [-1.0, 1.0, 1.0], t), "left and right"),
    ],
    "moved-scaled": [
        (lambda v, t: (v / 1000.0, t), "0.001 times as large"),
        (lambda v, t: (v * 1.1, t), "1.1 times as large"),
        (lambda v, t: (np.zeros_like(v), t), "0 times as large"),
    ],
    "plan-still": [(None, "mandible moves by 0 mm at most")],
    "plan-far": [
        (lambda v, t: (v + [0.0, 80.0, 0.0], t), "register the post-operative scan"),
        (lambda v, t: (v * [-1.0, -1.0, 1.0], t), "one file is in LPS and the other in RAS"),
    ],
    "plan-through-skin": [
        (lambda v, t: (v - [0.0, 40.0, 0.0], t), "moved through the undeformed skin")
    ],
}


@pytest.mark.parametrize(
    ("code", "change", "words"),
    [(code, change, words) for code, cases in SPOILT.items() for change, words in cases],
)
def test_the_doctor_tells_what_is_wrong_with_a_moved_bone(code, change, words, tmp_path):
    head = moved_head(change)
    if code == "plan-still":
        head.surfaces["mandible_post"] = head.surfaces["mandible"]
    findings = cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path)))
    found = {f.code: f for f in findings if f.code.startswith(("moved", "plan"))}
    # A bone that moves far may pass through others.
    assert code in found
    assert set(found) <= {code, "plan-far", "plan-through-bone"}
    text = " ".join([found[code].what, found[code].why, found[code].fix])
    assert words in text
    assert found[code].where.startswith("case.toml:")
    assert found[code].fix


def test_the_doctor_says_nothing_of_a_sound_motion_and_warns_where_all_moves(tmp_path):
    head = moved_head()
    head.surfaces["mandible_post"] = cmfsim.SurfaceData(
        np.asarray(head.surfaces["mandible"].vertices) + [0.0, -5.0, 0.0],
        head.surfaces["mandible"].triangles,
    )
    quiet = [f.code for f in cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path)))]
    assert not [code for code in quiet if code.startswith(("moved", "plan"))]
    head.surfaces["cranium_post"] = cmfsim.SurfaceData(
        np.asarray(head.surfaces["cranium"].vertices) + [0.0, 6.0, 0.0],
        head.surfaces["cranium"].triangles,
    )
    head.toml += '[plan.cranium]\nmoved = "cranium_post.ply"\n'
    warned = [f.code for f in cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path)))]
    assert "moved-all" in warned


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[plan.mandible]", "[plan.chin]", "for bones that [surfaces.bones] names"),
        ('moved = "m', 'angle = 3\nmoved = "m', "angle is unknown"),
        ('"mandible_post.ply"', "3", "plan.mandible.moved is 3: a text"),
    ],
)
def test_moved_is_checked_where_the_case_is_read(old, new, words, tmp_path):
    head = moved_head()
    head.replace(old, new)
    with pytest.raises(cmfsim.CaseError, match=re.escape(words)) as caught:
        cmfsim.Case.load(head.write(tmp_path))
    assert str(caught.value).startswith("case.toml:")


def test_a_skull_that_moved_in_part_carries_the_tissue_in_part(tmp_path):
    """Cranium as one surface, torn at a cut; both bones noisy; skin open at the neck."""
    head = moved_head(
        lambda v, t: (v + np.random.default_rng(4).normal(0, 0.1, v.shape), t), HeadCase(rounds=3)
    )
    cranium = head.surfaces["cranium"]
    vertices = np.asarray(cranium.vertices)
    low = vertices[:, 2] < CUT
    there = np.where(low[:, None], carried(vertices, FORWARDS), vertices)
    head.surfaces["cranium_post"] = cmfsim.SurfaceData(there, cranium.triangles)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 14.0")
    head.toml += '[plan.cranium]\nmoved = "cranium_post.ply"\n'
    neck = ELLIPSOIDS["skin"][0][2] - 100.0
    head.change("skin", triangles=lambda t: t[_above(head.surfaces["skin"], t, neck)])
    case = cmfsim.Case.load(head.write(tmp_path))
    prediction = cmfsim.predict(case, model="H", check=False)
    plan = prediction.summary["plan"]
    assert list(plan) == ["cranium", "cranium_2", "mandible"]
    assert plan["cranium"]["largest"] == 0.0
    np.testing.assert_allclose(plan["cranium_2"]["angle"], 3.0, atol=0.01)
    np.testing.assert_allclose(plan["mandible"]["angle"], 3.0, atol=0.3)
    codes = [finding.code for finding in prediction.findings]
    assert "motion-pieces" in codes
    # Noise is no change of shape: the jaw moves rigidly.
    assert np.shape(prediction.scene.plan["mandible"]) == (4, 4)
    moved = np.asarray(prediction.result.displacements)
    nodes = np.asarray(prediction.scene.nodes)
    joined = np.asarray(prediction.scene.segments["cranium_2"].joined)
    np.testing.assert_allclose(
        moved[joined], carried(nodes[joined], FORWARDS) - nodes[joined], atol=1e-9
    )
    assert np.abs(moved[np.asarray(prediction.scene.segments["cranium"].joined)]).max() < 1e-12
    assert np.linalg.norm(prediction.skin_displacements, axis=1).max() < 9.0


def _above(surface, triangles, height):
    return (np.asarray(surface.vertices)[triangles][:, :, 2] > height).all(axis=1)


# Bone that was removed.


def spined_ball(level=4):
    """A ball with a spine in front, as the maxilla has below the nose; which vertices are of it."""
    vertices, triangles = icosphere(level, 30.0)
    out = vertices / 30.0
    spine = np.exp(-(((out[:, 0] ** 2 + out[:, 2] ** 2) / 0.1**2) ** 2)) * (out[:, 1] < 0)
    grown = vertices + 8.0 * spine[:, None] * [0.0, -1.0, 0.0]
    return cmfsim.SurfaceData(grown, triangles), vertices, spine


def test_a_trimmed_spine_follows_the_bone_and_does_not_pull_back():
    """The spine is cut to the level of the bone round it, and the bone moves 5 mm forwards."""
    before, trimmed, spine = spined_ball()
    # As a surface drawn onto the bone after lies: the spine's vertices inside the bone before.
    after = carried(trimmed - 1.0 * spine[:, None] * [0, -1, 0], FORWARDS)
    motion = cmfsim.MovedSurface(before, after)
    found = coherent_motion(motion)
    kept, (patch,) = found.motion, found.removed
    here = np.asarray(before.vertices)
    wrong = np.linalg.norm(after - carried(here, FORWARDS), axis=1)
    left = np.linalg.norm(np.asarray(kept.moved_vertices) - carried(here, FORWARDS), axis=1)
    assert wrong.max() == pytest.approx(9.0, abs=0.2)
    assert left.max() < 0.8
    assert patch.depth == pytest.approx(9.0, abs=0.2)
    assert patch.place[1] == pytest.approx(-38.0, abs=0.5)
    assert 20.0 < patch.area < 400.0


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_burred_patch_is_found_under_noise(noise):
    """A cap of 11 mm radius is ground flat, 2 mm deep at its middle."""
    surface = ball(4)
    vertices = np.asarray(surface.vertices)
    flat = vertices.copy()
    flat[:, 1] = np.maximum(flat[:, 1], -28.0)
    there = carried(flat, FORWARDS)
    there = there + np.random.default_rng(5).normal(0.0, noise, there.shape)
    found = coherent_motion(cmfsim.MovedSurface(surface, there))
    kept, patches = found.motion, found.removed
    assert len(patches) >= 1
    assert patches[0].depth == pytest.approx(2.0, abs=3 * noise + 0.1)
    left = np.linalg.norm(np.asarray(kept.moved_vertices) - carried(vertices, FORWARDS), axis=1)
    assert left[vertices[:, 1] < -29.5].max() < 0.3 + 3 * noise


def test_bone_that_moved_bent_grew_or_is_noisy_has_lost_nothing():
    surface = ball(4)
    vertices = np.asarray(surface.vertices)
    there = carried(vertices, FORWARDS)
    noise = np.random.default_rng(2).normal(0.0, 0.3, vertices.shape)
    bent = np.outer((vertices[:, 0] / 15.0) ** 2, [0.0, 1.0, 0.0])
    middle = there.mean(axis=0)
    added = there + 4.0 * spined_ball()[2][:, None] * [0.0, -1.0, 0.0]
    for moved in (there, there + noise, there + bent, middle + 0.955 * (there - middle), added):
        motion = cmfsim.MovedSurface(surface, moved)
        assert coherent_motion(motion).removed == ()


def test_bone_that_is_gone_is_reported_where_a_segment_is_laid_on_the_bone_after():
    """Other triangles: the motion is rigid, and says where the spine was."""
    before, trimmed, _ = spined_ball()
    fewer = ball(3)
    assert len(fewer.vertices) != len(trimmed)
    after = cmfsim.SurfaceData(carried(np.asarray(fewer.vertices), FORWARDS), fewer.triangles)
    core = cmfsim.Surface(after.vertices, after.triangles)
    (patch,) = missing_patches(before, core, carried(np.asarray(before.vertices), FORWARDS))
    assert patch.depth == pytest.approx(8.0, abs=0.3)
    assert patch.place[1] == pytest.approx(-38.0, abs=0.5)
    assert missing_patches(fewer, core, after.vertices) == ()


def test_a_trimmed_bone_of_a_case_is_reported_and_its_tissue_follows_the_bone(tmp_path):
    """The chin of the mandible is ground off: the nodes on it move with the mandible."""
    plain = HeadCase(rounds=3)
    mandible = plain.surfaces["mandible"]
    vertices = np.asarray(mandible.vertices)
    front = vertices[:, 1].min()
    ground = vertices.copy()
    ground[:, 1] = np.maximum(ground[:, 1], front + 3.0)
    head = moved_head(lambda _, t: (carried(ground, FORWARDS), t), plain)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 12.0")
    model = cmfsim.build_model(cmfsim.Case.load(head.write(tmp_path)), check=False)
    (finding,) = [f for f in model.findings if f.code == "bone-removed"]
    assert finding.severity == "warning"
    assert "mandible" in finding.what
    plan = model.scene.plan["mandible"]
    moved = np.asarray(plan.moved_vertices)
    whole = carried(np.asarray(plan.surface.vertices), FORWARDS)
    assert np.linalg.norm(moved - whole, axis=1).max() < 1.0


@pytest.mark.parametrize(
    ("ratio", "severity", "words"),
    [
        (0.955, "warning", "0.955 times as large after the operation as before"),
        (1.1, "warning", "not close to the ratio of any two units"),
        (10.0, "error", "mm read as cm"),
        (25.4, "error", "mm read as inch"),
        (0.001, "error", "m read as mm"),
        (2.54, "error", "cm read as inch"),
        (1 / 25.4, "error", "inch read as mm"),
    ],
)
def test_only_a_ratio_of_units_is_an_error_of_size(ratio, severity, words, tmp_path):
    """About its own middle: a bone that is 4.5 % smaller may be another scanner's."""

    def scaled(v, t):
        return v.mean(axis=0) + ratio * (v - v.mean(axis=0)), t

    findings = cmfsim.diagnose(cmfsim.Case.load(moved_head(scaled).write(tmp_path)))
    (found,) = [f for f in findings if f.code == "moved-scaled"]
    assert found.severity == severity
    assert words in found.what
