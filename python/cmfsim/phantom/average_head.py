"""The ordinary synthetic head as surfaces with landmarks, ready to compare other heads with."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim.checks import Floats
from cmfsim.phantom.model import PhantomHead, make_head
from cmfsim.registration.proposed import TemplateHead
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.values.surface_data import SurfaceData

__all__ = ["average_head", "drawn_head", "write_average_head"]

FILE = "average_head.npz"
# Coordinates are rounded to this, mm: they pack into 16 bits.
GRAIN = 1.0 / 100.0
# Voxels that the surfaces are taken from, mm, and how many triangles each has at most.
SPACING, MOST_TRIANGLES = 1.5, 16_000
PARTS = ("cranium", "mandible", "skin")


@lru_cache(maxsize=1)
def average_head() -> TemplateHead:
    """The ordinary synthetic head: cranium and mandible with their teeth, skin, all landmarks.

    Its frame is that of `make_head`. The surfaces come with the package
    (`scripts/make_average_head.py` makes them again), the landmarks from the head itself.
    """
    head = make_head()
    with np.load(Path(__file__).with_name(FILE), allow_pickle=False) as stored:
        parts = {name: _unpacked(stored, name) for name in PARTS}
    return _template("synthetic head", head, parts)


def drawn_head(head: PhantomHead, name: str) -> TemplateHead:
    """A synthetic head with surfaces like those of `average_head`; it takes seconds."""
    anatomy = head.anatomy(SPACING)
    options = SurfaceOptions(max_triangles=MOST_TRIANGLES)
    levels = {**anatomy.bones, "skin": anatomy.skin}
    parts = {part: surface_of_level(part, levels[part], options) for part in PARTS}
    return _template(name, head, parts)


def write_average_head(path: Path) -> None:
    """Writes the surfaces of the ordinary synthetic head, packed."""
    template = drawn_head(make_head(), "synthetic head")
    surfaces = {**template.bones, "skin": template.skin}
    packed: dict[str, NDArray[np.generic]] = {}
    for name in PARTS:
        surface = surfaces[name]
        if surface is None:
            raise AssertionError(name)
        packed[f"{name}_vertices"] = np.round(surface.vertices / GRAIN).astype(np.int16)
        packed[f"{name}_triangles"] = surface.triangles.astype(np.uint16)
    np.savez_compressed(path, allow_pickle=False, **packed)


def _unpacked(stored: "np.lib.npyio.NpzFile", name: str) -> SurfaceData:
    vertices: Floats = stored[f"{name}_vertices"].astype(np.float64) * GRAIN
    return SurfaceData(vertices, stored[f"{name}_triangles"].astype(np.uint32))


def _template(name: str, head: PhantomHead, parts: dict[str, SurfaceData]) -> TemplateHead:
    return TemplateHead(
        name,
        {bone: parts[bone] for bone in ("cranium", "mandible")},
        head.skull_landmarks,
        parts["skin"],
        head.skin_landmarks,
    )
