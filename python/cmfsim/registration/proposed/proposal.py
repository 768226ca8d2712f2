"""Proposed landmarks of a head: found by definition, corrected by templates, judged one by one."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from cmfsim._core import Surface
from cmfsim.errors import LandmarkInputError
from cmfsim.registration.proposed.definitions.detection import (
    Detected,
    HeadBuild,
    HeadSurfaces,
    detect,
    is_lower,
)
from cmfsim.registration.proposed.definitions.groups import misfits
from cmfsim.registration.proposed.jaw_evidence import (
    JawEvidence,
    jaw_evidence,
    separation_points,
    weakened,
)
from cmfsim.registration.proposed.judgement import (
    IMAGE_ENDS,
    IMPOSSIBLE,
    judged,
    missing_sites,
    with_doubts_of_support,
)
from cmfsim.registration.proposed.pose import (
    Pose,
    distance_from,
    levelled,
    refined_pose,
    surface_samples,
)
from cmfsim.registration.proposed.shape_model.fitted_head import FittedHead, fit_head
from cmfsim.registration.proposed.shape_model.samples import cut_planes, samples_of
from cmfsim.registration.proposed.shape_model.site_covariance import (
    SiteKey,
    likeliest_places,
    outliers,
)
from cmfsim.registration.proposed.template_head import TemplateHead
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import JAW_SITES, SKIN_LANDMARKS, SKULL_LANDMARKS
from cmfsim.values.proposed_landmarks import ProposedLandmarks, ProposedSite
from cmfsim.values.shown_region import ShownRegion
from cmfsim.values.surface_data import SurfaceData, joined_surface

# Deviations from which a site is doubtful, and from which it says nothing: of normal errors along
# three axes 3 % and 0.03 % are larger.
DOUBTFUL, REPLACED = 1.75, 2.5
# Share of its distance from the model's that adds to the expected error of a site: the least with
# which 95 % of the sites of five unseen scans lie within twice the error; of four, 0.15 to 0.3.
GAP_SHARE = 0.3
# Share of the distance of two places that a site is expected to be off, if either may be right.
GAP_HALF = 0.5
# How far from its surface a likely place may lie, mm of the average head.
FARTHEST = 8.0

# Distance of a head from a template at which the template's bias counts half, average-head mm.
LIKENESS = 0.8
# Share that the model's place has in sites that lie where its surface is smooth: less than what
# either of two real heads in six shapes suggests.
MODEL_SHARES = {"supra_m2": 0.35, "infradentale": 0.2}
# Rounds of finding sites and levelling the head by them, and how many of the last ones the sites
# are the mean of: definitions jump where two places are nearly as good, as a pose turns by 0.2°.
LEVEL_ROUNDS, LAST_ROUNDS = 6, 5


@dataclass(frozen=True, eq=False)
class SitesOfKind:
    """Sites of skull or skin, those that are missing, and the surface of each site.

    gaps: mm. How far from where the others place it a site was found that contradicts them.
    """

    kind: str
    sites: Mapping[str, ProposedSite]
    missing: Mapping[str, str]
    surfaces: Mapping[bool, Surface]
    gaps: Mapping[SiteKey, float] = field(default_factory=dict)

    def surface_of(self, name: str) -> Surface | None:
        """The surface a site lies on; True is that of the lower jaw."""
        return self.surfaces.get(self.kind == "skull" and name.startswith(JAW_SITES))


def likeliest(
    kinds: Sequence[SitesOfKind], head: FittedHead
) -> dict[SiteKey, tuple[Floats, float]]:
    """Where definition, model and all other sites together place each site, and its error, mm.

    One that is far from the model's says nothing: it would take the others with it.
    """
    sites = {
        (found.kind, name): site
        for found in kinds
        for name, site in found.sites.items()
        if found.surface_of(name) is not None
        and _deviations(head, (found.kind, name), site) <= REPLACED
    }
    for key, site in sites.items():
        share = MODEL_SHARES.get(key[1].removesuffix("_L").removesuffix("_R"), 0.0)
        sites[key] = replace(site, point=site.point + share * (head.sites[key] - site.point))
    places = likeliest_places(sites)
    # The model knows better where few sites tell.
    for key in places.keys() - sites.keys():
        own = head.sites[key], head.errors[key]
        places[key] = min(places[key], own, key=lambda placed: placed[1])
    return places


def without_outliers(kinds: Sequence[SitesOfKind]) -> list[SitesOfKind]:
    """The sites, those doubtful that all others place elsewhere, and as far off as that."""
    sites = {(found.kind, name): site for found in kinds for name, site in found.sites.items()}
    for key, gap in outliers(sites, DOUBTFUL).items():
        sites[key] = sites[key].doubted(f"the other sites place it {gap:.1f} mm away", gap)
    return [
        replace(found, sites={name: sites[found.kind, name] for name in found.sites})
        for found in kinds
    ]


def _deviations(head: FittedHead, key: SiteKey, site: ProposedSite) -> float:
    """How many expected errors a site lies from the model's."""
    gap = np.linalg.norm(site.point - head.sites[key])
    return float(gap / np.hypot(head.errors[key], site.error))


