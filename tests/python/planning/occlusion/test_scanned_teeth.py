"""Crowns of intraoral scans in place of those of a CT that metal has streaked."""

from types import SimpleNamespace

import numpy as np
import pytest
import tooth_row_heads as heads

import cmfsim
from cmfsim.pipeline.building.case_checks import Head
from cmfsim.pipeline.building.inputs import input_hashes
from cmfsim.pipeline.building.stages import BuildOptions, Stages
from cmfsim.pipeline.building.teeth import with_scanned_teeth
from cmfsim.values.case_parts import CaseBite

pytest.importorskip("skimage")

# The scans are in a frame of their own.
FRAME = cmfsim.rigid_motion((120.0, 40.0, -33.0), 140.0, (1.0, 2.0, -0.5))
# A streak: a ball of "bone" on the front of the upper teeth, reaching between the rows, mm.
STREAK, RADIUS = 4.0, 3.0


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """The rows in fine voxels, and files of their scans."""
    folder = tmp_path_factory.mktemp("scans")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(heads, "SPACING", 0.6)
        rows = heads.rows_of(cmfsim.make_head())
    for row in rows:
        cmfsim.write_surface(folder / f"{row.arch.jaw}.stl", heads.scan_of(row, FRAME))
    return rows, CaseBite(folder / "upper.stl", folder / "lower.stl")


@pytest.fixture(scope="module")
def streaked():
    """The head in coarser voxels, with the clean level of its cranium and the streaked one."""
    head = cmfsim.make_head()
    levels = {
        "cranium": heads.level(head, "cranium", "upper_teeth"),
        "mandible": heads.level(head, "mandible", "lower_teeth"),
    }
    clean = levels["cranium"]
    sites = head.skull_landmarks
    centre = 0.5 * (sites["supradentale"] + sites["infradentale"]) - [0.0, STREAK, 0.0]
    away = np.sqrt(sum((a - c) ** 2 for a, c in zip(clean.axes(), centre, strict=True)))
    ball = clean.with_values(np.maximum(clean.values, RADIUS - away))
    skin = clean.with_values(np.full(clean.values.shape, heads.CLIP))
    anatomy = cmfsim.Anatomy(skin, {**levels, "cranium": ball})
    case = SimpleNamespace(where=lambda key: key)
    return Head(case, {"skull": sites}, anatomy), clean


def test_a_streak_is_gone_and_the_crowns_are_those_of_the_scan(streaked, scanned):
    (head, clean), (_, scans) = streaked, scanned
    stages = Stages(BuildOptions())
    found = with_scanned_teeth(head, scans, stages).anatomy
    volumes = [
        np.count_nonzero(level.values > 0.0)
        for level in (head.anatomy.bones["cranium"], found.bones["cranium"], clean)
    ]
    streak = volumes[0] - volumes[2]
    assert streak > 50
    assert abs(volumes[1] - volumes[2]) < 0.25 * streak
    # The bone above the crowns is that of the image.
    above = (..., clean.axes()[2].ravel() > head.skull["supradentale"][2] + 1.0)
    np.testing.assert_array_equal(found.bones["cranium"].values[above], clean.values[above])
    codes = [finding.code for finding in stages.findings]
    assert codes.count("teeth-of-scan") == 2


def test_scans_that_do_not_fit_are_refused_with_the_key(streaked, scanned, tmp_path):
    (head, _), (_, scans) = streaked, scanned
    exchanged = CaseBite(scans.lower, scans.upper)
    with pytest.raises(cmfsim.CaseError, match=r"image\.teeth: .*bite-scan-"):
        with_scanned_teeth(head, exchanged, Stages(BuildOptions()))
    inside_out = cmfsim.read_surface(scans.upper)
    flipped = np.ascontiguousarray(inside_out.triangles[:, ::-1])
    cmfsim.write_surface(tmp_path / "up.stl", cmfsim.SurfaceData(inside_out.vertices, flipped))
    with pytest.raises(cmfsim.CaseError, match="bite-scan-mirrored"):
        with_scanned_teeth(head, CaseBite(tmp_path / "up.stl", scans.lower), Stages(BuildOptions()))


def test_a_case_names_both_scans_and_counts_them_among_its_inputs(tmp_path):
    for name in ("ct.nrrd", "upper.stl", "lower.stl"):
        (tmp_path / name).write_bytes(name.encode())
    text = 'format = "cmfsim-case"\nversion = 1\n[image]\nfile = "ct.nrrd"\n[image.teeth]\n'
    case = tmp_path / "case.toml"
    case.write_text(f'{text}upper = "upper.stl"\nlower = "lower.stl"\n', encoding="utf-8")
    loaded = cmfsim.Case.load(case)
    assert loaded.image.teeth.lower.name == "lower.stl"
    assert {"upper.stl", "lower.stl"} <= input_hashes(loaded).keys()
    case.write_text(f'{text}upper = "upper.stl"\n', encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match="lower"):
        cmfsim.Case.load(case)
