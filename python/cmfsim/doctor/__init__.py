"""What will go wrong with a case, said before any work is done: each with why and how to mend it.

`diagnose` reads the files of a case and looks; it changes and writes nothing. `evidence` is what
was read, `placement` asks whether it lies where it should, `surfaces` whether it is sound,
`operation` whether cuts and plan can be meant, `moved` whether a bone before and after is one bone,
`after` whether what is given after the operation belongs together, `muscles` whether these can be
placed.
"""

from cmfsim.case import SEVERITIES, Finding
from cmfsim.doctor.after import check_after
from cmfsim.doctor.evidence import gather
from cmfsim.doctor.moved import check_moved
from cmfsim.doctor.operation import check_cuts, check_plan
from cmfsim.doctor.placement import check_placement
from cmfsim.doctor.report import findings_text
from cmfsim.doctor.surfaces import check_image, check_mesh_size, check_surfaces
from cmfsim.io import Case

__all__ = ["diagnose", "findings_text"]


def diagnose(case: Case) -> tuple[Finding, ...]:
    """What a person should know before a case is built: errors first, then warnings and notes.

    Parameters
    ----------
    case : Case

    Returns
    -------
    tuple of Finding
        An "error" means that building cannot succeed, or would give a wrong answer.

    Notes
    -----
    A fault that makes others is said alone: where a surface is in metres, nothing is said about its
    landmarks.

    Examples
    --------
    >>> import cmfsim
    >>> for finding in cmfsim.diagnose(cmfsim.Case.load("case.toml")):  # doctest: +SKIP
    ...     print(finding.severity, finding.what, finding.mend)
    """
    evidence = gather(case)
    findings = [*evidence.findings, *check_cuts(evidence)]
    placement = check_placement(evidence)
    findings += placement
    findings += [*check_image(evidence), *check_surfaces(evidence)]
    # Distances between things in different frames say nothing.
    if not any(finding.severity == "error" for finding in placement):
        findings += check_mesh_size(evidence)
        findings += check_plan(evidence)
        findings += check_moved(evidence)
        findings += check_after(evidence)
        if case.muscles is not None:
            from cmfsim.doctor.muscles import check_muscles  # noqa: PLC0415

            findings += check_muscles(evidence)
    return tuple(sorted(findings, key=lambda f: SEVERITIES.index(f.severity)))
