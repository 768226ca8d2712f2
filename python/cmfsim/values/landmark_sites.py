"""The landmarks of skull and skin: their names, and where they lie in templates and average heads.

`REFERENCE_PLACES` are those of the synthetic head (`cmfsim.make_head()`), LPS mm, the origin midway
between the ear canals; of pairs the left one.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import LandmarkInputError
from cmfsim.values.checks import Floats

_SKULL_MIDLINE: Mapping[str, tuple[float, float, float]] = {
    "glabella": (0.0, -93.5, 43.2), "infradentale": (0.0, -89.8, -53.5),
    "menton": (0.0, -82.7, -83.9), "mid_philtrum": (0.0, -95.2, -29.0),
    "nasion": (0.0, -90.8, 29.7), "pogonion": (0.0, -90.6, -74.3), "rhinion": (0.0, -98.5, 11.0),
    "supradentale": (0.0, -93.2, -32.5), "supraglabella": (0.0, -90.6, 58.3),
    "supramentale": (0.0, -89.3, -66.0),
}  # fmt: skip
_SKULL_PAIRED: Mapping[str, tuple[float, float, float]] = {
    "frontal_eminence": (31.5, -82.4, 68.0), "gonion": (48.9, -20.0, -60.0),
    "inferior_malar": (31.5, -76.2, -16.0), "lateral_orbit": (56.0, -64.0, 4.0),
    "occlusal_line": (51.7, -38.0, -45.0), "sub_m2": (42.3, -49.0, -62.0),
    "suborbital": (31.5, -79.8, 1.0), "supra_m2": (34.1, -50.0, -27.0),
    "supraglenoid": (64.5, -12.0, 5.0), "supraorbital": (31.5, -85.7, 35.0),
    "zygomatic_arch": (66.6, -29.5, 1.5),
}  # fmt: skip
_SKIN_MIDLINE: Mapping[str, tuple[float, float, float]] = {
    "labiale_inferius": (0.0, -100.2, -53.2), "labiale_superius": (0.0, -102.2, -34.9),
    "nasion": (0.0, -97.5, 28.5), "pogonion": (0.0, -99.6, -74.0),
    "pronasale": (0.0, -121.5, -7.3), "subnasale": (0.0, -102.0, -22.6),
}  # fmt: skip
_SKIN_PAIRED: Mapping[str, tuple[float, float, float]] = {
    "alare": (16.8, -104.5, -12.5), "cheilion": (25.5, -89.6, -44.7),
    "endocanthion": (16.8, -91.0, 17.5), "exocanthion": (45.5, -80.7, 18.0),
}  # fmt: skip

# The fourteen landmarks of the skin, after Kim et al. (2010), Figure 8: the figure's names are not
# in its text, so the choice is ours.
SKIN_LANDMARKS = (
    "nasion", "pronasale", "subnasale", "labiale_superius", "labiale_inferius", "pogonion",
    "exocanthion_L", "exocanthion_R", "endocanthion_L", "endocanthion_R", "alare_L", "alare_R",
    "cheilion_L", "cheilion_R",
)  # fmt: skip

_SKIN_PLACES: Mapping[str, str] = {
    "nasion": "root of the nose, at the height of the nasofrontal suture",
    "pronasale": "most protruded point of the nose",
    "subnasale": "where nasal septum and upper lip meet",
    "labiale_superius": "upper border of the red of the upper lip",
    "labiale_inferius": "lower border of the red of the lower lip",
    "pogonion": "foremost point of the soft chin",
    "exocanthion": "outer corner of the eye",
    "endocanthion": "inner corner of the eye",
    "alare": "most lateral point of the wing of the nose",
    "cheilion": "corner of the mouth",
}

_MIDLINE: Mapping[str, str] = {
    "supraglabella": "frontal bone above the glabella, where the forehead begins to rise upright",
    "glabella": "most prominent point between the brow ridges",
    "nasion": "where nasal and frontal bones meet",
    "rhinion": "lower end of the suture between the nasal bones, the tip of the bony nose",
    "mid_philtrum": "deepest point of the maxilla between nasal spine and upper incisors",
    "supradentale": "between the upper central incisors, at the edge of the bone",
    "infradentale": "between the lower central incisors, at the edge of the bone",
    "supramentale": "deepest point of the mandible between lower incisors and chin",
    "pogonion": "foremost point of the bony chin",
    "menton": "lowest point of the mandible",
}
_PAIRED: Mapping[str, str] = {
    "frontal_eminence": "bulge of the forehead, straight above the middle of the eye",
    "supraorbital": "upper rim of the orbit, above the middle of the eye",
    "suborbital": "lower rim of the orbit, below the middle of the eye",
    "inferior_malar": "lower border of cheekbone and maxilla, below the suborbital point",
    "lateral_orbit": "cheekbone beside and some 10 mm below the outer rim of the orbit",
    "zygomatic_arch": "point of the zygomatic arch that lies furthest to the side",
    "supraglenoid": "root of the zygomatic arch before the ear, above the jaw joint",
    "gonion": "point of the angle of the mandible furthest to the side, back and below",
    "supra_m2": "maxilla above the upper second molar",
    "occlusal_line": "front and outer face of the ramus at the height where the teeth meet",
    "sub_m2": "body of the mandible below the lower second molar",
}
_SIDES: Mapping[str, str] = {"_L": "left", "_R": "right"}


def _places(
    midline: Mapping[str, tuple[float, float, float]],
    paired: Mapping[str, tuple[float, float, float]],
) -> Mapping[str, Floats]:
    places = {name: np.array(place) for name, place in midline.items()}
    for name, (x, y, z) in paired.items():
        places[f"{name}_L"], places[f"{name}_R"] = np.array([x, y, z]), np.array([-x, y, z])
    return MappingProxyType(places)


# By the key of a case's [landmarks].
REFERENCE_PLACES: Mapping[str, Mapping[str, Floats]] = MappingProxyType(
    {"skull": _places(_SKULL_MIDLINE, _SKULL_PAIRED), "skin": _places(_SKIN_MIDLINE, _SKIN_PAIRED)}
)


def _plain(name: str) -> str:
    """A name without its side."""
    return name[:-2] if name[-2:] in _SIDES else name


# 10 in the midline and 11 on either side, after the sites at which Rhine & Campbell (1980) and
# Phillips & Smuts (1996) measured the soft tissue; left and right are the patient's.
SKULL_LANDMARKS: Mapping[str, str] = MappingProxyType(
    {name: f"midline: {where}" for name, where in _MIDLINE.items()}
    | {
        f"{name}{side}": f"{word}: {where}"
        for name, where in _PAIRED.items()
        for side, word in _SIDES.items()
    }
)
# The same of the skin.
SKIN_SITES: Mapping[str, str] = MappingProxyType(
    {
        name: f"{_SIDES.get(name[-2:], 'midline')}: {_SKIN_PLACES[_plain(name)]}"
        for name in SKIN_LANDMARKS
    }
)

# Sites of the lower jaw, without their side.
JAW_SITES = (
    "infradentale", "supramentale", "pogonion", "menton", "gonion", "occlusal_line", "sub_m2",
)  # fmt: skip


def is_lower_site(name: str) -> bool:
    """Whether a site of the skull lies on the lower jaw."""
    return name.startswith(JAW_SITES)


def site_part(kind: str, name: str) -> str:
    """The part that a site lies on: "cranium", "mandible" or "skin"."""
    if kind == "skin":
        return "skin"
    return "mandible" if is_lower_site(name) else "cranium"


def label_key(label: str) -> str:
    """What two spellings of a label have in common: neither capitals nor what parts the words."""
    return "_".join(label.casefold().replace("-", " ").replace("_", " ").split())


@dataclass(frozen=True)
class CephalometricSite:
    """A landmark under the names of cephalometry and of Slicer's automatic tools.

    short: Its abbreviations without a side ("LGo" and "Go_L" are the left gonion); the first is
        written.
    kind: "skull" or "skin".
    name: In words.
    site: Of `SKULL_LANDMARKS` or `SKIN_LANDMARKS` without its side; empty if only `cephalometry`
        uses it.
    where: Its definition in cephalometry.
    """

    short: tuple[str, ...]
    kind: str
    name: str
    site: str
    where: str


# Abbreviations as in cephalometry, with those of ALI_CBCT (Gillot et al. 2023) where they differ.
# fmt: off
CEPHALOMETRY: tuple[CephalometricSite, ...] = tuple(CephalometricSite(tuple(row[0].split()), *row[1:]) for row in (
    ("N Na", "skull", "nasion", "nasion", "front of the frontonasal suture"),
    ("G", "skull", "glabella", "glabella", "foremost point between the brows"),
    ("Rhi Rh", "skull", "rhinion", "rhinion", "tip of the nasal bones"),
    ("A SS", "skull", "A point, subspinale", "mid_philtrum", "deepest point of the maxilla between anterior nasal spine and prosthion"),
    ("Pr SPr", "skull", "prosthion", "supradentale", "edge of the bone between the upper central incisors"),
    ("Id", "skull", "infradentale", "infradentale", "edge of the bone between the lower central incisors"),
    ("B", "skull", "B point", "supramentale", "deepest point of the mandible between infradentale and pogonion"),
    ("Pog Pg", "skull", "pogonion", "pogonion", "foremost point of the bony chin"),
    ("Me", "skull", "menton", "menton", "lowest point of the chin"),
    ("Or", "skull", "orbitale", "suborbital", "lowest point of the rim of the orbit"),
    ("Zy", "skull", "zygion", "zygomatic_arch", "outermost point of the zygomatic arch"),
    ("Go", "skull", "gonion", "gonion", "point of the angle of the mandible"),
    ("N' Na'", "skin", "soft nasion", "nasion", "root of the nose"),
    ("Prn Pn", "skin", "pronasale", "pronasale", "tip of the nose"),
    ("Sn", "skin", "subnasale", "subnasale", "where septum and upper lip meet"),
    ("Ls", "skin", "labiale superius", "labiale_superius", "border of the upper vermilion"),
    ("Li", "skin", "labiale inferius", "labiale_inferius", "border of the lower vermilion"),
    ("Pog' Pg'", "skin", "soft pogonion", "pogonion", "foremost point of the soft chin"),
    ("Ex", "skin", "exocanthion", "exocanthion", "outer corner of the eye"),
    ("En", "skin", "endocanthion", "endocanthion", "inner corner of the eye"),
    ("Al", "skin", "alare", "alare", "outermost point of the nose"),
    ("Ch", "skin", "cheilion", "cheilion", "corner of the mouth"),
    ("S", "skull", "sella", "", "middle of the sella turcica"),
    ("Ba", "skull", "basion", "", "front edge of the foramen magnum"),
    ("ANS", "skull", "anterior nasal spine", "", "tip of the spine"),
    ("PNS", "skull", "posterior nasal spine", "", "tip of the spine"),
    ("Po", "skull", "porion", "", "highest point of the opening of the ear canal, on each side"),
    ("Co", "skull", "condylion", "", "highest point of each condyle"),
    ("Gn", "skull", "gnathion", "", "point of the chin between pogonion and menton"),
    ("U1 UR1O UL1O", "skull", "upper incisor", "", "edge of the upper central incisor"),
    ("L1 LR1O LL1O", "skull", "lower incisor", "", "edge of the lower central incisor"),
    ("U1R UR1R UL1R", "skull", "root of the upper incisor", "", "tip of its root"),
    ("L1R LR1R LL1R", "skull", "root of the lower incisor", "", "tip of its root"),
    ("U6 UR6O UL6O UR6MB UL6MB", "skull", "upper first molar", "", "crown of the upper first molar: middle (O), mesiobuccal cusp (MB)"),
    ("L6 LR6O LL6O LR6MB LL6MB", "skull", "lower first molar", "", "crown of the lower first molar: middle (O), mesiobuccal cusp (MB)"),
))
# fmt: on


def named_site(label: str, kind: str) -> str | None:
    """The site of a kind that a label stands for, in any spelling or by an abbreviation.

    Returns: None if it is none of cmfsim's.
    Raises `LandmarkError`: A paired site without its side.
    """
    key = label_key(label)
    found = _labels(kind).get(key)
    if found is None and key in _sideless(kind):
        raise LandmarkInputError(
            f"{label!r} does not state its side: use {label}_L for the patient's left and "
            f"{label}_R for the right"
        )
    return found


def short_name(kind: str, site: str) -> str:
    """The abbreviation of a site as ALI_CBCT writes it, such as "LGo"; its label without one."""
    side = site[-1] if site[-2:] in _SIDES else ""
    for entry in CEPHALOMETRY:
        if entry.kind == kind and entry.site == _plain(site):
            return side + entry.short[0]
    return site


def site_labels(kind: str, site: str) -> tuple[str, ...]:
    """All labels that stand for a site, as `label_key` spells them."""
    return tuple(key for key, name in _labels(kind).items() if name == site)


def profile_sites(landmarks: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """The sites of a skull as a lateral view shows them: both sides of a pair at their middle.

    Labels are those of `SKULL_LANDMARKS` or any abbreviations of `CEPHALOMETRY`. Sites are named by
    their first abbreviation ("N", "Go"), or by their label without a side.
    """
    short = _short_labels()
    found: dict[str, list[Floats]] = {}
    for label, place in landmarks.items():
        name = short.get(label_key(label), _plain(label))
        found.setdefault(name, []).append(np.asarray(place, dtype=np.float64))
    return {name: np.mean(places, axis=0) for name, places in found.items()}


def is_for_measures(label: str) -> bool:
    """Whether a label stands for a site that measures alone use: it may lie off the bone."""
    short = _short_labels().get(label_key(label))
    return any(entry.short[0] == short and not entry.site for entry in CEPHALOMETRY)


def tooth_of(label: str) -> tuple[str, str, str] | None:
    """The site (such as "U6"), side and cusp ("O" or "MB") of a tooth's label; None for others."""
    return _tooth_labels().get(label_key(label))


