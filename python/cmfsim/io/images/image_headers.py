"""Shared checks of image headers: numbers, sizes, positions and names.

A header may crash or mislead a reader: numbers of a thousand digits, infinite places, sizes beyond
any memory, data files in other folders, sheared axes that are silently made orthogonal. Each format
has its own file beside this one.
"""

import bz2
import math
import os
import re
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.files.reading_writing import check_readable, is_below
from cmfsim.io.files.texts import real_numbers, whole_numbers
from cmfsim.values.finding import Finding

# Larger images are refused before memory is taken, voxels: 1024 × 1024 × 2000.
MOST_VOXELS = 2_100_000_000
# Longer text headers are none, bytes: those of scanners' exports have some 20 kB.
MOST_HEADER = 1 << 20
# Longer numbers stand in no header, characters: ITK's reader crashes at a thousand.
MOST_DIGITS = 40
# Characters of a name that an error repeats.
MOST_SHOWN = 80
# Sizes, spacings and places beyond these are no head's: voxels along an axis, mm.
MOST_ALONG = 100_000
FARTHEST = 1e6
# Deflate cannot pack more tightly than this.
MOST_PACKED = 1032
# Bytes that are read or unpacked at once.
CHUNK = 1 << 20
LENGTHS: Mapping[str, float] = {
    "mm": 1.0, "millimeter": 1.0, "millimetre": 1.0, "millimeters": 1.0, "cm": 10.0, "m": 1000.0,
    "um": 0.001, "µm": 0.001, "micron": 0.001,
}  # fmt: skip
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?")
_WHOLE = re.compile(r"\d{1,18}")
KNOWN = "NRRD, NIfTI, MetaImage or DICOM is needed"


def check_shape(name: str, size: list[int], components: int = 1) -> None:
    """Refuses what is no volume of one number per voxel."""
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


def check_memory(name: str, needed: int) -> None:
    """Refuses voxels for which, and for one copy, this machine has no memory; the system, if asked.

    A few MB may unpack to more than that, and the system would end the process.

    needed: Bytes.
    """
    try:
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # Windows
        return
    if 2 * needed > there:
        raise ImageInputError(
            f"{name}: has {needed} bytes of voxels, and this machine {there} of memory, of which "
            "twice as many are needed: crop the image, or save it with larger voxels"
        )


def stored_voxels(
    data: Path, start: int, dtype: np.dtype[Any], sizes: Sequence[int], packing: str = ""
) -> tuple[NDArray[Any], tuple[Finding, ...]]:
    """The voxels of a file, the first axis the fastest, and a finding on bytes after them.

    start: Where the voxels begin; -1 where they end with the file.
    packing: "zlib" (gzip too), "bzip2", "hex" or "text"; empty where they are not packed.
    """
    needed, layer = (math.prod(n) * dtype.itemsize for n in (sizes, sizes[:2]))
    there, left = data.stat().st_size, 0
    check_memory(data.name, needed)
    with data.open("rb") as file:
        file.seek(max(0, there - needed) if start < 0 else start)
        if packing in {"zlib", "bzip2"}:
            raw: bytes | bytearray
            raw, left = _unpacked(data.name, file, needed + layer, packing)
        else:
            raw = _plain(data.name, file.read(-1 if packing else needed + layer), packing, dtype)
    found = len(raw)
    if not 0 <= found - needed < layer:
        what = "is cut short" if found < needed else "is longer than its header states"
        raise ImageInputError(
            f"{data.name}: {what}: {found} of {needed} bytes of voxels; copy it again"
        )
    voxels = np.frombuffer(raw, dtype, math.prod(sizes)).reshape(tuple(sizes), order="F")
    left += found - needed
    what = f"{left} bytes after its voxels were ignored: they are no slice that its header misses"
    findings = (Finding("field-ignored", what, where=data.name),) if left else ()
    return voxels.astype(dtype.newbyteorder("="), copy=False), findings


def _plain(name: str, raw: bytes, packing: str, dtype: np.dtype[Any]) -> bytes:
    """The bytes of voxels that are written as such, as hexadecimal digits or as words."""
    if not packing:
        return raw
    try:
        if packing == "hex":
            return bytes.fromhex(raw.decode("ascii"))
        read = real_numbers if dtype.kind == "f" else whole_numbers
        # Of a list, numpy refuses whole numbers that the type does not hold.
        values: list[Any] = read(raw.split(), "voxel {}".format).tolist()
        return np.array(values, dtype).tobytes()
    except (ValueError, OverflowError) as error:
        raise ImageInputError(f"{name}: its voxels are damaged ({error}); copy it again") from error


