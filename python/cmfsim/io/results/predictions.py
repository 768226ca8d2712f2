"""The output folder of `cmfsim predict`: skin, tissue and a summary, which is checked when read."""

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.folders import finish_writing, replacing_files
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.files.summaries import (
    COUNT,
    FINDING,
    Maybe,
    Span,
    check,
    checked_file,
    hashes_of,
    read_summary,
    write_summary,
)
from cmfsim.io.meshes.mesh_files import read_mesh
from cmfsim.io.meshes.surfaces import write_surface
from cmfsim.io.meshes.vtk_writing import write_tets, write_triangles
from cmfsim.io.results.result_files import (
    CHART_PAGE_FILE,
    DICOM_PAGE_FILE,
    EVALUATION_FILE,
    REPORT_FILE,
    is_evaluation_file,
    read_evaluation,
    read_picture,
    write_result,
)
from cmfsim.values.checks import AnyPath
from cmfsim.values.moduli import MOST_POISSON, YOUNG_RANGE
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.surface_data import SurfaceData

PREDICTION_FILES = re.compile(
    r"prediction\.(vtp|stl|vtu|npz|png|json|mrb)|face\.(vtp|stl)|face_before\.vtp|(bones|muscles)\.vtp"
    r"|(plan|muscles|band|contacts|lateral)\.png|timings\.json"
)
PREDICTION_FILE = "prediction.json"
# One of these is in every summary and report.
MARKS = (b"cmfsim", b'"case_key"')
TIMINGS_FILE = "timings.json"
AGAIN = "run cmfsim predict again"


def is_prediction_file(name: str) -> bool:
    """Whether a prediction is written as files of this name, among others."""
    return PREDICTION_FILES.fullmatch(name) is not None


_SIZE, _SHARE, _SECONDS = Span(0.0, 1e6), Span(0.0, 1.0), Span(0.0, 1e9)
_LARGE, _VECTOR = Span(0.0, 1e12), [Span(-1e6, 1e6)] * 3
_SCALE = Span(0.1, 10.0)


def _motion(where: str, value: object) -> None:
    """A rigid motion by its numbers, or another by how far it goes."""
    rigid = isinstance(value, dict) and "translation" in value
    shape = {"translation": _VECTOR, "angle": Span(0.0, 360.0), "axis": _VECTOR}
    moved = {"mean": _SIZE, "largest": _SIZE, "bending?": _SIZE}
    check(where, value, {**shape, "mean?": _SIZE, "bending?": _SIZE} if rigid else moved)


_SOLUTION = {
    "method": str,
    **dict.fromkeys(("n_tets", "n_unknowns", "contact_iterations"), COUNT),
    **dict.fromkeys(("residual", "error_bound?", "error_estimate?"), Maybe(_LARGE)),
    "contact_gap": Maybe(Span(-1e6, 1e6)),
}
_FIT = {
    **dict.fromkeys(("rms_mm", "worst_mm", "median_mm", "p95_mm", "slip_mm?"), _SIZE),
    "share": _SHARE,
    "shape?": {"scale": _SCALE, "scale_interval": [_SCALE] * 2, "eigenvalue_ratio": _SHARE,
               "open": [object]},
}  # fmt: skip
_YOUNG, _POISSON = Span(*YOUNG_RANGE), Span(-1.0, MOST_POISSON)
_MUSCLE = {"young_along": _YOUNG, "young_across": _YOUNG, "poisson": _POISSON}
_WIDTHS = ("half_width_mean_mm", "half_width_p95_mm", "half_width_largest_mm", "sd_mean_mm")
_FACTOR = {
    "factor": Span(0.0, 1e9), **dict.fromkeys(("n", "rank"), COUNT),
    **dict.fromkeys(("coverage", "coverage_5_percent", "coverage_95_percent"), _SHARE),
}  # fmt: skip
_BAND_REGION = {
    **dict.fromkeys(_WIDTHS, _SIZE), "calibration": Maybe(_FACTOR), "sources_rms_mm": {str: _SIZE},
}  # fmt: skip
_BAND = {
    "state": frozenset({"calibrated", "uncalibrated"}), "coverage": _SHARE,
    "factor_uncalibrated": Maybe(Span(0.0, 1e3)), "settings_digest": str, "settings": {str: object},
    "regions": {str: _BAND_REGION}, "sources": {str: {"sd": _SIZE, "unit": str, "reference": str}},
    "not_covered": [str], "notes": [str],
    "calibration": Maybe({"file": str, "note": str, "n": COUNT, "group?": Maybe(str)}),
    "seconds": _SECONDS,
}  # fmt: skip
_PLACE = Span(-1e6, 1e6)
_MEASURE = {
    **dict.fromkeys(("label", "unit", "norm", "source", "absent"), str),
    **dict.fromkeys(("before", "planned"), Maybe(_PLACE)),
}
_SITE = {
    **dict.fromkeys(("name", "moves_with"), str),
    **dict.fromkeys(("forwards_mm", "up_mm", "left_mm"), _PLACE),
}
_CONTACTS = {
    "absent?": str, "n_contacts?": COUNT, "greatest_overlap_mm?": _SIZE, "least_gap_mm?": _PLACE,
}  # fmt: skip
_CLINICAL = {
    "occlusion?": [_MEASURE], "cephalometry": [_MEASURE], "face": [_MEASURE], "sites": [_SITE],
    "contacts?": _CONTACTS,
}  # fmt: skip
_MODULI = {
    "fat": {"young": _YOUNG, "poisson": _POISSON}, "muscle": _MUSCLE, "muscles": {str: _MUSCLE},
}  # fmt: skip
PREDICTION = {
    **dict.fromkeys(("case", "case_key", "patient?", "note?", "plan_digits?", "written_at?"), str),
    "model": frozenset(MODELS),
    "versions": {str: str}, "inputs": {str: str}, "timings": {str: _SECONDS},
    "skin": dict.fromkeys(("mean", "face_mean?", "p95", "largest"), _SIZE), "plan": {str: _motion},
    "segments": {str: {"joined": COUNT, "sliding": COUNT}}, "mesh": {str: object},
    "solution": _SOLUTION, "findings": [FINDING],
    "parts": {frozenset({"bones", "muscles"}): [str]}, "files": [PREDICTION_FILES],
    "left_out?": [str], "clinical?": _CLINICAL, "achieved?": {"segments": {str: _FIT}},
    "muscles?": {"volumes?": {str: _LARGE}, "template?": str, "moduli?": _MODULI},
    "refined?": bool, "band?": _BAND,
}  # fmt: skip


