"""The expected error of a proposed landmark, doubts about it, and parts missing from the image."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from cmfsim.registration.proposed.pose import Pose
from cmfsim.registration.proposed.shape_model.samples import CutPlane
from cmfsim.registration.proposed.shape_model.site_covariance import SiteKey
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS
from cmfsim.values.proposed_landmarks import ProposedSite

# Expected error of a site on a head unlike any template, mm: root mean squares over two real heads
# and those in other shapes (docs/landmarks.md), rounded up; sites not named, heads like a template.
_ERRORS: Mapping[str, float] = MappingProxyType({
    "frontal_eminence": 6.0, "lateral_orbit": 5.5, "inferior_malar": 4.0, "supra_m2": 4.0,
    "sub_m2": 3.5, "supraglabella": 4.0, "zygomatic_arch": 3.0, "pogonion": 2.5, "cheilion": 2.5,
    "glabella": 3.0, "supraorbital": 3.0, "subnasale": 2.5,
    "alare": 2.5, "exocanthion": 3.0, "endocanthion": 2.5, "rhinion": 2.5,
})  # fmt: skip
USUAL_ERROR, ALIKE_ERROR = 2.0, 1.0
# How the reason of a site begins that the image does not show.
IMAGE_ENDS = "the image ends there"
# A point so near to where the image ends may lie on the cut instead of on bone, mm.
AT_CUT = 3.0
# The jaw below the lower incisors must be there as far down as this for its profile to be read,
# average-head mm: to the deepest point, and to the foremost one of the chin.
TO_FOLD, TO_CHIN = 18.0, 27.0
# A site that all others place so far off is wrong, mm of the average head.
IMPOSSIBLE = 15.0
INCONSISTENT = "the point found there is inconsistent with the other sites"


# Sites that others are found from, on the same side, by the kind of both: those of the skin are
# gone with any of the skull, and all are doubtful with any.
SUPPORT: Mapping[tuple[str, str], Mapping[str, tuple[str, ...]]] = MappingProxyType({
    ("skull", "skull"): {
        "supraglabella": ("glabella",), "mid_philtrum": ("supradentale",),
        "supramentale": ("pogonion",), "frontal_eminence": ("supraorbital",),
        "inferior_malar": ("suborbital",), "lateral_orbit": ("suborbital",),
        "zygomatic_arch": ("supraglenoid",),
    },
    ("skin", "skull"): {
        "pogonion": ("pogonion",), "nasion": ("nasion",),
        "exocanthion": ("supraorbital", "suborbital"),
        "endocanthion": ("supraorbital", "suborbital"),
    },
    ("skin", "skin"): {"cheilion": ("labiale_superius", "labiale_inferius")},
})  # fmt: skip
# Those that are looked for between nose and chin: they are wrong where the chin is.
ABOVE_CHIN = ("subnasale", "labiale_superius", "labiale_inferius", "alare", "cheilion")


@dataclass(frozen=True)
class MissingSites:
    """Sites that were not found, with the reason.

    misfits: mm. How far off the sites of the skull are that all others place elsewhere.
    """

    skull: Mapping[str, str]
    skin: Mapping[str, str]
    misfits: Mapping[str, float] = field(default_factory=dict)


def missing_sites(
    skull: Mapping[str, Floats],
    skin: Mapping[str, Floats],
    cuts: Sequence[CutPlane],
    pose: Pose,
    *,
    has_jaw: bool,
    odd: Mapping[SiteKey, float],
) -> MissingSites:
    """The sites that are absent, that lie where the image ends, or that cannot be right.

    odd: mm. How far off those are that all others place elsewhere.
    """
    gone: dict[str, str] = {}
    for name in SKULL_LANDMARKS:
        if name not in skull:
            gone[name] = (
                "the bone that it lies on was not recognised"
                if has_jaw
                else "upper and lower jaw are one surface"
            )
        else:
            cut = _cut_at(skull[name], cuts, AT_CUT)
            if cut is not None:
                gone[name] = f"{IMAGE_ENDS} ({cut.name} border)"
    _below_a_cut_chin(skull, cuts, pose, gone)
    impossible = {key: gap for key, gap in odd.items() if gap > IMPOSSIBLE * pose.size}
    strange = {name: gap for (kind, name), gap in impossible.items() if kind == "skull"}
    for name in strange:
        gone.setdefault(name, INCONSISTENT)
    lost: dict[str, str] = {}
    for name in SKIN_LANDMARKS:
        if name not in skin:
            lost[name] = "the skin around it was not recognised"
        elif (cut := _cut_at(skin[name], cuts, AT_CUT)) is not None:
            lost[name] = f"{IMAGE_ENDS} ({cut.name} border)"
        elif support := next((n for n in _support(("skin", "skull"), name) if n in gone), ""):
            lost[name] = gone[support]
        elif name.startswith(ABOVE_CHIN) and "pogonion" in strange:
            lost[name] = gone["pogonion"]
        elif ("skin", name) in impossible:
            lost[name] = INCONSISTENT
    return MissingSites(gone, lost, strange)


def _own(points: Mapping[str, Floats], pose: Pose) -> dict[str, Floats]:
    """Points in the frame and size of the average head."""
    return {name: pose.into(point[None])[0] / pose.size for name, point in points.items()}


def _below_a_cut_chin(
    skull: Mapping[str, Floats], cuts: Sequence[CutPlane], pose: Pose, gone: dict[str, str]
) -> None:
    """The profile of the chin is read from its lower end: without it, only where enough is left."""
    bottom = [cut for cut in cuts if cut.name == "bottom"]
    if "infradentale" not in skull or not bottom:
        return
    left = bottom[0].inside(skull["infradentale"]) / pose.size
    for name, least in (("supramentale", TO_FOLD), ("pogonion", TO_CHIN), ("menton", TO_CHIN)):
        if left < least:
            gone.setdefault(name, f"{IMAGE_ENDS} (bottom border)")


def _cut_at(point: Floats, cuts: Sequence[CutPlane], depth: float) -> CutPlane | None:
    return next((cut for cut in cuts if cut.inside(point) < depth), None)


def judged(points: Mapping[str, Floats], pose: Pose, likeness: float) -> dict[str, ProposedSite]:
    """The sites with their expected errors: larger where left and right differ."""
    uneven = _unevenness(_own(points, pose))
    sites = {}
    for name, point in points.items():
        base = name[:-2] if name.endswith(("_L", "_R")) else name
        error = likeness * ALIKE_ERROR + (1.0 - likeness) * _ERRORS.get(base, USUAL_ERROR)
        error = float(np.hypot(error, 0.35 * max(uneven.get(base, 0.0) - 1.4, 0.0)))
        sites[name] = ProposedSite(point, pose.size * error)
    return sites


def with_doubts_of_support(
    sites: Mapping[str, ProposedSite], others: Mapping[str, ProposedSite], kinds: tuple[str, str]
) -> dict[str, ProposedSite]:
    """The sites, doubtful and no surer where one of the others is doubtful that they rest on.

    kinds: Of the sites and of the others, "skull" or "skin".
    """
    result = dict(sites)
    for name, site in sites.items():
        of = next((n for n in _support(kinds, name) if n in others and others[n].doubt), "")
        if of:
            doubt = site.doubt or f"it is found from {of} ({kinds[1]}), which is doubtful"
            result[name] = ProposedSite(site.point, max(site.error, others[of].error), doubt)
    return result


def _support(kinds: tuple[str, str], name: str) -> list[str]:
    base = name.removesuffix("_L").removesuffix("_R")
    found = SUPPORT[kinds].get(base, ())
    return [f"{of}{name.removeprefix(base)}" for of in found] + [*found]


def _unevenness(own: Mapping[str, Floats]) -> dict[str, float]:
    """How far the two of each pair are from mirror images, average-head mm.

    Across, pairs may share a lean of the jaw: the middle of their own midlines is taken off.
    """
    pairs = [n[:-2] for n in own if n.endswith("_L") and f"{n[:-2]}_R" in own]
    gaps = {p: own[f"{p}_L"] * [-1.0, 1.0, 1.0] - own[f"{p}_R"] for p in pairs}
    result = {}
    for pair, gap in gaps.items():
        height = own[f"{pair}_L"][2]
        near = [abs(own[f"{p}_L"][2] - height) < 30.0 for p in pairs]
        lean = float(
            np.median([gaps[p][0] for p, is_near in zip(pairs, near, strict=True) if is_near])
        )
        result[pair] = float(np.linalg.norm(gap - [lean, 0.0, 0.0]))
    return result
