"""Headers of NRRD, NIfTI and MetaImage files, read and checked before a third-party reader is.

A header may crash or mislead a reader: numbers of a thousand digits, infinite places, sizes beyond
any memory, data files in other folders, sheared axes that are silently made orthogonal. What is
returned here is plain numbers, and the affine map of an image is this module's own.
"""

import gzip
import math
import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.case import Finding
from cmfsim.errors import ImageInputError

__all__ = ["MOST_VOXELS", "ImageHeader", "check_shape", "image_header", "is_gzip"]

# Larger images are refused before memory is taken, voxels: 1024 × 1024 × 2000.
MOST_VOXELS = 2_100_000_000
# Longer text headers are none, bytes: those of scanners' exports have some 20 kB.
MOST_HEADER = 1 << 20
# Longer numbers stand in no header, characters: ITK's reader crashes at a thousand.
MOST_DIGITS = 40
# Sizes, spacings and places beyond these are no head's: voxels along an axis, mm.
MOST_ALONG = 100_000
FARTHEST = 1e6
# Two statements of one image's place agree up to this at its corners, mm.
PLACES_AGREE = 0.25
# Spacings stated twice agree up to this part.
SPACINGS_AGREE = 0.01
# The longer of both NIfTI headers, bytes.
NIFTI_HEADER = 544
# Deflate cannot pack more tightly than this.
MOST_PACKED = 1032
# NIfTI's data types of one real number per voxel, and their bits.
NIFTI_TYPES: Mapping[int, int] = {
    2: 8, 4: 16, 8: 32, 16: 32, 64: 64, 256: 8, 512: 16, 768: 32, 1024: 64, 1280: 64,
}  # fmt: skip
# NIfTI's types of several numbers per voxel: complex numbers and colours.
NIFTI_VECTORS: Mapping[int, int] = {32: 2, 128: 3, 1792: 2, 2304: 4}
# NIfTI's units of length (the low three bits of xyzt_units), mm.
NIFTI_UNITS: Mapping[int, float] = {1: 1000.0, 2: 1.0, 3: 0.001}
# Codes of a NIfTI map to a template's space, in which lengths are not the patient's.
TEMPLATE_SPACES = (3, 4)
LENGTHS: Mapping[str, float] = {
    "mm": 1.0, "millimeter": 1.0, "millimetre": 1.0, "millimeters": 1.0, "cm": 10.0, "m": 1000.0,
    "um": 0.001, "µm": 0.001, "micron": 0.001,
}  # fmt: skip
# NRRD's anatomical spaces: what takes each axis to L, P and S.
NRRD_SPACES: Mapping[str, tuple[float, float, float]] = {
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "ras": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
    "las": (1.0, -1.0, 1.0),
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "lps": (1.0, 1.0, 1.0),
}
NRRD_BYTES: Mapping[str, int] = {
    **dict.fromkeys(("signed char", "int8", "int8_t", "uchar", "unsigned char"), 1),
    **dict.fromkeys(("uint8", "uint8_t"), 1),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int"), 2),
    **dict.fromkeys(("int16", "int16_t", "ushort", "unsigned short", "unsigned short int"), 2),
    **dict.fromkeys(("uint16", "uint16_t"), 2),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t", "uint", "unsigned int"), 4),
    **dict.fromkeys(("uint32", "uint32_t", "float"), 4),
    **dict.fromkeys(("longlong", "long long", "long long int", "signed long long"), 8),
    **dict.fromkeys(("signed long long int", "int64", "int64_t", "ulonglong"), 8),
    **dict.fromkeys(("unsigned long long", "unsigned long long int", "uint64", "uint64_t"), 8),
    "double": 8,
}
# NRRD axes that run through space; others hold the numbers of one voxel.
NRRD_SPATIAL = frozenset({"domain", "space", "none", "???", "time"})
# NRRD fields of free text.
NRRD_TEXTS = frozenset({"content", "data file", "datafile", "labels", "units", "sample units"})
META_BYTES: Mapping[str, int] = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4,
    "MET_LONG": 8, "MET_ULONG": 8, "MET_LONG_LONG": 8, "MET_ULONG_LONG": 8, "MET_FLOAT": 4,
    "MET_DOUBLE": 8,
}  # fmt: skip
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?")
_WHOLE = re.compile(r"\d{1,18}")
_KNOWN = "NRRD, NIfTI, MetaImage or DICOM is needed"


