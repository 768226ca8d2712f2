"""The lips: the seam between them, and the part of a mesh's boundary that belongs to each."""

from cmfsim.meshing.lips.seam import LipSeam, lip_regions, lip_seam, seam_faces

__all__ = ["LipSeam", "lip_regions", "lip_seam", "seam_faces"]
