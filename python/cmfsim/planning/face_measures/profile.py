"""The midline profile: where the midsagittal plane cuts the skin, from the forehead down."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import LandmarkInputError
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# Skin landmarks that determine the midsagittal plane, and how many are needed.
MIDLINE = ("nasion", "pronasale", "subnasale", "labiale_superius", "labiale_inferius", "pogonion")
LEAST_MIDLINE = 2
# Length of the profile behind the foremost point, mm: past throat and forehead.
DEPTH = 110.0


@dataclass(frozen=True, eq=False)
class MidlineProfile:
    """A polyline of points (n, 3), mm, from top to bottom, on edges of a surface that moves them.

    ends: (n, 2) uint32. Vertices of the edge on which each point lies.
    share: (n,). Position along the edge, from 0 at its first vertex to 1.
    """

    ends: NDArray[np.uint32]
    share: Floats
    points: Floats


def midline_profile(surface: SurfaceData, landmarks: Mapping[str, ArrayLike]) -> MidlineProfile:
    """The profile of a face in the plane through its midline landmarks, two or more of `MIDLINE`.

    The plane contains the direction P and the line that fits the landmarks best from above: a head
    that is tilted to the side has a tilted plane.
    Raises `LandmarkError`: Fewer midline landmarks, or a plane that does not cut the skin there.
    """
    known = [np.asarray(landmarks[name], dtype=np.float64) for name in MIDLINE if name in landmarks]
    if len(known) < LEAST_MIDLINE:
        raise LandmarkInputError(
            f"the profile needs {LEAST_MIDLINE} skin landmarks of {', '.join(MIDLINE)}: "
            f"{len(known)} are given"
        )
    places = np.array(known)
    rows = np.stack([np.ones(len(places)), places[:, 2] - places[:, 2].mean()], axis=1)
    (across, tilt), *_ = np.linalg.lstsq(rows, places[:, 0], rcond=None)
    vertices = surface.vertices
    side = vertices[:, 0] - across - tilt * (vertices[:, 2] - places[:, 2].mean())
    # A vertex exactly on the plane would be crossed by none of its edges, or by all of them.
    side = np.where(np.abs(side) < 1e-9, 1e-9, side)
    chain = _chain(vertices, surface.triangles.astype(np.int64), side, places)
    ends = np.array(chain, dtype=np.uint32)
    a, b = side[ends[:, 0]], side[ends[:, 1]]
    share = a / (a - b)
    points = vertices[ends[:, 0]] + share[:, None] * (vertices[ends[:, 1]] - vertices[ends[:, 0]])
    keep = _front(points, places)
    return MidlineProfile(ends[keep], share[keep], points[keep])


def _chain(
    vertices: Floats, triangles: NDArray[np.int64], side: Floats, places: Floats
) -> list[tuple[int, int]]:
    """The edges that are cut, in order, of the part of the cut closest to the landmarks."""
    near: dict[tuple[int, int], list[tuple[int, int]]] = {}
    positive = side[triangles] > 0.0
    for corners in triangles[positive.any(axis=1) & ~positive.all(axis=1)].tolist():
        cut = [
            (min(a, b), max(a, b))
            for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
            if (side[a] > 0.0) != (side[b] > 0.0)
        ]
        near.setdefault(cut[0], []).append(cut[1])
        near.setdefault(cut[1], []).append(cut[0])
    if not near:
        raise LandmarkInputError("the plane through the midline landmarks does not cut the skin")
    edges = list(near)
    middles = vertices[np.array(edges)].mean(axis=1)
    start = edges[
        int(np.argmin(np.linalg.norm(middles[:, None] - places[None], axis=2).min(axis=1)))
    ]
    one = _followed(near, start, 0)
    if len(one) > 2 and start in near[one[-1]]:
        # A closed cut is opened at the back.
        back = int(np.argmax(vertices[np.array(one)].mean(axis=1)[:, 1]))
        return [*one[back:], *one[:back]]
    return [*reversed(_followed(near, start, 1)[1:]), *one]


def _followed(
    near: Mapping[tuple[int, int], list[tuple[int, int]]], start: tuple[int, int], first: int
) -> list[tuple[int, int]]:
    """The edges that follow one, in the direction of its first or second neighbour, to the end."""
    row, seen = [start], {start}
    steps = near[start][first : first + 1]
    while steps:
        row.append(steps[0])
        seen.add(steps[0])
        steps = [edge for edge in near[steps[0]] if edge not in seen]
    return row


def _front(points: Floats, places: Floats) -> NDArray[np.intp]:
    """The part of the row on the face, from top to bottom; everything further back is dropped."""
    nearest = int(np.argmin(np.linalg.norm(points - places[len(places) // 2], axis=1)))
    in_front = points[:, 1] <= points[:, 1].min() + DEPTH
    low = high = nearest
    while low > 0 and in_front[low - 1]:
        low -= 1
    while high < len(points) - 1 and in_front[high + 1]:
        high += 1
    kept = np.arange(low, high + 1)
    return kept if points[low, 2] >= points[high, 2] else kept[::-1]
