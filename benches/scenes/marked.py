"""Tables that commands write into a page: the text between two comments that name the command."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

BEGIN, END = "<!-- begin {} -->", "<!-- end {} -->"


def replace_marked(page: Path, name: str, text: str) -> None:
    """Puts `text` between the comments that begin and end `name` in a page.

    Raises
    ------
    SystemExit
        The page lacks one of them.
    """
    begin, end = BEGIN.format(name), END.format(name)
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise SystemExit(f"{page}: has no {begin} … {end} for the table")
    page.write_text(f"{before}{begin}\n\n{text.strip()}\n\n{end}{after}", encoding="utf-8")


def publish(page: Path | None, name: str, text: str) -> None:
    """Prints a table, or puts it into a page."""
    if page is None:
        print(text)
    else:
        replace_marked(page, name, text)


def marked(page: Path, name: str) -> str:
    """The text between the comments that begin and end `name` in a page."""
    _, _, rest = page.read_text(encoding="utf-8").partition(BEGIN.format(name))
    return rest.partition(END.format(name))[0].strip()
