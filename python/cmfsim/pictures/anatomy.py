"""Pictures of anatomy, muscles, bone segments and node kinds."""

import colorsys
import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.pictures.canvas import SIZE, Shown, View, bounds, draw, polydata
from cmfsim.values.anatomy import BoneSegment, segment_colours
from cmfsim.values.checks import AnyPath, Floats, as_index_rows, as_rows
from cmfsim.values.musculature import MuscleSurface, Musculature
from cmfsim.values.scene import NODE_KINDS, NodeKinds
from cmfsim.values.surface_data import SurfaceData, joined_surface
from cmfsim.values.touching import LipRegion

SKIN_COLOUR = "#e3b7a0"
# Kim et al. (2010), Figure 4: fixed pink, joined orange, sliding blue, free white.
KIND_COLOURS: Mapping[str, str] = MappingProxyType(
    {"fixed": "#f08cb4", "joined": "#f28500", "sliding": "#2f6fd0", "free": "#ffffff"}
)
# Their nodes that are not attached.
LIP_COLOURS: Mapping[str, str] = MappingProxyType({"upper": "#8e3b9e", "lower": "#2a9d5c"})


def picture_anatomy(
    path: AnyPath,
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
    path: AnyPath,
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


MUSCLE_COLOUR, BONE_COLOUR = "#b8564b", "#e6dcc3"
# Boxes whose direction the outline hardly tells are drawn in the second colour.
BOX_COLOUR, SHEET_COLOUR, LINE_COLOUR = "#1f5fbf", "#e08a00", "#202020"
# Length of a direction on the surface, as a share of the picture's diagonal.
STROKE = 0.012
# About as many directions are drawn on each muscle.
STROKES = 60


def picture_muscles(
    path: AnyPath,
    musculature: Musculature,
    skull: SurfaceData | None = None,
    *,
    fibres: bool = False,
) -> None:
    """Writes a picture of muscles: in colours with their names, or with their fibres.

    In colours, from the front and the left; muscles of both sides with the same name have one
    colour. With fibres, boxes of muscles whose outline hardly determines the direction are orange,
    others blue; where fibre lines are known the directions follow them.

    path: Ends in `.png`.
    skull: Drawn with them, such as the patient's bones.
    fibres: Whether to draw boxes and directions (Kim et al. 2010, Figure 2) instead of names.
    Raises `CaseError`: PyVista or OpenGL is missing, no muscle, another ending.
    Raises `MeshError`: A muscle's surface that cannot be used for fibres.

    Examples
    --------
    >>> import cmfsim, cmfsim.pictures
    >>> template = cmfsim.MuscleTemplate.load("default")
    >>> cmfsim.pictures.picture_muscles(
    ...     "muscles.png", template.musculature, template.skull
    ... )  # doctest: +SKIP
    """
    if not len(musculature):
        raise CaseInputError("there is no muscle to draw")
    clouds = [muscle.surface.vertices for muscle in musculature]
    corners = bounds(clouds if skull is None else [*clouds, skull.vertices])

    views = tuple(View(name, name) for name in ("front", "left front", "left"))
    shown = Shown()

    names = dict.fromkeys(without_side(muscle.name) for muscle in musculature)
    colours = {n: MUSCLE_COLOUR if fibres else _hue(k) for k, n in enumerate(names)}
    length = STROKE * float(np.linalg.norm(corners[1] - corners[0]))
    lines = [_lines(muscle, length) if fibres else None for muscle in musculature]

    def paint(plotter: Any, _: View) -> None:
        if skull is not None:
            shown.add(plotter, "skull", partial(add_bones, plotter, skull))
        shown.add(plotter, "muscles", partial(_add_muscles, plotter, musculature, colours))
        for drawn in lines:
            if drawn is not None:
                strokes, edges, colour = drawn
                plotter.add_lines(strokes, color=LINE_COLOUR, width=2)
                plotter.add_lines(edges, color=colour, width=1)

    legend = list(colours.items())
    if fibres:
        legend = [("muscle", MUSCLE_COLOUR), ("fibre direction", LINE_COLOUR)]
        legend += [("box", BOX_COLOUR), ("box of a sheet", SHEET_COLOUR)]
    draw(path, views, corners, SIZE, paint, legend=legend)


def add_bones(plotter: Any, skull: SurfaceData) -> Any:
    """The actor of the skull, added to a view."""
    shape = polydata(skull.vertices, skull.triangles)
    return plotter.add_mesh(shape, color=BONE_COLOUR, smooth_shading=True)


def _add_muscles(plotter: Any, muscles: Musculature, colours: Mapping[str, str]) -> Any:
    """The actor of all muscles, added to a view: one surface with the colour of each."""
    joined = joined_surface([muscle.surface for muscle in muscles])
    shape = polydata(joined.vertices, joined.triangles)
    own = [[*bytes.fromhex(colours[without_side(muscle.name)][1:])] for muscle in muscles]
    counts = [len(muscle.surface.vertices) for muscle in muscles]
    shape.point_data["colour"] = np.repeat(np.array(own, dtype=np.uint8), counts, axis=0)
    return plotter.add_mesh(shape, scalars="colour", rgb=True, smooth_shading=True, ambient=0.15)


def _lines(muscle: MuscleSurface, length: float) -> tuple[Floats, Floats, str]:
    """Fibre strokes and box edges as pairs of points, and the colour of the boxes."""
    vertices = muscle.surface.vertices
    triangles = muscle.surface.triangles.astype(np.int64)
    fibres = muscle.fibres()
    every = max(1, len(triangles) // STROKES)
    corners = vertices[triangles[::every]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    # Just above the surface, so that they show.
    middle = corners.mean(axis=1) + 0.15 * length * normals
    half = 0.5 * length * fibres.directions(middle)
    strokes = np.stack([middle - half, middle + half], axis=1).reshape(-1, 3)
    centres, axes, half_extents = fibres.boxes
    edges = []
    for centre, frame, extent in zip(centres, axes, half_extents, strict=True):
        for axis in range(3):
            one, other = (k for k in range(3) if k != axis)
            along = extent[axis] * frame[axis]
            for a, b in itertools.product((-1.0, 1.0), repeat=2):
                at = centre + a * extent[one] * frame[one]
                at = at + b * extent[other] * frame[other]
                edges += [at - along, at + along]
    colour = SHEET_COLOUR if fibres.is_sheet else BOX_COLOUR
    return strokes, np.array(edges), colour


def without_side(name: str) -> str:
    """The name of a muscle as both sides have it."""
    return name.removesuffix("_L").removesuffix("_R")


def _hue(number: int) -> str:
    """A colour that differs from those of the numbers near it."""
    # Steps of the golden section spread hues evenly, however many there are.
    hue = (number * 0.6180339887) % 1.0
    channels = colorsys.hsv_to_rgb(hue, 0.75, 0.62 + 0.28 * (number % 2))
    return "#" + "".join(f"{round(255 * channel):02x}" for channel in channels)
