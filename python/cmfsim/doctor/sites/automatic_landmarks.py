"""The note that landmarks will be found during the build, and what cannot be checked before."""

from collections.abc import Iterator

from cmfsim.doctor.evidence import Evidence
from cmfsim.values.finding import Finding


def check_automatic(evidence: Evidence) -> Iterator[Finding]:
    """A note for a case without landmarks, with the checks that are left to the build."""
    case = evidence.case
    count = len(evidence.skull_landmarks)
    if not (case.landmarks.proposed or case.landmarks.is_completed(count)):
        return
    left = [
        *(f"the cut {cut.procedure}" for cut in case.osteotomies if cut.procedure),
        *(["the muscles"] if case.muscles is not None else []),
        "the region that is meshed",
    ]
    yield Finding(
        "landmarks-automatic",
        "the build will find the landmarks that the case does not give; the doctor does not check "
        + ", ".join(left),
        where=case.where("landmarks"),
    )
