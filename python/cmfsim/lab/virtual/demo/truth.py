"""The face of the embedded case after its operation, as the package holds it.

`truth.npz` next to this file contains `vertices` (v, 3) float, mm, LPS; `triangles` (t, 3) integer,
outward; `landmark_names` (k,) text and `landmarks` (k, 3) float, mm; and `parameters`, a JSON text
whose `head` names the `HeadParameters` that the face belongs to. `scripts/make_demo_truth.py`
computes it, in silico.
"""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import Floats, as_index_rows, as_rows
from cmfsim.values.surface_data import SurfaceData

TRUTH_FILE = "truth.npz"
MEMBERS = ("vertices", "triangles", "landmark_names", "landmarks", "parameters")


@dataclass(frozen=True, eq=False)
class DemoTruth:
    """A face after the operation.

    Attributes
    ----------
    skin : SurfaceData
    landmarks : mapping of str to (3,) float64, mm
        On the skin.
    """

    skin: SurfaceData
    landmarks: Mapping[str, Floats]


def read_demo_truth(head: Mapping[str, float], path: Path | None = None) -> DemoTruth | None:
    """The face after the operation; None where the package holds none.

    Parameters
    ----------
    head : mapping of str to float
        Parameters of the head that it must belong to.
    path : Path, optional
        Another archive than the package's own.

    Raises
    ------
    FileNotFoundError
        There is no file at `path`.
    CaseError
        (also `ValueError`) Not such an archive, or of another head.
    """
    if path is None:
        own = files("cmfsim.lab.virtual.demo").joinpath(TRUTH_FILE)
        if not own.is_file():
            return None
        path = Path(str(own))
    try:
        with np.load(path, allow_pickle=False) as archive:
            members = {name: archive[name] for name in MEMBERS if name in archive.files}
    except (zipfile.BadZipFile, ValueError, EOFError) as error:
        raise CaseInputError(f"{path}: is not an archive of arrays ({error})") from error
    missing = [name for name in MEMBERS if name not in members]
    if missing:
        raise CaseInputError(f"{path}: lacks {', '.join(missing)}")
    _check_head(path, str(members["parameters"]), head)
    vertices = as_rows(f"{path.name}: vertices", members["vertices"], 3)
    triangles = as_index_rows(
        f"{path.name}: triangles", members["triangles"], 3, len(vertices), "vertices"
    )
    places = as_rows(f"{path.name}: landmarks", members["landmarks"], 3)
    names = [str(name) for name in members["landmark_names"]]
    if len(names) != len(places):
        raise CaseInputError(f"{path}: has {len(places)} landmarks, but {len(names)} names")
    return DemoTruth(SurfaceData(vertices, triangles), dict(zip(names, places, strict=True)))


def _check_head(path: Path, text: str, head: Mapping[str, float]) -> None:
    """Refuses the face of another person."""
    try:
        given = json.loads(text)["head"]
        same = {name: float(value) for name, value in given.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CaseInputError(f"{path}: parameters do not describe a head ({error})") from error
    for name, value in head.items():
        if same.get(name) != float(value):
            raise CaseInputError(
                f"{path}: is the face of another head: {name} is {same.get(name)}, not {value:g}; "
                "create it again (scripts/make_demo_truth.py)"
            )
