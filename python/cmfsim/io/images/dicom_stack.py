"""The volume of DICOM slices, by what each slice states.

The order of slices, their distances and their shifts come from the position and orientation of each
slice, never from file names, instance numbers or a reader's sorting.
"""

import contextlib
import itertools
import math
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.io.files.reading_writing import utf8_path
from cmfsim.io.images.dicom_headers import (
    SHOWN_INVERTED,
    DicomHeader,
    Slice,
    Stack,
    counted,
    is_localizer,
    listed,
    numbers_of,
)
from cmfsim.io.images.image_grids import of_slices, on_axes
from cmfsim.io.images.image_headers import check_shape
from cmfsim.processes.child import ReaderError, read_in_child
from cmfsim.processes.worker import ReadLimits
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData

# Slices of another orientation than the rest, up to this many, are scouts.
MOST_SCOUTS = 3
# Direction cosines of parallel slices agree up to this.
PARALLEL = 1e-3
# Two slices this near are at one place, mm: positions are often written to a tenth.
ONE_PLACE = 0.02
# Positions off an even, straight row by less than this are so by rounding, mm.
ROUNDED = 0.06
# Slices between these parts of the usual distance are resampled; others are missing or too many.
LEAST_STEP, MOST_STEP = 0.5, 1.5
# A step this near to a multiple of the usual one, as a part of it, is that of missing slices.
MULTIPLE = 0.1
# Largest error of the skin between tilted slices over their distance: 0.18 and 0.44 mm on a head
# phantom's CT, written as tilted slices 1 and 2 mm apart.
SKIN_SHARE = 0.22
# Tilts that the geometry shows and that the header states differ by less than this, degrees.
TILTS_AGREE = 1.0
# Voxels farther apart than this lose thin bone, lips and lids, mm.
COARSE_SLICES = 2.5
# Position and spacing as the pixel reader finds them agree with the header's to this, mm.
READERS_AGREE = 0.01
# Kinds of value that say HU, or nothing.
UNSTATED_SCALES = frozenset({"", "HU", "US"})


def volume_of(
    name: str, slices: list[Slice], modality: str, findings: list[Finding]
) -> tuple[ImageData, str, tuple[Finding, ...]]:
    """The volume of slices, its modality, and what was noticed."""
    slices = _with_orientations(name, slices, findings)
    slices = _without_scouts(name, slices, findings)
    stack = _stack(name, slices)
    values = _pixels(name, stack)
    kept = _without_copies(name, stack, values, findings)
    if len(kept) < len(stack.slices):
        stack, values = stack.kept(kept), values[kept]
    _check_acquisitions(name, stack, findings)
    uneven = _check_steps(name, stack)
    if assumed := next((a for s in stack.slices if (a := s.text("assumed"))), ""):
        what = (
            f"the file states the place of its first frame alone; the {len(stack.slices)} frames "
            f"were placed one after the other along its normal, {assumed}"
        )
        findings.append(Finding("dicom-frames-assumed", what, where=name))
    image = _placed(name, stack, values, uneven, findings)
    if any(s.text("photometric") == SHOWN_INVERTED for s in stack.slices):
        what = f"{SHOWN_INVERTED} is ignored: it states that the lowest value is shown white"
        why = "what is shown follows the rescaling: the values in HU are the same (PS3.3 C.7.6.3.1)"
        fix = "check that bone is brighter than air in anatomy.png; otherwise export the CT again"
        findings.append(Finding("field-ignored", what, where=name, why=why, fix=fix))
    kinds = {s.text("rescale_type").upper() for s in stack.slices} - UNSTATED_SCALES
    if kinds:
        what = f"the header states that values are {', '.join(sorted(kinds))!r}, not HU"
        findings.append(Finding("ct-not-hu", what, where=name))
    return image, modality, tuple(findings)


def _with_orientations(name: str, slices: list[Slice], findings: list[Finding]) -> list[Slice]:
    """The slices, those that state no orientation with that of all others.

    Their places show that they belong to the row: the steps between slices are checked.
    """
    silent = [s for s in slices if not s.text("orientation").strip()]
    stated = {s.text("orientation") for s in slices if s not in silent}
    if not silent or len(stated) != 1 or 2 * len(silent) >= len(slices):
        return slices
    tags = {"orientation": stated.pop()}
    what = (
        f"{counted(len(silent), 'slice')} without an orientation were taken to have that of all "
        f"others: {listed([s.name for s in silent])}"
    )
    why = "a slice that is turned within its plane would be out of place"
    fix = "check these slices visually, or export the series again"
    findings.append(Finding("field-ignored", what, where=name, why=why, fix=fix))
    return [replace(s, tags={**s.tags, **tags}) if s in silent else s for s in slices]


