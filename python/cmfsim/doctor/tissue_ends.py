"""Whether lips can be separated, and moving jaws lie far enough from where the tissue ends."""

from collections.abc import Iterator
from pathlib import Path

from cmfsim.doctor.evidence import Evidence
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import label_key

CORNERS = ("cheilion_R", "cheilion_L")
BORDERS = ("labiale_superius", "labiale_inferius")
# Methods that solve contact of the lips.
METHODS = ("auto", "pcg")

# What moves the chin, and the landmarks at its lower and upper border.
LOWER_JAW = frozenset({"mandible", "mandible_body", "chin"})
LOWEST, HIGHEST = "menton", "infradentale"
# Soft tissue follows a bone that moves over about its own thickness, mm.
NEAR_END = 20.0


def check_ends(evidence: Evidence) -> Iterator[Finding]:
    """A finding where the chin moves and the tissue below it is fixed close by."""
    case = evidence.case
    moving = {*case.plan, *(n for cut in case.osteotomies for n in cut.segments)} & LOWER_JAW
    if not moving:
        return
    if (found := _chin(evidence)) is None:
        return
    place, top, where = found
    ends = []
    if case.region.lower is not None:
        ends.append(
            (case.region.lower, case.where("region.lower"), "move lower in [region] further down")
        )
    if evidence.image is not None:
        key = case.where("image.file")
        ends.append(
            (float(evidence.image.lowest[2]), key, "use an image that extends further down")
        )
    if not ends:
        return
    end, key, how = max(ends)
    room = place - end
    # A jaw that lies beyond the end altogether is another finding's.
    if room >= NEAR_END or top < end:
        return
    yield Finding(
        "segment-near-end",
        f"{', '.join(sorted(moving))} moves, and the tissue ends, fixed, {max(room, 0.0):.1f} mm "
        f"below {where} (z = {place:.1f} mm, end at {end:.1f} mm; at least {NEAR_END:g} mm is "
        "needed)",
        where=key,
        fix=f"{how}, or leave chin and throat out of the evaluation",
    )


def _chin(evidence: Evidence) -> tuple[float, float, str] | None:
    """The heights of the lower border of the chin and of the jaw's top, and their source."""
    points = evidence.skull_landmarks
    if LOWEST in points:
        heights = [float(points[n][2]) for n in (LOWEST, HIGHEST) if n in points]
        return heights[0], max(heights), f"the landmark {LOWEST}"
    if "mandible" in evidence.bones:
        heights = evidence.bones["mandible"].surface.vertices[:, 2].tolist()
        return min(heights), max(heights), "the mandible"
    return None


def check_lips(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the contact of the lips, where a case asks for it."""
    case = evidence.case
    lips = case.lips
    if not lips.contact:
        return
    if case.solver.method not in METHODS:
        yield Finding(
            "lips-contact",
            f"contact of the lips is not solved by method = {case.solver.method!r}",
            severity="error",
            where=case.where("solver.method"),
            why="the solver would end with an error",
            fix=f"write one of {', '.join(METHODS)}, or contact = false in [lips]",
        )
    if case.node_kinds.get("sliding") is False:
        yield Finding(
            "lips-contact",
            "contact of the lips is enabled, but tissue does not slide on the teeth",
            severity="warning",
            where=case.where("node_kinds.sliding"),
            why="the lips stay attached to the teeth and can hardly meet",
            fix="remove sliding = false from [node_kinds], or set contact = false in [lips]",
        )
    if isinstance(lips.seam, Path) or case.mesh.parting is not None:
        return
    known = {label_key(name) for name in evidence.skin_landmarks}
    missing = [name for name in (*CORNERS, *BORDERS) if label_key(name) not in known]
    if not missing:
        return
    if lips.seam == "landmarks":
        yield Finding(
            "landmark-missing",
            f'seam = "landmarks", and the skin landmarks {", ".join(missing)} are missing',
            severity="error",
            where=case.where("lips.seam"),
            why="the lips would not be separated",
            fix='place them, or set seam = "auto" in [lips]',
        )
        return
    yield Finding(
        "landmark-missing",
        f"the skin landmarks {', '.join(missing)} are missing",
        severity="note",
        where=case.where("landmarks.skin"),
        why="the line between the lips and the corners of the mouth are then found on the skin "
        "alone and cannot be checked; if the skin shows neither gap nor crease, the lips "
        "are not separated",
    )
