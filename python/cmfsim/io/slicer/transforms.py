"""Files of relocations: ITK transforms (`.tfm`, `.h5`) and 4 × 4 matrices, read and written.

A transform file does not record whether it moves the bone to its new position or back from it, so
the caller or the case file states the direction (docs/formats.md).
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import MAX_TEXT, check_readable, named, replace_text
from cmfsim.io.slicer.itk_hdf5 import read_itk_hdf5
from cmfsim.values.case_parts import DIRECTIONS, FRAMES
from cmfsim.values.checks import AnyPath, Floats, as_floats, check_one_of
from cmfsim.values.motion import rigid_matrix

MATRIX_SUFFIXES = (".txt", ".mat")
HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf")
ITK_HEADER = "#Insight Transform File"
COMPOSITE = "CompositeTransform"
# How a matrix is read if neither the caller nor the file states it: as a motion typed by hand.
DEFAULT_DIRECTION, DEFAULT_FRAME = "to-parent", "LPS"
# Turns RAS coordinates into LPS and back.
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
# The choice of directions, as part of an error message.
DIRECTION_CHOICE = (
    'direction = "from-parent" if the transform maps the moved bone back to its old position, '
    "as in a file that 3D Slicer saved for a transform applied to the bone; direction = "
    '"to-parent" if it maps the bone to its new position, as when ITK registers the bone '
    "after (moving image) to the bone before (fixed image)"
)
ITK_IS_LPS = "is an ITK transform, which is always LPS: remove frame"
# The comment in which `write_transform` records frame and direction.
STATED = re.compile(r"^#.*\bmm, (LPS|RAS)(?:, (to-parent|from-parent))?\s*$")


@dataclass(frozen=True, eq=False)
class TransformFile:
    """The motion in a transform file, and how the file was interpreted.

    matrix: (4, 4), mm. The motion of the bone: x ↦ R x + t on LPS points.
    direction, frame: "to-parent" or "from-parent", and "LPS" or "RAS".
    assumed: Which of both neither the caller nor the file stated.
    """

    matrix: Floats
    direction: str
    frame: str
    assumed: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """How the file was interpreted, in words."""
        assumed = f" ({' and '.join(self.assumed)} assumed)" if self.assumed else ""
        return f"{self.direction}, {self.frame}{assumed}"


def is_itk_file(path: AnyPath) -> bool:
    """Whether a file's suffix marks it as an ITK transform; `.txt` and `.mat` may hold one too."""
    return Path(path).suffix.lower() in (".tfm", *HDF5_SUFFIXES)


def motion_in_lps(matrix: Floats, frame: str) -> Floats:
    """A motion of points in a frame, "LPS" or "RAS", as the same motion of LPS points, (4, 4)."""
    return FLIP @ matrix @ FLIP if frame == "RAS" else matrix


def read_transform(
    path: AnyPath, *, direction: str | None = None, frame: str | None = None
) -> Floats:
    """The motion of the bone in a transform file, as a matrix in LPS.

    Parameters
    ----------
    path : path
        `.tfm` (ITK text) or `.h5` (ITK HDF5, read by SimpleITK): Euler3DTransform,
        VersorRigid3DTransform, VersorTransform, TranslationTransform, AffineTransform,
        MatrixOffsetTransformBase or Rigid3DTransform with their centre, or a CompositeTransform of
        one of them; or `.txt` or `.mat` with a 4 × 4 matrix in text.
    direction : str
        "to-parent": the file moves the bone from its present to its new position, so it is the
        motion itself. "from-parent": it moves the relocated bone back, and is inverted. Required
        for ITK files; a 4 × 4 matrix is "to-parent" by default.
    frame : str
        "LPS" or "RAS": the coordinates of a 4 × 4 matrix, LPS by default. ITK files are always LPS.

    Returns
    -------
    (4, 4) float64, mm
        x ↦ R x + t on LPS points.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) No direction for an ITK file; a direction or frame that contradicts the
        file's own comment; not a transform, several transforms, an unsupported kind, a wrong count
        of numbers (with the line), scale or shear.

    Notes
    -----
    ITK's transforms carry points of the *fixed* (output) image to the *moving* (input) one, which
    is what resampling needs. Register post-operative bone (moving) to pre-operative bone (fixed)
    and the file is the motion: "to-parent". 3D Slicer saves the transform that moves an object in
    the same convention, hence as its inverse: "from-parent"
    (https://slicer.readthedocs.io/en/latest/developer_guide/modules/transforms.html).

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.read_transform(
    ...     "maxilla.tfm", direction="from-parent"
    ... )
    """
    return read_transform_file(path, direction=direction, frame=frame).matrix


