"""Fibre lines of the atlas's flat muscles, whose outline does not determine them.

Origins and insertions are those of anatomy textbooks: temporalis converges on the coronoid process,
buccinator runs forwards to the corner of the mouth, platysma up from the clavicle to the jaw,
frontalis down from the vertex to the brow. Frame LPS.
"""

import numpy as np

from cmfsim.muscles.template.fibre_lines import fan_lines, lane_lines
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# Vertices that the tip of temporalis is the mean of; its tendon ends broadly.
TIP_VERTICES = 20
# Share of buccinator's vertices that its hind and its front end are the means of.
END_SHARE = 0.1
SAGITTAL = (1.0, 0.0, 0.0)
# Directions that platysma and frontalis face, on the left.
PLATYSMA_FACES, FRONTALIS_FACES = (0.7, -0.7, 0.0), (0.3, -1.0, 0.0)
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)


def atlas_course(name: str, side: str, surface: SurfaceData) -> tuple[Floats, ...]:
    """The fibre lines of a muscle of the atlas, from origin to insertion; none where boxes do.

    Parameters
    ----------
    name : str
        Without side.
    side : str
        "L" or "R".
    surface : SurfaceData

    Returns
    -------
    tuple of (n, 3) float64, mm
    """
    vertices = surface.vertices
    mirror = np.array([-1.0 if side == "R" else 1.0, 1.0, 1.0])
    if name == "temporalis":
        tip = vertices[np.argsort(vertices[:, 2])[:TIP_VERTICES]].mean(axis=0)
        return fan_lines(surface, tip, SAGITTAL)
    if name == "buccinator":
        order = np.argsort(vertices[:, 1])
        count = max(1, int(END_SHARE * len(order)))
        front, back = (vertices[rows].mean(axis=0) for rows in (order[:count], order[-count:]))
        return lane_lines(surface, front - back, SAGITTAL)
    if name == "platysma":
        return lane_lines(surface, UP, mirror * PLATYSMA_FACES)
    if name == "frontalis":
        return lane_lines(surface, DOWN, mirror * FRONTALIS_FACES)
    return ()
