"""The work on one case of a study, in a process of its own, whose log is standard error."""

import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cmfsim.doctor import examine, findings_text
from cmfsim.errors import CmfsimError, error_text
from cmfsim.io import Case, CaseChanges
from cmfsim.pipeline.evaluating import evaluate
from cmfsim.pipeline.outputs.results import write_results
from cmfsim.pipeline.predicting import case_for_models, prepare

_log = logging.getLogger(__name__)


def evaluate_case(file: str, output: str, changes: str, models: Sequence[str]) -> bool:
    """Whether a case was compared, though some of its models may have failed.

    It writes what `cmfsim evaluate` writes; if so, `metrics.json` is whole and new.

    file, output: The case, and its output folder.
    changes: Of its settings, as `CaseChanges.as_json` writes them, or an empty text.
    """
    logging.basicConfig(format="cmfsim: %(message)s", level=logging.WARNING, stream=sys.stderr)
    try:
        made = CaseChanges.from_json(changes) if changes else None
        return _evaluated(replace(Case.load(file, changes=made), output=Path(output)), models)
    except (CmfsimError, OSError, ValueError, MemoryError) as error:
        _log.error("error: %s", error_text(error))
        return False


def _evaluated(case: Case, models: Sequence[str]) -> bool:
    """Whether the doctor let the case pass; it was then predicted, compared and written."""
    prepare(case, report=True, evaluation=True)
    found = examine(case_for_models(case, models), models=models).findings
    if any(finding.severity == "error" for finding in found):
        _log.error("%s", findings_text(found))
        return False
    evaluation = evaluate(case, models, check=False, findings=found)
    write_results(
        case.output, evaluation.predictions, models, stage=_log.info, evaluation=lambda: evaluation
    )
    return True
