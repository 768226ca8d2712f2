"""Landmarks of a case that gives none or few: found on its head; where they come from in words.

Each site lies on the bone that its name puts it on, and each piece holds its sites: a jaw that
segmentation exchanged with the other, or a site placed on the wrong one, would move the wrong bone,
and the face would still look like a face.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.bones.cuts.planes import CuttingPlane, Procedure
from cmfsim.doctor.surgery.bone_overlap import jaw_of
from cmfsim.errors import LandmarkError, LandmarkInputError
from cmfsim.io import Case
from cmfsim.pipeline.building.case_checks import Head
from cmfsim.pipeline.building.inputs import read_placed_sites
from cmfsim.pipeline.building.stages import Stages
from cmfsim.surfaces.levels import block_of
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.case_parts import FEW_SITES
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.landmark_sites import SKULL_LANDMARKS, is_for_measures, is_lower_site
from cmfsim.values.proposed_landmarks import ProposedLandmarks

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
# Found sites of which one lies farther than this from where it was placed, mm, are of no use:
# landmarks of unseen heads are 2 to 5 mm off on average.
DISAGREE = 12.0
# Sites of one jaw, and those of the other that lie opposite.
OPPOSITE = (
    ("supradentale", "infradentale"),
    ("supra_m2_L", "sub_m2_L"),
    ("supra_m2_R", "sub_m2_R"),
)


def check_bones_of_sites(
    case: Case, skull: Mapping[str, Floats], anatomy: Anatomy, *, by_hand: bool
) -> None:
    """Refuses, by `LandmarkError`, sites of one jaw that lie on the bone of the other.

    anatomy: Bones without a jaw in their names, and heads of one bone, are not checked.
    by_hand: Whether a person placed the sites.
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
    """Refuses (`LandmarkError`) a piece that lacks its sites, or holds part of the other jaw."""
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
    inside = level.values > 0.0
    box = tuple(slice(a, b) for a, b in zip(*block_of(inside), strict=True))
    x, y, z = bite.distance_along(level)
    above = x[box[0]] + y[:, box[1]] + z[:, :, box[2]]
    below = inside[box] & (above < -BELOW_BITE)
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


def is_to_be_found(case: Case, placed: Mapping[str, Mapping[str, Floats]]) -> bool:
    """Whether landmarks are found automatically: all, or those that a few placed ones leave."""
    if case.landmarks.fills:
        return True
    if case.landmarks.proposed:
        return not placed
    is_needed = case.muscles is not None or any(cut.procedure for cut in case.osteotomies)
    count = sum(not is_for_measures(name) for name in placed.get("skull", {}))
    return is_needed and case.landmarks.is_completed(count)


def found_landmarks(
    case: Case,
    anatomy: Anatomy,
    stages: Stages,
    placed: Mapping[str, Mapping[str, Floats]],
    *,
    is_read: bool,
) -> Head:
    """A head with the landmarks found on it, by which its jaws may be separated.

    Placed sites stay, and the others follow them. Without any landmarks, with a warning, where the
    head shows no face: what cannot do without them is refused where it is reached.

    is_read: Whether the anatomy was made of the case's own files: the jaws of another one stay.
    Raises `LandmarkError`: What was taken for the mandible in the image cannot be one, and the plan
        needs it.
    """
    # A case with landmarks loads nothing of the synthetic heads that others are compared with.
    from cmfsim.pipeline.proposing import BY_SHAPE, filled_landmarks, proposed_head, unproposed_head  # noqa: PLC0415

    stages.begin("finding the landmarks")
    skull = placed.get("skull", {})
    try:
        head = proposed_head(case, anatomy, stages.begin, is_read=is_read, placed=skull)
    except LandmarkError as error:
        if not case.landmarks.fills:
            stages.add([_not_found(str(error), len(skull))])
            return Head(case, placed, anatomy)
        head = unproposed_head(anatomy, str(error))
    reason = _contradiction(case, head.landmarks, skull)
    if reason:
        stages.add([_not_found(reason, len(skull))])
        return Head(case, placed, anatomy)
    found = filled_landmarks(head, read_placed_sites(case)) if placed else head.landmarks
    # Sites that only measures use, such as sella, are not among those found.
    points = {kind: {**placed.get(kind, {}), **sites} for kind, sites in found.points.items()}
    findings = found.findings
    read, anatomy = anatomy, head.anatomy
    if found.impossible_jaw and case.image is not None:
        if needs_lower_jaw(case):
            raise LandmarkInputError(
                f"{case.where('image.file')}: the jaws in the image could not be separated, "
                f"because the part taken for the mandible is not one: {found.impossible_jaw}. "
                "Place infradentale, sub_m2_L and sub_m2_R by hand and name the file under "
                "[landmarks], or give surfaces of both bones"
            )
        # Its bones are one skull, as where jaws are not separated.
        levels = list(anatomy.bones.values())
        whole = np.maximum.reduce([level.values for level in levels])
        anatomy = replace(anatomy, bones={"skull": levels[0].with_values(whole)})
        points["skull"] = {n: p for n, p in points["skull"].items() if not is_lower_site(n)}
        what = (
            "the mandible is not separated from the skull, because the part taken for it is not "
            f"one: {found.impossible_jaw}; the plan does not need it"
        )
        stages.add([Finding("mandible-left-out", what, where="bone")])
        findings = tuple(f for f in findings if f.code != "jaw-doubtful")
    elif anatomy is not read:
        stages.drop({BY_SHAPE})
    stages.add(head.findings)
    stages.add(findings)
    return Head(case, points, anatomy, found, head.skin)


