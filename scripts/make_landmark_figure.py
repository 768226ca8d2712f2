"""Makes the pictures of docs/landmarks.md: the 32 sites of the skull and 14 of the skin.

python scripts/make_landmark_figure.py

`landmarks.png` is what `cmfsim landmarks` draws of a synthetic person, `landmarks_skin.png` the
points of the skin larger. `landmarks_skull.png` shows the points that an operator placed on the CT
phantom (the folder named by CMFSIM_DATA, else ../shared/data; skipped where absent), a real-shaped
skull: MIT licence, © 2022 Mark Gardner.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cmfsim
from cmfsim.pictures import picture_landmarks
from make_average_head import drawn_head

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs" / "figures"
# Another person than the template.
SEED = 7
# Pixels of six views, of two views next to each other, and of a column of the page.
SIX, PAIR, PAGE = (2100, 1450), (1500, 720), 1500


def main() -> None:
    """Finds the landmarks of a synthetic person and draws them; then those of the CT phantom."""
    head = drawn_head(cmfsim.make_head(cmfsim.HeadParameters.random(SEED)), "person")
    found = cmfsim.propose_landmarks(head.bones, head.skin).points
    sides = ("front", "left")
    write("landmarks.png", head.bones, head.skin, found, size=SIX)
    skin = {"skin": found["skin"]}
    write("landmarks_skin.png", head.bones, head.skin, skin, size=PAIR, views=sides)
    data = Path(os.environ.get("CMFSIM_DATA", ROOT.parent / "shared" / "data")) / "ct_phantom"
    if not data.is_dir():
        print(f"{data} is absent: landmarks_skull.png stays as it is (set CMFSIM_DATA)")
        return
    bones = {name: cmfsim.read_surface(data / f"{name}.ply") for name in ("cranium", "mandible")}
    placed = {"skull": cmfsim.read_landmarks(data / "skull_landmarks.mrk.json")}
    write("landmarks_skull.png", bones, None, placed, size=PAIR, views=sides)


def write(
    name: str,
    bones: Mapping[str, cmfsim.SurfaceData],
    skin: cmfsim.SurfaceData | None,
    points: Mapping[str, Mapping[str, Any]],
    *,
    size: tuple[int, int],
    views: Sequence[str] = ("front", "left", "right"),
) -> None:
    """Draws one picture, as wide as a page and in few colours: a third of the bytes."""
    from PIL import Image  # noqa: PLC0415 (comes with matplotlib)

    path = FIGURES / name
    picture_landmarks(path, bones, skin, points, views=views, size=size)
    drawn = Image.open(path).convert("RGB")
    page = drawn.resize((PAGE, round(drawn.height * PAGE / drawn.width)), Image.Resampling.LANCZOS)
    page.quantize(method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        path, optimize=True
    )
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