@dataclass(frozen=True, eq=False)
class ImageHeader:
    """What the header of an image file states.

    Attributes
    ----------
    reader : str
        ITK's name of the reader for its format.
    size : tuple of int
        Voxels along each of the three axes.
    affine : (3, 4) float64 or None, mm
        Takes an index (i, j, k, 1) to its place in LPS; None where the file states no frame: then
        the reader's own spacing and origin are all that is known.
    bytes : int
        Of all voxels, unpacked.
    scaled : bool
        Whether the affine differs from the reader's for a stated reason: a unit, a choice.
    findings : tuple of Finding
    """

    reader: str
    size: tuple[int, int, int]
    affine: NDArray[np.float64] | None
    bytes: int
    scaled: bool = False
    findings: tuple[Finding, ...] = ()


def image_header(path: Path) -> ImageHeader | None:
    """The checked header of an image file; None where it may be DICOM.

    Raises
    ------
    ImageError
        (also `ValueError`) No image, or a header that states something impossible.
    """
    with path.open("rb") as file:
        begin = file.read(NIFTI_HEADER)
    if not begin:
        raise ImageInputError(f"{path.name}: is empty")
    if begin[128:132] == b"DICM":
        return None
    if begin.startswith(b"NRRD000"):
        return _nrrd(path)
    if begin.startswith(b"\x1f\x8b"):
        return _nifti(path, _unpacked(path, NIFTI_HEADER))
    if _nifti_order(begin) is not None:
        return _nifti(path, begin)
    if _looks_like_meta(begin):
        return _meta(path)
    if path.name.lower().endswith((".nrrd", ".nhdr", ".nii", ".gz", ".mha", ".mhd", ".hdr")):
        raise ImageInputError(f"{path.name}: is no image that can be read (its header); {_KNOWN}")
    return None


def is_gzip(path: Path) -> bool:
    """Whether a file is packed by gzip."""
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def check_shape(name: str, size: list[int], components: int = 1) -> None:
    """Refuses what is no volume of one number per voxel.

    Raises
    ------
    ImageError
        (also `ValueError`)
    """
    text = " × ".join(map(str, size))
    if components != 1:
        raise ImageInputError(
            f"{name}: has {components} numbers per voxel (colours or vectors): one is needed"
        )
    if len(size) > 3 and any(n > 1 for n in size[3:]):
        raise ImageInputError(
            f"{name}: has {len(size)} axes ({text}): save one volume of the series"
        )
    if len(size) < 3 or min(size[:3]) < 2:
        raise ImageInputError(
            f"{name}: is a single slice ({text}): a volume is needed; for DICOM give the "
            "folder of all slices"
        )
    if max(size) > MOST_ALONG or math.prod(size) > MOST_VOXELS:
        raise ImageInputError(
            f"{name}: has {text} voxels: at most {MOST_VOXELS} are read, and {MOST_ALONG} along "
            "an axis"
        )


# NRRD ------------------------------------------------------------------------------------------


def _nrrd(path: Path) -> ImageHeader:
    fields, begin = _nrrd_fields(path)
    kind = fields.get("type", "").lower()
    each = NRRD_BYTES.get(kind)
    if each is None:
        raise ImageInputError(f"{path.name}: type is {kind!r}: whole or real numbers are needed")
    axes = _whole(path, "dimension", fields.get("dimension", ""))
    sizes = [_whole(path, "sizes", text) for text in fields.get("sizes", "").split()]
    if len(sizes) != axes or not 1 <= axes <= 16:
        raise ImageInputError(f"{path.name}: dimension is {axes} and sizes are {sizes}")
    kinds = [k.lower() for k in fields.get("kinds", "").split()] or ["domain"] * axes
    components = [n for n, k in zip(sizes, kinds, strict=False) if k not in NRRD_SPATIAL and n > 1]
    if components:
        check_shape(path.name, sizes[-3:], math.prod(components))
    check_shape(path.name, sizes)
    _nrrd_data_file(path, fields, begin, math.prod(sizes) * each)
    affine, scaled, findings = _nrrd_affine(path, fields, axes)
    size = (sizes[0], sizes[1], sizes[2])
    if affine is not None:
        _check_affine(path.name, affine, size)
    return ImageHeader("NrrdImageIO", size, affine, math.prod(sizes) * each, scaled, findings)


