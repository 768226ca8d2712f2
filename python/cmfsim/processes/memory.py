"""Freed memory of this process, where the C library is glibc: others keep their own ways."""

import ctypes
import sys

# Parameters of mallopt, from glibc's malloc.h.
TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8
# Freed memory that is kept for the next arrays, bytes: about five images of a head on the working
# grid. With more, the largest amount in use grows as well.
KEPT = 256 << 20
# Blocks that get a mapping of their own from this size on, bytes: none.
LARGEST = (1 << 31) - 1


def keep_freed_memory() -> None:
    """Lets large arrays reuse the memory of earlier ones.

    By default each array of an image is mapped from the kernel and given back: clearing its pages
    takes as long as the work on them, above all in a virtual machine. One arena serves all threads,
    so that they share what is kept.
    """
    library = _glibc()
    if library is not None:
        for parameter, value in ((ARENA_MAX, 1), (MMAP_THRESHOLD, LARGEST), (TRIM_THRESHOLD, KEPT)):
            library.mallopt(parameter, value)


def release_freed_memory() -> None:
    """Gives back what lies free between arrays in use: a fifth of a process after a build."""
    library = _glibc()
    if library is not None:
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    """The C library, if it is glibc: musl has none of these functions."""
    library = ctypes.CDLL(None) if sys.platform.startswith("linux") else None
    return library if hasattr(library, "gnu_get_libc_version") else None
