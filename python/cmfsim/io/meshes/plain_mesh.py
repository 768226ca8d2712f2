"""A mesh as a file has it, points, cells, values, frame; tets repaired; triangles from faces.

Indices are checked, and polygons are cut only where one way alone is right.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, Indices, as_index_rows, as_rows
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import used_nodes

Integers = NDArray[np.int64]
# The limits of `TetMesh`: volume over longest edge cubed, and the longest edge, mm.
DEGENERATE_VOLUME, SHORTEST_EDGE = 1e-12, 1e-9
# Largest coordinate, whatever its unit: a head in µm has 1e6. Far larger ones overflow in areas and
# volumes.
MAX_COORDINATE = 1e9
# Corners of a cell of each type that has straight edges.
CELL_CORNERS = {
    "vertex": 1, "line": 2, "triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6,
    "hexahedron": 8,
}  # fmt: skip


class RepairedTets(NamedTuple):
    """A mesh whose tets are oriented and enclose a volume.

    Attributes
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32
    kept_nodes, kept_tets : (n,) and (m,) int64
        The number that each had: `values[kept_nodes]` are the values of these nodes.
    n_turned, n_dropped : int
        Tets that were negative, and tets without volume, which are gone.
    """

    nodes: Floats
    tets: Indices
    kept_nodes: Integers
    kept_tets: Integers
    n_turned: int
    n_dropped: int


def repair_tets(nodes: ArrayLike, tets: ArrayLike) -> RepairedTets:
    """Tets as `TetMesh` takes them, from those of another program, with the number of changes.

    Negative tets are turned. Tets without volume are dropped, then the nodes that no tet uses.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32

    Raises
    ------
    CaseError
        (also `ValueError`) An index that is not there, a node that is not finite, no volume.

    Examples
    --------
    >>> import cmfsim
    >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]]
    >>> found = cmfsim.repair_tets(corners, [[0, 2, 1, 3], [0, 1, 2, 4]])
    >>> found.n_turned, found.n_dropped, len(found.nodes)
    (1, 1, 4)
    """
    places = as_rows("nodes", nodes, 3)
    turned, volumes = oriented(places, as_index_rows("tets", tets, 4, len(places), "nodes"))
    corners = places[turned]
    pairs = combinations(range(4), 2)
    edge = np.max([np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a, b in pairs], axis=0)
    solid = (np.abs(volumes) > DEGENERATE_VOLUME * edge**3) & (edge >= SHORTEST_EDGE)
    if not solid.any():
        raise CaseInputError(f"none of {len(turned)} tets has a volume")
    used, numbered = used_nodes(turned[solid])
    return RepairedTets(
        places[used],
        numbered.astype(np.uint32),
        used,
        np.flatnonzero(solid),
        int(np.count_nonzero(volumes[solid] < 0.0)),
        int(np.count_nonzero(~solid)),
    )


def oriented(nodes: Floats, tets: Indices) -> tuple[Indices, Floats]:
    """Tets (m, 4) with the negative ones turned, and their volumes before, (m,) mm³.

    Programs differ in the order of nodes: which one a mesh has, its volumes say.
    """
    corners, turned = nodes[tets], tets.copy()
    volumes: Floats = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    negative = volumes < 0.0
    turned[negative] = turned[negative][:, [0, 1, 3, 2]]
    return turned, volumes


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one type, "triangle", "tetra", …: indices of points (m, k) int64, from 0 on."""

    type: str
    data: Integers


@dataclass(frozen=True, eq=False)
class PlainMesh:
    """Points (n, 3) and cells of a file, checked: finite, and no index beyond the points.

    point_data, cell_data: (n, …), and (m, …) for each entry of `cells`.
    frame: "LPS" or "RAS" where the file's header states it.
    findings: What was ignored on reading, although the file states it.
    """

    points: Floats
    cells: tuple[Cells, ...]
    point_data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    cell_data: Mapping[str, tuple[NDArray[Any], ...]] = field(default_factory=dict)
    frame: str | None = None
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        points = self.points
        if points.ndim != 2 or points.shape[1] != 3:
            raise CaseInputError(f"has points of shape {points.shape}: (n, 3) is needed")
        if not np.isfinite(points).all():
            row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            raise CaseInputError(f"point {row} is not finite: every coordinate must be finite")
        if points.size and float(np.abs(points).max()) > MAX_COORDINATE:
            bad, axis = np.argwhere(np.abs(points) > MAX_COORDINATE)[0]
            raise CaseInputError(
                f"point {bad} has the coordinate {points[bad, axis]:g}: at most {MAX_COORDINATE:g} "
                "is read, in any unit; is the file damaged?"
            )
        for block in self.cells:
            _check_block(block, len(points))
        for name, array in self.point_data.items():
            if len(array) != len(points):
                raise CaseInputError(
                    f"point data {name!r} has {len(array)} rows for {len(points)} points"
                )
        for name, arrays in self.cell_data.items():
            rows = [len(a) for a in arrays]
            needed = [len(block.data) for block in self.cells]
            if rows != needed:
                raise CaseInputError(f"cell data {name!r} has {rows} rows for {needed} cells")

    @property
    def cells_dict(self) -> dict[str, Integers]:
        """All cells of each type."""
        types = dict.fromkeys(block.type for block in self.cells)
        return {
            t: np.concatenate([block.data for block in self.cells if block.type == t])
            for t in types
        }

    @property
    def found(self) -> str:
        """The types of cells that there are, as errors name them."""
        return ", ".join(sorted({block.type for block in self.cells if len(block.data)})) or (
            "nothing"
        )


