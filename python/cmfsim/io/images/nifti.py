"""NIfTI files, plain or packed by gzip: headers by nibabel, with what is checked of them.

ITK reads zeros where a file is cut short, drops the shear of a tilted scan or refuses it, and never
comes to an end where the affine is infinite. nibabel corrects headers without a word, unless it is
told not to, and reads a file that is longer than its header states.
"""

import gzip
import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageError, ImageInputError, third_party
from cmfsim.io.images.image_headers import (
    KNOWN,
    MOST_PACKED,
    apart,
    check_affine,
    check_memory,
    check_shape,
    unstated,
)
from cmfsim.values.finding import Finding

# Two statements of one image's place agree up to this at its corners, mm.
PLACES_AGREE = 0.25
# Spacings stated twice agree up to this part.
SPACINGS_AGREE = 0.01
# The modules of nibabel, by the length of the headers that each reads, bytes.
MODULES: Mapping[int, str] = {348: "nifti1", 540: "nifti2"}
# NIfTI's units of length (the low three bits of xyzt_units), mm.
NIFTI_UNITS: Mapping[int, float] = {1: 1000.0, 2: 1.0, 3: 0.001}
# Codes of a NIfTI map to a template's space, in which lengths are not the patient's.
TEMPLATE_SPACES = (3, 4)
# Larger numbers in a header are none; its data begin within so many bytes.
MOST_NUMBER = 1e30
MOST_START = 1 << 30
# Bytes between a header and its voxels that state extensions.
EXTENSION = 4
# Quaternions are written in single precision.
UNIT_PART = 1e-3
TURN = ("quatern_b", "quatern_c", "quatern_d", "qoffset_x", "qoffset_y", "qoffset_z")
GZIP = b"\x1f\x8b"
# Bytes that are unpacked at a time.
CHUNK = 1 << 22


@dataclass(frozen=True, eq=False)
class _Header:
    """The numbers of a header that place and scale the voxels; places and spacings in mm."""

    size: tuple[int, int, int]
    dtype: np.dtype[Any]
    start: int
    scale: tuple[float, float]
    spacing: NDArray[np.float64]
    hand: float
    codes: tuple[int, int]
    turn: NDArray[np.float64]
    rows: NDArray[np.float64]
    has_unit: bool
    ignored: tuple[str, ...] = ()


def is_nifti(begin: bytes) -> bool:
    """Whether the first bytes of a file, unpacked, are those of a NIfTI or Analyze header."""
    return _order(begin) is not None


def read_nifti(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], tuple[Finding, ...]]:
    """The voxels of a NIfTI file, axes x, y, z, the map from index to LPS (3, 4), and findings."""
    with path.open("rb") as file:
        packed = file.read(2) == GZIP
    try:
        with gzip.open(path, "rb") if packed else path.open("rb") as stream:
            header = _header(path, stream.read(max(MODULES)))
            values, left = _voxels(path, stream, header, packed=packed)
    except (EOFError, OSError, zlib.error) as error:
        raise ImageInputError(
            f"{path.name}: is cut short or damaged ({error}); copy it again"
        ) from error
    affine, findings = _affine(path, header)
    check_affine(path.name, affine, header.size)
    if not header.has_unit:
        text = " × ".join(f"{s:.4g}" for s in header.spacing)
        what = f"it states no unit of length: voxels were taken as {text} mm"
        findings.append(Finding("image-unit-unstated", what, where=path.name))
    ignored = header.ignored + ((f"{left} bytes after the last voxel",) if left else ())
    if ignored:
        what = f"ignored: {'; '.join(ignored)}"
        why = "its header was written by a program with errors; all else in it agrees"
        fix = "compare the image with the patient, or convert the DICOM series again"
        findings.append(Finding("field-ignored", what, where=path.name, why=why, fix=fix))
    return values, affine, tuple(findings)


def _order(header: bytes) -> str | None:
    """The byte order of a NIfTI or Analyze header; None if it is neither."""
    if len(header) < 4:
        return None
    return next((o for o in "<>" if struct.unpack(f"{o}i", header[:4])[0] in MODULES), None)


