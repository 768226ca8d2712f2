"""Images in the formats that SimpleITK reads: NRRD, NIfTI, MetaImage and folders of DICOM."""

import glob
import gzip
import os
import shutil
import struct
import zlib
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.case import Finding, ImageData
from cmfsim.errors import ImageError, ImageInputError
from cmfsim.io.leftovers import abandoned, temporary_folder

__all__ = ["ImageFile", "read_image", "read_image_file", "write_image"]

# What is written; reading goes by content.
SUFFIXES = (".nrrd", ".nii", ".nii.gz", ".mha")
# An axis farther than this from a patient's axis (as a sine) is resampled: 0.06 degrees, which is
# 0.25 mm over a head.
OBLIQUE = 1e-3
# Slices count as evenly spaced up to this part of their spacing.
UNEVEN = 0.02
# Larger images are refused before memory is taken, voxels: 1024 × 1024 × 2000.
MOST_VOXELS = 2_100_000_000
# Outside a rotated image there is air, HU; images without negative values get their least.
OUTSIDE = -1024.0
# The longer of both NIfTI headers, bytes.
NIFTI_HEADER = 544
_MODALITY = "0008|0060"
_POSITION = "0020|0032"
_ORIENTATION = "0020|0037"
_SERIES = "0008|103e"


@dataclass(frozen=True, eq=False)
class ImageFile:
    """An image with what was found on its file.

    Attributes
    ----------
    image : ImageData
        On an axis-aligned grid, LPS, mm.
    modality : str
        "CT", "MR", … of DICOM; empty where the file does not say it.
    findings : tuple of Finding
    """

    image: ImageData
    modality: str = ""
    findings: tuple[Finding, ...] = ()


def read_image(path: str | os.PathLike[str]) -> ImageData:
    """The image of a file or a DICOM folder, in LPS on an axis-aligned grid.

    Parameters
    ----------
    path : path
        NRRD, NIfTI, MetaImage, a DICOM file of several frames, or a folder of DICOM slices.

    Raises
    ------
    ImageError
        (also `ValueError`) Truncated, empty, not three-dimensional, one slice, colours, MR, slices
        missing.
    FileNotFoundError

    Examples
    --------
    >>> import cmfsim
    >>> image = cmfsim.read_image("head.nii.gz")  # doctest: +SKIP
    """
    return read_image_file(path).image


def read_image_file(path: str | os.PathLike[str]) -> ImageFile:
    """The image of a file or a DICOM folder, with its modality and findings.

    Raises
    ------
    ImageError
        (also `ValueError`) As `read_image`.
    FileNotFoundError
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    itk = _simpleitk()
    shown = bool(itk.ProcessObject.GetGlobalWarningDisplay())
    # ITK prints its warnings; what matters of them is found here.
    itk.ProcessObject.GlobalWarningDisplayOff()
    try:
        if path.is_dir():
            image, modality, findings = _read_series(itk, path)
        else:
            image, modality, findings = _read_file(itk, path)
        return _in_lps(itk, image, modality, findings, path)
    finally:
        if shown:
            itk.ProcessObject.GlobalWarningDisplayOn()


def write_image(image: ImageData, path: str | os.PathLike[str]) -> None:
    """Nothing; the image is in a file, whose name ends in .nrrd, .nii, .nii.gz or .mha.

    It is written under another name first, so that a failure leaves an older file whole.

    Raises
    ------
    ImageError
        (also `ValueError`) Another ending.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> image = cmfsim.ImageData(np.zeros((4, 4, 4), dtype=np.int16), spacing=(1, 1, 1))
    >>> cmfsim.write_image(image, "image.nrrd")  # doctest: +SKIP
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
    written.SetSpacing([float(s) for s in np.asarray(image.spacing)])
    written.SetOrigin([float(o) for o in image.lowest])
    # ITK tells the format by the ending of a name, and opens the file itself: so it gets a folder.
    prefix = f".{path.name}.writing-"
    for left in abandoned(path.parent, f"{glob.escape(prefix)}*"):
        shutil.rmtree(left, ignore_errors=True)
    with temporary_folder(path.parent, prefix) as fresh:
        try:
            temporary = fresh / f"image{suffix}"
            itk.WriteImage(written, str(temporary), useCompression=True)
            temporary.replace(path)
        except RuntimeError as error:
            raise ImageError(f"{path.name}: cannot be written ({_last_line(error)})") from error
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _simpleitk() -> Any:
    try:
        return import_module("SimpleITK")
    except ModuleNotFoundError as error:
        raise ImageError("images are read with SimpleITK: pip install 'cmfsim[imaging]'") from error


