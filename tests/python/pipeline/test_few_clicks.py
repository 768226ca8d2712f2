"""Few landmarks placed by hand decide what is what; none is believed that lies on another bone."""

import json
from dataclasses import replace

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes import ct_variants as variants
from cmfsim.bones.cuts.cutting import cut_bones
from cmfsim.bones.cuts.procedures import place_procedure
from cmfsim.cli import main
from cmfsim.pipeline import proposing
from cmfsim.pipeline.building.landmarks import (
    check_bones_of_sites,
    check_pieces,
    found_landmarks,
    is_to_be_found,
)
from cmfsim.pipeline.building.stages import BuildOptions, Stages
from cmfsim.pipeline.proposing import ProposedHead
from cmfsim.values.landmark_sites import is_lower_site
from cmfsim.values.proposed_landmarks import ProposedLandmarks, ProposedSite
from real_heads import data_folder, landmarks

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")

UPPER_ROW = ("supradentale", "supra_m2_L", "supra_m2_R")
LOWER_ROW = ("infradentale", "sub_m2_L", "sub_m2_R")
CHILD = 0.8
CASE = """format = "cmfsim-case"
version = 1
name = "child"

[image]
file = "ct.nrrd"

[mesh]
edge_length = 10.0

[landmarks]
skull = "skull.mrk.json"

[[osteotomies]]
procedure = "le_fort_1"

[plan.maxilla]
translation = [0, -4, 0]
"""


@pytest.fixture(scope="module")
def coarse():
    """The phantom's CT at about 4 mm."""
    image = cmfsim.read_image(data_folder() / "ct_phantom" / "ct.nii.gz")
    return variants.coarser(image, (4, 4, 2))


@pytest.fixture(scope="module")
def child(coarse):
    """A child's head with open mouth, in voxels of 3 mm."""
    return variants.scaled(variants.with_mouth_open(coarse, landmarks("ct_phantom")), CHILD)


def clicks(*names, size=CHILD):
    return {name: size * landmarks("ct_phantom")[name] for name in names}


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A case, for the places that messages name."""
    folder = tmp_path_factory.mktemp("case")
    (folder / "case.toml").write_text(CASE, encoding="utf-8")
    return cmfsim.Case.load(folder / "case.toml")


def parted(anatomy):
    return set(anatomy.bones) == {"cranium", "mandible"}


def test_three_clicks_on_the_upper_teeth_separate_the_jaws_of_an_open_mouth(child):
    sites = clicks(*UPPER_ROW)
    anatomy = cmfsim.segment_head(child, landmarks=sites)
    assert parted(anatomy)
    cranium, mandible = (anatomy.bones[name] for name in ("cranium", "mandible"))
    for name, point in sites.items():
        assert cranium.sample(point[None])[0] > mandible.sample(point[None])[0], name
    # The chin turned down and back with the mandible, and all of it lies below the upper row.
    z = mandible.axes()[2].ravel()[np.flatnonzero((mandible.values > 0.0).any(axis=(0, 1)))]
    assert z[0] < CHILD * landmarks("ct_phantom")["menton"][2] - 8.0
    volume = np.count_nonzero(mandible.values > 0.0) * np.prod(mandible.spacing) / 1000.0
    assert 25.0 < volume < 50.0


def test_three_clicks_leave_spine_and_skull_base_to_the_cranium_where_no_vault_is_shown(coarse):
    """A cone beam's field of view ends below the brow: nothing above the joints says cranium."""
    sites = landmarks("ct_phantom")
    face = variants.cropped(coarse, 2, high=float(sites["nasion"][2]))
    anatomy = cmfsim.segment_head(face, landmarks={name: sites[name] for name in UPPER_ROW})
    mandible = anatomy.bones["mandible"]
    y = mandible.axes()[1].ravel()
    inside = mandible.values > 0.0
    assert y[np.flatnonzero(inside.any(axis=(0, 2)))[-1]] < sites["supraglenoid_L"][1] + 12.0
    volume = np.count_nonzero(inside) * np.prod(mandible.spacing) / 1000.0
    assert 50.0 < volume < 90.0