def _header(path: Path, data: bytes) -> _Header:
    order = _order(data)
    first = 0 if order is None else struct.unpack(f"{order}i", data[:4])[0]
    if order is None or len(data) < first:
        raise ImageInputError(
            f"{path.name}: is not a readable image (no NIfTI header, or cut short); {KNOWN}"
        )

    module = f"nibabel.{MODULES[first]}"
    of_kind = third_party(module, "NIfTI is read", "imaging", ImageError)
    header = getattr(of_kind, f"Nifti{module[-1]}Header")(data[:first], order, check=False)
    at = header.structarr
    _check_magic(path, bytes(at["magic"].item())[:4].ljust(4, b"\0"))
    dtype, size = _dtype(path, header), _size(path, at["dim"].tolist())
    spacing = at["pixdim"][:4].astype(np.float64)
    start, units = float(at["vox_offset"]), int(at["xyzt_units"])
    scale = float(at["scl_slope"]), float(at["scl_inter"])
    codes = int(at["qform_code"]), int(at["sform_code"])
    turn = np.array([at[name] for name in TURN], dtype=np.float64)
    rows = np.array([at[f"srow_{axis}"] for axis in "xyz"], dtype=np.float64)
    ignored = []
    if (bits := int(at["bitpix"])) != 8 * dtype.itemsize:
        # The type says it as well, and the length of the file is compared with it.
        ignored.append(f"bitpix {bits}, which its data type contradicts")
    if not math.isfinite(scale[0]):
        # As nibabel and ITK take it.
        ignored.append(f"scl_slope {scale[0]}: values are as they are stored")
        scale = 1.0, 0.0
    if start == 0.0:
        ignored.append("vox_offset 0: voxels begin after the header")
        start = first + EXTENSION
    if codes[1] > 0 >= codes[0] and not _is_spacing(spacing[1:]) and np.isfinite(rows).all():
        ignored.append(f"pixdim {spacing[1:].tolist()}: its sform states the size of a voxel")
        spacing[1:] = np.linalg.norm(rows[:, :3], axis=0)
    used = {"pixdim": spacing[1:], "slope and intercept": scale, "start of the data": start}
    if codes[0] > 0:
        used["pixdim[0], the quaternion and offset of its qform"] = (spacing[0], *turn)
    if codes[1] > 0:
        used["sform"] = rows
    _check_numbers(path, used, first)
    unit = NIFTI_UNITS.get(units & 7, 1.0)
    turn[3:] *= unit
    return _Header(
        size,
        dtype,
        int(start),
        scale,
        unit * spacing[1:],
        -1.0 if spacing[0] < 0.0 else 1.0,
        codes,
        turn,
        unit * rows,
        units & 7 in NIFTI_UNITS,
        tuple(ignored),
    )


def _check_numbers(path: Path, used: Mapping[str, Any], header: int) -> None:
    """Refuses numbers that are used and not finite, no size of a voxel, data within the header."""
    for name, values in used.items():
        numbers = np.ravel(values)
        if not (np.abs(numbers) <= MOST_NUMBER).all():
            raise ImageInputError(
                f"{path.name}: {name} is {numbers.tolist()}: every number must be finite; convert "
                "the DICOM series again"
            )
    spacing, start = used["pixdim"], used["start of the data"]
    if not _is_spacing(spacing):
        raise ImageInputError(f"{path.name}: spacing is {spacing.tolist()}: must be above 0")
    if not header <= start <= MOST_START:
        raise ImageInputError(f"{path.name}: its data begin at byte {start:g}")


def _is_spacing(steps: NDArray[np.float64]) -> bool:
    """Whether numbers may be the size of a voxel."""
    return bool(((steps > 0.0) & (steps <= MOST_NUMBER)).all())


def _check_magic(path: Path, magic: bytes) -> None:
    if magic in {b"ni1\0", b"ni2\0"}:
        raise ImageInputError(
            f"{path.name}: is a pair of header and image: save it as one file (.nii.gz)"
        )
    if magic not in {b"n+1\0", b"n+2\0"}:
        raise ImageInputError(
            f"{path.name}: is an Analyze image, which states no orientation: save it as NIfTI "
            "(.nii.gz) or NRRD"
        )


def _dtype(path: Path, header: Any) -> np.dtype[Any]:
    """The type of a voxel: one real number."""
    kind = int(header["datatype"])
    try:
        dtype: np.dtype[Any] = header.get_data_dtype()
    except Exception as error:  # (a number that is no type is a KeyError)
        raise ImageInputError(f"{path.name}: data type {kind} is unknown") from error
    if components := len(dtype.names or "") or 2 * (dtype.kind == "c"):
        check_shape(path.name, [2, 2, 2], components)
    if dtype.kind not in "iuf":
        raise ImageInputError(f"{path.name}: data type {kind}: whole or real numbers are needed")
    return dtype


def _size(path: Path, shape: list[int]) -> tuple[int, int, int]:
    if not 1 <= shape[0] <= 7 or min(shape[1 : shape[0] + 1]) < 1:
        raise ImageInputError(f"{path.name}: has {shape[0]} axes of {shape[1:]} voxels")
    size = shape[1 : shape[0] + 1]
    check_shape(path.name, size)
    return size[0], size[1], size[2]


