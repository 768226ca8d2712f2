"""Archives of arrays with a JSON text, the `.npz` form of values. Nothing is unpickled.

An array is unpacked when it is asked for, after its header has been held against the size that the
archive states: what a stranger adds to an archive costs nothing.
"""

import io as stdio
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import (
    FORMAT_VERSION,
    UNITS,
    check_numbers,
    check_readable,
    check_units,
    check_version,
    parsed_json,
    replacing,
)

# Members of an archive: a scene has ten for each segment.
MAX_MEMBERS = 10_000
# Unpacked size up to which an archive is read, bytes: a scene of 20 million tets fits, a
# decompression bomb does not. Nor does what unpacks to more than this many times its size: arrays
# of one value pack a thousandfold, but nodes and tets beside them fourfold at most.
MAX_UNPACKED = 16 * 2**30
MAX_RATIO, FREE = 200, 2**28
# Characters of the JSON text.
MAX_TEXT = 2**26
# Kinds of numpy arrays that are read: numbers, flags and texts.
KINDS = "fiubU"
CHUNK = 2**20
ENDING = ".npy"
# zlib's effort: the least. A prediction's arrays take a third of the time of numpy's effort.
PACKING = 1
# What begins each entry of an archive's directory.
ENTRY = b"PK\x01\x02"
ENCRYPTED = 0x1
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class _Members(Mapping[str, NDArray[Any]]):
    """The arrays of an archive by name, each unpacked when it is asked for."""

    def __init__(self, data: bytes) -> None:
        # The whole file as it is now: a run that replaces it does not mix its arrays with these.
        if data.count(ENTRY) > 2 * MAX_MEMBERS:
            raise CaseInputError(f"has more than {MAX_MEMBERS} members")
        try:
            self._archive = zipfile.ZipFile(stdio.BytesIO(data))
        except Exception as error:
            raise CaseInputError(f"is not an .npz archive, or is cut short ({error})") from error
        infos = self._archive.infolist()
        self._infos = {info.filename.removesuffix(ENDING): info for info in infos}
        # A damaged name must not make an array look absent.
        other = next((i.filename for i in infos if not i.filename.endswith(ENDING)), None)
        if other is not None:
            raise CaseInputError(f"has the member {other[:60]!r}, which is not an array")
        if len(infos) > MAX_MEMBERS:
            raise CaseInputError(f"has {len(infos)} members: at most {MAX_MEMBERS} are read")
        names = {info.filename for info in infos}
        if len(names) < len(infos):
            raise CaseInputError(f"has {len(infos) - len(names)} members of the same name")
        self._left = min(MAX_UNPACKED, FREE + MAX_RATIO * len(data))

    def __getitem__(self, name: str) -> NDArray[Any]:
        info = self._infos[name]
        if info.file_size > self._left:
            raise CaseInputError(
                f"array {name!r} unpacks to {info.file_size} bytes: {self._left} more are read of "
                "an archive of this size"
            )
        if info.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise CaseInputError(f"array {name!r} is not compressed as numpy does it")
        if info.flag_bits & ENCRYPTED:
            raise CaseInputError(f"array {name!r} is encrypted")
        self._left -= info.file_size
        try:
            return _unpacked(self._archive, info)
        except CaseInputError as error:
            raise CaseInputError(f"array {name!r} {error}") from error
        # Damaged headers raise whatever zipfile, zlib, struct and the tokenizer raise.
        except Exception as error:
            raise CaseInputError(f"array {name!r} cannot be read ({error})") from error

    def __iter__(self) -> Iterator[str]:
        return iter(self._infos)

    def __len__(self) -> int:
        return len(self._infos)


def _unpacked(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    # zipfile's own type of a member lacks what it can do.
    file: Any
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version not in HEADERS:
            raise CaseInputError(f"has numpy's format {version}, which is not supported")
        shape, by_columns, dtype = HEADERS[version](file)
        if dtype.hasobject:
            raise CaseInputError("holds Python objects: these are pickled, and never read")
        if dtype.kind not in KINDS:
            raise CaseInputError(f"has dtype {dtype}: numbers, flags and texts are read")
        if min(shape, default=0) < 0:
            raise CaseInputError(f"has shape {shape}")
        size = math.prod(shape) * dtype.itemsize
        if file.tell() + size != info.file_size:
            raise CaseInputError(
                f"states {dtype} of shape {shape}, {size} bytes, and has "
                f"{info.file_size - file.tell()}"
            )
        raw = np.empty(size, dtype=np.uint8)
        view = memoryview(raw.data)
        for start in range(0, size, CHUNK):
            part = view[start : start + CHUNK]
            # The member's checksum is compared when its last byte is read.
            if file.readinto(part) != len(part):
                raise CaseInputError("is cut short")
        if file.read(1):
            raise CaseInputError("is longer than stated")
    if not size:
        return np.zeros(shape, dtype)
    array: NDArray[Any] = raw.view(dtype)
    return array.reshape(shape[::-1]).T if by_columns else array.reshape(shape)


def read_archive(
    path: Path, format_name: str, text_name: str
) -> tuple[dict[str, Any], Mapping[str, NDArray[Any]]]:
    """Header and arrays of an archive of this format, which its header states as its `format`.

    An array is unpacked when it is asked for: looking one up is an error where it is damaged or too
    large. `text_name` is the member that is the header, a JSON text.
    """
    check_readable(path)
    try:
        members = _Members(path.read_bytes())
    except MemoryError as error:
        raise CaseInputError("does not fit into memory") from error
    if text_name not in members:
        raise CaseInputError(f"lacks the member {text_name!r}: it is not a {format_name} file")
    text = members[text_name]
    if text.shape != () or text.dtype.kind != "U" or text.dtype.itemsize > 4 * MAX_TEXT:
        raise CaseInputError(f"member {text_name!r} is not a text of at most {MAX_TEXT} characters")
    try:
        header = parsed_json(str(text))
    except (ValueError, RecursionError) as error:
        raise CaseInputError(f"member {text_name!r} is not JSON ({error})") from error
    if not isinstance(header, dict):
        raise CaseInputError(f"member {text_name!r} is not a JSON object")
    if header.get("format") != format_name:
        raise CaseInputError(f"format is {header.get('format')!r}: {format_name!r} is needed")
    check_version(header.get("version"))
    check_units(header.get("units"))
    check_numbers(header, finite=True)
    return header, members


def write_archive(
    path: Path,
    format_name: str,
    text_name: str,
    header: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    """Replaces an archive in one step."""
    head = {"format": format_name, "version": FORMAT_VERSION, "units": dict(UNITS), **header}
    text = json.dumps(head, ensure_ascii=True, allow_nan=False)
    members = {text_name: np.array(text), **arrays}
    # As numpy's own writer does it, but packed faster: floats hardly get smaller by more effort.
    with (
        replacing(path) as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=PACKING) as archive,
    ):
        for name, array in members.items():
            with archive.open(f"{name}{ENDING}", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)


def member_of(members: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """An array of an archive by its name."""
    if name not in members:
        raise CaseInputError(f"lacks the array {name!r}")
    return members[name]
