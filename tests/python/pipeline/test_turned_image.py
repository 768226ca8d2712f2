"""A CT that lies upside down or faces backwards ends the run: its face would be a wrong one."""

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.imaging import head
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
