"""Nodes that stay with the skull: the septum, and periosteum that is lifted next to a cut."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.meshing.node_kinds.options import KindOptions
from cmfsim.surfaces.depth import distances
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats, as_rows
from cmfsim.values.finding import Finding
from cmfsim.values.patient_model import LiftedTissue
from cmfsim.values.scene import NODE_KINDS, NodeKinds
from cmfsim.values.surface_data import SurfaceData

# Faces of a cut lie on each other: this close, mm, and facing each other with this cosine.
CUT_GAP, CUT_FACING = 0.5, 0.9
# Least share of the smaller piece's area in such faces. After Le Fort I on three heads it is 0.08
# to 0.19; jaws that touch the skull at joints and teeth have up to 0.014.
CUT_SHARE = 0.04

SKULL_LANDMARKS = ("nasion", "rhinion", "mid_philtrum", "supradentale")
SKIN_LANDMARKS = ("pronasale", "subnasale")
# Half the thickness of the septum with its mucosa, mm: cartilage of 1.75 mm (mean of 40 cadavers)
# between two layers of about 0.7 mm. Tets cannot be cut there: in edges of the mesh at least, so
# that there is one layer of nodes.
HALF_THICKNESS, HALF_EDGES = 1.6, 0.32
# From the skin to the septum at the tip, which the alar cartilages form, and at the columella, mm.
BEHIND_TIP, BEHIND_COLUMELLA = 8.0, 5.0
# How far above the height of subnasale the septum ends, mm.
ABOVE_SUBNASALE = 3.0
# The septum was separated from what was cut off: so far from it no node is held, mm: as
# much as an impaction moves it up.
CLEARANCE = 6.0
# Perpendicular plate and vomer carry it up to this distance behind the nasal bones, mm.
DEPTH = 20.0


@dataclass(frozen=True, eq=False)
class Septum:
    """The nodes of the septum, (k,) uint32, including those that lie on the skull.

    kinds: Of all nodes; those of the septum that were free stay with the skull.
    """

    kinds: NodeKinds
    nodes: NDArray[np.uint32]
    findings: tuple[Finding, ...] = ()


def septum(
    nodes: ArrayLike,
    kinds: NodeKinds,
    segments: Sequence[BoneSegment],
    moved: Collection[str],
    landmarks: Mapping[str, Mapping[str, ArrayLike]],
    *,
    by_vertex: Collection[str] = (),
) -> Septum:
    """The septum of a nose whose floor was cut off the skull; empty if nothing was.

    moved: Names of the segments that are cut or moved.
    landmarks: "skull": nasion, rhinion, mid_philtrum, supradentale; "skin": pronasale, subnasale.
    by_vertex: Names of the segments that are followed vertex by vertex. If the skull is one of
        them, there is no septum: it lies up to 15 mm off the bone, where the noise of a triangle's
        rotation would move it by millimetres.

    Cartilage (2.7 MPa; Griffin et al. 2016) is a thousand times as stiff as fat, so the septum
    moves as a rigid body. In a Le Fort I osteotomy it is separated from the maxilla and stays with
    nasal bones, perpendicular plate and vomer.
    """
    none = np.zeros(0, dtype=np.uint32)
    skull, pieces = cut_off_skull(segments, moved)
    if not pieces:
        return Septum(kinds, none)
    if skull.name in by_vertex:
        followed = Finding(
            "septum-left-out",
            f"the nasal septum is not modelled: {skull.name} is followed vertex by vertex",
            where=f"segment {skull.name}",
            why="the septum lies too far from the bone for that; without its support, the tip of "
            "the nose follows the maxilla too far, mostly upwards",
            fix="if the skull did not move, leave it out of the plan",
        )
        return Septum(kinds, none, (followed,))
    marks: dict[str, Floats] = {}
    for kind_of, names in (("skull", SKULL_LANDMARKS), ("skin", SKIN_LANDMARKS)):
        given = landmarks.get(kind_of, {})
        marks |= {name: np.asarray(given[name], dtype=float) for name in names if name in given}
    missing = [n for n in (*SKULL_LANDMARKS, *SKIN_LANDMARKS) if n not in marks]
    if missing:
        unknown = Finding(
            "septum-left-out",
            f"the nasal septum is not modelled: {', '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} not among the landmarks",
            where="[landmarks]",
        )
        return Septum(kinds, none, (unknown,))
    # What was cut off must be the floor of the nose, and not its bridge.
    if _nearest(marks["mid_philtrum"], segments) not in pieces:
        return Septum(kinds, none)
    if _nearest(marks["rhinion"], segments) is not skull:
        return Septum(kinds, none)
    places = as_rows("nodes", nodes, 3)
    inside = np.flatnonzero(_inside(places, marks))
    for piece in pieces:
        inside = inside[distances(places[inside], piece.surface.searched) > CLEARANCE]
    number = kinds.segments.index(skull.name)
    kind, owner = np.array(kinds.kind), np.array(kinds.segment)
    free = inside[kind[inside] == NODE_KINDS.index("free")]
    on_skull = inside[owner[inside] == number]
    kind[free] = NODE_KINDS.index("joined" if skull.name in moved else "fixed")
    owner[free] = number
    found = np.union1d(free, on_skull).astype(np.uint32)
    return Septum(replace(kinds, kind=kind, segment=owner), found)


def _inside(places: Floats, marks: Mapping[str, Floats]) -> NDArray[np.bool_]:
    """Which places lie in the septum: near the midline's plane, and in its outline there."""
    midline = np.array(list(marks.values()))
    middle = midline.mean(axis=0)
    across = np.linalg.svd(midline - middle)[2][-1]
    across *= np.sign(across[0])
    back = np.array([0.0, 1.0, 0.0]) - across[1] * across
    back /= np.linalg.norm(back)
    up = np.cross(across, back)

    def flat(points: Floats) -> Floats:
        found: Floats = (points - middle) @ np.array([back, up]).T
        return found

    rhinion, tip, columella = (flat(marks[n]) for n in ("rhinion", "pronasale", "subnasale"))
    behind = max(rhinion[0], flat(marks["mid_philtrum"])[0]) + DEPTH
    lowest = columella[1] + ABOVE_SUBNASALE
    outline = np.array(
        [
            rhinion,
            tip + [BEHIND_TIP, 0.0],
            [columella[0] + BEHIND_COLUMELLA, lowest],
            [behind, lowest],
            [behind, rhinion[1]],
        ]
    )
    offset = np.abs((places - middle) @ across)
    around = (np.abs(flat(places) - outline.mean(axis=0)) < DEPTH).all(axis=1) & (offset < DEPTH)
    half = max(HALF_THICKNESS, HALF_EDGES * _spacing(places[around]))
    inside: NDArray[np.bool_] = offset < half
    ends = np.roll(outline, -1, axis=0)
    for start, side in zip(outline, ends - outline, strict=True):
        way = flat(places) - start
        inside &= side[0] * way[:, 1] - side[1] * way[:, 0] >= 0.0
    return inside


def _spacing(places: Floats) -> float:
    """The edge of a cube of which each place has one, in the box round them, mm."""
    if len(places) < 2:
        return 0.0
    return float((np.prod(np.ptp(places, axis=0)) / len(places)) ** (1.0 / 3.0))


def _nearest(place: Floats, segments: Sequence[BoneSegment]) -> BoneSegment:
    """The segment that a landmark lies on."""
    return min(segments, key=lambda s: float(distances(place[None], s.surface.searched)[0]))


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
    away = np.array([distances(places, s.surface.searched) for s in pieces])
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

    The skull is the segment that reaches highest. What was cut off it, being cut or `moved`, has a
    face in common with it; jaws and teeth that touch it have not.
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
