"""Images: which reader a file has by its content; DICOM's pixels, and writing, by ITK."""

import glob
import logging
import shutil
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageError, ImageInputError, third_party
from cmfsim.io.files.leftovers import abandoned, temporary_folder
from cmfsim.io.files.reading_writing import is_there, utf8_path
from cmfsim.io.images.dicom_series import read_dicom_file, read_dicom_folder
from cmfsim.io.images.image_grids import on_axes
from cmfsim.io.images.image_headers import KNOWN
from cmfsim.io.images.nifti import GZIP, is_nifti, read_nifti
from cmfsim.io.images.nrrd import is_meta, read_meta, read_nrrd
from cmfsim.processes.worker import Answer
from cmfsim.values.checks import AnyPath
from cmfsim.values.finding import Finding, log_warnings
from cmfsim.values.image_data import ImageData

_log = logging.getLogger(__name__)

# What the child process imports before the time of a file begins.
LIBRARIES = ("SimpleITK",)


def read_slices(paths: list[str]) -> Answer:
    """The pixels of DICOM files of one slice each, axes slice, row, column, in HU.

    Each file's own slope and intercept are applied. `places` holds the position and the spacing
    that the reader finds for each.
    """
    values: Any = None
    places = []
    for number, path in enumerate(paths):
        image = _read(path, "GDCMImageIO")
        pixels = _itk().GetArrayViewFromImage(image)
        pixels = pixels[0] if pixels.ndim == 3 else pixels
        places.append([*image.GetOrigin()[:3], *image.GetSpacing()[:2]])
        if values is None:
            values = np.empty((len(paths), *pixels.shape), dtype=pixels.dtype)
        if pixels.shape != values.shape[1:]:
            text = " × ".join(map(str, pixels.shape[::-1]))
            raise ImageInputError(f"{Path(path).name}: has {text} pixels, unlike the slices before")
        kind = np.result_type(values.dtype, pixels.dtype)
        if kind != values.dtype:
            values = values.astype(kind)
        values[number] = pixels
    return Answer({"places": places}, {"values": values})


def read_frames(path: str) -> Answer:
    """The pixels of a DICOM file of several frames, axes frame, row, column."""
    image = _read(path, "GDCMImageIO")
    pixels = _itk().GetArrayFromImage(image)
    return Answer({"spacing": list(image.GetSpacing())}, {"values": pixels})


def _itk() -> Any:
    return import_module("SimpleITK")


def _read(path: str, kind: str) -> Any:
    itk = _itk()
    # ITK prints its warnings; what matters of them is found elsewhere.
    itk.ProcessObject.GlobalWarningDisplayOff()
    reader = itk.ImageFileReader()
    reader.SetFileName(path)
    reader.SetImageIO(kind)
    name = Path(path).name
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise ImageInputError(
            f"{name}: cannot be decoded ({last_line(error)[:100]}): copy it again; if other "
            "programs show it, save it again with one of them (DICOM: with gdcmconv or dcmconv)"
        ) from error
    if image.GetNumberOfComponentsPerPixel() != 1:
        raise ImageInputError(
            f"{name}: has {image.GetNumberOfComponentsPerPixel()} numbers per voxel (colours or "
            "vectors): one is needed"
        )
    return image


