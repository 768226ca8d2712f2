"""The embedded case: a synthetic head with its operation and its true face.

`demo_truth.npz` next to this file holds the face after the operation: `vertices` (v, 3) float, mm,
LPS; `triangles` (t, 3) integer, outward; `landmark_names` (k,) text and `landmarks` (k, 3) float,
mm; and `parameters`, a JSON text whose `head` names the `HeadParameters` that the face belongs to.
`scripts/make_demo_truth.py` computes it, in silico.
"""

import os
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.io import Case, write_image, write_landmarks, write_surface
from cmfsim.io.files.reading_writing import replace_text
from cmfsim.lab.virtual.population import PATIENTS, template_text
from cmfsim.phantom.model import PhantomHead, make_head
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import as_positive
from cmfsim.values.surface_data import SurfaceData


def write_phantom_case(
    folder: str | os.PathLike[str], head: PhantomHead, *, spacing: float = 1.0, seed: int = 0
) -> Path:
    """The path of a new `case.toml` next to the CT and the landmarks of a synthetic head.

    Parameters
    ----------
    folder : path
        Created if it does not exist.
    head : PhantomHead
    spacing : float, mm
        Of the CT.
    seed : int
        Of its noise.

    Raises
    ------
    OSError
        The folder cannot be created or written to.

    Examples
    --------
    >>> import cmfsim
    >>> case = cmfsim.write_phantom_case("head", cmfsim.make_head())  # doctest: +SKIP
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_image(head.ct((spacing, spacing, spacing), seed=seed), folder / "ct.nrrd")
    write_landmarks(folder / "skull.mrk.json", head.skull_landmarks)
    write_landmarks(folder / "skin.mrk.json", head.skin_landmarks)
    replace_text(folder / "case.toml", template_text("phantom"))
    return folder / "case.toml"


TRUTH_FILE = "demo_truth.npz"

# A mandible that is long and a chin that is strong next to the average synthetic head (3 and 2 mm).
DEMO_PATIENT = PATIENTS[1]
DEMO_PARAMETERS = DEMO_PATIENT.parameters
# Le Fort I: forwards and up, and turned about the transverse axis through a landmark. Sagittal
# split: the mandible back and up with the maxilla.
MAXILLA, MANDIBLE = DEMO_PATIENT.plan["maxilla"], DEMO_PATIENT.plan["mandible_body"]
# Height up to which there is tissue, mm: the scalp above takes two fifths of the tets and stays.
TISSUE_TOP = 75.0
# The head's voxels, in edges of the tets, and their bounds, mm: finer ones cost time and change
# nothing, on coarser ones teeth and lips melt.
VOXELS_PER_EDGE = 4.0
VOXEL_BOUNDS = (1.5, 3.0)
# More triangles than a head's surface has at the finest voxels: nothing is decimated.
MOST_TRIANGLES = 1_000_000

MARK = "# cmfsim demo: written by this command, and overwritten by it."
NOTE = (
    "Not a patient, but a synthetic head (long mandible, strong chin). The plan shows how lips and "
    "chin follow the jaws; it is not one to operate by: the overjet grows from 2 to 10 mm. "
    "Skin, bones and airway are computed from the formulas that define the head, so nothing was "
    "scanned or segmented (cmfsim phantom writes a head with its CT). Landmarks are found "
    "automatically, more accurately than on real heads. The tets are coarse, for speed. "
    "The post-operative face is computed as well, by other equations on a finer mesh with "
    "other muscles (in silico). Errors show how the models differ from it, not how accurate they "
    "are on patients."
)


def read_demo_truth() -> SurfaceData:
    """The face after the operation, of the head of `DEMO_PARAMETERS`."""
    with (
        files("cmfsim.lab.virtual").joinpath(TRUTH_FILE).open("rb") as file,
        np.load(file, allow_pickle=False) as archive,
    ):
        return SurfaceData(archive["vertices"], archive["triangles"])


@dataclass(frozen=True, eq=False)
class DemoCase:
    """The embedded case on disk, with the anatomy that its surfaces were made from."""

    case: Case
    anatomy: Anatomy


def write_demo_case(folder: str | os.PathLike[str], *, edge_length: float = 6.0) -> DemoCase:
    """The embedded case, written as `case.toml` with surfaces, and without any landmark.

    The folder is made, empty, or an earlier demo's; edges of the tets in mm.
    """
    edge_length = as_positive("edge length", edge_length)
    folder = Path(folder)
    _check_folder(folder)
    head = make_head(DEMO_PARAMETERS)
    anatomy = head.anatomy(float(np.clip(edge_length / VOXELS_PER_EDGE, *VOXEL_BOUNDS)))
    folder.mkdir(parents=True, exist_ok=True)
    # First, so that a run that stops here leaves a folder that the next one knows.
    replace_text(folder / "case.toml", _case_text(head, edge_length))
    options = SurfaceOptions(max_triangles=MOST_TRIANGLES, smoothing=0)
    for name, level in {"skin": anatomy.skin, **anatomy.bones}.items():
        write_surface(folder / f"{name}.ply", surface_of_level(name, level, options))
    write_surface(folder / "after.ply", read_demo_truth())
    return DemoCase(Case.load(folder / "case.toml"), anatomy)


def _check_folder(folder: Path) -> None:
    """Refuses a folder that holds what the demo did not write."""
    if folder.exists() and not folder.is_dir():
        raise CaseInputError(f"{folder}: is a file; choose a folder for the demo")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    case = folder / "case.toml"
    if not case.is_file() or not case.read_bytes().startswith(MARK.encode()):
        raise CaseInputError(
            f"{folder}: contains files that are not the demo's; choose a new or empty folder"
        )


def _case_text(head: PhantomHead, edge_length: float) -> str:
    centre = [round(float(x), 3) for x in head.skull_landmarks[MAXILLA.centre]]
    return template_text("demo").format(
        mark=MARK,
        note=NOTE,
        maxilla=list(MAXILLA.translation),
        turn=MAXILLA.angle,
        centre=centre,
        mandible=list(MANDIBLE.translation),
        upper=TISSUE_TOP,
        edge_length=edge_length,
    )
