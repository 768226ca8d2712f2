"""Tables in Markdown."""

from collections.abc import Sequence

DASH = "–"


def cell(value: float | None, form: str) -> str:
    """A figure in a form, or a dash where there is none."""
    return DASH if value is None else form.format(value)


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells below their titles."""
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
