"""Whether the muscles of a case can be placed: its template, and the landmarks that carry it."""

from collections.abc import Iterator

from cmfsim.doctor.evidence import Evidence
from cmfsim.errors import CmfsimError
from cmfsim.muscles.template import MuscleTemplate
from cmfsim.muscles.template.morphing import missing_landmarks
from cmfsim.registration import match_landmarks
from cmfsim.values.finding import Finding

__all__ = ["check_muscles"]


def check_muscles(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the template of a case, and its landmarks beside the patient's."""
    given = evidence.case.muscles
    if given is None:
        return
    where = evidence.case.where("muscles")
    try:
        template = MuscleTemplate.load(given.template)
    except (CmfsimError, OSError) as error:
        yield Finding.error(
            "template-unreadable",
            str(error),
            where=evidence.case.where("muscles.template"),
            why="there is nothing to take muscles from",
            fix='name a folder that "cmfsim template check" passes, or "default"',
        )
        return
    if evidence.case.landmarks.proposed:
        # They are found when the case is built.
        return
    if not evidence.skull_landmarks:
        yield Finding.error(
            "muscles-without-landmarks",
            "muscles are asked for, and no skull landmarks could be read",
            where=where,
            why="they carry the template to the patient",
            fix="add [landmarks] skull, or leave out [muscles]",
        )
        return
    try:
        matched = match_landmarks(template.landmarks, evidence.skull_landmarks, required=())
    except CmfsimError as error:
        yield Finding.error(
            "muscles-landmarks",
            str(error),
            where=where,
            why="the template cannot be carried to the patient by these landmarks",
            fix='correct the landmarks; "cmfsim template morph" shows each one\'s error',
        )
        return
    yield from (finding for finding in matched.findings if finding.code != "landmark-extra")
    yield from missing_landmarks(template, matched.names, evidence.case.where("landmarks.skull"))
