"""Slices of a DICOM series: what each file states of its place, and stacks of parallel slices."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.images.dicom.headers import DicomHeader, numbers_of

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
    return [Slice(header, n, frame.tags) for n, frame in enumerate(header.frames)]


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
