"""Runs the tutorials and saves them with their outputs: save_tutorials.py [NAME ...].

Pictures are made smaller, and machine-specific data (execution times and paths) are removed.
`tests/python/project/test_tutorials.py` runs the tutorials again and compares what they print.
"""

import base64
import io
import os
import sys
from pathlib import Path
from typing import Any

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
# Of a page's column, pixels; a cell that takes longer hangs, s.
WIDTH, LONGEST_CELL = 800, 600


def main(names: list[str]) -> int:
    """Runs and saves the named tutorials, or all."""
    import nbclient  # noqa: PLC0415 (of the extra docs)
    import nbformat  # noqa: PLC0415

    for path in sorted(TUTORIALS.glob("*.ipynb")):
        if names and path.stem not in names:
            continue
        notebook = nbformat.read(path, as_version=4)
        # Progress bars and colours of a terminal have no place on a page.
        os.environ["NO_COLOR"] = "1"
        client = nbclient.NotebookClient(
            notebook, timeout=LONGEST_CELL, kernel_name="python3", record_timing=False
        )
        client.execute(cwd=str(path.parent))
        for cell in notebook.cells:
            for output in cell.get("outputs", []):
                shrink(output)
        notebook.metadata.pop("language_info", None)
        nbformat.write(notebook, path)
        print(f"{path}: {path.stat().st_size / 1024:.0f} kB")
    return 0


def shrink(output: dict[str, Any]) -> None:
    """Makes the picture of an output as wide as a page at most, in 256 colours."""
    from PIL import Image  # noqa: PLC0415 (comes with matplotlib)

    data = output.get("data", {})
    if "image/png" not in data:
        return
    picture = Image.open(io.BytesIO(base64.b64decode(data["image/png"]))).convert("RGB")
    width = min(WIDTH, picture.width)
    size = (width, round(picture.height * width / picture.width))
    small = picture.resize(size, Image.Resampling.LANCZOS)
    file = io.BytesIO()
    # By the range of colours, so that the ends of colour bars, which few pixels have, stay.
    few = small.quantize(method=Image.Quantize.MAXCOVERAGE)
    few.save(file, format="PNG", optimize=True)
    data["image/png"] = base64.b64encode(file.getvalue()).decode()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
