"""Inserts the results of `cmfsim bench frontier` into the documentation.

    python -m benches.speed.fill_frontier FOLDER NAME

`docs/frontier.md` has two marks around the tables of each NAME (head, ct_phantom); the picture is
saved next to the others.
"""

import argparse
import re
import shutil
from pathlib import Path

from benches.scenes.marked import replace_marked

DOCS = Path(__file__).parents[2] / "docs"
PICTURE = "![Error on the skin against run time](figures/frontier-{}.png)"


def main(folder: Path, name: str) -> None:
    """Fills the page with the tables in `folder`.

    Raises
    ------
    SystemExit
        No sweep was finished there, or the page has no place for it.
    """
    page = folder / "frontier.md"
    if not page.exists():
        raise SystemExit(f"{page} is missing: run cmfsim bench frontier -o {folder} first")
    # The page's own title gives way to that of the documentation, its sections become parts of one.
    measured = re.sub(r"\A# .*\n+", "", page.read_text(encoding="utf-8"))
    measured = re.sub(r"^## ", "#### ", measured, flags=re.MULTILINE)
    replace_marked(DOCS / "frontier.md", name, f"{PICTURE.format(name)}\n\n{measured}")
    shutil.copyfile(folder / "frontier.png", DOCS / "figures" / f"frontier-{name}.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Puts a finished sweep into docs/frontier.md.")
    parser.add_argument("folder", type=Path, help="the -o of cmfsim bench frontier")
    parser.add_argument("name", help="its part of the page: head, ct_phantom")
    found = parser.parse_args()
    main(found.folder, found.name)
