"""Pictures of a case, drawn off screen: anatomy, bone segments, node kinds. Needs PyVista.

Cameras look along the patient's axes (LPS) and depend on the bounds alone, so that pictures of two
plans lie on top of each other.
"""

import contextlib
import os
import struct
import subprocess
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.case import NODE_KINDS, BoneSegment, NodeKinds
from cmfsim.checks import Floats, as_index_rows, as_positive, as_rows
from cmfsim.errors import CaseInputError
from cmfsim.scene import SurfaceData

__all__ = [
    "View",
    "bounds",
    "draw",
    "picture_anatomy",
    "picture_node_kinds",
    "picture_segments",
    "polydata",
]

SIZE = (1600, 900)
SKIN_COLOUR = "#e3b7a0"
# Kim et al. (2010), Figure 4: fixed pink, joined orange, sliding blue, free white.
KIND_COLOURS: Mapping[str, str] = MappingProxyType(
    {"fixed": "#f08cb4", "joined": "#f28500", "sliding": "#2f6fd0", "free": "#ffffff"}
)
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
TEXT_SIZE = 9
LEGEND_ROW = 26  # pixels
# What draws nothing into a small window. Where OpenGL is missing VTK ends the process instead of
# raising, so this is tried in a process of its own, once.
PROBE = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(True)
window.SetSize(8, 8)
window.Render()
"""
# Time after which the probe counts as failed, s; it takes half a second.
PROBE_TIME = 60.0
NO_OPENGL = (
    "on a machine without a screen install OpenGL for software rendering "
    "(Debian: libgl1, libegl1, libosmesa6)"
)


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
    corners = bounds([np.asarray(s.surface.vertices) for s in segments])

    def paint(plotter: Any, view: View) -> None:
        del view
        for segment in segments:
            _add_bone(plotter, segment, colours[segment.name])

    views = tuple(View(name, name) for name in ("front", "left front", "left"))
    draw(path, views, corners, size, paint, list(colours.items()))


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
    corners = bounds([np.asarray(skin.vertices), *(s.surface.vertices for s in segments)])

    def paint(plotter: Any, view: View) -> None:
        del view
        for segment in segments:
            _add_bone(plotter, segment, colours[segment.name])
        shape = polydata(skin.vertices, skin.triangles)
        plotter.add_mesh(shape, color=SKIN_COLOUR, opacity=0.35, smooth_shading=True)

    views = tuple(View(name, name) for name in ("right", "front", "left"))
    draw(path, views, corners, size, paint, [("skin", SKIN_COLOUR), *colours.items()])


def picture_node_kinds(
    path: str | os.PathLike[str],
    nodes: ArrayLike,
    boundary_triangles: ArrayLike,
    kinds: NodeKinds,
    *,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes a picture of the node kinds in the colours of Kim et al. (2010), Figure 4.

    The boundary of the mesh, each node with its share of the triangles round it: the whole of it,
    then without its free part, so that the interface with the bones shows, from the left, from the
    front and from behind.

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
    ...     "kinds.png", mesh.nodes, mesh.boundary_triangles(), found.kinds
    ... )  # doctest: +SKIP
    """
    points = as_rows("nodes", nodes, 3)
    triangles = as_index_rows("boundary triangles", boundary_triangles, 3, len(points), "nodes")
    if len(kinds.kind) != len(points):
        raise CaseInputError(f"kinds are of {len(kinds.kind)} nodes, but there are {len(points)}")
    if not len(triangles):
        raise CaseInputError("the mesh has no boundary triangles to draw")
    held = (kinds.kind[triangles] > 0).any(axis=1)
    corners = bounds([points[np.unique(triangles)]])
    # What closes the mesh behind would hide all else from there: the rearmost cut is left out.
    edge = points[triangles[:, 0]] - points[triangles[:, 1]]
    rear = corners[1, 1] - 0.5 * float(np.median(np.linalg.norm(edge, axis=1)))
    closing = (points[triangles][:, :, 1] >= rear).all(axis=1)
    entries = [
        (f"{name} {len(kinds.nodes(name))}", KIND_COLOURS[name])
        for name in ("fixed", "joined", "sliding", "free")
    ]

    def paint(plotter: Any, view: View) -> None:
        shown = triangles
        if view.bare:
            shown = triangles[held & ~closing]
        for number, name in enumerate(NODE_KINDS):
            corner = _corners_of_kind(points, shown, kinds.kind == number)
            if len(corner):
                count = np.arange(3 * len(corner)).reshape(-1, 3)
                plotter.add_mesh(
                    polydata(corner.reshape(-1, 3), count),
                    color=KIND_COLOURS[name],
                    ambient=0.25,
                    specular=0.0,
                )

    views = (
        View("left front", "whole boundary"),
        View("left", "left, without the free part", bare=True),
        View("front", "front, without the free part", bare=True),
        View("behind", "from behind, without the free part", bare=True),
    )
    draw(path, views, corners, size, paint, entries)


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


