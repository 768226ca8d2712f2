"""The files of a sweep."""

from collections.abc import Sequence
from pathlib import Path

from cmfsim.io import replacing_files, write_metrics
from cmfsim.lab.frontier.chart import chart_frontier
from cmfsim.lab.frontier.rows import Frontier
from cmfsim.lab.frontier.table import frontier_page

SUMMARY, TABLE, PAGE, PICTURE = "frontier.json", "frontier.csv", "frontier.md", "frontier.png"


def write_frontier(folder: Path, found: Frontier) -> list[str]:
    """The names of the files written: table, page, picture and, last, all figures as JSON.

    Raises
    ------
    CaseError
        (also `ValueError`) matplotlib is missing.
    OSError
        The folder cannot be written to.
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
