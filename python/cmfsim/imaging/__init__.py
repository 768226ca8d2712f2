"""A head CT to anatomy (paper 2.1), and registration of two scans of one head (paper 3)."""

from cmfsim.imaging.head import segment_head as segment_head
from cmfsim.imaging.options import SegmentOptions as SegmentOptions
from cmfsim.imaging.two_scans.alignment import AlignmentOptions as AlignmentOptions
from cmfsim.imaging.two_scans.alignment import VolumeAlignment as VolumeAlignment
from cmfsim.imaging.two_scans.alignment import register_volumes as register_volumes
from cmfsim.imaging.two_scans.undeformed import undeformed_mask as undeformed_mask
