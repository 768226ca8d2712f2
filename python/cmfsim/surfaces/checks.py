"""Checks of a triangle surface: borders, debris, orientation, crossings, slivers.

Nothing here changes a surface; `repair_surface` does. The checks sort the edges a few times; the
search for crossings sorts the triangles into a grid.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.surfaces.crossings import crossing_pairs
from cmfsim.surfaces.topology import Edges, component_labels, edges_of, loops_of, orientation_flips
from cmfsim.values.checks import Floats, brief
from cmfsim.values.surface_data import SurfaceData, triangle_areas

# Largest coordinate for which areas and volumes stay finite, mm.
MAX_COORDINATE = 1e90

# A triangle whose height is below this share of its longest edge has no area: with coordinates of
# some 1000 mm in double precision, its normal is rounding error.
DEGENERATE_HEIGHT = 1e-9
# Below this share it is a sliver: distances to it are accurate, but its normal is not.
SLIVER_HEIGHT = 0.01


@dataclass(frozen=True, eq=False)
class BorderLoop:
    """One closed border: vertices in the direction of its triangles, their mean, length, mm."""

    vertices: NDArray[np.int64]
    length: float
    centre: Floats


@dataclass(frozen=True, eq=False)
class Component:
    """One connected piece of a surface, by shared edges; mm.

    volume: Signed, with the triangles oriented as they are; meaningful only if the piece is closed.
    """

    n_triangles: int
    area: float
    volume: float
    centre: Floats
    is_closed: bool


@dataclass(frozen=True, eq=False)
class SurfaceReport:
    """The state of a surface, in counts and places.

    Attributes
    ----------
    n_vertices, n_triangles : int
    lowest, highest : (3,) float64, mm
        Bounds of the vertices that triangles use.
    area : float, mm²
    volume : float, mm³
        Signed: negative where normals point inwards.
    degenerate : (k,) int64
        Triangles without area.
    duplicate : (k,) int64
        Triangles with the same corners as an earlier one, in either orientation.
    slivers : (k,) int64
        Triangles much lower than they are long, without the degenerate ones.
    non_manifold : (k, 2) int64
        Edges shared by more than two triangles, each as its two vertices.
    inconsistent : int
        Number of edges that both adjacent triangles traverse in the same direction.
    orientable : bool
    borders : tuple of BorderLoop
        Longest first.
    components : tuple of Component
        Largest area first.
    crossings : (k, 2) int64 or None
        Pairs of triangles that intersect; None if crossings were not checked.
    crossing_points : (k, 3) float64, mm, or None
        A place near each crossing.
    """

    n_vertices: int
    n_triangles: int
    lowest: Floats
    highest: Floats
    area: float
    volume: float
    degenerate: NDArray[np.int64]
    duplicate: NDArray[np.int64]
    slivers: NDArray[np.int64]
    non_manifold: NDArray[np.int64]
    inconsistent: int
    orientable: bool
    borders: tuple[BorderLoop, ...]
    components: tuple[Component, ...]
    crossings: NDArray[np.int64] | None = None
    crossing_points: Floats | None = None

    __repr__ = brief

    @property
    def is_closed(self) -> bool:
        """Whether the surface has no border."""
        return not self.borders


def check_extent(vertices: Floats) -> None:
    """Raises `CaseError` for a coordinate above 1e90 mm: areas and volumes would overflow."""
    far = np.argwhere(np.abs(vertices) > MAX_COORDINATE)
    if len(far):
        vertex, axis = far[0]
        raise CaseInputError(
            f"surface vertex {vertex} has the coordinate {vertices[vertex, axis]:g} mm: at most "
            f"{MAX_COORDINATE:g} is supported"
        )


def check_surface(surface: SurfaceData, *, crossings: bool = True) -> SurfaceReport:
    """The state of a surface.

    Parameters
    ----------
    surface : SurfaceData
        With coincident vertices merged, as `read_surface` does; otherwise every triangle of an STL
        file has a border of its own.
    crossings : bool
        Whether to check for triangles that intersect, which is the most expensive check.

    Raises
    ------
    CaseError
        (also `ValueError`) A coordinate above 1e90 mm.

    Examples
    --------
    >>> import cmfsim
    >>> triangle = cmfsim.SurfaceData([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])
    >>> report = cmfsim.check_surface(triangle)
    >>> report.area, report.borders[0].length, report.is_closed
    (6.0, 12.0, False)
    """
    vertices = surface.vertices
    triangles = surface.triangles.astype(np.int64)
    check_extent(vertices)
    degenerate, slivers = thin_triangles(vertices, triangles)
    duplicate = duplicate_triangles(triangles)
    # Duplicates would look like non-manifold edges. A triangle without area still connects its
    # neighbours; one that names a vertex twice is not needed for that, as they share an edge.
    keep = has_three_corners(triangles)
    keep[duplicate] = False
    kept = triangles[keep]
    edges = edges_of(kept)
    used = vertices[np.unique(triangles)] if len(triangles) else np.zeros((1, 3))
    _, orientable = orientation_flips(edges, len(kept))
    areas, volumes = areas_volumes(vertices, kept)
    found = points = None
    if crossings:
        solid = keep.copy()
        solid[degenerate] = False
        numbers = np.flatnonzero(solid)
        pairs = crossing_pairs(vertices, triangles[solid])
        if pairs is not None:
            found = numbers[pairs].reshape(-1, 2)
            points = vertices[triangles[found]].mean(axis=(1, 2))
    return SurfaceReport(
        n_vertices=len(vertices),
        n_triangles=len(triangles),
        lowest=used.min(axis=0),
        highest=used.max(axis=0),
        area=float(areas.sum()),
        volume=float(volumes.sum()),
        degenerate=degenerate,
        duplicate=duplicate,
        slivers=slivers,
        non_manifold=edges.ends[edges.counts > 2],
        inconsistent=int((~edges.opposed).sum()),
        orientable=orientable,
        borders=border_loops(vertices, edges),
        components=_components(vertices, kept, edges, areas, volumes),
        crossings=found,
        crossing_points=points,
    )


def thin_triangles(
    vertices: Floats, triangles: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The triangles without area, and those that are slivers."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    longest = np.sqrt(
        np.maximum.reduce([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))])
    )
    twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    flat = twice_area <= DEGENERATE_HEIGHT * longest * longest
    sliver = ~flat & (twice_area < SLIVER_HEIGHT * longest * longest)
    return np.flatnonzero(flat), np.flatnonzero(sliver)


def has_three_corners(triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which triangles name no vertex twice."""
    a, b, c = triangles.T
    three: NDArray[np.bool_] = (a != b) & (b != c) & (c != a)
    return three


