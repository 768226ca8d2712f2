"""A head CT to anatomy (paper 2.1), and two scans of one head laid on each other (paper 3)."""

from cmfsim.imaging.alignment import (
    AlignmentOptions,
    VolumeAlignment,
    register_volumes,
    undeformed_mask,
)
from cmfsim.imaging.head import segment_head
from cmfsim.imaging.options import SegmentOptions

__all__ = [
    "AlignmentOptions",
    "SegmentOptions",
    "VolumeAlignment",
    "register_volumes",
    "segment_head",
    "undeformed_mask",
]
