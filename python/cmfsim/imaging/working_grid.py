"""The grid that the segmentation works on: the head's part of the image, no finer than needed."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import ImageInputError
from cmfsim.imaging.intensities.intensity import (
    AIR,
    Calibration,
    calibration_within,
    check_is_ct,
    saturation_of,
)
from cmfsim.imaging.morphology import (
    Block,
    Mask,
    Volume,
    binned,
    label,
    opened,
    padding,
    resampled_to,
    shown_region,
)
from cmfsim.imaging.options import SegmentOptions
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.shown_region import ShownRegion

# Voxel size at which shapes as large as a couch are told apart, mm.
COARSE = 2.5
# A voxel this many times longer than the shortest is divided.
MOST_ANISOTROPIC = 1.5
# Left around the head, mm.
MARGIN = 10.0
# Smaller images hold no face, mm; fewer voxels hold no shape.
LEAST_EXTENT = 50.0
LEAST_VOXELS = 8
# Slices further apart than this lose thin bone, lips and lids, mm.
COARSE_SLICES = 2.5
# Air and foam lie below this, skin, couch and bone above, HU.
TISSUE = -300.0
# Voxel size on which a CT is told from an MR image, mm.
MODALITY_STEP = 2.0
# Values beyond these say nothing more on tissue, HU; scales of up to 30000 would make metal as wide
# as its blur.
LOWEST, HIGHEST = -1024.0, 4000.0
# Sheets and tubes thinner than twice this are no head, mm.
OPENING = 12.0


@dataclass(frozen=True, eq=False)
class Working:
    """HU on the working grid.

    hu: (nx, ny, nz) float32. Fortran order.
    spacing, origin: (3,), mm.
    border: (2, 3) bool. Whether the first and the last layer along each axis is the image's own
        border.
    native: (3,), mm. Voxel size of the image.
    saturation: HU. The value at which the image's brightest voxels were cut off; infinite where
        they were not.
    shown: mm. What padding surrounds; None where there is none.
    """

    hu: Volume
    spacing: NDArray[np.float64]
    origin: NDArray[np.float64]
    border: NDArray[np.bool_]
    native: NDArray[np.float64]
    saturation: float = np.inf
    shown: ShownRegion | None = None

    def part(self, box: Block) -> "Working":
        """A block of this grid."""
        starts = np.array([b.start for b in box])
        ends = np.array([b.stop == n for b, n in zip(box, self.hu.shape, strict=True)])
        return Working(
            np.asfortranarray(self.hu[box]),
            self.spacing,
            self.origin + self.spacing * starts,
            self.border & np.array([starts == 0, ends]),
            self.native,
            self.saturation,
            self.shown,
        )

    def image(self, values: NDArray[np.float32]) -> ImageData:
        """Values on this grid."""
        return ImageData(np.ascontiguousarray(values), self.spacing, self.origin)


def working_grid(image: ImageData, options: SegmentOptions) -> tuple[Working, tuple[Finding, ...]]:
    """The head's part of an image in HU, and what was found on the image.

    Errors
    ------
    ImageError
        (also `ValueError`) Too small, not finite, no CT, or no head in it.
    """
    spacing = image.spacing
    _check_size(image, spacing)
    shown = shown_region(image.values)
    scale = calibration_within(image.values, shown, options.rescale)
    findings = [*scale.findings, *_spacing_findings(spacing)]
    x, y, z = (max(1, int(options.working_spacing / s + 1e-6)) for s in spacing)
    factors = (x, y, z)
    values = image.values
    if values.dtype.kind == "b" or values.dtype == np.float16:
        values = values.astype(np.float32)
    values = _cut_off(values, scale)
    if shown is not None:
        air = values.dtype.type((AIR - scale.offset) / scale.slope)
        values = np.where(padding(image.values, shown), air, values)
    values, bins, shift = binned(values, factors, spacing)
    low, high = _head_box(values, bins, scale)
    border = np.array([low == 0, high == np.array(values.shape)])
    part = values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    hu = np.empty(part.shape, dtype=np.float32, order="F")
    np.multiply(part, np.float32(scale.slope), out=hu, casting="unsafe")
    hu += np.float32(scale.offset)
    with ThreadPoolExecutor(1) as beside:
        checked = None
        if options.rescale is None and not scale.has_air:
            checked = beside.submit(check_is_ct, *coarse_of(hu, bins, MODALITY_STEP)[:2])
        hu, target, more = _on_target(hu, bins, options)
        if checked is not None:
            checked.result()
    findings.extend(more)
    origin = image.origin + shift + low * bins
    saturation = saturation_of(image.values, float(np.prod(spacing)), scale)
    if shown is not None:
        shown = shown.scaled(spacing, image.origin)
    return Working(hu, target, origin, border, spacing, saturation, shown), tuple(findings)


def _on_target(
    hu: Volume, bins: NDArray[np.float64], options: SegmentOptions
) -> tuple[Volume, NDArray[np.float64], tuple[Finding, ...]]:
    """HU in the range that matters on voxels of the working size, and a finding if coarse."""
    findings: tuple[Finding, ...] = ()
    target = _target(bins, hu.shape, options)
    if not np.array_equal(target, bins):
        if (target > 1.01 * bins).any():
            findings = (_coarsened(target, options),)
        steps = np.floor((np.array(hu.shape) - 1) * bins / target + 1e-6)
        shape = tuple(int(n) + 1 for n in steps)
        hu = resampled_to(hu, bins, np.zeros(3), shape, target)
    np.clip(hu, LOWEST, HIGHEST, out=hu)
    return hu, target, findings


def coarse_of(
    hu: NDArray[Any], spacing: NDArray[np.float64], size: float = COARSE
) -> tuple[Volume, NDArray[np.float64], NDArray[np.float64]]:
    """HU in voxels of about `size` mm, their spacing and first centre, mm."""
    factors = tuple(max(1, round(size / s)) for s in spacing)
    coarse, steps, shift = binned(hu, factors, spacing)
    return coarse, steps, shift


def _check_size(image: ImageData, spacing: NDArray[np.float64]) -> None:
    shape = np.array(image.values.shape)
    extent = shape * spacing
    if (shape < LEAST_VOXELS).any() or (extent < LEAST_EXTENT).any():
        raise ImageInputError(
            f"image has {' × '.join(map(str, shape))} voxels over "
            f"{' × '.join(f'{e:.0f}' for e in extent)} mm: at least {LEAST_VOXELS} voxels and "
            f"{LEAST_EXTENT:g} mm along each axis are needed for a face"
        )
    if (extent > 2000.0).any() or (spacing > 10.0).any():
        raise ImageInputError(
            f"image has voxels of {spacing.tolist()} mm over {extent.round().tolist()} mm: no "
            "head is that large; check whether its spacing is in µm, or wrong"
        )
    if image.values.dtype.kind == "f":
        finite = np.isfinite(image.values)
        if not finite.all():
            bad = np.argwhere(~finite)[0]
            raise ImageInputError(
                f"image[{', '.join(map(str, bad))}] is {image.values[tuple(bad)]}: "
                f"{np.count_nonzero(~finite)} voxels are not finite"
            )


def _spacing_findings(spacing: NDArray[np.float64]) -> list[Finding]:
    if spacing.max() <= COARSE_SLICES:
        return []
    return [
        Finding(
            "ct-spacing-coarse",
            f"voxels are {' × '.join(f'{s:g}' for s in spacing)} mm",
            where="image",
            facts={"most": COARSE_SLICES},
        )
    ]


def _cut_off(values: NDArray[Any], scale: Calibration) -> NDArray[Any]:
    """Values that are no higher than the densest that matters."""
    top = (HIGHEST - scale.offset) / scale.slope
    if float(values.max()) <= top:
        return values
    found: NDArray[Any] = np.minimum(values, values.dtype.type(top))
    return found


def _target(
    bins: NDArray[np.float64], shape: tuple[int, ...], options: SegmentOptions
) -> NDArray[np.float64]:
    """The working voxel size: long voxels divided, all made larger where there are too many."""
    least = max(float(bins.min()), 0.6 * options.working_spacing)
    target = np.array(
        [b / np.round(b / least) if b > MOST_ANISOTROPIC * least else b for b in bins]
    )
    voxels = float(np.prod(np.array(shape) * bins / target))
    if voxels > options.most_voxels:
        grown = float(np.cbrt(voxels / options.most_voxels))
        target = np.maximum(target, float(np.prod(target)) ** (1 / 3) * grown)
    return target


def _coarsened(target: NDArray[np.float64], options: SegmentOptions) -> Finding:
    return Finding(
        "ct-coarsened",
        f"the head was resampled at {' × '.join(f'{t:.2f}' for t in target)} mm",
        where="image",
        facts={"most_voxels": options.most_voxels},
    )


def _head_box(
    values: NDArray[np.generic], spacing: NDArray[np.float64], scale: Calibration
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The first and past-the-last voxel of the head with a margin, along each axis."""
    coarse, steps, _ = coarse_of(values, spacing, 4.0)
    tissue: Mask = np.asfortranarray(coarse * scale.slope + scale.offset > TISSUE)
    core = opened(tissue, OPENING, steps)
    labels, sizes = label(core)
    if len(sizes) == 1:
        raise ImageInputError(
            f"the image contains nothing thicker than {2 * OPENING:g} mm above {TISSUE:g} HU: no "
            "head"
        )
    head = labels == np.argmax(sizes)
    # What the opening took (nose, ears, chin) lies within this of what it left.
    margin = 2.0 * OPENING + MARGIN
    low, high = np.zeros(3, dtype=np.intp), np.array(values.shape)
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        found = np.flatnonzero(head.any(axis=others)) * steps[axis]
        low[axis] = max(0, int((found[0] - margin) / spacing[axis]))
        high[axis] = min(
            values.shape[axis], int((found[-1] + steps[axis] + margin) / spacing[axis]) + 1
        )
    return low, high