def with_model(
    found: SitesOfKind,
    likely: Mapping[SiteKey, tuple[Floats, float]],
    head: FittedHead,
    size: float,
) -> tuple[dict[str, ProposedSite], dict[str, str]]:
    """Sites and missing ones after the others and the model have their say.

    Each goes where it is likeliest. One that lies far from the model's is doubtful, as is one that
    was not found: it is where the others place it, if the image goes on and a surface is near. It
    is missing if the image does not.
    """
    kind = found.kind
    sites: dict[str, ProposedSite] = {}
    missing = dict(found.missing)
    for name, site in found.sites.items():
        gap = float(np.linalg.norm(site.point - head.sites[kind, name]))
        deviations = _deviations(head, (kind, name), site)
        if deviations >= DOUBTFUL and not head.shows(likely[kind, name][0]):
            missing[name] = f"{IMAGE_ENDS}, by the shape of the whole head"
            continue
        moved = _surface_place(found, name, likely[kind, name][0], size)
        point = site.point if moved is None else moved
        error = float(np.hypot(site.error, GAP_SHARE * gap))
        sites[name] = ProposedSite(point, error, site.doubt)
        if deviations >= DOUBTFUL:
            reason = f"the shape of the whole head places it {gap:.1f} mm away"
            reason += "; placed by the others" * (deviations > REPLACED and moved is not None)
            doubtful = ProposedSite(point, site.error, site.doubt)
            sites[name] = doubtful.doubted(reason, GAP_HALF * gap)
    for name, reason in found.missing.items():
        if IMAGE_ENDS in reason or found.surface_of(name) is None:
            continue
        place, error = likely[kind, name]
        moved = _surface_place(found, name, place, size) if head.shows(place) else None
        if moved is not None:
            doubt = f"{reason}; placed by the shape of the head"
            # A place that no surface is near is less certain than the shapes of heads tell, as is
            # one that its definition contradicts.
            error = float(np.hypot(error, np.linalg.norm(moved - place)))
            error = max(error, GAP_HALF * found.gaps.get((kind, name), 0.0))
            sites[name] = ProposedSite(moved, error, doubt)
            del missing[name]
    order = [name for of, name in head.sites if of == kind and name in sites]
    return {name: sites[name] for name in order}, missing


def _surface_place(found: SitesOfKind, name: str, place: Floats, size: float) -> Floats | None:
    surface = found.surface_of(name)
    if surface is None:
        return None
    near, _, _ = surface.closest(place[None])
    point: Floats = near[0]
    return point if float(np.linalg.norm(point - place)) < FARTHEST * size else None


