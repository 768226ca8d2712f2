"""A frontier as a page of tables."""

from collections.abc import Callable, Sequence

from cmfsim.lab.frontier.choice import Choice
from cmfsim.lab.frontier.rows import Frontier, FrontierRow, Spread
from cmfsim.lab.frontier.skin_points import SKIN, WHOLE

# Mean error on the skin that a default may have, mm: a tenth of what surgeons can see, and below
# what a CT resolves.
TARGET = 0.1
GRID = ("edge_length", "element", "kinematics")
TITLES = (
    "mean", "P95", "max", "skin", "build s", "solve s (min–max)", "times base (min–max)", "CPU s",
    "peak MB", "front",
)  # fmt: skip
DASH = "–"


def frontier_page(found: Frontier) -> str:
    """The tables of a frontier in Markdown: grid, each factor by itself, regions, failures."""
    base, reference = found.base, found.reference
    grid = [row for row in found.rows if _kind(row, base.choice) == "grid"]
    factors: dict[str, list[FrontierRow]] = {}
    for row in found.rows:
        kind = _kind(row, base.choice)
        if kind not in {"grid", ""}:
            factors.setdefault(kind, []).append(row)
    parts = [
        f"# Error against run time: {found.case}",
        _head(found),
        "## Edge length, element, kinematics",
        _table(
            ("edge mm", "element", "kinematics", "tets"),
            grid,
            lambda row: (
                f"{row.choice.edge_length:g}",
                row.choice.element,
                row.choice.kinematics,
                _whole(row.n_tets),
            ),
        ),
        "## One factor at a time",
        f"From the base: {row_label(base.choice)}. A tolerance is that of `pcg`.",
    ]
    parts += [
        _table(("choice",), [base, *rows], lambda row: (_changed(row, base.choice),))
        for rows in factors.values()
    ]
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
        f"cmfsim {machine['cmfsim']}, commit {machine['commit'] or DASH}."
    )


def _kind(row: FrontierRow, base: Choice) -> str:
    """Which table a row belongs to: the grid, that of a factor, or none for the reference."""
    if row.is_reference:
        return ""
    changed = row.choice.changes(base)
    if not set(changed) - set(GRID):
        return "grid"
    # A tolerance is that of an iterative method, which comes with it.
    return "tolerance" if "tolerance" in changed else " and ".join(changed)


def _changed(row: FrontierRow, base: Choice) -> str:
    if row.is_base:
        return "base"
    named = (f"{name} {value}" for name, value in row.choice.changes(base).items())
    return ", ".join(named)


def _table(
    titles: Sequence[str],
    rows: Sequence[FrontierRow],
    first: Callable[[FrontierRow], Sequence[str]],
) -> str:
    head = [*titles, *TITLES]
    lines = [
        f"| {' | '.join(head)} |",
        f"|{'|'.join(['---'] * len(titles) + ['---:'] * len(TITLES))}|",
    ]
    lines += [f"| {' | '.join([*first(row), *_figures(row)])} |" for row in rows]
    return "\n".join(lines)


def _figures(row: FrontierRow) -> list[str]:
    whole, skin = row.error.get(WHOLE), row.error.get(SKIN)
    errors = [DASH] * 3 if whole is None else [_mm(v) for v in (whole.mean, whole.p95, whole.max)]
    return [
        *errors,
        DASH if skin is None else _mm(skin.mean),
        DASH if row.build_wall is None else f"{row.build_wall:.1f}",
        "failed" if row.failure else _spread(row.solve_wall),
        _spread(row.ratio),
        DASH if row.solve_cpu is None else f"{row.solve_cpu.median:.2f}",
        DASH if row.solve_peak is None else f"{row.solve_peak:.0f}",
        ("●" if row.on_front else "") + (" base" if row.is_base else ""),
    ]


def _regions(rows: Sequence[FrontierRow]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row.error))
    lines = [f"| choice | {' | '.join(names)} |", f"|---|{'---:|' * len(names)}"]
    for row in rows:
        cells = [_mm(row.error[name].mean) if name in row.error else DASH for name in names]
        choice = row.choice
        label = f"{choice.element} {choice.kinematics}, {choice.edge_length:g} mm"
        others = [f"{n} {v}" for n, v in choice.changes(rows[0].choice).items() if n not in GRID]
        lines.append(f"| {', '.join([label, *others])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _mm(value: float) -> str:
    """Three decimals, or two digits where these would show nothing."""
    return f"{value:.3f}" if value >= 0.0005 or value == 0.0 else f"{value:.1e}"


def _spread(spread: Spread | None) -> str:
    if spread is None:
        return DASH
    if spread.count == 1:
        return f"{spread.median:.3g}"
    return f"{spread.median:.3g} ({spread.low:.3g}–{spread.high:.3g})"


def _whole(value: int | None) -> str:
    return DASH if value is None else str(value)