def read_transform_file(
    path: AnyPath, *, direction: str | None = None, frame: str | None = None
) -> TransformFile:
    """The motion in a transform file, and how it was interpreted; as `read_transform` otherwise."""
    path = Path(path)
    if direction is not None:
        check_one_of("direction", direction, DIRECTIONS)
    if frame is not None:
        check_one_of("frame", frame, FRAMES)
    suffix = path.suffix.lower()
    if suffix not in (".tfm", *MATRIX_SUFFIXES, *HDF5_SUFFIXES):
        raise CaseInputError(
            f"{path.name}: a transform is read from .tfm, .h5, .txt or .mat, not {path.suffix!r}"
        )
    check_readable(path)
    with named(path):
        stated: tuple[str | None, str | None] = (None, None)
        if suffix in HDF5_SUFFIXES:
            is_itk, matrix = True, _matrix_of(read_itk_hdf5(path))
        else:
            text = _text(path)
            is_itk, stated = text.startswith(ITK_HEADER), _stated(text)
            if is_itk:
                matrix = _itk(text)
            elif suffix == ".tfm":
                raise CaseInputError(f"line 1: an ITK transform begins with {ITK_HEADER!r}")
            else:
                matrix = _four_by_four(text)
        return _understood(matrix, (direction, frame), stated, is_itk=is_itk)


def _understood(
    matrix: Floats,
    given: tuple[str | None, str | None],
    stated: tuple[str | None, str | None],
    *,
    is_itk: bool,
) -> TransformFile:
    """The matrix as a motion in LPS, as the caller and the file's own comment state it."""
    for name, mine, its in zip(("direction", "frame"), given, stated, strict=True):
        if mine is not None and its is not None and mine != its:
            raise CaseInputError(f"states {name} {its} in its comment, not {mine}")
    direction, frame = given[0] or stated[0], given[1] or stated[1]
    if is_itk:
        if frame == "RAS":
            raise CaseInputError(ITK_IS_LPS)
        if direction is None:
            raise CaseInputError(
                f"is an ITK transform, and does not record its direction: state {DIRECTION_CHOICE}"
            )
        frame = "LPS"
    matrix = rigid_matrix(matrix)
    both = {"direction": direction, "frame": frame}
    assumed = tuple(name for name, value in both.items() if value is None)
    direction, frame = direction or DEFAULT_DIRECTION, frame or DEFAULT_FRAME
    matrix = motion_in_lps(matrix, frame)
    if direction == "from-parent":
        matrix = _inverse(matrix)
    return TransformFile(matrix, direction, frame, assumed)


def write_transform(
    path: AnyPath, matrix: ArrayLike, *, direction: str | None = None, frame: str = "LPS"
) -> None:
    """Writes a rigid motion as ITK text (`.tfm`) or as a 4 × 4 matrix (`.txt`).

    A comment in the file states direction and frame; other programs skip it.

    Parameters
    ----------
    path : path
        An existing file is replaced once the new one is complete.
    matrix : (4, 4) float64, mm
        A rigid motion of LPS points.
    direction : str
        "to-parent" writes the motion itself, "from-parent" its inverse, which 3D Slicer displays as
        the motion. Required for `.tfm`; a `.txt` is "to-parent" by default.
    frame : str
        "LPS" or "RAS": the coordinates of a `.txt`.

    Raises
    ------
    CaseError
        (also `ValueError`) Another suffix; RAS or no direction for a `.tfm`.
    BoundaryError
        (also `ValueError`) Not a rigid motion.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.rigid_motion((0, -5, 0))
    >>> cmfsim.write_transform("a.tfm", motion, direction="from-parent")
    """
    path = Path(path)
    check_one_of("frame", frame, FRAMES)
    if direction is not None:
        check_one_of("direction", direction, DIRECTIONS)
    m = rigid_matrix(as_floats("matrix", matrix))
    if path.suffix.lower() == ".tfm":
        if frame != "LPS":
            raise CaseInputError(f"{path.name}: {ITK_IS_LPS}")
        if direction is None:
            raise CaseInputError(
                f'{path.name}: give direction = "from-parent" for 3D Slicer, which shows the '
                'inverse of the file as the motion, or "to-parent" to write the motion itself'
            )
        text = transform_text(m, direction=direction)
    elif path.suffix.lower() == ".txt":
        m = motion_in_lps(_inverse(m) if direction == "from-parent" else m, frame)
        header = f"# 4 x 4, mm, {frame}, {direction or DEFAULT_DIRECTION}"
        text = "\n".join((header, *(_numbers(row) for row in m))) + "\n"
    else:
        raise CaseInputError(
            f"{path.name}: a transform is written as .tfm or .txt, not {path.suffix!r}"
        )
    replace_text(path, text)


