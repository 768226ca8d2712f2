"""The files of a sweep: its page of tables, and its picture of error against time (matplotlib)."""

import os
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from cmfsim._core import KINEMATICS
from cmfsim.errors import CaseInputError
from cmfsim.io import replacing_files, write_metrics
from cmfsim.lab.frontier.choice import Choice
from cmfsim.lab.frontier.rows import SKIN, WHOLE, Frontier, FrontierRow, Spread, unbeaten
from cmfsim.pictures.charts import write_figure
from cmfsim.values.table import NOTHING, Table

# Mean error on the skin that a default may have, mm: a tenth of what surgeons can see, and below
# what a CT resolves.
TARGET = 0.1
GRID = ("edge_length", "element", "kinematics")
TITLES = (
    "mean", "P95", "max", "skin", "build s", "solve s (min–max)", "times base (min–max)", "CPU s",
    "peak MB", "front",
)  # fmt: skip
# Told apart in grey too, and by those who see no red or green.
ELEMENT_COLOURS = {"p1": "#8a5a2b", "anp": "#e0a53f", "p2": "#3f7fb5"}
KINEMATICS_MARKS = dict(zip(KINEMATICS, "os^Dv<>P", strict=False))
SIZE = (10.0, 5.2)
SUMMARY, TABLE, PAGE, PICTURE = "frontier.json", "frontier.csv", "frontier.md", "frontier.png"


def frontier_page(found: Frontier) -> str:
    """The tables of a frontier in Markdown: grid, each factor by itself, regions, failures."""
    base, reference = found.base, found.reference
    kinds: dict[str, list[FrontierRow]] = {"grid": []}
    for row in found.rows:
        if not row.is_reference:
            kinds.setdefault(_kind(row.choice.changes(base.choice)), []).append(row)
    parts = [
        f"# Error against run time: {found.case}",
        _head(found),
        "## Edge length, element, kinematics",
        _table(
            ("edge mm", "element", "kinematics", "tets"),
            kinds.pop("grid"),
            lambda row: (
                f"{row.choice.edge_length:g}",
                row.choice.element,
                row.choice.kinematics,
                NOTHING if row.n_tets is None else str(row.n_tets),
            ),
        ),
        "## One factor at a time",
        f"From the base: {row_label(base.choice)}. A tolerance is that of `pcg`.",
    ]

    def changed(row: FrontierRow) -> tuple[str]:
        named = [f"{name} {value}" for name, value in row.choice.changes(base.choice).items()]
        return ("base" if row.is_base else ", ".join(named),)

    parts += [_table(("choice",), [base, *rows], changed) for rows in kinds.values()]
    solved_in = _spread(reference.solve_wall)
    parts += [
        "## Where the error lies",
        "Mean over the skin, the face and its regions, mm: base and front.",
        _regions([base, *(row for row in found.front if row is not base)]),
        f"Reference: {row_label(reference.choice)}; {reference.n_tets} tets, {solved_in} s.",
    ]
    failed = [row for row in found.rows if row.failure]
    if failed:
        lines = [f"- {row_label(row.choice)}: {row.failure}" for row in failed]
        parts += ["## Choices that were refused or failed", "\n".join(lines)]
    return "\n\n".join(parts) + "\n"


def row_label(choice: Choice) -> str:
    """A choice in one line."""
    return (
        f"{choice.model}, {choice.element} {choice.kinematics} at {choice.edge_length:g} mm, "
        f"{choice.method}, tolerance {choice.tolerance:g}, {choice.contact} contact to "
        f"{choice.contact_tolerance:g} mm, {choice.samples} samples, {choice.mixing}"
    )


def base_verdict(base: FrontierRow) -> str:
    """How far the base is off on average over face and skin, and whether that will do."""
    verdicts = [
        f"{base.error[name].mean:.3f} mm off on average over the {name} "
        f"({'within' if base.error[name].mean <= TARGET else 'outside'} {TARGET:g} mm)"
        for name in (WHOLE, SKIN)
        if name in base.error
    ]
    return f"is {' and '.join(verdicts)}" if verdicts else "has no solution"


def _head(found: Frontier) -> str:
    machine, verdict = found.machine, base_verdict(found.base)
    return (
        f"Error: |u − u_ref| at {found.n_points} points of the patient's skin, mm; mean, P95 and "
        f"max over the face, which the reference moves by {found.moved:.2f} mm on average, and the "
        "mean over the whole skin of the simulated tissue. "
        f"The base (the case's own settings) {verdict}. Time: build is one run from the files to "
        "the scene; solve is the median of interleaved rounds, with minimum and "
        "maximum; “times base” is taken within each round. CPU and peak memory are those of the "
        "solve. The front: no other choice is both as accurate and as fast.\n\n"
        f"{machine['processor']}, {machine['threads']} threads, "
        f"cmfsim {machine['cmfsim']}, commit {machine['commit'] or NOTHING}."
    )


def _kind(changed: Mapping[str, Any]) -> str:
    """Which table a row belongs to by what it changes: the grid, or that of a factor."""
    if not set(changed) - set(GRID):
        return "grid"
    # A tolerance is that of an iterative method, which comes with it.
    return "tolerance" if "tolerance" in changed else " and ".join(changed)


def _table(
    titles: Sequence[str],
    rows: Sequence[FrontierRow],
    first: Callable[[FrontierRow], Sequence[str]],
) -> str:
    cells = [(*first(row), *_figures(row)) for row in rows]
    return Table((*titles, *TITLES), cells).markdown


def _figures(row: FrontierRow) -> list[str]:
    whole, skin = row.error.get(WHOLE), row.error.get(SKIN)
    errors = (
        [NOTHING] * 3 if whole is None else [_mm(v) for v in (whole.mean, whole.p95, whole.max)]
    )
    return [
        *errors,
        NOTHING if skin is None else _mm(skin.mean),
        NOTHING if row.build_wall is None else f"{row.build_wall:.1f}",
        "failed" if row.failure else _spread(row.solve_wall),
        _spread(row.ratio),
        NOTHING if row.solve_cpu is None else f"{row.solve_cpu.median:.2f}",
        NOTHING if row.solve_peak is None else f"{row.solve_peak:.0f}",
        ("●" if row.on_front else "") + (" base" if row.is_base else ""),
    ]


def _regions(rows: Sequence[FrontierRow]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row.error))
    lines = []
    for row in rows:
        cells = [_mm(row.error[name].mean) if name in row.error else NOTHING for name in names]
        choice = row.choice
        label = f"{choice.element} {choice.kinematics}, {choice.edge_length:g} mm"
        others = [f"{n} {v}" for n, v in choice.changes(rows[0].choice).items() if n not in GRID]
        lines.append((", ".join([label, *others]), *cells))
    return Table(("choice", *names), lines).markdown


def _mm(value: float) -> str:
    """Three decimals, or two digits where these would show nothing."""
    return f"{value:.3f}" if value >= 0.0005 or value == 0.0 else f"{value:.1e}"


def _spread(spread: Spread | None) -> str:
    if spread is None:
        return NOTHING
    if spread.count == 1:
        return f"{spread.median:.3g}"
    return f"{spread.median:.3g} ({spread.low:.3g}–{spread.high:.3g})"


def write_frontier(folder: Path, found: Frontier) -> list[str]:
    """The names of the files written: table, page, picture and, last, all figures as JSON."""

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
    ticker = import_module("matplotlib.ticker")
    for axis in (axes.xaxis, axes.yaxis):
        # Figures such as 0.2 and 30 at the ticks, with as many as a short range needs.
        axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(ticker.NullFormatter())
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
