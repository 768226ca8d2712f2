"""The way from a CT to an anatomy, stage by stage, and whether the CT shows the whole head."""

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import ImageInputError
from cmfsim.imaging.bones.bone import Bone, bone_level, find_bone, teeth_level
from cmfsim.imaging.bones.jaw import Jaws, part_jaws
from cmfsim.imaging.bones.metal import cropped, find_metal
from cmfsim.imaging.intensities.cupping import without_cupping, without_noise
from cmfsim.imaging.intensities.intensity import weak_bone
from cmfsim.imaging.intensities.levels import level_of
from cmfsim.imaging.morphology import Mask, Volume, depth, label, load
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.skins.attached import Attached, find_attached
from cmfsim.imaging.skins.skin import SKIN_SCALE, Skin, find_skin
from cmfsim.imaging.working_grid import COARSE, Working, working_grid
from cmfsim.registration.proposed.shape_model.model import head_model
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats, as_point
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.progress import Progress

# Skin or bone that meets a border of the image over less than this is not cut off, mm².
CUT_SKIN = 150.0
CUT_BONE = 60.0
# Width of the layer inside the border of the field of view that is searched for tissue, mm, and the
# cosine beyond which such a border lies above, below or behind the head.
FIELD_RING, STEEP = 3.0, 0.7
# Face, jaws and spine lie farther than this from the brain's cavity, the vault does not, mm.
VAULT = 15.0
# The middle of face, jaws and spine lies some 40 mm in front of the brain's and 80 mm below it: it
# may not lie behind it or above it by more than this, mm.
LEAST_OFFSET = 5.0

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
    >>> image = cmfsim.read_image("ct.nii.gz")
    >>> anatomy = cmfsim.segment_head(image)
    >>> sorted(anatomy.bones)
    ['cranium', 'mandible']
    """
    return segmented(image, options, landmarks=landmarks, progress=progress)[0]


@dataclass(frozen=True, eq=False)
class OpenHead:
    """A head before its jaws are separated: nothing of it depends on landmarks.

    noticed: Findings before and after those on the scan's values.
    """

    work: Working
    skin: Skin
    bone: Bone
    noticed: tuple[Sequence[Finding], Sequence[Finding]]


def segmented(
    head: ImageData | OpenHead,
    options: SegmentOptions | None = None,
    *,
    landmarks: Mapping[str, ArrayLike] | None = None,
    progress: Progress | None = None,
    on_skin: Callable[[ImageData], object] | None = None,
) -> tuple[Anatomy, OpenHead]:
    """What `segment_head` gives, and the head from which it is segmented with other landmarks.

    on_skin: Called with the level of the skin while the jaws are separated, in another thread.
    """
    options = SegmentOptions() if options is None else options

    def say(stage: str) -> None:
        _LOG.info("imaging: %s", stage)
        if progress is not None:
            progress(stage)

    points = None if landmarks is None else _checked(landmarks)
    with ThreadPoolExecutor(THREADS) as beside:
        # Libraries, while the image is resampled.
        beside.submit(load)
        # What separates the jaws of a head without landmarks depends on nothing of the image.
        is_guessed = points is None and options.part_jaws
        modelled = beside.submit(head_model) if is_guessed else None
        if not isinstance(head, OpenHead):
            head = _opened(head, options, beside, say)
        work, skin, bone = head.work, head.skin, head.bone
        # Where the bone is and which of it is the jaw are found without each other.
        level = beside.submit(bone_level, bone, options)
        noticed = beside.submit(_noticed, work, skin, bone, options)
        skinned = beside.submit(_skin_image, work, skin, on_skin)
        if modelled is not None:
            modelled.result()
        bones, teeth, jaws = _bones(work, bone, skin, points, level, options=options, say=say)
        say("air")
        hollow = air_level(work, skin, bone, options)
        (first, second), (weak, seen, attached) = head.noticed, noticed.result()
        things = [thing.finding for thing in attached]
        findings = (*first, *weak, *second, *seen, *things, *jaws)
    air = None if hollow is None else work.image(hollow)
    levels = skinned.result(), bones, air, teeth
    boxes = tuple(thing.box for thing in attached)
    vessels = np.zeros((0, 3))
    if bone.vessels is not None:
        # Every second voxel shows where they lie.
        vessels = work.origin + 2.0 * work.spacing * np.argwhere(bone.vessels[::2, ::2, ::2])
    return Anatomy(*levels, findings, shown=work.shown, attached=boxes, vessels=vessels), head


def _opened(
    image: ImageData, options: SegmentOptions, beside: ThreadPoolExecutor, say: Progress
) -> OpenHead:
    """Skin and bone of a head, and what was noticed on the way."""
    say("grid")
    work, findings = working_grid(image, options)
    hu, cupping = without_cupping(work)
    work = replace(work, hu=hu)
    say("metal")
    metal = find_metal(work, options)
    say("skin")
    skin = find_skin(work, metal, options, beside)
    _check_head(work, skin.mask)
    say("bone")
    # The couch and the air around the head need no more work, here or later.
    work, metal = cropped(work, metal, skin.box)
    smooth, noisy = without_noise(metal.hu)
    metal = replace(metal, hu=smooth)
    bone = find_bone(work, metal, skin, options)
    second = (*metal.findings, *skin.findings, *bone.findings)
    return OpenHead(work, skin, bone, ((*findings, *cupping, *noisy), second))


def _skin_image(work: Working, skin: Skin, then: Callable[[ImageData], object] | None) -> ImageData:
    image = work.image(skin.level)
    if then is not None:
        then(image)
    return image


def _noticed(
    work: Working, skin: Skin, bone: Bone, options: SegmentOptions
) -> tuple[Sequence[Finding], Sequence[Finding], Sequence[Attached]]:
    """What is noticed on the scan's values, on what it shows of the head, and on the face."""
    values = weak_bone(work.hu[skin.mask], options.least_bone)
    attached = find_attached(work, skin, bone, options.skin_threshold)
    return values, view_findings(work, skin, bone), attached


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


