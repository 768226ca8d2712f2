"""Occlusion: how the teeth of both jaws meet, and where they stand in the face.

Overjet, overbite and the relation of the first molars are taken along and across the occlusal plane
in the lateral view, midlines from the midsagittal plane of the cranium, and the cant in the view
from the front. The midsagittal plane runs through the sites of the cranium that no tooth belongs
to, in their middle.
"""

import itertools
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.planning.face_measures.cephalometry import (
    FORMULAS,
    OCCLUSAL,
    head_axes,
    known_sites,
    occlusal_plane,
)
from cmfsim.planning.face_measures.definitions import measures_of
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import REFERENCE_PLACES, is_lower_site, profile_sites, tooth_of

# Between the central incisors, and at the molars, on the bone: where the teeth are not given.
UPPER_MIDLINE, LOWER_MIDLINE, MOLARS = "supradentale", "infradentale", "supra_m2"
# Sites of the cranium in the midline, and those in pairs that follow the upper jaw.
OF_JAW = (MOLARS, "inferior_malar")
MIDLINE = ("supraglabella", "glabella", "nasion", "rhinion")
# How far the upper first molar lies in front of the lower one in class I, mm, between mesiobuccal
# cusps and between the middles of the crowns: the cusp of the upper one meets the groove behind
# that of the lower one.
CLASS_I = {"MB": -2.0, "O": -1.0}
# First molars that were found on the crowns: they do not locate the occlusal plane, which one side
# alone would tilt.
FOUND_MOLARS = {
    f"{tooth}-{side}": (tooth, side[0].upper(), "O")
    for tooth in ("U6", "L6")
    for side in ("left", "right")
}
OCCLUSAL_MEASURES = measures_of("occlusion")
# Beyond these a bite or a face is not wanted, mm and degrees: overjets and open bites in great need
# of treatment, grades 4 and 5 (Brook and Shaw 1989, Eur J Orthod 11:309–320; reverse overjets and
# open bites of grade 4); midlines that laypersons notice (Kokich, Kiyak and Shapiro 1999, J Esthet
# Dent 11:311–324); cants that nine of ten observers notice (Padwa, Kaiser and Kaban 1997, J Oral
# Maxillofac Surg 55:811–816).
_BROOK, _KOKICH = "Brook and Shaw 1989", "Kokich et al. 1999"
BITE_LIMITS: Mapping[str, tuple[float, float, str]] = {
    "overjet": (-3.5, 9.0, _BROOK),
    "overbite": (-4.0, np.inf, _BROOK),
    "upper_midline": (-4.0, 4.0, _KOKICH),
    "lower_midline": (-4.0, 4.0, _KOKICH),
    "cant": (-4.0, 4.0, "Padwa et al. 1997"),
}
# How far edges may lie off where they are found on bone, and what a plan must make worse to be its
# fault: mm and degrees.
EDGE_ERROR = WORSE = 1.0


def poor_bite(rows: Iterable[Mapping[str, Any]]) -> list[Finding]:
    """A finding on what a plan takes (further) out of `BITE_LIMITS`, in `clinical_figures`."""
    texts = []
    for measure, row in zip(OCCLUSAL_MEASURES, rows, strict=False):
        was, now = row["before"], row["planned"]
        if measure.key not in BITE_LIMITS or was is None or now is None:
            continue
        low, high, source = BITE_LIMITS[measure.key]
        out, out_before = (max(low - value, value - high) for value in (now, was))
        if out > EDGE_ERROR and out > out_before + WORSE:
            limits = f"{low:g} or more" if np.isinf(high) else f"{low:g} to {high:g}"
            unit = measure.unit if measure.unit == "°" else f" {measure.unit}"
            name, after = measure.label.lower(), f"{now:.1f}{unit}"
            text = f"{name} is {after}, {was:.1f} before (limits: {limits}, {source})"
            texts.append(text.replace("-", "−"))
    return [Finding("plan-bite-poor", f"as planned, {'; '.join(texts)}")] if texts else []


def occlusion(
    landmarks: Mapping[str, ArrayLike], before: Mapping[str, ArrayLike] | None = None
) -> dict[str, float | None]:
    """The value of each of `OCCLUSAL_MEASURES`; None if one of its sites is missing.

    Parameters
    ----------
    landmarks : mapping of str to (3,) float64, mm, LPS
        As for `cephalometry`. Midlines take the middle of both central incisors ("U1_L" and
        "U1_R"), else "supradentale" and "infradentale"; the cant takes "U6_L" and "U6_R", else
        "supra_m2". Molar relations take the mesiobuccal cusps of a side ("UL6MB" and "LL6MB"), else
        the middles of the crowns ("U6_L" and "L6_L").
    before : mapping of str to (3,) float64, mm, LPS, optional
        Those before the operation, which determine the midsagittal plane and the horizontal.

    Returns
    -------
    dict of str to float or None
        By `Measure.key`, mm or degrees.

    Raises
    ------
    LandmarkError
        As `cephalometry`.

    Examples
    --------
    >>> import cmfsim
    >>> sites = {"nasion": (0, -90, 30), "supradentale": (1.5, -93, -32)}
    >>> cmfsim.occlusion(sites)["upper_midline"]
    1.5
    """
    landmarks = known_sites(landmarks)
    frame = bite_frame(landmarks if before is None else known_sites(before))
    places = np.array([*landmarks.values()], dtype=np.float64).reshape(-1, 3)
    found = {
        key: term.value(term.weights @ places, frame)
        for key, term in occlusal_terms(landmarks).items()
    }
    return {measure.key: found.get(measure.key) for measure in OCCLUSAL_MEASURES}


