"""Checks of whether the image shows the whole head, and with the right orientation."""

import numpy as np

from cmfsim.imaging.bones.bone import Bone
from cmfsim.imaging.morphology import depth
from cmfsim.imaging.skins.skin import Skin
from cmfsim.imaging.working_grid import COARSE, Working
from cmfsim.values.finding import Finding

# Skin or bone that meets a border of the image over less than this is not cut off, mm².
CUT_SKIN = 150.0
CUT_BONE = 60.0
# Width of the ring inside the border of a round field of view that is searched for tissue, mm.
FIELD_RING = 3.0
# Face, jaws and spine lie farther than this from the brain's cavity, the vault does not, mm.
VAULT = 15.0
# The middle of face, jaws and spine lies some 40 mm in front of the brain's and 80 mm below it: it
# may not lie behind it or above it by more than this, mm.
LEAST_OFFSET = 5.0


def view_findings(work: Working, skin: Skin, bone: Bone) -> tuple[Finding, ...]:
    """Findings on cut-off parts and on the head's direction."""
    wrong = _direction(work, bone)
    return (*wrong, *([] if wrong else [*_cut_off(work, skin, bone), *_round(work, skin)]))


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


def _round(work: Working, skin: Skin) -> list[Finding]:
    """A finding where a round field of view ends inside the head."""
    if work.field is None:
        return []
    axes = (
        o + s * np.arange(n)
        for o, s, n in zip(work.origin, work.spacing, skin.mask.shape, strict=True)
    )
    x, y = (a - m for a, m in zip(axes, work.field.middle, strict=False))
    away = np.hypot(x[:, None] / work.field.radii[0], y[None] / work.field.radii[1])
    # The share of the ring just inside the field that is head.
    inward = (1.0 - away) * float(work.field.radii.min())
    ring = (inward > 0.0) & (inward < FIELD_RING)
    area = float(np.count_nonzero(skin.mask[ring])) * float(np.prod(work.spacing)) / FIELD_RING
    if area < CUT_SKIN:
        return []
    return [
        Finding(
            "ct-cut-off",
            f"the head extends beyond the round field of view, {2.0 * work.field.radii.min():.0f} "
            f"mm across: skin or tissue meets its border over {area / 100.0:.0f} cm²",
            severity="warning",
            where="border of the field of view",
            why="the surface is closed there, and values near the border are too high",
            fix="plan and evaluate only well inside the field, or use a scan of the whole head",
        )
    ]


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
