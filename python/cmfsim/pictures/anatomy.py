"""Pictures of anatomy, bone segments and node kinds."""

import os
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.pictures.canvas import SIZE, View, bounds, draw, polydata
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats, as_index_rows, as_rows
from cmfsim.values.node_kinds import NODE_KINDS, NodeKinds
from cmfsim.values.surface_data import SurfaceData
from cmfsim.values.touching import LipRegion

SKIN_COLOUR = "#e3b7a0"
# Kim et al. (2010), Figure 4: fixed pink, joined orange, sliding blue, free white.
KIND_COLOURS: Mapping[str, str] = MappingProxyType(
    {"fixed": "#f08cb4", "joined": "#f28500", "sliding": "#2f6fd0", "free": "#ffffff"}
)
# Their nodes that are not attached.
LIP_COLOURS: Mapping[str, str] = MappingProxyType({"upper": "#8e3b9e", "lower": "#2a9d5c"})
SEGMENT_COLOURS: Mapping[str, str] = MappingProxyType({
    "cranium": "#e6dcc3", "skull": "#e6dcc3", "midface": "#f2a33a", "maxilla": "#f2a33a",
    "mandible": "#5aa469", "mandible_body": "#5aa469", "ramus_left": "#4e79a7",
    "ramus_right": "#a678b8", "chin": "#d9534f",
})  # fmt: skip
# For segments of other names, in their order.
OTHER_COLOURS = ("#76b7b2", "#b6992d", "#d37295", "#79706e", "#86bcb6", "#9d7660")


def picture_segments(
    path: str | os.PathLike[str], segments: Sequence[BoneSegment], *, size: tuple[int, int] = SIZE
) -> None:
    """Writes a picture of bone segments in colours: from the front, the left front and the left.

    path: Ends in `.png`.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, no segment, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_segments("segments.png", segments)  # doctest: +SKIP
    """
    if not segments:
        raise CaseInputError("there is no segment to draw")
    colours = segment_colours([s.name for s in segments])
    corners = bounds([s.surface.vertices for s in segments])

    def paint(plotter: Any, _: View) -> None:
        for segment in segments:
            add_bone(plotter, segment.surface, colours[segment.name])

    views = tuple(View(name, name) for name in ("front", "left front", "left"))
    draw(path, views, corners, size, paint, legend=list(colours.items()))


