"""The skin as a scanner sees it after the operation: carried by the tissue, with noise."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.values.checks import Floats, as_index_rows, as_number, as_rows
from cmfsim.values.surface_data import SurfaceData

# Tets whose middles lie nearest to a point are tried for it.
CANDIDATES = 24
# Rounds of averaging over neighbours that give smooth noise its length: about 4 edges.
SMOOTHING = 12


def carried(
    points: ArrayLike, nodes: ArrayLike, tets: ArrayLike, displacements: ArrayLike
) -> Floats:
    """The displacements (k, 3) mm of points in or just outside a deformed mesh.

    A point takes the linear field of the tet that holds it; a point outside that of the tet it is
    least outside of, with its weights cut to 0…1, so that nothing is carried beyond the mesh.

    points: (k, 3), mm, at rest.
    nodes: (n, 3), mm.
    tets: (m, 4) uint32.
    displacements: (n, 3), mm, of the nodes.
    Raises `CaseError`: Misshapen arrays; scipy is not installed.
    """
    places = as_rows("points", points, 3)
    corners = as_rows("nodes", nodes, 3)
    moves = as_rows("displacements", displacements, 3)
    if len(moves) != len(corners):
        raise CaseInputError(f"{len(moves)} displacements for {len(corners)} nodes")
    rows = as_index_rows("tets", tets, 4, len(corners), "nodes").astype(np.int64)
    tree = _module("scipy.spatial").cKDTree(corners[rows].mean(axis=1))
    count = min(CANDIDATES, len(rows))
    near = tree.query(places, k=count)[1].reshape(len(places), count)
    best = np.full(len(places), -np.inf)
    weights = np.zeros((len(places), 4))
    home = np.zeros(len(places), dtype=np.int64)
    for tets_tried in near.T:
        lost = np.flatnonzero(best < 0.0)
        tet = tets_tried[lost]
        base = corners[rows[tet]]
        edges = (base[:, 1:] - base[:, :1]).transpose(0, 2, 1)
        rest = np.linalg.solve(edges, (places[lost] - base[:, 0])[..., None])[..., 0]
        inside = np.column_stack([1.0 - rest.sum(axis=1), rest])
        least = inside.min(axis=1)
        better = least > best[lost]
        at = lost[better]
        best[at], weights[at], home[at] = least[better], inside[better], tet[better]
    weights = np.clip(weights, 0.0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    moved: Floats = np.einsum("kc,kci->ki", weights, moves[rows[home]])
    return moved


def scanned(
    surface: SurfaceData, *, white: float, smooth: float, seed: int | list[int]
) -> SurfaceData:
    """The surface as a scanner would give it: vertices off along their normals.

    white, smooth: mm. Standard deviations of the noise that is new at each vertex, and of the noise
        that changes over a few edges (waves of the reconstruction).
    Raises `CaseError`: A negative deviation; scipy is not installed.
    """
    for name, value in (("white", white), ("smooth", smooth)):
        if as_number(f"{name} noise", value) < 0.0:
            raise CaseInputError(f"{name} noise is {value:g} mm: 0 or more is needed")
    vertices, triangles = surface.vertices, surface.triangles
    generator = np.random.default_rng(seed)
    offset = white * generator.standard_normal(len(vertices))
    wave = generator.standard_normal(len(vertices))
    average = _averaging(triangles, len(vertices))
    for _ in range(SMOOTHING):
        wave = average @ wave
    offset += smooth * wave / max(float(wave.std()), np.finfo(np.float64).tiny)
    return SurfaceData(vertices + offset[:, None] * _normals(vertices, triangles), triangles)


def _averaging(triangles: NDArray[Any], n: int) -> Any:
    """The matrix that takes the mean over each vertex and its neighbours."""
    sparse = _module("scipy.sparse")
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    ones = np.ones(len(ends))
    near = sparse.coo_array((ones, (ends[:, 0], ends[:, 1])), shape=(n, n)).tocsr()
    near = near + near.T + sparse.eye_array(n)
    return sparse.diags_array(1.0 / near.sum(axis=1)) @ near


def _normals(vertices: Floats, triangles: NDArray[Any]) -> Floats:
    """Unit normals of the vertices, weighted by the area of the triangles about each."""
    corners = vertices[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, triangles[:, corner], area)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals: Floats = total / np.maximum(length, np.finfo(np.float64).tiny)
    return normals


def _module(name: str) -> Any:
    return third_party(name, "skins of virtual patients are made", "study")
