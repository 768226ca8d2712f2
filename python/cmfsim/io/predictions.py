"""The output folder of `cmfsim predict`: skin, tissue and a summary for each model."""

import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files import replacing
from cmfsim.io.folders import replacing_files
from cmfsim.io.meshes import read_mesh
from cmfsim.io.results import write_result
from cmfsim.io.surfaces import write_surface
from cmfsim.io.vtk import write_tets, write_triangles
from cmfsim.prediction import Prediction
from cmfsim.scene import SurfaceData

__all__ = ["is_prediction_file", "read_parts", "write_prediction"]

PREDICTION_FILES = re.compile(
    r"prediction\.(vtp|stl|vtu|npz|png|json)|face\.(vtp|stl)|(bones|muscles)\.vtp"
    r"|(plan|muscles)\.png|timings\.json"
)


def is_prediction_file(name: str) -> bool:
    """Whether a prediction is written as files of this name, among others."""
    return PREDICTION_FILES.fullmatch(name) is not None


def write_prediction(
    folder: str | os.PathLike[str],
    prediction: Prediction,
    draw: Callable[[Path], Iterable[str]] | None = None,
) -> list[str]:
    """The names of the files that a prediction is written as, in a folder that is made if need be.

    `prediction.vtp` (the mesh's skin at rest with its `displacement`), `prediction.stl` (the same
    where it goes), `face.vtp` and `face.stl` (likewise the whole skin in full detail),
    `prediction.vtu` (tissue with `displacement`, `force`, muscle `fraction` and `fibre`),
    `prediction.npz` (everything, for `read_result`), `bones.vtp` (segments before the operation,
    with their `displacement`) and `muscles.vtp`, each vertex with the number of its `part` (the
    summary lists their names), `timings.json`, and `prediction.json` (counts, parameters, findings,
    versions, hashes). All take their places together, or none does.

    Parameters
    ----------
    folder : path
    prediction : Prediction
    draw : callable, optional
        Draws pictures into the folder that it is given, and returns their names.

    Returns
    -------
    list of str

    Raises
    ------
    OSError
        The folder cannot be made or written to.

    Examples
    --------
    >>> import cmfsim
    >>> names = cmfsim.write_prediction("out", prediction)  # doctest: +SKIP
    """

    def fill(fresh: Path) -> list[str]:
        names = [f"prediction.{ending}" for ending in ("vtp", "stl", "vtu", "npz")]
        names += ["face.vtp", "face.stl"]
        result, skin = prediction.result, prediction.skin_before
        with replacing(fresh / names[0]) as file:
            moved = {
                "displacement": prediction.skin_displacements,
                "node": prediction.skin_nodes.astype(np.int64),
            }
            write_triangles(file, skin.vertices, skin.triangles, moved)
        write_surface(fresh / names[1], prediction.skin)
        face, before = prediction.face, prediction.face_before
        with replacing(fresh / names[4]) as file:
            carried = np.asarray(face.vertices) - np.asarray(before.vertices)
            write_triangles(file, before.vertices, before.triangles, {"displacement": carried})
        write_surface(fresh / names[5], face)
        with replacing(fresh / names[2]) as file:
            points = {"displacement": result.displacements, "force": result.forces}
            write_tets(file, result.nodes, result.tets, points, _muscle_data(prediction))
        write_result(fresh / names[3], result)
        parts = _write_parts(fresh, prediction)
        names.extend(f"{name}.vtp" for name in parts)
        if draw is not None:
            names.extend(draw(fresh))
        names += ["timings.json", "prediction.json"]
        _write_json(fresh / "timings.json", prediction.summary["timings"])
        _write_json(
            fresh / "prediction.json", {**prediction.summary, "parts": parts, "files": names}
        )
        return names

    return replacing_files(Path(folder), "prediction.json", is_prediction_file, fill)


def _write_parts(folder: Path, prediction: Prediction) -> dict[str, list[str]]:
    """The names of the parts in the file of each kind: bones, and muscles where there are any."""
    parts = {"bones": prediction.bones}
    if prediction.muscles is not None:
        still = {m.name: (m.surface, np.asarray(m.surface.vertices)) for m in prediction.muscles}
        parts["muscles"] = still
    for kind, surfaces in parts.items():
        before = [np.asarray(surface.vertices) for surface, _ in surfaces.values()]
        counts = [len(vertices) for vertices in before]
        starts = np.concatenate([[0], np.cumsum(counts)])
        triangles = [
            np.asarray(surface.triangles, dtype=np.int64) + start
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
    folder: str | os.PathLike[str],
) -> dict[str, dict[str, tuple[SurfaceData, NDArray[np.float64]]]]:
    """The surfaces of a prediction that was written, with their vertices after the operation.

    Parameters
    ----------
    folder : path
        That `write_prediction` filled.

    Returns
    -------
    dict of str to dict of str to (SurfaceData, (v, 3) float64)
        "skin", "bones" and, in models with muscles, "muscles"; then by name. Muscles stay.

    Raises
    ------
    FileNotFoundError
        A file is missing: another program's folder, or an older version's.
    CaseError
        (also `ValueError`) A file that cannot be read; PyVista is missing.
    """
    folder = Path(folder)
    text = (folder / "prediction.json").read_text(encoding="utf-8")
    try:
        listed = {kind: [*names] for kind, names in json.loads(text).get("parts", {}).items()}
    except (ValueError, AttributeError, TypeError) as error:
        raise CaseInputError(f"{folder}: prediction.json cannot be read ({error})") from error
    found = {"skin": _read_part_file(folder / "face.vtp", ["skin"])}
    for kind in ("bones", "muscles"):
        if kind in listed:
            found[kind] = _read_part_file(folder / f"{kind}.vtp", listed[kind])
    return found


def _read_part_file(
    path: Path, names: Sequence[str]
) -> dict[str, tuple[SurfaceData, NDArray[np.float64]]]:
    mesh = read_mesh(path)
    points = np.asarray(mesh.points, dtype=np.float64)
    triangles = np.asarray(mesh.cells_dict["triangle"], dtype=np.int64)
    number = np.asarray(mesh.point_data.get("part", np.zeros(len(points), dtype=np.int64)))
    moved = points + np.asarray(mesh.point_data.get("displacement", 0.0))
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


def _write_json(path: Path, value: object) -> None:
    text = json.dumps(value, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
