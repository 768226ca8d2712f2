"""A CT from a folder of DICOM files, or a file of several frames; a PDF written to its study."""

import contextlib
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from cmfsim._core import __version__
from cmfsim.errors import ImageInputError, third_party
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.images.dicom_headers import (
    DicomHeader,
    counted,
    dicom_header,
    is_localizer,
    listed,
    slices_of,
)
from cmfsim.io.images.dicom_stack import volume_of
from cmfsim.io.images.image_headers import check_shape
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData

# A folder with more files is not one patient's scan.
MOST_FILES = 20_000
# How far below a folder its series go on.
MOST_DEPTH = 6
# Bytes before the mark of DICOM.
PREAMBLE = 128
# A series of fewer slices is a scout or a sample, not a second volume to choose from.
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
        return next((m for h in self.headers if (m := h.text("modality"))), "")

    @property
    def count(self) -> int:
        """Its slices."""
        return sum(h.count for h in self.headers)

    def described(self) -> str:
        """Number, description, slices and spacing, as a person tells series apart."""
        number = self.first.text("series_number") or "-"
        parts = [f"number {number}", f"{self.count} slices"]
        places = [h.numbers("position", 3) for h in self.headers]
        across = self.first.numbers("orientation", 6)
        known = [p for p in places if p is not None]
        if across is not None and len(known) > 1:
            heights = np.sort(np.array(known) @ np.cross(across[:3], across[3:]))
            parts.append(f"{np.median(np.diff(heights)):.3g} mm apart")
        if self.modality not in {"", "CT"}:
            parts.append(self.modality)
        name = self.first.text("series_description") or "no description"
        return f"{name!r} ({', '.join(parts)}; {self.uid})"


def read_dicom_folder(
    folder: Path, series: str | None = None
) -> tuple[ImageData, str, tuple[Finding, ...]]:
    """The CT of a folder, its modality, and findings on how it lay there.

    series: UID or number of the series that is meant.
    """
    chosen, findings = _meant(folder, series)
    slices = [s for header in chosen.headers for s in slices_of(header)]
    return volume_of(folder.name, slices, chosen.modality, findings)


def study_date(path: Path, series: str | None) -> str:
    """The date of the study of a DICOM folder or file, YYYYMMDD; empty where none is stated."""
    header = _meant(path, series)[0].first if path.is_dir() else dicom_header(path)
    return "" if header is None else header.text("study_date")


def _meant(folder: Path, series: str | None) -> tuple[Series, list[Finding]]:
    """The series of a folder that is meant, and findings on the others."""
    headers, findings = _headers(folder, series)
    groups: dict[tuple[str, str], list[DicomHeader]] = {}
    stated = {uid: modality for uid, modality in map(_key, headers) if modality}
    for header in headers:
        uid, modality = _key(header)
        # A slice that states no modality has that of its series.
        groups.setdefault((uid, modality or stated.get(uid, "")), []).append(header)
    there = [Series(uid, tuple(group)) for (uid, _), group in sorted(groups.items())]
    chosen, more = _chosen(folder, there, series)
    return chosen, [*findings, *more]


def read_dicom_file(path: Path) -> tuple[ImageData, str, tuple[Finding, ...]]:
    """The CT of a DICOM file of several frames."""
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


def dicom_files(folder: Path) -> list[Path]:
    """The files that a folder of DICOM may be read from: its own, and DICOM files below it."""
    own = sorted(p for p in folder.iterdir() if p.is_file())
    return [*own, *(p for p in _below(folder) if is_marked(p))]