def _without_scouts(name: str, slices: list[Slice], findings: list[Finding]) -> list[Slice]:
    """The slices without localizers and with one orientation."""
    scouts = [s for s in slices if is_localizer(s.header)]
    rest = [s for s in slices if not is_localizer(s.header)]
    if not rest:
        rest, scouts = scouts, []
    groups: list[list[Slice]] = []
    for one in rest:
        across = one.numbers("orientation", 6)
        close = (
            g for g in groups if np.abs(g[0].numbers("orientation", 6) - across).max() <= PARALLEL
        )
        if (group := next(close, None)) is None:
            groups.append([one])
        else:
            group.append(one)
    groups.sort(key=len, reverse=True)
    others = [s for g in groups[1:] for s in g]
    if len(others) > min(MOST_SCOUTS, len(groups[0]) - 1):
        text = "; ".join(
            f"{len(g)} slices along {g[0].text('orientation')}, such as {g[0].name}"
            for g in groups[:4]
        )
        raise ImageInputError(
            f"{name}: the series has slices of {len(groups)} orientations: {text}; keep those of "
            "one volume in the folder"
        )
    left = sorted(s.name for s in [*scouts, *others])
    if left:
        what = (
            f"skipped {counted(len(left), 'scout')} (localisers, or slices of another "
            f"orientation): {listed(left)}"
        )
        severity, fix = ("warning", "") if others else ("note", "nothing to do")
        why = "they show the head from different directions"
        found = Finding("dicom-skipped", what, severity=severity, where=name, why=why, fix=fix)
        findings.append(found)
    return groups[0]


def _stack(name: str, slices: list[Slice]) -> Stack:
    """The slices in the order of their places, of one size and spacing."""
    sizes = Counter((s.text("columns"), s.text("rows")) for s in slices)
    spacings = [s.numbers("pixel_spacing", 2) for s in slices]
    usual = np.median(spacings, axis=0)
    if len(sizes) > 1:
        common = sizes.most_common(1)[0][0]
        odd = [s for s in slices if (s.text("columns"), s.text("rows")) != common]
        raise ImageInputError(
            f"{name}: {len(odd)} of {len(slices)} slices have another size than "
            f"{' × '.join(common)} pixels, such as {odd[0].name} with {odd[0].text('columns')} × "
            f"{odd[0].text('rows')}: keep the slices of one volume in the folder"
        )
    least = 1e-4 * float(usual.max())
    pairs = zip(slices, spacings, strict=True)
    odd = [s for s, spacing in pairs if np.abs(spacing - usual).max() > least]
    if odd:
        raise ImageInputError(
            f"{name}: {len(odd)} of {len(slices)} slices have another pixel spacing than "
            f"{usual.tolist()} mm, such as {odd[0].name} with {odd[0].text('pixel_spacing')}: keep "
            "the slices of one volume in the folder"
        )
    if (usual <= 0.0).any() or (usual > 100.0).any():
        raise ImageInputError(f"{name}: pixel spacing is {usual.tolist()} mm")
    for key, what in (("photometric", "kinds of pixel"), ("frame_of_reference", "frames")):
        # A slice that states nothing contradicts none.
        stated = {s.text(key) for s in slices} - {""}
        if len(stated) > 1:
            raise ImageInputError(
                f"{name}: the series mixes {what} ({', '.join(sorted(stated))}): keep the slices "
                "of one volume in the folder"
            )
    kinds = {s.text("photometric") for s in slices} - {"", SHOWN_INVERTED, "MONOCHROME2"}
    if kinds:
        raise ImageInputError(
            f"{name}: pixels are {', '.join(kinds)}: a CT has MONOCHROME2, in which more is "
            "brighter; export the original series again from the scanner or archive"
        )
    columns, rows = (int(n) for n in next(iter(sizes)))
    check_shape(name, [columns, rows, len(slices)])
    across = np.mean([s.numbers("orientation", 6) for s in slices], axis=0).reshape(2, 3)
    lengths = np.linalg.norm(across, axis=1)
    if (np.abs(lengths - 1.0) > PARALLEL).any() or abs(float(across[0] @ across[1])) > PARALLEL:
        raise ImageInputError(
            f"{name}: the orientation {slices[0].text('orientation')} is not a pair of "
            "perpendicular unit vectors"
        )
    axes = across / lengths[:, None]
    positions = np.array([s.numbers("position", 3) for s in slices])
    if float(np.abs(positions).max()) > 1e5:
        raise ImageInputError(f"{name}: a slice lies {np.abs(positions).max():g} mm away")
    heights = positions @ np.cross(axes[0], axes[1])
    # Copies of a slice stand in the order of their names, on any system.
    order = sorted(range(len(slices)), key=lambda i: (float(heights[i]), slices[i].name))
    sorted_slices = tuple(slices[i] for i in order)
    # Pixel spacing states rows first: the distance between rows, then between columns.
    return Stack(sorted_slices, positions[order], axes, (float(usual[1]), float(usual[0])))


