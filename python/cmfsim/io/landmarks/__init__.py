"""Landmarks and curves, in the markups of 3D Slicer and in plain tables."""

from cmfsim.io.landmarks.landmark_files import (
    LandmarkFile,
    read_landmark_file,
    read_landmarks,
    write_landmarks,
)

__all__ = ["LandmarkFile", "read_landmark_file", "read_landmarks", "write_landmarks"]