def view_findings(work: Working, skin: Skin, bone: Bone) -> tuple[Finding, ...]:
    """Findings on cut-off parts and on the head's direction."""
    wrong = _direction(work, bone)
    return (*wrong, *([] if wrong else [*_cut_off(work, skin, bone), *_beyond(work, skin, bone)]))


def _direction(work: Working, bone: Bone) -> tuple[Finding, ...]:
    """An error where the face looks backwards or the head is upside down.

    Left and right cannot be told apart in a head; nothing here finds a mirrored one.
    """
    if bone.cavity is None:
        return ()
    steps = tuple(max(1, int(COARSE / h)) for h in work.spacing)
    blocks = tuple(slice(None, None, n) for n in steps)
    spacing = work.spacing * np.array(steps)
    cavity = np.asfortranarray(bone.cavity[blocks])
    beyond = bone.solid[blocks] & (depth(cavity, spacing, VAULT) < -VAULT)
    if not beyond.any():
        return ()
    away = (np.argwhere(beyond).mean(axis=0) - np.argwhere(cavity).mean(axis=0)) * spacing
    findings = []
    if away[2] > LEAST_OFFSET:
        findings.append(_turned("the head is upside down"))
    if away[1] > LEAST_OFFSET:
        findings.append(_turned("the face points backwards (+y, posterior)"))
    return tuple(findings)


def _turned(what: str) -> Finding:
    return Finding(
        "ct-flipped", f"{what}: the image is flipped, or its header is wrong", where="image"
    )


def _cut_off(work: Working, skin: Skin, bone: Bone) -> list[Finding]:
    """A finding for each part of the face that the image's border cuts."""
    findings = []
    x, y, z = work.spacing
    front = float(np.count_nonzero(skin.mask[:, 0]) * x * z)
    if work.border[0, 1] and front > CUT_SKIN:
        findings.append(
            _missing("front", "nose or face", f"skin meets the front border over {front:.0f} mm²")
        )
    for side, layer, begin in (("right", 0, 0), ("left", -1, 1)):
        area = float(np.count_nonzero(skin.mask[layer]) * y * z)
        if work.border[begin, 0] and area > CUT_SKIN:
            findings.append(
                _missing(side, f"{side} side", f"skin meets the border over {area:.0f} mm²")
            )
    top = float(np.count_nonzero(bone.solid[:, :, -1]) * x * y)
    if work.border[1, 2] and top > CUT_BONE:
        findings.append(_top(bone, top))
    chin = _chin_area(work, bone, skin)
    if work.border[0, 2] and chin > CUT_BONE:
        findings.append(
            _missing("bottom", "chin", f"bone of the jaw meets the border over {chin:.0f} mm²")
        )
    return findings


