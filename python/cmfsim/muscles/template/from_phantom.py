"""A template made from a phantom head: muscles whose fibres are known, on a skull made by code."""

import numpy as np

from cmfsim.io.cases.template_archives import mirrored_muscle
from cmfsim.muscles.template.muscle_template import MuscleTemplate
from cmfsim.phantom import Muscle, PhantomHead, make_head
from cmfsim.surfaces.repair import RepairOptions, repair_surface
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKULL_LANDMARKS
from cmfsim.values.musculature import MuscleSurface
from cmfsim.values.progress import Progress, no_progress
from cmfsim.values.surface_data import SurfaceData, joined_surface

# Edges of the marching cubes, mm: muscles are as thin as 2 mm, the skull is there to be looked at
# and to measure distances from.
MUSCLE_SPACING = 1.0
SKULL_SPACING = (("cranium", 2.5), ("mandible", 2.0), ("teeth", 1.5))
# Coordinates are rounded to this, mm, a hundredth of the marching cubes: single precision keeps
# them exactly, and they pack into half the bytes.
GRAIN = 1.0 / 128.0


def phantom_template(
    head: PhantomHead | None = None, *, name: str = "phantom", progress: Progress | None = None
) -> MuscleTemplate:
    """The muscles, skull and landmarks of a phantom head as a template, with known fibre lines.

    It takes about a minute. In a symmetric head the right muscles are the exact mirror images of
    the left ones.

    head: Default: the ordinary head.
    progress: Is told what is made.
    Raises `ImportError`: scikit-image is not installed.

    Examples
    --------
    >>> from cmfsim.muscles.template import phantom_template
    >>> template = phantom_template()  # doctest: +SKIP
    """
    head = make_head() if head is None else head
    say = progress or no_progress
    symmetric = head.parameters.asymmetry == 0.0
    made: dict[str, MuscleSurface] = {}
    for muscle in head.muscles.values():
        say(muscle.name)
        other = made.get(f"{muscle.name[:-1]}L") if muscle.side == "R" and symmetric else None
        made[muscle.name] = (
            phantom_muscle(head, muscle)
            if other is None
            else mirrored_muscle(other, muscle.name, "R")
        )
    say("skull")
    points = head.skull_landmarks
    return MuscleTemplate(
        name=name,
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
