"""The landmarks of skull and skin: their names, and where they lie in templates and average heads.

`REFERENCE_PLACES` are those of the synthetic head (`cmfsim.make_head()`), LPS mm, the origin midway
between the ear canals; of pairs the left one.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import LandmarkInputError
from cmfsim.values.checks import Floats

_DATA = json.loads(
    files("cmfsim.values").joinpath("landmark_sites.json").read_text(encoding="utf-8")
)
_SIDES: Mapping[str, str] = {"_L": "left", "_R": "right"}


def _places(kind: str) -> Mapping[str, Floats]:
    given = _DATA["places"][kind]
    places = {name: np.array(place) for name, place in given["midline"].items()}
    for name, (x, y, z) in given["paired"].items():
        places[f"{name}_L"], places[f"{name}_R"] = np.array([x, y, z]), np.array([-x, y, z])
    return MappingProxyType(places)


def _definitions(kind: str) -> Mapping[str, str]:
    paired, found = _DATA["places"][kind]["paired"], {}
    for name, where in _DATA["definitions"][kind].items():
        for side, word in _SIDES.items() if name in paired else (("", "midline"),):
            found[f"{name}{side}"] = f"{word}: {where}"
    return MappingProxyType(found)


# By the key of a case's [landmarks].
REFERENCE_PLACES: Mapping[str, Mapping[str, Floats]] = MappingProxyType(
    {"skull": _places("skull"), "skin": _places("skin")}
)
# 10 in the midline and 11 on either side, after the sites at which Rhine & Campbell (1980) and
# Phillips & Smuts (1996) measured the soft tissue; left and right are the patient's.
SKULL_LANDMARKS = _definitions("skull")
# The fourteen landmarks of the skin, after Kim et al. (2010), Figure 8: the figure's names are not
# in its text, so the choice is ours.
SKIN_SITES = _definitions("skin")
SKIN_LANDMARKS = tuple(SKIN_SITES)


def _plain(name: str) -> str:
    """A name without its side."""
    return name[:-2] if name[-2:] in _SIDES else name


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

    short: Its abbreviations without a side ("LGo" and "Go_L" are the left gonion), the first of
        which is written.
    site: Of `SKULL_LANDMARKS` or `SKIN_LANDMARKS` without its side; empty if only `cephalometry`
        uses it.
    """

    short: tuple[str, ...]
    kind: str
    name: str
    site: str
    where: str


# Abbreviations as in cephalometry, with those of ALI_CBCT (Gillot et al. 2023) where they differ.
CEPHALOMETRY: tuple[CephalometricSite, ...] = tuple(
    CephalometricSite(tuple(short.split()), *texts) for short, *texts in _DATA["cephalometry"]
)


def named_site(label: str, kind: str) -> str | None:
    """The site of a kind that a label stands for, in any spelling or abbreviation; None if none is.

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
