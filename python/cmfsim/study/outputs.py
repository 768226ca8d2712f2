"""What a study writes: its table as JSON, and its report."""

import json
from pathlib import Path

from cmfsim.io import replacing_files
from cmfsim.io.metrics import REPORT_FILE
from cmfsim.pipeline.outputs import write_report_page
from cmfsim.report import study_document
from cmfsim.study.cohort import StudyReport

__all__ = ["write_study_report"]

STUDY_FILE = "study.json"


def write_study_report(report: StudyReport) -> list[str]:
    """The names of the files of a study: its table as JSON and its report."""
    folder, values = report.cohort.output, report.as_dict()
    text = json.dumps(values, indent=1, allow_nan=False)

    def fill(fresh: Path) -> list[str]:
        (fresh / STUDY_FILE).write_text(text + "\n", encoding="utf-8")
        page = write_report_page(fresh, study_document(values))
        return [STUDY_FILE] if page is None else [STUDY_FILE, page]

    ours = {STUDY_FILE, REPORT_FILE}
    return replacing_files(folder, None, ours.__contains__, fill, lambda: [*ours])
