"""The summary that `cmfsim build` prints at its end."""

import textwrap
from collections.abc import Mapping
from typing import Any

from cmfsim.cli.text.terminal import escaped
from cmfsim.values.mesh_report import MeshReport

# Columns of the text in a pipe, and at most on a terminal.
WIDTH = 100
# Columns before the values, as in the lines of `MeshReport.as_text`.
INDENT = 14


def build_text(summary: Mapping[str, Any], *, width: int = WIDTH) -> str:
    """The summary of a model as lines: nodes, mesh, time per stage, files.

    Parameters
    ----------
    summary : mapping
        Of a `PatientModel` that was written.
    width : int
        Columns at which names of files wrap.

    Returns
    -------
    str
    """
    parts = [
        [f"case          {escaped(summary['case'])}", *_nodes(summary)],
        MeshReport(**summary["mesh"]).as_text().splitlines(),
        _times(summary["timings"]),
        _files(summary, width),
    ]
    return "\n\n".join("\n".join(part) for part in parts)


def _nodes(summary: Mapping[str, Any]) -> list[str]:
    counts = summary["nodes"]
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    names = [escaped(name) for name in summary["segments"]]
    wide = max([len("segment"), *map(len, names)])
    lines = [f"nodes         {kinds}", f"  {'segment':<{wide}}    joined   sliding"]
    for name, held in zip(names, summary["segments"].values(), strict=True):
        lines.append(f"  {name:<{wide}} {held['joined']:9d} {held['sliding']:9d}")
    return lines + _contacts(summary, wide)


def _contacts(summary: Mapping[str, Any], wide: int) -> list[str]:
    """The surfaces that nodes slide on, and their distance from the bone beneath."""
    contacts = summary.get("contact", {})
    if not contacts:
        return []
    lines = [f"contact       {'':<{max(wide - 12, 0)}} departure from bone, mm: mean, P95, largest"]
    for name, contact in contacts.items():
        away = [f"{contact[f'departure_{key}']:9.2f}" for key in ("mean", "p95", "max")]
        lines.append(f"  {escaped(name):<{wide}}{''.join(away)}  {contact['surface']}")
    return lines


def _times(timings: Mapping[str, float]) -> list[str]:
    lines = [f"time          {sum(timings.values()):.1f} s"]
    return lines + [f"  {seconds:8.2f} s  {escaped(name)}" for name, seconds in timings.items()]


def _files(summary: Mapping[str, Any], width: int) -> list[str]:
    names = ", ".join(escaped(name) for name in summary["files"])
    wrapped = textwrap.wrap(
        names,
        max(width, 40),
        initial_indent=" " * INDENT,
        subsequent_indent=" " * INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [f"written       {escaped(summary['output'])}", *wrapped]
