"""Results of a solve as `.npz`, `.vtu` and `.vtp`, and the output folder of `cmfsim build`."""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.cases.scenes import write_scene
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.io.files.folders import replacing_files
from cmfsim.io.files.reading_writing import named, replacing
from cmfsim.io.meshes.surfaces import write_surface
from cmfsim.io.meshes.vtk_writing import write_tets, write_triangles
from cmfsim.values.checks import AnyPath
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.scene import SceneResult
from cmfsim.values.surface_data import used_nodes

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
