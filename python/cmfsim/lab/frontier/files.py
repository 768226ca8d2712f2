"""The files of a sweep, and its picture: error against time (matplotlib)."""

import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io import replacing_files, write_metrics
from cmfsim.lab.frontier.rows import Frontier, FrontierRow, unbeaten
from cmfsim.lab.frontier.table import GRID, TARGET, frontier_page
from cmfsim.pictures.charts import write_figure

# Told apart in grey too, and by those who see no red or green.
ELEMENT_COLOURS = {"p1": "#8a5a2b", "anp": "#e0a53f", "p2": "#3f7fb5"}
KINEMATICS_MARKS = {"linear": "o", "corotational": "s", "hyperelastic": "^"}
SIZE = (10.0, 5.2)

SUMMARY, TABLE, PAGE, PICTURE = "frontier.json", "frontier.csv", "frontier.md", "frontier.png"


def write_frontier(folder: Path, found: Frontier) -> list[str]:
    """The names of the files written: table, page, picture and, last, all figures as JSON.

    Raises `CaseError`: matplotlib is missing.
    Raises `OSError`: The folder cannot be written to.
    """

    def fill(fresh: Path) -> Sequence[str]:
        write_metrics(fresh / TABLE, found)
        (fresh / PAGE).write_text(frontier_page(found), encoding="utf-8")
        names = [TABLE, PAGE]
        if any(row.mean for row in found.rows):
            chart_frontier(fresh / PICTURE, found)
            names.append(PICTURE)
        names.append(SUMMARY)
        write_metrics(fresh / SUMMARY, {**found.as_dict(), "files": names})
        return names

    return replacing_files(folder, SUMMARY, {TABLE, PAGE, PICTURE, SUMMARY}.__contains__, fill)


def chart_frontier(path: str | os.PathLike[str], found: Frontier) -> None:
    """Writes error against time, both on logarithmic axes: from the files on, and of the solve.

    Colours are elements, marks are kinematics, figures beside them edge lengths in mm. Filled marks
    are of the grid; hollow ones have one other factor changed. The line joins what no other choice
    beats in that panel's time, the ring is the base.

    path: Ends in `.png`, `.svg` or `.pdf`.
    Raises `CaseError`: matplotlib is missing, another ending, no choice that has an error.
    """
    rows = [row for row in found.rows if row.mean and not row.is_reference]
    if not rows:
        raise CaseInputError("no choice has an error above zero: there is nothing to draw")
    write_figure(Path(path), SIZE, lambda figure: _draw(figure, found, rows), dpi=160)


def _draw(figure: Any, found: Frontier, rows: list[FrontierRow]) -> None:
    left, right = figure.subplots(1, 2, sharey=True)
    _panel(left, found, {row: row.total_wall or 0.0 for row in rows})
    _panel(right, found, {row: row.solve_wall.median for row in rows if row.solve_wall})
    left.set_xlabel("from the files to the face, s")
    right.set_xlabel("from the scene to the face, s")
    left.set_ylabel("mean distance on the face from the reference, mm")
    figure.legend(handles=_marks(found), loc="outside upper center", ncols=9, frameon=False)


def _panel(axes: Any, found: Frontier, seconds: dict[FrontierRow, float]) -> None:
    base = found.base
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        _plain_numbers(axis)
    axes.axhline(TARGET, color="#999999", linewidth=0.9, linestyle=(0, (4, 3)), zorder=0)
    axes.annotate(
        f"{TARGET:g} mm",
        (1.0, TARGET),
        xycoords=("axes fraction", "data"),
        xytext=(-3, 3),
        textcoords="offset points",
        ha="right",
        color="#777777",
    )
    rows = sorted(seconds, key=seconds.__getitem__)
    on_front = unbeaten([seconds[row] for row in rows], [row.mean or 0.0 for row in rows])
    front = [row for row, on in zip(rows, on_front, strict=True) if on]
    line = ([seconds[row] for row in front], [row.mean for row in front])
    axes.plot(*line, color="#444444", linewidth=1.0, zorder=1)
    for row in rows:
        of_grid = not set(row.choice.changes(base.choice)) - set(GRID)
        place = (seconds[row], row.mean)
        colour = ELEMENT_COLOURS[row.choice.element]
        axes.plot(
            *([value] for value in place),
            marker=KINEMATICS_MARKS[row.choice.kinematics],
            markersize=7.0 if of_grid else 4.5,
            markerfacecolor=colour if of_grid else "none",
            markeredgecolor="white" if of_grid else colour,
            markeredgewidth=0.6 if of_grid else 1.0,
            linestyle="none",
            zorder=3,
        )
        if of_grid:
            axes.annotate(
                f"{row.choice.edge_length:g}",
                place,
                xytext=(5, 4),
                textcoords="offset points",
                fontsize=6.5,
                color="#555555",
            )
    if base in seconds:
        ring = {"markerfacecolor": "none", "markeredgecolor": "black", "markeredgewidth": 1.3}
        axes.plot([seconds[base]], [base.mean], marker="o", markersize=13.0, zorder=4, **ring)
    axes.grid(visible=True, which="major", color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _plain_numbers(axis: Any) -> None:
    """Figures such as 0.2 and 30 at the ticks, with as many as a short range needs."""
    ticker = import_module("matplotlib.ticker")
    axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())


def _marks(found: Frontier) -> list[Any]:
    lines = import_module("matplotlib.lines")

    def mark(label: str, **how: Any) -> Any:
        return lines.Line2D([], [], **{"linestyle": "none", "color": "#777777", **how}, label=label)

    rows = [row for row in found.rows if not row.is_reference]
    elements = {row.choice.element for row in rows}
    kinematics = {row.choice.kinematics for row in rows}
    return [
        *(mark(n, marker="D", color=c) for n, c in ELEMENT_COLOURS.items() if n in elements),
        *(mark(n, marker=m) for n, m in KINEMATICS_MARKS.items() if n in kinematics),
        mark("another factor", marker="o", markersize=4.5, markerfacecolor="none"),
        mark("base", marker="o", markersize=10.0, markerfacecolor="none", color="black"),
        mark("front", linestyle="-", color="#444444"),
    ]
