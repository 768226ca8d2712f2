"""Where tissue slides: on teeth and mucosa of the two dental arches, or in given regions."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface
from cmfsim.case import Anatomy, BoneSegment, Finding
from cmfsim.checks import Floats, as_rows
from cmfsim.errors import CaseInputError
from cmfsim.node_kinds.options import KindOptions

__all__ = ["LOWER_ARCH", "UPPER_ARCH", "sliding_nodes"]

# Bone landmarks of the two dental arches: front, left and right.
UPPER_ARCH = ("supradentale", "supra_m2_L", "supra_m2_R")
LOWER_ARCH = ("infradentale", "sub_m2_L", "sub_m2_R")


def sliding_nodes(
    points: Floats,
    nearest: NDArray[np.intp],
    anatomy: Anatomy,
    segments: Sequence[BoneSegment],
    surfaces: Sequence[Surface],
    landmarks: Mapping[str, ArrayLike],
    options: KindOptions,
    findings: list[Finding],
) -> NDArray[np.bool_]:
    """Which points lie on a bone (its number in `nearest`, or −1) within its sliding region."""
    slides = np.zeros(len(points), dtype=bool)
    given = {region.segment for region in options.regions}
    for region in options.regions:
        number = next(i for i, s in enumerate(segments) if s.name == region.segment)
        slides |= (nearest == number) & region.holds(points)
    rest = [i for i, s in enumerate(segments) if s.name not in given]
    missing = [n for n in (*UPPER_ARCH, *LOWER_ARCH) if n not in landmarks]
    if missing:
        if rest:
            findings.append(
                Finding(
                    "warning",
                    "sliding-landmarks",
                    f"no sliding region at the teeth: landmarks {', '.join(missing)} are missing",
                    "landmarks",
                    "lips and cheeks would stick to the teeth",
                    "place them, give regions, or set sliding = false",
                )
            )
        return slides
    places = {n: as_rows(f"landmark {n!r}", np.reshape(landmarks[n], (1, -1)), 3)[0]
              for n in (*UPPER_ARCH, *LOWER_ARCH)}  # fmt: skip
    near_teeth = _near_teeth(points, anatomy, options)
    up = _above(places, UPPER_ARCH, LOWER_ARCH)
    inside = {
        "upper": _in_arch(points, places, UPPER_ARCH, up, options),
        "lower": _in_arch(points, places, LOWER_ARCH, -up, options),
    }
    bearers = {
        "upper": _bearers(surfaces, [places[n] for n in UPPER_ARCH]),
        "lower": _bearers(surfaces, [places[n] for n in LOWER_ARCH]),
    }
    for number in rest:
        arches = [inside[jaw] for jaw in inside if number in bearers[jaw]]
        if arches:
            region = np.logical_and.reduce([*arches, near_teeth])
            slides |= (nearest == number) & region
    return slides


def _above(
    places: Mapping[str, Floats], upper: tuple[str, str, str], lower: tuple[str, str, str]
) -> Floats:
    """The unit vector from the lower arch to the upper, at right angles to left and front."""
    middle = [np.mean([places[n] for n in names], axis=0) for names in (lower, upper)]
    left = places[upper[1]] - places[upper[2]] + places[lower[1]] - places[lower[2]]
    left = left / np.linalg.norm(left)
    front = np.zeros(3)
    for tip, one, other in (upper, lower):
        front = front + places[tip] - 0.5 * (places[one] + places[other])
    front = front - (front @ left) * left
    front = front / np.linalg.norm(front)
    up = middle[1] - middle[0]
    up = up - (up @ left) * left - (up @ front) * front
    length = float(np.linalg.norm(up))
    if not np.isfinite(length) or length < 1.0:
        raise CaseInputError(
            f"landmarks of the upper and lower arch lie {length:.2g} mm apart in height: misplaced"
        )
    return cast("Floats", up / length)


def _in_arch(
    points: Floats,
    places: Mapping[str, Floats],
    arch: tuple[str, str, str],
    out: Floats,
    options: KindOptions,
) -> NDArray[np.bool_]:
    """Which points lie between the vestibule of an arch and the bite, and not behind or beside it.

    `out` points from the bite to the roots of this arch.
    """
    tip, left, right = (places[name] for name in arch)
    upper = arch is UPPER_ARCH
    front_depth = options.upper_front if upper else options.lower_front
    molar_depth = options.upper_molars if upper else options.lower_molars
    a = tip + front_depth * out
    b, c = left + molar_depth * out, right + molar_depth * out
    normal = np.cross(b - a, c - a)
    normal = normal * np.sign(normal @ out)
    across = (left - right) / np.linalg.norm(left - right)
    middle = 0.5 * (left + right)
    ahead = tip - middle
    ahead = ahead - (ahead @ across) * across - (ahead @ out) * out
    ahead = ahead / np.linalg.norm(ahead)
    offset = points - middle
    half = 0.5 * float(np.linalg.norm(left - right))
    return (
        ((points - a) @ normal <= 0.0)
        & (offset @ ahead >= -options.behind)
        & (np.abs(offset @ across) <= half + options.beside)
    )


def _bearers(surfaces: Sequence[Surface], arch: Sequence[Floats]) -> set[int]:
    """The segments that lie nearest to the landmarks of an arch: those that bear its teeth."""
    distances = []
    for surface in surfaces:
        closest, _, _ = surface.closest(np.array(arch))
        distances.append(np.linalg.norm(closest - np.array(arch), axis=1))
    return set(np.argmin(distances, axis=0).tolist())


def _near_teeth(points: Floats, anatomy: Anatomy, options: KindOptions) -> NDArray[np.bool_]:
    """Which points lie near the teeth; all, where the teeth are not known apart from bone."""
    if anatomy.teeth is None or not (anatomy.teeth.values > 0.0).any():
        return np.ones(len(points), dtype=bool)
    ndimage = _ndimage()
    distance = ndimage.distance_transform_edt(
        ~(anatomy.teeth.values > 0.0), sampling=np.asarray(anatomy.teeth.spacing).tolist()
    )
    return anatomy.teeth.with_values(distance).sample(points) <= options.teeth_distance


def _ndimage() -> Any:
    try:
        return import_module("scipy.ndimage")
    except ModuleNotFoundError as error:
        raise CaseInputError(
            "distances from the teeth are found with scipy: pip install 'cmfsim[imaging]'"
        ) from error
