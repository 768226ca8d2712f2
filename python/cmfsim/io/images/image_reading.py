"""Voxels by ITK's readers. These functions run in the child process (`cmfsim.processes.child`)."""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.errors import ImageInputError
from cmfsim.processes.worker import Answer

# What the child process imports before the time of a file begins.
LIBRARIES = ("SimpleITK",)


def read_volume(path: str, reader: str) -> Answer:
    """The voxels of a file, axes z, y, x, with the place that the reader gives them."""
    image = _read(path, reader)
    if image.GetDimension() == 4:
        image = image[:, :, :, 0]
    place = {
        "size": list(image.GetSize()),
        "spacing": list(image.GetSpacing()),
        "origin": list(image.GetOrigin()),
        "direction": list(image.GetDirection()),
    }
    return Answer(place, {"values": _itk().GetArrayFromImage(image)})


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
