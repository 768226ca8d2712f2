"""Nodes on the skull where a surgeon lifts the periosteum next to a cut."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.meshing.node_kinds.options import KindOptions
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import as_rows
from cmfsim.values.lifted_tissue import LiftedTissue
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.surface_data import SurfaceData

# Faces of a cut lie on each other: this close, mm, and facing each other with this cosine.
CUT_GAP, CUT_FACING = 0.5, 0.9
# Least share of the smaller piece's area in such faces. After Le Fort I on three heads it is 0.08
# to 0.19; jaws that touch the skull at joints and teeth have up to 0.014.
CUT_SHARE = 0.04


def lifted_tissue(
    nodes: ArrayLike,
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    moved: Collection[str],
    options: KindOptions | None = None,
) -> LiftedTissue | None:
    """The nodes on the skull from which tissue is lifted next to a Le Fort cut.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    kinds : NodeKinds
    segments : sequence of BoneSegment
    moved : collection of str
        Names of the segments that are cut or moved.
    options : KindOptions, optional
        `lifted` is the distance from what was cut off.

    Returns
    -------
    LiftedTissue or None
        None if nothing that may move was cut off the skull.

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
    skull, pieces = cut_off_skull(segments, moved)
    if reach == 0.0 or not pieces:
        return None
    is_joined = skull.name in moved
    held = kinds.nodes("joined" if is_joined else "fixed")
    on_skull = held[kinds.segment[held] == kinds.segments.index(skull.name)]
    places = as_rows("nodes", nodes, 3)[on_skull]
    away = np.array(
        [np.linalg.norm(s.surface.searched.closest(places)[0] - places, axis=1) for s in pieces]
    )
    near = away.min(axis=0) < reach
    if not near.any():
        return None
    _, normals, _ = skull.surface.searched.closest(places[near])
    return LiftedTissue(
        skull.name,
        is_joined,
        tuple(s.name for s in pieces),
        on_skull[near],
        away[:, near].argmin(axis=0),
        places[near],
        normals,
    )


def cut_off_skull(
    segments: Sequence[BoneSegment], moved: Collection[str]
) -> tuple[BoneSegment, list[BoneSegment]]:
    """The skull, and the segments that were cut off it, whatever their names.

    The skull is the segment that reaches highest. What was cut off it has a face in common with it;
    jaws and teeth that touch it have not.

    Parameters
    ----------
    segments : sequence of BoneSegment
    moved : collection of str
        Names of the segments that are cut or moved.
    """
    skull = max(segments, key=lambda segment: float(segment.surface.vertices[:, 2].max()))
    others = [s for s in segments if s is not skull and s.name in moved]
    return skull, [s for s in others if _is_cut_off(s.surface, skull.surface)]


def _is_cut_off(piece: SurfaceData, skull: SurfaceData) -> bool:
    """Whether a piece was cut off the skull: it lies on it with a share of its surface."""
    corners = piece.vertices[piece.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(normal, axis=1)
    centres = corners.mean(axis=1)
    closest, there, _ = skull.searched.closest(centres)
    on_it = np.linalg.norm(closest - centres, axis=1) < CUT_GAP
    on_it &= np.einsum("ta,ta->t", normal, there) < -CUT_FACING * twice
    return bool(twice[on_it].sum() > CUT_SHARE * twice.sum())
