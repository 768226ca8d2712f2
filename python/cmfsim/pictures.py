"""Pictures of a case, drawn off screen: anatomy, bone segments, node kinds. Needs PyVista.

Cameras look along the patient's axes (LPS) and depend on the bounds alone, so that pictures of two
plans lie on top of each other.
"""

import os
import struct
import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.case import BoneSegment, NodeKinds
from cmfsim.checks import Floats, as_index_rows, as_positive, as_rows
from cmfsim.errors import CaseInputError
from cmfsim.scene import SurfaceData

__all__ = ["picture_anatomy", "picture_node_kinds", "picture_segments"]

SIZE = (1600, 900)
SKIN_COLOUR = "#e3b7a0"
# Kim et al. (2010), Figure 4: fixed pink, joined orange, sliding blue, free white.
KIND_COLOURS: Mapping[str, str] = MappingProxyType(
    {"fixed": "#f08cb4", "joined": "#f28500", "sliding": "#2f6fd0", "free": "#ffffff"}
)
KIND_NAMES = ("free", "fixed", "joined", "sliding")
SEGMENT_COLOURS: Mapping[str, str] = MappingProxyType(
    {
        "cranium": "#e6dcc3",
        "skull": "#e6dcc3",
        "midface": "#f2a33a",
        "maxilla": "#f2a33a",
        "mandible": "#5aa469",
        "mandible_body": "#5aa469",
        "ramus_left": "#4e79a7",
        "ramus_right": "#a678b8",
        "chin": "#d9534f",
    }
)
# For segments of other names, in their order.
OTHER_COLOURS = ("#76b7b2", "#b6992d", "#d37295", "#79706e", "#86bcb6", "#9d7660")
# Where the camera stands, as a direction from the head, in LPS.
DIRECTIONS: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {
        "front": (0.0, -1.0, 0.0),
        "left": (1.0, 0.0, 0.0),
        "right": (-1.0, 0.0, 0.0),
        "left front": (0.7, -0.7, 0.1),
        "behind": (0.35, 0.9, 0.1),
    }
)
MARGIN = 1.04
# Diameter of a node's dot, as a part of the edges of the mesh.
DOT = 0.55
TEXT_SIZE = 9
LEGEND_ROW = 26  # pixels


