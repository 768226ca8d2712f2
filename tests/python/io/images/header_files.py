"""Files of images with any header, and how the reader must refuse them."""

import gzip
import struct
import time

import numpy as np
import pytest

from cmfsim import ImageError
from cmfsim.io.images.image_files import read_image, read_image_file

SHAPE = (4, 5, 6)
VALUES = np.arange(120, dtype="<i2").reshape(SHAPE[::-1]).T
SHEARED = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.6, 6.0], [0.0, 0.0, 2.0, 7.0]]


def write_nrrd(path, *lines, values=VALUES, data=True, **fields):
    given = {
        "type": "short",
        "dimension": "3",
        "space": "left-posterior-superior",
        "sizes": "4 5 6",
        "space directions": "(1,0,0) (0,1,0) (0,0,2)",
        "space origin": "(1,2,3)",
        "encoding": "raw",
        "endian": "little",
    } | {name.replace("_", " "): text for name, text in fields.items()}
    header = ["NRRD0004", *(f"{k}: {v}" for k, v in given.items() if v is not None), *lines]
    text = "\n".join(header) + "\n\n"
    path.write_bytes(text.encode() + (values.T.tobytes() if data else b""))
    return path


def write_nifti(
    path,
    *,
    qform=0,
    sform=1,
    rows=SHEARED,
    spacing=(1.0, 1.0, 2.0),
    units=2,
    offset=(5.0, 6.0, 7.0),
    quaternion=(0.0, 0.0, 0.0),
    shape=(3, 4, 5, 6, 1, 1, 1, 1),
    kind=(4, 16),
    start=352.0,
    scale=(1.0, 0.0),
    magic=b"n+1\0",
):
    header = bytearray(352)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, *shape)
    struct.pack_into("<2h", header, 70, *kind)
    struct.pack_into("<8f", header, 76, 1.0, *spacing, 0, 0, 0, 0)
    struct.pack_into("<3f", header, 108, start, *scale)
    header[123] = units
    struct.pack_into("<2h", header, 252, qform, sform)
    struct.pack_into("<6f", header, 256, *quaternion, *offset)
    struct.pack_into("<12f", header, 280, *np.ravel(rows))
    header[344:348] = magic
    data = bytes(header) + VALUES.T.tobytes()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def write_meta(path, *, data=True, **fields):
    given = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "Offset": "1 2 3",
        "ElementSpacing": "1 1 2",
        "DimSize": "4 5 6",
        "ElementType": "MET_SHORT",
    } | fields
    given["ElementDataFile"] = given.pop("ElementDataFile", "LOCAL")
    text = "".join(f"{k} = {v}\n" for k, v in given.items())
    path.write_bytes(text.encode() + (VALUES.T.tobytes() if data else b""))
    return path


def refused(path, *words):
    begun = time.monotonic()
    with pytest.raises(ImageError) as caught:
        read_image(path)
    assert isinstance(caught.value, ValueError)
    for word in (path.name, *words):
        assert word in str(caught.value)
    return time.monotonic() - begun


def codes(path):
    return [f.code for f in read_image_file(path).findings]
