"""A case of cmfsim from what was chosen in Slicer: files in a folder, and their case.toml.

Files are those that Slicer saved (LPS mm, which their headers state); matrices are Slicer's own,
RAS mm. Everything that the case holds was chosen by a person, so that nothing has to be guessed.
"""

import json
import shutil
import zipfile
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

# Segments that a procedure of cmfsim cuts from a CT, and the procedure.
PROCEDURES = {
    "maxilla": "le_fort_1",
    "midface": "le_fort_3",
    "mandible_body": "bsso",
    "ramus_left": "bsso",
    "ramus_right": "bsso",
    "chin": "genioplasty",
}
# What a bone may be: these keys have a meaning to cmfsim (teeth, reference points, joints).
BONES = ("cranium", "mandible", *PROCEDURES)
MODELS = ("H", "M", "H+S", "M+S")
FACE = "Data/face_predicted.vtp"
IDENTITY = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))


@dataclass
class Segment:
    """A bone: its name in the case, its file, and where its transform carries it.

    `matrix_ras` is the transform from where the bone is before the operation to where it goes, row
    by row, as Slicer has it; None for a bone that stays.
    """

    name: str
    file: Path | None = None
    matrix_ras: tuple | None = None


@dataclass
class Choice:
    """The choice in the module: a CT, or a skin with bones; landmarks; how to solve.

    `is_preview`: every segment that is named is cut, whether or not it moves.
    """

    volume: Path | None = None
    skin: Path | None = None
    segments: list = field(default_factory=list)
    skull_landmarks: Path | None = None
    skin_landmarks: Path | None = None
    edge_length: float = 6.0
    model: str = "M+S"
    is_preview: bool = False


class ChoiceError(ValueError):
    """What is missing, as a sentence for the user of the module."""


def check(choice):
    """Raises ChoiceError for a choice that does not define a case."""
    names = [segment.name for segment in choice.segments]
    for name in names:
        if not name or not all(c.isalnum() or c in "_-+" for c in name):
            raise ChoiceError(
                f"{name!r} is not a valid bone name: use letters, digits, '_', '-' and '+'."
            )
        if names.count(name) > 1:
            raise ChoiceError(f"Two bones are called {name}: each needs its own name.")
    if choice.model not in MODELS:
        raise ChoiceError(f"The model must be one of {', '.join(MODELS)}.")
    if choice.volume is not None:
        unknown = [name for name in names if name not in BONES]
        if unknown:
            raise ChoiceError(
                f"{unknown[0]} cannot be cut from a CT: use one of {', '.join(BONES)}, or choose "
                "models of skin and bones instead of the volume."
            )
    elif choice.skin is None:
        raise ChoiceError("Choose a CT volume, or a model of the skin with models of the bones.")
    elif not any(segment.file for segment in choice.segments):
        raise ChoiceError("Choose at least one model of a bone, such as the cranium.")
    if not choice.is_preview and not any(is_moved(segment) for segment in choice.segments):
        raise ChoiceError("No segment moves: apply a linear transform to at least one.")


def is_moved(segment):
    """Whether a segment's transform is not the identity."""
    matrix = segment.matrix_ras
    if matrix is None:
        return False
    pairs = zip(matrix, IDENTITY, strict=True)
    return any(abs(a - b) > 1e-9 for row, other in pairs for a, b in zip(row, other, strict=True))


def case_text(choice):
    """The case.toml of a choice."""
    check(choice)
    lines = [
        "# Written by the CmfSim module of 3D Slicer.",
        'format = "cmfsim-case"',
        "version = 1",
    ]
    if choice.volume is not None:
        lines += ["", "[image]", f"file = {json.dumps(choice.volume.name)}"]
        needed = [
            PROCEDURES.get(s.name) for s in choice.segments if choice.is_preview or is_moved(s)
        ]
        for procedure in dict.fromkeys(p for p in needed if p):
            lines += ["", "[[osteotomies]]", f'procedure = "{procedure}"']
    else:
        lines += [
            "",
            "[surfaces]",
            f"skin = {json.dumps(choice.skin.name)}",
            "",
            "[surfaces.bones]",
        ]
        lines += [f"{s.name} = {json.dumps(s.file.name)}" for s in choice.segments if s.file]
    marks = {"skull": choice.skull_landmarks, "skin": choice.skin_landmarks}
    if any(marks.values()):
        lines += ["", "[landmarks]"]
        lines += [f"{key} = {json.dumps(path.name)}" for key, path in marks.items() if path]
    for segment in choice.segments:
        if is_moved(segment):
            rows = [f"  [{', '.join(repr(float(v)) for v in row)}]," for row in segment.matrix_ras]
            lines += ["", f"[plan.{segment.name}]", 'frame = "RAS"', "matrix = [", *rows, "]"]
    lines += ["", "[mesh]", f"edge_length = {choice.edge_length:g}"]
    if choice.model.startswith("M"):
        lines += ["", "[muscles]"]
    return "\n".join([*lines, "", "[output]", 'folder = "out"', ""])


def write_case(folder, choice):
    """The path of the case.toml that was written into the folder where Slicer saved the files."""
    path = Path(folder) / "case.toml"
    path.write_text(case_text(choice), encoding="utf-8")
    return path


def face_of(bundle, folder):
    """The path of the predicted face, extracted from a bundle that cmfsim wrote."""
    target = Path(folder) / PurePosixPath(FACE).name
    with zipfile.ZipFile(bundle) as archive:
        names = [name for name in archive.namelist() if name.endswith(FACE)]
        if len(names) != 1:
            raise ChoiceError(f"{bundle} holds {len(names)} predicted faces: one is needed.")
        with archive.open(names[0]) as source, target.open("wb") as file:
            shutil.copyfileobj(source, file)
    return target
