"""Puts what `cmfsim bench frontier` measured into the documentation.

    python scripts/fill_frontier.py FOLDER

The page's tables stand in `docs/frontier.md` between two marks, the picture beside the others.
"""

import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
PICTURE = "![Error on the skin against run time](figures/frontier.png)"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def main(folder: Path) -> int:
    """0 where the page was filled; 1 where a file or a mark is missing."""
    page, target = folder / "frontier.md", DOCS / "frontier.md"
    text = target.read_text(encoding="utf-8")
    if not page.exists() or text.count(BEGIN) != 1 or text.count(END) != 1:
        print(f"{page} or one of the marks in {target} is missing", file=sys.stderr)
        return 1
    # The page's own title gives way to that of the documentation.
    measured = re.sub(r"\A# .*\n+", "", page.read_text(encoding="utf-8"))
    before, after = text.partition(BEGIN)[0], text.partition(END)[2]
    # Sections of the page become parts of one section.
    measured = re.sub(r"^## ", "### ", measured, flags=re.MULTILINE)
    filled = f"{BEGIN}\n\n{PICTURE}\n\n{measured}\n{END}"
    target.write_text(f"{before}{filled}{after}", encoding="utf-8")
    shutil.copyfile(folder / "frontier.png", DOCS / "figures" / "frontier.png")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
