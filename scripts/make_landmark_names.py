"""Writes the table of names into docs/landmarks.md: make_landmark_names.py [FILE]."""

import sys
from pathlib import Path

from cmfsim.values.landmark_sites import CEPHALOMETRY, SKIN_LANDMARKS, SKULL_LANDMARKS

PAGE = Path(__file__).parents[1] / "docs/landmarks.md"
BEGIN = "<!-- begin scripts/make_landmark_names.py -->"
END = "<!-- end scripts/make_landmark_names.py -->"


def names_table() -> str:
    """The table of names, as Markdown."""
    rows = ["| names | point | in cephalometry | in cmfsim |", "|---|---|---|---|"]
    for entry in CEPHALOMETRY:
        labels = SKULL_LANDMARKS if entry.kind == "skull" else SKIN_LANDMARKS
        site = f"`{entry.site}`" if entry.site else "measures only"
        if f"{entry.site}_L" in labels:
            site += ", L and R"
        if entry.kind == "skin":
            site += " (skin)"
        short = ", ".join(f"`{name}`" for name in entry.short)
        rows.append(f"| {short} | {entry.name} | {entry.where} | {site} |")
    return "\n".join(rows)


def with_table(text: str) -> str:
    """The text of the page with its table renewed."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END, 1)
    return f"{before}{BEGIN}\n\n{names_table()}\n\n{END}{after}"


if __name__ == "__main__":
    page = Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE
    page.write_text(with_table(page.read_text(encoding="utf-8")), encoding="utf-8")
