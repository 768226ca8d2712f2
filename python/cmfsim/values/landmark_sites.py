"""The landmarks of skull and skin: their names, and where the bone sites of a template lie."""

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["JAW_SITES", "SKIN_LANDMARKS", "SKULL_LANDMARKS", "label_key", "site_part"]

# The fourteen landmarks of the skin, after Kim et al. (2010), Figure 8: the figure's names are not
# in its text, so the choice is ours.
SKIN_LANDMARKS = (
    "nasion",
    "pronasale",
    "subnasale",
    "labiale_superius",
    "labiale_inferius",
    "pogonion",
    "exocanthion_L",
    "exocanthion_R",
    "endocanthion_L",
    "endocanthion_R",
    "alare_L",
    "alare_R",
    "cheilion_L",
    "cheilion_R",
)

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


def _definitions() -> dict[str, str]:
    found = {name: f"midline: {where}" for name, where in _MIDLINE.items()}
    for name, where in _PAIRED.items():
        found[f"{name}_L"] = f"left: {where}"
        found[f"{name}_R"] = f"right: {where}"
    return found


# 10 in the midline and 11 on either side, after the sites at which Rhine & Campbell (1980) and
# Phillips & Smuts (1996) measured the soft tissue; left and right are the patient's.
SKULL_LANDMARKS: Mapping[str, str] = MappingProxyType(_definitions())


# Sites of the lower jaw, without their side.
JAW_SITES = (
    "infradentale",
    "supramentale",
    "pogonion",
    "menton",
    "gonion",
    "occlusal_line",
    "sub_m2",
)


def site_part(kind: str, name: str) -> str:
    """The part that a site lies on: "cranium", "mandible" or "skin"."""
    if kind == "skin":
        return "skin"
    return "mandible" if name.startswith(JAW_SITES) else "cranium"


def label_key(label: str) -> str:
    """What two spellings of a label have in common: neither capitals nor what parts the words."""
    return "_".join(label.casefold().replace("-", " ").replace("_", " ").split())
