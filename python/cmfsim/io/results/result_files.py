"""Results of a solve as `.npz`, `.vtu` and `.vtp`: each reader beside its writer."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.io.files.reading_writing import named, replacing
from cmfsim.io.meshes.vtk.writing import write_tets, write_triangles
from cmfsim.values.scene import SceneResult
from cmfsim.values.surface_data import used_nodes

RESULT_FORMAT = "cmfsim-result"


def read_result(path: str | os.PathLike[str]) -> SceneResult:
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
        "nodes": (n, 3),
        "tets": (None, 4),
        "skin_triangles": (None, 3),
        "displacements": (n, 3),
        "forces": (n, 3),
        "residual_history": (None,),
        "contact_nodes": (s,),
        "contact_points": (s, 3),
        "contact_normals": (s, 3),
        "contact_forces": (s,),
        "contact_gaps": (s,),
    }
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


def write_result(path: str | os.PathLike[str], result: SceneResult) -> None:
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
    with replacing(path) as file:
        if path.suffix == ".vtu":
            _write_vtu(file, result)
        else:
            _write_vtp(file, result)


def result_suffixes() -> tuple[str, ...]:
    """The file endings that `write_result` knows."""
    return (".npz", ".vtu", ".vtp")


def _write_vtu(file: BinaryIO, result: SceneResult) -> None:
    write_tets(file, result.nodes, result.tets, _point_data(result), {})


def _write_vtp(file: BinaryIO, result: SceneResult) -> None:
    used, triangles = used_nodes(result.skin_triangles)
    data = {name: array[used] for name, array in _point_data(result).items()}
    data["node"] = used
    write_triangles(file, result.nodes[used], triangles, data)


def _point_data(result: SceneResult) -> dict[str, NDArray[Any]]:
    return {"displacement": result.displacements, "force": result.forces}
