"""Landmarks matched by name and judged: sides, outliers, and those of real heads."""

import math

import numpy as np
import pytest
from scanner_points import gap, moved, random_landmarks

import cmfsim
import real_heads

HEAD = {
    "nasion": (0, -90, 40),
    "glabella": (1, -92, 52),
    "pogonion": (0, -85, -70),
    "menton": (-1, -75, -78),
    "gonion_L": (48, -10, -50),
    "gonion_R": (-47, -11, -51),
    "malar_L": (52, -60, 10),
    "malar_R": (-53, -59, 11),
}


def patient(**changes):
    """The head elsewhere, larger, bent a little."""
    matrix = cmfsim.rigid_motion((5, -150, 1500), 8, (1, 2, 3))
    points = 1.1 * np.array(list(HEAD.values()), dtype=float)
    points = moved(matrix, points) + np.random.default_rng(9).normal(0, 1.5, points.shape)
    return {**dict(zip(HEAD, points, strict=True)), **changes}


def test_landmarks_match_by_name_in_the_order_of_the_source():
    target = dict(reversed(patient().items()))
    target["Nasion "] = target.pop("nasion")
    target["ear"] = np.zeros(3)
    found = cmfsim.match_landmarks(HEAD, target)
    assert found.names == tuple(HEAD)
    assert gap(found.source, np.array(list(HEAD.values()), dtype=float)) == 0.0
    assert np.array_equal(found.target[0], target["Nasion "])
    assert {f.code for f in found.findings} == {"landmark-spelling", "landmark-extra"}
    assert gap(found.spline()(found.source), found.target) < 1e-9
    with pytest.raises(cmfsim.LandmarkError, match="1 landmarks are only in the target: ear"):
        cmfsim.match_landmarks(HEAD, target, strict=True)


def without(landmarks, *names):
    return {name: point for name, point in landmarks.items() if name not in names}


def test_missing_landmarks_are_named():
    with pytest.raises(cmfsim.LandmarkError, match=r"the target lacks 2 of 8 .*: menton, malar_R"):
        cmfsim.match_landmarks(HEAD, without(patient(), "menton", "malar_R"))
    with pytest.raises(cmfsim.LandmarkError, match="the source lacks 1 of 1 landmarks: ear"):
        cmfsim.match_landmarks(HEAD, patient(), required=["ear"])
    found = cmfsim.match_landmarks(HEAD, without(patient(), "menton"), required=["nasion"])
    assert "menton" not in found.names
    assert len(found.names) == 7


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (patient(NASION=(1, 2, 3)), "'nasion' and 'NASION', which differ only in spelling"),
        (patient(nasion=(1, 2)), "nasion of the target is at"),
        (patient(nasion=(1, 2, math.nan)), "three finite numbers"),
        (patient(nasion="here"), "three finite numbers"),
        (patient(**{"": (1, 2, 3)}), "label ''"),
        (
            patient(malar_L=patient()["malar_R"]),
            "malar_L and malar_R of the target lie in the same place",
        ),
        ({n: (*p[:2], 0.0) for n, p in patient().items()}, "of the target lie in one plane"),
        ({n: (p[0], 0.0, 0.0) for n, p in patient().items()}, "of the target lie in one line"),
        ([(1, 2, 3)], "a mapping of label"),
    ],
)
def test_unusable_landmark_sets_are_refused(target, message):
    with pytest.raises(cmfsim.LandmarkError, match=message) as caught:
        cmfsim.match_landmarks(HEAD, target)
    assert isinstance(caught.value, ValueError)


def test_too_few_landmarks_are_refused():
    few = dict(list(HEAD.items())[:3])
    with pytest.raises(cmfsim.LandmarkError, match="3 landmarks are shared"):
        cmfsim.match_landmarks(few, patient())


def swap(landmarks, *pairs):
    swapped = dict(landmarks)
    for pair in pairs:
        left, right = f"{pair}_L", f"{pair}_R"
        swapped[left], swapped[right] = landmarks[right], landmarks[left]
    return swapped


