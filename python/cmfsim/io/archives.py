"""Archives of arrays with a JSON text, the `.npz` form of values. Nothing is unpickled."""

import errno
import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.files import FORMAT_VERSION, check_version, refuse_constant, replacing

__all__ = [
    "member_of",
    "read_archive",
    "write_archive",
]

UNITS = {"length": "mm", "stress": "MPa", "force": "N"}
# Unpacked size up to which an archive is read, bytes: a scene of 20 million tets fits, a
# decompression bomb does not.
MAX_UNPACKED = 16 * 2**30


def read_archive(
    path: Path, format_name: str, text_name: str
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of an archive of this format."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > MAX_UNPACKED:
            raise CaseInputError(f"unpacks to {unpacked} bytes: at most {MAX_UNPACKED} are read")
        with np.load(path, allow_pickle=False) as archive:
            members = {name: archive[name] for name in archive.files}
    except zipfile.BadZipFile as error:
        raise CaseInputError(f"is not an .npz archive, or is cut short ({error})") from error
    except OSError as error:
        # A damaged directory sends the reader to places before the file's start.
        if error.errno != errno.EINVAL:
            raise
        raise CaseInputError(f"is not an .npz archive, or is damaged ({error})") from error
    except (ValueError, EOFError, KeyError, zlib.error, MemoryError, RuntimeError) as error:
        if isinstance(error, CaseInputError):
            raise
        raise CaseInputError(f"holds an array that cannot be read ({error})") from error
    if text_name not in members:
        raise CaseInputError(f"lacks the member {text_name!r}: it is not a {format_name} file")
    text = members.pop(text_name)
    if text.shape != () or text.dtype.kind != "U":
        raise CaseInputError(f"member {text_name!r} is not a text")
    try:
        header = json.loads(str(text), parse_constant=refuse_constant)
    except (ValueError, RecursionError) as error:
        raise CaseInputError(f"member {text_name!r} is not JSON ({error})") from error
    if not isinstance(header, dict):
        raise CaseInputError(f"member {text_name!r} is not a JSON object")
    if header.get("format") != format_name:
        raise CaseInputError(f"format is {header.get('format')!r}: {format_name!r} is needed")
    check_version(header.get("version"))
    return header, members


def write_archive(
    path: Path,
    format_name: str,
    text_name: str,
    header: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    """Replaces an archive in one step."""
    head = {"format": format_name, "version": FORMAT_VERSION, "units": UNITS, **header}
    text = json.dumps(head, ensure_ascii=True, allow_nan=False)
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **{text_name: np.array(text), **arrays})


def member_of(members: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """An array of an archive by its name."""
    if name not in members:
        raise CaseInputError(f"lacks the array {name!r}")
    return members[name]
