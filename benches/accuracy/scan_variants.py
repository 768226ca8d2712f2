"""Errors of segmentation caused by metal, other scanners, crops and objects on the face, in mm.

Each variant is made from a CT whose segmentation is known. Skin and bone of both are compared in
the face, in both directions (excess and missing parts), away from where the variant is cut off. A
variant whose surfaces are beyond the tolerances must be reported by a finding or refused by a
specific error; otherwise its verdict is "silent".

    python -m benches.accuracy.scan_variants --before COMMIT --markdown docs/real_scans.md

Needs the real CT (the folder named by CMFSIM_DATA, else ../shared/data).
"""

import argparse
import io
import json
import os
import platform
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

import cmfsim
from benches.scenes import ct_variants as variants
from benches.scenes import scanner_effects as effects
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder
from cmfsim import ImageData

ROOT = Path(__file__).parents[2]
NAME = "benches/accuracy/scan_variants.py"
# The face of the CT phantom, LPS mm: lowest and highest corner.
FACE = np.array([[-200.0, -400.0, 322.0], [200.0, -200.0, 520.0]])
# A cut-off head is closed flat: surfaces this near to a border are not compared, mm.
BORDER = 4.0
# Surfaces farther than these from those of the clean scan, mm, or a tissue volume that differs by
# more than this part, have to be reported: voxels of the scan, and twice the error of landmarks.
TOLERANCES = {"skin p95": 1.0, "skin max": 5.0, "bone p95": 2.0, "bone max": 6.0, "tissue": 0.05}
SAMPLES = 20000
# Middle and radius of the field of view of cone-beam scanners for the face, mm.
MIDDLE, RADIUS = (0.0, -250.0), 80.0


@dataclass(frozen=True)
class Variant:
    """A scan made harder.

    Attributes
    ----------
    make : callable
        The image of the clean one.
    low, high : (3,) float, mm
        Where the variant shows the head.
    radius : float, mm
        Of a round field of view about MIDDLE.
    refused : bool
        Whether the image is no CT, so that anything but an error is wrong.
    """

    make: Callable[[ImageData], ImageData]
    low: tuple[float, float, float] = (-1e9, -1e9, -1e9)
    high: tuple[float, float, float] = (1e9, 1e9, 1e9)
    radius: float = np.inf
    refused: bool = False

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Which points are compared."""
        low, high = np.maximum(FACE[0], self.low), np.minimum(FACE[1], self.high)
        inside = ((points > low + BORDER) & (points < high - BORDER)).all(axis=1)
        away = np.hypot(points[:, 0] - MIDDLE[0], points[:, 1] - MIDDLE[1])
        seen: np.ndarray = inside & (away < self.radius - BORDER)
        return seen


def _shifted(by: float) -> Callable[[ImageData], ImageData]:
    return lambda image: image.with_values((image.values.astype(np.int32) + int(by)).astype("i2"))


def _filled(image: ImageData, **options: Any) -> ImageData:
    pieces = effects.fillings(image, variants.FILLINGS)
    return effects.with_metal_scanned(image, [pieces], **options)


def _filled_noisily(image: ImageData, sigma: float) -> ImageData:
    """Amalgam on an extended scale, in a scan of a low dose."""
    noise = np.random.default_rng(0).normal(0.0, sigma, image.values.shape)
    filled = _filled(image, top=effects.EXTENDED)
    noisy = np.round(filled.values + noise).clip(-1024, effects.EXTENDED)
    return filled.with_values(noisy.astype(np.int32))


def _braced(image: ImageData, **options: Any) -> ImageData:
    rows = [(x, z) for x in np.arange(-21.0, 22.0, 7.0) for z in (379.0, 364.0)]
    pieces = [
        effects.on_bone(image, "steel", rows, (3.5, 2.5, 3.0)),
        effects.on_bone(image, "steel", [(x, z) for x, z in rows if z > 370], (7.0, 0.8, 0.8)),
    ]
    return effects.with_metal_scanned(image, pieces, **options)


def _plated(image: ImageData) -> ImageData:
    places = [(-14.0, 395.0), (14.0, 395.0), (0.0, 342.0)]
    pieces = [effects.on_bone(image, "titanium", places, (12.0, 1.5, 5.0))]
    return effects.with_metal_scanned(image, pieces)


def _tube(image: ImageData) -> ImageData:
    """A tube of 10 mm from the lips over one cheek, 4 mm in front of the skin."""
    x, y, z = (a.ravel() for a in image.axes())
    middle = []
    for a in np.arange(6.0, 55.0):
        b = 371.0 - 0.1 * a
        column = image.values[np.argmin(np.abs(x + a)), :, np.argmin(np.abs(z - b))]
        middle.append([-a, y[np.flatnonzero(column > -300)[0]] - 4.0, b])
    return variants.with_tube(image, np.array(middle))


def _cushion(image: ImageData) -> ImageData:
    """A pad of foam against one cheek, as chin rests and straps have them."""
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    pad = (x > 40.0) & (x < 95.0) & (np.abs(y + 275.0) < 25.0) & (np.abs(z - 375.0) < 25.0)
    values[pad & (values < -120)] = -120
    return image.with_values(values)


def _chin_rest(image: ImageData) -> ImageData:
    """A plate of plastic under the chin, touching it over a palm's width."""
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    plate = (np.abs(x) < 45.0) & (y < -230.0) & (y > -330.0) & (np.abs(z - 321.0) < 5.0)
    values[plate & (values < 120)] = 120
    return image.with_values(values)


