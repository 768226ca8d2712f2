"""Slices of a DICOM series: what each file states of its place, and stacks of parallel slices."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.dicom_headers import DicomHeader, numbers_of

__all__ = ["Slice", "Stack", "counted", "is_localizer", "listed", "slices_of"]


@dataclass(frozen=True)
class Slice:
    """One slice: where it lies, and the file and frame of its pixels."""

    header: DicomHeader
    frame: int
    tags: Mapping[str, str | int]

    @property
    def name(self) -> str:
        """The file's name, and the frame's number where it has several."""
        frames = len(self.header.frames)
        return self.header.path.name + (f" frame {self.frame + 1}" if frames else "")

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
    stated = numbers_of(header.text("n_frames") or "1", 1)
    count = 1 if stated is None else int(stated[0])
    if count == 1 and not header.frames:
        return [Slice(header, 0, {})]
    if len(header.frames) != count:
        raise ImageInputError(
            f"{header.path.name}: has {count} frames and states the places of "
            f"{len(header.frames)}: export the series as one file per slice"
        )
    return [Slice(header, n, frame.tags) for n, frame in enumerate(header.frames)]


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
