"""The frame of coordinates, LPS or RAS, that the header of a surface file states.

3D Slicer writes `SPACE=LPS` or `SPACE=RAS` into the header of every surface that it saves, and
reads it there; files of this package state `LPS mm`. Other programs state nothing.
"""

import re
from pathlib import Path

from cmfsim.errors import CaseInputError

# As 3D Slicer writes it; and the words of this package's own files.
SLICER = re.compile(rb"\bSPACE=([A-Za-z]+)")
OWN = re.compile(rb"^(?:cmfsim |comment |# )LPS mm\b", re.MULTILINE)
# Headers end before this, bytes: PLY's has the longest.
MOST_HEADER = 2**16
STL_HEADER = 80


def stated_frame(data: bytes, suffix: str) -> str | None:
    """The frame in the header of an STL, PLY, OBJ or legacy VTK file; None where it states none.

    data: The whole file.
    suffix: Its ending in lower case, such as ".stl".
    Raises `CaseError`: Two frames, or one that is neither LPS nor RAS.
    """
    head = _header(data[:MOST_HEADER], suffix)
    found = {match.upper() for match in SLICER.findall(head)}
    if len(found) > 1:
        names = " and ".join(sorted(name.decode() for name in found))
        raise CaseInputError(f"its header states two frames, {names}: export it again")
    return stated_in_field(found.pop()) if found else None


def is_own_file(path: Path) -> bool:
    """Whether a surface states "LPS mm" as this package writes it.

    Where a case states another frame, that is used: the writer cannot know what it was given.
    """
    with path.open("rb") as file:
        return OWN.search(_header(file.read(MOST_HEADER), path.suffix.lower())) is not None


def stated_in_field(name: bytes) -> str:
    """The frame of the name that a file gives for its space: "LPS" or "RAS"."""
    if name not in {b"LPS", b"RAS"}:
        shown = name[:20].decode("ascii", "replace")
        raise CaseInputError(
            f"its header states SPACE={shown}: LPS and RAS are read; export it from 3D Slicer again"
        )
    return name.decode()


def _header(head: bytes, suffix: str) -> bytes:
    """The part of a file's first bytes in which a program may state what it likes."""
    if suffix == ".stl":
        return head[:STL_HEADER].partition(b"\n")[0]
    if suffix == ".ply":
        comments = head.partition(b"end_header")[0].splitlines()
        return b"\n".join(line for line in comments if line.startswith((b"comment", b"obj_info")))
    if suffix == ".obj":
        lines: list[bytes] = []
        for line in head.splitlines():
            if line.strip() and not line.startswith(b"#"):
                break
            lines.append(line)
        return b"\n".join(lines)
    # Legacy VTK: its second line is a title.
    return b"\n".join(head.split(b"\n", 2)[1:2])
