"""Whether the lips of a case can be separated, and their contact solved."""

from collections.abc import Iterator
from pathlib import Path

from cmfsim.doctor.evidence import Evidence
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import label_key

CORNERS = ("cheilion_R", "cheilion_L")
BORDERS = ("labiale_superius", "labiale_inferius")
# Methods that solve contact of the lips.
METHODS = ("auto", "pcg")


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
