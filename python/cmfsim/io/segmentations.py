"""Segmentations of 3D Slicer (`.seg.nrrd`): labels in layers, with a name for each segment."""

import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.files import check_readable
from cmfsim.io.image_headers import check_shape, whole
from cmfsim.io.nrrd import BYTES, nrrd_affine, nrrd_fields
from cmfsim.values.finding import Finding

__all__ = ["Segment", "Segmentation", "read_segmentation"]

MAX_SEGMENTS = 200
# Voxels of all layers, bytes in memory: those of a head CT in eight layers.
MAX_VOXELS = 2**31
LABEL_TYPES: Mapping[int, str] = {1: "u1", 2: "u2", 4: "u4"}
# What Slicer states of each segment, one line each.
ABOUT = re.compile(rb"^Segment(\d{1,4})_(Name|LabelValue|Layer):=([^\r\n]*)", re.MULTILINE)
LAYER = re.compile(r"[0-9]{1,4}", re.ASCII)
# zlib's number for a gzip stream.
GZIP = 31


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment: its name, its layer, and the label that it has there."""

    name: str
    layer: int
    label: int


@dataclass(frozen=True, eq=False)
class Segmentation:
    """The segments of a file.

    Attributes
    ----------
    labels : (layers, nx, ny, nz) array of whole numbers
    affine : (3, 4) float64, mm
        The map from index (i, j, k, 1) to LPS.
    segments : tuple of Segment
    findings : tuple of Finding
    """

    labels: NDArray[Any]
    affine: NDArray[np.float64]
    segments: tuple[Segment, ...]
    findings: tuple[Finding, ...] = ()

    def mask(self, segment: Segment) -> NDArray[np.bool_]:
        """Where a segment is, (nx, ny, nz)."""
        mask: NDArray[np.bool_] = self.labels[segment.layer] == segment.label
        return mask


def read_segmentation(path: Path) -> Segmentation:
    """The segments of a `.seg.nrrd` file, or the labels of a label image as segments.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    ImageError
        (also `ValueError`) Not NRRD, detached, cut short, real numbers; a layer that is not there.
    """
    check_readable(path, ImageInputError)
    with path.open("rb") as file:
        if not file.read(7).startswith(b"NRRD000"):
            raise ImageInputError(f"{path.name}: is not an NRRD file: save the segmentation again")
    fields, begin = nrrd_fields(path)
    sizes = [whole(path, "sizes", text) for text in fields.get("sizes", "").split()]
    if len(sizes) == 3:
        sizes = [1, *sizes]
    if len(sizes) != 4:
        raise ImageInputError(f"{path.name}: has {len(sizes)} axes: three, or four with layers")
    check_shape(path.name, sizes[1:])
    if not 1 <= sizes[0] <= MAX_SEGMENTS or math.prod(sizes) > MAX_VOXELS:
        raise ImageInputError(
            f"{path.name}: has {sizes[0]} layers of {math.prod(sizes[1:])} voxels: at most "
            f"{MAX_SEGMENTS} layers and {MAX_VOXELS} voxels are read"
        )
    width = BYTES.get(fields.get("type", "").lower(), 0)
    if width not in LABEL_TYPES or fields["type"].lower() in {"float", "double"}:
        raise ImageInputError(f"{path.name}: type is {fields.get('type')!r}: labels are needed")
    axes = len(fields["sizes"].split())
    affine, _, findings = nrrd_affine(path, fields, axes)
    if affine is None:
        raise ImageInputError(f"{path.name}: states no space: save it from 3D Slicer again")
    order = ">" if fields.get("endian", "little").lower() == "big" else "<"
    voxels = _voxels(path, fields, begin, math.prod(sizes) * width)
    labels = np.frombuffer(voxels, order + LABEL_TYPES[width]).reshape(sizes, order="F")
    with path.open("rb") as file:
        head = file.read(begin)
    return Segmentation(labels, affine, _segments(path, head, labels), findings)


def _voxels(path: Path, fields: Mapping[str, str], begin: int, needed: int) -> bytes:
    packing = fields.get("encoding", "raw").lower()
    if "data file" in fields or packing not in {"raw", "gzip", "gz"}:
        raise ImageInputError(
            f"{path.name}: its voxels are in another file, or packed as {packing!r}: save it as "
            "one .seg.nrrd"
        )
    with path.open("rb") as file:
        file.seek(begin)
        raw = file.read()
    if packing != "raw":
        raw = _unpacked(path, raw, needed)
    if len(raw) != needed:
        what = "is cut short" if len(raw) < needed else "is longer than its header states"
        raise ImageInputError(f"{path.name}: {what}: {len(raw)} of {needed} bytes of voxels")
    return raw


def _unpacked(path: Path, raw: bytes, needed: int) -> bytes:
    """The voxels of a gzip stream, whose checksum stands at its end."""
    unpacker = zlib.decompressobj(GZIP)
    try:
        voxels = unpacker.decompress(raw, needed + 1)
        if len(voxels) == needed and not unpacker.eof:
            voxels += unpacker.decompress(unpacker.unconsumed_tail, 1)
    except zlib.error as error:
        raise ImageInputError(f"{path.name}: is damaged ({error}): copy it again") from error
    if len(voxels) == needed and not unpacker.eof:
        raise ImageInputError(f"{path.name}: is cut short: its packed voxels do not end")
    return voxels


def _segments(path: Path, head: bytes, labels: NDArray[Any]) -> tuple[Segment, ...]:
    about: dict[int, dict[bytes, str]] = {}
    for number, key, value in ABOUT.findall(head):
        about.setdefault(int(number), {})[key] = value.decode("utf-8", "replace").strip()
    if not about:
        present = [int(label) for label in np.unique(labels) if label]
        about = {n: {b"LabelValue": str(label)} for n, label in enumerate(present)}
    if len(about) > MAX_SEGMENTS:
        raise ImageInputError(
            f"{path.name}: has {len(about)} segments or labels: at most {MAX_SEGMENTS} are read; "
            "is it a CT?"
        )
    found = []
    for number, said in sorted(about.items()):
        label = whole(path, f"Segment{number}_LabelValue", said.get(b"LabelValue", str(number + 1)))
        text = said.get(b"Layer", "0")
        layer = int(text) if LAYER.fullmatch(text) else -1
        if not 0 <= layer < len(labels):
            raise ImageInputError(
                f"{path.name}: Segment{number}_Layer is {said.get(b'Layer')!r}: there are "
                f"{len(labels)} layers"
            )
        found.append(Segment(said.get(b"Name", f"label {label}"), layer, label))
    return tuple(found)