@cache
def _tooth_labels() -> Mapping[str, tuple[str, str, str]]:
    """What each label of a tooth with a side stands for."""
    found = {}
    for entry in CEPHALOMETRY:
        site, *others = entry.short
        for label in others:
            if label[1] in "LR" and label.endswith(("O", "MB")):
                found[label_key(label)] = (site, label[1], label[3:])
                for side in _SIDES:
                    found |= {label_key(s): (site, side[1], "O") for s in _sided(site, side)}
    return MappingProxyType(found)


@cache
def _short_labels() -> Mapping[str, str]:
    """The first abbreviation of each label of the skull, with a side or without."""
    found: dict[str, str] = {}
    for entry in (e for e in CEPHALOMETRY if e.kind == "skull"):
        for word in filter(None, (entry.site, *entry.short)):
            for label in (word, *_sided(word, "_L"), *_sided(word, "_R")):
                found.setdefault(label_key(label), entry.short[0])
    return MappingProxyType(found)


@cache
def _labels(kind: str) -> Mapping[str, str]:
    """The site of each label of a kind, as `label_key` spells it."""
    found: dict[str, str] = {}
    for name in SKULL_LANDMARKS if kind == "skull" else SKIN_LANDMARKS:
        side = name[-2:] if name[-2:] in _SIDES else ""
        for word in (_plain(name), *_abbreviations(kind, _plain(name))):
            for label in _sided(word, side):
                key = label_key(label)
                if found.setdefault(key, name) != name:
                    raise AssertionError((label, name, found[key]))
    return MappingProxyType(found)


@cache
def _sideless(kind: str) -> frozenset[str]:
    """Labels of paired sites that lack the side."""
    names = SKULL_LANDMARKS if kind == "skull" else SKIN_LANDMARKS
    paired = {_plain(name) for name in names if name[-2:] in _SIDES}
    words = (word for name in paired for word in (name, *_abbreviations(kind, name)))
    return frozenset(map(label_key, words))


def _abbreviations(kind: str, site: str) -> Iterator[str]:
    for entry in CEPHALOMETRY:
        if entry.kind == kind and entry.site == site:
            yield from entry.short


def _sided(word: str, side: str) -> tuple[str, ...]:
    """The ways to write a word with a side: Go_L, LGo, Go left, left Go."""
    if not side:
        return (word,)
    full = _SIDES[side]
    return (f"{word}{side}", f"{side[1]}{word}", f"{side[1]} {word}", f"{word} {full}",
            f"{full} {word}")  # fmt: skip
