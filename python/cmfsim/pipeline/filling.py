"""Landmarks that a person did not place, from those that one did and those that were proposed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cmfsim._core import Surface
from cmfsim.errors import LandmarkInputError
from cmfsim.pipeline.proposing import ProposedHead
from cmfsim.registration.site_covariance import (
    PLACED_STD,
    SiteDistribution,
    SiteKey,
    site_covariance,
)
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS, site_part
from cmfsim.values.proposed_landmarks import (
    CLEARED_SHARE,
    GOOD_ERROR,
    MOST_ERROR,
    SURFACE_REACH,
    ProposedLandmarks,
    ProposedSite,
    SiteState,
)
from cmfsim.values.surface_data import SurfaceData

# The landmarks of a person by kind and label, mm, with who placed each.
GivenSites = Mapping[SiteKey, tuple[Floats, SiteState]]

# A given site this near to its surface was placed on a coarser drawing of it, and is brought onto
# it, mm: pages draw surfaces to within half of this.
DRAWN = 1.0
# A given site that is farther from its bone or skin, mm, is on another one, or of another head.
OFF = 8.0
# A site that follows by less than this has not moved, mm.
STILL = 0.05
# Kinds with their labels.
KINDS = {"skull": tuple(SKULL_LANDMARKS), "skin": SKIN_LANDMARKS}


def head_distribution(head: ProposedHead) -> SiteDistribution:
    """Where the landmarks of a head are expected before a person has placed any."""
    bone = np.concatenate([surface.vertices for surface in head.bones.values()])
    return site_covariance(head.landmarks, bone)


def filled_landmarks(head: ProposedHead, given: GivenSites) -> ProposedLandmarks:
    """The landmarks of a head of which a person has placed some.

    Given sites stay; the others move by the conditional mean of their distribution, and onto their
    surface. A missing site is doubtful if its expected error is above `GOOD_ERROR`, and stays
    missing above `MOST_ERROR`.

    head: With what was proposed, which may be nothing.
    given: mapping of (kind, label) to point (mm) and state.
    Returns: With the origin of each site.
    Raises `LandmarkError`: A given site lies on none of the bones, or not on the skin.
    """
    before = head_distribution(head)
    points = {key: point for key, (point, _) in given.items()}
    stds = {key: _std(state) for key, (_, state) in given.items()}
    after = before.given(points, stds)
    surfaces = _surfaces(head)
    sites: dict[str, dict[str, ProposedSite]] = {kind: {} for kind in KINDS}
    missing = {
        "skull": dict(head.landmarks.missing_skull),
        "skin": dict(head.landmarks.missing_skin),
    }
    shares = after.errors / before.errors
    shifts = np.linalg.norm(after.mean - before.mean, axis=1)
    rows = zip(after.names, after.mean, after.errors, shares, shifts, strict=True)
    for key, mean, error, share, shift in rows:
        kind, name = key
        if kind == "skin" and head.skin is None and key not in given:
            continue
        site: ProposedSite | None
        if key in given:
            site = _given_site(key, *given[key], surfaces)
        else:
            site = _following(head.landmarks, key, mean, float(error), float(share))
            site = site if shift > STILL or site is None else _as_found(head.landmarks, key, site)
            site = site and _on_surface(site, surfaces.get(site_part(*key)))
        if site is not None:
            sites[kind][name] = site
            missing[kind].pop(name, None)
        else:
            missing[kind].setdefault(name, "the sites that were placed do not determine it")
    return replace(
        head.landmarks,
        skull=_ordered(sites["skull"], SKULL_LANDMARKS),
        skin=_ordered(sites["skin"], SKIN_LANDMARKS),
        missing_skull=missing["skull"],
        missing_skin=missing["skin"],
    )


def _std(state: SiteState) -> float:
    """How far a given point may be off along each axis, mm."""
    return PLACED_STD if state.by_person else max(PLACED_STD, state.error / np.sqrt(3.0))


def _surfaces(head: ProposedHead) -> dict[str, list[Surface]]:
    """The surfaces of each part, to find closest points on."""
    found: dict[str, list[Surface]] = {}
    skin: dict[str, SurfaceData] = {} if head.skin is None else {"skin": head.skin}
    for name, surface in {**head.bones, **skin}.items():
        part = name if name in {"mandible", "skin"} else "cranium"
        found.setdefault(part, []).append(Surface(surface.vertices, surface.triangles))
    return found


def _given_site(
    key: SiteKey, point: Floats, state: SiteState, surfaces: Mapping[str, list[Surface]]
) -> ProposedSite:
    """A given site on its surface; doubtful if it lies on another bone."""
    own = site_part(*key)
    parts = [own] if own == "skin" else ["cranium", "mandible"]
    found = {part: _closest(point, surfaces[part]) for part in parts if part in surfaces}
    if own not in found:
        return ProposedSite(point, state.error, state.doubt, state.origin)
    closest, distance = found[own]
    other = min(found, key=lambda part: found[part][1])
    if found[other][1] > OFF:
        raise LandmarkInputError(
            f"{key[1]} ({key[0]}) of the case lies {distance:.0f} mm from the {own}: the others "
            "cannot follow it; check that the file belongs to this image, and its frame"
        )
    doubt = state.doubt
    if distance > OFF:
        doubt = f"it lies on the {other}, {distance:.0f} mm from the {own}"
    place = closest if distance <= DRAWN else point
    return ProposedSite(place, state.error, doubt, state.origin)


def _following(
    found: ProposedLandmarks, key: SiteKey, mean: Floats, error: float, share: float
) -> ProposedSite | None:
    """A site that nobody placed, moved with the others; None if it is missing and stays so."""
    kind, name = key
    site = (found.skull if kind == "skull" else found.skin).get(name)
    if site is None:
        return ProposedSite(mean, error, _unsure(error), "filled") if error <= MOST_ERROR else None
    if not site.doubt:
        return ProposedSite(mean, min(error, site.error), "", "moved")
    if share <= CLEARED_SHARE and error <= GOOD_ERROR:
        return ProposedSite(mean, error, "", "moved")
    return ProposedSite(mean, max(error, share * site.error), site.doubt, "moved")


def _as_found(found: ProposedLandmarks, key: SiteKey, site: ProposedSite) -> ProposedSite:
    """The site as it was proposed, if it was."""
    kind, name = key
    return (found.skull if kind == "skull" else found.skin).get(name, site)


def _unsure(error: float) -> str:
    """The doubt about a site that was filled in."""
    return "" if error <= GOOD_ERROR else "the sites that were placed are too few or too far away"


def _on_surface(site: ProposedSite, surfaces: list[Surface] | None) -> ProposedSite | None:
    """The site on its surface; None if it was filled in where there is none."""
    if site.origin == "proposed":
        return site
    closest, distance = _closest(site.point, surfaces or [])
    if distance <= SURFACE_REACH:
        return replace(site, point=closest)
    return None if site.origin == "filled" else site


def _closest(point: Floats, surfaces: list[Surface]) -> tuple[Floats, float]:
    best, least = point, np.inf
    for surface in surfaces:
        (closest,), _, _ = surface.closest(point[None])
        distance = float(np.linalg.norm(closest - point))
        if distance < least:
            best, least = closest, distance
    return best, least


def _ordered(
    sites: Mapping[str, ProposedSite], names: Mapping[str, str] | tuple[str, ...]
) -> dict[str, ProposedSite]:
    return {name: sites[name] for name in names if name in sites}
