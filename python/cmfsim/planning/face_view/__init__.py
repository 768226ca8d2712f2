"""A face before and after an operation, to turn in the browser, as a part of a report."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.planning.page.arrays import Arrays, add_surface, framing
from cmfsim.planning.page.document import view_markup
from cmfsim.values.anatomy import segment_colours
from cmfsim.values.checks import Floats
from cmfsim.values.skin_motion import carried_points
from cmfsim.values.surface_data import SurfaceData

Parts = Mapping[str, Mapping[str, tuple[SurfaceData, Floats]]]

# Triangles that a report draws of the face, and of all bones together: 1 MB of its text.
FACE_TRIANGLES, BONE_TRIANGLES, LEAST_BONE = 24_000, 30_000, 300
# Of a face whose vertices have the colours of a photo.
PHOTO_TRIANGLES = 90_000
# A vertex that moves by less than this, mm, does not decide what the picture shows; a segment that
# does is drawn as one that stays.
STAYS = 0.1
# How much more than what moves the picture shows at first.
ROUND_ABOUT = 1.3
PICTURE = (
    "The face before and after. Arrow keys rotate it, plus and minus zoom, 1 to 6 choose a view."
)


def face_view(parts: Parts, colours: NDArray[np.uint8] | None = None) -> tuple[str, str]:
    """The markup of the view of a prediction, and what its page must allow scripts from.

    parts: As `read_parts` has them; `colours`: of the vertices of the skin.
    """
    arrays: Arrays = {}
    shown: list[dict[str, Any]] = []
    bones = parts.get("bones", {})
    count = sum(len(surface.triangles) for surface, _ in bones.values())
    own = segment_colours(list(bones))
    for name, (surface, after) in bones.items():
        most = max(LEAST_BONE, BONE_TRIANGLES * len(surface.triangles) // count)
        moves = float(np.linalg.norm(after - surface.vertices, axis=1).max()) > STAYS
        shown.append({"kind": "bones", "colour": own[name] if moves else None})
        _pack(arrays, name, surface, after, most)
    ((skin, after),) = parts["skin"].values()
    shown.append({"kind": "skin", "colour": None})
    fewer = _pack(
        arrays, "skin", skin, after, FACE_TRIANGLES if colours is None else PHOTO_TRIANGLES
    )
    if colours is not None:
        closest, _, triangles = skin.searched.closest(fewer.vertices)
        corners = skin.triangles[triangles]
        away = np.linalg.norm(skin.vertices[corners] - closest[:, None], axis=2)
        nearest = colours[corners[np.arange(len(corners)), away.argmin(axis=1)]].astype(np.uint32)
        arrays["skin_colours"] = nearest @ np.array([1, 1 << 8, 1 << 16], dtype=np.uint32)
    moved = np.linalg.norm(after - skin.vertices, axis=1)
    values: dict[str, Any] = {
        "parts": shown,
        "most": max(1.0, float(np.ceil(2.0 * moved.max()) / 2.0)),
        **framing(skin.vertices[moved > STAYS] if (moved > STAYS).any() else skin.vertices),
    }
    values["span"] *= ROUND_ABOUT
    return view_markup(
        values, arrays, package="cmfsim.planning.face_view", main="view_main.js", picture=PICTURE
    )


def _pack(arrays: Arrays, name: str, surface: SurfaceData, after: Floats, most: int) -> SurfaceData:
    """The surface in fewer triangles, added with how each vertex moves."""
    key = f"part_{len(arrays) // 3}"
    fewer, _ = add_surface(arrays, key, name, surface, most)
    shift = after - surface.vertices
    if fewer is not surface:
        shift = carried_points(surface, shift, fewer.vertices)
    # Half precision: 0.004 mm on 8 mm.
    arrays[f"{key}_shift"] = shift.astype(np.float16)
    return fewer
