"""A CT that lies upside down or faces backwards ends the run; a head that nods is reported."""

import re

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.imaging import head
from cmfsim.pipeline.building.case_checks import TURNED, turned_head
from phantom_case import HEAD, IMAGE, write_case

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")

# Without landmarks, as a scan comes: those given for the head would lie beside its bone.
PLAN = """
[[osteotomies]]
procedure = "le_fort_1"

[plan.maxilla]
translation = [0, -4, 0]
"""


@pytest.mark.parametrize(
    ("axis", "said"),
    [
        (1, "the face points backwards"),
        pytest.param(2, "the head is upside down", marks=pytest.mark.slow),
    ],
    ids=["backwards", "upside down"],
)
def test_a_turned_image_ends_the_run(tmp_path, axis, said, capsys, monkeypatch):
    # Whose jaws are separated in vain, in ten seconds.
    monkeypatch.setattr(head, "part_jaws", lambda *_: head.Jaws(None, None, None, ()))
    image = cmfsim.make_head().ct(4.0)
    turned = image.with_values(np.flip(image.values, axis).copy())
    cmfsim.write_image(turned, tmp_path / "ct.nrrd")
    path = write_case(tmp_path, HEAD + IMAGE + PLAN)
    assert main(["predict", str(path), "-o", str(tmp_path / "out"), "--quiet"]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert "export the image again" in err
    assert not (tmp_path / "out" / "report.html").exists()


@pytest.mark.parametrize("frame", ["LPS", "RAS"])
@pytest.mark.parametrize("angle", [0.0, TURNED - 5.0, TURNED + 5.0, 35.0])
def test_a_plan_along_the_axes_of_a_head_that_nods_is_reported(tmp_path, angle, frame):
    """The advice moves the maxilla as the plan would with the head upright."""
    stated = "[1, 4, 2]" if frame == "RAS" else "[-1, -4, 2]"
    plan = f'[plan.maxilla]\ntranslation = {stated}\nframe = "{frame}"\n'
    plan += "angle = 3\naxis = [1, 0, 0]\ncentre = [10, 80, 20]\n"
    cut = '[[osteotomies]]\nprocedure = "le_fort_1"\n\n'
    case = cmfsim.Case.load(write_case(tmp_path, HEAD + IMAGE + cut + plan))
    nod = cmfsim.rigid_motion((5.0, 2.0, 9.0), angle, (1, 0, 0))
    places = np.array(list((sites := cmfsim.make_head().skull_landmarks).values()))
    turned = dict(zip(sites, places @ nod[:3, :3].T + nod[:3, 3], strict=True))
    found = turned_head(case, turned)
    if angle < TURNED:
        assert found == []
        return
    (finding,) = found
    assert (finding.severity, finding.code) == ("warning", "plan-head-turned")
    assert f"turned by {angle:.0f}°" in finding.what
    own = np.array([float(text) for text in re.findall(r"-?\d+\.\d+", finding.fix)])
    signs = [-1.0, -1.0, 1.0] if frame == "RAS" else [1.0, 1.0, 1.0]
    assert np.allclose(own * signs, nod[:3, :3] @ [-1.0, -4.0, 2.0], atol=0.02)
