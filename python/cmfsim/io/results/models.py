"""The output folder of `cmfsim build`: scene, tissue, skin, bones and a summary."""

import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.io.cases.scenes import write_scene
from cmfsim.io.files.folders import replacing_files
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.meshes.vtk.writing import write_tets
from cmfsim.io.surfaces import write_surface
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.patient_model import PatientModel

# What models are written as: an earlier build's files of these names go when a later lacks them.
MODEL_FILES = re.compile(
    r"scene\.npz|tissue\.vtu|skin\.ply|segment-[A-Za-z0-9_+-]+\.ply|anatomy\.png|node_kinds\.png|"
    r"muscles\.png|build\.json"
)


def is_model_file(name: str) -> bool:
    """Whether a model is written as files of this name, among others."""
    return MODEL_FILES.fullmatch(name) is not None


def write_model(
    folder: str | os.PathLike[str],
    model: PatientModel,
    draw: Callable[[Path], Iterable[str]] | None = None,
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