def _nrrd_fields(path: Path) -> tuple[dict[str, str], int]:
    """The fields of a header in lower case, and where the data begin."""
    with path.open("rb") as file:
        text = file.read(MOST_HEADER)
    ends = [text.find(e) + len(e) for e in (b"\n\n", b"\r\n\r\n") if e in text]
    if not ends and len(text) == MOST_HEADER:
        raise ImageInputError(
            f"{path.name}: has no end of its header within {MOST_HEADER} bytes: is it damaged?"
        )
    end = min(ends, default=len(text))
    fields: dict[str, str] = {}
    for line in text[:end].decode("utf-8", errors="replace").splitlines()[1:]:
        key, colon, value = line.partition(": ")
        # Lines with := hold what programs keep there for themselves.
        if line.startswith("#") or not colon or ":=" in line[: len(key) + 2]:
            continue
        key = key.strip().lower()
        if key not in NRRD_TEXTS and re.search(rf"[0-9.eE+-]{{{MOST_DIGITS + 1},}}", value):
            raise ImageInputError(
                f"{path.name}: {key} has a number of more than {MOST_DIGITS} characters"
            )
        fields[{"datafile": "data file"}.get(key, key)] = value.strip()
    return fields, end


def _nrrd_data_file(path: Path, fields: Mapping[str, str], begin: int, needed: int) -> None:
    for key in ("byte skip", "byteskip", "line skip", "lineskip"):
        if fields.get(key, "0") not in {"0", "-1"}:
            _whole(path, key, fields[key])
    data, start = path, begin
    if "data file" in fields:
        data, start = _data_file(path, fields["data file"]), 0
    if fields.get("encoding", "raw").lower() == "raw" and data.stat().st_size - start < needed:
        raise ImageInputError(
            f"{data.name}: is cut short: {data.stat().st_size - start} of {needed} bytes; copy it "
            "again"
        )


def _data_file(path: Path, name: str) -> Path:
    """The file beside a header that holds its voxels.

    Raises
    ------
    ImageError
        (also `ValueError`) It would lead out of the header's folder, it is a list or a pattern of
        names, or there is none.
    """
    how = (
        "a header may name one file beside it or below; save the image as one file (.nrrd, .mha, "
        ".nii.gz)"
    )
    if name.split(maxsplit=1)[:1] == ["LIST"] or "%" in name or "\0" in name or not name:
        raise ImageInputError(f"{path.name}: its data file is {name!r}: {how}")
    given = Path(name)
    folder = path.parent.resolve()
    if given.is_absolute() or ".." in given.parts or "\\" in name or ":" in name:
        raise ImageInputError(f"{path.name}: its data file {name!r} lies elsewhere: {how}")
    data = path.parent / given
    if not data.resolve().is_relative_to(folder):
        raise ImageInputError(
            f"{path.name}: its data file {name!r} is a link that leads out of the folder: {how}"
        )
    if not data.is_file():
        raise ImageInputError(
            f"{path.name}: its data file {name!r} does not exist beside it: copy both"
        )
    return data


def _nrrd_affine(
    path: Path, fields: Mapping[str, str], axes: int
) -> tuple[NDArray[np.float64] | None, bool, tuple[Finding, ...]]:
    signs = NRRD_SPACES.get(fields.get("space", "").lower())
    rows = _nrrd_vectors(path, "space directions", fields.get("space directions", ""))
    origin = _nrrd_vectors(path, "space origin", fields.get("space origin", ""))
    for key in ("spacings", "axis mins", "axismins", "axis maxs", "axismaxs", "thicknesses"):
        for text in fields.get(key, "").split():
            if text.lower() != "nan":
                number(path, key, text)
    if signs is None:
        stated = f"its space is {fields['space']!r}" if "space" in fields else "it states no space"
        return None, False, (_unstated(path, stated, "space: left-posterior-superior"),)
    vectors = [row for row in rows if row is not None]
    if len(rows) != axes or len(vectors) != 3 or any(len(row) != 3 for row in vectors):
        raise ImageInputError(
            f"{path.name}: space directions are {fields.get('space directions', '')!r}: three "
            "vectors of three numbers are needed"
        )
    if origin and (len(origin) != 1 or origin[0] is None or len(origin[0]) != 3):
        raise ImageInputError(f"{path.name}: space origin is {fields['space origin']!r}")
    findings: tuple[Finding, ...] = ()
    if not origin:
        findings = (_unstated(path, "it states no space origin", "space origin: (x,y,z)"),)
    units = {u.strip().lower() for u in re.findall(r'"([^"]*)"', fields.get("space units", ""))}
    units -= {""}
    if len(units) > 1 or not units <= set(LENGTHS):
        raise ImageInputError(
            f'{path.name}: space units are {fields["space units"]}: write "mm" for each axis'
        )
    scale = LENGTHS[units.pop()] if units else 1.0
    affine = np.zeros((3, 4))
    affine[:, :3] = np.array(vectors, dtype=np.float64).T
    affine[:, 3] = origin[0] if origin and origin[0] is not None else 0.0
    return scale * np.array(signs)[:, None] * affine, scale != 1.0, findings


