"""Makes docs/figures/landmarks.png: the proposed landmarks of a synthetic head.

python scripts/make_landmark_figure.py
"""

from pathlib import Path

import cmfsim
from cmfsim.phantom.average_head import drawn_head
from cmfsim.pictures import picture_landmarks

# Another person than the template, and pixels of a column of the page.
SEED, SIZE = 7, (1500, 1050)


def main(path: Path) -> None:
    """Finds the landmarks of a synthetic person and draws them."""
    head = drawn_head(cmfsim.make_head(cmfsim.HeadParameters.random(SEED)), "person")
    found = cmfsim.propose_landmarks(head.bones, head.skin)
    picture_landmarks(path, head.bones, head.skin, found.points, size=SIZE)
    # Few colours are enough for shaded surfaces, and a quarter of the bytes.
    from PIL import Image  # noqa: PLC0415 (comes with matplotlib)

    Image.open(path).convert("P", palette=Image.Palette.ADAPTIVE, colors=64).save(
        path, optimize=True
    )
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main(Path(__file__).parents[1] / "docs" / "figures" / "landmarks.png")
