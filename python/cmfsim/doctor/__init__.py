"""Problems of a case, reported before any work is done, each with its reason and its fix.

`diagnose` reads the files of a case and looks; it changes and writes nothing. `evidence` is what
was read, `placement` asks whether it lies where it should, `surfaces` whether it is sound,
`operation` whether cuts and plan are plausible and what is given after the operation belongs
together, `plan` whether motions have a bone's size, and states the plan in words, `moved_bones`
whether a bone before and after is one bone, `muscles` whether these can be placed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from cmfsim.doctor.evidence import gather
from cmfsim.doctor.sites.landmarks import check_automatic
from cmfsim.doctor.sites.placement import check_placement
from cmfsim.doctor.surfaces import (
    check_ends,
    check_image,
    check_lips,
    check_mesh_size,
    check_surfaces,
)
from cmfsim.doctor.surgery.moved_bones import check_moved
from cmfsim.doctor.surgery.operation import (
    check_after,
    check_bite,
    check_cuts,
    check_photo,
    check_plan,
    pieces_of,
    vertices_of,
)
from cmfsim.doctor.surgery.plan import state_plan
from cmfsim.io import CaseOrPath, as_case
from cmfsim.values.clinical_motion import ClinicalMotion
from cmfsim.values.finding import SEVERITIES, Finding


@dataclass(frozen=True)
class Examination:
    """The findings on a case before any work, and its plan in words.

    Attributes
    ----------
    findings : tuple of Finding
        Errors first, then warnings and notes.
    plan : mapping of str to ClinicalMotion
        Motion of each segment in the plan, as far as it can be read. Empty for a plan that is
        measured on the post-operative bones, and if the files are not in one frame.
    """

    findings: tuple[Finding, ...]
    plan: Mapping[str, ClinicalMotion]

    def __repr__(self) -> str:
        """The plan in words, and each finding on a line."""
        lines = [f"plan: {name}: {motion.text}" for name, motion in self.plan.items()]
        lines += [f"{f.severity}: {f.what} [{f.code}]" for f in self.findings]
        return "\n  ".join(["Examination", *lines])


def diagnose(case: CaseOrPath, models: Sequence[str] | None = None) -> tuple[Finding, ...]:
    """The findings on a case before it is built: errors first, then warnings and notes.

    Parameters
    ----------
    case : Case, or path of its file or folder
    models : sequence of str, optional
        The requested models, of "H", "M", "H+S" and "M+S": muscles are checked only if one of them
        has muscles. Default: all models with which the case can be solved.

    Returns
    -------
    tuple of Finding
        An "error" means that building cannot succeed, or would give a wrong answer.

    Notes
    -----
    A fault that causes others is reported alone: if a surface is in metres,
    its landmarks are not reported.

    Examples
    --------
    >>> import cmfsim
    >>> findings = cmfsim.diagnose(cmfsim.Case.load("case.toml"))
    >>> [finding.what for finding in findings if finding.severity == "error"]
    []
    """
    return examine(case, models).findings


def examine(case: CaseOrPath, models: Sequence[str] | None = None) -> Examination:
    """The findings of `diagnose`, with the plan in clinical terms.

    Parameters
    ----------
    case : Case, or path of its file or folder
    models : sequence of str, optional
        As for `diagnose`.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.examine(cmfsim.Case.load("case.toml"))
    >>> found.plan["maxilla"].text
    '5.0 mm forwards, 0.5 mm up at the centre of rotation; pitch −2.0° (front down)'
    """
    case = as_case(case)
    evidence = gather(case)
    findings = [*evidence.findings, *check_cuts(evidence), *check_lips(evidence)]
    findings += [*check_photo(case), *check_bite(case)]
    findings += check_automatic(evidence)
    placement = check_placement(evidence)
    findings += placement
    findings += [*check_image(evidence), *check_surfaces(evidence)]
    plan: dict[str, ClinicalMotion] = {}
    # Distances between things in different frames say nothing.
    if not any(finding.severity == "error" for finding in placement):
        pieces = pieces_of(evidence)
        plan = state_plan(evidence, vertices_of(evidence))
        findings += check_mesh_size(evidence)
        findings += check_plan(evidence, plan, pieces)
        findings += check_ends(evidence)
        findings += check_moved(evidence)
        findings += check_after(evidence)
        if case.muscles is not None and (models is None or any("M" in name for name in models)):
            from cmfsim.doctor.muscles import check_muscles  # noqa: PLC0415

            findings += check_muscles(evidence)
    in_order = sorted(findings, key=lambda f: SEVERITIES.index(f.severity))
    return Examination(tuple(in_order), MappingProxyType(plan))
