"""Which pads on the skin are reported: pads.py [--only WORD …] [--markdown PAGE].

Round pads with the density of soft tissue that follow the skin of the CT phantom (the folder named
by CMFSIM_DATA, else ../shared/data), each segmented as a scan of its own; and the same head without
one, as scanned, at a child's size, in 8 bit and turned.
"""

import argparse
import platform
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np

import cmfsim
from benches.scenes import ct_variants as variants
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder
from cmfsim.imaging import segment_head
from cmfsim.io.images.image_files import read_image_file
from cmfsim.values.image_data import ImageData

ROOT = Path(__file__).parents[2]
NAME = "benches/accuracy/pads.py"
Place = tuple[float, float, float]
# Where pads lie, mm in the frame of the scan.
FOLDS: dict[str, Place] = {"chin": (0, -304, 340), "under the jaw": (0, -260, 318)}
SMOOTH: dict[str, Place] = {
    "cheek": (60, -272, 372),
    "cheekbone": (-52, -283, 412),
    "angle of the jaw": (62, -235, 355),
    "middle of the forehead": (2, -304, 480),
    "side of the forehead": (45, -285, 480),
}
# Diameter and thickness, mm.
ALL = tuple(product((20.0, 30.0, 40.0, 60.0), (3.0, 5.0, 8.0)))
SOME = ((20.0, 3.0), (40.0, 3.0), (60.0, 3.0), (30.0, 8.0), (60.0, 8.0))
FEW = ((20.0, 5.0), (40.0, 3.0))
CHILD = 0.75
TURNS = ((12, -8, 10), (15, 0, 0), (-20, 0, 0), (0, 0, 20), (20, 0, 0), (0, 15, 0))
Cases = Iterator[tuple[str, ImageData]]


def is_reported(image: ImageData) -> bool:
    """Whether segmentation reports a thing on the skin."""
    return any(finding.code == "skin-attachment" for finding in segment_head(image).findings)


def child(image: ImageData) -> ImageData:
    """The head at a child's size."""
    return ImageData(image.values, np.asarray(image.spacing) * CHILD, image.origin)


def in_8_bit(image: ImageData) -> ImageData:
    """Values from −1000 to 1600 HU as 0 to 255."""
    values = np.clip(image.values, -1000.0, 1600.0)
    return image.with_values(np.round((values + 1000.0) * 255 / 2600.0).astype(np.uint8))


def rows(image: ImageData) -> Iterator[tuple[str, Cases]]:
    """The name of each row with its scans."""
    few = {"cheek": SMOOTH["cheek"], **FOLDS}
    origin = np.asarray(image.origin)
    small = {name: tuple(origin + CHILD * (np.array(at) - origin)) for name, at in few.items()}
    groups = [
        *((name, image, {name: place}, ALL) for name, place in FOLDS.items()),
        *((name, image, {name: place}, SOME) for name, place in SMOOTH.items()),
        ("a child's size: cheek, chin, under the jaw", child(image), small, FEW),
    ]
    for name, head, places, sizes in groups:
        yield name, _with_pads(head, places, sizes)
    padded = ((size, in_8_bit(scan)) for size, scan in _with_pads(image, few, FEW))
    yield "8 bit: cheek, chin, under the jaw", padded
    still = {"as scanned": image, "child": child(image), "8 bit": in_8_bit(image)}
    turned = ((f"turned by {angles}", variants.turned(image, angles)[0]) for angles in TURNS)
    yield "no pad: as scanned, child's size, 8 bit", iter(still.items())
    yield f"no pad: turned in {len(TURNS)} ways", turned


def _with_pads(
    image: ImageData, places: dict[str, Place], sizes: tuple[tuple[float, float], ...]
) -> Cases:
    for (name, place), (width, thickness) in product(places.items(), sizes):
        where = f"{name}, " if len(places) > 1 else ""
        padded = variants.with_pad(image, place, width, thickness)
        yield f"{where}{width:g} × {thickness:g}", padded


def main() -> None:
    """Segments every scan, and prints or publishes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[], help="rows whose name contains a word")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    folder = data_folder()
    image = read_image_file(folder / "ct_phantom" / "ct.nii.gz").image
    table = ["| where | scans | reported | not reported |", "|---|---:|---:|---|"]
    for name, cases in rows(image):
        if options.only and not any(word in name for word in options.only):
            continue
        found = {case: is_reported(scan) for case, scan in cases}
        missed = "; ".join(case for case, reported in found.items() if not reported)
        print(f"{name}: {found}", flush=True)
        missed = "all, rightly" if name.startswith("no pad") and not any(found.values()) else missed
        table.append(f"| {name} | {len(found)} | {sum(found.values())} | {missed} |")
    head = f"cmfsim {cmfsim.__version__}, {platform.machine()}. Diameter × thickness in mm."
    publish(options.markdown, NAME, f"{head}\n\n" + "\n".join(table))


if __name__ == "__main__":
    main()
