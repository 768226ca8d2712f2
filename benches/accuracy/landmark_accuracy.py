"""Distances of automatically found landmarks from those that a person placed.

Real heads (the folder named by CMFSIM_DATA, else ../shared/data; skipped where absent) in other
shapes than their own; as they are, each with the synthetic head as the only template and with the
other real head as a further one; variants of the CT that are cropped or degraded; and synthetic
heads, whose landmarks are known. What was measured before a change is kept with --keep, and
compared with --before, head by head and site by site.

    python -m benches.accuracy.landmark_accuracy --markdown docs/landmarks.md [--keep FILE]
        [--before FILE]
"""

import argparse
import json
import os
import platform
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

import cmfsim
from benches.scenes import ct_variants as variants
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder
from benches.scenes.warped_heads import KnownHead, warped
from cmfsim.imaging import segment_head
from cmfsim.io.images.image_files import read_image_file
from cmfsim.pipeline.proposing import head_surfaces, read_template_head
from cmfsim.registration.proposed import TemplateHead
from cmfsim.values.image_data import ImageData
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS
from cmfsim.values.proposed_landmarks import ProposedLandmarks
from cmfsim.values.surface_data import SurfaceData

ROOT = Path(__file__).parents[2]
NAME = "benches/accuracy/landmark_accuracy.py"
# What counts as close, mm.
CLOSE = 4.0
Points = Mapping[str, np.ndarray]
Truth = tuple[Points, Points]


@dataclass(frozen=True)
class Row:
    """Errors of one head, mm, by kind and label, and those more than twice the expected ones."""

    name: str
    errors: Mapping[tuple[str, str], float]
    dishonest: Mapping[str, str]
    missing: tuple[str, ...]
    doubtful: tuple[str, ...]
    seconds: float


def compared(name: str, found: ProposedLandmarks, truth: Truth, seconds: float) -> Row:
    """The errors of one head."""
    errors = {
        (kind, label): float(np.linalg.norm(site.point - known[label]))
        for kind, sites, known in (("skull", found.skull, truth[0]), ("skin", found.skin, truth[1]))
        for label, site in sites.items()
        if label in known
    }
    dishonest = {
        label: f"{label} {errors[kind, label]:.1f} ({site.error:.1f})"
        for kind, sites in (("skull", found.skull), ("skin", found.skin))
        for label, site in sites.items()
        if errors.get((kind, label), 0.0) > 2.0 * site.error
    }
    doubtful = [n for sites in (found.skull, found.skin) for n, s in sites.items() if s.doubt]
    missing = [*found.missing_skull, *(f"{name} (skin)" for name in found.missing_skin)]
    return Row(name, errors, dishonest, tuple(missing), tuple(doubtful), seconds)


def measured(
    name: str,
    bones: Mapping[str, SurfaceData],
    skin: SurfaceData | None,
    truth: Truth,
    templates: Sequence[TemplateHead] = (),
) -> Row:
    """The errors of one head, and the processor time of finding its landmarks."""
    begun = time.process_time()
    found = cmfsim.propose_landmarks(bones, skin, templates=templates)
    return compared(name, found, truth, time.process_time() - begun)


def synthetic_rows(count: int) -> Iterator[Row]:
    """Synthetic heads of random parameters, and one whose mouth is open."""
    people = [cmfsim.HeadParameters.random(seed) for seed in range(100, 100 + count)]
    for number, parameters in enumerate(people, start=1):
        head = cmfsim.make_head(parameters)
        truth = (head.skull_landmarks, head.skin_landmarks)
        yield measured(f"synthetic {number}", *head_surfaces(head.anatomy(1.5)), truth)


