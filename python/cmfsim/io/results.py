"""Results of a solve as `.npz`, `.vtu` and `.vtp`: each reader beside its writer."""

import os
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.archives import member_of, read_archive, write_archive
from cmfsim.io.files import named, replacing
from cmfsim.io.vtk import VTK_TETRA, data_array, write_vtk
from cmfsim.scene import SceneResult

__all__ = ["read_result", "result_suffixes", "write_result"]

RESULT_FORMAT = "cmfsim-result"


def read_result(path: str | os.PathLike[str]) -> SceneResult:
    """The result in a `.npz` file that `write_result` made.

    Parameters
    ----------
    path : path

    Returns
    -------
    SceneResult

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a result, another version, an entry missing.

    Examples
    --------
    >>> import cmfsim
    >>> result = cmfsim.read_result("out.npz")  # doctest: +SKIP
    """
    path = Path(path)
    with named(path):
        summary, members = read_archive(path, RESULT_FORMAT, "result")
        names = [f for f in SceneResult.__dataclass_fields__ if f != "summary"]
        return SceneResult(**{n: member_of(members, n) for n in names}, summary=summary)


def write_result(path: str | os.PathLike[str], result: SceneResult) -> None:
    """Writes a result as `.npz` (everything), `.vtu` (tissue) or `.vtp` (its boundary).

    An existing file is replaced in one step.

    Parameters
    ----------
    path : path
    result : SceneResult

    Raises
    ------
    CaseError
        (also `ValueError`) Another ending.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_result("out.vtu", result)  # doctest: +SKIP
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
    n_tets = len(result.tets)
    head = f'<Piece NumberOfPoints="{len(result.nodes)}" NumberOfCells="{n_tets}">'
    cells = (
        data_array("connectivity", result.tets.reshape(-1).astype(np.int64))
        + data_array("offsets", 4 * np.arange(1, n_tets + 1, dtype=np.int64))
        + data_array("types", np.full(n_tets, VTK_TETRA, dtype=np.uint8))
    )
    body = f"{head}{_points(result.nodes, result)}<Cells>{cells}</Cells></Piece>"
    write_vtk(file, "UnstructuredGrid", body)


def _write_vtp(file: BinaryIO, result: SceneResult) -> None:
    used, triangles = np.unique(result.skin_triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    n = len(triangles)
    head = (
        f'<Piece NumberOfPoints="{len(used)}" NumberOfVerts="0" NumberOfLines="0" '
        f'NumberOfStrips="0" NumberOfPolys="{n}">'
    )
    polys = data_array("connectivity", triangles.reshape(-1).astype(np.int64)) + data_array(
        "offsets", 3 * np.arange(1, n + 1, dtype=np.int64)
    )
    body = f"{head}{_points(result.nodes, result, used)}<Polys>{polys}</Polys></Piece>"
    write_vtk(file, "PolyData", body)


def _points(nodes: NDArray[Any], result: SceneResult, used: NDArray[Any] | None = None) -> str:
    rows = slice(None) if used is None else used
    data = (
        data_array("displacement", result.displacements[rows])
        + data_array("force", result.forces[rows])
        + ("" if used is None else data_array("node", used.astype(np.int64)))
    )
    points = data_array("points", nodes[rows])
    return f"<Points>{points}</Points><PointData>{data}</PointData>"
