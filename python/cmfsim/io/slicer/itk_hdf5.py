"""ITK's transforms in HDF5 files (`.h5`): their kinds and numbers, read by SimpleITK in the child.

HDF5 is a binary format with pointers inside, which its library follows in C; a damaged file ends
the child process, not this one.
"""

import re
from importlib import import_module
from pathlib import Path

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import utf8_path
from cmfsim.processes.child import ReaderError, read_in_child
from cmfsim.processes.worker import Answer, ReadLimits
from cmfsim.values.checks import Floats

SIGNATURE = b"\x89HDF\r\n\x1a\n"
# A rigid transform takes some 8 kB; above this a file holds a displacement field, bytes.
MAX_FILE = 2**26
# Processor time that reading may take, s: a transform needs some thousandths.
SECONDS = 1.0
# What the child process imports before this time begins.
LIBRARIES = ("SimpleITK",)
# The name of one dataset in the group of each transform. SimpleITK reads the first group and only
# warns of further ones, so they are counted here; HDF5 stores names of links as plain text.
TYPE_NAME = b"TransformType"
# ITK's words where a class is not registered, as 3D Slicer's nonlinear inverse transforms are not.
UNKNOWN_KIND = re.compile(r"create an instance of \W*(\w+)")


def read_itk_hdf5(path: Path) -> list[tuple[str, Floats, Floats]]:
    """Kind, parameters and fixed parameters of each transform in a file, composites first.

    Kinds are ITK's class names without precision and dimension, such as "Euler3DTransform". Errors
    are without the file's name.
    """
    size = path.stat().st_size
    if size > MAX_FILE:
        raise CaseInputError(
            f"has {size} bytes, and a rigid transform some 8000: displacement fields are not read"
        )
    with path.open("rb") as file:
        if file.read(len(SIGNATURE)) != SIGNATURE:
            raise CaseInputError("is not an HDF5 file: save the transform as .h5 or .tfm again")
    try:
        with utf8_path(path) as plain:
            task = "cmfsim.io.slicer.itk_hdf5:parse_itk_hdf5"
            answer = read_in_child(task, ReadLimits(seconds=SECONDS), path=plain)
    except ReaderError as error:
        raise CaseInputError(f"{error}; save the transform as .tfm (ITK text)") from error
    return [
        (kind, answer.arrays[f"parameters.{n}"], answer.arrays[f"fixed.{n}"])
        for n, kind in enumerate(answer.values["kinds"])
    ]


def parse_itk_hdf5(path: str) -> Answer:
    """The transforms of a file as SimpleITK reads them; runs in the child process."""
    try:
        sitk = import_module("SimpleITK")
    except ImportError as error:
        raise CaseInputError(
            f"HDF5 transforms are read with SimpleITK, which cannot be imported ({error}): "
            "pip install '.[imaging]' in cmfsim's folder, or save the transform as .tfm (ITK text)"
        ) from error
    try:
        whole = sitk.ReadTransform(path)
    except RuntimeError as error:
        unknown = UNKNOWN_KIND.search(str(error))
        reason = f"holds {unknown[1]}, which ITK does not have" if unknown else "is damaged"
        raise CaseInputError(
            f"ITK cannot read it: it {reason}; save one linear transform as .h5 or .tfm"
        ) from error
    found = [whole]
    if isinstance(whole, sitk.CompositeTransform):
        found += [whole.GetNthTransform(n) for n in range(whole.GetNumberOfTransforms())]
    count = Path(path).read_bytes().count(TYPE_NAME)
    if count != len(found):
        raise CaseInputError(
            f"holds {count} transforms, of which ITK reads {len(found)}: save one per file"
        )
    if whole.GetDimension() != 3:
        raise CaseInputError(f"is a transform of {whole.GetDimension()}-D space, not of 3-D")
    kinds, arrays = [], {}
    for n, one in enumerate(found):
        is_identity = one.GetTransformEnum() == sitk.sitkIdentity
        kinds.append("IdentityTransform" if is_identity else one.GetName())
        is_composite = isinstance(one, sitk.CompositeTransform)
        parameters = () if is_composite or not one.IsLinear() else one.GetParameters()
        fixed = () if is_composite or not one.IsLinear() else one.GetFixedParameters()
        arrays[f"parameters.{n}"] = np.array(parameters, dtype=np.float64)
        arrays[f"fixed.{n}"] = np.array(fixed, dtype=np.float64)
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise CaseInputError(f"{name.partition('.')[0]} holds a number that is not finite")
    return Answer({"kinds": kinds}, arrays)
