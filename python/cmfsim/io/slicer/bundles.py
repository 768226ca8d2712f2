"""Bundles of 3D Slicer (`.mrb`): a scene with its files in one zip, unpacked with limits."""

import re
import shutil
import stat
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import check_readable, named

# A planning scene has some hundred files, with a CT of half a gigabyte.
MAX_MEMBERS = 5000
MAX_UNPACKED = 8 * 2**30
# Surfaces and images pack tenfold at most, a decompression bomb a thousandfold.
MAX_RATIO, FREE = 100, 2**28
CHUNK = 2**20
ENCRYPTED = 0x1
DRIVE = re.compile(r"^[A-Za-z]:")
MAX_PATH = 500
# Bytes of a name that every system takes.
MAX_NAME = 200


def unpack_bundle(path: Path, folder: Path) -> Path:
    """The scene file of a bundle that was unpacked into a folder.

    Parameters
    ----------
    path : Path
        `.mrb`.
    folder : Path
        Empty, and the caller's to remove.

    Raises
    ------
    FileNotFoundError
        The bundle does not exist.
    CaseError
        (also `ValueError`) Not a zip archive, damaged, encrypted; a name that leads out of the
        folder, a link; more or larger files than a scene has; no scene, or several.
    """
    check_readable(path)
    with named(path):
        try:
            archive = zipfile.ZipFile(path)
        # Damaged archives raise whatever zipfile, zlib and struct raise.
        except Exception as error:
            raise CaseInputError(
                f"is not a 3D Slicer bundle, or is damaged ({error}): save it again"
            ) from error
        with archive:
            scenes = _unpack(archive, path.stat().st_size, folder)
        if len(scenes) != 1:
            raise CaseInputError(f"holds {len(scenes)} scenes (.mrml): one is needed")
        return scenes[0]


def _unpack(archive: zipfile.ZipFile, packed: int, folder: Path) -> list[Path]:
    members = archive.infolist()
    if len(members) > MAX_MEMBERS:
        raise CaseInputError(f"holds {len(members)} files: at most {MAX_MEMBERS} are unpacked")
    _check_names(members)
    limit = min(MAX_UNPACKED, FREE + MAX_RATIO * packed)
    total = sum(member.file_size for member in members)
    if total > limit:
        raise CaseInputError(
            f"unpacks to {total} bytes: at most {limit} are unpacked from an archive of {packed}"
        )
    free = shutil.disk_usage(folder).free
    if total > free:
        raise CaseInputError(f"unpacks to {total} bytes, and {free} are free at {folder}")
    scenes: list[Path] = []
    for member in members:
        target = folder / member.filename
        if member.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            for block in _blocks(archive, member):
                file.write(block)
        if target.suffix.lower() == ".mrml":
            scenes.append(target)
    return scenes


def _blocks(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Iterator[bytes]:
    """The content of a member, no more than its header states."""
    try:
        # zipfile reads no more than the header states, and compares the checksum.
        with archive.open(member) as source:
            while block := source.read(CHUNK):
                yield block
    except Exception as error:
        raise CaseInputError(
            f"{member.filename[:80]!r} in it is damaged ({error}): save the bundle again"
        ) from error


def _check_names(members: Sequence[zipfile.ZipInfo]) -> None:
    seen: set[str] = set()
    files: set[str] = set()
    for member in members:
        name = member.filename
        shown = name[:80]
        place = PurePosixPath(name)
        leads_out = place.is_absolute() or ".." in place.parts or DRIVE.match(name)
        too_long = len(name) > MAX_PATH or any(len(p.encode()) > MAX_NAME for p in place.parts)
        if leads_out or not place.parts or too_long or any(c in name for c in "\\\0"):
            raise CaseInputError(
                f"names the file {shown!r}, which would be outside the folder: nothing is unpacked"
            )
        if stat.S_ISLNK(member.external_attr >> 16):
            raise CaseInputError(f"holds the link {shown!r}: links are not unpacked")
        if member.flag_bits & ENCRYPTED:
            raise CaseInputError(f"is encrypted ({shown!r}): save it without a password")
        key = str(place).casefold()
        if key in seen:
            raise CaseInputError(f"holds {shown!r} twice")
        seen.add(key)
        if not name.endswith("/"):
            files.add(key)
    for key in seen:
        above = next((str(p) for p in PurePosixPath(key).parents if str(p) in files), None)
        if above is not None:
            raise CaseInputError(f"holds {above[:80]!r} as a file and as a folder")
