"""Headers of DICOM files: the few elements that place a slice, read by pydicom.

Only what stands before the pixels is read. Sequences that place the frames of an enhanced
multi-frame image are read as well. Pixels are decoded elsewhere, by ITK.
"""

import io
import re
import struct
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageError, ImageInputError, third_party

# Pixels whose lowest value is shown white (PS3.3 C.7.6.3.1), and the element that states it.
SHOWN_INVERTED = "MONOCHROME1"
INVERTED = re.compile(
    rb"((?:\x28\0\x04\0|\0\x28\0\x04)(?:CS..|\x0c\0\0\0|\0\0\0\x0c))MONOCHROME1", re.DOTALL
)
# Elements that are kept, by their tag.
NAMES: Mapping[int, str] = {
    0x00080008: "image_type", 0x00080016: "sop_class", 0x00080020: "study_date",
    0x00080060: "modality", 0x0008103E: "series_description", 0x00100020: "patient_id",
    0x00180050: "thickness", 0x00180088: "slice_spacing", 0x00181120: "gantry_tilt",
    0x0020000D: "study_uid", 0x0020000E: "series_uid", 0x00200011: "series_number",
    0x00200012: "acquisition_number",
    0x00200032: "position", 0x00200037: "orientation", 0x00200052: "frame_of_reference",
    0x00280002: "samples", 0x00280004: "photometric", 0x00280008: "n_frames", 0x00280010: "rows",
    0x00280011: "columns", 0x00280030: "pixel_spacing", 0x00280100: "bits",
    0x00281052: "intercept", 0x00281053: "slope", 0x00281054: "rescale_type",
    0x3004000C: "frame_offsets",
}  # fmt: skip
# What an enhanced image states of all frames and of each, and the sequences in these.
SHARED, PER_FRAME = 0x52009229, 0x52009230
WITHIN = frozenset({0x00209111, 0x00209113, 0x00209116, 0x00289110, 0x00289145})
TAGS = [*NAMES, SHARED, PER_FRAME]
# Whole numbers of 16 bits in binary; all others are text.
BINARY = frozenset({"samples", "rows", "columns", "bits"})
# Pixels, and those of real numbers.
PIXELS = frozenset({0x7FE00010, 0x7FE00008, 0x7FE00009})
UNDEFINED = 0xFFFFFFFF
# All value representations.
KINDS = frozenset(re.findall(
    "[A-Z]{2}", "AE AS AT CS DA DS DT FD FL IS LO LT OB OD OF OL OV OW PN SH SL SQ SS ST SV TM UC "
    "UI UL UN UR US UT UV"
))  # fmt: skip
# Classes of CT images, of one frame and several.
CT = "1.2.840.10008.5.1.4.1.1.2"
PREAMBLE = 128
# Longer values are none that is kept, bytes. No image takes more reads of its file, has a longer
# sequence or more items in one, for each of which pydicom takes 1.3 kB, or so many odd elements.
MOST_VALUE = 2**16
MOST_READS = 1_000_000
MOST_SEQUENCE, MOST_ITEMS = 2**25, 300_000
MOST_ODD = 100
# What begins an item, in both orders of bytes.
ITEMS = (b"\xfe\xff\x00\xe0", b"\xff\xfe\xe0\x00")

REWRITE = (
    "rewrite the files with a DICOM converter (such as gdcmconv or dcmconv), or export the series "
    "again"
)

Tags = Mapping[str, str | int]


@dataclass(frozen=True)
class DicomHeader:
    """What a DICOM file states before its pixels.

    tags: By name; absent where the file does not state it.
    frames: What an enhanced multi-frame image states of each frame, in the order of its pixels.
    odd: The first byte of each private element of no known kind, and of what fills the file up
        behind its pixels, and that after its last, in the file without those before.
    """

    path: Path
    tags: Tags
    has_pixels: bool = False
    frames: tuple[Tags, ...] = ()
    odd: tuple[tuple[int, int], ...] = ()

    def for_reader(self) -> bytes | None:
        """The file as ITK reads it rightly; None if it does so as it is.

        Private elements of no known kind and fillers, which not all readers pass, are left out.
        Pixels that are shown inverted would be inverted, which does not concern their values in HU.
        """
        inverted = self.text("photometric") == SHOWN_INVERTED
        if not (self.odd or inverted):
            return None
        data = self.path.read_bytes()
        for start, end in self.odd:
            data = data[:start] + data[end:]
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


def numbers_of(text: str, count: int) -> NDArray[np.float64] | None:
    r"""The finite numbers of a text "1\2\3"; None where it holds something else."""
    try:
        values = np.array([float(v) for v in text.split("\\")])
    except ValueError:
        return None
    return values if values.shape == (count,) and np.isfinite(values).all() else None


