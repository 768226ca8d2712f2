"""Sites by definition compared with those of the shape model, which stands in where they fail."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cmfsim._core import Surface
from cmfsim.registration.proposed.definitions.groups import JAW_SITES
from cmfsim.registration.proposed.judgement import IMAGE_ENDS
from cmfsim.registration.proposed.shape_model.fitted_head import FittedHead
from cmfsim.values.checks import Floats
from cmfsim.values.proposed_landmarks import ProposedSite
from cmfsim.values.surface_data import SurfaceData

# Deviations from which a site is doubtful, and from which it is the model's: of normal errors along
# three axes 3 % and 0.03 % are larger.
DOUBTFUL, REPLACED = 1.75, 2.5
# Error of a site that is not doubtful, and how far from its surface
# a site of the model may lie, mm of the average head.
KNOWN, FARTHEST = 2.5, 8.0


@dataclass(frozen=True, eq=False)
class SitesOfKind:
    """Sites of skull or skin, those that are missing, and the surface of each site."""

    kind: str
    sites: Mapping[str, ProposedSite]
    missing: Mapping[str, str]
    surfaces: Mapping[bool, SurfaceData]

    def surface_of(self, name: str) -> SurfaceData | None:
        """The surface a site lies on; True is that of the lower jaw."""
        return self.surfaces.get(self.kind == "skull" and name.startswith(JAW_SITES))


def with_model(
    found: SitesOfKind, head: FittedHead, size: float
) -> tuple[dict[str, ProposedSite], dict[str, str]]:
    """Sites and missing ones after the model has its say.

    A site far from the model's is replaced by it, and one that was not found is the model's, where
    the image goes on and a surface is near. Both are doubtful, with the model's expected error.
    """
    kind = found.kind
    sound = {(kind, n): s.point for n, s in found.sites.items() if not s.doubt}
    places, errors = head.given(sound, KNOWN * size)
    sites: dict[str, ProposedSite] = {}
    missing = dict(found.missing)
    for name, site in found.sites.items():
        model, error = head.sites[kind, name], head.errors[kind, name]
        gap = float(np.linalg.norm(site.point - model))
        deviations = gap / float(np.hypot(error, site.error))
        if deviations < DOUBTFUL:
            sites[name] = site
            continue
        doubt = f"the shape of the whole head places it {gap:.1f} mm away"
        doubt = "; ".join(filter(None, (site.doubt, doubt)))
        sites[name] = replace(site, error=max(site.error, 0.5 * gap), doubt=doubt)
        if deviations > REPLACED:
            # Others follow it no longer: the model's own place.
            moved = _on_surface(found, name, model, size)
            if moved is not None:
                doubt = f"{doubt}; placed by that shape"
                sites[name] = ProposedSite(moved, max(site.error, error, 0.5 * gap), doubt)
    for name, reason in found.missing.items():
        if IMAGE_ENDS in reason or found.surface_of(name) is None:
            continue
        place = places[kind, name]
        moved = _on_surface(found, name, place, size) if head.shows(place) else None
        if moved is not None:
            doubt = f"{reason}; placed by the shape of the head"
            sites[name] = ProposedSite(moved, errors[kind, name], doubt)
            del missing[name]
    order = [name for of, name in head.sites if of == kind and name in sites]
    return {name: sites[name] for name in order}, missing


def _on_surface(found: SitesOfKind, name: str, place: Floats, size: float) -> Floats | None:
    surface = found.surface_of(name)
    if surface is None:
        return None
    near, _, _ = Surface(surface.vertices, surface.triangles).closest(place[None])
    point: Floats = near[0]
    return point if float(np.linalg.norm(point - place)) < FARTHEST * size else None
