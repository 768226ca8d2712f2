"""The summary that `cmfsim build` prints at its end."""

import textwrap
from collections.abc import Mapping
from typing import Any

from cmfsim.cli.text.terminal import escaped
from cmfsim.report import Table
from cmfsim.values.mesh_report import MeshReport

# Columns of the text in a pipe, and at most on a terminal.
WIDTH = 100
# Columns before the values, as in the lines of `MeshReport.as_text`.
INDENT = 14
# Distances of a contact surface from the bone beneath.
AWAY = ("mean", "p95", "max")


def build_text(summary: Mapping[str, Any], *, width: int = WIDTH) -> str:
    """The summary of a `PatientModel` that was written: nodes, mesh, time per stage, files."""
    parts = [
        [f"case          {escaped(summary['case'])}", *_nodes(summary)],
        MeshReport(**summary["mesh"]).as_text().splitlines(),
        _times(summary["timings"]),
        _files(summary, width),
    ]
    return "\n\n".join("\n".join(part) for part in parts)


def _nodes(summary: Mapping[str, Any]) -> list[str]:
    """Nodes on each segment, and how far contact surfaces are from the bone beneath."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in summary["nodes"].items())
    held = tuple((n, str(s["joined"]), str(s["sliding"])) for n, s in summary["segments"].items())
    tables = [Table(("segment", "joined", "sliding"), held, f"nodes         {kinds}")]
    if summary.get("contact"):
        rows = tuple(
            (name, *(f"{found[f'departure_{key}']:.2f}" for key in AWAY), found["surface"])
            for name, found in summary["contact"].items()
        )
        caption = "contact       departure from bone, mm"
        tables.append(Table(("segment", *AWAY, "surface"), rows, caption))
    return [escaped(line) for table in tables for line in table.text.split("\n")]


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