def turned_rows(count: int) -> Iterator[Row]:
    """Synthetic heads of other sizes, turned by 40° about one axis after another."""
    for number in range(count):
        factor, sign = (0.75, 1.0, 1.15)[number % 3], (1.0, -1.0)[number // 3 % 2]
        angles = np.roll([40.0 * sign, 0.0, 0.0], number % 3)
        head = cmfsim.make_head(cmfsim.HeadParameters.random(200 + number))
        turn = factor * Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        bones, skin = head_surfaces(head.anatomy(1.5))
        surfaces = {n: replace(s, vertices=s.vertices @ turn.T) for n, s in bones.items()}
        moved = None if skin is None else replace(skin, vertices=skin.vertices @ turn.T)
        truth = tuple(
            {n: turn @ p for n, p in points.items()}
            for points in (head.skull_landmarks, head.skin_landmarks)
        )
        name = f"synthetic, size {factor:g}, turned by {np.array2string(angles, precision=0)}"
        yield measured(name, surfaces, moved, (truth[0], truth[1]))


def warped_rows(data: Path) -> Iterator[Row]:
    """The real heads in other shapes."""
    for folder in ("ct_phantom", "atlas_head"):
        if folder == "ct_phantom":
            found = head_surfaces(segment_head(read_image_file(data / folder / "ct.nii.gz").image))
        else:
            known = read_template_head(data / folder)
            found = dict(known.bones), known.skin
        if found[1] is None:
            continue
        for name, head in warped(KnownHead(found[0], found[1], _truth(data / folder))):
            try:
                yield measured(f"{folder}, {name}", head.bones, head.skin, head.truth)
            except cmfsim.CmfsimError as error:
                yield Row(f"{folder}, {name}: {error}", {}, {}, (), (), 0.0)


def real_rows(data: Path) -> Iterator[Row]:
    """The CT of the head phantom, its variants, and the atlas head."""
    truth = _truth(data / "ct_phantom")
    image = read_image_file(data / "ct_phantom" / "ct.nii.gz").image
    phantom = head_surfaces(segment_head(image))
    atlas = read_template_head(data / "atlas_head")
    own_truth = (atlas.skull, atlas.skin_landmarks)
    other = TemplateHead("ct_phantom", phantom[0], truth[0], phantom[1], truth[1])
    yield measured("CT phantom", *phantom, truth)
    yield measured("CT phantom, atlas head as template", *phantom, truth, [atlas])
    yield measured("atlas head", atlas.bones, atlas.skin, own_truth)
    yield measured(
        "atlas head, CT phantom as template", atlas.bones, atlas.skin, own_truth, [other]
    )
    for name, changed, matrix in _variants(image, truth[0]):
        moved = tuple(
            {n: matrix[:3, :3] @ p + matrix[:3, 3] for n, p in points.items()} for points in truth
        )
        surfaces = head_surfaces(segment_head(changed))
        yield measured(f"CT phantom, {name}", *surfaces, (moved[0], moved[1]))


def _truth(folder: Path) -> Truth:
    return (
        cmfsim.read_landmarks(folder / "skull_landmarks.mrk.json"),
        cmfsim.read_landmarks(folder / "skin_landmarks.mrk.json"),
    )


def _variants(image: ImageData, skull: Points) -> Iterator[tuple[str, ImageData, np.ndarray]]:
    still = np.eye(4)
    yield "cut at the chin", _cropped(image, low=skull["supramentale"][2]), still
    yield "cut at the forehead", _cropped(image, high=skull["glabella"][2] + 12.0), still
    yield "voxels of 3 mm", _coarse(image, 3.0), still
    yield "turned by 12°, −8° and 10°", *variants.turned(image, (12.0, -8.0, 10.0))
    yield "nodding by 15°", *variants.turned(image, (15.0, 0.0, 0.0))


def _cropped(image: ImageData, low: float = -np.inf, high: float = np.inf) -> ImageData:
    along = image.axes()[2].ravel()
    kept = np.flatnonzero((along >= low) & (along <= high))
    origin = np.array(image.origin, dtype=np.float64)
    origin[2] = along[kept[0]]
    return ImageData(image.values[:, :, kept[0] : kept[-1] + 1], image.spacing, origin)


def _coarse(image: ImageData, spacing: float) -> ImageData:
    values = np.asarray(image.values, dtype=np.float32)
    own = np.asarray(image.spacing)
    blurred = ndimage.gaussian_filter(values, 0.4 * spacing / own)
    fewer = ndimage.zoom(blurred, own / spacing, order=1)
    step = own * (np.array(values.shape) - 1) / (np.array(fewer.shape) - 1)
    return ImageData(fewer, step, image.origin)


def page(unseen: Sequence[Row], real: Sequence[Row], synthetic: Sequence[Row]) -> str:
    """The tables in Markdown, heads that nobody saw during development first."""
    parts = [_origin(), *([_unseen(unseen)] if unseen else []), _heads(real, synthetic)]
    whole = [row for row in real if row.name in {"CT phantom", "atlas head"}]
    parts.append(_sites(whole, synthetic))
    lines = [
        f"- {row.name}: {', '.join(row.missing) or 'none'}; doubtful: "
        f"{', '.join(row.doubtful) or 'none'}"
        for row in real
        if row.missing or row.doubtful
    ]
    if lines:
        parts += ["Sites reported as missing, and doubtful ones:", "\n".join(lines)]
    return "\n\n".join(parts)


def _origin() -> str:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],  # noqa: S607
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    return (
        f"Commit {commit}, {platform.machine()}, {os.cpu_count()} cores, Python "
        f"{platform.python_version()}; `python -m {__spec__.name} --synthetic 6 --markdown "
        "docs/landmarks.md`. Distances in mm; seconds are processor time without reading and "
        "segmenting the image."
    )


