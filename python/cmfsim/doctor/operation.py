"""Whether cuts and plan can be meant: names, landmarks, sizes of motions, bone through skin."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from cmfsim.bones import Procedure, place_procedure
from cmfsim.doctor.evidence import Body, Evidence
from cmfsim.doctor.places import place_text
from cmfsim.doctor.plan_size import SizedMotion, check_motion_size
from cmfsim.errors import CaseError, CmfsimError, LandmarkError
from cmfsim.io.surfaces import surface_as_stored
from cmfsim.io.transforms import motion_in_lps
from cmfsim.values.case_parts import CUT_UP, CaseOsteotomy
from cmfsim.values.checks import Floats
from cmfsim.values.clinical_motion import ClinicalMotion
from cmfsim.values.finding import Finding

__all__ = ["check_against_skin", "check_cuts", "check_plan", "pieces_of"]

# Depth by which a moved bone may pass the undeformed skin before it is reported, mm: skin goes with
# the bone, and an ordinary advancement exceeds the thickness of tissue over the piriform rim.
THROUGH_SKIN = 2.0
# How far outside a bone its neighbourhood is asked for tissue, mm.
BESIDE_BONE = 0.5


def check_cuts(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the names of bones and segments, and the landmarks that cuts need."""
    case = evidence.case
    bones = set(case.surfaces.bones) if case.surfaces else {"cranium", "mandible", "skull"}
    available = set(bones)
    for number, cut in enumerate(case.osteotomies):
        where = case.where(f"osteotomies.{number}")
        if cut.bone is not None and cut.bone not in available:
            yield Finding.error(
                "cut-unknown-bone",
                f"the cut is meant for bone {cut.bone!r}",
                where=where,
                why="no such bone or segment exists at this point of the list",
                fix=f"use one of: {', '.join(sorted(available))}",
            )
        available |= set(cut.segments)
        yield from _check_procedure(evidence, cut, where)
    cut_up = {CUT_UP[p]: cut for cut in case.osteotomies if (p := cut.procedure or "") in CUT_UP}
    for name in case.plan:
        if name in cut_up:
            cut = cut_up[name]
            yield Finding.error(
                "plan-unknown-segment",
                f"the plan moves {name!r}, which {cut.procedure} cuts into "
                f"{', '.join(cut.segments)}",
                where=case.where(f"plan.{name}"),
                why="after the cut no segment has this name, and which piece is meant is unclear",
                fix=f"write [plan.{cut.segments[0]}] for the piece with the teeth",
            )
        elif name not in available:
            yield Finding.error(
                "plan-unknown-segment",
                f"the plan moves {name!r}",
                where=case.where(f"plan.{name}"),
                why="no bone and no osteotomy of the case has this name",
                fix=f"use one of: {', '.join(sorted(available))}, or add the osteotomy that "
                "creates it",
            )


def _check_procedure(evidence: Evidence, cut: CaseOsteotomy, where: str) -> Iterator[Finding]:
    """Whether a standard procedure can be placed from the landmarks that are there."""
    if cut.procedure is None:
        return
    if evidence.case.landmarks.proposed:
        # Placed from landmarks that are found when the case is built.
        return
    try:
        yield from place_procedure(cut.procedure, evidence.skull_landmarks, cut.options).findings
    except LandmarkError as error:
        yield Finding.error(
            "landmark-missing",
            str(error),
            where=where,
            why="standard procedures are placed from skull landmarks",
            fix="add it to the file under [landmarks] skull, or cut by planes",
        )
    except CaseError as error:
        yield Finding.error(
            "cut-options",
            str(error),
            where=where,
            why="the cut cannot be placed",
            fix="correct the option, or remove it",
        )


def _placed(evidence: Evidence, cut: CaseOsteotomy) -> Procedure | None:
    if cut.procedure is None:
        return None
    try:
        return place_procedure(cut.procedure, evidence.skull_landmarks, cut.options)
    except (CaseError, LandmarkError):
        return None


def _piece(evidence: Evidence, name: str) -> Floats | None:
    """Points on the surface of a bone or segment, (k, 3) mm, with the unit normals, (k, 6) in all.

    Of a segment those of its bone that lie in the cut's region; None if nothing is known of it.
    """
    found: list[Floats] = []
    if name in evidence.bones:
        found.append(_with_normals(evidence.bones[name]))
    for cut in evidence.case.osteotomies:
        procedure = _placed(evidence, cut)
        if procedure is not None:
            for piece in procedure.cuts:
                bodies = [evidence.bones[s] for s in piece.sources if s in evidence.bones]
                if name not in {piece.segment, piece.rest} or not bodies:
                    continue
                rows = np.concatenate([_with_normals(body) for body in bodies])
                inside = np.maximum.reduce(
                    [np.minimum.reduce([p.distance(rows[:, :3]) for p in g]) for g in piece.groups]
                )
                found.append(rows[inside > 0.0] if name == piece.segment else rows[inside <= 0.0])
        elif cut.plane is not None and name == cut.name and cut.bone is not None:
            if cut.bone not in evidence.bones:
                continue
            rows = _with_normals(evidence.bones[cut.bone])
            found.append(rows[cut.plane.distance(rows[:, :3]) > 0.0])
    rows = np.concatenate(found) if found else np.zeros((0, 6))
    return rows if len(rows) else None