def _pixels(name: str, stack: Stack) -> NDArray[Any]:
    """The pixels of all slices, axes slice, row, column, by the third-party reader."""
    files = list(dict.fromkeys(s.header.path for s in stack.slices))
    size = sum(path.stat().st_size for path in files)
    columns, rows = (int(stack.slices[0].text(k)) for k in ("columns", "rows"))
    voxels = columns * rows * len(stack.slices)
    limits = ReadLimits(20.0 + (size + 2 * voxels) / 5e6, 4 * 2**30 + 16 * voxels)
    try:
        if all(s.header.count == 1 and not s.header.frames for s in stack.slices):
            return _of_files(stack, limits)
        parts = {s.header.path: s.header for s in stack.slices}
        frames = {path: _of_frames(header, limits) for path, header in parts.items()}
    except ReaderError as error:
        raise ImageInputError(f"{name}: {error}") from error
    scales = {(s.text("slope"), s.text("intercept")) for s in stack.slices}
    if len(scales) > 1:
        # The reader applies one of them to all.
        raise ImageInputError(
            f"{name}: its frames have {len(scales)} different rescale slopes and intercepts: "
            "export the series as one file per slice"
        )
    return np.stack([frames[s.header.path][s.frame] for s in stack.slices])


def _of_files(stack: Stack, limits: ReadLimits) -> NDArray[Any]:
    paths = []
    with contextlib.ExitStack() as kept:
        folder = kept.enter_context(tempfile.TemporaryDirectory(prefix="cmfsim-dicom-"))
        for k, one in enumerate(stack.slices):
            paths.append(kept.enter_context(utf8_path(_readable(one.header, folder, f"{k}.dcm"))))
        answer = read_in_child("cmfsim.io.images.image_files:read_slices", limits, paths=paths)
    places = np.array(answer.values["places"])
    expected = np.column_stack([stack.positions, np.tile(stack.spacing, (len(paths), 1))])
    off = np.abs(places - expected).max(axis=1)
    if off.max() > READERS_AGREE:
        worst = int(np.argmax(off))
        raise ImageInputError(
            f"{stack.slices[worst].name}: two readings of its position disagree: "
            f"{expected[worst].tolist()} and {places[worst].tolist()} (position and pixel "
            "spacing in mm): export the series again"
        )
    return answer.arrays["values"]


def _readable(header: DicomHeader, folder: str, name: str) -> Path:
    """A file that ITK reads rightly: that of the header, or a copy."""
    data = header.for_reader()
    if data is None:
        return header.path
    copy = Path(folder, name)
    copy.write_bytes(data)
    return copy


def _of_frames(header: DicomHeader, limits: ReadLimits) -> NDArray[Any]:
    with (
        tempfile.TemporaryDirectory(prefix="cmfsim-dicom-") as folder,
        utf8_path(_readable(header, folder, "frames.dcm")) as plain,
    ):
        answer = read_in_child("cmfsim.io.images.image_files:read_frames", limits, path=plain)
    values = answer.arrays["values"]
    return values if values.ndim == 3 else values[None]