def needs_lower_jaw(case: Case) -> bool:
    """Whether cuts or plan are about the lower jaw, as far as the case shows."""
    if case.achieved:
        return True
    names = [*case.plan, *(n for cut in case.osteotomies for n in (*cut.segments, cut.bone or ""))]
    return any(jaw_of(name) == "lower" for name in names)


def _contradiction(case: Case, found: ProposedLandmarks, skull: Mapping[str, Floats]) -> str:
    """Why found sites are of no use beside placed ones; empty if they are."""
    apart = found.apart(skull)
    _check_jaw_of_placed(case, found, skull, apart)
    if all(size <= DISAGREE for size in apart.values()):
        return ""
    listed = ", ".join(f"{name} by {size:.0f} mm" for name, size in apart.items())
    return f"those found differ from those placed by hand: {listed}"


def _check_jaw_of_placed(
    case: Case, found: ProposedLandmarks, skull: Mapping[str, Floats], apart: Mapping[str, float]
) -> None:
    """Refuses placed sites that lie where the opposite ones of the other jaw were found."""
    wrong = []
    for pair in OPPOSITE:
        for own, other in (pair, pair[::-1]):
            if own not in apart or other not in found.skull or apart[own] < 0.5 * DISAGREE:
                continue
            near = float(np.linalg.norm(found.skull[other].point - skull[own]))
            if near < 0.5 * apart[own]:
                wrong.append(f"{own} ({near:.1f} mm from the {other} found, {apart[own]:.1f} mm "
                             "from its own)")  # fmt: skip
    if wrong:
        raise LandmarkInputError(
            f"{case.where('landmarks.skull')}: sites placed by hand seem to lie on the other jaw, "
            f"which the plan would move: {', '.join(wrong)}; check them in 3D Slicer. If they are "
            f"right, place {FEW_SITES} landmarks or more: none is then found automatically"
        )


def _not_found(reason: str, count: int) -> Finding:
    if count:
        return Finding(
            "landmarks-not-completed",
            f"the case names {count} landmarks of the skull, and no others were found "
            f"automatically: {reason}",
            where="landmarks",
        )
    return Finding(
        "landmarks-not-found",
        f"the case names no landmarks, and none were found automatically: {reason}",
        where="landmarks",
    )


def landmark_summary(found: ProposedLandmarks) -> dict[str, Any]:
    """Where landmarks come from, for the summary of a model."""
    sites = (*found.skull.values(), *found.skin.values())
    is_all = not any(site.state.by_person for site in sites)
    return {
        "source": "found automatically" if is_all else "placed by hand and filled in",
        **{
            kind: {
                name: {
                    "point": np.round(site.point, 3).tolist(),
                    "error": round(site.error, 2),
                    "doubt": site.doubt,
                }
                for name, site in sites.items()
            }
            for kind, sites in (("skull", found.skull), ("skin", found.skin))
        },
        "missing": [*found.missing_skull, *(f"{name} (skin)" for name in found.missing_skin)],
    }