@dataclass(frozen=True, eq=False)
class BiteFrame:
    """The directions of a head, (3,), and where its midsagittal plane cuts left, mm, if known."""

    forwards: Floats
    up: Floats
    left: Floats
    middle: float | None


@dataclass(frozen=True, eq=False)
class OcclusalTerm:
    """How a measure is taken: a formula of points that are means of sites, less an offset, mm.

    weights: (p, n). Of each of n sites in each point.
    """

    formula: str
    weights: Floats
    offset: float = 0.0

    def value(self, points: Floats, frame: BiteFrame) -> float | None:
        """The value at points, (p, 3) mm."""
        if self.formula == "left":
            return None if frame.middle is None else float(points[0] @ frame.left) - frame.middle
        if self.formula == "cant":
            across = points[0] - points[1]
            return float(np.degrees(np.arctan2(across @ frame.up, across @ frame.left)))
        flat = points @ np.stack([frame.forwards, frame.up]).T
        return FORMULAS[self.formula][0](*flat) - self.offset


def bite_frame(landmarks: Mapping[str, ArrayLike]) -> BiteFrame:
    """The frame in which occlusion is measured, by the landmarks before the operation."""
    forwards, up = head_axes(landmarks)
    left: Floats = np.cross(up, forwards)
    return BiteFrame(forwards, up, left, _middle(landmarks, left))


def occlusal_terms(landmarks: Collection[str]) -> dict[str, OcclusalTerm]:
    """How each of `OCCLUSAL_MEASURES` is taken from landmarks of these names, where it can be."""
    # Means of unit vectors are the weights of the sites.
    unit: dict[str, Floats] = dict(zip(landmarks, np.eye(len(landmarks)), strict=True))
    flat = profile_sites(unit)
    flat |= occlusal_plane(flat)
    teeth = {FOUND_MOLARS[name]: unit[name] for name in unit if name in FOUND_MOLARS}
    teeth |= {known: unit[name] for name in unit if (known := tooth_of(name)) is not None}
    found = {}
    for measure in OCCLUSAL_MEASURES[:2]:
        if all(name in flat for name in measure.sites):
            points = np.stack([flat[name] for name in measure.sites])
            found[measure.key] = OcclusalTerm(measure.formula, points)
    for key, tooth, bone in (
        ("upper_midline", "U1", UPPER_MIDLINE),
        ("lower_midline", "L1", LOWER_MIDLINE),
    ):
        pair = _sides(teeth, tooth)
        site = unit.get(bone) if pair is None else 0.5 * (pair[0] + pair[1])
        if site is not None:
            found[key] = OcclusalTerm("left", site[None])
    on_bone = {
        ("U6", side, "O"): unit[f"{MOLARS}_{side}"] for side in "LR" if f"{MOLARS}_{side}" in unit
    }
    ends = _sides(teeth, "U6") or _sides(on_bone, "U6")
    if ends is not None:
        found["cant"] = OcclusalTerm("cant", np.stack(ends))
    for side, (cusp, offset) in itertools.product(("left", "right"), CLASS_I.items()):
        upper, lower = (teeth.get((name, side[0].upper(), cusp)) for name in ("U6", "L6"))
        if upper is not None and lower is not None and OCCLUSAL[0] in flat:
            points = np.stack([*(flat[name] for name in OCCLUSAL), upper, lower])
            found.setdefault(f"molar_{side}", OcclusalTerm("along", points, offset))
    return found


def missing_for_occlusion(
    landmarks: Mapping[str, ArrayLike], unfound: Mapping[str, str]
) -> dict[str, str]:
    """Why each of `OCCLUSAL_MEASURES` has no value, by key; `unfound`: why molars have no place."""
    edges = "edges of upper and lower incisors, or the occlusal plane: not given or found"
    middle = "central incisors of both sides, the bone between them, or sites of the cranium"
    reasons = {
        **dict.fromkeys(("overjet", "overbite"), edges),
        **dict.fromkeys(("upper_midline", "lower_midline"), f"{middle}: not given or found"),
        "cant": "upper molars of both sides: not given or found",
        **{
            key: f"U6 and L6 of the side, by the same cusp: not given, nor found ({unfound[key]})"
            if unfound.get(key)
            else "U6 and L6 of the side, by the same cusp: not given"
            for key in ("molar_left", "molar_right")
        },
    }
    values = occlusion(landmarks)
    return {key: "" if values[key] is not None else why for key, why in reasons.items()}


def _sides(
    teeth: Mapping[tuple[str, str, str], Floats], tooth: str
) -> tuple[Floats, Floats] | None:
    """The places of a tooth on both sides, by the same cusp; None if they are not given."""
    for cusp in ("O", "MB"):
        one, other = (teeth.get((tooth, side, cusp)) for side in "LR")
        if one is not None and other is not None:
            return one, other
    return None


def _middle(landmarks: Mapping[str, ArrayLike], left: Floats) -> float | None:
    """Where the midsagittal plane of a cranium cuts the direction to the left, mm."""
    own = {
        name: float(np.asarray(place, dtype=np.float64) @ left)
        for name, place in landmarks.items()
        if name in REFERENCE_PLACES["skull"]
        and not is_lower_site(name)
        and not name.startswith(OF_JAW)
    }
    pairs = [n[:-2] for n in own if n.endswith("_L") and f"{n[:-2]}_R" in own]
    found = [0.5 * (own[f"{name}_L"] + own[f"{name}_R"]) for name in pairs]
    found += [own[name] for name in MIDLINE if name in own]
    return float(np.mean(found)) if found else None