def picture_segments(
    path: str | os.PathLike[str],
    segments: Sequence[BoneSegment],
    *,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of bone segments in colours: from the front, the left front and the left.

    Parameters
    ----------
    path : path
        Ends in `.png`.
    segments : sequence of BoneSegment
    size : (int, int), pixels

    Raises
    ------
    CaseError
        (also `ValueError`) PyVista or OpenGL is missing, no segment, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_segments("segments.png", segments)  # doctest: +SKIP
    """
    if not segments:
        raise CaseInputError("there is no segment to draw")
    colours = _colours([s.name for s in segments])
    corners = _bounds([np.asarray(s.surface.vertices) for s in segments])

    def paint(plotter: Any, view: _View) -> None:
        del view
        for segment in segments:
            _add_bone(plotter, segment, colours[segment.name])

    views = tuple(_View(name, name) for name in ("front", "left front", "left"))
    _draw(path, views, corners, size, paint, list(colours.items()))


def picture_anatomy(
    path: str | os.PathLike[str],
    skin: SurfaceData,
    segments: Sequence[BoneSegment],
    *,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of translucent skin over bones: from the front and both sides.

    Parameters
    ----------
    path : path
        Ends in `.png`.
    skin : SurfaceData
    segments : sequence of BoneSegment
    size : (int, int), pixels

    Raises
    ------
    CaseError
        (also `ValueError`) PyVista or OpenGL is missing, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_anatomy("anatomy.png", skin, segments)  # doctest: +SKIP
    """
    colours = _colours([s.name for s in segments])
    corners = _bounds([np.asarray(skin.vertices), *(s.surface.vertices for s in segments)])

    def paint(plotter: Any, view: _View) -> None:
        del view
        for segment in segments:
            _add_bone(plotter, segment, colours[segment.name])
        shape = _polydata(skin.vertices, skin.triangles)
        plotter.add_mesh(shape, color=SKIN_COLOUR, opacity=0.35, smooth_shading=True)

    views = tuple(_View(name, name) for name in ("right", "front", "left"))
    _draw(path, views, corners, size, paint, [("skin", SKIN_COLOUR), *colours.items()])


def picture_node_kinds(
    path: str | os.PathLike[str],
    nodes: ArrayLike,
    boundary_triangles: ArrayLike,
    kinds: NodeKinds,
    *,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of the node kinds in the colours of Kim et al. (2010), Figure 4.

    The boundary of the mesh from the front and from the left, then without its free part, so that
    the interface with the bones shows: from the front, and from behind.

    Parameters
    ----------
    path : path
        Ends in `.png`.
    nodes : (n, 3) float64, mm
    boundary_triangles : (t, 3) uint32
    kinds : NodeKinds
    size : (int, int), pixels

    Raises
    ------
    CaseError
        (also `ValueError`) PyVista or OpenGL is missing, misshapen arrays, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_node_kinds(
    ...     "kinds.png", mesh.nodes, mesh.surface().triangles, found.kinds
    ... )  # doctest: +SKIP
    """
    points = as_rows("nodes", nodes, 3)
    triangles = as_index_rows("boundary triangles", boundary_triangles, 3, len(points), "nodes")
    if len(kinds.kind) != len(points):
        raise CaseInputError(f"kinds are of {len(kinds.kind)} nodes, but there are {len(points)}")
    held = (kinds.kind[triangles] > 0).any(axis=1)
    corners = _bounds([points[np.unique(triangles)]])
    entries = [
        (f"{name} {len(kinds.nodes(name))}", KIND_COLOURS[name])
        for name in ("fixed", "joined", "sliding", "free")
    ]
    edge = points[triangles[:, 0]] - points[triangles[:, 1]]
    diameter = DOT * float(np.median(np.linalg.norm(edge, axis=1))) if len(edge) else 1.0
    border = np.zeros(len(points), dtype=bool)
    border[np.unique(triangles)] = True

    def paint(plotter: Any, view: _View) -> None:
        shown = triangles[held] if view.bare else triangles
        if len(shown):
            plotter.add_mesh(
                _polydata(points, shown),
                color=KIND_COLOURS["free"],
                show_edges=True,
                edge_color="#b0b0b0",
                line_width=0.5,
                ambient=0.3,
            )
        for number, name in enumerate(KIND_NAMES):
            chosen = points[border & (kinds.kind == number)]
            if name != "free" and len(chosen):
                # Lifted towards the camera, or the surface that they lie on would cut them in half.
                chosen = chosen + diameter * _toward(view.direction)
                plotter.add_points(
                    chosen,
                    color=KIND_COLOURS[name],
                    point_size=max(2.0, diameter / view.mm_per_pixel),
                    render_points_as_spheres=True,
                )

    views = (
        _View("front", "front"),
        _View("left", "left"),
        _View("front", "front, without the free part", bare=True),
        _View("behind", "from behind, without the free part", bare=True),
    )
    _draw(path, views, corners, size, paint, entries)


@dataclass(frozen=True)
class _View:
    """One of the views side by side: where the camera stands, and what is written below."""

    direction: str
    caption: str
    bare: bool = False
    mm_per_pixel: float = 1.0


def _draw(
    path: str | os.PathLike[str],
    views: Sequence[_View],
    corners: Floats,
    size: tuple[int, int],
    paint: Callable[[Any, _View], None],
    legend: Sequence[tuple[str, str]],
) -> None:
    """Writes the views side by side, under a temporary name first."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise CaseInputError(f"{path.name}: a picture is written as .png, not {path.suffix!r}")
    width, height = (int(as_positive("picture size", n)) for n in size)
    pv = _pyvista()
    try:
        # PyVista and VTK warn of missing screens; whether the picture was made decides here.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            plotter = pv.Plotter(
                off_screen=True, shape=(1, len(views)), window_size=[width, height], border=False
            )
            try:
                plotter.enable_anti_aliasing("ssaa")
                for column, view in enumerate(views):
                    plotter.subplot(0, column)
                    plotter.set_background("white")
                    scale = _place_camera(plotter, view, corners, width / len(views), height)
                    paint(plotter, replace(view, mm_per_pixel=scale))
                    plotter.reset_camera_clipping_range()
                    plotter.add_text(
                        view.caption, position=(10, 10), font_size=TEXT_SIZE, color="black"
                    )
                plotter.subplot(0, 0)
                swatches = []
                for row, (text, colour) in enumerate(legend):
                    top = height - 14 - (row + 1) * LEGEND_ROW
                    plotter.add_text(text, position=(38, top), font_size=TEXT_SIZE, color="black")
                    swatches.append((height - top - LEGEND_ROW + 4, colour))
                image = np.array(plotter.screenshot(return_img=True))[:, :, :3]
            finally:
                plotter.close()
    except (RuntimeError, OSError, AttributeError) as error:
        raise CaseInputError(
            f"{path.name}: the picture cannot be drawn ({error}); on a machine without a screen "
            "install OpenGL for software rendering (Debian: libgl1, libegl1, libosmesa6)"
        ) from error
    for top, colour in swatches:
        image[top - 1 : top + 19, 11:31] = 90
        image[top : top + 18, 12:30] = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(_png(image))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _toward(direction: str) -> Floats:
    """The unit vector from the head to the camera."""
    vector = np.array(DIRECTIONS[direction])
    unit: Floats = vector / np.linalg.norm(vector)
    return unit


def _place_camera(plotter: Any, view: _View, corners: Floats, width: float, height: float) -> float:
    """Looks at the whole box in parallel projection; the size of a pixel in mm."""
    toward = _toward(view.direction)
    middle = corners.mean(axis=0)
    across = np.cross(toward, (0.0, 0.0, 1.0))
    across = across / np.linalg.norm(across)
    upward = np.cross(across, toward)
    box = np.array([[corners[i >> a & 1, a] for a in range(3)] for i in range(8)]) - middle
    half_width, half_height = np.abs(box @ across).max(), np.abs(box @ upward).max()
    scale = MARGIN * float(max(half_height, half_width * height / width))
    plotter.enable_parallel_projection()
    camera = plotter.camera
    camera.focal_point = tuple(middle)
    camera.position = tuple(middle + 4.0 * np.linalg.norm(corners[1] - corners[0]) * toward)
    camera.up = (0.0, 0.0, 1.0)
    camera.parallel_scale = scale
    # A camera that was set by hand must not be put back when the first mesh comes.
    plotter.camera_set = True
    return 2.0 * scale / height


def _add_bone(plotter: Any, segment: BoneSegment, colour: str) -> None:
    plotter.add_mesh(
        _polydata(segment.surface.vertices, segment.surface.triangles),
        color=colour,
        smooth_shading=True,
        split_sharp_edges=True,
        feature_angle=50.0,
        ambient=0.15,
    )


def _png(image: NDArray[np.uint8]) -> bytes:
    """The bytes of a PNG file of an (h, w, 3) image, the same for the same image."""
    height, width, _ = image.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    rows[:, 1:] = image.reshape(height, -1)

    def chunk(name: bytes, data: bytes) -> bytes:
        check = zlib.crc32(name + data)
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", check)

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6))
        + chunk(b"IEND", b"")
    )