def picture_anatomy(
    path: str | os.PathLike[str],
    skin: SurfaceData,
    segments: Sequence[BoneSegment],
    *,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of translucent skin over bones: from the front and both sides.

    path: Ends in `.png`.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_anatomy("anatomy.png", skin, segments)  # doctest: +SKIP
    """
    colours = segment_colours([s.name for s in segments])
    corners = bounds([skin.vertices, *(s.surface.vertices for s in segments)])

    def paint(plotter: Any, _: View) -> None:
        for segment in segments:
            add_bone(plotter, segment.surface, colours[segment.name])
        shape = polydata(skin.vertices, skin.triangles)
        plotter.add_mesh(shape, color=SKIN_COLOUR, opacity=0.35, smooth_shading=True)

    views = tuple(View(name, name) for name in ("right", "front", "left"))
    draw(path, views, corners, size, paint, legend=[("skin", SKIN_COLOUR), *colours.items()])


def picture_node_kinds(
    path: str | os.PathLike[str],
    nodes: ArrayLike,
    boundary_triangles: ArrayLike,
    kinds: NodeKinds,
    *,
    lips: Mapping[str, LipRegion] | None = None,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of the node kinds in the colours of Kim et al. (2010), Figure 4.

    The boundary of the mesh, each node with its share of the triangles round it: the whole of it,
    then without its free part, so that the interface with the bones shows, from the left, from the
    front and from behind.

    path: Ends in `.png`.
    nodes: (n, 3), mm.
    boundary_triangles: (t, 3) uint32.
    lips: "upper" and "lower": their nodes have colours of their own, and show where the free part
        is left away.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, misshapen arrays, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_node_kinds(
    ...     "kinds.png", mesh.nodes, mesh.boundary_triangles(), found.kinds
    ... )  # doctest: +SKIP
    """
    points = as_rows("nodes", nodes, 3)
    triangles = as_index_rows("boundary triangles", boundary_triangles, 3, len(points), "nodes")
    if len(kinds.kind) != len(points):
        raise CaseInputError(f"kinds are of {len(kinds.kind)} nodes, but there are {len(points)}")
    if not len(triangles):
        raise CaseInputError("the mesh has no boundary triangles to draw")
    shown_as = np.array(kinds.kind, dtype=np.intp)
    for number, region in enumerate((lips or {}).values(), start=len(NODE_KINDS)):
        shown_as[region.nodes] = number
    held = (shown_as[triangles] > 0).any(axis=1)
    colours = [KIND_COLOURS[name] for name in NODE_KINDS] + [LIP_COLOURS[n] for n in lips or {}]
    corners = bounds([points[np.unique(triangles)]])
    # What closes the mesh behind would hide all else from there: the rearmost cut is left out.
    edge = points[triangles[:, 0]] - points[triangles[:, 1]]
    rear = corners[1, 1] - 0.5 * float(np.median(np.linalg.norm(edge, axis=1)))
    closing = (points[triangles][:, :, 1] >= rear).all(axis=1)
    shown_kinds = ("fixed", "joined", "sliding", "free")
    entries = [(f"{name} {len(kinds.nodes(name))}", KIND_COLOURS[name]) for name in shown_kinds]
    entries += [
        (f"{name} lip {len(region.nodes)}", LIP_COLOURS[name])
        for name, region in (lips or {}).items()
    ]

    def paint(plotter: Any, view: View) -> None:
        shown = triangles[held & ~closing] if view.bare else triangles
        for number, colour in enumerate(colours):
            corner = _corners_of_kind(points, shown, shown_as == number)
            if len(corner):
                count = np.arange(3 * len(corner)).reshape(-1, 3)
                plotter.add_mesh(
                    polydata(corner.reshape(-1, 3), count), color=colour, ambient=0.25, specular=0.0
                )

    views = (
        View("left front", "whole boundary"),
        View("left", "left, without the free part", bare=True),
        View("front", "front, without the free part", bare=True),
        View("behind", "from behind, without the free part", bare=True),
    )
    draw(path, views, corners, size, paint, legend=entries)


def _corners_of_kind(
    points: Floats, triangles: NDArray[np.uint32], chosen: NDArray[np.bool_]
) -> Floats:
    """The thirds of triangles that belong to chosen nodes, each as two triangles, (2 k, 3, 3)."""
    places = points[triangles]
    middle = places.mean(axis=1)
    parts = []
    for corner in range(3):
        mine = chosen[triangles[:, corner]]
        a, b, c = (places[mine, (corner + k) % 3] for k in range(3))
        centre, half_ab, half_ac = middle[mine], 0.5 * (a + b), 0.5 * (a + c)
        parts += [np.stack([a, half_ab, centre], 1), np.stack([a, centre, half_ac], 1)]
    return np.concatenate(parts)


def segment_colours(names: Sequence[str]) -> dict[str, str]:
    """The colour of each segment, by name; the same for the same names."""
    others = iter(OTHER_COLOURS * (1 + len(names) // len(OTHER_COLOURS)))
    return {n: SEGMENT_COLOURS[n] if n in SEGMENT_COLOURS else next(others) for n in names}


def add_bone(plotter: Any, surface: SurfaceData, colour: str) -> Any:
    """The actor of the surface of a bone segment, added in a colour to a view."""
    return plotter.add_mesh(
        polydata(surface.vertices, surface.triangles),
        color=colour,
        smooth_shading=True,
        split_sharp_edges=True,
        feature_angle=50.0,
        ambient=0.15,
    )