def test_swapped_sides_are_named():
    with pytest.raises(cmfsim.LandmarkError, match="swapped in the target in malar: "):
        cmfsim.match_landmarks(HEAD, swap(patient(), "malar"))
    with pytest.raises(cmfsim.LandmarkError, match="swapped in the source in gonion: "):
        cmfsim.match_landmarks(swap(HEAD, "gonion"), patient())
    with pytest.raises(cmfsim.LandmarkError, match=r"gonion, malar: .* mirrored"):
        cmfsim.match_landmarks(HEAD, swap(patient(), "malar", "gonion"))
    with pytest.raises(cmfsim.LandmarkError, match="mirrored"):
        cmfsim.match_landmarks(HEAD, {n: p * [-1, 1, 1] for n, p in patient().items()})
    turned = {
        n: moved(cmfsim.rigid_motion(angle=170, axis=(0, 0, 1)), p[None])[0]
        for n, p in swap(patient(), "malar").items()
    }
    with pytest.raises(cmfsim.LandmarkError, match="in malar"):
        cmfsim.match_landmarks(HEAD, turned)


def test_mirrored_sets_without_sides_are_found():
    source, _ = random_landmarks(8)
    names = [f"p{i}" for i in range(8)]
    with pytest.raises(cmfsim.LandmarkError, match="mirror image"):
        cmfsim.match_landmarks(
            dict(zip(names, source, strict=True)),
            dict(zip(names, source * [1, -1, 1] + 3, strict=True)),
        )


def test_leave_one_out_equals_n_splines():
    source, target = random_landmarks(15)
    found = cmfsim.leave_one_out(source, target)
    for k in range(15):
        rest = np.arange(15) != k
        warp = cmfsim.ThinPlateSpline(source[rest], target[rest])
        assert gap(warp(source[[k]]), found.predicted[[k]]) < 1e-9
        assert found.distances[k] == pytest.approx(gap(warp(source[[k]]), target[[k]]), abs=1e-9)
    assert not cmfsim.leave_one_out(source, source @ np.diag([1.1, 0.9, 1.0])).scores.any()


def test_leave_one_out_refuses_what_it_cannot_judge():
    source, target = random_landmarks(6)
    with pytest.raises(cmfsim.LandmarkError, match="5 are needed"):
        cmfsim.leave_one_out(source[:4], target[:4])
    with pytest.raises(cmfsim.LandmarkError, match="give each landmark its own name"):
        cmfsim.leave_one_out(source, target, ["a"] * 6)
    flat = source.copy()
    flat[1:, 2] = 1500.0
    with pytest.raises(cmfsim.LandmarkError, match="without 0 the other 5 landmarks are in one"):
        cmfsim.leave_one_out(flat, target)


def test_real_landmarks_match_and_agree():
    """Atlas to patient: all 32 match, no tissue folds, and no landmark stands out."""
    atlas, head = (dict(real_heads.landmarks(name)) for name in real_heads.HEADS)
    found = cmfsim.match_landmarks(atlas, head, strict=True)
    assert len(found.names) == 32
    assert found.findings == ()
    agreement = cmfsim.leave_one_out(found.source, found.target, found.names)
    assert agreement.outliers == ()
    assert str(agreement).splitlines()[1].startswith(agreement.worst)
    mandible = real_heads.core_surface("atlas_head", "mandible")
    assert found.spline().folds(mandible.vertices).count == 0


def test_a_real_landmark_15_mm_off_is_found():
    """In ten directions each: six of seven are ranked first, nine of ten among three."""
    atlas, head = (dict(real_heads.landmarks(name)) for name in real_heads.HEADS)
    found = cmfsim.match_landmarks(atlas, head)
    rng = np.random.default_rng(0)
    first = top = 0
    for k, name in enumerate(found.names):
        for _ in range(10):
            direction = rng.normal(size=3)
            target = found.target.copy()
            target[k] += 15.0 * direction / np.linalg.norm(direction)
            agreement = cmfsim.leave_one_out(found.source, target, found.names)
            first += agreement.worst == name
            top += name in agreement.ranking[:3]
    assert first >= 0.85 * 320
    assert top >= 0.9 * 320


def test_swapped_real_landmarks_are_named():
    """Each of the eleven pairs, and all of them."""
    atlas, head = (dict(real_heads.landmarks(name)) for name in real_heads.HEADS)
    pairs = [name[:-2] for name in atlas if name.endswith("_L")]
    assert len(pairs) == 11
    for pair in pairs:
        with pytest.raises(cmfsim.LandmarkError, match=f"swapped in the target in {pair}: "):
            cmfsim.match_landmarks(atlas, swap(head, pair))
    with pytest.raises(cmfsim.LandmarkError, match=r"and 5 more: .*mirrored"):
        cmfsim.match_landmarks(atlas, swap(head, *pairs))
