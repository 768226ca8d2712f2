"""Relocations in files: ITK's text transforms (`.tfm`) and 4 × 4 matrices, read and written."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.checks import Floats, as_floats, check_one_of
from cmfsim.errors import CaseInputError
from cmfsim.io.files import MAX_TEXT, named, replacing
from cmfsim.planning import decompose_motion

__all__ = ["read_transform", "write_transform"]

MATRIX_SUFFIXES = (".txt", ".mat")
# ITK's HDF5 and MATLAB 4 files.
BINARY_SUFFIXES = (".h5", ".hdf5", ".hdf")
ITK_HEADER = "#Insight Transform File"
FRAMES = ("LPS", "RAS")
# Turns RAS coordinates into LPS and back.
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])


def read_transform(
    path: str | os.PathLike[str], *, frame: str = "LPS", inverse: bool = False
) -> Floats:
    """The rigid motion in a transform file, as a matrix in LPS.

    Parameters
    ----------
    path : path
        `.tfm` (ITK text: Euler3DTransform, VersorRigid3DTransform, VersorTransform,
        TranslationTransform, AffineTransform, MatrixOffsetTransformBase or Rigid3DTransform, with
        their centre), or `.txt` or `.mat` with a 4 × 4 matrix in text.
    frame : str
        "LPS" or "RAS": the coordinates that a 4 × 4 matrix is meant in. ITK files are LPS.
    inverse : bool
        Return the inverse of what the file holds.

    Returns
    -------
    (4, 4) float64, mm
        x ↦ R x + t on LPS points.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a transform, another kind of it, a wrong count of numbers (with the
        line), scale or shear.

    Notes
    -----
    ITK's transforms carry points of the *fixed* (output) image to the *moving* (input) one, which
    is what resampling needs. Register post-operative bone (moving) to pre-operative bone (fixed)
    and the file is the relocation itself. 3D Slicer writes the transform that moves an object as
    its inverse, "from parent": read such a file with `inverse=True`.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.read_transform("maxilla.tfm", inverse=True)  # doctest: +SKIP
    """
    path = Path(path)
    check_one_of("frame", frame, FRAMES)
    if path.suffix.lower() in BINARY_SUFFIXES:
        raise CaseInputError(
            f"{path.name}: HDF5 transforms are not read: save the transform as .tfm (ITK text)"
        )
    if path.suffix.lower() not in (".tfm", *MATRIX_SUFFIXES):
        raise CaseInputError(
            f"{path.name}: a transform is read from .tfm, .txt or .mat, not {path.suffix!r}"
        )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with named(path):
        text = _text(path)
        if text.startswith(ITK_HEADER):
            if frame != "LPS":
                raise CaseInputError("is an ITK transform, which is LPS always: drop frame")
            matrix = _itk(text)
        elif path.suffix.lower() == ".tfm":
            raise CaseInputError(f"line 1: an ITK transform begins with {ITK_HEADER!r}")
        else:
            matrix = _four_by_four(text)
            if frame == "RAS":
                matrix = FLIP @ matrix @ FLIP
        decompose_motion(matrix)
        return _inverse(matrix) if inverse else matrix


def write_transform(
    path: str | os.PathLike[str], matrix: ArrayLike, *, frame: str = "LPS", inverse: bool = False
) -> None:
    """Writes a rigid motion as ITK text (`.tfm`) or as a 4 × 4 matrix (`.txt`).

    Parameters
    ----------
    path : path
        Replaced when all is written.
    matrix : (4, 4) float64, mm
        A rigid motion of LPS points.
    frame : str
        "LPS" or "RAS": the coordinates in which a `.txt` is written.
    inverse : bool
        Write the inverse, as 3D Slicer does for the motion of an object.

    Raises
    ------
    CaseError
        (also `ValueError`) Another ending, RAS in a `.tfm`.
    BoundaryError
        (also `ValueError`) Not a rigid motion.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.rigid_motion((0, -5, 0))
    >>> cmfsim.write_transform("maxilla.tfm", motion)  # doctest: +SKIP
    """
    path = Path(path)
    check_one_of("frame", frame, FRAMES)
    m = as_floats("matrix", matrix)
    decompose_motion(m)
    if inverse:
        m = _inverse(m)
    if path.suffix.lower() == ".tfm":
        if frame != "LPS":
            raise CaseInputError(f"{path.name}: ITK transforms are LPS always: drop frame")
        lines: tuple[str, ...] = (
            f"{ITK_HEADER} V1.0",
            "#Transform 0",
            "Transform: AffineTransform_double_3_3",
            f"Parameters: {_numbers(np.concatenate([m[:3, :3].ravel(), m[:3, 3]]))}",
            "FixedParameters: 0 0 0",
        )
    elif path.suffix.lower() == ".txt":
        if frame == "RAS":
            m = FLIP @ m @ FLIP
        lines = (f"# 4 x 4, mm, {frame}", *(_numbers(row) for row in m))
    else:
        raise CaseInputError(
            f"{path.name}: a transform is written as .tfm or .txt, not {path.suffix!r}"
        )
    with replacing(path) as file:
        file.write(("\n".join(lines) + "\n").encode())


def _text(path: Path) -> str:
    if path.stat().st_size > MAX_TEXT:
        raise CaseInputError(f"is larger than {MAX_TEXT} bytes")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CaseInputError(
            "is not text (a MATLAB or HDF5 file?): save the transform as .tfm (ITK text)"
        ) from error
    if "\0" in text:
        raise CaseInputError("is not text: save the transform as .tfm (ITK text)")
    return text


def _itk(text: str) -> Floats:
    """The matrix of the only transform in an ITK text file."""
    kind, kind_line = "", 0
    found: dict[str, tuple[int, Floats]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        name, colon, value = line.partition(":")
        if not line.strip() or line.startswith("#"):
            continue
        if not colon:
            raise CaseInputError(f"line {number}: {line.strip()[:60]!r} is not 'name: value'")
        name = name.strip()
        if name == "Transform":
            if kind:
                raise CaseInputError(
                    f"line {number}: holds a second transform: save one transform per segment"
                )
            kind, kind_line = value.strip(), number
        elif name in {"Parameters", "FixedParameters"}:
            if name in found:
                raise CaseInputError(f"line {number}: {name} again")
            found[name] = number, _floats(value, number)
        else:
            raise CaseInputError(f"line {number}: unknown entry {name[:60]!r}")
    if not kind:
        raise CaseInputError("holds no line 'Transform: ...'")
    base = kind.removesuffix("_3_3").removesuffix("_double").removesuffix("_float")
    if base == kind or base not in ITK_KINDS:
        known = ", ".join(ITK_KINDS)
        raise CaseInputError(
            f"line {kind_line}: {kind[:60]!r} is no rigid transform of 3-D space that is read: "
            f"use one of {known}, with _double_3_3"
        )
    counts, rotation = ITK_KINDS[base]
    if "Parameters" not in found:
        raise CaseInputError("holds no line 'Parameters: ...'")
    parameters_line, parameters = found["Parameters"]
    if len(parameters) != counts:
        raise CaseInputError(
            f"line {parameters_line}: Parameters holds {len(parameters)} numbers: "
            f"{base} needs {counts}"
        )
    fixed_line, fixed = found.get("FixedParameters", (parameters_line, np.zeros(0)))
    # Older files have no centre; Euler3DTransform has a fourth number, the order of its turns.
    allowed = (0, 3, 4) if base == "Euler3DTransform" else (0, 3)
    if len(fixed) not in allowed:
        raise CaseInputError(
            f"line {fixed_line}: FixedParameters holds {len(fixed)} numbers: the centre, "
            f"{' or '.join(str(n) for n in allowed)}, is needed"
        )
    centre = fixed[:3] if len(fixed) else np.zeros(3)
    try:
        turn = rotation(parameters, fixed)
    except CaseInputError as error:
        raise CaseInputError(f"line {parameters_line}: {error}") from error
    # x ↦ R (x − c) + c + t; a VersorTransform has no t.
    shift = parameters[-3:] if base != "VersorTransform" else np.zeros(3)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = shift + centre - turn @ centre
    return matrix


def _four_by_four(text: str) -> Floats:
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.partition("#")[0].strip()
        if not content:
            continue
        row = _floats(content.replace(",", " "), number)
        if len(row) != 4:
            raise CaseInputError(f"line {number}: holds {len(row)} numbers: a 4 × 4 matrix needs 4")
        rows.append(row)
    if len(rows) != 4:
        raise CaseInputError(f"holds {len(rows)} rows of numbers: a 4 × 4 matrix is needed")
    return np.array(rows)


def _floats(text: str, line: int) -> Floats:
    values = []
    for word in text.split():
        try:
            value = float(word)
        except ValueError as error:
            raise CaseInputError(f"line {line}: {word[:60]!r} is not a number") from error
        if not np.isfinite(value):
            raise CaseInputError(f"line {line}: {word[:60]!r} is not finite")
        values.append(value)
    return np.array(values, dtype=np.float64)


def _numbers(values: NDArray[np.float64]) -> str:
    # repr of a float64 is the shortest text that reads back as the same number.
    return " ".join(repr(float(v)) for v in values)


def _inverse(matrix: Floats) -> Floats:
    """The inverse of a rigid motion, its rotation transposed."""
    back = np.eye(4)
    back[:3, :3] = matrix[:3, :3].T
    back[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return back


def _euler(parameters: Floats, fixed: Floats) -> Floats:
    """Rz Rx Ry, or Rz Ry Rx where the file's fourth fixed number says so; angles in radians."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(parameters[:3]), np.cos(parameters[:3])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    ry = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    rz = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    zyx = len(fixed) == 4 and fixed[3] != 0.0
    turn: Floats = rz @ ry @ rx if zyx else rz @ rx @ ry
    return turn


