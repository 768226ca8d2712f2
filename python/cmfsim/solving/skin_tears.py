"""Places where a predicted skin is stretched as no skin stretches, or turned over."""

import numpy as np

from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData

# Skin fails in tension at a stretch of about 1.5 (Ní Annaidh et al. 2012: 54 % ± 17 % at failure).
MOST_STRETCH = 1.5
# Edges that lengthen by less, mm, and triangles of less area, mm², are too small to be seen.
VISIBLE_LENGTH = 1.5
VISIBLE_AREA = 0.5


def tear_finding(skin: SurfaceData, displacements: Floats) -> Finding | None:
    """The warning that a predicted skin is torn or folded over, if it is anywhere.

    Parameters
    ----------
    skin : SurfaceData
        Before the operation.
    displacements : (v, 3) float64, mm
        Of its vertices.

    Returns
    -------
    Finding or None
        The finding's code is "skin-torn".

    Notes
    -----
    An edge counts as torn if it is stretched by more than half, and becomes longer by at least
    1.5 mm; a triangle as turned over if its normal turns by more than a right angle, and if it has
    at least 0.5 mm² before the operation.

    Examples
    --------
    >>> import cmfsim
    >>> from cmfsim.solving.skin_tears import tear_finding
    >>> skin = cmfsim.SurfaceData([[0, 0, 0], [2, 0, 0], [0, 2, 0]], [[0, 1, 2]])
    >>> tear_finding(skin, 0.2 * skin.vertices) is None
    True
    >>> tear_finding(skin, 0.8 * skin.vertices).code
    'skin-torn'
    """
    before, triangles = skin.vertices, skin.triangles.astype(np.int64)
    after = before + displacements
    ends = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    # As one number each: rows would be sorted twenty times as slowly.
    edges = np.column_stack(np.divmod(np.unique(ends @ [len(before), 1]), len(before)))
    rest, now = (np.linalg.norm(np.subtract(*v[edges.T]), axis=1) for v in (before, after))
    torn = (now > MOST_STRETCH * rest) & (now - rest > VISIBLE_LENGTH)
    one, other = (_areas(v[triangles]) for v in (before, after))
    turned = (np.einsum("ta,ta->t", one, other) < 0.0) & (
        np.linalg.norm(one, axis=1) > VISIBLE_AREA
    )
    if not torn.any() and not turned.any():
        return None
    facts = []
    if turned.any():
        count = int(turned.sum())
        facts.append(f"{count} {'triangle is' if count == 1 else 'triangles are'} turned over")
        worst = int(np.argmax(np.where(turned, np.linalg.norm(one, axis=1), 0.0)))
        place = before[triangles[worst]].mean(axis=0)
    if torn.any():
        count = int(torn.sum())
        longer = np.where(torn, now - rest, 0.0)
        worst = int(longer.argmax())
        place = before[edges[worst]].mean(axis=0)
        facts.insert(
            0,
            f"{count} {'edge' if count == 1 else 'edges'} of the predicted skin "
            f"{'is' if count == 1 else 'are'} stretched by more than half (worst: from "
            f"{rest[worst]:.1f} to {now[worst]:.1f} mm)",
        )
    else:
        facts[0] += " in the predicted skin"
    return Finding(
        "skin-torn",
        ", and ".join(facts),
        where=f"about ({place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f}) mm",
    )


def _areas(corners: Floats) -> Floats:
    """The area vectors of triangles given by their corners, (t, 3) mm²."""
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