def is_result_file(name: str) -> bool:
    """Whether predictions and evaluations are written as a file of this name in an output folder.

    Those of several models lie in a folder for each.
    """
    model, _, plain_name = name.rpartition("/")
    if model:
        return model in MODELS and is_prediction_file(plain_name)
    return is_prediction_file(name) or is_evaluation_file(name)


def read_prediction(folder: AnyPath) -> dict[str, Any]:
    """What `prediction.json` in a folder holds, which `write_prediction` wrote there.

    Raises `FileNotFoundError`: There is none: another program's folder, or a run that was stopped.
    """
    return read_summary(Path(folder) / PREDICTION_FILE, PREDICTION, AGAIN)


def read_prediction_picture(folder: AnyPath, summary: Mapping[str, Any], name: str) -> bytes | None:
    """A picture of a prediction as it was written; None where it was not drawn."""
    if name not in summary["files"]:
        return None
    return read_picture(checked_file(Path(folder), summary, name, AGAIN))


def predictions_of(folder: AnyPath) -> dict[Path, dict[str, Any]]:
    """The predictions in a case's output folder, all of one plan, by the folder of each.

    What a stopped run had still to put in place is put there first.

    folder: That of the case, or of one model.
    Returns: What `read_prediction` gives, in the order of the models; each model once.
    """
    folder = Path(folder)
    places = [folder, *(folder / model for model in MODELS)]
    for place in places:
        if place.is_dir() and not place.is_symlink():
            finish_writing(place)
    there = [
        place
        for place in places
        if not (place.is_symlink() and place != folder) and (place / PREDICTION_FILE).exists()
    ]
    if not there:
        raise FileNotFoundError(
            f"{folder}: holds no prediction.json, or a run was stopped while it wrote: run cmfsim "
            "predict or evaluate first"
        )
    found = {place: read_prediction(place) for place in there}
    if len({summary["case_key"] for summary in found.values()}) > 1:
        names = ", ".join(str(place / PREDICTION_FILE) for place in found)
        raise CaseInputError(
            f"{names}: belong to different plans, inputs or versions; {AGAIN}, or name the folder "
            "of one of them"
        )
    by_model = {summary["model"]: place for place, summary in reversed(found.items())}
    ordered = [by_model[model] for model in MODELS if model in by_model]
    return {place: found[place] for place in ordered}


def check_own(folder: Path) -> None:
    """Finds files of another program that results would replace, or remove as those of old ones."""
    for path in (folder / name for name in (PREDICTION_FILE, EVALUATION_FILE, REPORT_FILE)):
        data = path.read_bytes() if path.is_file() else b""
        # An empty one is what a full disk left.
        if data and not any(mark in data for mark in MARKS):
            raise CaseInputError(
                f"{path}: was not written by cmfsim, and the results would replace or remove it: "
                "move it, or choose another output folder"
            )