def transform_text(matrix: Floats, *, direction: str) -> str:
    """A rigid motion of LPS points as ITK text, (4, 4), or its inverse for "from-parent"."""
    m = _inverse(matrix) if direction == "from-parent" else matrix
    lines = (
        f"{ITK_HEADER} V1.0",
        f"# mm, LPS, {direction}",
        "#Transform 0",
        "Transform: AffineTransform_double_3_3",
        f"Parameters: {_numbers(np.concatenate([m[:3, :3].ravel(), m[:3, 3]]))}",
        "FixedParameters: 0 0 0",
    )
    return "\n".join(lines) + "\n"


def _stated(text: str) -> tuple[str | None, str | None]:
    """Direction and frame that a comment of `write_transform` states."""
    for line in text.splitlines():
        found = STATED.match(line)
        if found:
            return found[2], found[1]
    return None, None


def _text(path: Path) -> str:
    if path.stat().st_size > MAX_TEXT:
        raise CaseInputError(f"is larger than {MAX_TEXT} bytes")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CaseInputError(
            "is not text (a MATLAB file?): save the transform as .tfm (ITK text)"
        ) from error
    if "\0" in text:
        raise CaseInputError("is not text: save the transform as .tfm (ITK text)")
    return text


@dataclass(frozen=True, eq=False)
class _Found:
    """One transform of a file: its ITK class without precision and dimension, and its numbers."""

    kind: str
    parameters: Floats
    fixed: Floats
    # Prefix of an error message about each entry: its line in a text file.
    where: Mapping[str, str]