def _coarse(image: ImageData) -> ImageData:
    own, step = np.asarray(image.spacing), np.full(3, 3.0)
    blurred = ndimage.gaussian_filter(image.values.astype(np.float32), 0.4 * step / own)
    places = [
        np.arange(0.0, n - 1.0, s / o) for n, s, o in zip(blurred.shape, step, own, strict=True)
    ]
    grid = np.meshgrid(*places, indexing="ij")
    values = ndimage.map_coordinates(blurred, grid, order=1)
    return ImageData(np.round(values).astype(np.int16), step, image.origin)


def _cone(**options: Any) -> Callable[[ImageData], ImageData]:
    return lambda image: effects.cone_beam(image, effects.ConeBeam(middle=MIDDLE, **options))


def _small_cone(image: ImageData) -> ImageData:
    shown = variants.cropped(image, 2, low=318.0, high=440.0)
    scanner = effects.ConeBeam(
        slope=0.55, offset=780.0, cupping=150.0, noise=120.0, radius=RADIUS, middle=MIDDLE
    )
    cone = effects.cone_beam(shown, scanner)
    for axis in (0, 1):
        low, high = MIDDLE[axis] - RADIUS, MIDDLE[axis] + RADIUS
        cone = variants.cropped(cone, axis, low=low, high=high)
    return cone


VARIANTS: Mapping[str, Variant] = {
    "as scanned": Variant(lambda image: image),
    "amalgam, cut off at 3071 HU": Variant(_filled),
    "amalgam, up to 30000 HU": Variant(lambda i: _filled(i, top=effects.EXTENDED)),
    "brackets and wire of steel": Variant(_braced),
    "brackets, up to 30000 HU": Variant(lambda i: _braced(i, top=effects.EXTENDED)),
    "plates of titanium": Variant(_plated),
    "amalgam and noise of 100 HU": Variant(lambda i: _filled_noisily(i, 100.0)),
    "amalgam and noise of 150 HU": Variant(lambda i: _filled_noisily(i, 150.0)),
    "noise of 60 HU": Variant(lambda i: variants.with_noise(i, 60.0)),
    "noise of 150 HU": Variant(lambda i: variants.with_noise(i, 150.0)),
    "200 HU too high": Variant(_shifted(200.0)),
    "200 HU too low": Variant(_shifted(-200.0)),
    "1024 too high": Variant(_shifted(1024.0)),
    "cone beam: cupping 150, noise 100": Variant(_cone()),
    "cone beam, 0.55·HU + 780": Variant(_cone(slope=0.55, offset=780.0, noise=120.0)),
    "cone beam, 160 mm of the head": Variant(
        _small_cone, low=(-80.0, -330.0, 318.0), high=(80.0, -170.0, 440.0), radius=RADIUS
    ),
    "chin cut off": Variant(lambda i: variants.cropped(i, 2, low=352.0), low=(-1e9, -1e9, 352.0)),
    "cut 3 mm below the chin": Variant(
        lambda i: variants.cropped(i, 2, low=323.0), low=(-1e9, -1e9, 323.0)
    ),
    "forehead cut off": Variant(
        lambda i: variants.cropped(i, 2, high=455.0), high=(1e9, 1e9, 455.0)
    ),
    "nose cut off": Variant(lambda i: variants.cropped(i, 1, low=-308.0), low=(-1e9, -308.0, -1e9)),
    "voxels of 3 mm": Variant(_coarse),
    "tube taped to the lips": Variant(_tube),
    "cushion on one cheek": Variant(_cushion),
    "plate under the chin": Variant(_chin_rest),
    "MR image": Variant(effects.as_magnetic_resonance, refused=True),
}