def _nrrd_vectors(path: Path, key: str, text: str) -> list[list[float] | None]:
    """The vectors "(1,0,0) none (0,1,0)" of a field."""
    found: list[list[float] | None] = []
    for part in re.findall(r"\([^)]*\)|none", text):
        if part == "none":
            found.append(None)
        else:
            found.append([number(path, key, n) for n in part[1:-1].split(",")])
    return found


def _unstated(path: Path, stated: str, how: str) -> Finding:
    return Finding(
        "warning",
        "image-frame-unstated",
        f"{stated}: its axes were taken as left, posterior and superior",
        where=path.name,
        why="left and right of the face would be swapped, or front and back, if that is wrong; no "
        "image shows left and right",
        mend=f"export the image again with its orientation ({how}), and check left and right",
    )


# NIfTI -----------------------------------------------------------------------------------------


def _unpacked(path: Path, count: int) -> bytes:
    try:
        with gzip.open(path, "rb") as file:
            return file.read(count)
    except (EOFError, OSError, zlib.error) as error:
        raise ImageInputError(
            f"{path.name}: is cut short or damaged ({error}); copy it again"
        ) from error


def _nifti_order(header: bytes) -> str | None:
    """The byte order of a NIfTI or Analyze header; None if it is neither."""
    if len(header) < 4:
        return None
    return next((o for o in "<>" if struct.unpack(f"{o}i", header[:4])[0] in {348, 540}), None)


def _nifti(path: Path, header: bytes) -> ImageHeader:
    order = _nifti_order(header)
    first = 0 if order is None else struct.unpack(f"{order}i", header[:4])[0]
    if order is None or len(header) < first:
        raise ImageInputError(
            f"{path.name}: is no image that can be read (no NIfTI header, or cut short); {_KNOWN}"
        )

    def at(form: str, place: int) -> tuple[Any, ...]:
        return struct.unpack_from(f"{order}{form}", header, place)

    long = first == 540
    magic = header[4:8] if long else header[344:348]
    if magic not in {b"n+1\0", b"n+2\0", b"ni1\0", b"ni2\0"}:
        raise ImageInputError(
            f"{path.name}: is an Analyze image, which states no orientation: save it as NIfTI "
            "(.nii.gz) or NRRD"
        )
    if magic in {b"ni1\0", b"ni2\0"}:
        raise ImageInputError(
            f"{path.name}: is a pair of header and image: save it as one file (.nii.gz)"
        )
    shape = [int(n) for n in at("8q" if long else "8h", 16 if long else 40)]
    kind, bits = at("hh", 12 if long else 70)
    spacing = np.array(at("8d" if long else "8f", 104 if long else 76))
    start = float(at("q" if long else "f", 168 if long else 108)[0])
    scales = at("dd" if long else "ff", 176 if long else 112)
    units = int(at("i", 500)[0]) if long else header[123]
    codes = [int(c) for c in at("ii" if long else "hh", 344 if long else 252)]
    turn = np.array(at("6d" if long else "6f", 352 if long else 256))
    rows = np.array(at("12d" if long else "12f", 400 if long else 280)).reshape(3, 4)
    size = _nifti_size(path, shape, int(kind), int(bits))
    for name, values in (
        ("pixdim", spacing[:4]),
        ("quaternion and offset", turn),
        ("sform", rows),
        ("slope and intercept", np.array(scales)),
        ("start of the data", np.array([start])),
    ):
        if not np.isfinite(values).all() or np.abs(values).max() > 1e30:
            raise ImageInputError(
                f"{path.name}: {name} is {values.tolist()}: every number must be finite"
            )
    if (spacing[1:4] <= 0.0).any():
        raise ImageInputError(f"{path.name}: spacing is {spacing[1:4].tolist()}: must be above 0")
    needed = math.prod(shape[1 : shape[0] + 1]) * int(bits) // 8
    if not first <= start <= 1 << 30:
        raise ImageInputError(f"{path.name}: its data begin at byte {start:g}")
    _check_nifti_length(path, int(start) + needed)
    scale = NIFTI_UNITS.get(units & 7, 1.0)
    spacing[1:4] *= scale
    turn[3:] *= scale
    affine, scaled, findings = _nifti_affine(path, spacing, codes, turn, scale * rows, size)
    if affine is not None:
        _check_affine(path.name, affine, size)
    if units & 7 not in NIFTI_UNITS:
        findings.append(_no_unit(path, spacing[1:4]))
    return ImageHeader("NiftiImageIO", size, affine, needed, scaled, tuple(findings))