def _unpacked(name: str, file: BinaryIO, most: int, packing: str) -> tuple[bytearray, int]:
    """The voxels in the rest of a packed file, or a few above `most`; bytes after their end."""
    bzip2 = packing == "bzip2"
    # zlib tells its two forms apart.
    reader: Any = bz2.BZ2Decompressor() if bzip2 else zlib.decompressobj(zlib.MAX_WBITS + 32)
    found = bytearray()
    try:
        while not reader.eof and len(found) < most and (block := file.read(CHUNK)):
            # Unpacked by pieces: a block of zeros alone would take a thousand times its size.
            while block and not reader.eof and len(found) < most:
                found += reader.decompress(block, CHUNK)
                block = b"" if bzip2 else reader.unconsumed_tail
            while bzip2 and not (reader.eof or reader.needs_input) and len(found) < most:
                found += reader.decompress(b"", CHUNK)
        left = len(reader.unused_data) + len(file.read(CHUNK))
    except (OSError, zlib.error) as error:
        raise ImageInputError(
            f"{name}: its voxels are damaged ({error}); copy the file again"
        ) from error
    if len(found) < most and not reader.eof:
        raise ImageInputError(
            f"{name}: is cut short: its voxels are compressed, and the file ends before them; "
            "copy it again"
        )
    return found, left if reader.eof else 0


def data_file(path: Path, name: str) -> Path:
    """The file beside a header that holds its voxels."""
    how = (
        "a header may refer to one file next to it or below; save the image as one file (.nrrd, "
        ".mha, .nii.gz)"
    )
    shown = name if len(name) <= MOST_SHOWN else f"{name[:MOST_SHOWN]}…"
    if name.split(maxsplit=1)[:1] == ["LIST"] or "%" in name or "\0" in name or not name:
        raise ImageInputError(f"{path.name}: its data file is {shown!r}: {how}")
    given = Path(name)
    if given.is_absolute() or ".." in given.parts or "\\" in name or ":" in name:
        raise ImageInputError(f"{path.name}: its data file {shown!r} is in another folder: {how}")
    data = path.parent / given
    if not is_below(data, path.parent):
        raise ImageInputError(
            f"{path.name}: its data file {shown!r} is a link that points outside the folder: {how}"
        )
    try:
        check_readable(data, ImageInputError)
    except FileNotFoundError as error:
        raise ImageInputError(
            f"{path.name}: its data file {shown!r} does not exist next to it: copy both"
        ) from error
    except ImageInputError as error:
        raise ImageInputError(f"{path.name}: its data file {shown!r}: {error}") from error
    return data


def unstated(path: Path, stated: str, how: str) -> Finding:
    """A finding on a file that does not state its frame, and how it would."""
    return Finding(
        "frame-unstated",
        f"{stated}: its axes were assumed to be left, posterior and superior",
        severity="warning",
        where=path.name,
        why="if this is wrong, left and right of the face are swapped, or front and back; left "
        "and right cannot be recognised in an image",
        fix=f"export the image again with its orientation ({how}), and check left and right",
    )


def apart(a: NDArray[np.float64], b: NDArray[np.float64], size: tuple[int, int, int]) -> float:
    """How far two maps of an image lie apart at its corners."""
    corners = np.array(
        [[(c >> axis & 1) * (size[axis] - 1.0) for axis in range(3)] + [1.0] for c in range(8)]
    )
    return float(np.linalg.norm(corners @ (a - b).T, axis=1).max())


def whole(path: Path, key: str, text: str) -> int:
    """A whole number of a header, not below 0."""
    if not _WHOLE.fullmatch(text.strip()):
        raise ImageInputError(f"{path.name}: {key} is {text[:MOST_DIGITS]!r}: not a whole number")
    return int(text)


def number(path: Path, key: str, text: str) -> float:
    """A finite number of a header."""
    text = text.strip()
    if len(text) > MOST_DIGITS or not _NUMBER.fullmatch(text):
        raise ImageInputError(f"{path.name}: {key} has {text[:MOST_DIGITS]!r}: not a finite number")
    value = float(text)
    if abs(value) > FARTHEST:
        raise ImageInputError(f"{path.name}: {key} has {value:g}: no head is that large or so far")
    return value


def check_affine(name: str, affine: NDArray[np.float64], size: tuple[int, int, int]) -> None:
    """Refuses a map from index to place whose axes span no space, or that leads too far."""
    lengths = np.linalg.norm(affine[:, :3], axis=0)
    if not (lengths > 0.0).all():
        raise ImageInputError(f"{name}: spacing is {lengths.tolist()} mm: must be above 0")
    volume = abs(float(np.linalg.det(affine[:, :3] / lengths)))
    # Axes of a scan tilted by 30° span 0.87; below a half they nearly lie in one plane.
    if volume < 0.5:
        raise ImageInputError(
            f"{name}: direction {(affine[:, :3] / lengths).round(4).tolist()} is not a set of axes "
            f"in space (they span {volume:.2g} of a cube)"
        )
    farthest = float(np.abs(affine[:, 3]).max() + (lengths * np.array(size)).max())
    if farthest > FARTHEST:
        raise ImageInputError(f"{name}: reaches {farthest:g} mm from the origin: no head does")
