"""Segmentations: `.seg.nrrd` of 3D Slicer (labels in layers, with names), and label images."""

import gzip
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.files.reading_writing import check_readable
from cmfsim.io.images.image_files import read_image_file
from cmfsim.io.images.image_headers import check_shape, whole
from cmfsim.io.images.nifti import read_nifti
from cmfsim.io.images.nrrd import SPACES, TYPES, nrrd_affine, nrrd_fields, nrrd_voxels
from cmfsim.values.finding import Finding

MAX_SEGMENTS = 200
# Voxels of all layers, bytes in memory: those of a head CT in eight layers.
MAX_VOXELS = 2**31
# What Slicer states of each segment, one line each.
ABOUT = re.compile(rb"^Segment(\d{1,4})_(Name|LabelValue|Layer):=([^\r\n]*)", re.MULTILINE)
LAYER = re.compile(r"[0-9]{1,4}", re.ASCII)
# Kinds of axes in NRRD that may run through space.
SPATIAL_KINDS = frozenset({"domain", "space", "none", "???"})
# The largest label of the programs whose images are read (TotalSegmentator has 117).
MOST_LABEL = 255
# A CT has more values than this, or neighbours inside it that differ: noise.
FEW_VALUES, SAME_NEIGHBOURS = 40, 0.8
# Where nnU-Net states the names of the labels that it writes, next to them.
NAMES_FILE = "dataset.json"
MOST_NAMES = 1 << 20
# TotalSegmentator's names, in an extension of its NIfTI header.
LABEL_NAME = re.compile(rb'<Label\s[^>]*?Key="(\d{1,4})"[^>]*>(?:<!\[CDATA\[)?([^<\]]{1,100})')


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment: its name, its layer, and the label that it has there."""

    name: str
    layer: int
    label: int


@dataclass(frozen=True, eq=False)
class Segmentation:
    """The segments of a file; the affine (3, 4) leads from index (i, j, k, 1) to LPS, mm."""

    labels: NDArray[Any]
    affine: NDArray[np.float64]
    segments: tuple[Segment, ...]
    findings: tuple[Finding, ...] = ()

    def mask(self, segment: Segment) -> NDArray[np.bool_]:
        """Where a segment is, (nx, ny, nz)."""
        mask: NDArray[np.bool_] = self.labels[segment.layer] == segment.label
        return mask


def read_segmentation(path: Path) -> Segmentation:
    """The segments of a `.seg.nrrd` file, or the labels of a label image as segments."""
    check_readable(path, ImageInputError)
    with path.open("rb") as file:
        if not file.read(7).startswith(b"NRRD000"):
            raise ImageInputError(f"{path.name}: is not an NRRD file: save the segmentation again")
    fields, begin = nrrd_fields(path)
    sizes = [whole(path, "sizes", text) for text in fields.get("sizes", "").split()]
    if len(sizes) not in {3, 4}:
        raise ImageInputError(f"{path.name}: has {len(sizes)} axes: three, or four with layers")
    across = _layer_axis(path, fields) if len(sizes) == 4 else None
    shape = [size for axis, size in enumerate(sizes) if axis != across]
    n_layers = 1 if across is None else sizes[across]
    check_shape(path.name, shape)
    if not 1 <= n_layers <= MAX_SEGMENTS or math.prod(sizes) > MAX_VOXELS:
        raise ImageInputError(
            f"{path.name}: has {n_layers} layers of {math.prod(shape)} voxels: at most "
            f"{MAX_SEGMENTS} layers and {MAX_VOXELS} voxels are read"
        )
    kind = TYPES.get(fields.get("type", "").lower(), "")
    if not kind or kind[0] == "f" or kind[1] == "8":
        raise ImageInputError(f"{path.name}: type is {fields.get('type')!r}: labels are needed")
    affine, findings = nrrd_affine(path, fields, len(sizes))
    if fields.get("space", "").lower() not in SPACES:
        raise ImageInputError(f"{path.name}: states no space: save it from 3D Slicer again")
    if "data file" in fields:
        raise ImageInputError(
            f"{path.name}: its voxels are in another file: save it as one .seg.nrrd"
        )
    stored, more = nrrd_voxels(path, {"endian": "little", **fields}, begin, sizes)
    labels = stored[None] if across is None else np.moveaxis(stored, across, 0)
    with path.open("rb") as file:
        head = file.read(begin)
    return Segmentation(labels, affine, _segments(path, head, labels), (*findings, *more))


def are_labels(values: NDArray[Any]) -> bool:
    """Whether the values of an image are labels, and not those of a CT: whole, few, in regions."""
    low, high = values.min(), values.max()
    if low != 0 or not 0 < high <= MOST_LABEL:
        return False
    layers = values[:, :, :: max(1, values.shape[2] // 16)]
    if values.dtype.kind == "f" and (layers != np.rint(layers)).any():
        return False
    if len(np.unique(layers)) <= FEW_VALUES:
        return True
    is_inside = layers[1:] != 0
    same = (layers[1:] == layers[:-1])[is_inside]
    return same.size > 0 and float(same.mean()) > SAME_NEIGHBOURS


def read_labels(path: Path) -> Segmentation:
    """The labels of an image as segments; their names where the file, or nnU-Net, states them.

    One label alone is a mask, named after its file.
    """
    check_readable(path, ImageInputError)
    name = path.name.lower()
    if name.endswith(".nrrd"):
        return _named(path, read_segmentation(path))
    if name.endswith((".nii", ".nii.gz")):
        values, affine, findings = read_nifti(path)
    else:
        read = read_image_file(path)
        values, findings = read.image.values, read.findings
        if any(f.code == "image-oblique" for f in findings):
            raise ImageInputError(
                f"{path.name}: labels on a turned grid are read from NRRD and NIfTI: save it so"
            )
        affine = np.column_stack([np.diag(read.image.spacing), read.image.lowest])
    if not are_labels(values):
        raise ImageInputError(f"{path.name}: its values are not labels")
    labels = values.astype(np.uint8)[None]
    return _named(path, Segmentation(labels, affine, _segments(path, b"", labels), findings))


def _named(path: Path, read: Segmentation) -> Segmentation:
    """The segments with the names that the file, or the one of nnU-Net next to it, states."""
    if not all(segment.name == f"label {segment.label}" for segment in read.segments):
        return read
    if len(read.segments) == 1:
        names = {read.segments[0].label: path.name.partition(".")[0]}
    else:
        names = _names_inside(path) or _names_of_network(path.parent / NAMES_FILE)
    segments = tuple(Segment(names.get(s.label, s.name), s.layer, s.label) for s in read.segments)
    return Segmentation(read.labels, read.affine, segments, read.findings)


def _names_inside(path: Path) -> dict[int, str]:
    """Label names in the first bytes of a NIfTI file."""
    packed = path.name.lower().endswith(".gz")
    with gzip.open(path, "rb") if packed else path.open("rb") as file:
        begin = file.read(MOST_NAMES)
    return {
        int(key): name.decode("utf-8", "replace").strip() for key, name in LABEL_NAME.findall(begin)
    }


def _names_of_network(path: Path) -> dict[int, str]:
    """Label names in nnU-Net's description of its data: {"labels": {name: number}}."""
    try:
        if path.stat().st_size > MOST_NAMES:
            return {}
        labels = json.loads(path.read_bytes())["labels"]
        pairs = [
            (value, key) if isinstance(value, int) else (int(key), value)
            for key, value in labels.items()
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}
    return {number: name[:100] for number, name in pairs if isinstance(name, str)}


def _layer_axis(path: Path, fields: Mapping[str, str]) -> int:
    """The axis of the layers: the one of four without a direction, whatever its place.

    `kinds`, where it is stated, must say the same: "list", or another kind that is not of space.
    """
    directions = fields.get("space directions", "")
    rows = re.findall(r"\([^)]*\)|none", directions)
    without = [axis for axis, row in enumerate(rows) if row == "none"]
    kinds = fields.get("kinds", "").lower().split()
    lists = [axis for axis, kind in enumerate(kinds) if kind not in SPATIAL_KINDS]
    if len(without) != 1 or len(rows) != 4 or (lists and lists != without):
        raise ImageInputError(
            f"{path.name}: which of its four axes has the layers is not clear: space directions "
            f"are {directions!r}, kinds {fields.get('kinds', '')!r}; one axis needs the direction "
            '"none" and the kind "list"'
        )
    return without[0]


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
