"""What of the head the image leaves out, and whether it shows it the right way round."""

import numpy as np

from cmfsim.case import Finding
from cmfsim.imaging.bone import Bone
from cmfsim.imaging.skin import Skin
from cmfsim.imaging.working import Working

__all__ = ["view_findings"]

# Skin or bone that meets a border of the image over less than this is not cut off, mm².
CUT_SKIN = 150.0
CUT_BONE = 60.0
# The face lies in front of the brain's middle and below it by more than this, mm.
LEAST_OFFSET = 8.0
# Bone of the face: within this in height below the cavity's lowest tenth, mm.
FACE_HEIGHT = 120.0
# From the lowest bone of the front to the skull's lowest cavity there are at least this many mm
# where the chin is in the image.
LEAST_FACE = 60.0


def view_findings(work: Working, skin: Skin, bone: Bone) -> tuple[Finding, ...]:
    """Findings on cut-off parts and on the head's direction."""
    wrong = _direction(work, bone)
    return (*wrong, *([] if wrong else _cut_off(work, skin, bone)))


def _direction(work: Working, bone: Bone) -> tuple[Finding, ...]:
    """An error where the face looks backwards or the head stands on its vertex.

    Left and right cannot be told apart in a head; nothing here finds a mirrored one.
    """
    if bone.cavity is None:
        return ()
    brain, extent = _middle(work, bone.cavity)
    # Bone of the vault surrounds the brain evenly; the face and the jaws are what lies beyond it.
    x, y, z = (
        o + s * np.arange(n)
        for o, s, n in zip(work.origin, work.spacing, bone.solid.shape, strict=True)
    )
    del x
    up = np.abs(z - brain[2])
    counts = bone.solid.sum(axis=0).astype(np.float64)
    beyond = up[None, :] > 0.8 * extent[2]
    above = counts[:, z > brain[2]][:, (up > 1.1 * extent[2])[z > brain[2]]].sum()
    below = counts[:, z < brain[2]][:, (up > 1.1 * extent[2])[z < brain[2]]].sum()
    findings = []
    if above > 2.0 * below:
        findings.append(_turned("upside-down", "the head stands on its vertex"))
    # Spine and face both lie beyond the cavity, the face farther from its middle and with more bone.
    away = y[:, None] - brain[1]
    beyond = beyond & (np.abs(away) > 0.35 * extent[1])
    front = float((counts * beyond * np.clip(-away, 0.0, None)).sum())
    back = float((counts * beyond * np.clip(away, 0.0, None)).sum())
    if back > 1.3 * front:
        findings.append(_turned("facing-back", "the face looks to the back (+y, posterior)"))
    return tuple(findings)


def _middle(work: Working, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Middle and half extent of a mask, mm."""
    low, high = [], []
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        found = np.flatnonzero(mask.any(axis=others))
        low.append(work.origin[axis] + work.spacing[axis] * found[0])
        high.append(work.origin[axis] + work.spacing[axis] * found[-1])
    return 0.5 * (np.array(low) + np.array(high)), 0.5 * (np.array(high) - np.array(low))


def _turned(code: str, what: str) -> Finding:
    return Finding(
        "error",
        f"ct-{code}",
        f"{what}: the image is flipped, or its header lies",
        where="image",
        why="front and back, or up and down, would be taken for one another; left and right may "
        "be swapped as well, which no image shows",
        mend="export the image again with its orientation, and check left and right",
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
        findings.append(_top(work, bone, top))
    chin = _chin_area(work, bone, skin)
    if work.border[0, 2] and chin > CUT_BONE:
        findings.append(
            _missing("bottom", "chin", f"bone of the jaw meets the border over {chin:.0f} mm²")
        )
    return findings


def _top(work: Working, bone: Bone, area: float) -> Finding:
    """The forehead is missing if the border cuts the skull below its widest layer."""
    per_layer = bone.mask.sum(axis=(0, 1))
    what = f"bone of the skull meets the border over {area:.0f} mm²"
    if per_layer[-1] > 0.75 * per_layer.max():
        return _missing("top", "forehead", what)
    return Finding(
        "note",
        "ct-cut-vertex",
        f"the vertex is cut off: {what}",
        where="top border of the image",
        why="the skull is closed flat there; the face is not concerned",
    )


def _chin_area(work: Working, bone: Bone, skin: Skin) -> float:
    """Bone at the bottom border in the front half of the head, mm²."""
    middle = int(np.average(np.arange(skin.mask.shape[1]), weights=skin.mask.sum(axis=(0, 2))))
    layer = bone.solid[:, : max(middle - int(25.0 / work.spacing[1]), 1), 0]
    return float(np.count_nonzero(layer) * work.spacing[0] * work.spacing[1])


def _missing(side: str, part: str, what: str) -> Finding:
    return Finding(
        "warning",
        f"ct-cut-{side}",
        f"{part} cut off: {what}",
        where=f"{side} border of the image",
        why="the surface is closed flat there, and the prediction near it means nothing",
        mend="use an image that holds the whole face, or leave that region out of the evaluation",
    )
