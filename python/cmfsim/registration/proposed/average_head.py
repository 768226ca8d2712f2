"""The ordinary synthetic head, as stored: what the landmarks of other heads are proposed from."""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.proposed.template_head import TemplateHead
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS
from cmfsim.values.surface_data import SurfaceData

FILE = "average_head.npz"
# Coordinates are rounded to this, mm: they pack into 16 bits.
GRAIN = 1.0 / 100.0
BONES = ("cranium", "mandible")
PARTS = (*BONES, "skin")
KINDS = {"skull": SKULL_LANDMARKS, "skin": SKIN_LANDMARKS}


@lru_cache(maxsize=1)
def average_head() -> TemplateHead:
    """The ordinary synthetic head: cranium and mandible with their teeth, skin, all landmarks.

    Its frame is that of `make_head`. Surfaces, landmarks and the biases of the definitions come
    with the package (`scripts/make_average_head.py` makes them again).
    """
    return read_average_head(Path(__file__).with_name(FILE))


def read_average_head(path: Path) -> TemplateHead:
    """The head of a file by `write_average_head`."""
    with np.load(path, allow_pickle=False) as stored:
        return _unpacked(stored)


def write_average_head(path: Path, head: TemplateHead) -> None:
    """Writes the head that `average_head` reads: surfaces packed, landmarks with every digit.

    Biases are those of the head as it is read: rounded.
    """
    surfaces = {**head.bones, "skin": head.skin}
    packed: dict[str, NDArray[np.generic]] = {}
    for name in PARTS:
        surface = surfaces[name]
        if surface is None:
            raise AssertionError(name)
        packed[f"{name}_vertices"] = np.round(surface.vertices / GRAIN).astype(np.int16)
        packed[f"{name}_triangles"] = surface.triangles.astype(np.uint16)
    packed["skull_landmarks"] = np.array([head.skull[name] for name in SKULL_LANDMARKS])
    packed["skin_landmarks"] = np.array([head.skin_landmarks[name] for name in SKIN_LANDMARKS])
    if head.biases is not None:
        for (kind, names), biases in zip(KINDS.items(), head.biases, strict=True):
            packed[f"{kind}_biases"] = np.array([biases[name] for name in names])
    np.savez_compressed(path, allow_pickle=False, **packed)


def _unpacked(stored: Mapping[str, NDArray[Any]]) -> TemplateHead:
    """The head of arrays by name."""

    def surface(name: str) -> SurfaceData:
        vertices: Floats = stored[f"{name}_vertices"].astype(np.float64) * GRAIN
        return SurfaceData(vertices, stored[f"{name}_triangles"].astype(np.uint32))

    def points(what: str) -> list[dict[str, Floats]]:
        return [
            dict(zip(names, stored[f"{kind}_{what}"], strict=True)) for kind, names in KINDS.items()
        ]

    skull, skin = points("landmarks")
    biases = None
    if "skull_biases" in stored:
        of_skull, of_skin = points("biases")
        biases = (of_skull, of_skin)
    bones = {bone: surface(bone) for bone in BONES}
    return TemplateHead("synthetic head", bones, skull, surface("skin"), skin, biases)
