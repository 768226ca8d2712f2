"""A folder whose files are written together: all new ones take their places, or none does."""

import contextlib
import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

__all__ = ["replacing_files"]


def replacing_files(
    folder: Path,
    summary: str,
    is_ours: Callable[[str], bool],
    fill: Callable[[Path], Sequence[str]],
) -> list[str]:
    """The names of the files that `fill` wrote, now in the folder, which is made if need be.

    All files are written beside the old ones first and then take their places; where one cannot,
    the old ones come back. Files that an earlier summary lists and the new ones have not go.

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
        The folder cannot be made or written to.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        fresh = Path(tempfile.mkdtemp(prefix=".writing-", dir=folder))
        try:
            names = list(fill(fresh))
            gone = [n for n in _listed(folder / summary) if is_ours(n) and n not in names]
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


def _take_places(fresh: Path, folder: Path, names: Sequence[str], gone: Sequence[str]) -> None:
    """Puts new files in the place of old ones: all, or where one cannot be put, none."""
    old = fresh / "old"
    old.mkdir()
    for name in (*names, *gone):
        if (folder / name).exists():
            _keep(folder / name, old / name)
    try:
        for name in gone:
            (folder / name).unlink(missing_ok=True)
        for name in names:
            (fresh / name).replace(folder / name)
    except BaseException:
        for name in (*names, *gone):
            if (old / name).exists():
                (old / name).replace(folder / name)
            elif not (fresh / name).exists():
                (folder / name).unlink(missing_ok=True)
        raise


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
