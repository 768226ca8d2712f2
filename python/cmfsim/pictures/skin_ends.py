"""The ends of the skin of a mesh: at the back, below and above, its triangles are ragged."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# What is left off, in edges.
RIM = 2.0
# A skin's upper end is a cut, not a crown, where its topmost rim is wider than this share of it.
CUT_WIDTH = 0.5


@dataclass(frozen=True)
class SkinEnds:
    """How far back, down and up a skin is drawn, mm along P and S."""

    back: float
    below: float
    above: float

    def within(self, corners: Floats) -> Floats:
        """The box between these ends, (2, 3)."""
        box: Floats = np.array(corners)
        box[1, 1] = min(box[1, 1], self.back)
        box[0, 2], box[1, 2] = max(box[0, 2], self.below), min(box[1, 2], self.above)
        return box


def skin_ends(skin: SurfaceData) -> SkinEnds:
    """The ends of a skin, short of its ragged rim; of one a few edges across nothing is cut."""
    vertices, triangles = skin.vertices, skin.triangles
    edge = float(np.median(np.linalg.norm(np.diff(vertices[triangles[:, :2]], axis=1), axis=2)))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if (high - low).max() < 20.0 * RIM * edge:
        return SkinEnds(*(float(value) for value in (high[1], low[2], high[2])))
    top = vertices[vertices[:, 2] > high[2] - RIM * edge]
    is_cut = np.ptp(top[:, 0]) > CUT_WIDTH * (high[0] - low[0])
    return SkinEnds(
        back=float(high[1]) - RIM * edge,
        below=float(low[2]) + RIM * edge,
        above=float(high[2]) - (RIM * edge if is_cut else 0.0),
    )


def trimmed(shape: Any, ends: SkinEnds) -> Any:
    """A skin as PyVista has it, cut off at its ends; values at its vertices are kept."""
    shape = shape.clip("y", origin=(0, ends.back, 0))
    shape = shape.clip("-z", origin=(0, 0, ends.below))
    return shape.clip("z", origin=(0, 0, ends.above))
