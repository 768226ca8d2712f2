"""A head CT to anatomy: skin, bones, air and teeth as level images (paper 2.1)."""

from cmfsim.imaging.head import segment_head
from cmfsim.imaging.options import SegmentOptions

__all__ = ["SegmentOptions", "segment_head"]
