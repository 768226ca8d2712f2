"""A folder whose files are written together: all new ones take their places, or none does."""

import contextlib
import errno
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from cmfsim.errors import CaseInputError
from cmfsim.io.files.leftovers import abandoned, holding, temporary_folder
from cmfsim.io.files.reading_writing import deleted_meanwhile

PREFIX = ".writing-"
# In a folder of new files that are whole: which take their places, and which old ones go. A run
# that is killed after it wrote this is finished by the next.
READY = "ready.json"
# The same, once a file could not take its place: the old ones come back.
UNDO = "undo.json"
# A journal lists names: above this size it is none of ours, bytes.
MOST_JOURNAL = 2**20
# Files that state what the others are. Old ones go first and new ones come last, so that files of
# two runs are never together beneath one of them.
STATEMENTS = (".json", ".html", ".toml")

Ours = Callable[[str], bool]


@dataclass(frozen=True)
class _Journal:
    """Which files take their places, which old ones go, and which of both were there before."""

    names: list[str]
    gone: list[str]
    old: list[str]


def replacing_files(
    folder: Path,
    summary: str | None,
    is_ours: Ours,
    fill: Callable[[Path], Sequence[str]],
    stale: Callable[[], Sequence[str]] | None = None,
) -> list[str]:
    """The names of the files that `fill` wrote, now in the folder, which is made if need be.

    All files are written next to the old ones first and then take their places; where one cannot,
    the old ones come back. Files that an earlier summary lists and the new ones have not go, and so
    do those that `stale` finds. What a killed run left is removed, or finished if only places had
    still to be taken: until then the files that state what the others are (`STATEMENTS`) are
    missing, so that nothing reads old and new files as one.

    summary: The JSON file whose "files" lists what was written; `fill` writes it last.
    fill: Writes the files into the folder that it is given, and returns their names: plain ones, or
        one folder and a name ("M/prediction.vtp").
    is_ours, stale: Whether a file of a name may be removed; names that go, asked after `fill`.
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
                        left = _listed(folder / summary) if summary else []
                        left += stale() if stale else ()
                        gone = [n for n in dict.fromkeys(left) if n not in names]
                        gone = [n for n in gone if _is_plain(n) and is_ours(n)]
                        _take_places(fresh, folder, names, gone)
                except FileNotFoundError as error:
                    if fresh.exists():
                        raise
                    raise deleted_meanwhile(folder) from error
                else:
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
    """Ends what killed runs left in a folder: whole files take their places, others go.

    What a stranger put there under such a name can neither lead out of the folder nor keep a run
    from working.
    """
    for left in abandoned(folder, f"{PREFIX}*", folders=True):
        undo, ready = _journal(left / UNDO), _journal(left / READY)
        with holding(folder), _naming(folder):
            if undo is not None:
                _put_back(left, folder, undo)
            elif ready is not None:
                _place(left, folder, ready)
        shutil.rmtree(left, ignore_errors=True)


def check_below(folder: Path, base: Path) -> None:
    """Refuses a folder that lies below another by its name, and elsewhere by a link.

    A case comes from strangers, and a link in it could have results replace files anywhere. A
    folder that does not lie below is the user's own choice.
    """
    if not folder.absolute().is_relative_to(base.absolute()):
        return
    try:
        real = folder.resolve()
        leads_out = not real.is_relative_to(base.resolve())
    except (OSError, RuntimeError) as error:  # a link that leads to itself
        raise CaseInputError(f"{folder}: cannot be followed ({error})") from error
    if leads_out:
        raise CaseInputError(
            f"{folder}: is a link that points outside the case's folder, to {real}: remove it, "
            f"or choose the target with -o {real}"
        )


def check_writable(folder: Path) -> None:
    """Finds before the work that a folder cannot be made or written to, by writing to it.

    Permissions do not tell: root has them all, and a disk may be read-only or full.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        what = "is a broken link" if there.is_symlink() else "is a file"
        raise CaseInputError(
            f"{there}: {what}, so the output folder cannot be created; choose another one with -o"
        )
    try:
        # The folder itself is made when there is something to put in it.
        Path(tempfile.mkdtemp(prefix=PREFIX, dir=there)).rmdir()
    except OSError as error:
        raise OSError(
            error.errno,
            f"the output folder is not writable ({error.strerror}); choose another one with -o",
            str(there),
        ) from error


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
    _check_subfolders(folder, (*names, *gone))
    old = fresh / "old"
    old.mkdir()
    kept = [name for name in (*names, *gone) if os.path.lexists(folder / name)]
    for name in kept:
        _keep(folder / name, old / name)
    for name in names:
        _reach_disk(fresh / name)
    journal = _Journal([*names], [*gone], kept)
    part = fresh / f"{READY}.part"
    part.write_text(json.dumps(asdict(journal)), encoding="utf-8")
    _reach_disk(part)
    part.replace(fresh / READY)
    try:
        _place(fresh, folder, journal)
    except BaseException:
        # At once, so that the next run does not finish what could not be done.
        (fresh / READY).replace(fresh / UNDO)
        _put_back(fresh, folder, journal)
        (fresh / UNDO).unlink()
        raise
    (fresh / READY).unlink()


