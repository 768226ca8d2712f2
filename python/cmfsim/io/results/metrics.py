"""Figures of an evaluation as `metrics.json` and `metrics.csv`."""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.files.summaries import (
    COUNT,
    FINDING,
    SOME,
    Maybe,
    Span,
    check,
    checked_file,
    read_summary,
)
from cmfsim.values.prediction import MODELS

# Written last, so that a case that has it is finished.
EVALUATION_FILE = "metrics.json"
REPORT_FILE = "report.html"
EVALUATION_FILES = re.compile(
    r"metrics\.(json|csv)|errors\.png|error-(H|M|H\+S|M\+S)\.(png|vtp)|report\.html"
)
AGAIN = "run cmfsim evaluate again"
# A picture of a report above this size is none of ours, bytes.
MOST_PICTURE = 64 * 2**20
PNG = b"\x89PNG\r\n\x1a\n"

_LENGTH, _SHARE = Span(0.0, 1e6), Span(0.0, 1.0)
_STATISTICS = {
    **dict.fromkeys(
        ("mean_mm", "std_mm", "median_mm", "rms_mm", "p90_mm", "p95_mm", "max_mm"), _LENGTH
    ),
    "signed_mean_mm": Span(-1e6, 1e6),
    "within": {"2 mm": _SHARE, **dict.fromkeys(("1 mm?", "1.5 mm?", "3 mm?"), _SHARE)},
    "count?": COUNT,
}
_ERRORS = {"regions": {"whole": _STATISTICS, SOME: _STATISTICS}}
_EVALUATION = {
    **dict.fromkeys(("case", "key", "case_key"), str),
    "models": {frozenset(MODELS): _ERRORS},
    "failed": {frozenset(MODELS): str},
    "files": [EVALUATION_FILES],
    "not_operated?": Maybe({"regions": {str: _STATISTICS}}),
    "thickness?": {
        "share_of_depth": Span(-1.0, 1.0),
        "vertices": COUNT,
        **dict.fromkeys(("mean_depth_mm", "mean_before_mm", "mean_after_mm"), _LENGTH),
        "mean_mm": {str: {str: _LENGTH}},
    },
    "no_change?": _ERRORS,
    "wilcoxon?": {str: {"p": Maybe(_SHARE)}},
    "notes?": [str],
    "warnings?": [str],
    "seconds?": {str: Span(0.0, 1e9)},
    "findings?": [FINDING],
}


def is_evaluation_file(name: str) -> bool:
    """Whether an evaluation is written as files of this name, among others."""
    return EVALUATION_FILES.fullmatch(name) is not None


def read_evaluation(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """What `metrics.json` in a folder holds, which `cmfsim evaluate` wrote there.

    Raises
    ------
    FileNotFoundError
        There is none.
    CaseError
        (also `ValueError`) It was changed, or holds what an evaluation does not.
    """
    return read_summary(Path(folder) / EVALUATION_FILE, _EVALUATION, AGAIN)


def read_evaluation_picture(
    folder: str | os.PathLike[str], evaluation: Mapping[str, Any], name: str
) -> bytes:
    """A picture that an evaluation lists, as it was written.

    Raises
    ------
    FileNotFoundError
        It is missing.
    CaseError
        (also `ValueError`) It is none of that evaluation, or no PNG.
    """
    check("files", name, EVALUATION_FILES)
    return read_picture(checked_file(Path(folder), evaluation, name, AGAIN))


def read_picture(path: Path) -> bytes:
    """The bytes of a PNG."""
    if path.stat().st_size > MOST_PICTURE:
        raise CaseInputError(f"{path}: is larger than {MOST_PICTURE} bytes")
    data = path.read_bytes()
    if not data.startswith(PNG):
        raise CaseInputError(f"{path}: is not a PNG picture")
    return data


def write_metrics(path: str | os.PathLike[str], metrics: Any) -> None:
    """Writes figures as `.json` (all) or `.csv` (a table), replacing an old file in one step.

    Parameters
    ----------
    path : path
    metrics : SkinComparison, ModelComparison, AchievedPlan, ErrorTable, … or mapping
        For `.json` an object with `as_dict()`, or a mapping of plain values; for `.csv` an object
        with `csv()`, such as an `ErrorTable`.

    Raises
    ------
    CaseError
        (also `ValueError`) Another ending; what cannot be written so; NaN or infinity.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_metrics("metrics.json", cmfsim.distance_statistics([0.5, -1.0]))
    """
    path = Path(path)
    if path.suffix == ".json":
        values = metrics if isinstance(metrics, Mapping) else _call(path, metrics, "as_dict")
        try:
            text = json.dumps(values, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
        except (TypeError, ValueError) as error:
            raise CaseInputError(f"{path.name}: cannot be written as JSON: {error}") from error
    elif path.suffix == ".csv":
        text = _call(path, metrics, "csv")
    else:
        raise CaseInputError(f"{path.name}: figures are written as .json or .csv")
    with replacing(path) as file:
        file.write(text.encode("utf-8"))


def _call(path: Path, metrics: Any, method: str) -> Any:
    if not callable(getattr(metrics, method, None)):
        raise CaseInputError(
            f"{path.name}: a {type(metrics).__name__} has no {method}(): give a result of "
            "compare_skins, compare_models, achieved_plan or error_table"
        )
    return getattr(metrics, method)()
