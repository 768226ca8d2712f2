"""Headers of DICOM files: the few elements that place a slice, read by this module's own code.

Only what stands before the pixels is read. Nested sequences are read as well, for the frames of an
enhanced multi-frame image are placed there. Pixels are decoded elsewhere, by a third-party reader.
"""

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError

# Pixels whose lowest value is shown white (PS3.3 C.7.6.3.1), and the element that states it.
SHOWN_INVERTED = "MONOCHROME1"
INVERTED = re.compile(
    rb"((?:\x28\0\x04\0|\0\x28\0\x04)(?:CS..|\x0c\0\0\0|\0\0\0\x0c))MONOCHROME1", re.DOTALL
)
# Elements that are kept, by their tag.
NAMES: Mapping[int, str] = {
    0x00020010: "transfer_syntax", 0x00041220: "directory_records", 0x00080008: "image_type",
    0x00080016: "sop_class", 0x00080022: "acquisition_date", 0x00080032: "acquisition_time",
    0x00080060: "modality", 0x0008103E: "series_description", 0x00100020: "patient_id",
    0x00180050: "thickness", 0x00180088: "slice_spacing", 0x00181120: "gantry_tilt",
    0x0020000D: "study_uid", 0x0020000E: "series_uid", 0x00200011: "series_number",
    0x00200012: "acquisition_number", 0x00200013: "instance_number", 0x00200032: "position",
    0x00200037: "orientation", 0x00200052: "frame_of_reference", 0x00280002: "samples",
    0x00280004: "photometric", 0x00280008: "n_frames", 0x00280010: "rows", 0x00280011: "columns",
    0x00280030: "pixel_spacing", 0x00280100: "bits", 0x00281052: "intercept", 0x00281053: "slope",
    0x00281054: "rescale_type", 0x3004000C: "frame_offsets",
}  # fmt: skip
# Sequences that are read, and what is in them.
SEQUENCES: Mapping[int, str] = {
    0x52009229: "shared", 0x52009230: "per_frame", 0x00209111: "content",
    0x00209113: "plane_position", 0x00209116: "plane_orientation", 0x00289110: "pixel_measures",
    0x00289145: "value_transformation",
}  # fmt: skip
# Whole numbers of 16 bits in binary; all others are text.
BINARY = frozenset({"samples", "rows", "columns", "bits"})
PIXELS = 0x7FE00010
FLOAT_PIXELS = frozenset({0x7FE00008, 0x7FE00009})
ITEM, ITEM_END, SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
UNDEFINED = 0xFFFFFFFF
# Value representations whose length takes four bytes, after two that are reserved.
LONG = frozenset((b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"))  # fmt: skip # noqa: E501
# All value representations.
KINDS = LONG | frozenset(
    re.findall(rb"[A-Z]{2}", b"AE AS AT CS DA DS DT FD FL IS LO LT PN SH SL SS ST TM UI UL US")
)
EXPLICIT_BIG, DEFLATED, IMPLICIT = "1.2.840.10008.1.2.2", "1.2.840.10008.1.2.1.99", "1.2.840.10008.1.2"  # fmt: skip # noqa: E501
PREAMBLE = 128
# The group that states how all others are written.
META_GROUP = 2
# Longer values are none that is kept, bytes; deeper nesting and more elements are no image's.
MOST_VALUE = 2**16
MOST_DEPTH = 16
MOST_ELEMENTS = 3_000_000

Tags = Mapping[str, str | int]


@dataclass(frozen=True)
class DicomHeader:
    """What a DICOM file states before its pixels.

    tags: By name; absent where the file does not state it.
    frames: What an enhanced multi-frame image states of each frame, in the order of its pixels.
    odd: The first byte of each private element of no known kind, and that after its last.
    """

    path: Path
    tags: Tags
    has_pixels: bool = False
    frames: tuple[Tags, ...] = ()
    odd: tuple[tuple[int, int], ...] = ()

    def for_reader(self) -> bytes | None:
        """The file as ITK reads it rightly; None if it does so as it is.

        Private elements of no known kind, which not all readers pass, are left out. Pixels that
        are shown inverted would be inverted, although that does not concern their values in HU.
        """
        inverted = self.text("photometric") == SHOWN_INVERTED
        if not (self.odd or inverted):
            return None
        data, ends = self.path.read_bytes(), [0, *(end for _, end in self.odd)]
        starts = [*(start for start, _ in self.odd), len(data)]
        data = b"".join(data[a:b] for a, b in zip(ends, starts, strict=True))
        if not inverted:
            return data
        data, count = INVERTED.subn(rb"\1MONOCHROME2", data, count=1)
        if not count:
            raise ImageInputError(
                f"{self.path.name}: {SHOWN_INVERTED} is not found where it is stated: export the "
                "series again"
            )
        return data

    @property
    def count(self) -> int:
        """How many frames its pixels have, as far as it states that."""
        stated = numbers_of(self.text("n_frames") or "1", 1)
        return 1 if stated is None else max(1, int(stated[0]))

    def text(self, name: str) -> str:
        """A value as text; empty where the file does not state it."""
        return str(self.tags.get(name, ""))

    def numbers(self, name: str, count: int) -> NDArray[np.float64] | None:
        """The finite numbers of a value; None where the file states something else."""
        return numbers_of(self.text(name), count)


@dataclass
class _Found:
    """What one data set holds so far."""

    tags: dict[str, str | int] = field(default_factory=dict)
    sequences: dict[str, list["_Found"]] = field(default_factory=dict)


def numbers_of(text: str, count: int) -> NDArray[np.float64] | None:
    r"""The finite numbers of a text "1\2\3"; None where it holds something else."""
    try:
        values = np.array([float(v) for v in text.split("\\")])
    except ValueError:
        return None
    return values if values.shape == (count,) and np.isfinite(values).all() else None


def dicom_header(path: Path) -> DicomHeader | None:
    """What a DICOM file states; None where the file is no DICOM.

    Raises `ImageError`: A DICOM file that is cut short, damaged or packed as a whole.
    """
    with path.open("rb") as stream:
        begin = stream.read(PREAMBLE + 4)
        marked = begin[PREAMBLE:] == b"DICM"
        if not marked:
            if not _bare(begin):
                return None
            stream.seek(0)
        try:
            return _Reader(path, stream).header()
        except (EOFError, struct.error, ValueError) as error:
            if not marked:
                return None
            if isinstance(error, ImageInputError):
                raise
            raise ImageInputError(
                f"{path.name}: is cut short or damaged ({error}); copy it again"
            ) from error


def _bare(begin: bytes) -> bool:
    """Whether a file without preamble begins as an old DICOM data set does."""
    if len(begin) < 8:
        return False
    group, element, length = struct.unpack("<HHI", begin[:8])
    explicit = begin[4:6].isalpha() and begin[4:6].isupper()
    return group in {2, 8} and element <= 0x60 and (explicit or length < MOST_VALUE)


class _Reader:
    """Walks through the elements of one file."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path = path
        self.stream = stream
        self.size = path.stat().st_size
        self.order = "<"
        self.explicit = True
        self.elements = 0
        self.pixels: int | None = None
        self.depth = 0
        self.odd: list[tuple[int, int]] = []

    def header(self) -> DicomHeader:
        found = _Found()
        begin = self.stream.tell()
        first = self.stream.read(8)
        self.stream.seek(begin)
        if len(first) == 8 and struct.unpack("<H", first[:2])[0] == META_GROUP:
            self._data_set(found, self.size, 0, stop_after_meta=True)
            syntax = str(found.tags.get("transfer_syntax", ""))
            if syntax == DEFLATED:
                raise ImageInputError(
                    f"{self.path.name}: is compressed as a whole (deflated transfer syntax): "
                    "export it uncompressed"
                )
            self.order = ">" if syntax == EXPLICIT_BIG else "<"
            self.explicit = syntax != IMPLICIT
        else:
            self.explicit = first[4:6].isalpha()
        self._data_set(found, self.size, 0)
        self._check_pixels(found)
        # What all frames share, and what each states itself.
        shared = _flat(found.sequences.get("shared", []))
        each = found.sequences.get("per_frame", [])
        frames = tuple({**shared, **_flat([item])} for item in each)
        has_pixels = self.pixels is not None
        return DicomHeader(self.path, found.tags, has_pixels, frames, tuple(self.odd))

    def _data_set(
        self, found: _Found, end: int, depth: int, *, stop_after_meta: bool = False
    ) -> None:
        """Reads elements until an end, an end mark, or the pixels."""
        if depth > MOST_DEPTH:
            message = f"sequences are nested deeper than {MOST_DEPTH}"
            raise ValueError(message)
        while self.stream.tell() < end:
            if stop_after_meta and self._next_group() != META_GROUP:
                return
            self.depth = depth
            tag, kind, length = self._element()
            if tag in {ITEM_END, SEQUENCE_END}:
                return
            if (tag == PIXELS or tag in FLOAT_PIXELS) and depth == 0:
                self.pixels = length
                return
            if kind == b"SQ" or length == UNDEFINED:
                explicit = self.explicit
                # A sequence of unknown kind is written without kinds inside.
                self.explicit = explicit and kind != b"UN"
                self._sequence(found, tag, length, depth)
                self.explicit = explicit
                continue
            if length > self.size - self.stream.tell():
                message = f"element {tag:08x} has {length} bytes, more than are left"
                raise EOFError(message)
            name = NAMES.get(tag)
            if name is None or length > MOST_VALUE:
                self.stream.seek(length, 1)
            else:
                found.tags[name] = self._value(name, self._bytes(length))

    def _next_group(self) -> int:
        """The group of the element to come: what follows the first group has another encoding."""
        group = self._bytes(2)
        self.stream.seek(-2, 1)
        return int(struct.unpack("<H", group)[0])

    def _element(self) -> tuple[int, bytes, int]:
        """Tag, value representation (empty where it is not stated) and length of an element."""
        self.elements += 1
        if self.elements > MOST_ELEMENTS:
            message = f"more than {MOST_ELEMENTS} elements"
            raise ValueError(message)
        head = self._bytes(8)
        group, element = struct.unpack(f"{self.order}HH", head[:4])
        tag = group << 16 | element
        if not self.explicit or group == 0xFFFE:
            return tag, b"SQ" if tag in SEQUENCES else b"", self._long(head[4:])
        kind = head[4:6]
        if kind in LONG:
            return tag, kind, self._long(self._bytes(4))
        if not kind.isalpha():
            return tag, b"UN", self._length_of_no_kind(tag, head)
        return tag, kind, struct.unpack(f"{self.order}H", head[6:])[0]

    def _length_of_no_kind(self, tag: int, head: bytes) -> int:
        """The length of an element whose kind is none, if what follows it shows which it is.

        Such elements are private ones, that no reader needs. Programs write their lengths in two
        bytes, in four, or as where no kind is stated.
        """
        begin = self.stream.tell()
        if tag >> 16 & 1 and len(more := self.stream.read(4)) == 4:
            (short,) = struct.unpack(f"{self.order}H", head[6:])
            starts = (begin, short), (begin, self._long(head[4:])), (begin + 4, self._long(more))
            for start, length in starts:
                if self._is_followed(tag, start + length):
                    self.stream.seek(start)
                    if self.depth == 0:
                        self.odd.append((begin - 8, start + length))
                    return length
        raise ImageInputError(
            f"{self.path.name}: its element {tag >> 16:04x},{tag & 0xFFFF:04x} has no known value "
            "representation (VR), and what follows it is not found: rewrite the files with a DICOM "
            "converter (such as gdcmconv or dcmconv), or export the series again"
        )

    def _is_followed(self, tag: int, place: int) -> bool:
        """Whether a place is that of an element after this one, of a known kind."""
        if place + 8 > self.size:
            return False
        self.stream.seek(place)
        head = self.stream.read(8)
        group, element = struct.unpack(f"{self.order}HH", head[:4])
        return group << 16 | element > tag and head[4:6] in KINDS

    def _sequence(self, found: _Found, tag: int, length: int, depth: int) -> None:
        """Reads the items of a sequence, or passes over it."""
        begin = self.stream.tell()
        name = SEQUENCES.get(tag)
        if length != UNDEFINED:
            if length > self.size - begin:
                message = f"sequence {tag:08x} has {length} bytes, more than are left"
                raise EOFError(message)
            if name is None:
                self.stream.seek(length, 1)
                return
        end = self.size if length == UNDEFINED else begin + length
        items = found.sequences.setdefault(name or "", [])
        while self.stream.tell() < end:
            mark, _, size = self._element()
            if mark == SEQUENCE_END:
                return
            if mark != ITEM:
                message = f"sequence {tag:08x} holds {mark:08x} in place of an item"
                raise ValueError(message)
            item = _Found()
            stop = self.size if size == UNDEFINED else self.stream.tell() + size
            if name is None and size != UNDEFINED:
                self.stream.seek(min(stop, self.size))
                continue
            self._data_set(item, min(stop, self.size), depth + 1)
            if name is not None:
                items.append(item)

    def _value(self, name: str, data: bytes) -> str | int:
        if name in BINARY:
            if len(data) < 2:
                message = f"{name} is empty"
                raise ValueError(message)
            return int(struct.unpack(f"{self.order}H", data[:2])[0])
        return data.decode("latin-1").strip("\0 ")

    def _long(self, data: bytes) -> int:
        return int(struct.unpack(f"{self.order}I", data)[0])

    def _bytes(self, count: int) -> bytes:
        data = self.stream.read(count)
        if len(data) < count:
            message = f"it ends at byte {self.size}"
            raise EOFError(message)
        return data

    def _check_pixels(self, found: _Found) -> None:
        """Refuses a file that holds fewer pixels than it states: readers give zeros for them."""
        if self.pixels is None or self.pixels == UNDEFINED:
            return
        left = self.size - self.stream.tell()
        tags = found.tags
        needed = self.pixels
        if all(name in tags for name in ("rows", "columns", "bits")):
            frames = numbers_of(str(tags.get("n_frames", "") or "1"), 1)
            each = int(tags["rows"]) * int(tags["columns"]) * int(tags.get("samples", 1))
            needed = each * (int(tags["bits"]) // 8) * (1 if frames is None else int(frames[0]))
        if left < needed:
            message = f"{left} of {needed} bytes of pixels"
            raise EOFError(message)


def _flat(items: list[_Found]) -> dict[str, str | int]:
    tags: dict[str, str | int] = {}
    for item in items:
        tags |= item.tags
        for inner in item.sequences.values():
            tags |= _flat(inner)
    return tags


# More frames than this are no head's.
MOST_FRAMES = 20_000
# Where a classic image of several frames states how far apart they are, by the names of DICOM.
GAPS = {"slice_spacing": "SpacingBetweenSlices", "thickness": "SliceThickness"}


@dataclass(frozen=True)
class Slice:
    """One slice: where it lies, and the file and frame of its pixels."""

    header: DicomHeader
    frame: int
    tags: Mapping[str, str | int]

    @property
    def name(self) -> str:
        """The file's name, and the frame's number where it has several."""
        many = self.header.count > 1 or self.header.frames
        return self.header.path.name + (f" frame {self.frame + 1}" if many else "")

    def text(self, key: str) -> str:
        """A value of the frame, or of its file."""
        return str(self.tags.get(key, self.header.text(key)))

    def numbers(self, key: str, count: int) -> NDArray[np.float64]:
        """The numbers of a value that a slice must have."""
        found = numbers_of(self.text(key), count)
        if found is None:
            tag = {"position": "0020,0032", "orientation": "0020,0037"}.get(key, "0028,0030")
            raise ImageInputError(
                f"{self.name}: does not state its {key.replace('_', ' ')} (DICOM tag {tag} is "
                f"{self.text(key)[:60]!r}): export the series again from the scanner or archive"
            )
        return found


def is_localizer(header: DicomHeader) -> bool:
    """Whether the header of an image states that it is a scout."""
    return "LOCALIZER" in header.text("image_type").upper()


def slices_of(header: DicomHeader) -> list[Slice]:
    """The slices of a file."""
    count = header.count
    if count == 1 and not header.frames:
        return [Slice(header, 0, {})]
    if not header.frames:
        return _placed_by_the_first(header)
    if len(header.frames) != count:
        raise ImageInputError(
            f"{header.path.name}: has {count} frames and states the places of "
            f"{len(header.frames)}: export the series as one file per slice"
        )
    return [Slice(header, n, tags) for n, tags in enumerate(header.frames)]


def _placed_by_the_first(header: DicomHeader) -> list[Slice]:
    """The frames of a classic image, which states the place of the first alone.

    They follow it along the normal, as cone-beam scanners write them; `assumed` says by what.
    """
    if header.count > MOST_FRAMES:
        raise ImageInputError(
            f"{header.path.name}: states {header.count} frames, more than {MOST_FRAMES}: is it "
            "damaged?"
        )
    first = Slice(header, 0, {})
    try:
        place, across = first.numbers("position", 3), first.numbers("orientation", 6)
    except ImageInputError as error:
        raise ImageInputError(
            f"{header.path.name}: has {header.count} frames and does not state where the first one "
            "lies (position and orientation): export the series as one file per slice"
        ) from error
    normal = np.cross(across[:3], across[3:])
    steps = np.arange(header.count)
    offsets = header.numbers("frame_offsets", header.count)
    assumed = ""
    if offsets is None:
        for key, what in GAPS.items():
            gap = header.numbers(key, 1)
            if gap is not None and gap[0] != 0.0:
                offsets = gap[0] * steps
                assumed = f"{gap[0]:g} mm apart by {what}"
                break
        else:
            raise ImageInputError(
                f"{header.path.name}: has {header.count} frames and does not state how far apart "
                "they are (SpacingBetweenSlices): export the series as one file per slice"
            )
    places = place + np.outer(offsets - offsets[0], normal)
    return [
        Slice(header, k, {"position": "\\".join(f"{x:.8g}" for x in p), "assumed": assumed})
        for k, p in enumerate(places.tolist())
    ]


@dataclass(frozen=True, eq=False)
class Stack:
    """Parallel slices in ascending order along their normal."""

    slices: tuple[Slice, ...]
    positions: NDArray[np.float64]
    axes: NDArray[np.float64]
    spacing: tuple[float, float]

    @property
    def heights(self) -> NDArray[np.float64]:
        """Of the slices along their normal, mm."""
        along: NDArray[np.float64] = self.positions @ np.cross(*self.axes)
        return along

    def kept(self, which: Sequence[int]) -> "Stack":
        """The stack of some of the slices."""
        chosen = list(which)
        slices = tuple(self.slices[i] for i in chosen)
        return Stack(slices, self.positions[chosen], self.axes, self.spacing)


def counted(number: int, what: str) -> str:
    """A number of things in words: "1 slice", "3 slices"."""
    many = f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"{number} {what if number == 1 else many}"


def listed(names: Sequence[str]) -> str:
    """Up to four names, and how many more there are."""
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