def stale_results(folder: Path, key: str) -> list[str]:
    """The names of results in a case's output folder that belong to another plan than a key.

    key: The "case_key" of the results that are about to be put there.
    Returns: Predictions with the folder of the model, their comparison and their report.
    """
    stale: list[str] = []
    for place in ("", *MODELS):
        base = folder / place
        if (place and base.is_symlink()) or not os.path.lexists(base / PREDICTION_FILE):
            continue
        if _key_of(read_prediction, base) != key:
            names = sorted(path.name for path in base.iterdir() if is_prediction_file(path.name))
            stale += [f"{place}/{name}".lstrip("/") for name in names]
    if os.path.lexists(folder / EVALUATION_FILE) and _key_of(read_evaluation, folder) != key:
        stale += sorted(path.name for path in folder.iterdir() if is_evaluation_file(path.name))
    if stale:
        reports = (REPORT_FILE, CHART_PAGE_FILE, DICOM_PAGE_FILE)
        stale += [name for name in reports if os.path.lexists(folder / name)]
    return [*dict.fromkeys(stale)]


def _key_of(read: Callable[[Path], Mapping[str, Any]], folder: Path) -> str | None:
    try:
        return str(read(folder)["case_key"])
    except (OSError, ValueError):
        return None


def write_prediction(
    folder: AnyPath, prediction: Prediction, draw: Callable[[Path], Iterable[str]] | None = None
) -> list[str]:
    """The names of the files of a prediction, written to a folder, which is created if necessary.

    `prediction.vtp` (the mesh's skin at rest with its `displacement`, and with its band where it
    has one), `prediction.stl` (the same where it goes), `face.vtp` and `face.stl` (the whole skin
    in full detail, after the operation), `face_before.vtp` (the same before it; both with the
    `displacement` between them and, if the case has a 3D photo, their `colour`), `prediction.vtu`
    (tissue with `displacement`, `force`, muscle `fraction` and `fibre`), `prediction.npz`
    (everything, for `read_result`), `bones.vtp` (segments before the operation, with their
    `displacement`) and `muscles.vtp`, each vertex with the number of its `part` (the summary lists
    their names), `timings.json`, and `prediction.json` (counts, parameters, findings, versions,
    hashes). All files are moved into place together, or none is. Predictions, a comparison and a
    report in the folder that belong to another plan are removed.

    Parameters
    ----------
    folder : path
    prediction : Prediction
    draw : callable, optional
        Draws pictures into the folder that it is given, and returns their names.

    Raises
    ------
    OSError
        The folder cannot be created or written to.

    Examples
    --------
    >>> import cmfsim
    >>> names = cmfsim.write_prediction("out", prediction)
    """
    folder = Path(folder)
    key = str(prediction.summary.get("case_key", ""))
    return replacing_files(
        folder,
        PREDICTION_FILE,
        is_result_file,
        lambda fresh: fill_prediction(fresh, prediction, draw),
        lambda: stale_results(folder, key),
    )


def fill_prediction(
    fresh: Path, prediction: Prediction, draw: Callable[[Path], Iterable[str]] | None = None
) -> list[str]:
    """The names of the files of a prediction, written into a folder that has none of them."""
    names = [f"prediction.{ending}" for ending in ("vtp", "stl", "vtu", "npz")]
    names += ["face.vtp", "face.stl", "face_before.vtp"]
    result, skin = prediction.result, prediction.skin_before
    with replacing(fresh / names[0]) as file:
        moved = {
            "displacement": prediction.skin_displacements,
            "node": prediction.skin_nodes.astype(np.int64),
            **({} if prediction.band is None else prediction.band.arrays()),
        }
        write_triangles(file, skin.vertices, skin.triangles, moved)
    write_surface(fresh / names[1], prediction.skin)
    face, before = prediction.face, prediction.face_before
    carried: dict[str, NDArray[Any]] = {"displacement": face.vertices - before.vertices}
    if prediction.face_colours is not None:
        carried["colour"] = prediction.face_colours
    for name, places in ((names[4], face.vertices), (names[6], before.vertices)):
        with replacing(fresh / name) as file:
            write_triangles(file, places, before.triangles, carried)
    write_surface(fresh / names[5], face)
    with replacing(fresh / names[2]) as file:
        points = {"displacement": result.displacements, "force": result.forces}
        write_tets(file, result.nodes, result.tets, points, _muscle_data(prediction))
    write_result(fresh / names[3], result)
    parts = _write_parts(fresh, prediction)
    names.extend(f"{name}.vtp" for name in parts)
    # While pictures are drawn.
    sealed = hashes_of(fresh, names)
    if draw is not None:
        more = list(draw(fresh))
        sealed |= hashes_of(fresh, more)
        names.extend(more)
    summary = {"case_key": "", **prediction.summary, "parts": parts}
    own = [TIMINGS_FILE, PREDICTION_FILE]
    summary["files"] = [*names, *own]
    # Timings are for people: what comes after the prediction is added to them.
    write_timings(fresh, prediction.summary["timings"])
    write_summary(fresh / PREDICTION_FILE, summary, sealed)
    return [*names, *own]