def duplicate_triangles(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """The triangles that have the corners of an earlier one, in any order."""
    if not len(triangles):
        return np.zeros(0, dtype=np.int64)
    rows = np.sort(triangles, axis=1)
    order = np.lexsort(rows.T)
    one, other = rows[order[:-1]].T, rows[order[1:]].T
    again = (one[0] == other[0]) & (one[1] == other[1]) & (one[2] == other[2])
    return np.sort(order[1:][again])


def border_loops(vertices: Floats, edges: Edges) -> tuple[BorderLoop, ...]:
    """The closed borders of a surface, longest first."""
    loops, rests = loops_of(edges.border, edges.border[:, 0].tolist())
    # The rests are borders that inconsistent triangles interrupt.
    found = [_border_loop(vertices, np.array(loop, dtype=np.int64)) for loop in (*loops, *rests)]
    return tuple(sorted(found, key=lambda loop: (-loop.length, int(loop.vertices.min()))))


def _border_loop(vertices: Floats, loop: NDArray[np.int64]) -> BorderLoop:
    points = vertices[loop]
    steps = np.roll(points, -1, axis=0) - points
    return BorderLoop(loop, float(np.linalg.norm(steps, axis=1).sum()), points.mean(axis=0))


def areas_volumes(vertices: Floats, triangles: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Area of each triangle, and its share of the signed volume about the middle of the surface."""
    if not len(triangles):
        return np.zeros(0), np.zeros(0)
    # Relative to the middle: far from the origin, the digits of a small volume would cancel.
    middle = vertices[triangles].mean(axis=(0, 1))
    a, b, c = (vertices[triangles[:, i]] - middle for i in range(3))
    volumes: Floats = (a * np.cross(b, c)).sum(axis=1) / 6.0
    return triangle_areas(vertices - middle, triangles), volumes


def _components(
    vertices: Floats, triangles: NDArray[np.int64], edges: Edges, areas: Floats, volumes: Floats
) -> tuple[Component, ...]:
    labels = component_labels(edges, len(triangles))
    if not len(labels):
        return ()
    count = int(labels.max()) + 1
    n_triangles = np.bincount(labels, minlength=count)
    area = np.bincount(labels, weights=areas, minlength=count)
    volume = np.bincount(labels, weights=volumes, minlength=count)
    middles = vertices[triangles].mean(axis=1)
    centre = np.stack(
        [np.bincount(labels, weights=middles[:, i], minlength=count) for i in range(3)], axis=1
    )
    open_pieces = np.zeros(count, dtype=bool)
    open_pieces[labels[edges.border_triangles]] = True
    return tuple(
        Component(
            int(n_triangles[i]),
            float(area[i]),
            float(volume[i]),
            centre[i] / n_triangles[i],
            not open_pieces[i],
        )
        for i in np.lexsort((np.arange(count), -area))
    )
