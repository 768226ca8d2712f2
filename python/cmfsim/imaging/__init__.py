"""A head CT to anatomy (paper 2.1), and registration of two scans of one head (paper 3)."""

from cmfsim.imaging.head import segment_head
from cmfsim.imaging.options import SegmentOptions
from cmfsim.imaging.two_scans.alignment import AlignmentOptions, VolumeAlignment, register_volumes
from cmfsim.imaging.two_scans.undeformed import undeformed_mask

__all__ = [
    "AlignmentOptions",
    "SegmentOptions",
    "VolumeAlignment",
    "register_volumes",
    "segment_head",
    "undeformed_mask",
]
