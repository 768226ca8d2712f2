"""An evaluation: its figures as `metrics.json` and `metrics.csv`, errors as `error-MODEL.vtp`."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files import summaries
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.meshes.mesh_files import read_mesh
from cmfsim.io.meshes.vtk_writing import write_triangles
from cmfsim.values.checks import AnyPath, Floats, as_floats, as_rows, frozen
from cmfsim.values.prediction import MODELS
from cmfsim.values.surface_data import SurfaceData

DISTANCE, EVALUATED = "signed_distance_mm", "evaluated"

# Written last, so that a case that has it is finished.
EVALUATION_FILE = "metrics.json"
REPORT_FILE, CHART_PAGE_FILE, DICOM_PAGE_FILE = "report.html", "report.pdf", "report.dcm"
EVALUATION_FILES = re.compile(
    r"metrics\.(json|csv)|errors\.png|error-(H|M|H\+S|M\+S)\.(png|vtp)|report\.(html|pdf)"
)
AGAIN = "run cmfsim evaluate again"
# A picture of a report above this size is none of ours, bytes.
MOST_PICTURE = 64 * 2**20
PNG = b"\x89PNG\r\n\x1a\n"

_LENGTH, _SHARE = summaries.Span(0.0, 1e6), summaries.Span(0.0, 1.0)
_STATISTICS = {
    **dict.fromkeys(
        ("mean_mm", "std_mm", "median_mm", "rms_mm", "p90_mm", "p95_mm", "max_mm"), _LENGTH
    ),
    "signed_mean_mm": summaries.Span(-1e6, 1e6),
    "within": {"2 mm": _SHARE, **dict.fromkeys(("1 mm?", "1.5 mm?", "3 mm?"), _SHARE)},
    "count?": summaries.COUNT,
}
_ERRORS = {"regions": {"whole": _STATISTICS, summaries.SOME: _STATISTICS}}
_DEPTHS = ("mean_depth_mm", "mean_before_mm", "mean_after_mm")
_THICKNESS = {
    "share_of_depth": summaries.Span(-1.0, 1.0), "vertices": summaries.COUNT,
    **dict.fromkeys(_DEPTHS, _LENGTH), "mean_mm": {str: {str: _LENGTH}},
}  # fmt: skip
_EVALUATION = {
    **dict.fromkeys(("case", "key", "case_key"), str), "models": {frozenset(MODELS): _ERRORS},
    "failed": {frozenset(MODELS): str}, "files": [EVALUATION_FILES],
    "not_operated?": summaries.Maybe({"regions": {str: _STATISTICS}}), "thickness?": _THICKNESS,
    "no_change?": _ERRORS, "wilcoxon?": {str: {"p": summaries.Maybe(_SHARE)}},
    "notes?": [str], "warnings?": [str], "findings?": [summaries.FINDING],
    "seconds?": {str: summaries.Span(0.0, 1e9)},
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class SkinErrors:
    """A predicted skin with its distances from the skin after the operation.

    skin: As predicted.
    signed: (v,), mm. Negative where the prediction lies behind; 0 where nothing was evaluated.
    evaluated: (v,) bool. The vertices that the tables count: those evaluated in every model.
    """

    skin: SurfaceData
    signed: Floats
    evaluated: NDArray[np.bool_]

    def __post_init__(self) -> None:
        count = len(self.skin.vertices)
        if self.signed.shape != (count,) or self.evaluated.shape != (count,):
            raise CaseInputError(
                f"the skin has {count} vertices, but {len(self.signed)} distances and "
                f"{len(self.evaluated)} marks: one of each is needed for each vertex"
            )
        if not self.evaluated.any():
            raise CaseInputError("no vertex of the skin was evaluated")

    @property
    def counted(self) -> Floats:
        """The signed distances that the tables count, (k,) float64, mm."""
        return self.signed[self.evaluated]

    @property
    def field(self) -> Any:
        """The signed distances on all vertices, masked where nothing was evaluated, mm."""
        return np.ma.array(self.signed, mask=~self.evaluated)


def skin_errors_file(model: str) -> str:
    """The name of the file that holds the errors of a model."""
    return f"error-{model}.vtp"


def write_skin_errors(
    path: AnyPath, skin: SurfaceData, vertices: NDArray[Any], signed: Floats
) -> None:
    """Writes a predicted skin with its distances; an old file goes in one step.

    skin: As predicted.
    vertices: (k,) indices. The vertices that were evaluated.
    signed: (k,), mm. Their distances.
    """
    count = len(skin.vertices)
    values, evaluated = np.zeros(count), np.zeros(count, dtype=np.uint8)
    values[vertices], evaluated[vertices] = signed, 1
    with replacing(Path(path)) as file:
        arrays: dict[str, NDArray[Any]] = {DISTANCE: values, EVALUATED: evaluated}
        write_triangles(file, skin.vertices, skin.triangles, arrays, frame="LPS")


def read_skin_errors(folder: AnyPath, evaluation: Mapping[str, Any], model: str) -> SkinErrors:
    """The errors of a model that an evaluation lists, as they were written.

    folder: With the files of the evaluation.
    evaluation: `read_evaluation` of the same folder.
    Raises `FileNotFoundError`: The file is missing.
    Raises `CaseError`: It is none of that evaluation, was changed, or holds no distances.
    """
    path = summaries.checked_file(Path(folder), evaluation, skin_errors_file(model), AGAIN)
    mesh = read_mesh(path)
    missing = [name for name in (DISTANCE, EVALUATED) if name not in mesh.point_data]
    if missing or "triangle" not in mesh.cells_dict:
        what = missing[0] if missing else "triangles"
        raise CaseInputError(f"{path}: has no {what}; {AGAIN}")
    skin = SurfaceData(as_rows("vertices", mesh.points, 3), mesh.cells_dict["triangle"])
    try:
        return SkinErrors(
            skin,
            frozen(as_floats(DISTANCE, mesh.point_data[DISTANCE])),
            mesh.point_data[EVALUATED] != 0,
        )
    except CaseInputError as error:
        raise CaseInputError(f"{path}: {error}; {AGAIN}") from error


def is_evaluation_file(name: str) -> bool:
    """Whether an evaluation is written as files of this name, among others."""
    return EVALUATION_FILES.fullmatch(name) is not None


def read_evaluation(folder: AnyPath) -> dict[str, Any]:
    """What `metrics.json` in a folder holds, which `cmfsim evaluate` wrote there.

    Raises `FileNotFoundError`: There is none.
    Raises `CaseError`: It was changed, or holds what an evaluation does not.
    """
    return summaries.read_summary(Path(folder) / EVALUATION_FILE, _EVALUATION, AGAIN)


def read_evaluation_picture(folder: AnyPath, evaluation: Mapping[str, Any], name: str) -> bytes:
    """A picture that an evaluation lists, as it was written.

    Raises `FileNotFoundError`: It is missing.
    Raises `CaseError`: It is none of that evaluation, or no PNG.
    """
    summaries.check("files", name, EVALUATION_FILES)
    return read_picture(summaries.checked_file(Path(folder), evaluation, name, AGAIN))


def read_picture(path: Path) -> bytes:
    """The bytes of a PNG."""
    if path.stat().st_size > MOST_PICTURE:
        raise CaseInputError(f"{path}: is larger than {MOST_PICTURE} bytes")
    data = path.read_bytes()
    if not data.startswith(PNG):
        raise CaseInputError(f"{path}: is not a PNG picture")
    return data


def write_metrics(path: AnyPath, metrics: Any) -> None:
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