def surface_points(level: ImageData) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (mm) and triangles of a level's zero set."""
    values = np.pad(level.values, 1, constant_values=-1.0)
    spacing = np.asarray(level.spacing)
    points, triangles, _, _ = marching_cubes(
        values, 0.0, spacing=tuple(spacing), allow_degenerate=False
    )
    return points + level.lowest - spacing, triangles


def parts_of(anatomy: cmfsim.Anatomy) -> dict[str, ImageData]:
    """The levels of skin and of all bone."""
    bones = np.max([level.values for level in anatomy.bones.values()], axis=0)
    return {"skin": anatomy.skin, "bone": anatomy.skin.with_values(bones)}


def compared(found: cmfsim.Anatomy, clean: cmfsim.Anatomy, variant: Variant) -> dict[str, float]:
    """Distances of the surfaces, mm, and the relative change of the tissue's volume."""
    result: dict[str, float] = {}
    for name, level in parts_of(found).items():
        other = parts_of(clean)[name]
        one, two = surface_points(level), surface_points(other)
        apart = np.concatenate([_apart(one, two, variant), _apart(two, one, variant)])
        result |= {
            f"{name} mean": float(apart.mean()),
            f"{name} p95": float(np.percentile(apart, 95.0)),
            f"{name} max": float(apart.max()),
        }
    result["tissue"] = _tissue(found, variant) / _tissue(clean, variant) - 1.0
    return result


def _apart(
    points: tuple[np.ndarray, np.ndarray], surface: tuple[np.ndarray, np.ndarray], variant: Variant
) -> np.ndarray:
    seen = points[0][variant.sees(points[0])]
    seen = seen[np.random.default_rng(0).permutation(len(seen))[:SAMPLES]]
    closest = cmfsim.Surface(*surface).closest(seen)[0]
    apart: np.ndarray = np.linalg.norm(seen - closest, axis=1)
    return apart


def _tissue(anatomy: cmfsim.Anatomy, variant: Variant) -> float:
    """Volume of soft tissue where the variant is compared, mm³."""
    parts = parts_of(anatomy)
    soft = (parts["skin"].values > 0.0) & (parts["bone"].values <= 0.0)
    if anatomy.air is not None:
        soft &= anatomy.air.values <= 0.0
    places = anatomy.skin.lowest + np.argwhere(soft) * np.asarray(anatomy.skin.spacing)
    return float(np.count_nonzero(variant.sees(places)) * np.prod(anatomy.skin.spacing))


def measured(folder: Path) -> list[dict[str, Any]]:
    """A row for each variant of a folder, by the cmfsim that this process has."""
    rows = []
    points = None
    clean = None
    if (folder / "landmarks.mrk.json").is_file():
        points = cmfsim.read_landmarks(folder / "landmarks.mrk.json")
    known: set[str] = set()
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as stored:
            image = ImageData(stored["values"], stored["spacing"], stored["origin"])
            name = str(stored["name"])
        row: dict[str, Any] = {"name": name, "codes": [], "error": ""}
        begun = time.process_time()
        try:
            found = cmfsim.segment_head(image, landmarks=points)
        except cmfsim.ImageError as error:
            row["error"] = str(error)
        else:
            clean = found if clean is None else clean
            row["seconds"] = time.process_time() - begun
            codes = {f.code for f in found.findings}
            known = known or codes
            row["codes"] = sorted(codes - known)
            row |= compared(found, clean, VARIANTS[name])
            row["jaws"] = sorted(found.bones)
        print(json.dumps(row), file=sys.stderr, flush=True)
        rows.append(row)
    return rows


