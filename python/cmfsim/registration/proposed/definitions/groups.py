"""Whether sites of the skull lie among one another as in an average head: cranium and jaw."""

from collections.abc import Mapping

import numpy as np

from cmfsim.registration.closest import robust_similarity
from cmfsim.registration.proposed.shape_model.model import HINGE
from cmfsim.registration.proposed.shape_model.state import rotation_of
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import JAW_SITES, REFERENCE_PLACES

# The distance at which a site counts half in the fit, mm.
HALF_DISTANCE = 5.0
LEAST_SITES = 5
# A jaw whose sites lie farther from where the cranium puts those of a jaw that opens is none, mm of
# the average head: condyles slide forwards by 10 mm. And how far mouths open, radians.
FAR_JAW = 24.0
OPENINGS = np.radians(np.arange(0.0, 36.0, 5.0))


def misfits(skull: Mapping[str, Floats]) -> dict[str, float]:
    """How far each site lies from where the others of its group put it, average-head mm.

    Cranium and jaw are fitted to the average head by similarities that leave outliers out; correct
    sites of two real heads lie within 12 mm. All sites of a jaw that is none have the distance from
    the place of a closed one.
    """
    upper = {n: p for n, p in skull.items() if not n.startswith(JAW_SITES)}
    lower = {n: p for n, p in skull.items() if n.startswith(JAW_SITES)}
    found: dict[str, float] = {}
    of_cranium = _fit(upper)
    if of_cranium is not None:
        found.update(_distances(upper, REFERENCE_PLACES["skull"], of_cranium))
        away = _from_jaw(lower, of_cranium)
        if away and float(np.median(list(away.values()))) > FAR_JAW:
            return {**found, **away}
    of_jaw = _fit(lower)
    if of_jaw is not None:
        found.update(_distances(lower, REFERENCE_PLACES["skull"], of_jaw))
    return found


def jaw_distance(skull: Mapping[str, Floats]) -> float:
    """How far the sites of a jaw lie from where the cranium puts those of one that opens.

    The median, average-head mm; 0 where too few sites are known.
    """
    upper = {n: p for n, p in skull.items() if not n.startswith(JAW_SITES)}
    lower = {n: p for n, p in skull.items() if n.startswith(JAW_SITES)}
    of_cranium = _fit(upper)
    if of_cranium is None or not lower:
        return 0.0
    return float(np.median([*_from_jaw(lower, of_cranium).values()]))


Similarity = tuple[Floats, Floats, float]


def _from_jaw(lower: Mapping[str, Floats], of_cranium: Similarity) -> dict[str, float]:
    """How far the sites of a jaw lie from those of an average one, as open as fits them best."""
    tried = []
    for angle in OPENINGS:
        turn = rotation_of(np.array([angle, 0.0, 0.0]))
        opened = {n: turn @ (p - HINGE) + HINGE for n, p in REFERENCE_PLACES["skull"].items()}
        tried.append(_distances(lower, opened, of_cranium))
    return min(tried, key=lambda away: float(np.median([*away.values()])) if away else 0.0)


def _distances(
    sites: Mapping[str, Floats], reference: Mapping[str, Floats], fit: Similarity
) -> dict[str, float]:
    linear, offset, scale = fit
    return {
        name: float(np.linalg.norm(linear @ place + offset - reference[name]))
        for name, place in sites.items()
        if name in reference and scale > 0.0
    }


def _fit(sites: Mapping[str, Floats]) -> Similarity | None:
    """The similarity from sites to an average head: linear part, offset, scale."""
    reference = REFERENCE_PLACES["skull"]
    names = [name for name in sites if name in reference]
    if len(names) < LEAST_SITES:
        return None
    p = np.array([sites[name] for name in names])
    r = np.array([reference[name] for name in names])
    return robust_similarity(p, r, np.ones(len(names)), HALF_DISTANCE)
