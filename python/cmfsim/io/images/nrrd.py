"""Headers of NRRD (.nrrd, .nhdr) and MetaImage (.mha, .mhd), with their data or next to them."""

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.images.image_headers import (
    LENGTHS,
    MOST_DIGITS,
    MOST_HEADER,
    MOST_PACKED,
    ImageHeader,
    PackedVoxels,
    check_affine,
    check_length,
    check_shape,
    data_file,
    number,
    unstated,
    whole,
)
from cmfsim.values.finding import Finding

MET_BYTES: Mapping[str, int] = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4,
    "MET_LONG": 8, "MET_ULONG": 8, "MET_LONG_LONG": 8, "MET_ULONG_LONG": 8, "MET_FLOAT": 4,
    "MET_DOUBLE": 8,
}  # fmt: skip


def is_meta(begin: bytes) -> bool:
    """Whether the first bytes of a file are those of a MetaImage header."""
    line = begin.split(b"\n", 1)[0]
    return bool(re.match(rb"\s*(ObjectType|NDims|Comment|ObjectSubType)\s*=", line))


def meta_header(path: Path) -> ImageHeader:
    """The checked header of a MetaImage file.

    Raises `ImageError`: Something impossible is stated, or a data file elsewhere.
    """
    fields, begin = _fields(path)
    axes = whole(path, "NDims", fields.get("NDims", ""))
    sizes = [whole(path, "DimSize", text) for text in fields.get("DimSize", "").split()]
    if len(sizes) != axes or not 1 <= axes <= 10:
        raise ImageInputError(f"{path.name}: NDims is {axes} and DimSize {sizes}")
    channels = whole(path, "ElementNumberOfChannels", fields.get("ElementNumberOfChannels", "1"))
    check_shape(path.name, sizes, channels)
    each = MET_BYTES.get(fields.get("ElementType", ""))
    if each is None:
        raise ImageInputError(
            f"{path.name}: ElementType is {fields.get('ElementType', '')!r}: whole or real numbers "
            "are needed"
        )
    needed = math.prod(sizes) * each
    name = fields["ElementDataFile"]
    data, start = path, begin
    if name.upper() != "LOCAL":
        data, start = data_file(path, name), 0
    packed = fields.get("CompressedData", "False").lower() in {"true", "1"}
    findings: tuple[Finding, ...] = ()
    if fields.get("HeaderSize", "0") == "0":
        layer = sizes[0] * sizes[1] * each
        findings = check_length(data, start, needed, layer, "zlib" if packed else "")
    elif (found := data.stat().st_size - start) * (MOST_PACKED if packed else 1) < needed:
        raise ImageInputError(
            f"{data.name}: is cut short: {found} of {needed} bytes; copy it again"
        )
    unpacked = None
    if packed and data == path and "CompressedDataSize" not in fields:
        # ITK would take the header for the begin of the voxels.
        unpacked = _unpacked(path, start)
    size = (sizes[0], sizes[1], sizes[2])
    affine, scaled = _affine(path, fields, axes)
    check_affine(path.name, affine, size)
    return ImageHeader("MetaImageIO", size, affine, needed, scaled, findings, unpacked)


def _unpacked(path: Path, start: int) -> PackedVoxels:
    """The voxels of a file, and its header without their packing."""
    with path.open("rb") as file:
        text = file.read(start)
    header = re.sub(rb"(?m)^\s*CompressedData\s*=.*$", b"CompressedData = False", text)
    return PackedVoxels(header, path, start, "zlib")


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


def _affine(path: Path, fields: Mapping[str, str], axes: int) -> tuple[NDArray[np.float64], bool]:
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


