"""Whether each site lies on the bone that its name puts it on, and each piece holds its sites.

A jaw that segmentation exchanged with the other, or a site placed on the wrong one, would move the
wrong bone, and the face would still look like a face.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.bones import CuttingPlane, Procedure
from cmfsim.doctor.surgery.bone_overlap import jaw_of
from cmfsim.errors import LandmarkInputError
from cmfsim.io import Case
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.image_data import ImageData
from cmfsim.values.landmark_sites import SKULL_LANDMARKS, is_lower_site

# A site farther than this from any bone lies on none: that is a finding of its own, mm.
REACH = 20.0
# A site is on the other bone if it is nearer to that by more than this, mm, and by a voxel. Correct
# sites of two heads are 6 mm and more farther from the other bone than from their own.
NEARER = 2.0
# The sites that a piece must hold, whatever the options of its cut.
HELD: Mapping[str, tuple[str, ...]] = {
    "maxilla": ("supradentale", "supra_m2_L", "supra_m2_R"),
    "midface": ("suborbital_L", "suborbital_R"),
    "mandible_body": ("infradentale",),
    "chin": ("menton",),
}
# Bone of an upper piece farther than this below the edges of the upper teeth is the lower jaw's,
# mm, from this volume on, mm³.
BELOW_BITE, LOWER_JAW = 8.0, 1500.0
# Names in one message.
MOST_NAMES = 6


def check_bones_of_sites(
    case: Case, skull: Mapping[str, Floats], anatomy: Anatomy, *, by_hand: bool
) -> None:
    """Refuses sites of one jaw that lie on the bone of the other.

    skull: mapping of str to (3,), mm.
    anatomy: Bones without a jaw in their names, and heads of one bone, are not checked.
    by_hand: Whether a person placed the sites.
    Raises `LandmarkError`: With the sites and their distances from both bones.
    """
    jaws: dict[str, list[ImageData]] = {"upper": [], "lower": []}
    for name, level in anatomy.bones.items():
        if name != "skull" and (jaw := jaw_of(name)) is not None:
            jaws[jaw].append(level)
    if not all(jaws.values()):
        return
    wrong = []
    margin = max(NEARER, float(anatomy.skin.spacing.max()))
    for name, point in skull.items():
        if name not in SKULL_LANDMARKS:
            continue
        own, other = ("lower", "upper") if is_lower_site(name) else ("upper", "lower")
        away, near = (min(_distance(b, point) for b in jaws[j]) for j in (own, other))
        if near < REACH and away > near + margin:
            wrong.append(f"{name} ({_mm(away)} from the {own} jaw's bone, {_mm(near)} from the "
                         f"{other} one's)")  # fmt: skip
    if not wrong:
        return
    listed = ", ".join(wrong[:MOST_NAMES]) + (", …" if len(wrong) > MOST_NAMES else "")
    raise LandmarkInputError(
        f"{case.where('landmarks.skull' if by_hand else 'landmarks')}: {len(wrong)} of "
        f"{len(skull)} sites lie on the bone of the other jaw: {listed}. Either they are "
        "misplaced, or the image was divided wrongly, and the plan would move the wrong jaw. "
        + _remedy(by_hand=by_hand)
    )


def check_pieces(
    case: Case,
    skull: Mapping[str, Floats],
    segments: Sequence[BoneSegment],
    procedures: Iterable[Procedure],
    *,
    by_hand: bool,
) -> None:
    """Refuses a cut whose piece lacks the sites that it is cut for, or holds the other jaw.

    Raises `LandmarkError`: With the piece, and the sites and distances or the volume.
    """
    made = {cut.segment: (procedure, cut) for procedure in procedures for cut in procedure.cuts}
    bodies = {segment.name: segment for segment in segments}
    rests = {cut.rest: procedure for procedure, cut in made.values() if cut.rest is not None}
    for name, sites in HELD.items():
        if name not in bodies or not (name in made or name in rests):
            continue
        lost = []
        for site in sites:
            if site not in skull:
                continue
            point = skull[site]
            own = _distance(bodies[name].level, point)
            others = {b: _distance(bodies[b].level, point) for b in bodies if b != name}
            nearest = min(others, key=others.__getitem__, default=None)
            margin = max(NEARER, float(bodies[name].level.spacing.max()))
            if nearest is not None and own > others[nearest] + margin:
                lost.append(f"{site} ({_mm(own)} from it, {_mm(others[nearest])} from {nearest})")
        if lost:
            raise LandmarkInputError(
                f"{case.where('osteotomies')}: the cut piece {name!r} does not hold the sites that "
                f"it is cut for: {', '.join(lost)}. The cut lies elsewhere than its name says, so "
                "the plan would move another bone. " + _remedy(by_hand=by_hand)
            )
    for name in ("maxilla", "midface"):
        bite = made[name][1].joined if name in made and name in bodies else None
        if bite is not None:
            _check_no_lower_jaw(case, bodies[name], bite, by_hand=by_hand)


def _check_no_lower_jaw(
    case: Case, body: BoneSegment, bite: CuttingPlane, *, by_hand: bool
) -> None:
    level = body.level
    below = (level.values > 0.0) & (bite.distance_on(level) < -BELOW_BITE)
    volume = np.count_nonzero(below) * float(np.prod(level.spacing))
    if volume > LOWER_JAW:
        raise LandmarkInputError(
            f"{case.where('osteotomies')}: the cut piece {body.name!r} has {volume / 1000.0:.1f} "
            f"cm³ of bone more than {BELOW_BITE:g} mm below the upper teeth: it holds part of the "
            "lower jaw, which the plan would move with it. " + _remedy(by_hand=by_hand)
        )


def _remedy(*, by_hand: bool) -> str:
    if by_hand:
        return (
            "Check these sites in 3D Slicer; if they are right, also place supradentale and "
            "infradentale, which separate the jaws, or give surfaces of both bones"
        )
    return (
        "Place supradentale, supra_m2_L and supra_m2_R by hand and name the file under "
        "[landmarks], or give surfaces of both bones"
    )


def _mm(distance: float) -> str:
    return f"{distance:.1f} mm" if distance < REACH else f"more than {REACH:g} mm"


def _distance(level: ImageData, point: Floats) -> float:
    """How far a point lies from the inside of a level, to half a voxel, mm; at most `REACH`."""
    spacing = level.spacing
    place = (point - level.lowest) / spacing
    low = np.maximum(np.floor(place - REACH / spacing).astype(int), 0)
    high = np.minimum(np.ceil(place + REACH / spacing).astype(int) + 1, level.values.shape)
    if (high <= low).any():
        return REACH
    part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    index: NDArray[np.intp] = np.argwhere(level.values[part] > 0.0)
    if not len(index):
        return REACH
    away = np.linalg.norm((index + low - place) * spacing, axis=1)
    return min(float(away.min()), REACH)
