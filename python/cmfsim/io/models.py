"""The output folder of `cmfsim build`: scene, tissue, skin, bones and a summary."""

import contextlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
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

__all__ = ["is_model_file", "write_model"]


# What models are written as: an earlier build's files of these names go when a later lacks them.
MODEL_FILES = re.compile(
    r"scene\.npz|tissue\.vtu|skin\.ply|segment-[A-Za-z0-9_+-]+\.ply|anatomy\.png|node_kinds\.png|"
    r"build\.json"
)


def is_model_file(name: str) -> bool:
    """Whether a model is written as files of this name, among others."""
    return MODEL_FILES.fullmatch(name) is not None


def write_model(
    folder: str | os.PathLike[str],
    model: PatientModel,
    draw: Callable[[Path], Iterable[str]] | None = None,
) -> list[str]:
    """The names of the files that a model is written as, in a folder that is made if need be.

    `scene.npz` (what `cmfsim solve` takes), `tissue.vtu` (nodes with their kind and segment),
    `skin.ply`, `segment-NAME.ply`, and `build.json` (counts, quality, findings, timings, hashes).
    All files are written beside the old ones first and then take their places, the summary last;
    where one cannot, the old ones come back. Segments and pictures that `build.json` of an earlier
    build lists and this model has not are taken away.

    Parameters
    ----------
    folder : path
    model : PatientModel
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
    >>> names = cmfsim.write_model("out", model)  # doctest: +SKIP
    """
    folder = Path(folder)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return _write_into(folder, model, draw)
    except BaseException:
        # Folders that were made for nothing; one that holds something stays.
        with contextlib.suppress(OSError):
            for path in made:
                path.rmdir()
        raise


def _write_into(
    folder: Path, model: PatientModel, draw: Callable[[Path], Iterable[str]] | None
) -> list[str]:
    fresh = Path(tempfile.mkdtemp(prefix=".building-", dir=folder))
    try:
        names = ["scene.npz", "tissue.vtu", "skin.ply"]
        write_scene(fresh / names[0], model.scene)
        with replacing(fresh / names[1]) as file:
            _write_tissue(file, model.scene, model.kinds)
        write_surface(fresh / names[2], model.skin)
        for number, segment in enumerate(model.segments):
            names.append(_segment_file(segment.name, number, names))
            write_surface(fresh / names[-1], segment.surface)
        if draw is not None:
            names.extend(draw(fresh))
        names.append("build.json")
        text = json.dumps({**model.summary, "files": names}, indent=1, allow_nan=False)
        (fresh / names[-1]).write_text(text + "\n", encoding="utf-8")
        _take_places(fresh, folder, names)
        return names
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _take_places(fresh: Path, folder: Path, names: Sequence[str]) -> None:
    """Puts new files in the place of old ones: all, or where one cannot be put, none."""
    gone = [name for name in _listed(folder / "build.json") if name not in names]
    old = fresh / "old"
    old.mkdir()
    for name in (*names, *gone):
        if (folder / name).exists():
            _keep(folder / name, old / name)
    try:
        for name in gone:
            (folder / name).unlink(missing_ok=True)
        for name in names:
            (fresh / name).replace(folder / name)
    except BaseException:
        for name in (*names, *gone):
            if (old / name).exists():
                (old / name).replace(folder / name)
            elif not (fresh / name).exists():
                (folder / name).unlink(missing_ok=True)
        raise


def _keep(path: Path, copy: Path) -> None:
    """A second name for a file, or a copy where the file system knows no second names."""
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder, where a file is to be written")
    try:
        copy.hardlink_to(path)
    except OSError:
        shutil.copy2(path, copy)


def _listed(summary: Path) -> list[str]:
    """The files of a model that an earlier build's summary lists, where there is one."""
    try:
        listed = json.loads(summary.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [n for n in listed if isinstance(n, str) and is_model_file(n)]


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
