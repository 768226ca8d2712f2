"""Results of a solve as `.npz`, `.vtu` and `.vtp`, the output of `cmfsim build`, and evaluations.

An evaluation is `metrics.json` and `metrics.csv`, with errors as `error-MODEL.vtp`.
"""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.cases.scenes import write_scene
from cmfsim.io.files import summaries
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.io.files.folders import replacing_files
from cmfsim.io.files.reading_writing import named, replace_text, replacing
from cmfsim.io.meshes.mesh_files import read_mesh
from cmfsim.io.meshes.surfaces import write_surface
from cmfsim.io.meshes.vtk_writing import write_tets, write_triangles
from cmfsim.values.checks import AnyPath, Floats, as_floats, as_rows, frozen
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import MODELS
from cmfsim.values.scene import NodeKinds, SceneResult
from cmfsim.values.surface_data import SurfaceData, used_nodes

RESULT_FORMAT = "cmfsim-result"


def read_result(path: AnyPath) -> SceneResult:
    """The result in a `.npz` file that `write_result` made.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a result, another version, an entry missing.

    Examples
    --------
    >>> import cmfsim
    >>> result = cmfsim.read_result("out.npz")
    """
    path = Path(path)
    with named(path):
        summary, members = read_archive(path, RESULT_FORMAT, "result")
        names = [f for f in SceneResult.__dataclass_fields__ if f != "summary"]
        arrays = {name: member_of(members, name) for name in names}
        _check(arrays)
        return SceneResult(**arrays, summary=summary)


