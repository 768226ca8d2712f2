"""Whether a jaw that moves lies far enough from where the image, and with it the tissue, ends."""

from collections.abc import Iterator

from cmfsim.doctor.evidence import Evidence
from cmfsim.values.finding import Finding

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
