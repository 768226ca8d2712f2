"""Figures of an evaluation as `metrics.json` and `metrics.csv`."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io.files import replacing

__all__ = ["write_metrics"]


def write_metrics(path: str | os.PathLike[str], metrics: Any) -> None:
    """Writes figures as `.json` (all of them) or `.csv` (a table); an old file goes in one step.

    Parameters
    ----------
    path : path
    metrics : SkinComparison, ModelComparison, AchievedPlan, ErrorTable, … or mapping
        For `.json` what has `as_dict()`, or a mapping of plain values; for `.csv` what has `csv()`,
        as an `ErrorTable` has.

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
            f"{path.name}: a {type(metrics).__name__} has no {method}(): give what compare_skins, "
            "compare_models, achieved_plan or error_table return"
        )
    return getattr(metrics, method)()
