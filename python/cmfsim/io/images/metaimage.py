"""Headers of MetaImage files, attached (.mha) and detached (.mhd)."""

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.images.image_headers import (
    LENGTHS,
    MOST_HEADER,
    MOST_PACKED,
    ImageHeader,
    PackedVoxels,
    check_affine,
    check_length,
    check_shape,
    data_file,
    number,
    whole,
)
from cmfsim.values.finding import Finding

BYTES: Mapping[str, int] = {
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
    each = BYTES.get(fields.get("ElementType", ""))
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