def _last_line(error: Exception) -> str:
    """What ITK says of an error, without the places in its sources."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def _read_file(itk: Any, path: Path) -> tuple[Any, str, list[Finding]]:
    if path.stat().st_size == 0:
        raise ImageInputError(f"{path.name}: is empty")
    reader = itk.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise ImageInputError(
            f"{path.name}: is no image that can be read ({_last_line(error)}); NRRD, NIfTI, "
            "MetaImage or DICOM is needed"
        ) from error
    modality = _tag(reader, _MODALITY)
    _check_modality(path, modality)
    _check_shape(path, [int(n) for n in reader.GetSize()], int(reader.GetNumberOfComponents()))
    if path.name.lower().endswith((".nii", ".nii.gz")):
        _check_nifti_length(path)
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise ImageInputError(
            f"{path.name}: is cut short or damaged ({_last_line(error)}); copy it again"
        ) from error
    if image.GetDimension() == 4:
        image = image[:, :, :, 0]
    return image, modality, []


def _check_nifti_length(path: Path) -> None:
    """Refuses a NIfTI file with fewer bytes than its header says: ITK reads zeros for the rest."""
    opener: Any = gzip.open if _packed(path) else open
    try:
        with opener(path, "rb") as file:
            header = file.read(NIFTI_HEADER)
            needed = _nifti_length(header)
            found = len(header)
            while block := file.read(2**22):
                found += len(block)
    except (EOFError, OSError, struct.error, zlib.error) as error:
        raise ImageInputError(
            f"{path.name}: is cut short or damaged ({error}); copy it again"
        ) from error
    if found < needed:
        raise ImageInputError(
            f"{path.name}: is cut short: {found} of {needed} bytes; copy it again"
        )


def _packed(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def _nifti_length(header: bytes) -> int:
    """The bytes of a file by its header, of NIfTI-1 (348 bytes) or NIfTI-2 (540)."""
    order = next((o for o in "<>" if struct.unpack(f"{o}i", header[:4])[0] in {348, 540}), None)
    if order is None:
        message = "no NIfTI header"
        raise OSError(message)
    if struct.unpack(f"{order}i", header[:4])[0] == 348:
        shape = struct.unpack(f"{order}8h", header[40:56])
        bits = struct.unpack(f"{order}h", header[72:74])[0]
        start = struct.unpack(f"{order}f", header[108:112])[0]
    else:
        shape = struct.unpack(f"{order}8q", header[16:80])
        bits = struct.unpack(f"{order}h", header[14:16])[0]
        start = struct.unpack(f"{order}q", header[168:176])[0]
    voxels = 1
    for n in shape[1 : shape[0] + 1]:
        voxels *= int(n)
    return int(start) + voxels * int(bits) // 8


def _check_shape(path: Path, size: list[int], components: int) -> None:
    text = " × ".join(map(str, size))
    if components != 1:
        raise ImageInputError(
            f"{path.name}: has {components} numbers per voxel (colours or vectors): one is needed"
        )
    if len(size) > 3 and any(n > 1 for n in size[3:]):
        raise ImageInputError(
            f"{path.name}: has {len(size)} axes ({text}): save one volume of the series"
        )
    if len(size) < 3 or min(size[:3]) < 2:
        raise ImageInputError(
            f"{path.name}: is a single slice ({text}): a volume is needed; for DICOM give the "
            "folder of all slices"
        )
    if float(np.prod(np.array(size, dtype=np.float64))) > MOST_VOXELS:
        raise ImageInputError(f"{path.name}: has {text} voxels: at most {MOST_VOXELS} are read")


def _check_modality(path: Path, modality: str) -> None:
    if modality and modality != "CT":
        raise ImageInputError(
            f"{path.name}: DICOM modality is {modality!r}: a CT is needed, for thresholds are in HU"
        )


def _tag(reader: Any, name: str) -> str:
    return str(reader.GetMetaData(name)).strip() if reader.HasMetaDataKey(name) else ""


def _read_series(itk: Any, folder: Path) -> tuple[Any, str, list[Finding]]:
    """The largest CT series of a folder."""
    findings: list[Finding] = []
    series = {
        str(uid): [str(f) for f in itk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), uid)]
        for uid in itk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    }
    if not series:
        raise ImageInputError(f"{folder.name}: the folder holds no DICOM image")
    described = {uid: _describe(itk, files) for uid, files in series.items()}
    cts = [uid for uid in series if described[uid][0] in {"", "CT"}]
    if not cts:
        found = ", ".join(sorted({m for m, _ in described.values()}))
        raise ImageInputError(
            f"{folder.name}: DICOM modality is {found!r}: a CT is needed, for thresholds are in HU"
        )
    cts.sort(key=lambda uid: (-len(series[uid]), uid))
    chosen = cts[0]
    if len(cts) > 1 and len(series[cts[1]]) == len(series[chosen]):
        names = " and ".join(repr(described[u][1] or u) for u in cts[:2])
        raise ImageInputError(
            f"{folder.name}: two series of {len(series[chosen])} slices each, {names}: keep one in "
            "the folder"
        )
    if len(series) > 1:
        findings.append(
            Finding(
                "warning",
                "dicom-series",
                f"{len(series)} series in the folder; the largest CT, "
                f"{described[chosen][1] or chosen!r} with {len(series[chosen])} slices, was taken",
                where=folder.name,
                why="another series may be the one that was meant",
                mend="keep one series in the folder",
            )
        )
    files = series[chosen]
    if len(files) == 1:
        image, modality, more = _read_file(itk, Path(files[0]))
        return image, modality, findings + more
    _check_slices(itk, folder, files)
    reader = itk.ImageSeriesReader()
    reader.SetFileNames(files)
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise ImageInputError(
            f"{folder.name}: slices are cut short, damaged or of different size "
            f"({_last_line(error)})"
        ) from error
    _check_shape(folder, [int(n) for n in image.GetSize()], image.GetNumberOfComponentsPerPixel())
    return image, described[chosen][0], findings


def _describe(itk: Any, files: list[str]) -> tuple[str, str]:
    """Modality and description of a series."""
    reader = _header(itk, files[0])
    return _tag(reader, _MODALITY), _tag(reader, _SERIES)


def _header(itk: Any, file: str) -> Any:
    reader = itk.ImageFileReader()
    reader.SetFileName(file)
    reader.SetImageIO("GDCMImageIO")
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise ImageInputError(
            f"{Path(file).name}: is cut short or damaged ({_last_line(error)})"
        ) from error
    return reader


def _check_slices(itk: Any, folder: Path, files: list[str]) -> None:
    """Refuses slices that are not evenly spaced, naming the gap."""
    places, normal = [], None
    for file in files:
        reader = _header(itk, file)
        position = _numbers(_tag(reader, _POSITION), 3)
        across = _numbers(_tag(reader, _ORIENTATION), 6)
        if position is None or across is None:
            raise ImageInputError(
                f"{folder.name}: slice {Path(file).name} does not say where it lies (DICOM tags "
                "0020,0032 and 0020,0037)"
            )
        if normal is None:
            normal = np.cross(across[:3], across[3:])
        places.append(float(position @ normal))
    order = np.sort(places)
    steps = np.diff(order)
    usual = float(np.median(steps))
    if usual <= 0.0 or steps.min() < 1e-3:
        at = float(order[int(np.argmin(steps))])
        raise ImageInputError(
            f"{folder.name}: two slices lie at {at:.2f} mm: more than one scan in the series"
        )
    bad = np.flatnonzero(np.abs(steps - usual) > UNEVEN * usual)
    if len(bad):
        i = int(bad[np.argmax(np.abs(steps[bad] - usual))])
        raise ImageInputError(
            f"{folder.name}: slices are {usual:.3g} mm apart, but {steps[i]:.3g} mm between "
            f"{order[i]:.2f} and {order[i + 1]:.2f} mm ({len(bad)} such steps): slices are missing "
            "or unevenly spaced; export the series again"
        )


def _numbers(text: str, count: int) -> NDArray[np.float64] | None:
    try:
        values = np.array([float(v) for v in text.split("\\")])
    except ValueError:
        return None
    return values if values.shape == (count,) and np.isfinite(values).all() else None


def _in_lps(itk: Any, image: Any, modality: str, findings: list[Finding], path: Path) -> ImageFile:
    spacing = np.array(image.GetSpacing())
    direction = np.array(image.GetDirection()).reshape(3, 3)
    if not (np.isfinite(spacing).all() and (spacing > 0.0).all()):
        raise ImageInputError(f"{path.name}: spacing is {spacing.tolist()} mm: must be above 0")
    if not np.isfinite(direction).all() or abs(abs(np.linalg.det(direction)) - 1.0) > 1e-2:
        raise ImageInputError(
            f"{path.name}: direction {direction.round(4).tolist()} is no rotation of axes"
        )
    values = itk.GetArrayViewFromImage(image)
    if values.dtype.kind == "f":
        _check_finite(values, path)
    image = itk.DICOMOrient(image, "LPS")
    direction = np.array(image.GetDirection()).reshape(3, 3)
    off = float(np.abs(direction - np.eye(3)).max())
    if off > OBLIQUE:
        angle = float(np.degrees(np.arccos(np.clip((np.trace(direction) - 1.0) / 2.0, -1.0, 1.0))))
        image = _upright(itk, image, direction)
        findings = [
            *findings,
            Finding(
                "note",
                "image-oblique",
                f"the image's axes are turned by {angle:.1f}° from the patient's; it was resampled",
                where=path.name,
                why="everything works on a grid along the patient's axes",
            ),
        ]
    voxels = itk.GetArrayFromImage(image).T
    return ImageFile(
        ImageData(voxels, image.GetSpacing(), image.GetOrigin()), modality, tuple(findings)
    )


def _check_finite(values: NDArray[Any], path: Path) -> None:
    count = sum(int(np.count_nonzero(~np.isfinite(layer))) for layer in values)
    if count:
        raise ImageInputError(
            f"{path.name}: {count} voxels are NaN or infinite: every value must be finite"
        )


def _upright(itk: Any, image: Any, direction: NDArray[np.float64]) -> Any:
    """The image on the smallest grid along the patient's axes that holds it."""
    size = np.array(image.GetSize())
    corners = np.array(
        [
            image.TransformIndexToPhysicalPoint(
                [int(n - 1) if (corner >> a) & 1 else 0 for a, n in enumerate(size)]
            )
            for corner in range(8)
        ]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    # Each new axis takes the spacing of the old axis nearest to it.
    spacing = np.array(image.GetSpacing())[np.argmax(np.abs(direction), axis=1)]
    count = np.floor((high - low) / spacing + 1e-6).astype(int) + 1
    if float(np.prod(count.astype(np.float64))) > MOST_VOXELS:
        raise ImageInputError(f"the turned image would need {' × '.join(map(str, count))} voxels")
    least = float(itk.GetArrayViewFromImage(image).min())
    resampler = itk.ResampleImageFilter()
    resampler.SetSize([int(n) for n in count])
    resampler.SetOutputSpacing([float(s) for s in spacing])
    resampler.SetOutputOrigin([float(o) for o in low])
    resampler.SetInterpolator(itk.sitkLinear)
    resampler.SetDefaultPixelValue(max(least, OUTSIDE))
    return resampler.Execute(image)