def _beyond(work: Working, skin: Skin, bone: Bone) -> list[Finding]:
    """Findings where padding begins inside the head: in front or at the sides, above or below."""
    if work.shown is None:
        return []
    inside = np.argwhere(skin.mask)
    within, plane = work.shown.nearest(work.origin + work.spacing * inside)
    at_end = within < FIELD_RING
    inside, normals = inside[at_end], work.shown.normals[plane[at_end]]
    is_bone = bone.solid[tuple(inside.T)]
    middle = np.average(np.arange(skin.mask.shape[1]), weights=skin.mask.sum(axis=(0, 2)))
    in_front = inside[:, 1] < middle - 25.0 / work.spacing[1]
    below, above = normals[:, 2] < -STEEP, normals[:, 2] > STEEP
    beside = ~below & ~above & (normals[:, 1] < STEEP)

    def area(found: Mask) -> float:
        return float(np.count_nonzero(found) * np.prod(work.spacing)) / FIELD_RING

    findings = []
    if (meeting := area(beside)) > CUT_SKIN:
        what = f"skin or tissue meets its border over {meeting / 100.0:.0f} cm²"
        findings.append(_padded(f"the head extends beyond the field of view: {what}"))
    if (meeting := area(below & is_bone & in_front)) > CUT_BONE:
        findings.append(_padded(f"chin cut off: bone of the jaw meets it over {meeting:.0f} mm²"))
    if (meeting := area(above & is_bone)) > CUT_BONE:
        findings.append(_top(bone, meeting))
    return findings


def _padded(what: str) -> Finding:
    return Finding(
        "ct-cut-off",
        what,
        severity="warning",
        where="border of the field of view",
        why="the surface is closed there, and values near the border are too high",
        fix="plan and evaluate only well inside the field, or use a scan of the whole head",
    )


def _top(bone: Bone, area: float) -> Finding:
    """The forehead is missing if the border cuts the skull below its widest layer.

    It is as well where the image shows too little of the vault for the brain's room to be found.
    """
    per_layer = bone.mask.sum(axis=(0, 1))
    what = f"bone of the skull meets the border over {area:.0f} mm²"
    if bone.cavity is None or per_layer[-1] > 0.75 * per_layer.max():
        return _missing("top", "forehead", what)
    return Finding(
        "ct-cut-off",
        f"the vertex is cut off: {what}",
        severity="note",
        where="top border of the image",
        why="the skull is closed by a flat surface there; the face is not affected",
        fix="nothing to do",
    )


def _chin_area(work: Working, bone: Bone, skin: Skin) -> float:
    """Bone at the bottom border in the front half of the head, mm²."""
    middle = int(np.average(np.arange(skin.mask.shape[1]), weights=skin.mask.sum(axis=(0, 2))))
    layer = bone.solid[:, : max(middle - int(25.0 / work.spacing[1]), 1), 0]
    return float(np.count_nonzero(layer) * work.spacing[0] * work.spacing[1])


def _missing(border: str, part: str, what: str) -> Finding:
    return Finding(
        "ct-cut-off",
        f"{part} cut off: {what}",
        severity="warning",
        where=f"{border} border of the image",
    )


# Smaller bubbles are part of the tissue, mm³.
LEAST_AIR = 200.0


def air_level(work: Working, skin: Skin, bone: Bone, options: SegmentOptions) -> Volume | None:
    """The level of hollows that no bone encloses; None if there are none."""
    labels, sizes = label(skin.hollow & ~bone.mask)
    large = sizes * float(np.prod(work.spacing)) > LEAST_AIR
    if not large.any():
        return None
    return level_of(-work.hu, -options.skin_threshold, SKIN_SCALE, large[labels])
