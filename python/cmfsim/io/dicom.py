"""A CT from a folder of DICOM files, or a file of several frames: which series is meant."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cmfsim.errors import ImageInputError
from cmfsim.io.dicom_headers import DicomHeader, dicom_header
from cmfsim.io.dicom_slices import counted, is_localizer, listed, slices_of
from cmfsim.io.dicom_stack import volume_of
from cmfsim.io.image_headers import check_shape
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData

__all__ = ["read_dicom_file", "read_dicom_folder"]

# A folder with more files is not one patient's scan.
MOST_FILES = 20_000
# A series of fewer slices is a scout or a sample, no second volume that might be meant.
LEAST_VOLUME = 10
# The largest series is meant where no other has more than this part of its slices.
CLEARLY_LARGEST = 0.5
# What a DICOMDIR is.
DIRECTORY = "1.2.840.10008.1.3.10"


@dataclass(frozen=True)
class Series:
    """The images of one series in a folder."""

    uid: str
    headers: tuple[DicomHeader, ...]

    @property
    def first(self) -> DicomHeader:
        """The file that describes the series."""
        return self.headers[0]

    @property
    def modality(self) -> str:
        """The modality, such as "CT" or "MR"; empty where it is not stated."""
        return self.first.text("modality")

    @property
    def count(self) -> int:
        """Its slices."""
        return sum(max(1, len(h.frames)) for h in self.headers)

    def described(self) -> str:
        """Number, description, slices and spacing, as a person tells series apart."""
        number = self.first.text("series_number") or "-"
        parts = [f"number {number}", f"{self.count} slices"]
        if (gap := self._gap()) is not None:
            parts.append(f"{gap:.3g} mm apart")
        if self.modality not in {"", "CT"}:
            parts.append(self.modality)
        name = self.first.text("series_description") or "no description"
        return f"{name!r} ({', '.join(parts)}; {self.uid})"

    def _gap(self) -> float | None:
        places = [h.numbers("position", 3) for h in self.headers]
        across = self.first.numbers("orientation", 6)
        known = [p for p in places if p is not None]
        if across is None or len(known) < 2:
            return None
        heights = np.sort(np.array(known) @ np.cross(across[:3], across[3:]))
        return float(np.median(np.diff(heights)))


def read_dicom_folder(
    folder: Path, series: str | None = None
) -> tuple[ImageData, str, tuple[Finding, ...]]:
    """The CT of a folder, its modality, and findings on how it lay there.

    Parameters
    ----------
    folder : Path
    series : str, optional
        UID or number of the series that is meant.

    Raises
    ------
    ImageError
        (also `ValueError`) No CT, several that may be meant, slices that do not make a volume.
    """
    headers, findings = _headers(folder)
    chosen, more = _chosen(folder, _series(headers), series)
    findings += more
    slices = [s for header in chosen.headers for s in slices_of(header)]
    return volume_of(folder.name, slices, chosen.modality, findings)


def read_dicom_file(path: Path) -> tuple[ImageData, str, tuple[Finding, ...]]:
    """The CT of a DICOM file of several frames.

    Raises
    ------
    ImageError
        (also `ValueError`) No DICOM image, one slice, no CT, frames that do not make a volume.
    """
    header = dicom_header(path)
    if header is None or not header.has_pixels:
        raise ImageInputError(
            f"{path.name}: is not a readable image; NRRD, NIfTI, MetaImage or DICOM is needed"
        )
    _check_modality(path.name, {header.text("modality")})
    slices = slices_of(header)
    if len(slices) < 2:
        size = [int(header.tags.get(k, 0)) for k in ("columns", "rows")]
        check_shape(path.name, [*size, 1])
    return volume_of(path.name, slices, header.text("modality"), [])


def _check_modality(name: str, found: set[str]) -> None:
    if not found & {"", "CT"}:
        raise ImageInputError(
            f"{name}: DICOM modality is {', '.join(sorted(found))!r}: a CT is needed, because "
            "thresholds are in HU"
        )


def _headers(folder: Path) -> tuple[list[DicomHeader], list[Finding]]:
    """The DICOM images of a folder, by file name, and what else is there."""
    paths = sorted(p for p in folder.iterdir() if p.is_file())
    if len(paths) > MOST_FILES:
        raise ImageInputError(
            f"{folder.name}: holds {len(paths)} files, more than {MOST_FILES}: name the folder of "
            "one series"
        )
    headers, others = [], []
    for path in paths:
        header = dicom_header(path)
        if header is None:
            others.append(path.name)
        elif header.has_pixels and header.text("sop_class") != DIRECTORY:
            headers.append(header)
    if not headers:
        below = sorted(p.name for p in folder.iterdir() if p.is_dir())
        hint = f"; it has the folders {', '.join(below[:5])}: name one of them" if below else ""
        raise ImageInputError(
            f"{folder.name}: the folder holds no DICOM image ({len(paths)} files){hint}"
        )
    findings = []
    if others:
        findings.append(
            Finding.note(
                "dicom-other-files",
                f"skipped {counted(len(others), 'file')} not in DICOM: {listed(others)}",
                where=folder.name,
                why="a slice whose first bytes are damaged would also be skipped",
            )
        )
    return headers, findings


def _series(headers: list[DicomHeader]) -> list[Series]:
    """The series of a folder; slices of several modalities under one UID are several."""
    groups: dict[tuple[str, str], list[DicomHeader]] = {}
    for header in headers:
        key = (header.text("series_uid"), header.text("modality"))
        groups.setdefault(key, []).append(header)
    return [Series(uid, tuple(group)) for (uid, _), group in sorted(groups.items())]


def _chosen(folder: Path, found: list[Series], wanted: str | None) -> tuple[Series, list[Finding]]:
    """The series that is meant: as asked for, or the CT that is clearly the largest."""
    listed = "; ".join(s.described() for s in found)
    how = 'write series = "NUMBER or UID" beside the folder in the case file, or keep one series'
    how += " in the folder"
    if wanted is not None:
        meant = [
            s for s in found if wanted.strip() in {s.uid, s.first.text("series_number").strip()}
        ]
        if len(meant) != 1:
            raise ImageInputError(
                f"{folder.name}: series {wanted!r} was requested, which {len(meant)} of "
                f"{len(found)} series have: {listed}"
            )
        _check_modality(folder.name, {meant[0].modality})
        return meant[0], []
    _check_modality(folder.name, {s.modality for s in found})
    cts = [s for s in found if s.modality in {"", "CT"}]
    volumes = [s for s in cts if not all(is_localizer(h) for h in s.headers)] or cts
    volumes.sort(key=lambda s: (-s.count, s.uid))
    first, rest = volumes[0], volumes[1:]
    rivals = [s for s in rest if s.count > CLEARLY_LARGEST * first.count]
    rivals += [
        s
        for s in rest
        if s not in rivals
        and s.count >= LEAST_VOLUME
        and any(s.first.text(k) != first.first.text(k) for k in ("study_uid", "patient_id"))
    ]
    if rivals:
        several = f"{len(rivals) + 1} CT series may be meant"
        raise ImageInputError(f"{folder.name}: {several}; {how}: {listed}")
    if len(found) == 1:
        return first, []
    finding = Finding.warning(
        "dicom-series",
        f"{len(found)} series in the folder; the largest CT, {first.described()}, was chosen from: "
        f"{listed}",
        where=folder.name,
        why="another series may be the right one",
        fix=how,
    )
    return first, [finding]