def _itk(text: str) -> Floats:
    """The matrix of the only transform in an ITK text file."""
    blocks: list[dict[str, tuple[int, str]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        name, colon, value = line.partition(":")
        if not line.strip() or line.startswith("#"):
            continue
        if not colon:
            raise CaseInputError(f"line {number}: {line.strip()[:60]!r} is not 'name: value'")
        name = name.strip()
        if name == "Transform":
            blocks.append({name: (number, value.strip())})
        elif name not in {"Parameters", "FixedParameters"}:
            raise CaseInputError(f"line {number}: unknown entry {name[:60]!r}")
        elif not blocks:
            raise CaseInputError(f"line {number}: {name} comes before 'Transform: ...'")
        elif name in blocks[-1]:
            raise CaseInputError(f"line {number}: {name} again")
        else:
            blocks[-1][name] = number, value
    if not blocks:
        raise CaseInputError("holds no line 'Transform: ...'")
    return _matrix_of([_found(block) for block in blocks])


def _found(block: Mapping[str, tuple[int, str]]) -> _Found:
    line, kind = block["Transform"]
    base = kind.removesuffix("_3_3").removesuffix("_double").removesuffix("_float")
    where = {name: f"line {number}: " for name, (number, _) in block.items()}
    where = {"Parameters": where["Transform"], "FixedParameters": where["Transform"], **where}
    if base == kind or (base not in ITK_KINDS and base != COMPOSITE):
        raise _unknown_kind(where["Transform"], kind)
    if base != COMPOSITE and "Parameters" not in block:
        raise CaseInputError(f"line {line}: {base} lacks its line 'Parameters: ...'")
    numbers = {name: _floats(*block[name][::-1]) for name in block if name != "Transform"}
    # Older files have no centre.
    own, fixed = (numbers.get(name, np.zeros(0)) for name in ("Parameters", "FixedParameters"))
    return _Found(base, own, fixed, where)


def _unknown_kind(where: str, kind: str) -> CaseInputError:
    known = ", ".join(ITK_KINDS)
    return CaseInputError(
        f"{where}{kind[:60]!r} is not a rigid 3-D transform that cmfsim reads: use one of {known}"
    )


def _matrix_of(found: Sequence[tuple[str, Floats, Floats] | _Found]) -> Floats:
    """The matrix of the only rigid transform, alone or in a composite."""
    all_of = [f if isinstance(f, _Found) else _Found(*f, MappingProxyType({})) for f in found]
    inner = [f for f in all_of if f.kind != COMPOSITE]
    if len(inner) != 1 or len(all_of) - len(inner) > 1:
        kinds = ", ".join(f.kind for f in all_of)
        where = all_of[1].where.get("Transform", "") if len(all_of) > 1 else ""
        raise CaseInputError(
            f"{where}the file holds {len(inner)} transforms ({kinds}), not one rigid transform per "
            "segment: combine them into one (3D Slicer: harden the transform)"
        )
    one = inner[0]
    if one.kind not in ITK_KINDS:
        raise _unknown_kind("", one.kind)
    counts, rotation = ITK_KINDS[one.kind]
    if len(one.parameters) != counts:
        raise CaseInputError(
            f"{one.where.get('Parameters', '')}Parameters holds {len(one.parameters)} numbers: "
            f"{one.kind} needs {counts}"
        )
    # Euler3DTransform has a fourth number, the order of its rotations.
    allowed = (0, 3, 4) if one.kind == "Euler3DTransform" else (0, 3)
    if len(one.fixed) not in allowed:
        raise CaseInputError(
            f"{one.where.get('FixedParameters', '')}FixedParameters holds {len(one.fixed)} "
            f"numbers: the centre, {' or '.join(str(n) for n in allowed)}, is needed"
        )
    centre = one.fixed[:3] if len(one.fixed) else np.zeros(3)
    try:
        turn = rotation(one.parameters, one.fixed)
    except CaseInputError as error:
        raise CaseInputError(f"{one.where.get('Parameters', '')}{error}") from error
    # x ↦ R (x − c) + c + t; a VersorTransform has no t.
    shift = np.zeros(3) if one.kind in WITHOUT_SHIFT else one.parameters[-3:]
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
    """Rz Rx Ry, or Rz Ry Rx if the file's fourth fixed number is not 0; angles in radians."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(parameters[:3]), np.cos(parameters[:3])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    ry = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    rz = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    zyx = len(fixed) == 4 and fixed[3] != 0.0
    turn: Floats = rz @ ry @ rx if zyx else rz @ rx @ ry
    return turn


def _versor(parameters: Floats, _: Floats) -> Floats:
    """The rotation of the unit quaternion with vector part v and real part √(1 − |v|²)."""
    v = parameters[:3]
    square = float(v @ v)
    if square > 1.0 + 1e-9:
        raise CaseInputError(f"the versor has length {np.sqrt(square):.6g}: 0 to 1 is needed")
    w = float(np.sqrt(max(0.0, 1.0 - square)))
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    turn: Floats = np.eye(3) + 2.0 * w * cross + 2.0 * (cross @ cross)
    return turn


# Number of parameters of each kind, and the rotation that they describe.
ITK_KINDS: Mapping[str, tuple[int, Callable[[Floats, Floats], Floats]]] = MappingProxyType({
    "Euler3DTransform": (6, _euler), "VersorRigid3DTransform": (6, _versor),
    "VersorTransform": (3, _versor), "TranslationTransform": (3, lambda *_: np.eye(3)),
    "IdentityTransform": (0, lambda *_: np.eye(3)),
    **dict.fromkeys(
        ("AffineTransform", "MatrixOffsetTransformBase", "Rigid3DTransform"),
        (12, lambda parameters, _: parameters[:9].reshape(3, 3)),
    ),
})  # fmt: skip
WITHOUT_SHIFT = ("VersorTransform", "IdentityTransform")