def dicom_header(path: Path) -> DicomHeader | None:
    """What a DICOM file states; None where the file is no DICOM."""
    with path.open("rb", buffering=0) as file:
        begin = file.read(PREAMBLE + 4)
        marked = begin[PREAMBLE:] == b"DICM"
        if not (marked or _bare(begin)):
            return None
        reader = third_party("pydicom.filereader", "DICOM is read", "imaging", ImageError)
        raw: Any = file
        odd: list[tuple[int, int]] = []
        try:
            while len(odd) <= MOST_ODD:
                with _Stream(raw) as stream, warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    elements = _Elements(stream)
                    found = reader.read_partial(stream, elements, force=True, specific_tags=TAGS)
                    if elements.odd is None:
                        return _header(path, found, elements, (*odd, *elements.filler()))
                    odd.append(elements.odd)
                    raw = stream.without(*elements.odd)
            message = f"has more than {MOST_ODD} elements of no known kind (VR): {REWRITE}"
            raise _RefusedError(message)  # noqa: TRY301 (told as the others)
        except Exception as error:  # (whatever pydicom stumbles over)
            if not marked:
                return None
            what = f"is cut short or damaged ({error}); copy it again"
            what = str(error) if isinstance(error, _RefusedError) else what
            raise ImageInputError(f"{path.name}: {what}") from error


def _bare(begin: bytes) -> bool:
    """Whether a file without preamble begins as an old DICOM data set does."""
    if len(begin) < 8:
        return False
    group, element, length = struct.unpack("<HHI", begin[:8])
    explicit = begin[4:6].isalpha() and begin[4:6].isupper()
    return group in {2, 8} and element <= 0x60 and (explicit or length < MOST_VALUE)


class _RefusedError(Exception):
    """What another program has to change in a file."""


class _Stream(io.BufferedReader):
    """A file that ends in an error where pydicom would go on without what is missing."""

    # Which bytes in memory have none, and pydicom asks for.
    name = ""

    def __init__(self, raw: Any) -> None:
        super().__init__(raw)
        self.reads = 0
        self.size = self.seek(0, io.SEEK_END)
        self.seek(0)

    def read(self, size: int | None = -1, /) -> bytes:
        """So many bytes, or none at the end of the file."""
        if size is None or size < 0:
            # pydicom would unpack all that follows, whatever its size.
            message = "is compressed as a whole (deflated transfer syntax): export it uncompressed"
            raise _RefusedError(message)
        data = super().read(size)
        # The head of an element, of 8 bytes, is asked for until there is none.
        if len(data) < size and (data or size > 8):
            message = f"it ends at byte {self.size}"
            raise ValueError(message)
        self.reads += 1
        if self.reads > MOST_READS:
            message = "it has more elements than any image"
            raise ValueError(message)
        return data

    def without(self, start: int, end: int) -> io.BytesIO:
        """The file without some of its bytes."""
        self.seek(0)
        data = self.read(self.size)
        return io.BytesIO(data[:start] + data[end:])


