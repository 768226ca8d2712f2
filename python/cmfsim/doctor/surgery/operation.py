"""Whether cuts and plan are plausible, and what is given after the operation belongs together."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface
from cmfsim.bones.cuts.planes import Cut
from cmfsim.bones.cuts.procedures import place_procedure, placed_cut
from cmfsim.doctor.evidence import Evidence, place_text
from cmfsim.doctor.sites.placement import LANDMARK_WARNING
from cmfsim.doctor.surgery.bone_overlap import BonePart, check_jaws, jaw_of
from cmfsim.doctor.surgery.plan import SizedMotion, check_motion_size, check_typed, nothing_moves
from cmfsim.errors import CaseError, CmfsimError, LandmarkError
from cmfsim.io import Case, read_landmark_file, read_surface
from cmfsim.io.meshes.photos import read_photo
from cmfsim.io.meshes.surfaces import surface_as_stored
from cmfsim.io.slicer.transforms import motion_in_lps
from cmfsim.surfaces.depth import distances
from cmfsim.values.anatomy import JAWS
from cmfsim.values.case_parts import CUT_UP, CaseOsteotomy
from cmfsim.values.checks import Floats
from cmfsim.values.clinical_motion import ClinicalMotion
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.motion import carried
from cmfsim.values.surface_data import MovedSurface, SurfaceData

# Vertices of two files that lie within this of each other are the same, mm: rounding in a file.
SAME = 1e-3
# Depth by which a moved bone may pass the undeformed skin before it is reported, mm: skin goes with
# the bone, and an ordinary advancement exceeds the thickness of tissue over the piriform rim.
THROUGH_SKIN = 2.0
# How far outside a bone its neighbourhood is asked for tissue, mm.
BESIDE_BONE = 0.5


def check_after(evidence: Evidence) -> Iterator[Finding]:
    """A face after the operation that is the one before, or whose landmarks lie elsewhere."""
    given = evidence.case.postoperative
    # A file that is missing is reported where files are looked for.
    if given is None or given.skin is None or not given.skin.is_file():
        return
    try:
        skin = read_surface(given.skin, units=given.units, frame=given.frame)
    except CmfsimError as error:
        yield _unreadable(evidence.case.where("postoperative.skin"), error)
        return
    yield from _check_changed(evidence, skin, severity="warning" if given.verified else "error")
    if given.landmarks is not None and given.landmarks.is_file():
        yield from _check_landmarks(evidence.case, given.landmarks, skin)


def check_photo(case: Case) -> Iterator[Finding]:
    """A 3D photo that cannot be read, or has no colours; whether it fits is known on the head."""
    if case.photo is None:
        return
    try:
        read_photo(case.photo.file)
        if case.photo.landmarks is not None:
            read_landmark_file(case.photo.landmarks)
    except (CmfsimError, OSError) as error:
        why = "the skin cannot get its colours, and the case is not built"
        yield _unreadable(case.where("photo"), error, why)


def check_bite(case: Case) -> Iterator[Finding]:
    """A scan of the wanted bite that cannot be read; whether it fits is known on the teeth."""
    for jaw in JAWS if case.bite is not None else ():
        try:
            read_surface(getattr(case.bite, jaw))
        except (CmfsimError, OSError) as error:
            why = "the bite of the scans is not known, and the case is not built"
            yield _unreadable(case.where(f"bite.{jaw}"), error, why)


def _unreadable(
    where: str,
    error: Exception,
    why: str = "the prediction cannot be compared with the face after the operation",
) -> Finding:
    return Finding("input-unreadable", str(error), where=where, why=why)


def _check_changed(evidence: Evidence, after: SurfaceData, *, severity: str) -> Iterator[Finding]:
    """Whether the face after is the surface before, though the plan moves bone."""
    case = evidence.case
    still = all(np.array_equal(matrix, np.eye(4)) for matrix in evidence.motions.values())
    before = evidence.skin
    if before is None or (still and not evidence.moved and not case.achieved):
        return
    here, there = before.surface.vertices, after.vertices
    if here.shape != there.shape or np.abs(here - there).max(initial=0.0) > SAME:
        return
    yield Finding(
        "postoperative-unchanged",
        "the face after the operation is the face before, vertex by vertex",
        severity=severity,
        where=case.where("postoperative.skin"),
    )


def _check_landmarks(case: Case, file: Path, skin: SurfaceData) -> Iterator[Finding]:
    """Landmarks after the operation that do not lie on the skin after it."""
    where = case.where("postoperative.landmarks")
    try:
        places = read_landmark_file(file, frame=case.landmarks.frame).points
        away = distances(np.array([*places.values()]), Surface(skin.vertices, skin.triangles))
    except CmfsimError as error:
        yield _unreadable(where, error)
        return
    far = [n for n, d in zip(places, away, strict=True) if d > LANDMARK_WARNING]
    if far:
        more = ", …" if len(far) > 4 else ""
        yield Finding(
            "landmarks-off",
            f"{len(far)} of {len(away)} landmarks lie more than {LANDMARK_WARNING:g} mm from the "
            f"skin after the operation, {away.max():.1f} mm at most: {', '.join(far[:4])}{more}",
            severity="warning",
            where=where,
            why="these landmarks decide which points are compared, so their errors would count "
            "as errors of the prediction",
            fix="place them on the post-operative skin, not on the pre-operative one",
        )


def check_cuts(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the names of bones and segments, and the landmarks that cuts need."""
    case = evidence.case
    bones = set(case.surfaces.bones) if case.surfaces else {"cranium", "mandible", "skull"}
    available = set(bones)
    for number, cut in enumerate(case.osteotomies):
        where = case.where(f"osteotomies.{number}")
        if cut.bone is not None and cut.bone not in available:
            yield Finding(
                "unknown-name",
                f"the cut is meant for bone {cut.bone!r}",
                where=where,
                why="no such bone or segment exists at this point of the list",
                facts={"names": ", ".join(sorted(available))},
            )
        available |= set(cut.segments)
        yield from _check_procedure(evidence, cut, where)
    cut_up = {CUT_UP[p]: cut for cut in case.osteotomies if (p := cut.procedure or "") in CUT_UP}
    if {"le_fort_1", "le_fort_3"} <= {cut.procedure for cut in case.osteotomies}:
        yield Finding("cuts-both-le-fort", where=case.where("osteotomies"))
    for name in case.plan:
        if name in cut_up:
            cut = cut_up[name]
            yield Finding(
                "unknown-name",
                f"the plan moves {name!r}, which {cut.procedure} cuts into "
                f"{', '.join(cut.segments)}",
                where=case.where(f"plan.{name}"),
                why="after the cut no segment has this name, and which piece is meant is unclear",
                fix=f"write [plan.{cut.segments[0]}] for the piece with the teeth",
            )
        elif name not in available:
            yield Finding(
                "unknown-name",
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
    landmarks = evidence.case.landmarks
    if landmarks.proposed or landmarks.is_completed(len(evidence.skull_landmarks)):
        # Placed from landmarks that are found when the case is built.
        return
    try:
        yield from place_procedure(cut.procedure, evidence.skull_landmarks, cut.options).findings
    except LandmarkError as error:
        yield Finding(
            "landmark-missing",
            str(error),
            severity="error",
            where=where,
            why="standard procedures are placed from skull landmarks",
            fix="add it to the file under [landmarks] skull, or cut by planes",
        )
    except CaseError as error:
        yield Finding("cut-options", str(error), where=where)


def _cuts(evidence: Evidence) -> Iterator[Cut]:
    """The cuts of the case that can be placed, in their order."""
    for cut in evidence.case.osteotomies:
        # Landmarks or options that do not place it are reported by `check_cuts`.
        with suppress(CaseError, LandmarkError):
            yield from placed_cut(cut, evidence.skull_landmarks).cuts


def _owners(evidence: Evidence, bone: str, points: Floats) -> NDArray[np.object_]:
    """The name of the segment that each of (k, 3) points in or on a bone belongs to."""
    names = np.full(len(points), bone, dtype=object)
    there = set(evidence.bones)
    for cut in _cuts(evidence):
        source = next((name for name in cut.sources if name in there), None)
        if source is None:
            continue
        there |= {cut.segment} if cut.rest is None else {cut.segment, cut.rest}
        own = np.flatnonzero(names == source)
        inside = np.maximum.reduce(
            [np.minimum.reduce([p.distance(points[own]) for p in group]) for group in cut.groups]
        )
        names[own[inside > 0.0]] = cut.segment
        if cut.rest is not None:
            names[own[inside <= 0.0]] = cut.rest
            there.discard(source)
    return names


def _piece(evidence: Evidence, name: str) -> Floats | None:
    """Points on a bone or segment and their unit normals, (k, 6), mm; None if none is known."""
    found = []
    for bone, body in evidence.bones.items():
        own = body.samples[_owners(evidence, bone, body.samples) == name]
        if len(own):
            found.append(np.concatenate([own, body.index.closest(own)[1]], axis=1))
    return np.concatenate(found) if found else None


def vertices_of(evidence: Evidence) -> dict[str, Floats | None]:
    """The vertices, (k, 3) mm, of each segment whose motion is a matrix, as far as it has any."""
    found: dict[str, Floats | None] = dict.fromkeys(evidence.motions)
    for bone, body in evidence.bones.items():
        points = body.repaired.vertices
        owners = _owners(evidence, bone, points)
        for name, known in found.items():
            own = points[owners == name]
            if len(own):
                found[name] = own if known is None else np.concatenate([known, own])
    return found


def _parts(evidence: Evidence) -> list[BonePart]:
    """The bones of both jaws, cut as the case cuts them, with the motions that are known."""
    parts = []
    for bone, body in evidence.bones.items():
        jaw = jaw_of(bone)
        if jaw is None:
            continue
        # A bone itself is among the segments that it is cut into if it is left.
        for name in dict.fromkeys(_owners(evidence, bone, body.samples)):
            moved = evidence.moved.get(name)
            motion = evidence.motions.get(name, np.eye(4))
            where = evidence.case.where(f"plan.{name}")
            if isinstance(moved, MovedSurface):
                parts.append(BonePart(name, jaw, where, body.repaired, moved))
                continue

            def owns(points: Floats, bone: str = bone, name: str = name) -> NDArray[np.bool_]:
                return np.asarray(_owners(evidence, bone, points) == name, dtype=np.bool_)

            parts.append(BonePart(name, jaw, where, body.repaired, motion, owns))
    return parts


def pieces_of(evidence: Evidence) -> dict[str, Floats | None]:
    """What `_piece` gives for each segment whose motion is a matrix, by name."""
    return {name: _piece(evidence, name) for name in evidence.motions}


def check_plan(
    evidence: Evidence, plan: Mapping[str, ClinicalMotion], pieces: Mapping[str, Floats | None]
) -> Iterator[Finding]:
    """Findings about what a plan of `state_plan` does to each bone, by points of `pieces_of`."""
    case = evidence.case
    # A motion that cannot be read is reported where files are.
    known = not case.achieved and set(case.plan) == set(evidence.motions)
    if known and all(np.array_equal(motion, np.eye(4)) for motion in evidence.motions.values()):
        yield nothing_moves(case.where("plan"))
    apart = False
    for name, matrix in evidence.motions.items():
        piece, given, where = pieces[name], case.plan[name], case.where(f"plan.{name}")
        points = None if piece is None else piece[:, :3]
        yield from findings_at(where, _check_frame(evidence, name, matrix))
        sized = SizedMotion(
            name, matrix, points, plan[name].point, typed=given.typed, centre=given.centre
        )
        wrong = list(findings_at(where, check_motion_size(sized)))
        yield from wrong
        if given.typed:
            yield from findings_at(where, check_typed(plan[name]))
        # A bone that flies off passes the skin as well: one reason is enough.
        flies = any(f.severity == "error" for f in wrong)
        apart = apart or flies
        if points is not None and not flies:
            moved = carried(matrix, points)
            yield from findings_at(where, check_against_skin(evidence, name, points, moved))
    if not apart:
        yield from check_jaws(_parts(evidence), evidence.skull_landmarks)


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
    yield Finding(
        "plan-frame",
        f"the motion of {name} has no frame and is read as LPS, but the surfaces are in {frame}",
        facts={"frame": frame},
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
    depth = distances(moved[through], skin.index)
    if depth.max() <= THROUGH_SKIN:
        return
    worst = int(np.argmax(depth))
    yield Finding(
        "plan-through-skin",
        f"{name} is moved through the undeformed skin, by {depth[worst]:.1f} mm at "
        f"{place_text(moved[through[worst]])}",
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
    yield Finding(
        "segment-no-tissue", f"{name} touches no soft tissue in the meshed region", severity="error"
    )
