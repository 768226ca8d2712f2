"""Triangles that close a border loop: ears cut off in the plane that fits it best."""

import numpy as np
from numpy.typing import NDArray

from cmfsim.values.checks import Floats

Integers = NDArray[np.int64]

# An ear whose area is below this share of the loop's squared extent is cut off only if no other is
# left: cutting needles first would leave needles behind.
FLAT_EAR = 1e-9


def cap_loop(vertices: Floats, loop: Integers) -> tuple[Integers, float]:
    """The triangles of a cap and the largest distance of its border from the plane that fits best.

    Parameters
    ----------
    vertices : (v, 3) float64, mm
    loop : (k,) int64
        Vertices in the order in which the triangles at the border run.

    Returns
    -------
    (k − 2, 3) int64
        They run through the border the other way, so that the closed surface is consistent.
    float, mm

    Notes
    -----
    Ear clipping (Meisters 1975) in the best plane. A loop that crosses itself there has no ears at
    some stage; the corner with the shortest new edge is then cut off, which still closes it.
    """
    points = vertices[loop[::-1]]
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    normal = _loop_normal(centred)
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


def _loop_normal(points: Floats) -> Floats:
    """Twice the vector area of a loop (Newell)."""
    doubled: Floats = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    return doubled


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