def _without_copies(
    name: str, stack: Stack, values: NDArray[Any], findings: list[Finding]
) -> list[int]:
    """The slices without those that are there twice; an error where two at one place differ."""
    kept, copies = [0], []
    heights = stack.heights
    for i in range(1, len(stack.slices)):
        before = kept[-1]
        if heights[i] - heights[before] > ONE_PLACE:
            kept.append(i)
            continue
        one, other = stack.slices[before], stack.slices[i]
        shift = float(np.linalg.norm(stack.positions[i] - stack.positions[before]))
        if shift > ONE_PLACE or not np.array_equal(values[i], values[before]):
            count = int(np.count_nonzero(np.diff(heights) <= ONE_PLACE))
            place = ", ".join(f"{x:.2f}" for x in stack.positions[i])
            raise ImageInputError(
                f"{name}: {one.name} and {other.name} lie in the same place (first pixel at "
                f"{place} mm) "
                f"with different pixels, as {counted(count, 'pair')} of slices do: more than one "
                "scan, reconstruction or time in the series; keep one of them in the folder"
            )
        copies.append(other.name)
    if copies:
        what = f"skipped {counted(len(copies), 'copy')} of slices with the same place and pixels: "
        what += listed(copies)
        why, fix = "the image is the same without them", "nothing to do"
        found = Finding("dicom-skipped", what, severity="note", where=name, why=why, fix=fix)
        findings.append(found)
    return kept


def _off_even(heights: NDArray[np.float64]) -> float:
    """How far heights are off an even row between the first and the last, mm."""
    even = np.linspace(heights[0], heights[-1], len(heights))
    return float(np.abs(heights - even).max())


def _check_acquisitions(name: str, stack: Stack, findings: list[Finding]) -> None:
    """Refuses slices of several scans between one another, unless their places show one row.

    A slice without a number says nothing about which scan it is from.
    """
    ranges: dict[str, list[float]] = {}
    for one, height in zip(stack.slices, stack.heights, strict=True):
        if number := one.text("acquisition_number").strip():
            ranges.setdefault(number, []).append(float(height))
    # One run after the other is how a scanner steps; two runs over one place are two scans.
    spans = sorted((min(h), max(h), number) for number, h in ranges.items())
    is_even = _off_even(stack.heights) <= ROUNDED
    for (_, high, first), (low, _, second) in itertools.pairwise(spans):
        if low < high and not is_even:
            raise ImageInputError(
                f"{name}: the slices of acquisitions {first} and {second} are interleaved "
                f"({low:.2f} to {high:.2f} mm along the normal): two scans or times in one series; "
                "keep the slices of one acquisition in the folder"
            )
        if low < high:
            what = (
                f"the slices of acquisitions {first} and {second} alternate, and together they are "
                "evenly spaced: they were taken as one scan"
            )
            why = "if they are two scans, the patient may have moved between them"
            fix = "look for steps in the skin; keep the slices of one acquisition if there are any"
            findings.append(Finding("field-ignored", what, where=name, why=why, fix=fix))
            return


def _check_steps(name: str, stack: Stack) -> list[int]:
    """The uneven steps of a stack; an error where slices are missing or too many."""
    heights = stack.heights
    steps = np.diff(heights)
    usual = float(np.median(steps))
    wide = np.flatnonzero(steps >= MOST_STEP * usual)
    if len(wide):
        multiples = steps[wide] / usual
        whole = np.abs(multiples - np.round(multiples)) < MULTIPLE
        lost = int(np.sum(np.round(multiples[whole]) - 1))
        what = "slices missing or unevenly spaced"
        if whole.all():
            what = f"{counted(lost, 'slice')} missing"
        raise ImageInputError(
            f"{name}: {what}: slices are {usual:.3g} mm apart, but {_steps(stack, wide)}; export "
            "the whole series again (nothing is interpolated over a gap of more than "
            f"{MOST_STEP:g} times the usual distance)"
        )
    narrow = np.flatnonzero(steps <= LEAST_STEP * usual)
    if len(narrow):
        raise ImageInputError(
            f"{name}: slices too close together: they are {usual:.3g} mm apart, but "
            f"{_steps(stack, narrow)}: more than one scan or reconstruction in the series; keep "
            "one in the folder"
        )
    if _off_even(heights) <= ROUNDED:
        return []
    return [int(i) for i in np.flatnonzero(np.abs(steps - usual) > 0.01 * usual)] or [0]


def _steps(stack: Stack, which: Sequence[int] | NDArray[np.intp]) -> str:
    """Steps with the slices that they lie between."""
    heights = stack.heights
    texts = [
        f"{heights[i + 1] - heights[i]:.3g} mm between {heights[i]:.2f} and {heights[i + 1]:.2f} "
        f"mm ({stack.slices[i].name}, {stack.slices[i + 1].name})"
        for i in list(which)[:4]
    ]
    more = f" and {len(which) - 4} more" if len(which) > 4 else ""
    return ", ".join(texts) + more


