"""Whether the muscles of a case can be placed: its template, and the landmarks that carry it."""

import difflib
from collections.abc import Iterator
from dataclasses import replace

from cmfsim._core import PRESETS
from cmfsim.doctor.evidence import Evidence
from cmfsim.errors import CmfsimError
from cmfsim.muscles.equivalent import moduli_findings
from cmfsim.muscles.template.muscle_template import MuscleTemplate, missing_landmarks, too_few
from cmfsim.registration import match_landmarks
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.finding import Finding
from cmfsim.values.moduli import FatModuli

# Where a case states moduli of all muscles.
MUSCLE_KEYS = ("muscles.young_along", "muscles.young_across", "muscles.poisson")


def check_muscles(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the template of a case, and its landmarks compared with the patient's."""
    given = evidence.case.muscles
    if given is None:
        return
    where = evidence.case.where("muscles")
    try:
        template = MuscleTemplate.load(given.template)
    except (CmfsimError, OSError) as error:
        yield Finding(
            "input-unreadable",
            str(error),
            where=evidence.case.where("muscles.template"),
            why="muscles cannot be placed without a template",
            fix='give a folder that "cmfsim template check" accepts, or "default"',
        )
        return
    yield from _moduli(evidence, given, template)
    landmarks = evidence.case.landmarks
    if landmarks.proposed or landmarks.is_completed(len(evidence.skull_landmarks)):
        # They are found when the case is built.
        return
    few = too_few(template, evidence.skull_landmarks)
    if few is not None:
        yield replace(few, where=where)
        return
    try:
        matched = match_landmarks(template.landmarks, evidence.skull_landmarks, required=())
    except CmfsimError as error:
        yield Finding(
            "template-landmarks",
            str(error),
            where=where,
            fix='correct the landmarks; "cmfsim template morph" shows each one\'s error',
        )
        return
    yield from (finding for finding in matched.findings if finding.code != "landmark-extra")
    yield from missing_landmarks(template, matched.names, evidence.case.where("landmarks.skull"))


def _moduli(evidence: Evidence, given: CaseMuscles, template: MuscleTemplate) -> Iterator[Finding]:
    """Moduli that the case sets: of muscles that are not there, or other than the preset's."""
    case = evidence.case
    names = [muscle.name for muscle in template.muscles]
    for name in given.moduli.muscles:
        if name not in names:
            close = difflib.get_close_matches(name, names)
            yield Finding(
                "unknown-name",
                f"moduli are given for the muscle {name!r}, which the template does not have",
                where=case.where(f"muscles.moduli.{name}"),
                facts={"names": ", ".join(close or names)},
            )
    tissue = case.fat
    if tissue.kind == "preset" and tissue.preset not in PRESETS:
        return  # `gather` reports it
    stated = (k for k in case.places if k in MUSCLE_KEYS or k.startswith("muscles.moduli."))
    place = next(stated, "tissue")
    try:
        moduli = replace(given.moduli, fat=FatModuli.of(tissue))
    except CmfsimError as error:
        yield Finding(
            "moduli-unusual",
            str(error),
            severity="error",
            where=case.where("tissue"),
            why="the fat of [tissue] lies between the muscles",
            fix="set young (MPa) to a value that is plausible for fat, or remove [tissue]",
        )
        return
    yield from moduli_findings(moduli, given.preset, case.where(place))
