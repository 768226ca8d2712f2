"""Repair of triangle surfaces: merged, cleaned, oriented, capped; each is a finding."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.surfaces.checks import (
    areas_volumes,
    border_loops,
    check_extent,
    duplicate_triangles,
    has_three_corners,
    thin_triangles,
)
from cmfsim.surfaces.topology import component_labels, connected_labels, edges_of, orientation_flips
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData, triangle_areas, used_nodes

# Vertices closer than this share of the surface's extent are merged: 0.03 µm on a head, less than
# the resolution of single precision.
WELD_DISTANCE = 1e-7
# Pieces with less than this share of the largest piece's area are dropped.
KEEP_SHARE = 0.01
# An ear whose area is below this share of the loop's squared extent is cut off only if no other is
# left: cutting needles first would leave needles behind.
FLAT_EAR = 1e-9

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class RepairOptions:
    """Which repairs are made.

    Attributes
    ----------
    close_borders : bool
        Whether borders are closed by caps.
    outer_wall : bool
        Whether a large piece inside the largest is dropped: the inner wall of a skin that was saved
        as a shell. Hollows of air are far smaller.
    """

    close_borders: bool = True
    outer_wall: bool = False


def clean_surface(surface: SurfaceData) -> SurfaceData:
    """The surface without flat or repeated triangles and stray vertices; it may be empty."""
    vertices = surface.vertices
    triangles = surface.triangles.astype(np.int64)
    keep = np.ones(len(triangles), dtype=bool)
    keep[thin_triangles(vertices, triangles)[0]] = False
    keep[duplicate_triangles(triangles)] = False
    return _compact(vertices, triangles[keep], surface.crease_angle)


def repair_surface(
    surface: SurfaceData, name: str, options: RepairOptions | None = None
) -> tuple[SurfaceData, tuple[Finding, ...]]:
    """A closed surface with outward normals from one that is nearly so, and a finding per repair.

    Coincident vertices are merged. Triangles without area, duplicate triangles and small pieces are
    dropped. Triangles are flipped until neighbours agree and the largest piece encloses a positive
    volume; another piece that encloses a negative volume is kept as it is inside the largest, where
    it is a hollow, and turned elsewhere. Borders are closed by caps.

    Parameters
    ----------
    surface : SurfaceData
    name : str
        The surface's name in findings.
    options : RepairOptions, optional

    Returns
    -------
    SurfaceData
    tuple of Finding
        Notes, and a warning for each cap that is far from flat.

    Raises
    ------
    CaseError
        (also `ValueError`) No triangle with an area remains; a coordinate above 1e90 mm.

    Examples
    --------
    >>> import cmfsim
    >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> open_tet = cmfsim.SurfaceData(corners, [[0, 1, 2], [0, 3, 1], [0, 2, 3]])
    >>> closed, findings = cmfsim.repair_surface(open_tet, "tet")
    >>> len(closed.triangles), [finding.code for finding in findings]
    (4, ['surface-repaired', 'surface-open'])
    """
    options = options or RepairOptions()
    findings: list[Finding] = []

    def note(what: str, why: str) -> None:
        findings.append(Finding("surface-repaired", what, where=name, why=why))

    vertices = surface.vertices
    triangles = surface.triangles.astype(np.int64)
    check_extent(vertices)
    vertices, triangles, n_welded = _welded(vertices, triangles)
    if n_welded:
        note(f"{n_welded} vertices were merged with others", "they concealed edges")
    triangles, n_flat, n_again = _without_flat(vertices, triangles)
    if n_flat or n_again:
        what = f"{n_flat} triangles without area and {n_again} repeated ones are removed"
        note(what, "they have no normal, or their volume counts twice")
    if not len(triangles):
        raise CaseInputError(f"{name}: no triangle with an area is left")

    triangles, dropped = _without_debris(vertices, triangles)
    if dropped:
        what = f"{dropped} small pieces are dropped (below {KEEP_SHARE:.0%} of the largest)"
        note(what, "debris would become islands of bone or skin")
    triangles, n_turned = _outward(vertices, triangles)
    if options.outer_wall:
        triangles, wall = _without_inner_wall(vertices, triangles)
        if wall:
            findings.append(_wall_finding(name, wall))
    if n_turned:
        what = f"{n_turned} of {len(triangles)} triangles are flipped"
        note(what, "normals that point inwards swap inside and outside")
    if options.close_borders:
        caps = []
        for loop in border_loops(vertices, edges_of(triangles)):
            if len(loop.vertices) < 3:
                continue
            cap, bulge = cap_loop(vertices, loop.vertices)
            # Triangles of a cap that lie on a line would close a slit of no width.
            cap = np.delete(cap, thin_triangles(vertices, cap)[0], axis=0)
            if not len(cap):
                continue
            caps.append(cap)
            findings.append(_cap_finding(name, loop.length, loop.centre, bulge))
        triangles = np.concatenate([triangles, *caps])
    return _compact(vertices, triangles, surface.crease_angle), tuple(findings)


# A cap whose border departs from a plane by more than this share of its length covers a region of
# unknown shape.
FLAT_SHARE = 0.05


def _cap_finding(name: str, length: float, centre: Floats, bulge: float) -> Finding:
    flat = bulge <= FLAT_SHARE * length
    place = ", ".join(f"{x:.1f}" for x in centre)
    return Finding(
        "surface-open",
        f"a border of {length:.1f} mm (at most {bulge:.1f} mm from a plane) is closed by a cap",
        severity="note" if flat else "warning",
        where=f"{name} at ({place})",
        why="only a closed surface has an inside and an outside"
        + ("" if flat else "; this cap is far from flat, so its shape is only a guess"),
        fix="check the cap; if it is wrong, close the surface yourself",
    )


# The code of findings on a skin that was saved as a shell.
INNER_WALL = "surface-inner-wall"
# Share of the outer wall's volume that an inner wall encloses at least: a shell 15 mm thick has a
# half, and airways and sinuses together a twentieth.
WALL_SHARE = 0.3


def _without_inner_wall(vertices: Floats, triangles: Integers) -> tuple[Integers, float]:
    """Triangles without inner walls, and which share of the volume the largest of them enclosed."""
    labels = component_labels(edges_of(triangles), len(triangles))
    volumes = np.abs(np.bincount(labels, weights=areas_volumes(vertices, triangles)[1]))
    outer = int(np.argmax(volumes))
    large = [p for p in np.flatnonzero(volumes > WALL_SHARE * volumes[outer]) if p != outer]
    if not large:
        return triangles, 0.0
    body = _compact(vertices, triangles[labels == outer], 180.0)
    samples = np.array([vertices[triangles[labels == p][0]].mean(axis=0) for p in large])
    inside = np.abs(Surface(body.vertices, body.triangles).winding_number(samples)) > 0.5
    walls = np.array(large)[inside]
    if not len(walls):
        return triangles, 0.0
    return triangles[~np.isin(labels, walls)], float(volumes[walls].max() / volumes[outer])


def _wall_finding(name: str, share: float) -> Finding:
    return Finding(
        INNER_WALL,
        f"the {name} has an inner wall, which encloses {share:.0%} of the outer one's volume; the "
        "outer wall alone is used",
        severity="warning",
        where=name,
    )


def _compact(vertices: Floats, triangles: Integers, crease_angle: float) -> SurfaceData:
    used, corners = used_nodes(triangles)
    return SurfaceData(vertices[used], corners, crease_angle)


def _welded(vertices: Floats, triangles: Integers) -> tuple[Floats, Integers, int]:
    """Vertices, merged where closer than a share of the extent; the first of each group is kept."""
    if not len(vertices):
        return vertices, triangles, 0
    extent = float((vertices.max(axis=0) - vertices.min(axis=0)).max())
    distance = WELD_DISTANCE * extent
    if distance == 0.0:
        return vertices, triangles, 0
    labels = connected_labels(_near_pairs(vertices, distance), len(vertices))
    _, first = np.unique(labels, return_index=True)
    return vertices[first], labels[triangles], len(vertices) - len(first)


def _near_pairs(vertices: Floats, distance: float) -> Integers:
    """Pairs of vertices that lie within a distance, by grids shifted by half a cell each way.

    Any two that are closer than the distance share a cell, of twice that width, in one of the eight
    grids.
    """
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    places = (vertices - vertices.min(axis=0)).T / (2.0 * distance)
    for corner in range(8):
        x, y, z = (np.floor(v + 0.5 * ((corner >> axis) & 1)) for axis, v in enumerate(places))
        order = np.lexsort((x, y, z))
        one, other = order[:-1], order[1:]
        near = (x[one] == x[other]) & (y[one] == y[other]) & (z[one] == z[other])
        one, other = one[near], other[near]
        near = np.linalg.norm(vertices[one] - vertices[other], axis=1) <= distance
        pairs.append(np.stack([one[near], other[near]], axis=1))
    return np.concatenate(pairs)


# Rounds, and number of flat triangles, up to which these are removed without opening a slit; a
# surface with more of them has another defect.
FLAT_ROUNDS, MAX_FLAT = 8, 2000
# Share of the longest edge below which the shortest is a point.
POINT_SHARE = 1e-3


def _without_flat(vertices: Floats, triangles: Integers) -> tuple[Integers, int, int]:
    """Triangles without flat and duplicate ones, and how many of each were removed.

    Deleting a flat triangle would leave a slit of no width. One with two coincident corners
    disappears when these are merged. One with a corner on its longest edge is merged into the
    triangle across that edge, which is split in two at the corner.
    """
    n_flat = len(thin_triangles(vertices, triangles)[0])
    n_again = 0
    for _ in range(FLAT_ROUNDS):
        triangles = triangles[has_three_corners(triangles)]
        before = len(triangles)
        triangles = np.delete(triangles, duplicate_triangles(triangles), axis=0)
        n_again += before - len(triangles)
        flat = thin_triangles(vertices, triangles)[0]
        if not 0 < len(flat) <= MAX_FLAT:
            break
        corners = vertices[triangles[flat]]
        # Edge i lies opposite corner i.
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), axis=2)
        is_point = lengths.min(axis=1) <= POINT_SHARE * lengths.max(axis=1)
        if is_point.any():
            short = lengths[is_point].argmin(axis=1)
            rows = triangles[flat[is_point]]
            ends = [rows[np.arange(len(rows)), (short + step) % 3] for step in (1, 2)]
            labels = connected_labels(np.stack(ends, axis=1), len(vertices))
            _, first = np.unique(labels, return_index=True)
            triangles = first[labels][triangles]
        else:
            triangles = _with_turned_edges(triangles, flat, lengths.argmax(axis=1))
    flat = thin_triangles(vertices, triangles)[0]
    triangles = np.delete(triangles, flat, axis=0)
    return triangles, n_flat, n_again


def _with_turned_edges(triangles: Integers, flat: Integers, longest: Integers) -> Integers:
    """Triangles with the longest edge of each flat one flipped, in it and in its neighbour."""
    triangles = triangles.copy()
    done: set[int] = set()
    for number, corner in zip(flat.tolist(), longest.tolist(), strict=True):
        tip, start, end = np.roll(triangles[number], -corner)
        across = np.flatnonzero(
            (triangles == start).any(axis=1) & (triangles == end).any(axis=1)
        ).tolist()
        others = [t for t in across if t != number]
        if len(others) != 1 or {number, others[0]} & done:
            continue
        other = others[0]
        far = next(v for v in triangles[other].tolist() if v not in {start, end})
        # The neighbour runs from end to start; if it does not, the surface is inconsistent there.
        row = triangles[other].tolist()
        if row[(row.index(end) + 1) % 3] != start:
            continue
        triangles[number] = (tip, start, far)
        triangles[other] = (tip, far, end)
        done |= {number, other}
    return triangles


def _without_debris(vertices: Floats, triangles: Integers) -> tuple[Integers, int]:
    labels = component_labels(edges_of(triangles), len(triangles))
    areas = np.bincount(labels, weights=triangle_areas(vertices, triangles))
    keep = areas >= KEEP_SHARE * areas.max()
    return triangles[keep[labels]], int((~keep).sum())


def _outward(vertices: Floats, triangles: Integers) -> tuple[Integers, int]:
    """Triangles flipped until neighbours agree and solid pieces enclose positive volumes."""
    edges = edges_of(triangles)
    flips, _ = orientation_flips(edges, len(triangles))
    labels = component_labels(edges, len(triangles))
    oriented = np.where(flips[:, None], triangles[:, ::-1], triangles)
    areas, volumes = (np.bincount(labels, w) for w in areas_volumes(vertices, oriented))
    largest = int(np.argmax(areas))
    turn = np.zeros(len(volumes), dtype=bool)
    if volumes[largest] < 0.0:
        # A surface that is inside out as a whole keeps its hollows if all of it is turned.
        turn[:] = True
        volumes = -volumes
    inward = [piece for piece in np.flatnonzero(volumes < 0.0) if piece != largest]
    if inward:
        turned = turn[labels][:, None]
        body = np.where(turned, oriented[:, ::-1], oriented)[labels == largest]
        outer = _compact(vertices, body, 180.0)
        samples = [vertices[oriented[labels == piece][0]].mean(axis=0) for piece in inward]
        inside = Surface(outer.vertices, outer.triangles).winding_number(np.array(samples)) > 0.5
        for piece, hollow in zip(inward, inside, strict=True):
            turn[piece] ^= not hollow
    flips ^= turn[labels]
    return np.where(flips[:, None], triangles[:, ::-1], triangles), int(flips.sum())


def cap_loop(vertices: Floats, loop: Integers) -> tuple[Integers, float]:
    """The triangles of a cap and the largest distance of its border from the plane that fits best.

    loop: (k,) int64. Vertices in the order in which the triangles at the border run.
    Returns: (k − 2, 3) int64. They run through the border the other way: the surface is consistent.

    Ear clipping (Meisters 1975) in the best plane. A loop that crosses itself there has no ears at
    some stage; the corner with the shortest new edge is then cut off, which still closes it.
    """
    points = vertices[loop[::-1]]
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    # Twice the vector area of the loop (Newell).
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    if float(np.linalg.norm(normal)) == 0.0:
        normal = axes[2]
    normal = normal / np.linalg.norm(normal)
    across = axes[0] - (axes[0] @ normal) * normal
    if float(np.linalg.norm(across)) < 1e-6:
        across = axes[1] - (axes[1] @ normal) * normal
    across = across / np.linalg.norm(across)
    flat = np.stack([centred @ across, centred @ np.cross(normal, across)], axis=1)
    bulge = float(np.abs(centred @ normal).max())
    return loop[::-1][_clip_ears(flat)], bulge


def _clip_ears(flat: Floats) -> Integers:
    """The triangles, as places in an anticlockwise polygon, of its ears one after another."""
    left = list(range(len(flat)))
    triangles: list[tuple[int, int, int]] = []
    smallest = FLAT_EAR * float(np.ptp(flat, axis=0).max()) ** 2
    while len(left) > 3:
        place = np.array(left)
        points = flat[place]
        before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
        area = _cross(points - before, after - points)
        chord = np.linalg.norm(after - before, axis=1)
        # Shortest chord first: round triangles instead of fans of needles.
        order = np.lexsort((chord, area <= smallest))
        chosen = next(
            (int(i) for i in order if area[i] > smallest and _is_ear(points, int(i))),
            int(np.argmin(chord)),
        )
        triangles.append((left[chosen - 1], left[chosen], left[(chosen + 1) % len(left)]))
        del left[chosen]
    triangles.append((left[0], left[1], left[2]))
    return np.array(triangles, dtype=np.int64)


def _is_ear(points: Floats, i: int) -> bool:
    """Whether no other corner lies in the triangle of corner i and its neighbours."""
    n = len(points)
    a, b, c = points[i - 1], points[i], points[(i + 1) % n]
    others = np.delete(points, [(i - 1) % n, i, (i + 1) % n], axis=0)
    inside = (
        (_cross(b - a, others - a) >= 0.0)
        & (_cross(c - b, others - b) >= 0.0)
        & (_cross(a - c, others - c) >= 0.0)
    )
    return not bool(inside.any())


def _cross(a: Floats, b: Floats) -> Floats:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