def test_clicks_on_the_teeth_of_the_other_jaw_are_refused_by_name(coarse):
    """As if upper and lower were confused: no lower jaw is left below the clicked row."""
    image = variants.scaled(coarse, CHILD)
    lower = clicks(*LOWER_ROW)
    wrong = dict(zip(UPPER_ROW, lower.values(), strict=True))
    (finding,) = (
        f for f in cmfsim.segment_head(image, landmarks=wrong).findings if f.severity == "error"
    )
    assert finding.code == "sites-on-other-jaw"
    assert all(name in finding.fix for name in UPPER_ROW)


def exchanged(anatomy):
    """The anatomy with its bones under one another's names."""
    bones = {"cranium": anatomy.bones["mandible"], "mandible": anatomy.bones["cranium"]}
    return cmfsim.Anatomy(anatomy.skin, bones, anatomy.air, anatomy.teeth, anatomy.findings)


def test_sites_on_the_bone_of_the_other_jaw_are_refused_with_their_distances(child, case):
    sites = clicks("nasion", *UPPER_ROW)
    anatomy = cmfsim.segment_head(child, landmarks=sites)
    check_bones_of_sites(case, sites, anatomy, by_hand=True)
    with pytest.raises(cmfsim.LandmarkError, match=r"supradentale .* mm from the upper .* mm from"):
        check_bones_of_sites(case, sites, exchanged(anatomy), by_hand=True)


def test_the_sites_of_real_heads_lie_on_their_own_bones(coarse, case):
    sites = landmarks("ct_phantom")
    anatomy = cmfsim.segment_head(coarse, landmarks=sites)
    check_bones_of_sites(case, sites, anatomy, by_hand=True)
    lower = {name for name in sites if is_lower_site(name)}
    assert len(lower) == 10


def test_a_piece_without_its_sites_or_with_the_lower_jaw_is_refused(coarse, case):
    sites = landmarks("ct_phantom")
    anatomy = cmfsim.segment_head(coarse, landmarks=sites)
    procedure = place_procedure("le_fort_1", sites)
    right = cut_bones(anatomy.bones, [procedure])
    check_pieces(case, sites, right.segments, right.procedures, by_hand=True)
    elsewhere = {**sites, "supradentale": sites["glabella"]}
    with pytest.raises(cmfsim.LandmarkError, match=r"'maxilla' does not hold .*supradentale"):
        check_pieces(case, elsewhere, right.segments, right.procedures, by_hand=True)
    # Jaws that were not separated and passed for a cranium.
    whole = np.maximum(anatomy.bones["cranium"].values, anatomy.bones["mandible"].values)
    joined = {"cranium": anatomy.skin.with_values(whole)}
    both = cut_bones(joined, [procedure])
    with pytest.raises(cmfsim.LandmarkError, match="holds part of the lower jaw"):
        check_pieces(case, sites, both.segments, both.procedures, by_hand=True)


@pytest.fixture
def found(monkeypatch):
    """What is found on a head, without the search: the operator's landmarks as they are."""
    anatomy = real_heads.anatomy("ct_phantom")
    folder = real_heads.data_folder() / "ct_phantom"
    bones = {n: cmfsim.read_surface(folder / f"{n}.ply") for n in ("cranium", "mandible")}

    def of(points, case, placed, impossible=""):
        sites = {name: ProposedSite(point, 2.0) for name, point in points.items()}
        marks = ProposedLandmarks(sites, {}, impossible_jaw=impossible, doubtful_jaw=impossible)
        head = ProposedHead(anatomy, bones, None, marks)
        monkeypatch.setattr(proposing, "proposed_head", lambda *_, **__: head)
        stages = Stages(BuildOptions())
        if placed:
            cmfsim.write_landmarks(case.landmarks.skull, placed)
        placed = {"skull": placed} if placed else {}
        return found_landmarks(case, anatomy, stages, placed, is_read=True), stages.findings

    return of