def _place(fresh: Path, folder: Path, journal: _Journal) -> None:
    """Puts the files of a journal in place, from the beginning or from where it was stopped."""
    waiting = [name for name in journal.names if os.path.lexists(fresh / name)]
    _check_subfolders(folder, (*waiting, *journal.gone))
    statements = [name for name in waiting if name.endswith(STATEMENTS)]
    for name in (*statements, *sorted(journal.gone, key=lambda n: not n.endswith(STATEMENTS))):
        (folder / name).unlink(missing_ok=True)
    for name in sorted(waiting, key=lambda name: name.endswith(STATEMENTS)):
        (folder / name).parent.mkdir(exist_ok=True)
        (fresh / name).replace(folder / name)
    _remove_empty(folder, journal.gone)


def _put_back(fresh: Path, folder: Path, journal: _Journal) -> None:
    """Restores the old files of a journal, from the beginning or from where it was stopped."""
    names = [*dict.fromkeys([*journal.names, *journal.gone])]
    for name in names:
        # New statements go before old files come back beneath them.
        if name not in journal.old or name.endswith(STATEMENTS):
            is_back = name in journal.old and not os.path.lexists(fresh / "old" / name)
            if not is_back:
                (folder / name).unlink(missing_ok=True)
    for name in sorted(journal.old, key=lambda name: name.endswith(STATEMENTS)):
        if os.path.lexists(fresh / "old" / name):
            (folder / name).parent.mkdir(exist_ok=True)
            (fresh / "old" / name).replace(folder / name)
    _remove_empty(folder, names)


def _remove_empty(folder: Path, names: Sequence[str]) -> None:
    """Removes the subfolders of some names that hold nothing any more."""
    for parent in {(folder / name).parent for name in names} - {folder}:
        with contextlib.suppress(OSError):
            parent.rmdir()


def _check_subfolders(folder: Path, names: Sequence[str]) -> None:
    """Refuses a subfolder that leads elsewhere, or that is none."""
    for parent in sorted({(folder / name).parent for name in names} - {folder}):
        if parent.is_symlink() or (os.path.lexists(parent) and not parent.is_dir()):
            is_link = parent.is_symlink()
            what = "a link that points outside the output folder" if is_link else "a file"
            raise CaseInputError(f"{parent}: is {what}, but a folder of results is needed")


def _journal(path: Path) -> _Journal | None:
    """What a killed run had still to do; none if there is no journal, or one that is not ours."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > MOST_JOURNAL:
            return None
        content = json.loads(path.read_text(encoding="utf-8"))
        journal = _Journal(content["names"], content["gone"], content["old"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    lists = (journal.names, journal.gone, journal.old)
    if not all(isinstance(names, list) for names in lists):
        return None
    if not all(_is_plain(name) for names in lists for name in names):
        return None
    # A link or a folder in the place of a file was put there by someone else.
    files = [path.parent / name for name in journal.names]
    files += [path.parent / "old" / name for name in journal.old]
    if any(os.path.lexists(file) and not stat.S_ISREG(file.lstat().st_mode) for file in files):
        return None
    folder = path.parent.parent
    blocked = any((folder / name).is_dir() for name in (*journal.names, *journal.gone))
    return None if blocked else journal


def _is_plain(name: object) -> bool:
    """Whether a name is that of a file in the folder, or in a folder of it."""
    if not isinstance(name, str) or any(c in name for c in "\\:\0"):
        return False
    parts = name.split("/")
    return len(parts) <= 2 and not any(part in {"", ".", ".."} for part in parts)


def _reach_disk(path: Path) -> None:
    """Waits until the content of a file is on the disk: a name must not come before it."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _keep(path: Path, copy: Path) -> None:
    """A second name for a file, or a copy where the file system knows no second names."""
    if path.is_dir() and not path.is_symlink():
        text = "is a folder, but a file is to be written there: remove it, or give another output"
        raise IsADirectoryError(errno.EISDIR, text, str(path))
    copy.parent.mkdir(exist_ok=True)
    try:
        copy.hardlink_to(path)
    except OSError:
        shutil.copy2(path, copy, follow_symlinks=False)


def _listed(summary: Path) -> list[str]:
    """The files that an earlier summary lists, where there is one."""
    try:
        listed = json.loads(summary.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [name for name in listed if isinstance(name, str)]