def _colours(names: Sequence[str]) -> dict[str, str]:
    others = iter(OTHER_COLOURS * (1 + len(names) // len(OTHER_COLOURS)))
    return {n: SEGMENT_COLOURS[n] if n in SEGMENT_COLOURS else next(others) for n in names}


def _bounds(clouds: Sequence[ArrayLike]) -> Floats:
    """Lowest and highest corner of all points, (2, 3)."""
    arrays = [np.asarray(c, dtype=np.float64) for c in clouds]
    return np.array(
        [
            np.min([a.min(axis=0) for a in arrays], axis=0),
            np.max([a.max(axis=0) for a in arrays], axis=0),
        ]
    )


def _polydata(vertices: ArrayLike, triangles: ArrayLike) -> Any:
    return _pyvista().PolyData.from_regular_faces(
        np.asarray(vertices, dtype=np.float64), np.asarray(triangles, dtype=np.int64)
    )


def _pyvista() -> Any:
    try:
        return import_module("pyvista")
    except ImportError as error:
        # VTK without libGL fails as an ImportError that names the library.
        raise CaseInputError(
            f"pictures are drawn with PyVista, which cannot be imported ({error}): "
            "pip install 'cmfsim[view]', and where libGL is missing install it (Debian: libgl1)"
        ) from error
