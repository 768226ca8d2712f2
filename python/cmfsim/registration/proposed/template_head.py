"""A head whose landmarks are known: what proposed landmarks are compared with and corrected by."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import LandmarkInputError
from cmfsim.values.checks import Floats, Frozen, as_text, check_instance
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS
from cmfsim.values.surface_data import SurfaceData


@dataclass(frozen=True, eq=False)
class TemplateHead(Frozen):
    """A head whose landmarks are known.

    bones: "cranium" and "mandible", LPS mm; the mandible apart, as far as it is known.
    skull: mapping of str to (3,), mm. Its skull landmarks by label.
    skin_landmarks: mapping of str to (3,), mm.
    biases: tuple of two mappings of str to (3,), mm, or None. How far the landmarks of skull and
        skin lie from where their definitions put them on this head, in its own frame; None where
        that has to be measured.
    Raises `LandmarkError`: No cranium, or no skull landmarks.
    """

    name: str
    bones: Mapping[str, SurfaceData]
    skull: Mapping[str, Floats]
    skin: SurfaceData | None = None
    skin_landmarks: Mapping[str, Floats] = field(default_factory=dict)
    biases: tuple[Mapping[str, Floats], Mapping[str, Floats]] | None = None

    def __post_init__(self) -> None:
        as_text("name of the template head", self.name)
        if not self.bones or not self.skull:
            raise LandmarkInputError(
                f"template head {self.name!r} has {len(self.bones)} bones and {len(self.skull)} "
                "skull landmarks: both are needed"
            )
        for name, bone in self.bones.items():
            check_instance(f"bone {name!r} of template head {self.name!r}", bone, SurfaceData)
        for name in ("bones", "skull", "skin_landmarks"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))


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
