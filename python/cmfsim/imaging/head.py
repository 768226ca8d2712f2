"""The way from a CT to an anatomy, stage by stage."""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import ImageInputError
from cmfsim.imaging.bones.bone import Bone, bone_level, find_bone, teeth_level
from cmfsim.imaging.bones.jaw import Jaws, part_jaws
from cmfsim.imaging.bones.metal import find_metal, metal_within
from cmfsim.imaging.coverage import view_findings
from cmfsim.imaging.intensities.cupping import without_cupping, without_noise
from cmfsim.imaging.intensities.intensity import weak_bone
from cmfsim.imaging.morphology import Mask, Volume
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.skins.air import air_level
from cmfsim.imaging.skins.attached import attached_findings
from cmfsim.imaging.skins.skin import Skin, find_skin
from cmfsim.imaging.working_grid import Working, working_grid
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats, as_point
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.progress import Progress

_LOG = logging.getLogger(__name__)

# Number of things found in parallel with others.
THREADS = 2
# A child's face in a narrow image is larger than this, cm³.
LEAST_HEAD = 250.0


def segment_head(
    image: ImageData,
    options: SegmentOptions | None = None,
    *,
    landmarks: Mapping[str, ArrayLike] | None = None,
    progress: Progress | None = None,
) -> Anatomy:
    """Skin, bones, air and teeth of a head CT, as level images on one grid, with findings.

    Parameters
    ----------
    image : ImageData
        A CT in LPS, in HU or in a scale that its histogram reveals (reported as a finding).
    options : SegmentOptions, optional
    landmarks : mapping of str to (3,) float64, mm, optional
        Of the skull, LPS. They separate the mandible from the rest; without them, its shape does.
    progress : callable, optional
        Called with the name of each stage: "grid", "metal", "skin", "bone", "jaw", "air".

    Returns
    -------
    Anatomy
        On the part of the grid that holds the head, with bones "cranium" (with the cervical spine)
        and "mandible", or "skull".

    Raises
    ------
    ImageError
        (also `ValueError`) Too small, not finite, no CT, no head, no bone.

    Examples
    --------
    >>> import cmfsim
    >>> image = cmfsim.read_image("ct.nii.gz")  # doctest: +SKIP
    >>> anatomy = cmfsim.segment_head(image)  # doctest: +SKIP
    >>> sorted(anatomy.bones)  # doctest: +SKIP
    ['cranium', 'mandible']
    """
    options = SegmentOptions() if options is None else options

    def say(stage: str) -> None:
        _LOG.info("imaging: %s", stage)
        if progress is not None:
            progress(stage)

    points = None if landmarks is None else _checked(landmarks)
    say("grid")
    work, findings = working_grid(image, options)
    hu, cupping = without_cupping(work)
    work = replace(work, hu=hu)
    all_findings: list[Finding] = [*findings, *cupping]
    say("metal")
    metal = find_metal(work, options)
    with ThreadPoolExecutor(THREADS) as beside:
        say("skin")
        skin = find_skin(work, metal, options, beside)
        _check_head(work, skin.mask)
        say("bone")
        # The couch and the air around the head need no more work, here or later.
        work, metal = work.part(skin.box), metal_within(metal, skin.box)
        smooth, noisy = without_noise(metal.hu)
        metal = replace(metal, hu=smooth)
        bone = find_bone(work, metal, skin, options)
        # Where the bone is and which of it is the jaw are found without each other.
        level = beside.submit(bone_level, bone, options)
        noticed = beside.submit(_noticed, work, skin, bone, options)
        bones, teeth, jaws = _bones(work, bone, skin, points, level, options=options, say=say)
        say("air")
        hollow = air_level(work, skin, bone, options)
        all_findings += [
            *noisy,
            *noticed.result()[0],
            *metal.findings,
            *skin.findings,
            *bone.findings,
            *noticed.result()[1],
            *jaws,
        ]
    air = None if hollow is None else work.image(hollow)
    return Anatomy(work.image(skin.level), bones, air, teeth, tuple(all_findings))


def _noticed(
    work: Working, skin: Skin, bone: Bone, options: SegmentOptions
) -> tuple[Sequence[Finding], Sequence[Finding]]:
    """What is noticed on the scan's values, and on what it shows of the head."""
    values = weak_bone(work.hu[skin.mask], options.least_bone)
    return values, [*view_findings(work, skin, bone), *attached_findings(work, skin, bone)]


def _bones(
    work: Working,
    bone: Bone,
    skin: Skin,
    points: Mapping[str, Floats] | None,
    bone_values: "Future[Volume]",
    *,
    options: SegmentOptions,
    say: Progress,
) -> tuple[dict[str, ImageData], ImageData | None, Sequence[Finding]]:
    """The levels of bones and teeth, and the findings on how the jaws were separated."""
    if options.part_jaws:
        say("jaw")
        jaws = part_jaws(work, bone, skin, points)
    else:
        jaws = Jaws(None, None, None, ())
    # A smoothed rim may not carry bone past the skin.
    level = np.minimum(bone_values.result(), skin.level)
    parts = {"skull": level}
    if jaws.side is not None:
        parts = {"cranium": np.minimum(level, -jaws.side), "mandible": np.minimum(level, jaws.side)}
    with ThreadPoolExecutor(THREADS) as pool:
        bones = dict(zip(parts, pool.map(work.image, parts.values()), strict=True))
    dense = teeth_level(bone, work, jaws.occlusal_height)
    return bones, None if dense is None else work.image(dense), jaws.findings


def _check_head(work: Working, inside: Mask) -> None:
    """Refuses a part that is too small to be a head."""
    volume = np.count_nonzero(inside) * float(np.prod(work.spacing)) / 1000.0
    if volume < LEAST_HEAD:
        raise ImageInputError(
            f"the largest object in the image that could be a head has {volume:.0f} cm³: a face "
            f"has at least {LEAST_HEAD:g}; check whether the head is cut off or hollow (a "
            "phantom), and whether the scale is right"
        )


def _checked(landmarks: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    return {name: as_point(f"landmark {name!r}", place) for name, place in landmarks.items()}
