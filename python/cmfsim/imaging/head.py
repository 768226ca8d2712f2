"""The way from a CT to an anatomy, stage by stage."""

import logging
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.case import Anatomy, Finding, ImageData
from cmfsim.imaging.bone import bone_level, find_bone
from cmfsim.imaging.intensity import noise_of, weak_bone
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

    say("grid")
    work, findings = working_grid(image, options)
    all_findings: list[Finding] = list(findings)
    say("skin")
    skin = find_skin(work, options)
    all_findings += skin.findings
    say("bone")
    bone = find_bone(work, work.hu, skin, options)
    all_findings += bone.findings
    bones = {"skull": work.image(bone_level(bone, options))}
    return Anatomy(work.image(skin.level), bones, findings=tuple(all_findings))
