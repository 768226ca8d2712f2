"""Regions of real faces: those that jaws move, and those that nothing was operated on."""

import numpy as np
import pytest
from real_faces import face, moved

import cmfsim
import real_heads
from benches.accuracy.paired_motion import lighter
from cmfsim.evaluation.unmoved import compare_unmoved
from cmfsim.surfaces.depth import moved_outward, tissue_depth
from cmfsim.values.landmark_sites import SKIN_LANDMARKS


@pytest.mark.parametrize("head", real_heads.HEADS)
def test_regions_of_real_faces(head):
    """Landmarks lie in their regions; regions are apart, on the face, of both sides' size."""
    skin, marks = face(head, "skin")
    vertices = np.asarray(skin.vertices)
    parts = cmfsim.skin_regions(vertices, marks)
    inner = {n: p for n, p in parts.items() if n not in {"face", "lower face"}}
    assert sum(p.astype(int) for p in inner.values()).max() == 1
    for part in inner.values():
        assert part.sum() > 100
        assert not (part & ~parts["face"]).any()
    places = np.array([marks[n] for n in SKIN_LANDMARKS])
    of_marks = cmfsim.skin_regions(places, marks)
    homes = {
        "nose": ("pronasale", "alare_L", "alare_R"),
        "upper lip": ("labiale_superius",),
        "lower lip": ("labiale_inferius",),
        "chin": ("pogonion",),
        "face": ("exocanthion_L", "nasion", "pogonion"),
    }
    for region, names in homes.items():
        for name in names:
            assert of_marks[region][SKIN_LANDMARKS.index(name)], (region, name)
    # The lower face is the regions that jaws move, and no part of the eyes.
    lower = parts["lower face"]
    assert not (lower & ~parts["face"]).any()
    for eye in ("exocanthion_L", "endocanthion_R"):
        assert not of_marks["lower face"][SKIN_LANDMARKS.index(eye)]
        assert of_marks["face"][SKIN_LANDMARKS.index(eye)]
        near = np.linalg.norm(vertices - marks[eye], axis=1) < 6.0
        assert near.any()
        assert not (lower & near).any()
    for region in ("upper lip", "lower lip", "chin"):
        assert not (parts[region] & ~lower).any()
    # Nothing of the back of the head.
    depth = vertices[:, 1] - marks["pronasale"][1]
    assert depth[parts["face"]].max() < 90.0


def test_regions_follow_the_head_and_mirror_with_it():
    skin, marks = face()
    vertices = np.asarray(skin.vertices)[::7]
    parts = cmfsim.skin_regions(vertices, marks)
    turn = cmfsim.rigid_motion((30, -700, 55), 40, (1, 2, -3), (0, 0, 1500))
    go = lambda p: p @ turn[:3, :3].T + turn[:3, 3]  # noqa: E731
    turned = cmfsim.skin_regions(go(vertices), {n: go(p) for n, p in marks.items()})
    flip = np.array([-1.0, 1.0, 1.0])
    names = {
        n: n[:-1] + {"L": "R", "R": "L"}[n[-1]] if n[-2:] in ("_L", "_R") else n for n in marks
    }
    mirrored = cmfsim.skin_regions(vertices * flip, {names[n]: p * flip for n, p in marks.items()})
    other = {"left cheek": "right cheek", "right cheek": "left cheek"}
    for name, part in parts.items():
        # A vertex on an outline may change sides by rounding.
        assert np.count_nonzero(part != turned[name]) <= 2
        assert np.count_nonzero(part != mirrored[other.get(name, name)]) <= 2


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (lambda m: m.pop("nasion"), "lack nasion"),
        (lambda m: m.update(alare_L=m["alare_R"], alare_R=m["alare_L"]), "swap their names"),
        (lambda m: m.update(nasion=m["pogonion"] - [0, 0, 5]), "nasion lies below"),
        (lambda m: m.update(pronasale=m["pronasale"] + [0, 90, 0]), "behind the eyes"),
        (lambda m: m.update(nasion=[1, 2]), r"landmark nasion has shape \(2,\)"),
        (lambda m: [m.update({n: [0, 0, 0]}) for n in m], "do not outline a face"),
    ],
)
def test_landmarks_that_are_no_face_are_named(change, pattern):
    marks = {n: np.array(p) for n, p in face()[1].items()}
    change(marks)
    with pytest.raises(cmfsim.LandmarkError, match=pattern) as caught:
        cmfsim.skin_regions(np.zeros((1, 3)), marks)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("head", real_heads.HEADS)
