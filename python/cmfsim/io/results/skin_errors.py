"""Errors of a predicted skin as `error-MODEL.vtp`: the skin with its distances, and back."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.files.summaries import checked_file
from cmfsim.io.meshes.mesh_files import read_mesh
from cmfsim.io.meshes.vtk.writing import write_triangles
from cmfsim.io.results.metrics import AGAIN
from cmfsim.values.checks import Floats, as_floats, as_rows, frozen
from cmfsim.values.surface_data import SurfaceData

DISTANCE, EVALUATED = "signed_distance_mm", "evaluated"


@dataclass(frozen=True, eq=False)
class SkinErrors:
    """A predicted skin with its distances from the skin after the operation.

    Attributes
    ----------
    skin : SurfaceData
        As predicted.
    signed : (v,) float64, mm
        Negative where the prediction lies behind; 0 where nothing was evaluated.
    evaluated : (v,) bool
        The vertices that the tables count: those evaluated in every model.
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
    path: str | os.PathLike[str], skin: SurfaceData, vertices: NDArray[Any], signed: Floats
) -> None:
    """Writes a predicted skin with its distances; an old file goes in one step.

    Parameters
    ----------
    path : path
    skin : SurfaceData
        As predicted.
    vertices : (k,) indices
        The vertices that were evaluated.
    signed : (k,) float64, mm
        Their distances.
    """
    count = len(skin.vertices)
    values, evaluated = np.zeros(count), np.zeros(count, dtype=np.uint8)
    values[vertices], evaluated[vertices] = signed, 1
    with replacing(Path(path)) as file:
        arrays: dict[str, NDArray[Any]] = {DISTANCE: values, EVALUATED: evaluated}
        write_triangles(file, skin.vertices, skin.triangles, arrays, frame="LPS")


def read_skin_errors(
    folder: str | os.PathLike[str], evaluation: Mapping[str, Any], model: str
) -> SkinErrors:
    """The errors of a model that an evaluation lists, as they were written.

    Parameters
    ----------
    folder : path
        With the files of the evaluation.
    evaluation : mapping
        `read_evaluation` of the same folder.
    model : str

    Raises
    ------
    FileNotFoundError
        The file is missing.
    CaseError
        (also `ValueError`) It is none of that evaluation, was changed, or holds no distances.
    """
    path = checked_file(Path(folder), evaluation, skin_errors_file(model), AGAIN)
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