def dicom_places(folders: Sequence[Path]) -> list[tuple[Path, str | None]]:
    """Where images in folders with DICOM files are read, and which series of a place is meant.

    Folders that have parts of one series are one place: the folder that all of them lie in. The
    series is None where the place holds nothing else.
    """
    held = {folder: Counter[str]() for folder in folders}
    for folder, counts in held.items():
        for path in sorted(p for p in folder.iterdir() if p.is_file()):
            # Damaged files are found later.
            with contextlib.suppress(ImageInputError, OSError):
                header = dicom_header(path)
                if header is not None and header.has_pixels:
                    counts[header.text("series_uid")] += 1
    # A DICOMDIR alone is no image.
    groups: list[tuple[list[Path], Counter[str]]] = []
    for folder, counts in held.items():
        if not counts:
            continue
        joined = [g for g in groups if set(g[1]) & set(counts) - {""}]
        paths = [p for g in joined for p in g[0]]
        groups = [g for g in groups if g not in joined]
        groups.append(([*paths, folder], sum((g[1] for g in joined), counts)))
    places: list[tuple[Path, str | None]] = []
    for paths, counts in groups:
        if len(paths) == 1:
            places.append((paths[0], None))
            continue
        place = Path(os.path.commonpath(paths))
        others = [f for f in held if held[f] and f not in paths and f.is_relative_to(place)]
        largest = max(sorted(counts), key=lambda uid: counts[uid])
        places.append((place, largest if others else None))
    return sorted(places)


def _below(folder: Path) -> Iterator[Path]:
    """The plain files in the folders below a folder, in a fixed order; hidden ones left out."""
    for place, folders, names in os.walk(folder):
        here = Path(place)
        deep = len(here.relative_to(folder).parts) >= MOST_DEPTH
        folders[:] = [] if deep else sorted(f for f in folders if f[0] != ".")
        if here != folder:
            yield from (p for name in sorted(names) if (p := here / name).is_file())


def is_marked(path: Path) -> bool:
    """Whether a file has the mark of DICOM behind its preamble."""
    with path.open("rb") as file:
        return file.read(PREAMBLE + 4)[PREAMBLE:] == b"DICM"


def _headers(folder: Path, wanted: str | None) -> tuple[list[DicomHeader], list[Finding]]:
    """The DICOM images of a folder, by file name, and what else is there.

    A series goes on in folders below: scanners and disks write some hundred files to each. Of
    these, only the series of the folder itself are taken, or the one that is asked for.
    """
    paths = sorted(p for p in folder.iterdir() if p.is_file())
    _check_number(folder, len(paths))
    headers, others = [], []
    for path in paths:
        header = dicom_header(path)
        if header is None:
            others.append(path.name)
        elif _is_image(header):
            headers.append(header)
    below, damaged = _headers_below(folder, {*map(_key, headers)}, wanted)
    if not headers and damaged:
        raise ImageInputError(damaged[0])
    findings, where = list[Finding](), folder.name
    places = Counter(h.path.parent.relative_to(folder).as_posix() for h in below)
    if len(places) + bool(headers) > 1:
        parts = [f"{name} ({n})" for name, n in sorted(places.items())]
        what = f"images were also read from folders below: {listed(parts)}"
        findings.append(Finding("dicom-folders", what, where=where))
    headers += below
    if not headers:
        raise ImageInputError(
            f"{folder.name}: there is no DICOM image in the folder or below it "
            f"({len(paths)} files in it)"
        )
    if damaged:
        what = f"skipped {counted(len(damaged), 'file')} in folders below: {damaged[0]}"
        findings.append(Finding("dicom-skipped", what, severity="warning", where=where))
    missing = [p.name for p in sorted(folder.iterdir()) if p.is_symlink() and not p.exists()]
    if missing:
        what = (
            f"skipped {counted(len(missing), 'link')} to files that are not here: {listed(missing)}"
        )
        why = "slices at the ends of a series are not missed when they are absent"
        fix = "fetch the files (with DataLad: datalad get)"
        found = Finding("dicom-skipped", what, severity="warning", where=where, why=why, fix=fix)
        findings.append(found)
    if others:
        what = f"skipped {counted(len(others), 'file')} not in DICOM: {listed(others)}"
        findings.append(Finding("dicom-skipped", what, severity="note", where=where))
    return headers, findings


def _headers_below(
    folder: Path, own: set[tuple[str, str]], wanted: str | None
) -> tuple[list[DicomHeader], list[str]]:
    """The images in folders below that belong to a folder, and why others cannot be read."""
    headers, damaged = list[DicomHeader](), list[str]()
    for path in _below(folder):
        if not is_marked(path):
            continue
        _check_number(folder, len(headers))
        try:
            header = dicom_header(path)
        except ImageInputError as error:
            damaged.append(str(error))
            continue
        if header is None or not _is_image(header):
            continue
        is_wanted = wanted is not None and _is_meant(header, wanted)
        if not own or is_wanted or (header.text("series_uid") and _key(header) in own):
            headers.append(header)
    return headers, damaged