def _placed(
    name: str, stack: Stack, values: NDArray[Any], uneven: list[int], findings: list[Finding]
) -> ImageData:
    """The image of a stack on axes of the patient, resampled where its slices ask for it."""
    heights, normal = stack.heights, np.cross(*stack.axes)
    shifts = stack.positions - np.outer(heights, normal)
    along = (shifts - shifts[0]) @ stack.axes.T
    # Slices in one straight, even row, as far as positions are written exactly.
    straight = float(np.abs(along - along[0]).max()) <= ROUNDED
    findings += _tilt_findings(name, stack, along, straight=straight)
    if uneven:
        steps = np.diff(heights)
        what = (
            f"slices are {np.median(steps):.3g} mm apart, from {steps.min():.3g} to "
            f"{steps.max():.3g} mm: {_steps(stack, uneven)}; resampled by their positions"
        )
        findings.append(Finding("dicom-uneven", what, where=name))
    if straight and not uneven:
        gap = float(heights[-1] - heights[0]) / (len(heights) - 1)
        across = stack.axes.T * stack.spacing
        affine = np.column_stack([across, normal * gap, stack.positions[0]])
        image, more = on_axes(values.transpose(2, 1, 0), affine, name)
        findings += more
        return image
    gap = float(np.median(np.diff(heights)))
    if gap > COARSE_SLICES:
        what = f"slices are {gap:.3g} mm apart"
        findings.append(
            Finding("ct-spacing-coarse", what, where=name, facts={"most": COARSE_SLICES})
        )
    return of_slices(values, stack.positions, stack.axes, stack.spacing, name)


def _tilt_findings(
    name: str, stack: Stack, along: NDArray[np.float64], *, straight: bool
) -> list[Finding]:
    """Findings on slices that are shifted against one another, and on a tilt that is not there."""
    heights = stack.heights - stack.heights[0]
    gap = float(np.median(np.abs(np.diff(heights))))
    slope = along.T @ heights / float(heights @ heights)
    angle = math.degrees(math.atan(float(np.linalg.norm(slope))))
    stated = numbers_of(stack.slices[0].text("gantry_tilt") or "0", 1)
    tilt = 0.0 if stated is None else float(stated[0])
    off = float(np.linalg.norm(along - np.outer(heights, slope), axis=1).max())
    findings = []
    if not straight:
        signed = math.copysign(angle, tilt) if tilt else angle
        what = f"gantry tilt {signed:.1f}°".replace("-", "−")
        if off > max(ROUNDED, 0.01 * float(np.linalg.norm(along[-1]))):
            shift = np.ptp(along, axis=0).max()
            what = f"slices shifted against one another by up to {shift:.1f} mm"
        what += (
            ", resampled by the position of each slice "
            f"({np.linalg.norm(along[-1]):.1f} mm from first to last slice)"
        )
        why = (
            f"without resampling, the head would be sheared; between slices {gap:.1f} mm apart the "
            f"skin is known to {SKIN_SHARE * gap:.1f} mm; outside the slices there is air, so the "
            "neck may end on an oblique plane on which nothing is fixed"
        )
        fix = f"check the skin visually; {_whole_heights(stack)}"
        findings.append(Finding("dicom-tilted", what, where=name, why=why, fix=fix))
    if abs(abs(tilt) - angle) > TILTS_AGREE:
        what = (
            f"the header states a gantry tilt of {tilt:g}°, the positions of the slices one of "
            f"{angle:.1f}°; the positions were used"
        )
        findings.append(Finding("dicom-tilted", what, where=name))
    return findings


def _whole_heights(stack: Stack) -> str:
    """Between which heights every slice position was scanned, as the region of a case has them."""
    columns, rows = (int(stack.slices[0].text(k)) for k in ("columns", "rows"))
    across = np.array([0.0, (columns - 1) * stack.spacing[0] * stack.axes[0, 2]])
    down = np.array([0.0, (rows - 1) * stack.spacing[1] * stack.axes[1, 2]])
    corners = np.add.outer(across, down).ravel()
    first, last = stack.positions[0, 2] + corners, stack.positions[-1, 2] + corners
    low, high = (first, last) if first.mean() < last.mean() else (last, first)
    return (
        f"the head is scanned from front to back between z = {low.max():.1f} and "
        f"{high.min():.1f} mm: lower = {low.max():.1f} in [region] ends the tissue on a plane that "
        "fixes it, where the face allows that"
    )
