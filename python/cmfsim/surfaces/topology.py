"""Topology of triangles and tets: edges, connected pieces, and consistent orientation."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]

# The cube of fewer items is a long integer.
MOST_CUBED = 1 << 21


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of a surface, (e, 2), the lower vertex first, and the triangles at them; int64.

    counts: (e,). Number of triangles at each edge.
    pairs: (p, 2). Triangles on the two sides of each edge that has exactly two.
    opposed: (p,) bool. Whether they run through that edge in opposite directions, consistently.
    border: (b, 2). Edges with a single triangle, `border_triangles`, in its direction.
    """

    ends: Integers
    counts: Integers
    pairs: Integers
    opposed: NDArray[np.bool_]
    border: Integers
    border_triangles: Integers


def edges_of(triangles: Integers) -> Edges:
    """The edges of triangles; no triangle may name a vertex twice."""
    if not len(triangles):
        none = np.zeros((0, 2), dtype=np.int64)
        single = np.zeros(0, dtype=np.int64)
        return Edges(none, single, none, np.zeros(0, dtype=bool), none, single)
    start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    key = low * (int(high.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    key, directed, owner = key[order], np.stack([start, end], axis=1)[order], order // 3
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    counts = np.diff(np.concatenate([first, [len(key)]]))
    two = first[counts == 2]
    one = first[counts == 1]
    return Edges(
        ends=np.sort(directed[first], axis=1),
        counts=counts,
        pairs=np.stack([owner[two], owner[two + 1]], axis=1),
        opposed=directed[two, 0] != directed[two + 1, 0],
        border=directed[one],
        border_triangles=owner[one],
    )


def component_labels(edges: Edges, n_triangles: int) -> Integers:
    """The number of the connected piece of each triangle, pieces in the order of their first one.

    Pieces are connected by edges with two triangles: at a fork, the connection is ambiguous.
    """
    return connected_labels(edges.pairs, n_triangles)


def connected_labels(pairs: Integers, count: int) -> Integers:
    """The number of the connected component of each of `count` items that pairs join.

    Each round, the smaller label of a pair goes to the label that the other item has, and labels
    follow themselves to their roots; a few rounds do for any shape.
    """
    root = np.arange(count)
    while True:
        a, b = root[pairs[:, 0]], root[pairs[:, 1]]
        apart = a != b
        if not apart.any():
            break
        a, b = a[apart], b[apart]
        np.minimum.at(root, np.maximum(a, b), np.minimum(a, b))
        while True:
            followed = root[root]
            if np.array_equal(followed, root):
                break
            root = followed
    return np.unique(root, return_inverse=True)[1].reshape(-1)


def loops_of(edges: Integers, starts: Iterable[int]) -> tuple[list[list[int]], list[list[int]]]:
    """Directed edges (k, 2) as loops that pass each vertex once, and the paths that are left.

    Walks begin at `starts` and end a loop where they return to a vertex, so two loops that touch at
    a vertex stay separate.
    """
    onward: dict[int, list[int]] = {}
    for start, end in edges.tolist():
        onward.setdefault(start, []).append(end)
    loops: list[list[int]] = []
    paths: list[list[int]] = []
    for first in starts:
        path, place = [first], {first: 0}
        while onward.get(path[-1]):
            vertex = onward[path[-1]].pop()
            if vertex in place:
                begin = place[vertex]
                loops.append(path[begin:])
                for left in path[begin + 1 :]:
                    del place[left]
                del path[begin + 1 :]
            else:
                place[vertex] = len(path)
                path.append(vertex)
        if len(path) > 1:
            paths.append(path)
    return loops, paths


def orientation_flips(edges: Edges, n_triangles: int) -> tuple[NDArray[np.bool_], bool]:
    """Which triangles to flip for a consistent surface, and whether there is such a choice.

    Each triangle is taken twice, as it is and turned; edges join the copies that agree. A piece
    whose two copies are joined has one side only (Möbius) and is left as it is. In each other piece
    the smaller number of triangles is turned.
    """
    same = np.concatenate([edges.pairs, edges.pairs + n_triangles])
    crossed = np.concatenate(
        [edges.pairs + [0, n_triangles], edges.pairs + [n_triangles, 0]], axis=0
    )
    agree = np.concatenate([edges.opposed, edges.opposed])
    cover = connected_labels(np.where(agree[:, None], same, crossed), 2 * n_triangles)
    one_sided = cover[:n_triangles] == cover[n_triangles:]
    # Labels are numbered by first item, so of the two copies of a piece the one with the first
    # triangle as it is has the smaller label.
    turned = cover[:n_triangles] > cover[n_triangles:]
    piece = np.minimum(cover[:n_triangles], cover[n_triangles:])
    size = np.bincount(piece, minlength=1)
    n_turned = np.bincount(piece, weights=turned, minlength=1)
    flips = np.where(2 * n_turned[piece] > size[piece], ~turned, turned) & ~one_sided
    return flips, not bool(one_sided.any())


def tet_bodies(tets: NDArray[Any]) -> Integers:
    """The number of the body of each tet, connected by faces: a mere edge or node can turn."""
    corners = np.sort(tets.astype(np.int64), axis=1)
    faces = corners[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    # One number for each face is sorted much faster than a row of three.
    count = int(corners.max(initial=0)) + 1
    face = faces[:, 0] * count + faces[:, 1]
    if count >= MOST_CUBED:
        face = np.unique(face, return_inverse=True)[1].reshape(-1)
    face = face * count + faces[:, 2]
    order = np.argsort(face)
    same = face[order[1:]] == face[order[:-1]]
    pairs = np.stack([order[:-1][same], order[1:][same]], axis=1) // 4
    return connected_labels(pairs, len(tets))