def _check(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Refuses arrays that no solve writes: other shapes, not finite, or of unknown nodes."""
    n, s = len(arrays["nodes"]), len(arrays["contact_nodes"])
    shapes: dict[str, tuple[int | None, ...]] = {
        "nodes": (n, 3), "tets": (None, 4), "skin_triangles": (None, 3), "displacements": (n, 3),
        "forces": (n, 3), "residual_history": (None,), "contact_nodes": (s,),
        "contact_points": (s, 3), "contact_normals": (s, 3), "contact_forces": (s,),
        "contact_gaps": (s,),
    }  # fmt: skip
    for name, shape in shapes.items():
        array = arrays[name]
        kinds = "iu" if name in {"tets", "skin_triangles", "contact_nodes"} else "f"
        fits = array.ndim == len(shape) and all(
            wanted in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
        )
        if array.dtype.kind not in kinds or not fits:
            wanted = " × ".join("any" if w is None else str(w) for w in shape)
            raise CaseInputError(
                f"array {name!r} is {array.dtype} of shape {array.shape}: {wanted} of "
                f"{'whole' if kinds == 'iu' else 'real'} numbers is needed"
            )
        if kinds == "f" and not np.isfinite(array).all():
            at = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise CaseInputError(f"array {name!r} holds a number that is not finite at {at}")
    # Contact nodes of quadratic tets lie in the middle of edges, beyond the nodes of the mesh.
    for name in ("tets", "skin_triangles"):
        array = arrays[name]
        if array.size and not 0 <= int(array.min()) <= int(array.max()) < n:
            raise CaseInputError(f"array {name!r} names a node that is not among {n}")


def write_result(path: AnyPath, result: SceneResult) -> None:
    """Writes a result as `.npz` (everything), `.vtu` (tissue) or `.vtp` (its boundary).

    An existing file is replaced in one step.

    Raises
    ------
    CaseError
        (also `ValueError`) Another ending.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_result("out.vtu", result)
    """
    path = Path(path)
    if path.suffix not in result_suffixes():
        known = ", ".join(result_suffixes())
        raise CaseInputError(f"{path.name}: a result is written as {known}, not {path.suffix!r}")
    if path.suffix == ".npz":
        write_archive(path, RESULT_FORMAT, "result", dict(result.summary), result.arrays())
        return
    points = {"displacement": result.displacements, "force": result.forces}
    with replacing(path) as file:
        if path.suffix == ".vtu":
            write_tets(file, result.nodes, result.tets, points, {})
            return
        used, triangles = used_nodes(result.skin_triangles)
        data: dict[str, NDArray[Any]] = {name: array[used] for name, array in points.items()}
        data["node"] = used
        write_triangles(file, result.nodes[used], triangles, data)


def result_suffixes() -> tuple[str, ...]:
    """The file endings that `write_result` knows."""
    return (".npz", ".vtu", ".vtp")


# What models are written as: an earlier build's files of these names go when a later lacks them.
MODEL_FILES = re.compile(
    r"scene\.npz|tissue\.vtu|skin\.ply|segment-[A-Za-z0-9_+-]+\.ply|anatomy\.png|node_kinds\.png|"
    r"muscles\.png|build\.json"
)


def is_model_file(name: str) -> bool:
    """Whether a model is written as files of this name, among others."""
    return MODEL_FILES.fullmatch(name) is not None


def write_model(
    folder: AnyPath, model: PatientModel, draw: Callable[[Path], Iterable[str]] | None = None
) -> list[str]:
    """The names of the files of a model, written to a folder, which is created if necessary.

    `scene.npz` (what `cmfsim solve` takes), `tissue.vtu` (nodes with their kind and segment),
    `skin.ply`, `segment-NAME.ply`, and `build.json` (counts, quality, findings, timings, hashes).
    All files are written next to the old ones first and then moved into place, the summary last; if
    this fails, the old files are restored. Segments and pictures that the `build.json` of an
    earlier build lists but this model does not have are removed.

    Parameters
    ----------
    folder : path
    model : PatientModel
    draw : callable, optional
        Draws pictures into the folder that it is given, and returns their names.

    Raises
    ------
    OSError
        The folder cannot be created or written to.

    Examples
    --------
    >>> import cmfsim
    >>> names = cmfsim.write_model("out", model)  # doctest: +SKIP
    """

    def fill(fresh: Path) -> list[str]:
        names = ["scene.npz", "tissue.vtu", "skin.ply"]
        write_scene(fresh / names[0], model.scene)
        with replacing(fresh / names[1]) as file:
            _write_tissue(file, model)
        write_surface(fresh / names[2], model.skin)
        for number, segment in enumerate(model.segments):
            names.append(_segment_file(segment.name, number, names))
            write_surface(fresh / names[-1], segment.surface)
        if draw is not None:
            names.extend(draw(fresh))
        names.append("build.json")
        text = json.dumps({**model.summary, "files": names}, indent=1, allow_nan=False)
        (fresh / names[-1]).write_text(text + "\n", encoding="utf-8")
        return names

    return replacing_files(Path(folder), "build.json", is_model_file, fill)


def _segment_file(name: str, number: int, taken: Sequence[str]) -> str:
    """A file name that any system takes and no stranger's name can lead elsewhere.

    Other names than plain ones give way to their number, as do those that differ from an earlier
    one in capitals alone; "+" keeps the number apart from a segment that is called so.
    """
    file = f"segment-{name}.ply"
    plain = re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name) is not None
    if plain and file.lower() not in {other.lower() for other in taken}:
        return file
    return f"segment-+{number}.ply"


def _write_tissue(file: BinaryIO, model: PatientModel) -> None:
    kinds: NodeKinds = model.kinds
    points: dict[str, NDArray[Any]] = {
        "kind": kinds.kind,
        "segment": kinds.segment.astype(np.int64),
    }
    cells: dict[str, NDArray[Any]] = {}
    if model.fraction is not None and model.fibre is not None:
        cells = {"fraction": model.fraction, "fibre": model.fibre}
    write_tets(file, model.scene.nodes, model.scene.tets, points, cells)


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
    """A predicted skin with its distances from the skin after the operation, (v,).

    signed: mm. Negative where the prediction lies behind; 0 where nothing was evaluated.
    evaluated: The vertices that the tables count: those evaluated in every model.
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
    """Writes a predicted skin with the distances (k,), mm, of the vertices that were evaluated."""
    count = len(skin.vertices)
    values, evaluated = np.zeros(count), np.zeros(count, dtype=np.uint8)
    values[vertices], evaluated[vertices] = signed, 1
    with replacing(Path(path)) as file:
        arrays: dict[str, NDArray[Any]] = {DISTANCE: values, EVALUATED: evaluated}
        write_triangles(file, skin.vertices, skin.triangles, arrays, frame="LPS")


def read_skin_errors(folder: AnyPath, evaluation: Mapping[str, Any], model: str) -> SkinErrors:
    """The errors of a model as `read_evaluation` of the same folder lists them."""
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
    """What `metrics.json` in a folder holds, which `cmfsim evaluate` wrote there."""
    return summaries.read_summary(Path(folder) / EVALUATION_FILE, _EVALUATION, AGAIN)


def read_evaluation_picture(folder: AnyPath, evaluation: Mapping[str, Any], name: str) -> bytes:
    """A picture that an evaluation lists, as it was written."""
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
    replace_text(path, text)


def _call(path: Path, metrics: Any, method: str) -> Any:
    if not callable(getattr(metrics, method, None)):
        raise CaseInputError(
            f"{path.name}: a {type(metrics).__name__} has no {method}(): give a result of "
            "compare_skins, compare_models, achieved_plan or error_table"
        )
    return getattr(metrics, method)()
