"""Fixed nodes where a surgeon lifts the periosteum above a Le Fort I cut."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.meshing.node_kinds.options import KindOptions
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import as_rows
from cmfsim.values.lifted_tissue import LiftedTissue
from cmfsim.values.node_kinds import NodeKinds

__all__ = ["lifted_tissue"]

# What stays, and what a Le Fort I osteotomy separates from it.
CRANIUM, MAXILLA = "cranium", "maxilla"


def lifted_tissue(
    nodes: ArrayLike,
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    moved: Collection[str],
    options: KindOptions | None = None,
) -> LiftedTissue | None:
    """The nodes on the cranium from which tissue is lifted above a Le Fort I cut.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    kinds : NodeKinds
    segments : sequence of BoneSegment
    moved : collection of str
        Names of the segments that are cut or moved.
    options : KindOptions, optional
        `lifted` is the distance from the maxilla.

    Returns
    -------
    LiftedTissue or None
        None if no maxilla was separated from the cranium.

    Notes
    -----
    For a Le Fort I osteotomy the periosteum is lifted from the piriform aperture to the zygomatic
    buttress, up to below the infraorbital foramen (Bell 1975). Attached there, the tissue beside
    the nose would stay where it is, and skin above the cut does follow an advanced maxilla.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.lifted_tissue(
    ...     mesh.nodes, kinds, segments, moved=["maxilla"]
    ... )  # doctest: +SKIP
    """
    reach = (options or KindOptions()).lifted
    surfaces = {segment.name: segment.surface for segment in segments}
    if reach == 0.0 or MAXILLA not in moved or not {CRANIUM, MAXILLA} <= set(surfaces):
        return None
    fixed = kinds.nodes("fixed")
    on_cranium = fixed[kinds.segment[fixed] == kinds.segments.index(CRANIUM)]
    places = as_rows("nodes", nodes, 3)[on_cranium]
    found = {name: surfaces[name].searched.closest(places) for name in (MAXILLA, CRANIUM)}
    closest, _, _ = found[MAXILLA]
    _, normals, _ = found[CRANIUM]
    near = np.linalg.norm(closest - places, axis=1) < reach
    if not near.any():
        return None
    return LiftedTissue(MAXILLA, on_cranium[near], places[near], normals[near])
