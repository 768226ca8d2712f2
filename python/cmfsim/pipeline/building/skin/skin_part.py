"""The skin of a case: its part of a mesh's boundary, and whether it shows a face over the skull."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData

# Sites of the skull that skin covers whatever the lips do.
COVERED = ("nasion", "mid_philtrum", "pogonion", "suborbital_L", "suborbital_R")
# Skin alone is 1.5 mm thick: less of all tissue in front of bone is none, mm.
LEAST_TISSUE = 1.2
# The nose stands out by more than this from the line from rhinion to mid-philtrum, mm, where nasion
# and mid-philtrum are 59 mm apart as in an average head; 26 to 28 in two real heads.
LEAST_NOSE, NOSE_HEIGHT = 9.0, 59.0
# How far in front of bone skin is looked for, in steps, mm.
FARTHEST, STEP = 50.0, 0.5
# What a triangle's centroid may lie further from the skin than from the tissue's surface, mm.
SLACK = 0.25
# Smaller patches, mm², belong to what surrounds them: where tissue is hardly thicker than a tet, a
# triangle of the skin can lie nearer to the bone below.
LEAST_PATCH = 100.0


def check_skin(anatomy: Anatomy, skull: Mapping[str, Floats]) -> Iterator[Finding]:
    """Warnings where nose or tissue is missing in front of the skull."""
    front = _front(skull)
    if front is None:
        return
    bare = {
        name: depth
        for name in COVERED
        if name in skull and (depth := _tissue(anatomy, skull[name], front)) < LEAST_TISSUE
    }
    if bare:
        yield _missing(
            "tissue in front of bone is missing at "
            + ", ".join(f"{name} ({depth:.1f} mm)" for name, depth in bare.items())
        )
    if not {"rhinion", "mid_philtrum", "nasion"} <= skull.keys():
        return
    top, bottom = skull["rhinion"], skull["mid_philtrum"]
    size = float(np.linalg.norm(skull["nasion"] - bottom)) / NOSE_HEIGHT
    line = [top + share * (bottom - top) for share in np.linspace(0.2, 0.9, 8)]
    nose = max(_tissue(anatomy, point, front, last=True) for point in line)
    if nose < LEAST_NOSE * size:
        yield _missing(
            f"the skin has no nose: it stands out by {nose:.1f} mm between rhinion and upper lip "
            f"({LEAST_NOSE * size:.0f} mm at least are expected)"
        )


def _front(skull: Mapping[str, Floats]) -> Floats | None:
    """The direction in which the face looks, from pairs of sites and the midline."""
    pairs = [n[:-2] for n in skull if n.endswith("_L") and f"{n[:-2]}_R" in skull]
    if not pairs or not {"nasion", "supradentale"} <= skull.keys():
        return None
    left = np.sum([skull[f"{n}_L"] - skull[f"{n}_R"] for n in pairs], axis=0)
    front: Floats = np.cross(left, skull["nasion"] - skull["supradentale"])
    length = float(np.linalg.norm(front))
    return front / length if length > 0.0 else None


def _tissue(anatomy: Anatomy, point: Floats, front: Floats, *, last: bool = False) -> float:
    """How far the head reaches in front of a point, to the first or the last end of it, mm."""
    steps = np.arange(0.0, FARTHEST, STEP)
    inside = np.asarray(anatomy.skin.sample(point + steps[:, None] * front)) > 0.0
    if last:
        return float(steps[np.flatnonzero(inside)[-1]]) if inside.any() else 0.0
    return FARTHEST if inside.all() else float(steps[int(np.argmin(inside))])


def _missing(what: str) -> Finding:
    return Finding("skin-implausible", what, where="skin")


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
