"""The embedded case: a synthetic head with its operation and its true face.

`demo_truth.npz` next to this file holds the face after the operation: `vertices` (v, 3) float, mm,
LPS; `triangles` (t, 3) integer, outward; `landmark_names` (k,) text and `landmarks` (k, 3) float,
mm; and `parameters`, a JSON text whose `head` names the `HeadParameters` that the face belongs to.
`scripts/make_demo_truth.py` computes it, in silico.
"""

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.io import Case, write_image, write_landmarks, write_surface
from cmfsim.io.files.reading_writing import replacing
from cmfsim.lab.virtual.population import PATIENTS
from cmfsim.phantom import PhantomHead, make_head
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats, as_index_rows, as_positive, as_rows
from cmfsim.values.surface_data import SurfaceData

CASE_TEXT = """\
# A synthetic head: no patient. `cmfsim build case.toml` makes its model.
format = "cmfsim-case"
version = 1
name = "phantom"

[image]
file = "ct.nrrd"

[landmarks]
skull = "skull.mrk.json"
skin = "skin.mrk.json"

[[osteotomies]]
procedure = "le_fort_1"

[[osteotomies]]
procedure = "bsso"

[plan.maxilla]                    # 5 mm forwards
translation = [0, -5, 0]

[plan.mandible_body]              # 3 mm backwards
translation = [0, 3, 0]

[mesh]
edge_length = 4.0

[output]
folder = "out"
"""


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
    with replacing(folder / "case.toml") as file:
        file.write(CASE_TEXT.encode())
    return folder / "case.toml"


TRUTH_FILE = "demo_truth.npz"
MEMBERS = ("vertices", "triangles", "landmark_names", "landmarks", "parameters")

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
    "automatically, more accurately than on real heads. The tets are coarse, for speed."
)
IN_SILICO = (
    " The post-operative face is computed as well, by other equations on a finer mesh with "
    "other muscles (in silico). Errors show how the models differ from it, not how accurate they "
    "are on patients."
)
CASE = """\
{mark}
# Change the plan, then run: cmfsim {command} case.toml
format = "cmfsim-case"
version = 1
name = "demo"
note = "{note}"

[surfaces]
skin = "skin.ply"

[surfaces.bones]
cranium = "cranium.ply"
mandible = "mandible.ply"

# No [landmarks]: they are found automatically. To check them: cmfsim landmarks case.toml
[[osteotomies]]
procedure = "le_fort_1"

[[osteotomies]]
procedure = "bsso"

[plan.maxilla]                    # P is backwards: -5 is 5 mm forwards
translation = {maxilla}
angle = {turn}
axis = [1, 0, 0]
centre = {centre}

[plan.mandible_body]
translation = {mandible}

[muscles]
template = "default"
samples = 32

[region]                          # the vault above the forehead does not move
upper = {upper}

[mesh]
edge_length = {edge_length}

{after}[output]
folder = "out"
"""
AFTER = """\
[postoperative]
skin = "after.ply"

"""


@dataclass(frozen=True, eq=False)
class DemoTruth:
    """A face after the operation.

    landmarks: mapping of str to (3,), mm, on the skin.
    """

    skin: SurfaceData
    landmarks: Mapping[str, Floats]


def read_demo_truth(head: Mapping[str, float], path: Path | None = None) -> DemoTruth | None:
    """The face after the operation; None where the package holds none.

    head: Parameters of the head that it must belong to.
    path: Another archive than the package's own.
    Raises `FileNotFoundError`: There is no file at `path`.
    Raises `CaseError`: Not such an archive, or of another head.
    """
    if path is None:
        own = files("cmfsim.lab.virtual").joinpath(TRUTH_FILE)
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


@dataclass(frozen=True, eq=False)
class DemoCase:
    """The embedded case on disk, with the anatomy that its surfaces were made from.

    truth: None where the package holds no face after the operation.
    """

    case: Case
    anatomy: Anatomy
    truth: DemoTruth | None


def write_demo_case(
    folder: str | os.PathLike[str], *, edge_length: float = 6.0, truth: Path | None = None
) -> DemoCase:
    """The embedded case, written as `case.toml` with surfaces, and without any landmark.

    folder: Made if it is not there; empty, or an earlier demo's.
    edge_length: mm, of the tets.
    truth: An archive with the face after the operation, instead of the package's own.
    Raises `CaseError`: A folder with other files in it; an archive of another head; scikit-image is
        missing.
    Raises `OSError`: The folder cannot be made or written to.

    Examples
    --------
    >>> from cmfsim.lab.virtual.demo import write_demo_case
    >>> made = write_demo_case("cmfsim-demo")  # doctest: +SKIP
    >>> prediction = cmfsim.predict(made.case, model="M")  # doctest: +SKIP
    """
    edge_length = as_positive("edge length", edge_length)
    folder = Path(folder)
    _check_folder(folder)
    after = read_demo_truth(asdict(DEMO_PARAMETERS), truth)
    head = make_head(DEMO_PARAMETERS)
    anatomy = head.anatomy(float(np.clip(edge_length / VOXELS_PER_EDGE, *VOXEL_BOUNDS)))
    folder.mkdir(parents=True, exist_ok=True)
    # First, so that a run that stops here leaves a folder that the next one knows.
    with replacing(folder / "case.toml") as file:
        file.write(_case_text(head, edge_length, after).encode())
    options = SurfaceOptions(max_triangles=MOST_TRIANGLES, smoothing=0)
    for name, level in {"skin": anatomy.skin, **anatomy.bones}.items():
        write_surface(folder / f"{name}.ply", surface_of_level(name, level, options))
    if after is not None:
        write_surface(folder / "after.ply", after.skin)
    return DemoCase(Case.load(folder / "case.toml"), anatomy, after)


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


def _case_text(head: PhantomHead, edge_length: float, after: DemoTruth | None) -> str:
    centre = [round(float(x), 3) for x in head.skull_landmarks[MAXILLA.centre]]
    return CASE.format(
        mark=MARK,
        command="predict" if after is None else "evaluate",
        note=NOTE if after is None else NOTE + IN_SILICO,
        maxilla=list(MAXILLA.translation),
        turn=MAXILLA.angle,
        centre=centre,
        mandible=list(MANDIBLE.translation),
        upper=TISSUE_TOP,
        edge_length=edge_length,
        after="" if after is None else AFTER,
    )
