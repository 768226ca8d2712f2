"""Makes the pictures of the README from a demo: cmfsim demo, then make_figures.py cmfsim-demo.

The pictures are those of the demo's report, made smaller so that the repository stays light.
"""

import sys
from pathlib import Path

# Of a README's column, pixels.
WIDTH = 840
FIGURES = {"prediction": "demo_prediction"}


def main(demo: Path, docs: Path) -> int:
    """Writes docs/figures from the last model's pictures; 1 where there are none."""
    from PIL import Image  # noqa: PLC0415 (comes with matplotlib)

    folder = demo / "out" / "M+S"
    if not (folder / "prediction.png").exists():
        print(f"{folder}: holds no prediction.png; run cmfsim demo first", file=sys.stderr)
        return 1
    figures = docs / "figures"
    figures.mkdir(exist_ok=True)
    for name, target in FIGURES.items():
        picture = Image.open(folder / f"{name}.png").convert("RGB")
        height = round(picture.height * WIDTH / picture.width)
        small = picture.resize((WIDTH, height), Image.Resampling.LANCZOS)
        small.save(figures / f"{target}.png", optimize=True)
        print(figures / f"{target}.png")
    return 0


if __name__ == "__main__":
    root = Path(__file__).parents[1]
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "cmfsim-demo"), root / "docs"))