class _Elements:
    """Looks at each element before pydicom reads it, and stops at the pixels.

    pixels: The length of the pixels, perhaps UNDEFINED; None where there are none.
    left: Bytes from there to the end of the file.
    odd: The first byte of a private element of no known kind and that after its last.
    """

    def __init__(self, stream: _Stream) -> None:
        self.stream = stream
        self.explicit = False
        self.count = 0
        self.pixels: int | None = None
        self.left = 0
        self.odd: tuple[int, int] | None = None

    def __call__(self, tag: int, kind: str | None, length: int) -> bool:
        """Whether pydicom stops before an element, whose value begins where the stream is."""
        self.count += 1
        self.explicit |= kind in KINDS
        self.left = self.stream.size - self.stream.tell()
        if self.explicit and kind not in KINDS:
            self.odd = self._span_of_no_kind(tag)
            return True
        if tag in PIXELS:
            self.pixels = length
            return True
        if self.left < length != UNDEFINED:
            message = f"element {tag:08x} has {length} bytes, more than are left"
            raise ValueError(message)
        return False

    def filler(self) -> tuple[tuple[int, int], ...]:
        """The bytes behind pixels of a stated length, if they are no element but fill a block."""
        if self.pixels in {None, UNDEFINED} or self.left <= (length := self.pixels or 0):
            return ()
        end = self.stream.size - self.left + length
        self.stream.seek(end)
        head = self.stream.read(8) if self.left - length >= 8 else b""
        if head and self.explicit:
            is_element = head[4:6].decode("latin-1") in KINDS
        else:
            is_element = bool(head) and 0 < struct.unpack("<4xI", head)[0] <= self.left - length - 8
        return () if is_element else ((end, self.stream.size),)

    def _span_of_no_kind(self, tag: int) -> tuple[int, int]:
        """The bytes of an element whose kind is none, if what follows it shows how many they are.

        Such elements are private ones, that no reader needs. Programs write their lengths in two
        bytes, in four, or as where no kind is stated.
        """
        begin = self.stream.tell() - 8
        self.stream.seek(begin)
        head = self.stream.read(min(12, self.left + 8))
        order = "<" if struct.unpack("<HH", head[:4]) == (tag >> 16, tag & 0xFFFF) else ">"
        if tag >> 16 & 1 and len(head) == 12:
            for size, form in ((8, "6xH"), (8, "4xI"), (12, "8xI")):
                end = begin + size + struct.unpack_from(order + form, head)[0]
                if self._is_element(order, tag, end):
                    return begin, end
        message = (
            f"its element {tag >> 16:04x},{tag & 0xFFFF:04x} has no known value representation "
            f"(VR), and what follows it is not found: {REWRITE}"
        )
        raise _RefusedError(message)

    def _is_element(self, order: str, before: int, place: int) -> bool:
        """Whether an element of a known kind, that may follow another, begins at a place."""
        if place + 8 > self.stream.size:
            return False
        self.stream.seek(place)
        group, element, kind = struct.unpack(f"{order}HH2s2x", self.stream.read(8))
        return group << 16 | element > before and kind.decode("latin-1") in KINDS


def _header(
    path: Path, found: Any, elements: _Elements, odd: tuple[tuple[int, int], ...]
) -> DicomHeader:
    """The header of what pydicom read; an error if the file holds fewer pixels than it states."""
    tags = _tags(found)
    shared = _tags_of_items(found, SHARED)
    frames = tuple({**shared, **_tags(item)} for item in _items(found, PER_FRAME))
    header = DicomHeader(path, tags, elements.pixels is not None, frames, odd)
    size = {"rows", "columns"} & tags.keys()
    kind = header.text("sop_class") or str(found.file_meta.get("MediaStorageSOPClassUID", ""))
    is_image = size or kind.startswith(CT) or not elements.count
    if len(size) < 2 if header.has_pixels else is_image:
        message = "it has no pixels, or does not state their rows and columns"
        raise ValueError(message)
    if elements.pixels not in {None, UNDEFINED}:
        needed = elements.pixels or 0
        there = min(elements.left, needed)
        if "bits" in tags:
            # Readers give zeros for pixels that are not there.
            each = int(tags["rows"]) * int(tags["columns"]) * int(tags.get("samples", 1))
            needed = each * (int(tags["bits"]) // 8) * header.count
        if there < needed:
            message = f"{there} of {needed} bytes of pixels"
            raise ValueError(message)
    return header


def _tags(found: Any) -> dict[str, str | int]:
    """The values of a data set and of the sequences in it that are kept."""
    tags: dict[str, str | int] = {}
    # As they stand in the file: pydicom refuses numbers that are not written by its rules.
    for element in found.elements():
        if not (element.VR in KINDS or getattr(element, "is_implicit_VR", False)):
            message = f"element {element.tag:08x} is of no known kind (VR)"
            raise ValueError(message)
        if (name := NAMES.get(element.tag)) is not None:
            data = element.value or b""
            if data and len(data) != element.length:
                message = f"element {element.tag:08x} has {len(data)} of {element.length} bytes"
                raise ValueError(message)
            if len(data) > MOST_VALUE:
                continue
            if name in BINARY:
                order = "<" if element.is_little_endian else ">"
                tags[name] = int(struct.unpack_from(f"{order}H", data)[0])
            else:
                tags[name] = data.decode("latin-1").strip("\0 ")
        elif element.tag in WITHIN:
            tags |= _tags_of_items(found, element.tag)
    return tags


def _tags_of_items(found: Any, tag: int) -> dict[str, str | int]:
    """The values of all items of a sequence."""
    tags: dict[str, str | int] = {}
    for item in _items(found, tag):
        tags |= _tags(item)
    return tags


def _items(found: Any, tag: int) -> Any:
    """The items of a sequence; none where there is none."""
    if tag not in found:
        return ()
    raw = found.get_item(tag).value
    if isinstance(raw, bytes) and (
        len(raw) > MOST_SEQUENCE or max(map(raw.count, ITEMS)) > MOST_ITEMS
    ):
        message = f"its sequence {tag:08x} is longer than any image has"
        raise ValueError(message)
    return found[tag].value


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