def _nifti_size(path: Path, shape: list[int], kind: int, bits: int) -> tuple[int, int, int]:
    if not 1 <= shape[0] <= 7 or min(shape[1 : shape[0] + 1]) < 1:
        raise ImageInputError(f"{path.name}: has {shape[0]} axes of {shape[1:]} voxels")
    size = shape[1 : shape[0] + 1]
    if kind in NIFTI_VECTORS:
        check_shape(path.name, size, NIFTI_VECTORS[kind])
    if NIFTI_TYPES.get(kind) != bits:
        raise ImageInputError(
            f"{path.name}: data type {kind} of {bits} bits: whole or real numbers are needed"
        )
    check_shape(path.name, size)
    return size[0], size[1], size[2]


def _check_nifti_length(path: Path, needed: int) -> None:
    """Refuses a NIfTI file with fewer bytes than its header states: ITK reads zeros for the rest.

    A packed file is unpacked no further than that.
    """
    found = path.stat().st_size
    if is_gzip(path):
        if found * MOST_PACKED < needed:
            raise ImageInputError(
                f"{path.name}: is cut short: its header asks for {needed} bytes, which {found} "
                "packed ones cannot hold; copy it again"
            )
        found = 0
        try:
            with gzip.open(path, "rb") as file:
                while found < needed and (block := file.read(2**22)):
                    found += len(block)
        except (EOFError, OSError, zlib.error) as error:
            raise ImageInputError(
                f"{path.name}: is cut short or damaged ({error}); copy it again"
            ) from error
    if found < needed:
        raise ImageInputError(
            f"{path.name}: is cut short: {found} of {needed} bytes; copy it again"
        )


def _no_unit(path: Path, spacing: NDArray[np.float64]) -> Finding:
    text = " × ".join(f"{s:.4g}" for s in spacing)
    return Finding(
        "note",
        "image-unit-unstated",
        f"it states no unit of length: voxels were taken as {text} mm",
        where=path.name,
        why="every length of the head follows from it",
        mend="compare a distance with one on the patient, or export with units of mm",
    )


def _nifti_affine(
    path: Path,
    spacing: NDArray[np.float64],
    codes: list[int],
    turn: NDArray[np.float64],
    rows: NDArray[np.float64],
    size: tuple[int, int, int],
) -> tuple[NDArray[np.float64] | None, bool, list[Finding]]:
    """The map of a NIfTI file to LPS, from its two statements of it (qform, sform) in mm."""
    by_turn, by_rows = codes[0] > 0, codes[1] > 0
    if not by_turn and not by_rows:
        how = "as DICOM converters write it, with qform or sform"
        return None, False, [_unstated(path, "its codes qform and sform are 0", how)]
    turned = _from_quaternion(spacing, turn)
    to_lps = np.array([[-1.0], [-1.0], [1.0]])
    if by_turn and by_rows and codes[1] in TEMPLATE_SPACES and codes[0] not in TEMPLATE_SPACES:
        finding = Finding(
            "note",
            "image-template-space",
            f"its sform (code {codes[1]}) leads to the space of a template; its qform, which leads "
            "to the scanner's, was used",
            where=path.name,
            why="lengths in a template's space are not the patient's",
        )
        return to_lps * turned, True, [finding]
    if not by_rows:
        return to_lps * turned, False, []
    findings = []
    if by_turn:
        apart = _apart(turned, rows, size)
        sheared = _apart(turned, _orthogonal(rows, spacing), size)
        if min(apart, sheared) > PLACES_AGREE:
            raise ImageInputError(
                f"{path.name}: its two statements of where it lies disagree by {apart:.4g} mm "
                f"(qform, code {codes[0]}: {turned.round(4).tolist()}; sform, code {codes[1]}: "
                f"{rows.round(4).tolist()}): keep the right one and set the code of the other to "
                "0, or convert the DICOM series again"
            )
    else:
        _check_lengths(path, rows, spacing)
    if codes[1] in TEMPLATE_SPACES:
        findings.append(
            Finding(
                "warning",
                "image-template-space",
                f"its sform (code {codes[1]}) leads to the space of a template",
                where=path.name,
                why="lengths in a template's space are not the patient's",
                mend="use the image in the scanner's space",
            )
        )
    return to_lps * rows, True, findings


