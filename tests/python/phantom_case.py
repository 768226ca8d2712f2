"""The phantom head as a case on disk, as a CT or as surfaces: coarse, and known exactly."""

from pathlib import Path

import numpy as np
from skimage import measure

import cmfsim

HEAD = """format = "cmfsim-case"
version = 1
name = "phantom"
"""
IMAGE = """
[image]
file = "ct.nrrd"
working_spacing = 2.0
"""
SURFACES = """
[surfaces]
skin = "skin.ply"

[surfaces.bones]
cranium = "cranium.ply"
mandible = "mandible.ply"
"""
REST = """
[landmarks]
skull = "skull.mrk.json"
skin = "skin.mrk.json"

[mesh]
edge_length = 7.0

[[osteotomies]]
procedure = "le_fort_1"

[[osteotomies]]
procedure = "bsso"

[plan.maxilla]
translation = [0, -4, 0]

[plan.mandible_body]
translation = [0, 3, 0]
"""


def write_case(folder: Path, text: str) -> Path:
    """The path of a case file of the text given, in a folder that has the rest."""
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return path


def write_landmarks(folder: Path, head) -> None:
    """The landmarks of the head, as Slicer writes them."""
    cmfsim.write_landmarks(folder / "skull.mrk.json", head.skull_landmarks)
    cmfsim.write_landmarks(folder / "skin.mrk.json", head.skin_landmarks)


def ct_case(folder: Path, head, spacing: float = 2.5) -> Path:
    """The case of a CT of the head."""
    cmfsim.write_image(head.ct(spacing), folder / "ct.nrrd")
    write_landmarks(folder, head)
    return write_case(folder, HEAD + IMAGE + REST)


def surface_case(folder: Path, head, anatomy: cmfsim.Anatomy) -> Path:
    """The case of surfaces of the head; each bone holds its teeth."""
    for name, level in {"skin": anatomy.skin, **anatomy.bones}.items():
        cmfsim.write_surface(folder / f"{name}.ply", zero_surface(level))
    write_landmarks(folder, head)
    return write_case(folder, HEAD + SURFACES + REST)


def zero_surface(level) -> cmfsim.SurfaceData:
    """The closed surface on which a level is zero, outward."""
    values = np.pad(level.values, 1, constant_values=-1.0)
    spacing = np.asarray(level.spacing)
    vertices, triangles, _, _ = measure.marching_cubes(
        values, 0.0, spacing=tuple(spacing), gradient_direction="ascent"
    )
    return cmfsim.SurfaceData(vertices + level.lowest - spacing, triangles)