def last_line(error: Exception) -> str:
    """What ITK reports of an error, without the places in its sources."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


# What is written; reading goes by content.
SUFFIXES = (".nrrd", ".nii", ".nii.gz", ".mha")
# Names of files that are no DICOM, whose content is none of their formats.
OTHER_SUFFIXES = (".nrrd", ".nhdr", ".nii", ".gz", ".mha", ".mhd", ".hdr")
# What tells formats apart.
FIRST_BYTES = 1024


@dataclass(frozen=True, eq=False)
class ImageFile:
    """An image in LPS, what was found on its file, and its modality, where DICOM states one."""

    image: ImageData
    modality: str = ""
    findings: tuple[Finding, ...] = ()


def read_image(path: AnyPath, *, series: str | None = None) -> ImageData:
    """The image of a file or a DICOM folder, in LPS on an axis-aligned grid.

    Warnings about the file, such as a frame that it does not state, are logged.

    Parameters
    ----------
    path : path
        NRRD, NIfTI, MetaImage, a DICOM file of several frames, or a folder of DICOM slices.
    series : str, optional
        UID or number of the DICOM series that is meant, where a folder holds several.

    Raises
    ------
    ImageError
        (also `ValueError`) Damaged, empty, not three-dimensional, one slice, colours, MR, slices
        missing or at one place, several series to choose from, a header that contradicts itself
        or leads to files elsewhere.
    FileNotFoundError

    Examples
    --------
    >>> import cmfsim
    >>> image = cmfsim.read_image("head.nii.gz")
    """
    return logged(read_image_file(path, series=series))


def logged(read: ImageFile) -> ImageData:
    """The image, with its warnings in the log, for callers who are not given the findings."""
    log_warnings(_log, read.findings)
    return read.image


def read_image_file(path: AnyPath, *, series: str | None = None) -> ImageFile:
    """The image of a file or a DICOM folder, with its modality and findings."""
    path = Path(path)
    if not is_there(path, ImageInputError):
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_dir():
        _simpleitk()
        return ImageFile(*read_dicom_folder(path, series))
    if series is not None:
        raise ImageInputError(
            f"{path.name}: series = {series!r} chooses among the series of a DICOM folder, but "
            "this is a file: remove it, or give the folder"
        )
    with path.open("rb") as file:
        begin = file.read(FIRST_BYTES)
    if not begin:
        raise ImageInputError(f"{path.name}: is empty")
    # A DICOM file may begin with anything.
    if begin[128:132] != b"DICM":
        if begin.startswith(GZIP) or is_nifti(begin):
            return placed(path, *read_nifti(path))
        if begin.startswith(b"NRRD000"):
            return placed(path, *read_nrrd(path))
        if is_meta(begin):
            return placed(path, *read_meta(path))
        if path.name.lower().endswith(OTHER_SUFFIXES):
            raise ImageInputError(f"{path.name}: is not a readable image; {KNOWN}")
    _simpleitk()
    return ImageFile(*read_dicom_file(path))


def write_image(image: ImageData, path: AnyPath) -> None:
    """Writes an image to a file whose name ends in .nrrd, .nii, .nii.gz or .mha.

    It is written under another name first, so that a failure leaves an older file intact.

    Raises
    ------
    ImageError
        (also `ValueError`) Another ending.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> image = cmfsim.ImageData(np.zeros((4, 4, 4), dtype=np.int16), spacing=(1, 1, 1))
    >>> cmfsim.write_image(image, "image.nrrd")
    """
    path = Path(path)
    suffix = next((s for s in SUFFIXES if path.name.lower().endswith(s)), None)
    if suffix is None:
        raise ImageInputError(f"{path.name}: images are written as {', '.join(SUFFIXES)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: no such folder")
    itk = _simpleitk()
    values = image.values
    if values.dtype == bool:
        values = values.astype(np.uint8)
    elif values.dtype == np.float16:
        values = values.astype(np.float32)
    written = itk.GetImageFromArray(np.ascontiguousarray(values.T))
    written.SetSpacing([float(s) for s in image.spacing])
    written.SetOrigin([float(o) for o in image.lowest])
    # ITK tells the format by the ending of a name, and opens the file itself: so it gets a folder.
    prefix = f".{path.name}.writing-"
    for left in abandoned(path.parent, f"{glob.escape(prefix)}*"):
        shutil.rmtree(left, ignore_errors=True)
    with temporary_folder(path.parent, prefix) as fresh:
        try:
            with utf8_path(fresh) as plain:
                itk.WriteImage(written, f"{plain}/image{suffix}", useCompression=True)
            (fresh / f"image{suffix}").replace(path)
        except RuntimeError as error:
            raise ImageError(f"{path.name}: cannot be written ({last_line(error)})") from error
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _simpleitk() -> Any:
    return third_party("SimpleITK", "images are read", "imaging", ImageError)


def placed(
    path: Path, values: NDArray[Any], affine: NDArray[np.float64], findings: tuple[Finding, ...]
) -> ImageFile:
    """The image of voxels with their map to LPS, on axes of the patient."""
    if values.dtype.kind == "f":
        nan, infinite = (
            sum(int(np.count_nonzero(is_it(layer))) for layer in values.T)
            for is_it in (np.isnan, np.isinf)
        )
        if infinite or nan == values.size:
            raise ImageInputError(
                f"{path.name}: {nan + infinite} voxels are NaN or infinite: export it with numbers "
                "(air has -1000 HU)"
            )
        if nan:
            # As programs leave what lies outside the field of view when they resample an image.
            lowest = float(np.nanmin(values))
            values = np.nan_to_num(values, nan=lowest)
            what = f"{nan} voxels ({nan / values.size:.1%}) are no number: read as {lowest:g}"
            fix = "nothing to do if they lie outside the head; otherwise export the image again"
            why = "a program that resamples an image leaves them where it has no data"
            odd = Finding("field-ignored", what, where=path.name, why=why, fix=fix)
            findings = (*findings, odd)
    image, more = on_axes(values, affine, path.name)
    return ImageFile(image, "", (*findings, *more))
