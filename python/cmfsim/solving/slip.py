"""Sliding nodes that slipped further along bone than the plan can explain."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.scene import Scene
from cmfsim.values.surface_data import MovedSurface

# Of 60 random plans of two real heads, one in thirty has a node that slips further than this
# multiple of what bones moved: a node that went round an edge of the bone.
MOST_SLIP = 1.25
# Slip that needs no explanation, mm.
SMALL_SLIP = 4.0


def slip_finding(scene: Scene, displacements: ArrayLike) -> Finding | None:
    """The warning that sliding nodes went further along their bone than bones moved, if any did.

    A node slips because its bone moves under tissue that is held elsewhere, or because other bones
    move that tissue: by about the motion of its bone at its place plus the largest of any other. A
    node that slips by more has usually gone round an edge, and the plan may have another
    equilibrium in which it has not.

    Parameters
    ----------
    scene : Scene
        Segments that follow surfaces are left out, and so is unilateral contact, where nodes may
        leave the bone.
    displacements : (n, 3) float64, mm
        Of the nodes of the scene.

    Returns
    -------
    Finding or None
        The finding's code is "contact-slipped-far".

    Examples
    --------
    >>> import cmfsim
    >>> from cmfsim.solving.slip import slip_finding
    >>> result = cmfsim.solve_scene(scene)  # doctest: +SKIP
    >>> slip_finding(scene, result.displacements)  # doctest: +SKIP
    """
    if scene.options.contact != "bilateral":
        return None
    u = np.asarray(displacements, dtype=np.float64)
    motions = _motions(scene)
    farthest = {name: float(np.linalg.norm(way, axis=1).max()) for name, way in motions.items()}
    count, worst, largest = 0, "", 0.0
    for name, way in motions.items():
        nodes = scene.segments[name].sliding
        if not len(nodes):
            continue
        # The motions of a segment's sliding nodes come first.
        own = way[: len(nodes)]
        slip = np.linalg.norm(u[nodes] - own, axis=1)
        others = max((far for other, far in farthest.items() if other != name), default=0.0)
        explained = MOST_SLIP * (np.linalg.norm(own, axis=1) + others)
        excess = slip / np.maximum(explained, SMALL_SLIP)
        count += int(np.count_nonzero(excess > 1.0))
        if excess.max() > largest:
            at = int(excess.argmax())
            largest = float(excess[at])
            x, y, z = scene.nodes[nodes[at]]
            worst = f"{slip[at]:.1f} mm on {name!r} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    if count == 0:
        return None
    return Finding(
        "contact-slipped-far",
        f"{count} sliding {'node' if count == 1 else 'nodes'} slipped further than bones moved, at "
        f"most {worst} before the operation",
        where="contact",
    )


def _motions(scene: Scene) -> Mapping[str, Floats]:
    """How bone moves at the nodes of each rigid segment, sliding nodes first, (k, 3), mm."""
    motions = {}
    for name, segment in scene.segments.items():
        plan = scene.plan[name]
        nodes = np.concatenate([segment.sliding, segment.joined]).astype(np.int64)
        if isinstance(plan, MovedSurface) or plan.shape != (4, 4) or not len(nodes):
            continue
        places = scene.nodes[nodes]
        motions[name] = places @ plan[:3, :3].T + plan[:3, 3] - places
    return motions