def _check_block(block: Cells, count: int) -> None:
    wanted = CELL_CORNERS.get(block.type)
    if block.data.ndim != 2 or (wanted is not None and block.data.shape[1] != wanted):
        raise CaseInputError(f"has cells {block.type!r} of shape {block.data.shape}")
    bad = np.argwhere((block.data < 0) | (block.data >= count))
    if len(bad):
        row, column = bad[0]
        raise CaseInputError(
            f"{block.type} {row} names point {block.data[row, column]}, but there are {count} "
            f"points (allowed {f'0 to {count - 1}' if count else 'none'})"
        )


# VTK's numbers (vtkCellType.h); other cells keep their number as their name.
NAMES = {
    1: "vertex", 3: "line", 5: "triangle", 9: "quad", 10: "tetra", 12: "hexahedron", 13: "wedge",
    14: "pyramid", 21: "line3", 22: "triangle6", 24: "tetra10",
}  # fmt: skip


def cells_by_type(
    types: Integers, counts: Integers, corners: Integers
) -> tuple[tuple[Cells, ...], tuple[Integers, ...]]:
    """Cells grouped by type, and the number of each in the file.

    types, counts: (m,) int64, with the number of corners of each cell.
    corners: (sum of counts,) int64.
    """
    starts = np.cumsum(counts) - counts
    blocks, rows = list[Cells](), list[Integers]()
    for number in dict.fromkeys(types.tolist()):
        name = NAMES.get(number, f"VTK cell {number}")
        of_type = np.flatnonzero(types == number)
        # Polygons and the like differ in their number of corners.
        for size in np.unique(counts[of_type]):
            mine = of_type[counts[of_type] == size]
            wanted = CELL_CORNERS.get(name)
            if wanted is not None and size != wanted:
                raise CaseInputError(
                    f"cell {mine[0]} is a {name} with {size} corners: {wanted} are needed"
                )
            blocks.append(Cells(name, corners[starts[mine][:, None] + np.arange(size)]))
            rows.append(mine)
    return tuple(blocks), tuple(rows)


# As 3D Slicer writes it; and the words of this package's own files.
SLICER = re.compile(rb"\bSPACE=([A-Za-z]+)")
OWN = re.compile(rb"^(?:cmfsim |comment |# )LPS mm\b", re.MULTILINE)
# Headers end before this, bytes: PLY's has the longest.
MOST_HEADER = 2**16
STL_HEADER = 80


def stated_frame(data: bytes, suffix: str) -> str | None:
    """The frame in the header of a whole STL, PLY, OBJ or legacy VTK file; None if it states none.

    The suffix is its ending in lower case, such as ".stl".
    """
    head = _header(data[:MOST_HEADER], suffix)
    found = {match.upper() for match in SLICER.findall(head)}
    if len(found) > 1:
        names = " and ".join(sorted(name.decode() for name in found))
        raise CaseInputError(f"its header states two frames, {names}: export it again")
    return stated_in_field(found.pop()) if found else None


def is_own_file(path: Path) -> bool:
    """Whether a surface states "LPS mm" as this package writes it.

    Where a case states another frame, that is used: the writer cannot know what it was given.
    """
    with path.open("rb") as file:
        return OWN.search(_header(file.read(MOST_HEADER), path.suffix.lower())) is not None


def stated_in_field(name: bytes) -> str:
    """The frame of the name that a file gives for its space: "LPS" or "RAS"."""
    if name not in {b"LPS", b"RAS"}:
        shown = name[:20].decode("ascii", "replace")
        raise CaseInputError(
            f"its header states SPACE={shown}: LPS and RAS are read; export it from 3D Slicer again"
        )
    return name.decode()


def _header(head: bytes, suffix: str) -> bytes:
    """The part of a file's first bytes in which a program may state what it likes."""
    if suffix == ".stl":
        return head[:STL_HEADER].partition(b"\n")[0]
    if suffix == ".ply":
        comments = head.partition(b"end_header")[0].splitlines()
        return b"\n".join(line for line in comments if line.startswith((b"comment", b"obj_info")))
    if suffix == ".obj":
        lines: list[bytes] = []
        for line in head.splitlines():
            if line.strip() and not line.startswith(b"#"):
                break
            lines.append(line)
        return b"\n".join(lines)
    # Legacy VTK: its second line is a title.
    return b"\n".join(head.split(b"\n", 2)[1:2])


