"""The landmarks of an average head, with which a set of landmarks is compared by name.

The places are those of the synthetic head (`cmfsim.make_head()`), LPS mm, the origin midway between
the ear canals; of pairs the left one.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from cmfsim.values.checks import Floats

_SKULL_MIDLINE: Mapping[str, tuple[float, float, float]] = {
    "glabella": (0.0, -93.5, 43.2),
    "infradentale": (0.0, -89.8, -53.5),
    "menton": (0.0, -82.7, -83.9),
    "mid_philtrum": (0.0, -95.2, -29.0),
    "nasion": (0.0, -90.8, 29.7),
    "pogonion": (0.0, -90.6, -74.3),
    "rhinion": (0.0, -98.5, 11.0),
    "supradentale": (0.0, -93.2, -32.5),
    "supraglabella": (0.0, -90.6, 58.3),
    "supramentale": (0.0, -89.3, -66.0),
}
_SKULL_PAIRED: Mapping[str, tuple[float, float, float]] = {
    "frontal_eminence": (31.5, -82.4, 68.0),
    "gonion": (48.9, -20.0, -60.0),
    "inferior_malar": (31.5, -76.2, -16.0),
    "lateral_orbit": (56.0, -64.0, 4.0),
    "occlusal_line": (51.7, -38.0, -45.0),
    "sub_m2": (42.3, -49.0, -62.0),
    "suborbital": (31.5, -79.8, 1.0),
    "supra_m2": (34.1, -50.0, -27.0),
    "supraglenoid": (64.5, -12.0, 5.0),
    "supraorbital": (31.5, -85.7, 35.0),
    "zygomatic_arch": (66.6, -29.5, 1.5),
}
_SKIN_MIDLINE: Mapping[str, tuple[float, float, float]] = {
    "labiale_inferius": (0.0, -100.2, -53.2),
    "labiale_superius": (0.0, -102.2, -34.9),
    "nasion": (0.0, -97.5, 28.5),
    "pogonion": (0.0, -99.6, -74.0),
    "pronasale": (0.0, -121.5, -7.3),
    "subnasale": (0.0, -102.0, -22.6),
}
_SKIN_PAIRED: Mapping[str, tuple[float, float, float]] = {
    "alare": (16.8, -104.5, -12.5),
    "cheilion": (25.5, -89.6, -44.7),
    "endocanthion": (16.8, -91.0, 17.5),
    "exocanthion": (45.5, -80.7, 18.0),
}


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
