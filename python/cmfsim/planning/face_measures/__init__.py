"""Measures of a face that surgeons use: angles and distances between named sites."""

from cmfsim.planning.face_measures.cephalometry import (
    CEPHALOMETRIC_MEASURES as CEPHALOMETRIC_MEASURES,
)