def test_what_few_clicks_leave_is_found_and_the_clicks_stay(found, case):
    points = landmarks("ct_phantom")
    placed = {name: points[name] + [1.0, 0.0, 0.0] for name in UPPER_ROW}
    assert is_to_be_found(case, {"skull": placed})
    assert not is_to_be_found(case, {"skull": dict(list(points.items())[:12])})
    sella = np.array([0.0, -200.0, 450.0])
    head, (finding,) = found(points, case, {**placed, "S": sella})
    assert finding.code == "landmarks-filled"
    # A site that measures alone use is neither found nor moved.
    assert set(head.skull) == {*points, "S"}
    np.testing.assert_array_equal(head.skull["S"], sella)
    # They are brought onto the bone where they lie beside it.
    assert all(np.linalg.norm(head.skull[n] - place) <= 1.0 for n, place in placed.items())


def test_found_sites_that_contradict_clicks_are_not_used(found, case):
    points = landmarks("ct_phantom")
    placed = {name: points[name] for name in UPPER_ROW}
    elsewhere = {name: point + [0.0, 0.0, 15.0] for name, point in points.items()}
    head, (finding,) = found(elsewhere, case, placed)
    assert finding.code == "landmarks-not-completed"
    assert "supradentale by 15 mm" in finding.what
    assert set(head.skull) == set(placed)


def test_clicks_where_the_other_jaw_was_found_are_refused(found, case):
    points = landmarks("ct_phantom")
    wrong = {one: points[other] for one, other in zip(UPPER_ROW, LOWER_ROW, strict=True)}
    with pytest.raises(cmfsim.LandmarkError, match=r"on the other jaw.*supradentale \(0.0 mm from"):
        found(points, case, wrong)


def test_a_wrong_click_is_doubted_by_name_and_right_ones_are_not(found, case):
    """10 mm off, on the other side, and on the other jaw."""
    points = landmarks("ct_phantom")
    right = {name: points[name] + [0.9, -0.9, 0.9] for name in UPPER_ROW}
    assert not {f.code for f in found(points, case, right)[1]} & {"landmark-doubtful"}
    left, mirrored = "supra_m2_L", "supra_m2_R"
    for wrong in (
        {left: points[left] + [0.0, -10.0, 0.0]},
        {left: points[mirrored], mirrored: points[left]},
        {"supradentale": points["infradentale"]},
    ):
        try:
            told = [f.what for f in found(points, case, {**right, **wrong})[1]]
        except cmfsim.LandmarkError as error:
            told = [str(error)]
        assert any(name in what for name in wrong for what in told)


def test_a_mandible_that_is_none_is_left_out_where_the_plan_does_not_need_it(found, case):
    points = landmarks("ct_phantom")
    head, findings = found(points, case, {}, "its incisors are 102 mm above the upper ones")
    codes = {finding.code for finding in findings}
    assert "mandible-left-out" in codes
    assert "jaw-doubtful" not in codes
    assert set(head.anatomy.bones) == {"skull"}
    assert not any(is_lower_site(name) for name in head.skull)
    lower = replace(case, plan={"mandible": case.plan["maxilla"]})
    with pytest.raises(cmfsim.LandmarkError, match="Place infradentale, sub_m2_L and sub_m2_R"):
        found(points, lower, {}, "its incisors are 102 mm above the upper ones")


@pytest.mark.slow
def test_three_clicks_suffice_for_a_face(child, tmp_path, capsys):
    """The others are found; muscles and lips are placed by all of them."""
    from cmfsim.io import write_landmarks  # noqa: PLC0415

    sitk = pytest.importorskip("SimpleITK")
    image = sitk.GetImageFromArray(np.ascontiguousarray(child.values.T))
    image.SetSpacing(np.asarray(child.spacing).tolist())
    image.SetOrigin(np.asarray(child.lowest).tolist())
    sitk.WriteImage(image, str(tmp_path / "ct.nrrd"))
    write_landmarks(tmp_path / "skull.mrk.json", clicks(*UPPER_ROW))
    (tmp_path / "case.toml").write_text(CASE, encoding="utf-8")
    assert main(["predict", str(tmp_path), "--model", "M+S", "--json", "-q"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report