def _check_number(folder: Path, count: int) -> None:
    if count > MOST_FILES:
        raise ImageInputError(
            f"{folder.name}: holds {count} files, more than {MOST_FILES}: name the folder of one "
            "series"
        )


def _is_image(header: DicomHeader) -> bool:
    return header.has_pixels and header.text("sop_class") != DIRECTORY


def _key(header: DicomHeader) -> tuple[str, str]:
    """What images of one series share: slices of several modalities under one UID are several."""
    return header.text("series_uid"), header.text("modality")


def _is_meant(header: DicomHeader, wanted: str) -> bool:
    """Whether an image is of the series of a UID or number."""
    return wanted.strip() in {header.text("series_uid"), header.text("series_number").strip()}


def _chosen(folder: Path, found: list[Series], wanted: str | None) -> tuple[Series, list[Finding]]:
    """The series that is meant: as asked for, or the CT that is clearly the largest."""
    listed = "; ".join(s.described() for s in found)
    how = 'write series = "NUMBER or UID" beside the folder in the case file, or keep one series'
    how += " in the folder"
    if wanted is not None:
        meant = [s for s in found if _is_meant(s.first, wanted)]
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
    what = f"{len(found)} series in the folder; the largest CT, {first.described()}, was chosen "
    return first, [Finding("dicom-series", f"{what}from: {listed}", where=folder.name, fix=how)]


# What is taken over from the CT: whose the document is, and to which study it belongs.
PATIENT = ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "SpecificCharacterSet")
STUDY = ("StudyInstanceUID", "StudyDate", "StudyTime", "StudyID", "AccessionNumber")
TAKEN = (*PATIENT, *STUDY, "ReferringPhysicianName")
PDF_CLASS = "1.2.840.10008.5.1.4.1.1.104.1"
# Behind the series of a scanner.
SERIES_NUMBER = 9001


def write_dicom_pdf(path: Path, pdf: bytes, source: Path, title: str) -> None:
    """Writes a PDF as a DICOM file of its own series in the study of a CT: a folder, or a file."""
    pydicom = third_party("pydicom", "DICOM is written", "imaging")
    uid = third_party("pydicom.uid", "DICOM is written", "imaging")
    found = {}
    for file in dicom_files(source) if source.is_dir() else [source]:
        try:
            header = pydicom.dcmread(file, stop_before_pixels=True, specific_tags=[*TAKEN])
        except pydicom.errors.InvalidDicomError:
            continue
        if "StudyInstanceUID" in header:
            found[str(header.get("PatientID", "")), str(header.StudyInstanceUID)] = header
    if len(found) != 1:
        raise ImageInputError(
            f"{source} holds DICOM of {len(found)} patients and studies (dicom-study): one is "
            "needed, of which the report is"
        )
    now = datetime.now().astimezone()
    data = pydicom.Dataset()
    data.SOPClassUID, data.SOPInstanceUID = PDF_CLASS, uid.generate_uid()
    for name in TAKEN:
        # Names of patients and studies must be there, even if they are empty.
        setattr(data, name, found[next(iter(found))].get(name, ""))
    if not data.SpecificCharacterSet:
        data.SpecificCharacterSet = "ISO_IR 192"
    data.Modality, data.SeriesInstanceUID = "DOC", uid.generate_uid()
    data.SeriesNumber, data.InstanceNumber = SERIES_NUMBER, 1
    data.SeriesDescription = data.DocumentTitle = title
    data.Manufacturer, data.SoftwareVersions = "cmfsim", __version__
    data.ConversionType, data.BurnedInAnnotation = "WSD", "YES"
    data.ContentDate, data.ContentTime = now.strftime("%Y%m%d"), now.strftime("%H%M%S")
    data.AcquisitionDateTime = ""
    data.ConceptNameCodeSequence = []
    data.MIMETypeOfEncapsulatedDocument = "application/pdf"
    data.EncapsulatedDocumentLength = len(pdf)
    # Values have an even length (PS3.5, 7.1).
    data.EncapsulatedDocument = pdf + b"\0" * (len(pdf) % 2)
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = uid.ExplicitVRLittleEndian
    with replacing(path) as stream:
        pydicom.dcmwrite(stream, data, enforce_file_format=True)
