"""The page of landmarks: its surfaces, sites and views, and its text."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from cmfsim._core import __version__
from cmfsim.planning.page.arrays import Arrays, PageContent, add_surface, framing, singles
from cmfsim.planning.page.document import Document, document_text
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import (
    SKIN_SITES,
    SKULL_LANDMARKS,
    short_name,
    site_labels,
    site_part,
)
from cmfsim.values.proposed_landmarks import CLEARED_SHARE, GOOD_ERROR, SURFACE_REACH, SiteState
from cmfsim.values.surface_data import SurfaceData

_VIEWS = files(__package__).joinpath("views.csv").read_text(encoding="utf-8").splitlines()
# Degrees as in camera.js (azimuth 0 from the front, 90 from the patient's left; elevation 90 from
# above), and the height of the picture, mm. Of pairs, the view of the left one.
VIEWS = {row.pop("site"): {k: float(v) for k, v in row.items()} for row in csv.DictReader(_VIEWS)}
# Triangles that the page draws of the skull, of a jaw and of the skin: about 2 MB together.
MOST_TRIANGLES: Mapping[str, int] = {"cranium": 60_000, "mandible": 24_000, "skin": 40_000}
# And of the average head that shows where a site is.
SMALL_TRIANGLES: Mapping[str, int] = {"cranium": 5_000, "mandible": 2_500, "skin": 3_500}
# How much of the height of the head a picture shows.
SPAN_SHARE = 1.1


@dataclass(frozen=True, eq=False)
class PageSite:
    """A landmark of the page, of the skull or skin; a missing one is "filled", with the reason.

    point: (3,), mm. Where it is, or for a missing site where the others place it.
    placed: (3,), mm, or None. Where a person has placed or accepted it already.
    """

    kind: str
    name: str
    point: Floats
    state: SiteState
    why: str = ""
    placed: Floats | None = None
    placed_origin: str = "placed"


def landmark_content(
    case: str,
    surfaces: Mapping[str, SurfaceData],
    sites: Sequence[PageSite],
    covariance: Floats,
    average: tuple[Mapping[str, SurfaceData], Mapping[str, Mapping[str, Floats]]],
    *,
    placed_std: float,
    built_for: str = "",
) -> PageContent:
    """The content of the page of a head, of bones and perhaps "skin", LPS mm.

    covariance: (3 n, 3 n), mm². Of the errors of the sites: how they follow one that is placed.
    average: The head in which the page shows where each site is.
    placed_std: mm. How far a person's own point lies from the site, along each axis.
    built_for: The state of the case.
    """
    arrays: Arrays = {
        "site_points": singles([site.point for site in sites]),
        "site_covariance": singles(covariance),
    }
    average_surfaces, average_points = average
    values = {
        "case": case,
        "version": __version__,
        "built_for": built_for or "a head without a case file",
        "surfaces": _packed(surfaces, MOST_TRIANGLES, "surface", arrays),
        "average": {
            "surfaces": _packed(average_surfaces, SMALL_TRIANGLES, "average", arrays),
            "points": {
                kind: {name: np.asarray(p).round(2).tolist() for name, p in points.items()}
                for kind, points in average_points.items()
            },
        },
        "sites": [_values(site) for site in sites],
        "placed_std": placed_std,
        "good_error": GOOD_ERROR,
        "cleared_share": CLEARED_SHARE,
        "surface_reach": SURFACE_REACH,
        **framing(
            np.concatenate([s.vertices for name, s in surfaces.items() if name != "skin"]),
            SPAN_SHARE,
        ),
    }
    return PageContent(values, arrays)


def _values(site: PageSite) -> dict[str, Any]:
    state = site.state
    definitions = SKULL_LANDMARKS if site.kind == "skull" else SKIN_SITES
    short = short_name(site.kind, site.name)
    return {
        "kind": site.kind,
        "name": site.name,
        "part": site_part(site.kind, site.name),
        "where": definitions[site.name],
        "short": "" if short == site.name else short,
        "labels": list(site_labels(site.kind, site.name)),
        "origin": state.origin,
        "error": round(state.error, 2),
        "doubt": state.doubt,
        "why": site.why,
        "placed": None if site.placed is None else np.asarray(site.placed).tolist(),
        "placed_origin": site.placed_origin,
        "view": site_view(site.name),
    }


def _part_of(name: str) -> str:
    """The part that a surface shows: every bone but the mandible carries sites of the cranium."""
    return name if name in {"mandible", "skin"} else "cranium"


def _packed(
    surfaces: Mapping[str, SurfaceData], most: Mapping[str, int], prefix: str, arrays: Arrays
) -> list[dict[str, Any]]:
    """The surfaces of parts, simplified into arrays, with how far the drawn ones are off."""
    counts = {
        part: sum(len(s.triangles) for name, s in surfaces.items() if _part_of(name) == part)
        for part in most
    }
    found = []
    for number, (name, surface) in enumerate(surfaces.items()):
        part = _part_of(name)
        allowed = max(500, most[part] * len(surface.triangles) // counts[part])
        _, off = add_surface(arrays, f"{prefix}_{number}", name, surface, allowed)
        found.append({"name": name, "part": part, "away": round(off, 3)})
    return found


def site_view(name: str) -> dict[str, float]:
    """The azimuth, elevation (degrees) and height (mm) of the picture that shows a site."""
    side = name[-2:] if name.endswith(("_L", "_R")) else ""
    view = VIEWS.get(name.removesuffix(side), VIEWS["other"])
    return {**view, "azimuth": -view["azimuth"]} if side == "_R" else view


def landmark_page_text(content: PageContent) -> str:
    """The text of a page of landmarks, which loads and sends nothing; `CaseError` if not finite."""
    case, version = content.values["case"], content.values["version"]
    return document_text(
        Document(
            title=f"{case}: landmarks",
            facts="Choose a site in the list and click on the bone or skin where it is, or drag "
            "its ball. Sites that nobody has confirmed follow. L and R are the patient's sides.",
            footer=f"Made by cmfsim {version} for case {case}. The page loads nothing from "
            "elsewhere and sends nothing. Coordinates are LPS in mm.",
            stage="Skull and skin",
            panel="Landmarks",
            picture="Skull and skin with their landmarks. Arrow keys rotate, plus and minus zoom, "
            "1 to 6 choose a view.",
            made_for=str(content.values["built_for"]),
            values=content.values,
            arrays=content.arrays,
            package="cmfsim.planning.landmark_page",
            main="landmarks_main.js",
            is_served=bool(content.values.get("on_desk")),
        )
    )
