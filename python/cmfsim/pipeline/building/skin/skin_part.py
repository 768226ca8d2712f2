"""The part of a mesh's boundary that is the patient's skin."""

import numpy as np
from numpy.typing import NDArray

from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData

# What a triangle's centroid may lie further from the skin than from the tissue's surface, mm.
SLACK = 0.25
# Smaller patches, mm², belong to what surrounds them: where tissue is hardly thicker than a tet, a
# triangle of the skin can lie nearer to the bone below.
LEAST_PATCH = 100.0


def on_skin(
    nodes: Floats, triangles: NDArray[np.uint32], anatomy: Anatomy, level: ImageData
) -> NDArray[np.bool_]:
    """Which boundary triangles are skin: their centroids lie nearer to it than to anything else.

    nodes: (n, 3), mm.
    triangles: (t, 3) uint32. The boundary of the mesh.
    level: Of the tissue that was meshed.
    """
    centroids = nodes[triangles].mean(axis=1)
    others = [*anatomy.bones.values(), *([] if anatomy.air is None else [anatomy.air])]
    from_skin = np.abs(anatomy.skin.sample(centroids))
    near = np.ones(len(centroids), dtype=bool)
    for other in others:
        near &= from_skin < np.abs(other.sample(centroids))
    # On a plane that bounds the region, the level is zero well inside the skin.
    near &= from_skin <= np.abs(level.sample(centroids)) + SLACK
    return _without_specks(nodes, triangles, near)


def _without_specks(
    nodes: Floats, triangles: NDArray[np.uint32], chosen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The choice with its small patches, and the small gaps in it, turned over."""
    edges = edges_of(triangles.astype(np.int64))
    # Patches hang together by edges between triangles of one choice.
    alike = chosen[edges.pairs[:, 0]] == chosen[edges.pairs[:, 1]]
    patch = connected_labels(edges.pairs[alike], len(triangles))
    a, b, c = (nodes[triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    small = np.bincount(patch, weights=area) < LEAST_PATCH
    # A closed surface of its own, round a small cavity, is surrounded by nothing.
    bordered = np.zeros(len(small), dtype=bool)
    bordered[patch[edges.pairs[~alike]]] = True
    return chosen ^ (small & bordered)[patch]