def _voxels(path: Path, stream: Any, header: _Header, *, packed: bool) -> tuple[NDArray[Any], int]:
    """The scaled voxels, and how many bytes follow them: too few for a row of voxels."""
    needed = math.prod(header.size) * header.dtype.itemsize
    there = path.stat().st_size
    most = there * MOST_PACKED if packed else there - header.start
    if most < needed:
        raise ImageInputError(
            f"{path.name}: is cut short: {there} bytes, and its header asks for {needed} of "
            "voxels; copy it again"
        )
    check_memory(path.name, needed)
    stream.seek(header.start)
    values = np.empty(header.size, dtype=header.dtype, order="F")
    room = memoryview(values.reshape(-1, order="F").view(np.uint8).data)
    found = 0
    while found < needed and (count := stream.readinto(room[found : found + CHUNK])):
        found += count
    if found < needed:
        raise ImageInputError(
            f"{path.name}: is cut short: {found} of {needed} bytes of voxels; copy it again"
        )
    # The end of a packed file holds its checksum, which is compared by reading past it.
    left = stream.read(min(header.size) * header.dtype.itemsize)
    if len(left) >= min(header.size) * header.dtype.itemsize:
        raise ImageInputError(
            f"{path.name}: is longer than its header states, which are {needed} bytes of voxels: "
            "the header belongs to another image, or the file is damaged; copy it again"
        )
    values = values.astype(header.dtype.newbyteorder("="), copy=False)
    slope, intercept = header.scale
    if slope == 0.0 or (slope, intercept) == (1.0, 0.0):
        return values, len(left)
    return values * np.float32(slope) + np.float32(intercept), len(left)


def _affine(path: Path, header: _Header) -> tuple[NDArray[np.float64], list[Finding]]:
    """The map to LPS, from the file's two statements of it (qform, sform)."""
    code_turn, code_rows = header.codes
    rows, spacing = header.rows, header.spacing
    if code_turn <= 0 and code_rows <= 0:
        how = "as DICOM converters write it, with qform or sform"
        found = unstated(path, "its codes qform and sform are 0", how)
        return np.column_stack([np.diag(spacing), np.zeros(3)]), [found]
    turned = _from_quaternion(path, header)
    to_lps = np.array([[-1.0], [-1.0], [1.0]])
    if code_rows <= 0:
        return to_lps * turned, []
    if code_turn > 0 and code_rows in TEMPLATE_SPACES and code_turn not in TEMPLATE_SPACES:
        used = "; its qform, which refers to the scanner's, was used"
        return to_lps * turned, [_template(path, code_rows, "note", used)]
    if code_turn > 0:
        off = apart(turned, rows, header.size)
        if min(off, apart(turned, _orthogonal(rows, spacing), header.size)) > PLACES_AGREE:
            raise ImageInputError(
                f"{path.name}: its two statements of its position disagree by {off:.4g} mm "
                f"(qform, code {code_turn}: {turned.round(4).tolist()}; sform, code {code_rows}: "
                f"{rows.round(4).tolist()}): keep the right one and set the code of the other to "
                "0, or convert the DICOM series again"
            )
    else:
        _check_lengths(path, rows, spacing)
    if code_rows in TEMPLATE_SPACES:
        return to_lps * rows, [_template(path, code_rows, "warning", "")]
    return to_lps * rows, []


def _template(path: Path, code: int, severity: str, used: str) -> Finding:
    what = f"its sform (code {code}) leads to the space of a template{used}"
    fix = "nothing to do" if used else ""
    return Finding("image-template-space", what, severity=severity, where=path.name, fix=fix)


def _from_quaternion(path: Path, header: _Header) -> NDArray[np.float64]:
    """The map of a NIfTI qform: turned by a quaternion, scaled by the spacing."""
    b, c, d = header.turn[:3].tolist()
    rest = 1.0 - (b * b + c * c + d * d)
    if header.codes[0] > 0 and rest < -UNIT_PART:
        raise ImageInputError(
            f"{path.name}: the quaternion of its qform is {(b, c, d)}, longer than 1: convert the "
            "DICOM series again"
        )
    quaternion = third_party("nibabel.quaternions", "NIfTI is read", "imaging", ImageError)
    rotation = quaternion.quat2mat((math.sqrt(max(0.0, rest)), b, c, d))
    steps = header.spacing * np.array([1.0, 1.0, header.hand])
    return np.column_stack([rotation * steps, header.turn[3:]])


def _orthogonal(rows: NDArray[np.float64], spacing: NDArray[np.float64]) -> NDArray[np.float64]:
    """The map with the nearest orthogonal axes: what a qform keeps of a sheared sform."""
    lengths = np.linalg.norm(rows[:, :3], axis=0)
    if not (lengths > 0.0).all():
        return rows
    u, _, v = np.linalg.svd(rows[:, :3] / lengths)
    return np.column_stack([(u @ v) * spacing, rows[:, 3]])


def _check_lengths(path: Path, rows: NDArray[np.float64], spacing: NDArray[np.float64]) -> None:
    """Refuses an sform whose voxels have another size than the header states elsewhere."""
    lengths = np.linalg.norm(rows[:, :3], axis=0)
    normal = np.cross(rows[:, 0], rows[:, 1])
    size = float(np.linalg.norm(normal))
    # Slices of a tilted scan: their distance is measured across them, or along the table.
    across = abs(float(rows[:, 2] @ normal)) / size if size > 0.0 else 0.0
    wrong = np.abs(lengths - spacing) > SPACINGS_AGREE * spacing
    wrong[2] &= abs(across - spacing[2]) > SPACINGS_AGREE * spacing[2]
    if wrong.any():
        raise ImageInputError(
            f"{path.name}: its voxels are {spacing.tolist()} by pixdim and "
            f"{lengths.round(4).tolist()} by its sform: convert the DICOM series again"
        )