# NRRD's encodings whose length is known beforehand; text and hexadecimal are ITK's to read.
PACKINGS: Mapping[str, str] = {
    "raw": "", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2",
}  # fmt: skip
# NRRD's anatomical spaces: what takes each axis to L, P and S.
SPACES: Mapping[str, tuple[float, float, float]] = {
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "ras": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
    "las": (1.0, -1.0, 1.0),
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "lps": (1.0, 1.0, 1.0),
}
BYTES: Mapping[str, int] = {
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
SPATIAL = frozenset({"domain", "space", "none", "???", "time"})
# NRRD fields of free text.
TEXTS = frozenset({"content", "data file", "datafile", "labels", "units", "sample units"})


def nrrd_header(path: Path) -> ImageHeader:
    """The checked header of a NRRD file.

    Raises `ImageError`: Something impossible is stated, or a data file elsewhere.
    """
    fields, begin = nrrd_fields(path)
    kind = fields.get("type", "").lower()
    each = BYTES.get(kind)
    if each is None:
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
    more = _check_data(path, fields, begin, (math.prod(sizes) * each, math.prod(sizes[:2]) * each))
    affine, scaled, findings = nrrd_affine(path, fields, axes)
    # ITK's reader has no bzip2.
    packed = _packed(path, fields, begin) if _packing(fields) == "bzip2" else None
    size = (sizes[0], sizes[1], sizes[2])
    if affine is not None:
        check_affine(path.name, affine, size)
    n_bytes = math.prod(sizes) * each
    return ImageHeader("NrrdImageIO", size, affine, n_bytes, scaled, (*findings, *more), packed)


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


def _packing(fields: Mapping[str, str]) -> str | None:
    return PACKINGS.get(fields.get("encoding", "raw").lower())


def _packed(path: Path, fields: Mapping[str, str], begin: int) -> PackedVoxels:
    """The voxels of a file, and its header without their packing."""
    with path.open("rb") as file:
        text = file.read(begin)
    text = re.sub(rb"(?im)^(encoding|data ?file): .*\n?", b"", text).rstrip()
    data, start = path, begin
    if "data file" in fields:
        data, start = data_file(path, fields["data file"]), 0
    return PackedVoxels(text + b"\nencoding: raw\n\n", data, start, "bzip2")


def _check_data(
    path: Path, fields: Mapping[str, str], begin: int, lengths: tuple[int, int]
) -> tuple[Finding, ...]:
    """Refuses too few bytes of voxels; `lengths` are those of all, and of one slice."""
    needed, layer = lengths
    skips = False
    for key in ("byte skip", "byteskip", "line skip", "lineskip"):
        if fields.get(key, "0") != "0":
            skips = True
            if fields[key] != "-1":
                whole(path, key, fields[key])
    data, start = path, begin
    if "data file" in fields:
        data, start = data_file(path, fields["data file"]), 0
    packing = _packing(fields)
    if packing is not None and not skips:
        return check_length(data, start, needed, layer, packing)
    if packing == "" and data.stat().st_size - start < needed:
        raise ImageInputError(
            f"{data.name}: is cut short: {data.stat().st_size - start} of {needed} bytes; copy it "
            "again"
        )
    return ()


def nrrd_affine(
    path: Path, fields: Mapping[str, str], axes: int
) -> tuple[NDArray[np.float64] | None, bool, tuple[Finding, ...]]:
    """The map from index to LPS mm, (3, 4), if it is stated; whether in mm already; findings."""
    signs = SPACES.get(fields.get("space", "").lower())
    rows = _vectors(path, "space directions", fields.get("space directions", ""))
    origin = _vectors(path, "space origin", fields.get("space origin", ""))
    for key in ("spacings", "axis mins", "axismins", "axis maxs", "axismaxs", "thicknesses"):
        for text in fields.get(key, "").split():
            if text.lower() != "nan":
                number(path, key, text)
    if signs is None:
        stated = f"its space is {fields['space']!r}" if "space" in fields else "it states no space"
        return None, False, (unstated(path, stated, "space: left-posterior-superior"),)
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
    return scale * np.array(signs)[:, None] * affine, scale != 1.0, findings


def _vectors(path: Path, key: str, text: str) -> list[list[float] | None]:
    """The vectors "(1,0,0) none (0,1,0)" of a field."""
    found: list[list[float] | None] = []
    for part in re.findall(r"\([^)]*\)|none", text):
        if part == "none":
            found.append(None)
        else:
            found.append([number(path, key, n) for n in part[1:-1].split(",")])
    return found
