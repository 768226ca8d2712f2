"""Temporary files and folders that a killed run cannot take away itself.

Who writes one holds a lock on it, which the system drops with the process. What nobody holds was
left, and the next run that writes there takes it away. Where the system has no such locks
(Windows), what is older than a day was left.
"""

import contextlib
import os
import stat
import tempfile
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

# Age of what was left where there are no locks, s: longer than any run writes.
LEFT_AFTER = 86_400.0


def temporary_file(path: Path) -> tuple[int, Path]:
    """A new file beside a path, open and locked: its handle, which keeps the lock, and its name."""
    while True:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        if _lock(handle) and _is_still(handle, name):
            return handle, Path(name)
        # Taken for a leftover in the moment before it was locked.
        os.close(handle)


@contextlib.contextmanager
def temporary_folder(folder: Path, prefix: str) -> Iterator[Path]:
    """A new folder in another one, locked; what becomes of it is the caller's."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=prefix, dir=folder))
        handle = _opened(path)
        if handle is None:
            yield path
            return
        try:
            if _lock(handle) and _is_still(handle, path):
                yield path
                return
        finally:
            os.close(handle)


@contextlib.contextmanager
def holding(folder: Path) -> Iterator[None]:
    """Has other runs that write to a folder wait, where the system has locks."""
    handle = _opened(folder)
    if handle is None:
        yield
        return
    try:
        # A file system without locks (some that lie on a network) goes without.
        with contextlib.suppress(OSError):
            locks = _locks()
            locks.flock(handle, locks.LOCK_EX)
        yield
    finally:
        os.close(handle)


def abandoned(folder: Path, pattern: str, *, folders: bool = False) -> Iterator[Path]:
    """Files, or folders, that killed runs left in a folder, each locked while the caller has it.

    What has such a name and is something else (a link, a pipe, a folder for a file) is no run's.
    """
    for path in sorted(folder.glob(pattern)):
        if not _is_kind(path, folders=folders):
            continue
        handle = _opened(path)
        if handle is None:
            with contextlib.suppress(OSError):
                if time.time() - path.stat().st_mtime > LEFT_AFTER:
                    yield path
            continue
        try:
            if _lock(handle):
                yield path
        finally:
            os.close(handle)


def _is_kind(path: Path, *, folders: bool) -> bool:
    """Whether it is a plain file, or a plain folder; links are neither, and pipes would block."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return False
    return stat.S_ISDIR(mode) if folders else stat.S_ISREG(mode)


def _locks() -> Any:
    """The module of locks; none on Windows."""
    try:
        return import_module("fcntl")
    except ModuleNotFoundError:
        return None


def _opened(path: Path) -> int | None:
    """A handle of a file or folder to lock it by; none where that cannot be."""
    if _locks() is None or path.is_symlink():
        return None
    try:
        return os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return None


def _lock(handle: int) -> bool:
    """Whether the lock could be had; where there are none, it could."""
    locks = _locks()
    if locks is None:
        return True
    try:
        locks.flock(handle, locks.LOCK_EX | locks.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        # A file system without locks: nothing can be told of what lies there.
        return True
    return True


def _is_still(handle: int, path: str | Path) -> bool:
    """Whether a path still names the open file."""
    try:
        found = Path(path).stat()
    except FileNotFoundError:
        return False
    held = os.fstat(handle)
    return (found.st_ino, found.st_dev) == (held.st_ino, held.st_dev)
