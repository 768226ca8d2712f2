"""Whether the face after an operation is that of this patient, after this operation."""

from collections.abc import Iterator, Mapping

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.evaluation import NO_CHANGE, ModelComparison, SkinComparison
from cmfsim.io import Case
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding

# Mean distance between the faces before and after where nothing was operated on, mm, from which on
# it is reported, and from which on they are not one patient's in one frame. Registration, weight
# and expression leave 0.1 to 0.7 mm; the face of another patient of like size left 3.05 mm.
DIFFERS, OTHER_FACE = 1.0, 3.0
# Where a model moves the skin by at least this, mm, and by half of what it moves most of it by, the
# face after shows the operation (most: a coarse mesh leaves single vertices in folds). If it is so
# much nearer to the face before than to every prediction, it is a scan from before: two scans of
# one face differ by 0.15 mm.
SHOWS, HALF, MOST, UNCHANGED = 1.0, 0.5, 0.95, 0.15


def check_face_after(
    case: Case,
    comparison: ModelComparison,
    unmoved: SkinComparison | None,
    moved: Mapping[str, Floats],
) -> Iterator[Finding]:
    """Findings on a face after that is another patient's, in another frame, or the one before.

    They are errors, unless the case states that the face is verified.

    unmoved: The faces before and after where nothing was operated on, where it is known.
    moved: mapping of str to (v,), mm. How far each model moves each vertex of the skin.
    """
    given = case.postoperative
    severity = "warning" if given is not None and given.verified else "error"
    where = case.where("postoperative")
    change = comparison.statistics[NO_CHANGE].mean
    if unmoved is not None:
        differs = unmoved.statistics.mean
        what = f"by {differs:.2f} mm on average where nothing was operated on"
    else:
        differs = change - max(float(size.max()) for size in moved.values())
        what = f"by {change:.2f} mm on average, more than any model moves the skin anywhere"
    if differs > (DIFFERS if unmoved is not None else OTHER_FACE):
        yield Finding(
            "postoperative-other-face",
            f"the faces before and after the operation differ {what}",
            severity=severity if differs > OTHER_FACE else "warning",
            where=where,
        )
    if _is_unchanged(comparison):
        yield Finding(
            "postoperative-unchanged",
            "the face after the operation is the face before: where the plan moves the skin "
            f"most, they differ by {change:.2f} mm on average",
            severity=severity,
            where=where,
        )


def _is_unchanged(comparison: ModelComparison) -> bool:
    """Whether the face after is far nearer to the face before than to every prediction."""
    still = np.abs(comparison.errors[NO_CHANGE])
    for model in comparison.models:
        off = np.abs(comparison.errors[model])
        shows = off > max(SHOWS, HALF * float(np.quantile(off, MOST)))
        if not shows.any() or np.median(still[shows]) > UNCHANGED * np.median(off[shows]):
            return False
    return True


def refuse_other_face(findings: Iterator[Finding]) -> tuple[Finding, ...]:
    """The findings, where none is an error.

    Raises `CaseError`: One is.
    """
    found = tuple(findings)
    for finding in found:
        if finding.severity == "error":
            raise CaseInputError(
                f"{finding.where}: {finding.what} ({finding.code}): {finding.why}; {finding.fix}"
            )
    return found