def _versor(parameters: Floats, fixed: Floats) -> Floats:
    """The rotation of the unit quaternion with vector part v and real part √(1 − |v|²)."""
    del fixed
    v = parameters[:3]
    square = float(v @ v)
    if square > 1.0 + 1e-9:
        raise CaseInputError(f"the versor has length {np.sqrt(square):.6g}: 0 to 1 is needed")
    w = float(np.sqrt(max(0.0, 1.0 - square)))
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    turn: Floats = np.eye(3) + 2.0 * w * cross + 2.0 * (cross @ cross)
    return turn


def _matrix(parameters: Floats, fixed: Floats) -> Floats:
    del fixed
    return parameters[:9].reshape(3, 3)


def _no_turn(parameters: Floats, fixed: Floats) -> Floats:
    del parameters, fixed
    return np.eye(3)


# Count of parameters and the rotation that they mean.
ITK_KINDS: Mapping[str, tuple[int, Callable[[Floats, Floats], Floats]]] = MappingProxyType(
    {
        "Euler3DTransform": (6, _euler),
        "VersorRigid3DTransform": (6, _versor),
        "VersorTransform": (3, _versor),
        "TranslationTransform": (3, _no_turn),
        "AffineTransform": (12, _matrix),
        "MatrixOffsetTransformBase": (12, _matrix),
        "Rigid3DTransform": (12, _matrix),
    }
)
