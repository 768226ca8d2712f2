"""The output folder of `cmfsim build`: scene, tissue, skin, bones and a summary."""

import json
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from cmfsim.case import NodeKinds
from cmfsim.io.files import replacing
from cmfsim.io.scenes import write_scene
from cmfsim.io.surfaces import write_surface
from cmfsim.io.vtk import VTK_TETRA, data_array, write_vtk
from cmfsim.model import PatientModel
from cmfsim.scene import Scene

__all__ = ["write_model"]


def write_model(folder: str | os.PathLike[str], model: PatientModel) -> None:
    """Writes a model into a folder, which is made if it is not there.

    `scene.npz` (what `cmfsim solve` takes), `tissue.vtu` (nodes with their kind and segment),
    `skin.ply`, `segment-NAME.ply`, and `build.json` (counts, quality, findings, timings, hashes).
    All files are written beside the old ones first and then take their places, the summary last.

    Parameters
    ----------
    folder : path
    model : PatientModel

    Raises
    ------
    OSError
        The folder cannot be made or written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_model("out", model)  # doctest: +SKIP
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=".building-", dir=folder))
    try:
        names = ["scene.npz", "tissue.vtu", "skin.ply"]
        write_scene(fresh / names[0], model.scene)
        with replacing(fresh / names[1]) as file:
            _write_tissue(file, model.scene, model.kinds)
        write_surface(fresh / names[2], model.skin)
        for number, segment in enumerate(model.segments):
            names.append(_segment_file(segment.name, number))
            write_surface(fresh / names[-1], segment.surface)
        names.append("build.json")
        text = json.dumps({**model.summary, "files": names}, indent=1, allow_nan=False)
        (fresh / names[-1]).write_text(text + "\n", encoding="utf-8")
        for name in names:
            (fresh / name).replace(folder / name)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _segment_file(name: str, number: int) -> str:
    """A file name that any system takes and no stranger's name can lead elsewhere."""
    plain = re.fullmatch(r"[A-Za-z0-9_-]{1,60}", name)
    return f"segment-{name if plain else number}.ply"


def _write_tissue(file: BinaryIO, scene: Scene, kinds: NodeKinds) -> None:
    nodes, tets = np.asarray(scene.nodes), np.asarray(scene.tets)
    cells = (
        data_array("connectivity", tets.reshape(-1).astype(np.int64))
        + data_array("offsets", 4 * np.arange(1, len(tets) + 1, dtype=np.int64))
        + data_array("types", np.full(len(tets), VTK_TETRA, dtype=np.uint8))
    )
    data = data_array("kind", kinds.kind) + data_array("segment", kinds.segment.astype(np.int64))
    body = (
        f'<Piece NumberOfPoints="{len(nodes)}" NumberOfCells="{len(tets)}">'
        f"<Points>{data_array('points', nodes)}</Points><PointData>{data}</PointData>"
        f"<Cells>{cells}</Cells></Piece>"
    )
    write_vtk(file, "UnstructuredGrid", body)
