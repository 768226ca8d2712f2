"""Writes the built-in template from the phantom head: make_default_template.py [FILE].

Run it after a change of the phantom's muscles, skull or landmarks; a test detects this. It takes
about a minute and needs the extra `imaging`.
"""

import sys
from pathlib import Path

import numpy as np

from cmfsim.io.cases.template_archives import mirrored_muscle
from cmfsim.muscles.template.checking import template_path
from cmfsim.muscles.template.muscle_template import MuscleTemplate
from cmfsim.phantom.model import PhantomHead, make_head
from cmfsim.phantom.muscles import Muscle
from cmfsim.surfaces.repair import RepairOptions, repair_surface
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKULL_LANDMARKS
from cmfsim.values.musculature import MuscleSurface
from cmfsim.values.surface_data import SurfaceData, joined_surface

# Edges of the marching cubes, mm: muscles are as thin as 2 mm, the skull is there to be looked at
# and to measure distances from.
MUSCLE_SPACING = 1.0
SKULL_SPACING = (("cranium", 2.5), ("mandible", 2.0), ("teeth", 1.5))
# Coordinates are rounded to this, mm, a hundredth of the marching cubes: single precision keeps
# them exactly, and they pack into half the bytes.
GRAIN = 1.0 / 128.0


def phantom_template() -> MuscleTemplate:
    """The muscles, skull and landmarks of the ordinary phantom head, with known fibre lines.

    The head is symmetric: the right muscles are the exact mirror images of the left ones.
    """
    head = make_head()
    made: dict[str, MuscleSurface] = {}
    for muscle in head.muscles.values():
        print(muscle.name)
        made[muscle.name] = (
            mirrored_muscle(made[f"{muscle.name[:-1]}L"], muscle.name, "R")
            if muscle.side == "R"
            else phantom_muscle(head, muscle)
        )
    points = head.skull_landmarks
    return MuscleTemplate(
        name="default",
        muscles=tuple(made.values()),
        skull=joined_surface([_surface(head, part, spacing) for part, spacing in SKULL_SPACING]),
        landmarks={site: points[site] for site in SKULL_LANDMARKS},
        definitions=SKULL_LANDMARKS,
        licence="MIT OR Apache-2.0",
        attribution="The cmfsim maintainers",
        source="cmfsim.phantom: a synthetic head, no image of a person",
    )


def phantom_muscle(head: PhantomHead, muscle: Muscle) -> MuscleSurface:
    """One muscle of a phantom head: its closed surface and its fibre lines."""
    surface = _surface(head, muscle.name, MUSCLE_SPACING)
    course = tuple(_rounded(line) for line in muscle.course)
    return MuscleSurface(muscle.name, muscle.side, surface, muscle.kind, None, course)


def _surface(head: PhantomHead, part: str, spacing: float) -> SurfaceData:
    """The closed surface of a part in rounded coordinates, without what the grid broke off."""
    drawn = head.surface(part, spacing)
    rounded = SurfaceData(_rounded(drawn.vertices), drawn.triangles)
    return repair_surface(rounded, part, RepairOptions())[0]


def _rounded(points: Floats) -> Floats:
    # Adding zero turns −0 into 0, so that a mirrored midline is the same bits.
    return GRAIN * np.round(points / GRAIN) + 0.0


def main(path: Path) -> int:
    """Makes the template, writes it, and says how large it is."""
    template = phantom_template()
    template.save(path)
    print(f"wrote {path}: {len(template.muscles)} muscles, {path.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else template_path("default")))