# A corner may turn inwards by this share of a polygon's area and count as rounding.
FLAT_SHARE = 1e-9


def checked_indices(
    indices: Integers, count: int, *, of: str = "triangle", first: int = 0
) -> Integers:
    """The indices (m, k), from 0 on, if each names one of `count` vertices.

    of, first: What a row is, and how the file numbers the first vertex (1 in OBJ), for the error.
    """
    if indices.size and (int(indices.min()) < 0 or int(indices.max()) >= count):
        row, column = np.argwhere((indices < 0) | (indices >= count))[0]
        value = int(indices[row, column]) + first
        allowed = f"{first} to {count - 1 + first}" if count else "none"
        hint = "" if first else "; is the file numbered from 1?" if value == count else ""
        raise CaseInputError(
            f"{of} {row} names vertex {value}, but there are {count} vertices (allowed {allowed})"
            f"{hint}"
        )
    return indices


def _check_corners(of: str, counts: Integers) -> None:
    few = np.flatnonzero(counts < 3)
    if len(few):
        raise CaseInputError(
            f"{of} {few[0]} has {counts[few[0]]} corners: three or more are needed"
        )


def triangles_of(
    points: Floats, counts: Integers, corners: Integers, *, first: int = 0
) -> Integers:
    """The triangles (t, 3) of faces, in the order of the faces.

    A polygon becomes a fan of triangles about its first corner from which all of them face the same
    way; one that no fan fills, such as a star or a bow, is refused.

    counts, corners: (f,), number of corners of each face, and (sum of counts,), from 0 on.
    first: Number of the first vertex in the file's own count.
    """
    _check_corners("face", counts)
    if not (counts > 3).any():
        return checked_indices(corners.reshape(-1, 3), len(points), of="face", first=first)
    starts = np.cumsum(counts) - counts
    face = np.repeat(np.arange(len(counts)), counts)
    bad = np.flatnonzero((corners < 0) | (corners >= len(points)))
    if len(bad):
        value = int(corners[bad[0]]) + first
        raise CaseInputError(
            f"face {face[bad[0]]} names vertex {value}, but there are {len(points)} vertices"
        )
    corners = corners.copy()
    for size in np.unique(counts[counts > 3]):
        mine = np.flatnonzero(counts == size)
        rows = starts[mine][:, None] + np.arange(size)
        corners[rows] = _turned(points, corners[rows], mine)
    n_fan = counts - 2
    owner = np.repeat(np.arange(len(counts)), n_fan)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(n_fan) - n_fan, n_fan) + 1
    at = starts[owner]
    return np.stack([corners[at], corners[at + step], corners[at + step + 1]], axis=1)


def triangles_of_strips(points: Floats, counts: Integers, corners: Integers) -> Integers:
    """The triangles (t, 3) of strips, each of which shares an edge with the one before.

    Every other triangle of a strip runs the other way round, so that all face the same way. One
    that names a corner twice joins two parts of a strip and is none.

    counts, corners: (s,), number of corners of each strip, and (sum of counts,), from 0 on.
    """
    _check_corners("strip", counts)
    begins = np.cumsum(counts) - counts
    within = np.arange(int(counts.sum())) - np.repeat(begins, counts)
    # A triangle begins at each corner of a strip but its last two.
    at = np.flatnonzero(within < np.repeat(counts, counts) - 2)
    odd = within[at] % 2
    triangles = np.stack([corners[at + odd], corners[at + 1 - odd], corners[at + 2]], axis=1)
    checked_indices(triangles, len(points), of="triangle")
    a, b, c = triangles.T
    whole: Integers = triangles[(a != b) & (b != c) & (c != a)]
    return whole


def _turned(points: Floats, polygons: Integers, faces: Integers) -> Integers:
    """Polygons (m, k) that each begin at a corner whose fan fills them."""
    polygons = polygons.copy()
    todo = np.arange(len(polygons))
    for _ in range(polygons.shape[1]):
        places = points[polygons[todo]]
        spokes = places[:, 1:] - places[:, :1]
        normals = np.cross(spokes[:, :-1], spokes[:, 1:])
        whole = normals.sum(axis=1)
        along = (normals * whole[:, None]).sum(axis=2)
        least = -FLAT_SHARE * (whole * whole).sum(axis=1)
        todo = todo[~(along >= least[:, None]).all(axis=1)]
        if not len(todo):
            return polygons
        polygons[todo] = np.roll(polygons[todo], -1, axis=1)
    raise CaseInputError(
        f"face {faces[todo[0]]} has {polygons.shape[1]} corners that no fan of triangles fills: "
        "triangulate the surface before it is exported"
    )
