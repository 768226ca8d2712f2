"""NRRD (.nrrd, .nhdr) and MetaImage (.mha, .mhd), with their data or next to them."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.images.image_headers import (
    LENGTHS,
    MOST_DIGITS,
    MOST_HEADER,
    check_affine,
    check_shape,
    data_file,
    number,
    stored_voxels,
    unstated,
    whole,
)
from cmfsim.values.finding import Finding

MET_TYPES: Mapping[str, str] = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4",
    "MET_UINT": "u4", "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
ORDER_KEYS = ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")
# An image: voxels, axes x, y, z, the map from index to LPS (3, 4), mm, and findings.
Read = tuple[NDArray[Any], NDArray[np.float64], tuple[Finding, ...]]


def is_meta(begin: bytes) -> bool:
    """Whether the first bytes of a file are those of a MetaImage header."""
    line = begin.split(b"\n", 1)[0]
    return bool(re.match(rb"\s*(ObjectType|NDims|Comment|ObjectSubType)\s*=", line))


def read_meta(path: Path) -> Read:
    """The image of a MetaImage file."""
    fields, begin = _fields(path)
    axes = whole(path, "NDims", fields.get("NDims", ""))
    sizes = [whole(path, "DimSize", text) for text in fields.get("DimSize", "").split()]
    if len(sizes) != axes or not 1 <= axes <= 10:
        raise ImageInputError(f"{path.name}: NDims is {axes} and DimSize {sizes}")
    channels = whole(path, "ElementNumberOfChannels", fields.get("ElementNumberOfChannels", "1"))
    check_shape(path.name, sizes, channels)
    kind = MET_TYPES.get(fields.get("ElementType", ""))
    if kind is None:
        raise ImageInputError(
            f"{path.name}: ElementType is {fields.get('ElementType', '')!r}: whole or real numbers "
            "are needed"
        )
    affine = _affine(path, fields, axes)
    check_affine(path.name, affine, (sizes[0], sizes[1], sizes[2]))
    name, skip = fields["ElementDataFile"], fields.get("HeaderSize", "0")
    data, start = (path, begin) if name.upper() == "LOCAL" else (data_file(path, name), 0)
    if skip != "0":
        start = -1 if skip == "-1" else whole(path, "HeaderSize", skip)

    def is_set(key: str, *, default: bool = False) -> bool:
        return fields.get(key, str(default)).lower() in {"true", "1"}

    packing = "zlib" if is_set("CompressedData") else ""
    if not is_set("BinaryData", default=True):
        packing = "text"
    orders = {is_set(key) for key in ORDER_KEYS if key in fields}
    if len(orders) > 1:
        raise ImageInputError(f"{path.name}: {' and '.join(ORDER_KEYS)} contradict each other")
    order = ">" if True in orders else "<"
    values, findings = stored_voxels(data, start, np.dtype(order + kind), sizes, packing)
    return values.reshape(values.shape[:3]), affine, findings


def _fields(path: Path) -> tuple[dict[str, str], int]:
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


def _affine(path: Path, fields: Mapping[str, str], axes: int) -> NDArray[np.float64]:
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
    return scale * np.column_stack([direction * spacing[:3], place[:3]])


# NRRD's encodings, as `stored_voxels` has them.
PACKINGS: Mapping[str, str] = {
    "raw": "", "gzip": "zlib", "gz": "zlib", "bzip2": "bzip2", "bz2": "bzip2", "hex": "hex",
    "text": "text", "txt": "text", "ascii": "text",
}  # fmt: skip
# NRRD's anatomical spaces: what takes each axis to L, P and S.
SPACES: Mapping[str, tuple[float, float, float]] = {
    **dict.fromkeys(("right-anterior-superior", "ras"), (-1.0, -1.0, 1.0)),
    **dict.fromkeys(("left-anterior-superior", "las"), (1.0, -1.0, 1.0)),
    **dict.fromkeys(("left-posterior-superior", "lps"), (1.0, 1.0, 1.0)),
}
TYPES: Mapping[str, str] = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(
        ("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"
    ),
    **dict.fromkeys(
        ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"
    ),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "long long int", "signed long long"), "i8"),
    **dict.fromkeys(("signed long long int", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int"), "u8"),
    **dict.fromkeys(("uint64", "uint64_t"), "u8"),
    "float": "f4", "double": "f8",
}  # fmt: skip
# NRRD axes that run through space; others hold the numbers of one voxel.
SPATIAL = frozenset({"domain", "space", "none", "???", "time"})
# NRRD fields of free text.
TEXTS = frozenset({"content", "data file", "datafile", "labels", "units", "sample units"})


def read_nrrd(path: Path) -> Read:
    """The image of a NRRD file."""
    fields, begin = nrrd_fields(path)
    kind = fields.get("type", "").lower()
    if kind not in TYPES:
        raise ImageInputError(f"{path.name}: type is {kind!r}: whole or real numbers are needed")
    axes = whole(path, "dimension", fields.get("dimension", ""))
    sizes = [whole(path, "sizes", text) for text in fields.get("sizes", "").split()]
    if len(sizes) != axes or not 1 <= axes <= 16:
        raise ImageInputError(f"{path.name}: dimension is {axes} and sizes are {sizes}")
    kinds = [k.lower() for k in fields.get("kinds", "").split()] or ["domain"] * axes
    components = [n for n, k in zip(sizes, kinds, strict=False) if k not in SPATIAL and n > 1]
    if components:
        check_shape(path.name, sizes[-3:], math.prod(components))
    check_shape(path.name, sizes)
    affine, findings = nrrd_affine(path, fields, axes)
    check_affine(path.name, affine, (sizes[0], sizes[1], sizes[2]))
    values, more = nrrd_voxels(path, fields, begin, sizes)
    return values.reshape(values.shape[:3]), affine, (*findings, *more)


def nrrd_fields(path: Path) -> tuple[dict[str, str], int]:
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
        if key not in TEXTS and re.search(rf"[0-9.eE+-]{{{MOST_DIGITS + 1},}}", value):
            raise ImageInputError(
                f"{path.name}: {key} has a number of more than {MOST_DIGITS} characters"
            )
        fields[{"datafile": "data file"}.get(key, key)] = value.strip()
    return fields, end


def nrrd_voxels(
    path: Path, fields: Mapping[str, str], begin: int, sizes: list[int]
) -> tuple[NDArray[Any], tuple[Finding, ...]]:
    """The voxels of a file, axes in the order of its sizes, and findings."""
    packing = PACKINGS.get(fields.get("encoding", "raw").lower())
    if packing is None:
        raise ImageInputError(
            f"{path.name}: encoding is {fields['encoding']!r}: use one of {', '.join(PACKINGS)}"
        )
    kind = TYPES[fields["type"].lower()]
    order = {"little": "<", "big": ">"}.get(fields.get("endian", "").lower())
    if order is None and kind[1] != "1" and packing != "text":
        raise ImageInputError(
            f"{path.name}: endian is {fields.get('endian', '')!r}: little or big is needed"
        )
    data, start = path, begin
    if "data file" in fields:
        data, start = data_file(path, fields["data file"]), 0
    if (lines := _skip(path, fields, "line skip")) > 0:
        with data.open("rb") as file:
            file.seek(start)
            for _ in range(min(lines, data.stat().st_size)):
                file.readline()
            start = file.tell()
    if (skip := _skip(path, fields, "byte skip")) and packing:
        raise ImageInputError(f"{path.name}: its voxels are packed: write byte skip: 0")
    start = -1 if skip < 0 else start + skip
    return stored_voxels(data, start, np.dtype((order or "=") + kind), sizes, packing)


def _skip(path: Path, fields: Mapping[str, str], key: str) -> int:
    """How many lines or bytes are passed over before the voxels; -1: they end with the file."""
    text = fields.get(key, fields.get(key.replace(" ", ""), "0"))
    return -1 if text == "-1" and key == "byte skip" else whole(path, key, text)


def nrrd_affine(
    path: Path, fields: Mapping[str, str], axes: int
) -> tuple[NDArray[np.float64], tuple[Finding, ...]]:
    """The map from index to LPS mm, (3, 4), and a finding where its frame is not stated."""
    signs = SPACES.get(fields.get("space", "").lower())
    rows = _vectors(path, "space directions", fields.get("space directions", ""))
    origin = _vectors(path, "space origin", fields.get("space origin", ""))
    for key in ("spacings", "axis mins", "axismins", "axis maxs", "axismaxs", "thicknesses"):
        for text in fields.get(key, "").split():
            if text.lower() != "nan":
                number(path, key, text)
    if signs is None:
        stated = f"its space is {fields['space']!r}" if "space" in fields else "it states no space"
        plain = _unstated_affine(path, fields, rows, origin)
        return plain, (unstated(path, stated, "space: left-posterior-superior"),)
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
        findings = (unstated(path, "it states no space origin", "space origin: (x,y,z)"),)
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
    return scale * np.array(signs)[:, None] * affine, findings


def _unstated_affine(
    path: Path,
    fields: Mapping[str, str],
    rows: list[list[float] | None],
    origin: list[list[float] | None],
) -> NDArray[np.float64]:
    """The map of a file that states no frame of the patient: along its own axes, as ITK has it."""
    texts = fields.get("spacings", "").split()[:3]
    spacing = [1.0 if text.lower() == "nan" else number(path, "spacings", text) for text in texts]
    affine = np.eye(3, 4)
    affine[:, :3] = np.diag([*spacing, 1.0, 1.0, 1.0][:3])
    vectors = [row for row in rows if row is not None]
    if len(vectors) == 3 and all(len(row) == 3 for row in vectors):
        affine[:, :3] = np.array(vectors).T
    if origin and origin[0] is not None and len(origin[0]) == 3:
        affine[:, 3] = origin[0]
    if lows := fields.get("axis mins", fields.get("axismins", "")).split()[:3]:
        if len(spacing) < 3 or vectors:
            raise ImageInputError(f"{path.name}: states axis mins without spacings: write them")
        nodes = [text == "node" for text in fields.get("centerings", "").lower().split()[:3]]
        nodes += [False] * (3 - len(nodes))
        # Between the borders of a cell lies its voxel.
        for axis, (low, node) in enumerate(zip(lows, nodes, strict=False)):
            affine[axis, 3] = number(path, "axis mins", low) + (0.0 if node else spacing[axis] / 2)
    return affine


def _vectors(path: Path, key: str, text: str) -> list[list[float] | None]:
    """The vectors "(1,0,0) none (0,1,0)" of a field."""
    return [
        None if part == "none" else [number(path, key, n) for n in part[1:-1].split(",")]
        for part in re.findall(r"\([^)]*\)|none", text)
    ]