def _from_quaternion(spacing: NDArray[np.float64], turn: NDArray[np.float64]) -> Any:
    """The map of a NIfTI qform: turned by a quaternion, scaled by the spacing."""
    b, c, d = turn[:3]
    a = math.sqrt(max(0.0, 1.0 - float(b * b + c * c + d * d)))
    rotation = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    steps = spacing[1:4] * np.array([1.0, 1.0, -1.0 if spacing[0] < 0.0 else 1.0])
    return np.column_stack([rotation * steps, turn[3:]])


def _orthogonal(rows: NDArray[np.float64], spacing: NDArray[np.float64]) -> Any:
    """The map with the nearest orthogonal axes: what a qform keeps of a sheared sform."""
    lengths = np.linalg.norm(rows[:, :3], axis=0)
    if not (lengths > 0.0).all():
        return rows
    u, _, v = np.linalg.svd(rows[:, :3] / lengths)
    return np.column_stack([(u @ v) * spacing[1:4], rows[:, 3]])


def _apart(a: NDArray[np.float64], b: NDArray[np.float64], size: tuple[int, int, int]) -> float:
    """How far two maps of an image lie apart at its corners."""
    corners = np.array(
        [[(c >> axis & 1) * (size[axis] - 1.0) for axis in range(3)] + [1.0] for c in range(8)]
    )
    return float(np.linalg.norm(corners @ (a - b).T, axis=1).max())


def _check_lengths(path: Path, rows: NDArray[np.float64], spacing: NDArray[np.float64]) -> None:
    """Refuses an sform whose voxels have another size than the header states elsewhere."""
    lengths = np.linalg.norm(rows[:, :3], axis=0)
    normal = np.cross(rows[:, 0], rows[:, 1])
    size = float(np.linalg.norm(normal))
    # Slices of a tilted scan: their distance is measured across them, or along the table.
    across = abs(float(rows[:, 2] @ normal)) / size if size > 0.0 else 0.0
    stated = spacing[1:4]
    wrong = np.abs(lengths - stated) > SPACINGS_AGREE * stated
    if abs(across - stated[2]) <= SPACINGS_AGREE * stated[2]:
        wrong[2] = False
    if wrong.any():
        raise ImageInputError(
            f"{path.name}: its voxels are {stated.tolist()} by pixdim and "
            f"{lengths.round(4).tolist()} by its sform: convert the DICOM series again"
        )


# MetaImage -------------------------------------------------------------------------------------


def _looks_like_meta(begin: bytes) -> bool:
    line = begin.split(b"\n", 1)[0]
    return bool(re.match(rb"\s*(ObjectType|NDims|Comment|ObjectSubType)\s*=", line))


def _meta(path: Path) -> ImageHeader:
    fields, begin = _meta_fields(path)
    axes = _whole(path, "NDims", fields.get("NDims", ""))
    sizes = [_whole(path, "DimSize", text) for text in fields.get("DimSize", "").split()]
    if len(sizes) != axes or not 1 <= axes <= 10:
        raise ImageInputError(f"{path.name}: NDims is {axes} and DimSize {sizes}")
    channels = _whole(path, "ElementNumberOfChannels", fields.get("ElementNumberOfChannels", "1"))
    check_shape(path.name, sizes, channels)
    each = META_BYTES.get(fields.get("ElementType", ""))
    if each is None:
        raise ImageInputError(
            f"{path.name}: ElementType is {fields.get('ElementType', '')!r}: whole or real numbers "
            "are needed"
        )
    needed = math.prod(sizes) * each
    name = fields["ElementDataFile"]
    data, start = path, begin
    if name.upper() != "LOCAL":
        data, start = _data_file(path, name), 0
    found = data.stat().st_size - start
    packed = fields.get("CompressedData", "False").lower() in {"true", "1"}
    if found * (MOST_PACKED if packed else 1) < needed:
        raise ImageInputError(
            f"{data.name}: is cut short: {found} of {needed} bytes; copy it again"
        )
    size = (sizes[0], sizes[1], sizes[2])
    affine, scaled = _meta_affine(path, fields, axes)
    _check_affine(path.name, affine, size)
    return ImageHeader("MetaImageIO", size, affine, needed, scaled)


