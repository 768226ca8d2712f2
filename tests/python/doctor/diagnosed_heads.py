"""What the doctor finds in a head, and a head that is scaled or an image alone."""

import numpy as np
import pytest

import cmfsim
from head_case import HeadCase

HALF_TURN = np.array([-1.0, -1.0, 1.0])


def diagnosis(folder, head):
    return cmfsim.diagnose(cmfsim.Case.load(head.write(folder)))


def serious(folder, head):
    """Severity and code of every error and warning."""
    return [(f.severity, f.code) for f in diagnosis(folder, head) if f.severity != "note"]


def notes(folder, head):
    """The code of every note."""
    findings = diagnosis(folder, head)
    assert all(f.severity == "note" for f in findings), findings
    return [f.code for f in findings]


def scaled(head, factor, names=("skin", "cranium", "mandible")):
    for name in names:
        head.change(name, vertices=lambda v: v * factor)


def image_case(folder, spacing):
    """The case with an empty image round the head in place of its surfaces."""
    pytest.importorskip("SimpleITK")
    head = HeadCase()
    table = head.toml.split("[surfaces]")[1].split("[landmarks]")[0]
    head.replace(f"[surfaces]{table}", '[image]\nfile = "ct.nrrd"\n\n')
    low, high = np.array([-80, -210, 1370.0]), np.array([90, 10, 1630.0])
    shape = tuple(int(n) for n in np.ceil((high - low) / spacing) + 1)
    image = cmfsim.ImageData(np.full(shape, -1000, np.int16), (spacing,) * 3, low)
    cmfsim.write_image(image, folder / "ct.nrrd")
    return head
