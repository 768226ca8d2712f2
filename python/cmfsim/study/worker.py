"""The process that works on one case of a study.

    python -m cmfsim.study.worker FILE OUTPUT CHANGES MODEL [MODEL ...]

It writes what `cmfsim evaluate` writes, and ends with 0 if `metrics.json` is whole and new. Its log
goes to standard error. Standard input is a pipe of the process that started it: when that is
closed, the worker ends at once.
"""

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cmfsim.doctor import examine, findings_text
from cmfsim.errors import CmfsimError, error_text
from cmfsim.io import Case, CaseChanges
from cmfsim.pipeline.evaluating import evaluate
from cmfsim.pipeline.outputs import write_results
from cmfsim.pipeline.predicting import case_for_models
from cmfsim.pipeline.preparation import prepare

_log = logging.getLogger(__name__)


def main(words: Sequence[str]) -> int:
    """The exit code of one case: 0 if it was compared, though some of its models may have failed.

    Parameters
    ----------
    words : sequence of str
        The case's file, its output folder, changes of its settings as `CaseChanges.as_json` writes
        them or an empty text, and the models.
    """
    logging.basicConfig(format="cmfsim: %(message)s", level=logging.WARNING, stream=sys.stderr)
    file, output, changes, *models = words
    _end_with_input()
    try:
        made = CaseChanges.from_json(changes) if changes else None
        case = replace(Case.load(file, changes=made), output=Path(output))
        return 0 if _evaluated(case, models) else 1
    except (CmfsimError, OSError, ValueError, MemoryError) as error:
        _log.error("error: %s", error_text(error))
        return 1


def _evaluated(case: Case, models: Sequence[str]) -> bool:
    """Whether the doctor let the case pass; it was then predicted, compared and written."""
    prepare(case, report=True, evaluation=True)
    found = examine(case_for_models(case, models), models=models).findings
    if any(finding.severity == "error" for finding in found):
        _log.error("%s", findings_text(found))
        return False
    evaluation = evaluate(case, models, check=False, findings=found)
    write_results(
        case.output,
        evaluation.predictions,
        models,
        stage=_log.info,
        evaluation=lambda: evaluation,
    )
    return True


def _end_with_input() -> None:
    """Has the process end at once when standard input does: with the process that started it."""

    def wait() -> None:
        # Not through `sys.stdin`, whose lock the end of the interpreter would wait for.
        with contextlib.suppress(OSError):
            while os.read(0, 1024):
                pass
        # Results are whole whenever a process ends.
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
