"""Plans as tables of a case file, which `Case.with_plan` reads."""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

from numpy.typing import ArrayLike

from cmfsim.io.files.reading_writing import replacing
from cmfsim.values.motion import rigid_matrix

# A name that TOML takes as a key without quotes.
BARE = re.compile(r"[A-Za-z0-9_-]+")


def write_plan(
    path: str | os.PathLike[str], plan: Mapping[str, ArrayLike], *, made_for: str = ""
) -> None:
    """Writes rigid motions as tables `[plan.SEGMENT]`, which `cmfsim predict --plan` reads.

    Parameters
    ----------
    path : path
        Replaced when all is written.
    plan : mapping of str to (4, 4) float64, mm
        In LPS.
    made_for : str
        The `plan_key` of the case, so that a plan for another head is noticed.

    Raises
    ------
    BoundaryError
        (also `ValueError`) A matrix that is not a rigid motion.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.rigid_motion(translation=(0, -4, 0))
    >>> cmfsim.write_plan("plan.toml", {"maxilla": motion})  # doctest: +SKIP
    """
    lines = [
        "# Plan. Not a medical device.",
        "# Each matrix carries the bone from where it is to where it goes: LPS, mm.",
        "# cmfsim predict case.toml --plan THIS_FILE; or copy the tables into the case's [plan].",
    ]
    if made_for:
        lines.append(f"# made for: {made_for}")
    for name, motion in plan.items():
        matrix = rigid_matrix(motion, f"motion of {name!r}")
        key = name if BARE.fullmatch(name) else json.dumps(name)
        rows = [f"  [{', '.join(repr(float(v)) for v in row)}]," for row in matrix]
        lines += ["", f"[plan.{key}]", "matrix = [", *rows, "]"]
    with replacing(Path(path)) as file:
        file.write(("\n".join(lines) + "\n").encode())