def _with_normals(body: Body) -> Floats:
    return np.concatenate([body.samples, body.index.closest(body.samples)[1]], axis=1)


def pieces_of(evidence: Evidence) -> dict[str, Floats | None]:
    """What `_piece` gives for each segment whose motion is a matrix, by name."""
    return {name: _piece(evidence, name) for name in evidence.motions}


def check_plan(
    evidence: Evidence, plan: Mapping[str, ClinicalMotion], pieces: Mapping[str, Floats | None]
) -> Iterator[Finding]:
    """Findings about what the plan does to each bone.

    Parameters
    ----------
    evidence : Evidence
    plan : mapping of str to ClinicalMotion
        As `state_plan` gives it.
    pieces : mapping of str to (k, 6) float64 or None
        As `pieces_of` gives it.
    """
    case = evidence.case
    for name, matrix in evidence.motions.items():
        piece, given = pieces[name], case.plan[name]
        yield from _check_frame(evidence, name, matrix)
        wrong = list(
            check_motion_size(
                SizedMotion(
                    name,
                    matrix,
                    case.where(f"plan.{name}"),
                    None if piece is None else piece[:, :3],
                    plan[name].point,
                    typed=given.typed,
                    has_centre=given.centre is not None,
                )
            )
        )
        yield from wrong
        # A bone that flies off passes the skin as well: one reason is enough.
        if piece is not None and not any(f.severity == "error" for f in wrong):
            yield from check_against_skin(
                evidence, name, piece[:, :3], _moved(matrix, piece[:, :3])
            )


def _check_frame(evidence: Evidence, name: str, matrix: Floats) -> Iterator[Finding]:
    """Findings on numbers without a frame, read as LPS, if the surfaces are not in LPS."""
    case, read = evidence.case, evidence.transforms.get(name)
    stated = case.plan[name].frame is not None
    if read is not None:
        stated = "frame" not in read.assumed
    if stated or case.surfaces is None:
        return
    frame = case.surfaces.frame or _header_frame(case.surfaces.skin)
    if frame == "LPS" or np.allclose(motion_in_lps(matrix, frame), matrix, rtol=0.0, atol=1e-9):
        return
    yield Finding.warning(
        "plan-frame",
        f"the motion of {name} has no frame and is read as LPS, but the surfaces are in {frame}",
        where=case.where(f"plan.{name}"),
        why="the other frame reverses forwards and backwards, left and right",
        fix=f'write frame = "LPS" or frame = "{frame}" next to the numbers of the motion',
    )


def _header_frame(path: Path) -> str:
    """The frame that the header of a surface states; LPS where it states none."""
    try:
        return surface_as_stored(path).frame or "LPS"
    except (CmfsimError, OSError):
        # Reported where files are looked for.
        return "LPS"


def check_against_skin(
    evidence: Evidence, name: str, points: Floats, moved: Floats
) -> Iterator[Finding]:
    """Findings about a segment whose points move through the skin, or touch no tissue."""
    yield from _check_through_skin(evidence, name, points, moved)
    piece = _piece(evidence, name)
    if piece is not None:
        yield from _check_tissue(evidence, name, piece)


def _check_through_skin(
    evidence: Evidence, name: str, points: Floats, moved: Floats
) -> Iterator[Finding]:
    skin = evidence.skin
    if skin is None:
        return
    inside_before = skin.index.winding_number(points) >= 0.5
    outside_after = skin.index.winding_number(moved) < 0.5
    through = np.flatnonzero(inside_before & outside_after)
    if not len(through):
        return
    closest = skin.index.closest(moved[through])[0]
    depth = np.linalg.norm(closest - moved[through], axis=1)
    if depth.max() <= THROUGH_SKIN:
        return
    worst = int(np.argmax(depth))
    yield Finding.warning(
        "plan-through-skin",
        f"{name} is moved through the undeformed skin, by {depth[worst]:.1f} mm at "
        f"{place_text(moved[through[worst]])}",
        where=evidence.case.where(f"plan.{name}"),
        why="the tissue over it would be crushed or inverted",
        fix="check the plan; if the advancement is really that large, solve it in steps",
    )


def _check_tissue(evidence: Evidence, name: str, piece: Floats) -> Iterator[Finding]:
    """Findings on a moving bone without adjacent soft tissue in the meshed region."""
    skin = evidence.skin
    if skin is None:
        return
    beside = piece[:, :3] + BESIDE_BONE * piece[:, 3:]
    tissue = (skin.index.winding_number(beside) > 0.5) & evidence.in_region(beside)
    for other in evidence.bones.values():
        if tissue.any():
            beside_tissue = np.flatnonzero(tissue)
            inside = other.index.winding_number(beside[beside_tissue]) > 0.5
            tissue[beside_tissue[inside]] = False
    if tissue.any():
        return
    yield Finding.error(
        "segment-no-tissue",
        f"{name} touches no soft tissue in the meshed region",
        where=evidence.case.where(f"plan.{name}"),
        why="moving it has no effect",
        fix="check region (posterior plane, lower, upper), and that the skin encloses it",
    )


def _moved(matrix: Floats, points: Floats) -> Floats:
    return points @ matrix[:3, :3].T + matrix[:3, 3]