@dataclass(frozen=True)
class View:
    """One of the views side by side: where the camera stands, and what is written below."""

    direction: str
    caption: str
    bare: bool = False


def draw(
    path: str | os.PathLike[str],
    views: Sequence[View],
    corners: Floats,
    size: tuple[int, int],
    paint: Callable[[Any, View], None],
    legend: Sequence[tuple[str, str]],
) -> None:
    """Writes the views side by side, under a temporary name first."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise CaseInputError(f"{path.name}: a picture is written as .png, not {path.suffix!r}")
    width, height = (int(as_positive("picture size", n)) for n in size)
    pv = _pyvista()
    if not _can_draw():
        raise CaseInputError(
            f"{path.name}: the picture cannot be drawn (OpenGL does not work); {NO_OPENGL}"
        )
    # One scale for all views.
    half = max(_half_height(view, corners, width / len(views), height) for view in views)
    try:
        # PyVista and VTK warn of missing screens; whether the picture was made decides here.
        with _silent_vtk(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            plotter = pv.Plotter(
                off_screen=True, shape=(1, len(views)), window_size=[width, height], border=False
            )
            try:
                plotter.enable_anti_aliasing("ssaa")
                for column, view in enumerate(views):
                    plotter.subplot(0, column)
                    plotter.set_background("white")
                    _place_camera(plotter, view, corners, half)
                    paint(plotter, view)
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
            f"{path.name}: the picture cannot be drawn ({error}); {NO_OPENGL}"
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


def _half_height(view: View, corners: Floats, width: float, height: float) -> float:
    """Half the height, in mm, that a view needs to show the whole box."""
    toward = _toward(view.direction)
    across = np.cross(toward, (0.0, 0.0, 1.0))
    across = across / np.linalg.norm(across)
    box = np.array([[corners[i >> a & 1, a] for a in range(3)] for i in range(8)])
    box -= corners.mean(axis=0)
    upright = np.abs(box @ np.cross(across, toward)).max()
    return MARGIN * float(max(upright, np.abs(box @ across).max() * height / width))


def _place_camera(plotter: Any, view: View, corners: Floats, half_height: float) -> None:
    """Looks at the middle of the box in parallel projection."""
    middle = corners.mean(axis=0)
    distance = 4.0 * float(np.linalg.norm(corners[1] - corners[0]))
    plotter.enable_parallel_projection()
    camera = plotter.camera
    camera.focal_point = tuple(middle)
    camera.position = tuple(middle + distance * _toward(view.direction))
    camera.up = (0.0, 0.0, 1.0)
    camera.parallel_scale = half_height
    # A camera that was set by hand must not be put back when the first mesh comes.
    plotter.camera_set = True


def _add_bone(plotter: Any, segment: BoneSegment, colour: str) -> None:
    plotter.add_mesh(
        polydata(segment.surface.vertices, segment.surface.triangles),
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


def bounds(clouds: Sequence[ArrayLike]) -> Floats:
    """Lowest and highest corner of all points, (2, 3)."""
    arrays = [np.asarray(c, dtype=np.float64) for c in clouds]
    return np.array(
        [
            np.min([a.min(axis=0) for a in arrays], axis=0),
            np.max([a.max(axis=0) for a in arrays], axis=0),
        ]
    )


def polydata(vertices: ArrayLike, triangles: ArrayLike) -> Any:
    """A surface as PyVista has it."""
    return _pyvista().PolyData.from_regular_faces(
        np.asarray(vertices, dtype=np.float64), np.asarray(triangles, dtype=np.int64)
    )


@cache
def _can_draw() -> bool:
    """Whether VTK can draw here, asked of another process: it may crash."""
    if not sys.executable:
        return True
    try:
        probe = subprocess.run(  # noqa: S603 (this interpreter, and a text of this file)
            [sys.executable, "-c", PROBE],
            env={**os.environ, "PYTHONSAFEPATH": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=PROBE_TIME,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return probe.returncode == 0


@contextlib.contextmanager
def _silent_vtk() -> Iterator[None]:
    """Keeps VTK's warnings, as of a screen that is not there, off the standard error."""
    logger = import_module("vtkmodules.vtkCommonCore").vtkLogger
    before = logger.GetCurrentVerbosityCutoff()
    logger.SetStderrVerbosity(logger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        logger.SetStderrVerbosity(before)


def _pyvista() -> Any:
    try:
        return import_module("pyvista")
    except ImportError as error:
        # VTK without libGL fails as an ImportError that names the library.
        raise CaseInputError(
            f"pictures are drawn with PyVista, which cannot be imported ({error}): "
            "pip install 'cmfsim[view]', and where libGL is missing install it (Debian: libgl1)"
        ) from error
