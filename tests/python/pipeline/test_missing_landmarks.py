"""The landmarks that the files of a case lack, during a build."""

import numpy as np
import pytest

import cmfsim
from cmfsim.pipeline import proposing
from cmfsim.pipeline.building.inputs import read_anatomy, read_case_landmarks
from cmfsim.pipeline.building.landmarks import found_landmarks, landmark_summary
from cmfsim.pipeline.building.stages import BuildOptions, Stages
from cmfsim.registration.proposed.template_head import average_head

pytest.importorskip("scipy")
pytest.importorskip("meshio")

CASE = """format = "cmfsim-case"
version = 1
[surfaces]
skin = "skin.ply"
[surfaces.bones]
cranium = "cranium.ply"
mandible = "mandible.ply"
[landmarks]
skull = "few.mrk.json"
automatic = "missing"
[mesh]
edge_length = 10.0
"""
# Six sites, as many as place the rest of a head without any proposal.
FEW = ("nasion", "supradentale", "menton", "gonion_L", "gonion_R", "zygomatic_arch_L")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("few")
    head = average_head()
    for name, surface in {**head.bones, "skin": head.skin}.items():
        cmfsim.write_surface(folder / f"{name}.ply", surface)
    cmfsim.write_landmarks(folder / "few.mrk.json", {name: head.skull[name] for name in FEW})
    (folder / "case.toml").write_text(CASE, encoding="utf-8")
    return cmfsim.Case.load(folder)


@pytest.fixture(scope="module")
def anatomy(case):
    return read_anatomy(case, {}, lambda _: None)[0]


def test_a_build_keeps_the_sites_of_the_files_and_fills_in_the_rest(case, anatomy, monkeypatch):
    """Also where nothing can be proposed, as on a head whose pose is not recognised."""

    def refused(*_, **__):
        raise cmfsim.LandmarkError("the bones lie 15 mm from an average skull")

    monkeypatch.setattr(proposing, "proposed_head", refused)
    given, _ = read_case_landmarks(case)
    assert case.landmarks.proposed
    stages = Stages(BuildOptions())
    head = found_landmarks(case, anatomy, stages, given, is_read=True)
    for name in FEW:
        # On the surface, from which the average head's own points lie up to 0.2 mm.
        assert abs(head.skull[name] - average_head().skull[name]).max() < 0.3
    assert len(head.skull) > 20
    finding = next(f for f in stages.findings if f.code == "landmarks-filled")
    assert "6 landmarks were placed by hand" in finding.what
    summary = landmark_summary(head.proposed)
    assert summary["source"] == "placed by hand and filled in"
    nasion = summary["skull"]["nasion"]
    assert (nasion["error"], nasion["doubt"]) == (0.0, "")
    np.testing.assert_allclose(nasion["point"], head.skull["nasion"], atol=1e-3)
    assert summary["skull"]["glabella"]["error"] > 2.0