def landmarks_from(
    bones: Mapping[str, SurfaceData],
    skin: SurfaceData | None,
    templates: Sequence[TemplateHead],
    shown: ShownRegion | None = None,
) -> ProposedLandmarks:
    """The landmarks of a head, each where its definition holds, with what is doubtful about it.

    The plane of symmetry and the fit of the first template's cranium give the pose; sites are found
    in views from front and side; what a template's own sites are off from its landmarks corrects
    them, the more the head is like it.

    Parameters
    ----------
    bones : mapping of str to SurfaceData
        Of the patient, LPS mm, upright within about 30°; what is called "mandible" or the like is
        the lower jaw.
    skin : SurfaceData or None
        Without it no landmark of the skin is found.
    templates : sequence of TemplateHead
        The first is the average head, in its own frame; at least one.
    shown : ShownRegion, optional
        What padding surrounds in the image of the head.

    Raises
    ------
    LandmarkError
        (also `ValueError`) The bones show no head, or one that lies otherwise.
    """
    if not bones or not templates:
        raise LandmarkInputError(
            f"{len(bones)} bones and {len(templates)} template heads are given: at least one of "
            "each is needed to find landmarks"
        )
    parts = _surfaces(bones, skin)
    average = templates[0]
    pose, found, fitted = _found(parts, average, shown)
    likeness = [_likeness(template, parts.upper, pose, templates) for template in templates]
    found = _corrected(found, templates, likeness)
    skull = {name: p for name, p in found.skull.items() if not name.startswith("_")}
    upper = parts.upper.searched
    surface = {False: upper, True: parts.lower.searched if parts.lower else upper}
    placed = _on_surface(skull, pose, surface)
    by_skin = {} if skin is None else dict.fromkeys((False, True), skin.searched)
    on_skin = _on_surface(found.skin, pose, by_skin)
    cuts = cut_planes([*([] if skin is None else [skin]), parts.upper], shown)
    all_sites = {
        (kind, name): site
        for kind, points in (("skull", placed), ("skin", on_skin))
        for name, site in judged(points, pose, max(likeness)).items()
    }
    odd = outliers(all_sites, DOUBTFUL)
    gone = missing_sites(placed, on_skin, cuts, pose, has_jaw=parts.lower is not None, odd=odd)
    evidence = JawEvidence("", ())
    if parts.lower is not None:
        strange = {n: m / pose.size for n, m in gone.misfits.items() if n.startswith(JAW_SITES)}
        evidence = jaw_evidence(found.skull, parts.lower, pose, strange)
    placed = {name: placed[name] for name in SKULL_LANDMARKS if name in placed.keys() - gone.skull}
    on_skin = {name: on_skin[name] for name in SKIN_LANDMARKS if name in on_skin.keys() - gone.skin}
    sites = judged(placed, pose, max(likeness))
    if evidence.impossible or parts.lower is None:
        # The model puts no site on a surface that is no jaw.
        del surface[True]
    of_skull = SitesOfKind("skull", weakened(sites, evidence, pose.size), gone.skull, surface, odd)
    lost = gone.skin if skin is not None else dict.fromkeys(SKIN_LANDMARKS, "no skin is given")
    of_mouth = weakened(judged(on_skin, pose, max(likeness)), evidence, pose.size, "skin")
    of_skin = SitesOfKind("skin", of_mouth, lost, by_skin, odd)
    of_skull, of_skin = without_outliers((of_skull, of_skin))
    likely = likeliest((of_skull, of_skin), fitted)
    all_skull, missing_skull = with_model(of_skull, likely, fitted, pose.size)
    added = {name: site for name, site in all_skull.items() if name not in of_skull.sites}
    all_skull |= weakened(added, evidence, pose.size)
    all_skin, missing_skin = with_model(of_skin, likely, fitted, pose.size)
    all_skin = with_doubts_of_support(all_skin, all_skin, ("skin", "skin"))
    return ProposedLandmarks(
        with_doubts_of_support(all_skull, all_skull, ("skull", "skull")),
        with_doubts_of_support(all_skin, all_skull, ("skin", "skull")),
        missing_skull,
        missing_skin,
        evidence.impossible,
        evidence.reason,
        {} if evidence.is_only_open else separation_points(sites, pose, average.skull),
    )


def _found(
    parts: HeadSurfaces, average: TemplateHead, shown: ShownRegion | None
) -> tuple[Pose, Detected, FittedHead]:
    """The pose, the sites by their definitions, and the model of shape on the head."""
    # Points on all surfaces are drawn while the pose is found.
    with ThreadPoolExecutor(1) as beside:
        drawn = beside.submit(parts.draw)
        fitted = _fitted(parts, shown)
        pose = refined_pose(fitted.pose, parts.upper, average.bones["cranium"])
        drawn.result()
    return *_best_sites(parts, (pose, fitted.pose), average, fitted), fitted


def _surfaces(bones: Mapping[str, SurfaceData], skin: SurfaceData | None = None) -> HeadSurfaces:
    upper = [bone for name, bone in bones.items() if not is_lower(name)]
    lower = [bone for name, bone in bones.items() if is_lower(name)]
    if not upper:
        raise LandmarkInputError(
            f"the bones are {', '.join(bones)}: add the cranium, which is needed to find landmarks"
        )
    return HeadSurfaces(joined_surface(upper), joined_surface(lower) if lower else None, skin)


def _fitted(parts: HeadSurfaces, shown: ShownRegion | None = None) -> FittedHead:
    """The model of shape in all bone, divided or not, and the skin."""
    bones = [parts.upper, *([] if parts.lower is None else [parts.lower])]
    return fit_head(samples_of(joined_surface(bones), parts.skin, shown))


def _likeness(
    template: TemplateHead, upper: SurfaceData, pose: Pose, templates: Sequence[TemplateHead]
) -> float:
    """How much a template's bias counts: 1 for a head of its own shape, near 0 for another."""
    if template is templates[0]:
        distance = pose.residual / pose.size
    else:
        other, _ = _template_sites(template, templates[0])
        points, normals = surface_samples(upper, 2000)
        shape = _template_surfaces(template).upper
        moved = SurfaceData(other.into(shape.vertices) / other.size, shape.triangles)
        distance = distance_from(pose.into(points) / pose.size, normals @ pose.axes.T, moved)
    return 1.0 / (1.0 + (distance / LIKENESS) ** 2)