def test_unmoved_regions_of_real_faces_are_forehead_and_temples(head):
    skin, marks = face(head, "skin")
    vertices = np.asarray(skin.vertices)
    parts = cmfsim.unmoved_regions(vertices, marks)
    assert set(parts) == {"forehead", "left temple", "right temple"}
    assert sum(p.astype(int) for p in parts.values()).max() == 1
    brow = max(marks[f"exocanthion_{side}"][2] for side in "LR")
    for name, part in parts.items():
        assert part.sum() > 50, name
        assert vertices[part][:, 2].min() > brow - 10.0, name
    assert vertices[parts["left temple"]][:, 0].min() > marks["exocanthion_L"][0]
    assert vertices[parts["right temple"]][:, 0].max() < marks["exocanthion_R"][0]
    of_face = cmfsim.skin_regions(vertices, marks)
    for name in ("lower face", "nose", "chin", "left cheek"):
        assert not any((part & of_face[name]).any() for part in parts.values())


def test_a_shift_of_the_scan_is_reported_where_nothing_was_operated_on():
    """A registration that is off by 1.5 mm to the front is not the error of any model."""
    skin, marks = face()
    vertices = np.asarray(skin.vertices)
    regions = cmfsim.unmoved_regions(vertices, marks)
    shift = np.array([0.0, -1.5, 0.0])
    found = compare_unmoved(skin, moved(skin, vertices + shift), regions, np.zeros(len(vertices)))
    assert -1.5 < found.regions["forehead"].signed_mean < -1.2
    # What a model moves counts as operated on, and where all of it does, nothing is stated.
    assert compare_unmoved(skin, skin, regions, np.full(len(vertices), 0.2)) is None


def test_one_change_of_thickness_is_recovered_among_outliers():
    rng = np.random.default_rng(3)
    depth = rng.uniform(3.0, 15.0, 500)
    signed = -0.08 * depth + rng.normal(0.0, 0.1, 500)
    signed[:60] += rng.uniform(3.0, 6.0, 60)  # hair
    found = cmfsim.fitted_thickness(signed, depth)
    assert found.share == pytest.approx(0.08, abs=0.006)
    # The least sum of sizes, by trying every share.
    tried = np.linspace(-0.2, 0.3, 5001)
    sums = np.abs(signed[:, None] + tried * depth[:, None]).sum(axis=0)
    assert found.share == pytest.approx(tried[sums.argmin()], abs=2e-4)
    assert found.after < found.before


def test_a_face_in_another_frame_is_no_change_of_thickness():
    with pytest.raises(cmfsim.CaseError, match="swelling does not explain this"):
        cmfsim.fitted_thickness(np.full(30, -9.0), np.full(30, 6.0))
    with pytest.raises(cmfsim.CaseError, match="2 signed distances and 1 depths"):
        cmfsim.fitted_thickness([1.0, 2.0], [1.0])


def test_thickening_the_real_face_is_undone_by_the_fit():
    """A face swollen by 6 % of its depth: fitted on forehead and temples, applied everywhere."""
    pytest.importorskip("pyvista")
    skin, marks = face("ct_phantom", "skin")
    skin = lighter(skin)
    bones = [real_heads.read_ply("ct_phantom", name) for name in ("cranium", "mandible")]
    vertices = np.asarray(skin.vertices)
    depth = tissue_depth(vertices, bones)
    core = cmfsim.Surface(vertices, skin.triangles)
    swollen = moved(skin, moved_outward(core, vertices, 0.06 * depth))
    regions = cmfsim.unmoved_regions(vertices, marks)
    unmoved = compare_unmoved(skin, swollen, regions, np.zeros(len(vertices)))
    found = cmfsim.fitted_thickness(unmoved.signed, depth[unmoved.vertices])
    assert found.share == pytest.approx(0.06, abs=0.006)
    sides = {"mask": "face", "method": "closest", "landmarks": (marks, marks)}
    bare = cmfsim.compare_models(skin, {"H": vertices}, swollen, **sides)
    fitted = cmfsim.compare_models(
        skin, {"H": vertices}, swollen, thickening=found.share * depth, **sides
    )
    assert fitted.statistics["H"].mean < 0.2 * bare.statistics["H"].mean
    assert fitted.statistics["no change"].mean < 0.2 * bare.statistics["no change"].mean