def write_timings(folder: Path, seconds: Mapping[str, float]) -> None:
    """Writes the seconds of each stage, in their order, to `timings.json` of a prediction."""
    text = json.dumps(seconds, indent=1, allow_nan=False)
    (folder / TIMINGS_FILE).write_text(text + "\n", encoding="utf-8")


def _write_parts(folder: Path, prediction: Prediction) -> dict[str, list[str]]:
    """The names of the parts in the file of each kind: bones, and muscles where there are any."""
    # The skin has files of its own.
    parts = {kind: found for kind, found in prediction.parts.items() if kind != "skin"}
    for kind, surfaces in parts.items():
        before = [surface.vertices for surface, _ in surfaces.values()]
        counts = [len(vertices) for vertices in before]
        starts = np.concatenate([[0], np.cumsum(counts)])
        triangles = [
            surface.triangles.astype(np.int64) + start
            for (surface, _), start in zip(surfaces.values(), starts, strict=False)
        ]
        moved = [after - at for (_, after), at in zip(surfaces.values(), before, strict=True)]
        with replacing(folder / f"{kind}.vtp") as file:
            data: dict[str, NDArray[Any]] = {
                "part": np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
            }
            if kind == "bones":
                data["displacement"] = np.concatenate(moved)
            # To be looked at: single precision, 10 nm on a head, halves the largest of the files.
            points = np.concatenate(before).astype(np.float32)
            write_triangles(file, points, np.concatenate(triangles), data)
    return {kind: list(surfaces) for kind, surfaces in parts.items()}


def read_parts(
    folder: AnyPath, kinds: Sequence[str] | None = None
) -> dict[str, dict[str, tuple[SurfaceData, NDArray[np.float64]]]]:
    """The surfaces of a prediction and their vertices after the operation, by kind and name.

    Kinds are "skin" and, of these the ones that are asked for, "bones" and "muscles", which stay.
    Raises `FileNotFoundError`: A file is missing: another program's folder, or an older version's.
    """
    folder = Path(folder)
    summary = read_prediction(folder)
    found = {
        "skin": _read_part_file(checked_file(folder, summary, "face_before.vtp", AGAIN), ["skin"])
    }
    for kind, names in summary["parts"].items():
        if kinds is not None and kind not in kinds:
            continue
        path = checked_file(folder, summary, f"{kind}.vtp", AGAIN)
        found[kind] = _read_part_file(path, names)
    return found


def read_face_colours(folder: Path) -> NDArray[np.uint8] | None:
    """The colours of the vertices of the skin that `read_parts` reads; None without a 3D photo."""
    path = checked_file(folder, read_prediction(folder), "face_before.vtp", AGAIN)
    found = read_mesh(path).point_data.get("colour")
    return None if found is None else found.astype(np.uint8)


def _read_part_file(
    path: Path, names: Sequence[str]
) -> dict[str, tuple[SurfaceData, NDArray[np.float64]]]:
    mesh = read_mesh(path)
    points = mesh.points
    triangles = mesh.cells_dict["triangle"]
    number = mesh.point_data.get("part", np.zeros(len(points), dtype=np.int64))
    moved = points + mesh.point_data.get("displacement", 0.0)
    found = {}
    for part, name in enumerate(names):
        mine = np.flatnonzero(number == part)
        corners = triangles[(number[triangles] == part).all(axis=1)]
        if not len(mine) or not len(corners):
            raise CaseInputError(f"{path.name}: part {part} ({name}) has no triangles")
        surface = SurfaceData(points[mine], np.searchsorted(mine, corners))
        found[name] = (surface, moved[mine])
    return found


def _muscle_data(prediction: Prediction) -> dict[str, np.ndarray]:
    patient = prediction.patient
    if prediction.muscles is None or patient.fraction is None or patient.fibre is None:
        return {}
    return {"fraction": patient.fraction, "fibre": patient.fibre}
