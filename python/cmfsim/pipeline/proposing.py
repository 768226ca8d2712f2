"""Landmarks of a head, found on its surfaces by the synthetic head and templates, or filled in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.io import Case, read_landmark_file, read_surface
from cmfsim.pipeline.building.inputs import read_anatomy
from cmfsim.registration.proposed import TemplateHead, landmarks_from
from cmfsim.registration.proposed.proposal import DOUBTFUL
from cmfsim.registration.proposed.shape_model.site_covariance import (
    PLACED_STD,
    SiteDistribution,
    SiteKey,
    site_covariance,
)
from cmfsim.registration.proposed.template_head import average_head
from cmfsim.surfaces.levels import detailed_surface
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
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

# Surfaces that are made at a time.
SURFACES_AT_ONCE = 2
# The finding of a segmentation that separated the jaws without landmarks.
BY_SHAPE = "jaws-parted-by-shape"
# What voxels add to the expected error of a site, as a share of their longest edge.
VOXEL_ERROR = 0.5
# A site of the skin this near to something on the face may lie on it, and is then expected to be
# off by the second, mm.
ON_THINGS, UNDER_THINGS = 5.0, 8.0
# What is left of a vessel that was taken out of the bone lies within this of it, mm.
BY_VESSEL = 8.0
# A site that moves by more when the jaws are separated again is doubtful, mm.
MOVED = 3.5
# What a template head keeps its surfaces in.
SURFACE_SUFFIXES = (".ply", ".stl", ".obj", ".vtp")
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


def propose_landmarks(
    bones: Mapping[str, SurfaceData],
    skin: SurfaceData | None = None,
    *,
    templates: Sequence[TemplateHead] = (),
) -> ProposedLandmarks:
    """The landmarks of a head, found automatically by the definition of each site.

    The head's plane of symmetry and the fit of a synthetic cranium give its pose. Each site is
    found in the views from front and side by its definition, on either side and independently of
    the jaw's posture. Heads whose landmarks are known correct the bias of the definitions, as far
    as the head resembles them. It takes a few seconds.

    Parameters
    ----------
    bones : mapping of str to SurfaceData
        LPS mm, upright within about 30°. The lower jaw must be called "mandible"; without it, sites
        of the jaws are missing.
    skin : SurfaceData, optional
        Without it, no landmark of the skin is found.
    templates : sequence of TemplateHead, optional
        Further heads whose landmarks are known, besides the synthetic one.

    Returns
    -------
    ProposedLandmarks
        Points, mm, with the expected error of each; sites that the surfaces do not show are missing
        and listed with the reason.

    Raises
    ------
    LandmarkError
        (also `ValueError`) The bones show no face, or are not in LPS.
    CaseError
        scipy is missing.

    Notes
    -----
    Sites after Rhine & Campbell (1980) and Phillips & Smuts (1996); poses by iterative closest
    points with steps to tangent planes (Chen & Medioni 1992). Accuracy: docs/landmarks.md.

    Examples
    --------
    >>> import cmfsim
    >>> from cmfsim.registration.proposed.template_head import average_head
    >>> head = average_head()
    >>> found = cmfsim.propose_landmarks(head.bones, head.skin)
    >>> len(found.skull), len(found.skin)
    (32, 14)
    """
    return landmarks_from(bones, skin, [average_head(), *templates])


def head_surfaces(anatomy: Anatomy) -> tuple[dict[str, SurfaceData], SurfaceData | None]:
    """The bones and the skin of a head as surfaces: as given, or those of its levels.

    Raises `CaseError`: scikit-image is missing.
    """
    levels = {**anatomy.bones, "skin": anatomy.skin}
    found: dict[str, SurfaceData] = {}
    # One is smoothed while another is decimated, as pieces of cut bones are.
    with ThreadPoolExecutor(SURFACES_AT_ONCE) as pool:
        made = pool.map(
            lambda name: anatomy.surfaces.get(name) or detailed_surface(name, levels[name]), levels
        )
        surfaces = dict(zip(levels, made, strict=True))
    for name, surface in surfaces.items():
        if surface is None:
            raise CaseInputError(
                "finding landmarks needs surfaces, which need scikit-image: install "
                "'.[imaging]' in cmfsim's folder, or place the landmarks by hand"
            )
        found[name] = surface
    skin = found.pop("skin")
    return found, skin


@dataclass(frozen=True, eq=False)
class ProposedHead:
    """A head with the landmarks that were found on it.

    anatomy: The one given, or the one with the jaws separated again.
    findings: What was noticed beyond those of anatomy and landmarks.
    """

    anatomy: Anatomy
    bones: Mapping[str, SurfaceData]
    skin: SurfaceData | None
    landmarks: ProposedLandmarks
    findings: tuple[Finding, ...] = ()


def proposed_head(
    case: Case,
    anatomy: Anatomy,
    stage: Callable[[str], None],
    templates: Sequence[Path] = (),
    *,
    is_read: bool = True,
    placed: Mapping[str, Floats] | None = None,
) -> ProposedHead:
    """The landmarks of a case's head, with its jaws separated by them where shape alone did it.

    Where a CT's jaws were separated by shape and the lower one is doubtful, the landmarks that do
    not rest on that separate them once more, and all are found again: a site that this moves is
    doubtful. If the second jaw is worse, the first one stays. Where the first jaw shows no teeth,
    as in a head that nods far forwards, an average head's separate it, and then the patient's own.

    templates: Folders of template heads besides those that the case names.
    is_read: Whether the anatomy is what `read_anatomy` makes of the case: any other keeps its jaws.
    placed: Sites of the skull, mm, that a person placed: they separate the jaws where they differ.
    """
    placed = placed or {}
    heads = [read_template_head(folder) for folder in (*case.landmarks.templates, *templates)]
    first = _proposed(anatomy, heads)
    found = first.landmarks
    by_shape = any(finding.code == BY_SHAPE for finding in anatomy.findings)
    is_doubtful = bool(found.doubtful_jaw or found.impossible_jaw)
    if case.image is None or not (is_read and by_shape and is_doubtful and found.separation):
        return first
    second = _separated_by(first, case, stage, heads, placed)
    if second is None:
        return replace(first, findings=(_not_separated_again(),))
    if not {"supradentale", "infradentale"} <= found.skull.keys():
        # An average head's teeth separated the jaws: these teeth are known now, and do it better.
        third = _separated_by(second, case, stage, heads, placed)
        first, second = (first, second) if third is None else (second, third)
    apart = second.landmarks.apart(first.landmarks.points.get("skull", {}))
    moved = replace(second.landmarks, skull=_with_moves(second.landmarks.skull, apart))
    return replace(second, landmarks=moved, findings=(_separated_again(apart),))


def _separated_by(
    first: ProposedHead,
    case: Case,
    stage: Callable[[str], None],
    heads: Sequence[TemplateHead],
    placed: Mapping[str, Floats],
) -> ProposedHead | None:
    """The head with its jaws separated by its landmarks; None where that makes them worse."""
    stage("separating the jaws by the landmarks found")
    again, _ = read_anatomy(case, {**first.landmarks.separation, **placed}, stage)
    stage("finding the landmarks again")
    second = _proposed(again, heads)
    if "mandible" not in again.bones or _is_worse(second.landmarks, first.landmarks):
        return None
    return second


def unproposed_head(anatomy: Anatomy, why: str) -> ProposedHead:
    """The head without landmarks: all are missing, for this reason."""
    bones, skin = head_surfaces(anatomy)
    nothing = ProposedLandmarks(
        {}, {}, dict.fromkeys(SKULL_LANDMARKS, why), dict.fromkeys(SKIN_LANDMARKS, why)
    )
    return ProposedHead(anatomy, bones, skin, nothing)


def _proposed(anatomy: Anatomy, heads: Sequence[TemplateHead]) -> ProposedHead:
    bones, skin = head_surfaces(anatomy)
    found = landmarks_from(bones, skin, [average_head(), *heads], anatomy.shown)
    if not anatomy.surfaces:
        # The voxels of an image blur what the definitions read.
        blur = VOXEL_ERROR * float(anatomy.skin.spacing.max())
        on_skin = _under_things(_blurred(found.skin, blur), anatomy.attached)
        on_bone = _by_vessels(_blurred(found.skull, blur), anatomy.vessels)
        found = replace(found, skull=on_bone, skin=on_skin)
    return ProposedHead(anatomy, bones, skin, found)


def _blurred(sites: Mapping[str, ProposedSite], blur: float) -> dict[str, ProposedSite]:
    return {n: replace(s, error=float(np.hypot(s.error, blur))) for n, s in sites.items()}


def _under_things(
    sites: Mapping[str, ProposedSite], boxes: Sequence[Floats]
) -> dict[str, ProposedSite]:
    """The sites of the skin, those doubtful that may lie on what is attached to the face."""
    result = dict(sites)
    for name, site in sites.items():
        near = ((b[0] - ON_THINGS < site.point) & (site.point < b[1] + ON_THINGS) for b in boxes)
        if any(inside.all() for inside in near):
            reason = "something that is no part of the face lies there (skin-attachment)"
            result[name] = site.doubted(reason, UNDER_THINGS)
    return result


def _by_vessels(sites: Mapping[str, ProposedSite], vessels: Floats) -> dict[str, ProposedSite]:
    """The sites of the skull, those doubtful beside which a vessel was taken out of the bone."""
    result = dict(sites)
    for name, site in sites.items():
        if (np.linalg.norm(vessels - site.point, axis=1) < BY_VESSEL).any():
            reason = "a vessel with contrast agent was taken out of the bone there (bone-vessels)"
            result[name] = site.doubted(reason, UNDER_THINGS)
    return result


def _is_worse(second: ProposedLandmarks, first: ProposedLandmarks) -> bool:
    if bool(second.impossible_jaw) != bool(first.impossible_jaw):
        return bool(second.impossible_jaw)
    return bool(second.doubtful_jaw) and not first.doubtful_jaw


def _with_moves(
    sites: Mapping[str, ProposedSite], apart: Mapping[str, float]
) -> dict[str, ProposedSite]:
    """The sites, those doubtful that the second separation of the jaws has moved."""
    result = dict(sites)
    for name, moved in apart.items():
        if moved > MOVED:
            site = sites[name]
            reason = f"it moved by {moved:.1f} mm when the jaws were separated by landmarks"
            result[name] = site.doubted(reason, moved)
    return result


def _separated_again(apart: Mapping[str, float]) -> Finding:
    name = max(apart, key=lambda site: apart[site])
    return Finding(
        "jaws-separated-again",
        "the mandible was separated from the skull by shape, and again by the landmarks found: "
        f"they moved by {np.mean(list(apart.values())):.1f} mm on average, {apart[name]:.1f} mm at "
        f"most ({name})",
        severity="note",
        where="bone",
        fix="place skull landmarks by hand if a millimetre matters",
    )


def _not_separated_again() -> Finding:
    return Finding(
        "jaws-separated-again",
        "the landmarks found separate the jaws less well than shape does: they are inconsistent",
        severity="warning",
        where="bone",
        why="the cut between the tooth rows may be some millimetres off, and so may the "
        "landmarks of teeth and jaw",
    )


def read_template_head(folder: Path) -> TemplateHead:
    """A head whose landmarks are known, from a folder of surfaces and landmarks.

    The folder holds `cranium.*`, `mandible.*` and, where known, `skin.*` (PLY, STL, OBJ, VTP; LPS
    mm), `skull_landmarks.mrk.json` and, where known, `skin_landmarks.mrk.json`.
    Raises `FileNotFoundError`: The folder has no cranium or no skull landmarks.
    """
    surfaces = {
        name: read_surface(path)
        for name in ("cranium", "mandible", "skin")
        if (path := _file_of(folder, name)) is not None
    }
    points = {
        kind: read_landmark_file(path, kind=kind).points
        for kind in ("skull", "skin")
        if (path := folder / f"{kind}_landmarks.mrk.json").is_file()
    }
    if "cranium" not in surfaces or "skull" not in points:
        raise FileNotFoundError(
            f"{folder}: a template head needs a surface called cranium (.ply, .stl, .obj, .vtp) "
            "and skull_landmarks.mrk.json"
        )
    skin = surfaces.pop("skin", None)
    return TemplateHead(folder.name, surfaces, points["skull"], skin, points.get("skin", {}))


def _file_of(folder: Path, name: str) -> Path | None:
    found = [folder / f"{name}{suffix}" for suffix in SURFACE_SUFFIXES]
    return next((path for path in found if path.is_file()), None)


def head_distribution(head: ProposedHead) -> SiteDistribution:
    """Where the landmarks of a head are expected before a person has placed any."""
    bone = np.concatenate([surface.vertices for surface in head.bones.values()])
    return site_covariance(head.landmarks, bone)


def filled_landmarks(head: ProposedHead, given: GivenSites) -> ProposedLandmarks:
    """The landmarks of a head of which a person has placed some, with the origin of each site.

    Given sites stay; the others move by the conditional mean of their distribution, and onto their
    surface. A missing site is doubtful if its expected error is above `GOOD_ERROR`, and stays
    missing above `MOST_ERROR`. What was proposed may be nothing.
    Raises `LandmarkError`: A given site lies on none of the bones, or not on the skin.
    """
    before = head_distribution(head)
    points = {key: point for key, (point, _) in given.items()}
    # How far a given point may be off along each axis, mm.
    stds = {
        key: PLACED_STD if s.by_person else max(PLACED_STD, s.error / np.sqrt(3.0))
        for key, (_, s) in given.items()
    }
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
            site = _compared(site, key, before, points, stds)
        else:
            found = (head.landmarks.skull if kind == "skull" else head.landmarks.skin).get(name)
            site = _following(found, mean, float(error), float(share))
            site = site if shift > STILL else found or site
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


def _compared(
    site: ProposedSite,
    key: SiteKey,
    before: SiteDistribution,
    points: Mapping[SiteKey, Floats],
    stds: Mapping[SiteKey, float],
) -> ProposedSite:
    """A site of a person, doubtful if it lies far from where the image and the other ones put it.

    This is how a click on another tooth, on the other side or on the other jaw shows.
    """
    others = before.given({k: p for k, p in points.items() if k != key}, stds)
    row = others.names.index(key)
    gap = float(np.linalg.norm(site.point - others.mean[row]))
    if gap <= DOUBTFUL * float(np.hypot(others.errors[row], np.sqrt(3.0) * stds[key])):
        return site
    reason = f"the image and the other sites place it {gap:.0f} mm away"
    return site.doubted(reason)


def _following(
    site: ProposedSite | None, mean: Floats, error: float, share: float
) -> ProposedSite | None:
    """A site that nobody placed, moved with the others; None if it is missing and stays so."""
    if site is None:
        few = "the sites that were placed are too few or too far away"
        doubt = "" if error <= GOOD_ERROR else few
        return ProposedSite(mean, error, doubt, "filled") if error <= MOST_ERROR else None
    if not site.doubt:
        return ProposedSite(mean, min(error, site.error), "", "moved")
    if share <= CLEARED_SHARE and error <= GOOD_ERROR:
        return ProposedSite(mean, error, "", "moved")
    return ProposedSite(mean, max(error, share * site.error), site.doubt, "moved")


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