def _meta_fields(path: Path) -> tuple[dict[str, str], int]:
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while file.tell() < MOST_HEADER and (line := file.readline(MOST_HEADER)):
            key, equals, value = line.decode("utf-8", errors="replace").partition("=")
            if not equals:
                continue
            fields[key.strip()] = value.strip()
            if key.strip() == "ElementDataFile":
                return fields, file.tell()
    raise ImageInputError(
        f"{path.name}: has no ElementDataFile in its header: is it cut short? Copy it again"
    )


def _meta_affine(
    path: Path, fields: Mapping[str, str], axes: int
) -> tuple[NDArray[np.float64], bool]:
    def numbers(keys: tuple[str, ...], default: list[float]) -> NDArray[np.float64]:
        key = next((k for k in keys if k in fields), None)
        if key is None:
            return np.array(default)
        found = [number(path, key, text) for text in fields[key].split()]
        if len(found) != len(default):
            raise ImageInputError(f"{path.name}: {key} has {len(found)} of {len(default)} numbers")
        return np.array(found)

    turn = numbers(("TransformMatrix", "Rotation", "Orientation"), np.eye(axes).ravel().tolist())
    spacing = numbers(("ElementSpacing", "ElementSize"), [1.0] * axes)
    place = numbers(("Offset", "Position", "Origin"), [0.0] * axes)
    numbers(("CenterOfRotation",), [0.0] * axes)
    if (spacing <= 0.0).any():
        raise ImageInputError(
            f"{path.name}: ElementSpacing is {spacing.tolist()} mm: must be above 0"
        )
    unit = fields.get("DistanceUnits", "mm").lower()
    if unit not in {*LENGTHS, "?", ""}:
        raise ImageInputError(f"{path.name}: DistanceUnits is {unit!r}: write mm")
    scale = LENGTHS.get(unit, 1.0)
    # A row of the matrix is the direction of an axis.
    direction = turn.reshape(axes, axes).T[:3, :3]
    return scale * np.column_stack([direction * spacing[:3], place[:3]]), scale != 1.0


# Numbers ---------------------------------------------------------------------------------------


def _whole(path: Path, key: str, text: str) -> int:
    if not _WHOLE.fullmatch(text.strip()):
        raise ImageInputError(f"{path.name}: {key} is {text[:MOST_DIGITS]!r}: no whole number")
    return int(text)


def number(path: Path, key: str, text: str) -> float:
    """A finite number of a header.

    Raises
    ------
    ImageError
        (also `ValueError`) None, not finite, longer than any that is meant, or farther than a head.
    """
    text = text.strip()
    if len(text) > MOST_DIGITS or not _NUMBER.fullmatch(text):
        raise ImageInputError(f"{path.name}: {key} has {text[:MOST_DIGITS]!r}: no finite number")
    value = float(text)
    if abs(value) > FARTHEST:
        raise ImageInputError(f"{path.name}: {key} has {value:g}: no head is so large or so far")
    return value


def _check_affine(name: str, affine: NDArray[np.float64], size: tuple[int, int, int]) -> None:
    lengths = np.linalg.norm(affine[:, :3], axis=0)
    if not (lengths > 0.0).all():
        raise ImageInputError(f"{name}: spacing is {lengths.tolist()} mm: must be above 0")
    volume = abs(float(np.linalg.det(affine[:, :3] / lengths)))
    # Axes of a scan tilted by 30° span 0.87; below a half they nearly lie in one plane.
    if volume < 0.5:
        raise ImageInputError(
            f"{name}: direction {(affine[:, :3] / lengths).round(4).tolist()} is no set of axes in "
            f"space (they span {volume:.2g} of a cube)"
        )
    farthest = float(np.abs(affine[:, 3]).max() + (lengths * np.array(size)).max())
    if farthest > FARTHEST:
        raise ImageInputError(f"{name}: reaches {farthest:g} mm from the origin: no head does")
