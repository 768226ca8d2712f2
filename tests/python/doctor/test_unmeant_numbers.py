"""Numbers that no one means: a wrong digit or unit, a plan that moves nothing, no centre."""

import numpy as np
import pytest

import cmfsim
from head_case import HeadCase

TURN = "translation = [0, -4, 1]\nangle = 2\naxis = [1, 0, 0]\ncentre = [3, -100, 1450]"
PAPER = 'preset = "kim2010"'
LE_FORT = '[[osteotomies]]\nprocedure = "le_fort_1"\n\n[[osteotomies]]\nprocedure = "le_fort_3"\n'
NUMBERS = {
    "a Poisson's ratio of 0.046": (PAPER, "young = 0.003\npoisson = 0.046", "moduli-unusual"),
    "kilopascals": (PAPER, "young = 3\npoisson = 0.46", "moduli-unusual"),
    "gigapascals": (PAPER, "young = 3e-6\npoisson = 0.46", "moduli-unusual"),
    "nothing moves": (TURN, "translation = [0, 0, 0]", "plan-still"),
    "no plan": (f"[plan.mandible]\n{TURN}\n", "", "plan-still"),
    "no centre": ("\ncentre = [3, -100, 1450]", "", "plan-far"),
    "no centre, near": ("angle = 2\naxis = [1, 0, 0]\ncentre = [3, -100, 1450]",
                        "angle = 0.5\naxis = [1, 0, 0]", "plan-no-centre"),
    "a centre in another patient": ("centre = [3, -100, 1450]", "centre = [3, -100, 1150]",
                                    "plan-centre-far"),
    "centimetres": (TURN, "translation = [0, -0.4, 0.1]", "plan-tiny"),
    "another order": (TURN, "translation = [-4, 0, 1]", "plan-sideways"),
    "the skull": ("[plan.mandible]", "[plan.cranium]\ntranslation = [0, -3, 0]\n\n[plan.mandible]",
                  "plan-cranium"),
    "both Le Fort": ("[plan.mandible]", f"{LE_FORT}\n[plan.mandible]", "cuts-both-le-fort"),
}  # fmt: skip


def codes(folder, head):
    found = cmfsim.diagnose(cmfsim.Case.load(head.write(folder)))
    return {f.code for f in found if f.severity != "note"}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_that_no_one_means_is_a_warning(tmp_path, name):
    head = HeadCase(rounds=2)
    before = codes(tmp_path, head)
    old, new, code = NUMBERS[name]
    head.replace(old, new)
    assert code not in before
    assert code in codes(tmp_path, head)


def test_a_turn_about_a_stated_origin_is_meant(tmp_path):
    head = HeadCase(rounds=2)
    head.replace("angle = 2", "angle = 0.5")
    head.replace("centre = [3, -100, 1450]", "centre = [0, 0, 0]")
    assert "plan-no-centre" not in codes(tmp_path, head)


def test_moduli_of_muscles_and_fat_are_checked_together(tmp_path):
    head = HeadCase(rounds=2)
    head.replace(PAPER, "young = 3\npoisson = 0.46")
    head.toml += "\n[muscles]\nyoung_along = 200.0\n"
    found = cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path)))
    (warning,) = (f for f in found if f.code == "moduli-unusual")
    assert "fat 3 MPa" in warning.what
    assert "muscle 200 MPa" in warning.what


MASKED = np.ma.masked_array(np.arange(12.0).reshape(4, 3), mask=np.eye(4, 3))
CORNERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
MASKED_IDS = np.ma.masked_array([[0, 1, 2, 3]], mask=[[True, False, False, False]])


@pytest.mark.parametrize(
    "make",
    [
        lambda: cmfsim.TetMesh(MASKED, [[0, 1, 2, 3]]),
        lambda: cmfsim.TetMesh(CORNERS, MASKED_IDS),
        lambda: cmfsim.SurfaceData(MASKED, [[0, 1, 2]]),
        lambda: cmfsim.SurfaceData(CORNERS, MASKED_IDS[:, :3]),
        lambda: cmfsim.Surface(MASKED, [[0, 1, 2], [0, 2, 1]]),
        lambda: cmfsim.Tissue.isotropic(np.ma.masked_array([1.0, 2.0], [True, False]), 0.4),
        lambda: cmfsim.rigid_motion(translation=MASKED[0]),
        lambda: cmfsim.ImageData(np.ma.masked_less(np.zeros((2, 2, 2)), 1.0), (1, 1, 1)),
        lambda: cmfsim.icp(MASKED, CORNERS),
    ],
)
def test_masked_entries_are_refused(make):
    """Their values are whatever lies below the mask."""
    with pytest.raises(ValueError, match="masked entries"):
        make()


def test_a_masked_array_without_a_masked_entry_is_an_array():
    nodes = np.ma.masked_array(np.array(CORNERS, dtype=float))
    assert len(cmfsim.TetMesh(nodes, [[0, 1, 2, 3]]).volumes) == 1
    assert len(cmfsim.SurfaceData(nodes, [[0, 1, 2]]).vertices) == 4
