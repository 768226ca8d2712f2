"""The exception family, how Python code of the package raises it, and missing optional packages.

The classes are defined by the extension, so that an error is the same class wherever it is
detected. If the input is at fault, the error is also a `ValueError`.
"""

from importlib import import_module
from threading import RLock
from typing import Any

from cmfsim._core import (
    BoundaryError,
    CaseError,
    CmfsimError,
    ContactError,
    ImageError,
    LandmarkError,
    MaterialError,
    MeshError,
    RegistrationError,
    SolverError,
)

__all__ = [
    "BoundaryError",
    "BoundaryInputError",
    "CalibrationError",
    "CaseError",
    "CaseInputError",
    "CmfsimError",
    "ContactError",
    "ImageError",
    "ImageInputError",
    "LandmarkError",
    "LandmarkInputError",
    "MaterialError",
    "MaterialInputError",
    "MeshError",
    "MeshInputError",
    "RegistrationError",
    "RegistrationInputError",
    "SolverError",
    "UnpairedError",
    "error_text",
    "third_party",
]


class BoundaryInputError(BoundaryError, ValueError):
    """An invalid motion, plan or boundary."""


class CaseInputError(CaseError, ValueError):
    """An invalid scene or case, in memory or on disk."""


class UnpairedError(CaseInputError):
    """Two surfaces with different triangles, where vertices are to be followed one by one."""


class CalibrationError(CaseInputError):
    """A calibration that does not match the prediction, or that is too small for the request."""


class MaterialInputError(MaterialError, ValueError):
    """Invalid options of a tissue."""


class MeshInputError(MeshError, ValueError):
    """Labels, levels or surfaces that cannot be meshed."""


class LandmarkInputError(LandmarkError, ValueError):
    """Invalid landmarks, in memory or on disk."""


class ImageInputError(ImageError, ValueError):
    """An image that is invalid: not three axes, no CT, damaged, no head in it."""


class RegistrationInputError(RegistrationError, ValueError):
    """Points, surfaces or volumes that cannot be registered."""


def error_text(error: BaseException) -> str:
    """The text of an error; a file of the system's errors comes first, as in the package's own."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__


# Python breaks a deadlock between threads that import parts of one package, such as scipy.ndimage
# and scipy.spatial, by handing out a module that is half imported.
_IMPORTING = RLock()


def third_party(
    module: str, purpose: str, extra: str, error: type[CmfsimError] = CaseInputError
) -> Any:
    """A module of an optional dependency; an error names the pip line for a missing one.

    module: As `import` takes it: "scipy.ndimage".
    purpose: Its use, as the beginning of a sentence: "bones are cut".
    extra: The extra of cmfsim that installs it.
    error: What to raise.
    Raises `CmfsimError`: (of type `error`) The module cannot be imported.
    """
    try:
        with _IMPORTING:
            return import_module(module)
    except ImportError as reason:
        package = module.partition(".")[0]
        raise error(
            f"{purpose} with {package}, which cannot be imported ({reason}): "
            f"pip install '.[{extra}]' in cmfsim's folder"
        ) from reason
