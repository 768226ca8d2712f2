"""Lines as curves of 3D Slicer (`.mrk.json`): fibre lines that a person may draw and look at."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import LandmarkInputError
from cmfsim.io.landmarks.markups import Markup, markup_of, markup_text, markups_of, write_markups
from cmfsim.values.checks import Floats, as_rows

# What Slicer calls markups whose points follow one another along a line.
CURVE_KINDS = ("Curve", "ClosedCurve", "Line")


def read_curves(path: str | os.PathLike[str]) -> tuple[Floats, ...]:
    """The curves of a `.mrk.json` file as polylines through their points, (n, 3) each, LPS mm.

    A closed curve ends where it starts. A file that states no frame is read as LPS, as Slicer's
    schema says.

    Parameters
    ----------
    path : path

    Returns
    -------
    tuple of (n, 3) float64, mm

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    LandmarkError
        (also `ValueError`) Not such a file, another markup, a curve of one point.
    """
    path = Path(path)
    text = markup_text(path)
    try:
        markups = markups_of(text, "LPS")
        return tuple(_line(markup, number) for number, markup in enumerate(markups, start=1))
    except LandmarkInputError as error:
        raise LandmarkInputError(f"{path.name}: {error}") from error


def write_curves(path: str | os.PathLike[str], lines: Sequence[ArrayLike]) -> None:
    """Writes polylines as open curves of 3D Slicer, LPS mm; `read_curves` gives them back."""
    path = Path(path)
    markups = []
    for number, line in enumerate(lines, start=1):
        points = as_rows(f"line {number}", line, 3)
        markups.append(markup_of("Curve", ((str(i), p) for i, p in enumerate(points, start=1))))
    write_markups(path, markups)


def _line(markup: Markup, number: int) -> Floats:
    if markup.kind not in CURVE_KINDS:
        known = ", ".join(CURVE_KINDS)
        raise LandmarkInputError(f"markup {number} is a {markup.kind!r}: one of {known} is needed")
    points = [entry.position for entry in markup.entries if entry.position is not None]
    if len(points) < 2:
        raise LandmarkInputError(f"curve {number} has {len(points)} placed points: two are needed")
    if markup.kind == "ClosedCurve":
        points.append(points[0])
    return np.array(points)