def _unseen(rows: Sequence[Row]) -> str:
    """A line for each shape that real heads were given, and one for all."""
    lines = [
        f"| head | found | mean | 90 % | within {CLOSE:g} mm | worst | twice as stated | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    means = []
    for row in rows:
        values = np.array([*row.errors.values()] or [np.nan])
        means.append(float(values.mean()))
        worst = sorted(row.errors.items(), key=lambda item: -item[1])[:2]
        lines.append(
            f"| {row.name} | {len(row.errors)} | {values.mean():.2f} | "
            f"{np.quantile(values, 0.9):.1f} | {100 * (values <= CLOSE).mean():.0f} % | "
            f"{', '.join(f'{label} {error:.1f}' for (_, label), error in worst)} | "
            f"{', '.join(row.dishonest.values()) or '–'} | {row.seconds:.1f} |"
        )
    every = np.array([error for row in rows for error in row.errors.values()])
    total = (
        f"All {len(rows)}: {every.mean():.2f} mm on average, {100 * (every <= CLOSE).mean():.0f} % "
        f"within {CLOSE:g} mm; of the means of heads, 90 % are below "
        f"{np.nanquantile(means, 0.9):.2f} mm, and the worst is {np.nanmax(means):.2f} mm. Sites "
        "that are off by more than twice the expected error have that in brackets."
    )
    return "\n".join([total, "", *lines])


def _heads(real: Sequence[Row], synthetic: Sequence[Row]) -> str:
    lines = [
        f"| head | found | mean | 90 % | within {CLOSE:g} mm | worst site | s |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in real:
        values = np.array(list(row.errors.values()))
        (_, worst), largest = max(row.errors.items(), key=lambda item: item[1])
        lines.append(
            f"| {row.name} | {len(values)} | {values.mean():.2f} | {np.quantile(values, 0.9):.1f} "
            f"| {100 * (values <= CLOSE).mean():.0f} % | {worst} {largest:.1f} "
            f"| {row.seconds:.1f} |"
        )
    if synthetic:
        means = [np.mean(list(row.errors.values())) for row in synthetic]
        values = np.concatenate([list(row.errors.values()) for row in synthetic])
        largest, worst = max(
            (value, site) for row in synthetic for (_, site), value in row.errors.items()
        )
        lines.append(
            f"| {len(synthetic)} synthetic heads (worst head: mean {max(means):.2f}) | "
            f"{min(len(row.errors) for row in synthetic)} and more | {values.mean():.2f} | "
            f"{np.quantile(values, 0.9):.1f} | {100 * (values <= CLOSE).mean():.0f} % | {worst} "
            f"{largest:.1f} | {max(row.seconds for row in synthetic):.1f} |"
        )
    return "\n".join(lines)


def _sites(real: Sequence[Row], synthetic: Sequence[Row]) -> str:
    names = [row.name for row in real]
    lines = [
        f"| site | {' | '.join(names)} | synthetic, mean | synthetic, worst |",
        "|---" * (len(names) + 3) + "|",
    ]
    for kind, labels in (("skull", SKULL_LANDMARKS), ("skin", SKIN_LANDMARKS)):
        for base in dict.fromkeys(_base(label) for label in labels):
            of_site = [(kind, n) for n in (base, f"{base}_L", f"{base}_R")]
            cells = [_cell([row.errors[s] for s in of_site if s in row.errors]) for row in real]
            made = [row.errors[s] for row in synthetic for s in of_site if s in row.errors]
            cells += [f"{np.mean(made):.1f}", f"{max(made):.1f}"] if made else ["–", "–"]
            title = f"{base} (skin)" if kind == "skin" else base
            lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def changes(before: Path, rows: Sequence[Row]) -> str:
    """What differs by half a millimetre and more from errors that were kept, and the means."""
    kept = json.loads(before.read_text(encoding="utf-8"))
    lines = ["| head | before | now | sites that differ by 0.5 mm and more |", "|---|---|---|---|"]
    for row in rows:
        old = kept.get(row.name, {})
        now = {f"{label} ({kind})": error for (kind, label), error in row.errors.items()}
        moved = [
            f"{site} {old[site]:.1f} → {error:.1f}"
            for site, error in now.items()
            if site in old and abs(error - old[site]) >= 0.5
        ]
        means = [np.mean([*errors.values()]) if errors else np.nan for errors in (old, now)]
        lines.append(f"| {row.name} | {means[0]:.2f} | {means[1]:.2f} | {', '.join(moved)} |")
    return "\n".join(lines)


def keep(path: Path, rows: Sequence[Row]) -> None:
    """Writes the errors of all heads by site, mm."""
    errors = {
        row.name: {f"{label} ({kind})": error for (kind, label), error in row.errors.items()}
        for row in rows
    }
    path.write_text(json.dumps(errors), encoding="utf-8")


def _cell(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.1f}" for value in values) or "–"


def _base(label: str) -> str:
    return label[:-2] if label.endswith(("_L", "_R")) else label


def main() -> None:
    """Measures, and prints the tables or puts them into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--synthetic", type=int, default=20, help="synthetic heads (default 20)")
    parser.add_argument("--no-real", action="store_true", help="synthetic heads alone")
    parser.add_argument("--markdown", type=Path, help="page whose marked place is filled")
    parser.add_argument("--keep", type=Path, help="file for the errors by head and site")
    parser.add_argument("--before", type=Path, help="such a file, to compare with")
    options = parser.parse_args()
    data = data_folder()
    unseen: list[Row] = []
    real: list[Row] = []
    if not options.no_real and data.is_dir():
        unseen = list(_shown(warped_rows(data)))
        real = list(_shown(real_rows(data)))
    elif not options.no_real:
        print(f"{data} is absent: real heads are skipped (set CMFSIM_DATA)")
    real += _shown(turned_rows(options.synthetic // 3))
    synthetic = list(_shown(synthetic_rows(options.synthetic)))
    if options.keep:
        keep(options.keep, [*unseen, *real, *synthetic])
    if options.before:
        print(changes(options.before, [*unseen, *real, *synthetic]))
    publish(options.markdown, NAME, page(unseen, real, synthetic))


def _shown(rows: Iterator[Row]) -> Iterator[Row]:
    for row in rows:
        values = np.array(list(row.errors.values()) or [np.nan])
        print(
            f"{row.name}: {len(values)} sites, mean {values.mean():.2f} mm, 90 % "
            f"{np.quantile(values, 0.9):.1f} mm, {row.seconds:.1f} s",
            flush=True,
        )
        yield row


if __name__ == "__main__":
    main()
