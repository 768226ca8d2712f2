"""The output folder of `cmfsim predict`: skin, tissue and a summary for each model."""

import json
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from cmfsim.io.files import replacing
from cmfsim.io.folders import replacing_files
from cmfsim.io.results import write_result
from cmfsim.io.surfaces import write_surface
from cmfsim.io.vtk import write_tets, write_triangles
from cmfsim.prediction import Prediction

__all__ = ["is_prediction_file", "write_prediction"]

PREDICTION_FILES = re.compile(r"prediction\.(vtp|stl|vtu|npz|png|json)|plan\.png|timings\.json")


def is_prediction_file(name: str) -> bool:
    """Whether a prediction is written as files of this name, among others."""
    return PREDICTION_FILES.fullmatch(name) is not None


def write_prediction(
    folder: str | os.PathLike[str],
    prediction: Prediction,
    draw: Callable[[Path], Iterable[str]] | None = None,
) -> list[str]:
    """The names of the files that a prediction is written as, in a folder that is made if need be.

    `prediction.vtp` (the skin at rest with its `displacement`), `prediction.stl` (the predicted
    skin), `prediction.vtu` (tissue with `displacement`, `force`, muscle `fraction` and `fibre`),
    `prediction.npz` (everything, for `read_result`), `timings.json`, and `prediction.json` (counts,
    parameters, findings, versions, hashes). All take their places together, or none does.

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
        result, skin = prediction.result, prediction.skin_before
        with replacing(fresh / names[0]) as file:
            moved = {
                "displacement": prediction.skin_displacements,
                "node": prediction.skin_nodes.astype(np.int64),
            }
            write_triangles(file, skin.vertices, skin.triangles, moved)
        write_surface(fresh / names[1], prediction.skin)
        with replacing(fresh / names[2]) as file:
            points = {"displacement": result.displacements, "force": result.forces}
            write_tets(file, result.nodes, result.tets, points, _muscle_data(prediction))
        write_result(fresh / names[3], result)
        if draw is not None:
            names.extend(draw(fresh))
        names += ["timings.json", "prediction.json"]
        _write_json(fresh / "timings.json", prediction.summary["timings"])
        _write_json(fresh / "prediction.json", {**prediction.summary, "files": names})
        return names

    return replacing_files(Path(folder), "prediction.json", is_prediction_file, fill)


def _muscle_data(prediction: Prediction) -> dict[str, np.ndarray]:
    patient = prediction.patient
    if prediction.muscles is None or patient.fraction is None or patient.fibre is None:
        return {}
    return {"fraction": patient.fraction, "fibre": patient.fibre}


def _write_json(path: Path, value: object) -> None:
    text = json.dumps(value, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