@lru_cache(maxsize=2)
def _template_surfaces(template: TemplateHead) -> HeadSurfaces:
    return _surfaces(template.bones, template.skin)


@lru_cache(maxsize=8)
def _template_sites(template: TemplateHead, average: TemplateHead) -> tuple[Pose, Detected]:
    """The pose of a template, and the sites that its definitions find."""
    parts = _template_surfaces(template)
    if template is average:
        pose, build = Pose(np.zeros(3), np.eye(3), 1.0, 0.0), HeadBuild(np.eye(4), 1.0)
    else:
        fitted = _fitted(parts)
        pose = refined_pose(fitted.pose, parts.upper, average.bones["cranium"])
        build = HeadBuild(fitted.jaw, fitted.breadth)
    return _levelled_sites(parts, pose, average, build)


def _best_sites(
    parts: HeadSurfaces, poses: Sequence[Pose], average: TemplateHead, fitted: FittedHead
) -> tuple[Pose, Detected]:
    """The sites from the first pose that gives none which no average head has, or the best one.

    Of a long skull, the whole cranium turns the pose by degrees that the face does not show.
    """
    build = HeadBuild(fitted.jaw, fitted.breadth)
    found, scores = [], []
    for pose in poses:
        found.append(_levelled_sites(parts, pose, average, build))
        off = misfits({n: p for n, p in found[-1][1].skull.items() if n[0] != "_"})
        if off and max(off.values()) < IMPOSSIBLE:
            return found[-1]
        scores.append(sum(min(off.get(n, IMPOSSIBLE), IMPOSSIBLE) for n in SKULL_LANDMARKS))
    return found[int(np.argmin(scores))]


def _levelled_sites(
    parts: HeadSurfaces, pose: Pose, average: TemplateHead, build: HeadBuild
) -> tuple[Pose, Detected]:
    """The pose in which the sites that are found level the head, and the sites in it."""
    seen = []
    for _ in range(LEVEL_ROUNDS):
        skull = detect(parts, pose, build, skin=False).skull
        seen.append((pose, skull))
        pose = levelled(pose, skull, average.skull)
    last = detect(parts, pose, build)
    means = dict(last.skull)
    for name, place in last.skull.items():
        places = [
            pose.into(then.out(sites[name][None] * then.size))[0] / pose.size
            for then, sites in seen[1 - LAST_ROUNDS :]
            if name in sites
        ]
        means[name] = np.mean([place, *places], axis=0)
    return pose, Detected(means, last.skin)


def measured_biases(
    template: TemplateHead, average: TemplateHead
) -> tuple[Mapping[str, Floats], Mapping[str, Floats]]:
    """How far the landmarks of a template lie from where its sites are found: skull and skin.

    In the frame and size of the average head, (3,) each.
    """
    pose, found = _template_sites(template, average)
    skull, skin = (
        {
            name: pose.into(true[name][None])[0] / pose.size - place
            for name, place in sites.items()
            if name in true
        }
        for sites, true in ((found.skull, template.skull), (found.skin, template.skin_landmarks))
    )
    return skull, skin


def _corrected(
    found: Detected, templates: Sequence[TemplateHead], likeness: Sequence[float]
) -> Detected:
    """The sites moved by the biases of templates, as far as the head is like them."""
    results: list[dict[str, Floats]] = [dict(found.skull), dict(found.skin)]
    total = max(1.0, float(sum(likeness)))
    for template, weight in zip(templates, likeness, strict=True):
        shares = template.biases or measured_biases(template, templates[0])
        for sites, bias in zip(results, shares, strict=True):
            for name in sites.keys() & bias.keys():
                sites[name] = sites[name] + weight / total * bias[name]
    return Detected(results[0], results[1])


def _on_surface(
    sites: Mapping[str, Floats], pose: Pose, surfaces: Mapping[bool, Surface]
) -> dict[str, Floats]:
    """The sites moved to the closest points of their surfaces, in the patient's frame."""
    placed: dict[str, Floats] = {}
    for lower, surface in surfaces.items():
        names = [name for name in sites if name.startswith(JAW_SITES) == lower]
        if not names:
            continue
        points = pose.out(np.array([sites[name] for name in names]) * pose.size)
        near, _, _ = surface.closest(points)
        placed.update(zip(names, near, strict=True))
    return placed
