"""A folder whose files are written together: all new ones take their places, or none does."""

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from cmfsim.io.leftovers import abandoned, holding, temporary_folder

__all__ = ["finish_writing", "replacing_files"]

PREFIX = ".writing-"
# In a folder of new files that are whole: which take their places, and which old ones go. A run
# that is killed after it wrote this is finished by the next.
READY = "ready.json"


def replacing_files(
    folder: Path,
    summary: str,
    is_ours: Callable[[str], bool],
    fill: Callable[[Path], Sequence[str]],
) -> list[str]:
    """The names of the files that `fill` wrote, now in the folder, which is made if need be.

    All files are written beside the old ones first and then take their places; where one cannot,
    the old ones come back. Files that an earlier summary lists and the new ones have not go. What
    a killed run left is taken away, or finished if only places had still to be taken.

    Parameters
    ----------
    folder : Path
    summary : str
        The JSON file whose "files" lists what was written; `fill` writes it last.
    is_ours : callable
        Whether a file of a name may be taken away.
    fill : callable
        Writes the files into the folder that it is given, and returns their names.

    Raises
    ------
    OSError
        The folder cannot be made or written to; names it.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        with _naming(folder):
            folder.mkdir(parents=True, exist_ok=True)
            finish_writing(folder)
            with temporary_folder(folder, PREFIX) as fresh:
                try:
                    names = list(fill(fresh))
                    with holding(folder):
                        gone = [
                            n for n in _listed(folder / summary) if is_ours(n) and n not in names
                        ]
                        _take_places(fresh, folder, names, gone)
                    return names
                finally:
                    shutil.rmtree(fresh, ignore_errors=True)
    except BaseException:
        # Folders that were made for nothing; one that holds something stays.
        with contextlib.suppress(OSError):
            for path in made:
                path.rmdir()
        raise


def finish_writing(folder: Path) -> None:
    """Ends what killed runs left in a folder: whole files take their places, others go."""
    for left in abandoned(folder, f"{PREFIX}*"):
        ready = _ready(left)
        if ready is not None:
            names, gone = ready
            with holding(folder):
                for name in names:
                    if (left / name).exists():
                        (left / name).replace(folder / name)
                for name in gone:
                    (folder / name).unlink(missing_ok=True)
        shutil.rmtree(left, ignore_errors=True)


@contextlib.contextmanager
def _naming(folder: Path) -> Iterator[None]:
    """Puts the folder's name into an error of the system that names no file, as of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(folder)) from error


def _take_places(fresh: Path, folder: Path, names: Sequence[str], gone: Sequence[str]) -> None:
    """Puts new files in the place of old ones: all, or where one cannot be put, none."""
    old = fresh / "old"
    old.mkdir()
    for name in (*names, *gone):
        if (folder / name).exists():
            _keep(folder / name, old / name)
    for name in names:
        _reach_disk(fresh / name)
    text = json.dumps({"names": [*names], "gone": [*gone]})
    part = fresh / f"{READY}.part"
    part.write_text(text, encoding="utf-8")
    _reach_disk(part)
    part.replace(fresh / READY)
    try:
        for name in names:
            (fresh / name).replace(folder / name)
        for name in gone:
            (folder / name).unlink(missing_ok=True)
    except BaseException:
        # First, so that a run that is killed here is not finished by the next.
        (fresh / READY).unlink()
        for name in (*names, *gone):
            if (old / name).exists():
                (old / name).replace(folder / name)
            elif not (fresh / name).exists():
                (folder / name).unlink(missing_ok=True)
        raise
    (fresh / READY).unlink()


def _ready(left: Path) -> tuple[list[str], list[str]] | None:
    """What a killed run had still to put in place; none if its files are not whole."""
    try:
        found = json.loads((left / READY).read_text(encoding="utf-8"))
        names, gone = found["names"], found["gone"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    plain = all(isinstance(n, str) and n and Path(n).name == n for n in (*names, *gone))
    return (names, gone) if plain else None


def _reach_disk(path: Path) -> None:
    """Waits until the content of a file is on the disk: a name must not come before it."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _keep(path: Path, copy: Path) -> None:
    """A second name for a file, or a copy where the file system knows no second names."""
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder, where a file is to be written")
    try:
        copy.hardlink_to(path)
    except OSError:
        shutil.copy2(path, copy)


def _listed(summary: Path) -> list[str]:
    """The files that an earlier summary lists, where there is one."""
    try:
        listed = json.loads(summary.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [name for name in listed if isinstance(name, str)]
