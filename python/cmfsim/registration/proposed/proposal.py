"""Proposed landmarks of a head: found by definition, corrected by templates, judged one by one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cmfsim._core import Surface
from cmfsim.checks import Floats
from cmfsim.registration.proposed.detection import Detected, biases, detect, is_lower, joined
from cmfsim.registration.proposed.pose import Pose, find_pose, levelled
from cmfsim.registration.proposed.template_head import TemplateHead
from cmfsim.values.surface_data import SurfaceData

__all__ = ["propose"]

# Distance of a head from a template at which the template's bias counts half, average-head mm.
LIKENESS = 0.8
# Share by which a pair moves towards its mirror image.
MIRRORED = 0.3


def propose(
    bones: Mapping[str, SurfaceData],
    skin: SurfaceData | None,
    templates: Sequence[TemplateHead],
) -> tuple[dict[str, Floats], dict[str, Floats], Pose]:
    average = templates[0]
    upper = joined([b for n, b in bones.items() if not is_lower(n)] or list(bones.values()))
    pose = find_pose(upper, average.bones["cranium"])
    for _ in range(2):
        pose = levelled(pose, detect(bones, None, pose).skull, average.skull)
    found = detect(bones, skin, pose)
    skull, skin_sites = _corrected(found, [(average, pose.residual / pose.size)])
    skull = {name: place for name, place in skull.items() if not name.startswith("_")}
    skull = _evened(skull)
    skin_sites = _evened(skin_sites)
    upper = joined([b for n, b in bones.items() if not is_lower(n)])
    lower = [b for n, b in bones.items() if is_lower(n)]
    onto = {False: upper, True: joined(lower) if lower else upper}
    return (
        _on_surface(skull, pose, onto),
        {} if skin is None else _on_surface(skin_sites, pose, {False: skin, True: skin}),
        pose,
    )


JAW = ("infradentale", "supramentale", "pogonion", "menton", "gonion", "occlusal_line", "sub_m2")


def _on_surface(
    sites: Mapping[str, Floats], pose: Pose, surfaces: Mapping[bool, SurfaceData]
) -> dict[str, Floats]:
    placed: dict[str, Floats] = {}
    for lower, surface in surfaces.items():
        names = [n for n in sites if n.startswith(JAW) == lower]
        if not names:
            continue
        points = pose.out(np.array([sites[n] for n in names]) * pose.size)
        whole = Surface(np.asarray(surface.vertices), np.asarray(surface.triangles))
        near, _, _ = whole.closest(points)
        placed.update(zip(names, near, strict=True))
    return placed


def _corrected(
    found: Detected, templates: Sequence[tuple[TemplateHead, float]]
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """The sites moved by the biases of templates, as far as the head is like them."""
    results: list[dict[str, Floats]] = [dict(found.skull), dict(found.skin)]
    for template, distance in templates:
        weight = 1.0 / (1.0 + (distance / LIKENESS) ** 2)
        for sites, bias in zip(results, _average_biases(template), strict=True):
            for name in sites.keys() & bias.keys():
                sites[name] = sites[name] + weight * bias[name]
    return results[0], results[1]


@lru_cache(maxsize=4)
def _average_biases(template: TemplateHead) -> tuple[dict[str, Floats], dict[str, Floats]]:
    pose = Pose(np.zeros(3), np.eye(3), 1.0, 0.0)
    for _ in range(2):
        pose = levelled(pose, detect(template.bones, None, pose).skull, template.skull)
    return biases(template, pose)


def _evened(sites: Mapping[str, Floats]) -> dict[str, Floats]:
    """Pairs moved a little towards their mirror images about their own midline."""
    pairs = [n[:-2] for n in sites if n.endswith("_L") and f"{n[:-2]}_R" in sites]
    result = dict(sites)
    for pair in pairs:
        left, right = sites[f"{pair}_L"], sites[f"{pair}_R"]
        even = 0.5 * (left + right * [-1.0, 1.0, 1.0])
        middle = 0.5 * (left[0] + right[0])
        for letter, side, own in (("L", 1.0, left), ("R", -1.0, right)):
            mirrored = even * [side, 1.0, 1.0] + [middle, 0.0, 0.0]
            result[f"{pair}_{letter}"] = own + MIRRORED * (mirrored - own)
    return result