def verdict(row: Mapping[str, Any]) -> str:
    """Whether a variant is within the tolerances, reported, refused or silent."""
    if VARIANTS[row["name"]].refused:
        return "refused, rightly" if row["error"] else "**taken for a CT**"
    if row["error"]:
        return "refused"
    codes = ", ".join(f"`{code}`" for code in row["codes"])
    beyond = [k for k, most in TOLERANCES.items() if abs(row[k]) > most]
    if not beyond:
        return f"within tolerance{f'; {codes}' if codes else ''}"
    return f"reported: {codes}" if codes else f"**silent**: {', '.join(beyond)}"


def _cells(row: Mapping[str, Any]) -> str:
    if row["error"]:
        return "– | – | –"
    skin, bone = (
        " / ".join(f"{row[f'{part} {what}']:.2f}" for what in ("mean", "p95", "max"))
        for part in ("skin", "bone")
    )
    return f"{skin} | {bone} | {100.0 * row['tissue']:+.1f}"


def page(runs: Mapping[str, list[dict[str, Any]]]) -> str:
    """The table in Markdown."""
    commit = _git("rev-parse", "--short", "HEAD").decode().strip()
    made = (
        f"cmfsim {cmfsim.__version__} after commit {commit}, {platform.machine()}, Python "
        f"{platform.python_version()}; `python {NAME}`. Distances in mm: mean / 95 % / largest."
    )
    lines = [
        made,
        "",
        "| variant | | skin | bone | tissue, % | verdict |",
        "|---|---|---|---|---|---|",
    ]
    for at in range(len(next(iter(runs.values())))):
        for state, rows in runs.items():
            row = rows[at]
            lines.append(f"| {row['name']} | {state} | {_cells(row)} | {verdict(row)} |")
    return "\n".join(lines)


def _git(*arguments: str) -> bytes:
    command = ["git", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout  # noqa: S603


def _run(folder: Path, package: Path) -> list[dict[str, Any]]:
    """The rows of another state of the package, measured by a process of its own."""
    command = [sys.executable, "-m", __spec__.name, "--measure", str(folder)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(package), str(ROOT)])}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)  # noqa: S603
    rows: list[dict[str, Any]] = json.loads(done.stdout)
    return rows


def _earlier(commit: str, folder: Path) -> Path:
    """The package of a commit, with the extension built for this one."""
    with tarfile.open(fileobj=io.BytesIO(_git("archive", commit, "python"))) as archive:
        archive.extractall(folder, filter="data")
    core = next((ROOT / "python" / "cmfsim").glob("_core*.so"))
    (folder / "python" / "cmfsim" / core.name).symlink_to(core)
    return folder / "python"


def _make(data: Path, folder: Path, wanted: str) -> None:
    image = cmfsim.read_image(data / "ct.nii.gz")
    points = data / "skull_landmarks.mrk.json"
    (folder / "landmarks.mrk.json").write_bytes(points.read_bytes())
    for number, (name, variant) in enumerate(VARIANTS.items()):
        if number and wanted not in name:
            continue
        made = variant.make(image)
        path = folder / f"{number:02d}.npz"
        np.savez(path, values=made.values, spacing=made.spacing, origin=made.origin, name=name)


def main() -> None:
    """Makes the variants, measures them, and prints the table or puts it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", help="a commit to be compared with")
    parser.add_argument("--only", default="", help="variants whose name has this in it")
    parser.add_argument("--markdown", type=Path, help="page whose marked place is filled")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measured(options.measure)))
        return
    data = data_folder() / "ct_phantom"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        _make(data, folder / "images", options.only)
        runs = {}
        if options.before:
            runs["before"] = _run(folder / "images", _earlier(options.before, folder / "earlier"))
        runs["after" if options.before else ""] = _run(folder / "images", ROOT / "python")
    if options.json:
        options.json.write_text(json.dumps(runs, indent=1))
    publish(options.markdown, NAME, page(runs))


if __name__ == "__main__":
    main()
