"""The lips: where they meet, and what of a mesh's boundary each of them is."""

from cmfsim.lips.regions import lip_regions, seam_faces
from cmfsim.lips.seam import LIP_LANDMARKS, LipSeam, lip_seam

__all__ = ["LIP_LANDMARKS", "LipSeam", "lip_regions", "lip_seam", "seam_faces"]
