"""The way from a CT to an anatomy, stage by stage."""

import logging
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.checks import Floats, as_rows
from cmfsim.case import Anatomy, Finding, ImageData
from cmfsim.imaging.bone import bone_level, find_bone
from cmfsim.imaging.intensity import noise_of, weak_bone
from cmfsim.imaging.jaw import part_jaws
from cmfsim.imaging.morphology import smoothed
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.skin import find_skin
from cmfsim.imaging.working import working_grid

__all__ = ["segment_head"]

_LOG = logging.getLogger(__name__)


def segment_head(
    image: ImageData,
    options: SegmentOptions | None = None,
    *,
    landmarks: Mapping[str, ArrayLike] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Anatomy:
    """Skin, bones, air and teeth of a head CT."""
    options = SegmentOptions() if options is None else options

    def say(stage: str) -> None:
        _LOG.info("imaging: %s", stage)
        if progress is not None:
            progress(stage)

    points = None if landmarks is None else _checked(landmarks)
    say("grid")
    work, findings = working_grid(image, options)
    all_findings: list[Finding] = list(findings)
    say("skin")
    skin = find_skin(work, options)
    all_findings += skin.findings
    say("bone")
    bone = find_bone(work, work.hu, skin, options)
    all_findings += bone.findings
    level = bone_level(bone, options)
    bones = {"skull": work.image(level)}
    if options.part_jaws:
        say("jaw")
        jaws = part_jaws(work, bone, points)
        all_findings += jaws.findings
        if jaws.side is not None:
            bones = {
                "cranium": work.image(np.minimum(level, -jaws.side)),
                "mandible": work.image(np.minimum(level, jaws.side)),
            }
    return Anatomy(work.image(skin.level), bones, findings=tuple(all_findings))


def _checked(landmarks: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    return {
        name: as_rows(f"landmark {name!r}", np.reshape(np.asarray(place), (1, -1)), 3)[0]
        for name, place in landmarks.items()
    }
