"""Ends of the tissue near moving bone: at planes that fix it, and at borders of the image."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.meshing import TissueRegion
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.node_kinds import NodeKinds

# Soft tissue follows a bone that moves over about its own thickness, mm: what is fixed nearer than
# that holds the face back.
NEAR_END = 20.0
# Skin and tissue that end on the image's border over less than this are not cut off, mm².
CUT_AREA = 150.0
# A surface that the border closes ends half a voxel to one inside it.
BORDER_VOXELS = 1.5
# Cosine from which a triangle faces a border.
FACING = 0.9
BORDERS = (("right", "left"), ("front", "back"), ("bottom", "top"))


def end_findings(
    nodes: Floats,
    triangles: NDArray[np.uint32],
    kinds: NodeKinds,
    anatomy: Anatomy,
    region: TissueRegion,
    *,
    segments: Sequence[BoneSegment],
    moved: Collection[str],
) -> list[Finding]:
    """Findings on bones that move close to where tissue is fixed, and on tissue that ends loose.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    triangles : (t, 3) uint32
        Boundary of the tissue's mesh, outward.
    kinds : NodeKinds
    anatomy : Anatomy
        Its grid ends where the image does.
    region : TissueRegion
    segments : sequence of BoneSegment
    moved : collection of str
        Names of the segments that move.
    """
    near = _near_ends(anatomy, region, [s for s in segments if s.name in moved])
    return [*near, *_loose_ends(nodes, triangles, kinds, anatomy)]


def _near_ends(
    anatomy: Anatomy, region: TissueRegion, moving: Sequence[BoneSegment]
) -> Iterator[Finding]:
    image_low, image_high = (float(h[2]) for h in (anatomy.skin.lowest, anatomy.skin.highest))
    for segment in moving:
        heights = segment.surface.vertices[:, 2]
        ends = (
            ("below", region.lower, float(heights.min()), -1.0, image_low, "lower"),
            ("above", region.upper, float(heights.max()), 1.0, image_high, "upper"),
        )
        for side, end, place, sign, border, key in ends:
            if end is None or sign * (end - place) >= NEAR_END:
                continue
            room = sign * (end - place)
            # The plane lies some voxels inside the image where the head was cut off there.
            cut = abs(end - border) < NEAR_END
            how = (
                "use a scan that extends further" if cut else f"move {key} in [region] further away"
            )
            yield Finding(
                "segment-near-end",
                f"{segment.name}, which moves, "
                + (
                    f"comes within {room:.1f} mm of the plane z = {end:.1f} mm {side} it"
                    if room > 0.0
                    else f"reaches {-room:.1f} mm past the plane z = {end:.1f} mm {side} it"
                )
                + f", on which all tissue is fixed (at least {NEAR_END:g} mm is needed)",
                where=f"{segment.name} at z = {place:.1f} mm",
                why=f"tissue {side} it cannot follow: the face there moves too little, or not at "
                "all" + (", because the image ends there" if cut else ""),
                fix=f"{how}, or exclude that part of the face from the evaluation",
            )


def _loose_ends(
    nodes: Floats, triangles: NDArray[np.uint32], kinds: NodeKinds, anatomy: Anatomy
) -> Iterator[Finding]:
    corners = nodes[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(normal, axis=1)
    free = (kinds.kind[triangles] == 0).all(axis=1)
    spacing = anatomy.skin.spacing
    for axis, names in enumerate(BORDERS):
        for name, sign, end in zip(
            names, (-1.0, 1.0), (anatomy.skin.lowest, anatomy.skin.highest), strict=True
        ):
            there = np.abs(corners[:, :, axis] - end[axis]).max(axis=1)
            chosen = free & (there <= BORDER_VOXELS * spacing[axis])
            chosen &= sign * normal[:, axis] > FACING * twice
            area = 0.5 * float(twice[chosen].sum())
            if area <= CUT_AREA:
                continue
            yield Finding(
                "tissue-ends-loose",
                f"the tissue ends on the {name} border of the image over {area:.0f} mm², and "
                "nothing is fixed there",
                where=f"{name} border, {'xyz'[axis]} = {end[axis]:.1f} mm",
                fix="use an image that shows the whole face"
                + (
                    ", or bring the posterior plane inside it (posterior_depth in [region])"
                    if name == "back"
                    else f', or fix it: fixed_borders = ["{_kind_border(axis, sign)}"] in '
                    "[node_kinds]"
                ),
            )


def _kind_border(axis: int, sign: float) -> str:
    """The border's name as [node_kinds] has it."""
    names = (("right", "left"), ("anterior", "posterior"), ("inferior", "superior"))
    return names[axis][int(sign > 0.0)]
