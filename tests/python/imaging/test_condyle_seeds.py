"""Seeds of the mandible in condyles that touch the skull, where no landmarks are given."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("scipy.ndimage", reason="needs scipy")

from cmfsim.imaging.bones.jaw import CONDYLE, _joint_seeds
from cmfsim.imaging.working_grid import Working

LOW, SIDE = np.array([-60.0, -30.0, -40.0]), 45.0


def fitted(jaw):
    """The model with both joints known, as it lies in the image."""
    root = np.array([CONDYLE[0], -CONDYLE[1], -CONDYLE[2]])
    sites = {
        ("skull", f"supraglenoid_{letter}"): [side * (SIDE + root[0]), root[1], root[2]]
        for letter, side in (("L", 1.0), ("R", -1.0))
    }
    state = SimpleNamespace(into=lambda p: p, out=lambda p: p, linear=np.eye(3), scale=1.0)
    return SimpleNamespace(
        jaw=jaw, state=state, sites={key: np.array(place) for key, place in sites.items()}
    )


def made(ahead):
    """Skull base, a condyle that touches it on each side, so far ahead, and a plate behind it."""
    x, y, z = (low + np.arange(n).reshape([-1 if a == b else 1 for b in range(3)])
               for a, (low, n) in enumerate(zip(LOW, (121, 61, 61), strict=True)))  # fmt: skip
    away = np.abs(np.abs(x) - SIDE)
    head = (away / 8.0) ** 2 + ((y + ahead) / 4.0) ** 2 + (z / 7.0) ** 2 < 1.0
    neck = (away < 3.0) & (np.abs(y + ahead) < 3.0) & (z < 0.0)
    base = (z > 6.0) & (z < 12.0) & (np.abs(y) < 31.0)
    plate = (away < 6.0) & (np.abs(y - 3.0) < 2.0) & (z > -5.0) & (z <= 6.0)
    domain = np.asfortranarray(head | neck | base | plate)
    seeds = np.zeros(domain.shape, dtype=np.int32, order="F")
    seeds[domain & (z < -14.0)] = 1
    seeds[domain & (z > 8.0)] = 2
    hu = np.where(domain, np.float32(900.0), np.float32(40.0))
    work = Working(np.asfortranarray(hu), np.ones(3), LOW, np.zeros((2, 3), bool), np.ones(3))
    return work, domain, seeds, np.broadcast_to(head & (z > -5.0), domain.shape), plate & domain


def test_condyles_that_touch_the_skull_are_the_mandibles_and_not_what_lies_behind_them():
    work, domain, seeds, condyles, plate = made(ahead=6.0)
    before = seeds.copy()
    _joint_seeds(seeds, domain, work, fitted(np.eye(4)))
    left = condyles.copy()
    left[: len(left) // 2] = False
    for condyle in (left, condyles & ~left):
        assert np.count_nonzero(seeds[condyle] == 1) > 20
    assert not (seeds[plate] == 1).any()
    assert (seeds[before > 0] == before[before > 0]).all()


def test_condyles_of_an_open_mouth_are_left_to_the_flood():
    work, domain, seeds, _, _ = made(ahead=6.0)
    before = seeds.copy()
    turned = np.eye(4)
    turned[1:3, 1:3] = [[0.95, 0.3], [-0.3, 0.95]]
    _joint_seeds(seeds, domain, work, fitted(turned))
    assert (seeds == before).all()
