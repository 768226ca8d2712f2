"""Regions of the face, placed from the landmarks of the skin: the one place that defines them."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.checks import Floats, as_floats, as_rows
from cmfsim.errors import LandmarkInputError
from cmfsim.values.landmark_sites import SKIN_LANDMARKS

__all__ = ["REGIONS", "SKIN_LANDMARKS", "UNMOVED_REGIONS", "skin_regions", "unmoved_regions"]

PAIRS = ("exocanthion", "endocanthion", "alare", "cheilion")
REGIONS: Mapping[str, str] = MappingProxyType(
    {
        "face": "from the brow to below the chin, a little wider than the eyes",
        "lower face": "the same from below the lower eyelids on: what jaws move, without the eyes",
        "nose": "from nasion to subnasale, with the wings",
        "upper lip": "from subnasale to the line of the mouth, between its corners",
        "lower lip": "from the line of the mouth half way down to pogonion",
        "chin": "from there to below pogonion",
        "left cheek": "from below the eye to the height of the lower lip, beside nose and mouth",
        "right cheek": "its mirror image",
    }
)
# Where no operation on the jaws moves anything: what differs there has another cause.
UNMOVED_REGIONS: Mapping[str, str] = MappingProxyType(
    {
        "forehead": "above the brows, below the hair, as wide as the eyes",
        "left temple": "beside the eye and above it",
        "right temple": "its mirror image",
    }
)
# Proportions, each a factor on a distance between landmarks (no unit). They put the borders into
# folds of the two heads that they were looked at on: an adult male and a phantom.
NOSE_WIDTH = 1.2  # of the wings, on the distance of alare from the midline
NOSE_ROOT = 0.7  # of the root, on the same
LID = 0.35  # of the way down from the eyes to subnasale the cheek begins
FOLD = 0.5  # of the way down from labiale inferius to pogonion the chin begins
CHIN = 0.75  # the chin ends this far below pogonion, on labiale inferius to pogonion
CHIN_WIDTH = 0.9  # on the distance of cheilion from the midline
SIDE = 1.15  # the face ends at the side, on the distance of exocanthion from the midline
BROW = 0.5  # the face begins this far above the eyes, on eyes to subnasale
FOREHEAD = (0.75, 1.4)  # its lower and upper end above the eyes, on eyes to subnasale
TEMPLE = (0.1, 1.1)  # the same of the temples
TEMPLE_WIDTH = 1.7  # they end at the side, on the distance of exocanthion from the midline
DEPTH = 1.0  # and reaches this far behind cheilion, on exocanthion from the midline


def skin_regions(
    points: ArrayLike, landmarks: Mapping[str, ArrayLike]
) -> dict[str, NDArray[np.bool_]]:
    """Which points of a skin lie in each region of the face.

    Parameters
    ----------
    points : (n, 3) float64, mm
        Vertices of a skin, in any frame.
    landmarks : mapping of str to (3,) float64, mm
        The fourteen of `SKIN_LANDMARKS` on the same skin; others are left alone.

    Returns
    -------
    dict of str to (n,) bool
        "face", "lower face", "nose", "upper lip", "lower lip", "chin", "left cheek", "right cheek".
        All but the first two are apart from each other.

    Raises
    ------
    LandmarkError
        (also `ValueError`) A landmark is missing, or they do not look like a face: left and right
        exchanged, eyes below the mouth, no width.

    Notes
    -----
    Regions are outlines in the view from the front along the head's own axes: left from the mean of
    right to left landmarks, up from mouth to eyes at a right angle to it.

    Examples
    --------
    >>> import cmfsim
    >>> regions = cmfsim.skin_regions(skin.vertices, landmarks)  # doctest: +SKIP
    >>> regions["chin"].sum()  # doctest: +SKIP
    """
    return _regions(points, landmarks, _outlines)


def unmoved_regions(
    points: ArrayLike, landmarks: Mapping[str, ArrayLike]
) -> dict[str, NDArray[np.bool_]]:
    """Which points of a skin lie where operations on the jaws move nothing.

    Parameters
    ----------
    points : (n, 3) float64, mm
    landmarks : mapping of str to (3,) float64, mm
        As `skin_regions` takes them.

    Returns
    -------
    dict of str to (n,) bool
        "forehead", "left temple", "right temple", apart from each other and from the face's.

    Raises
    ------
    LandmarkError
        (also `ValueError`) As `skin_regions`.

    Examples
    --------
    >>> import cmfsim
    >>> regions = cmfsim.unmoved_regions(points, landmarks)  # doctest: +SKIP
    """
    return _regions(points, landmarks, _unmoved_outlines)


def _regions(
    points: ArrayLike,
    landmarks: Mapping[str, ArrayLike],
    outlines: Callable[[Mapping[str, Floats]], dict[str, list[tuple[float, float]]]],
) -> dict[str, NDArray[np.bool_]]:
    """The points within each outline in the view from the front."""
    missing = [name for name in SKIN_LANDMARKS if name not in landmarks]
    if missing:
        raise LandmarkInputError(
            f"landmarks lack {', '.join(missing)}: regions of the face are placed from "
            f"{', '.join(SKIN_LANDMARKS)}"
        )
    named = {name: as_floats(f"landmark {name}", landmarks[name]) for name in SKIN_LANDMARKS}
    for name, place in named.items():
        if place.shape != (3,):
            raise LandmarkInputError(f"landmark {name} has shape {place.shape}: (3,) is needed")
    origin, axes = _face_frame(named)
    at = {name: axes @ (place - origin) for name, place in named.items()}
    _check_face(at)
    left, up, front = axes @ (as_rows("points", points, 3) - origin).T
    view = np.stack([left, up], axis=1)
    reach = DEPTH * 0.5 * (at["exocanthion_L"][0] - at["exocanthion_R"][0])
    near = front > 0.5 * (at["cheilion_L"][2] + at["cheilion_R"][2]) - reach
    return {name: near & _inside(view, np.array(outline)) for name, outline in outlines(at).items()}


def _face_frame(named: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """The middle of the face, and the unit axes to its left, up and to the front as rows."""
    across = np.mean([named[f"{pair}_L"] - named[f"{pair}_R"] for pair in PAIRS], axis=0)
    middle = {p: 0.5 * (named[f"{p}_L"] + named[f"{p}_R"]) for p in PAIRS}
    rise = 0.5 * (middle["exocanthion"] + middle["endocanthion"]) - middle["cheilion"]
    width = float(np.linalg.norm(across))
    left = across / width if width > 0.0 else across
    rise = rise - (rise @ left) * left
    height = float(np.linalg.norm(rise))
    if width == 0.0 or height == 0.0:
        raise LandmarkInputError(
            f"the landmarks have a mean width of {width:g} mm and a height of {height:g} mm from "
            "mouth to eyes: they do not outline a face"
        )
    up = rise / height
    # The midline passes between all pairs.
    return np.mean(list(middle.values()), axis=0), np.array([left, up, np.cross(left, up)])


def _check_face(at: Mapping[str, Floats]) -> None:
    """Refuses landmarks whose order is no face's."""
    for pair in PAIRS:
        if at[f"{pair}_L"][0] <= at[f"{pair}_R"][0]:
            raise LandmarkInputError(
                f"{pair}_L lies to the right of {pair}_R: exchange their names (left is the "
                "patient's left)"
            )
    order = ("nasion", "subnasale", "labiale_superius", "labiale_inferius", "pogonion")
    for above, below in itertools.pairwise(order):
        if at[above][1] <= at[below][1]:
            raise LandmarkInputError(
                f"{above} lies below {below}: are the landmarks in the frame of the skin, and "
                "their names in their places?"
            )
    if at["pronasale"][2] <= 0.5 * (at["exocanthion_L"][2] + at["exocanthion_R"][2]):
        raise LandmarkInputError(
            "pronasale lies behind the eyes: left and right are exchanged, or the frame mirrors"
        )


def _outlines(at: Mapping[str, Floats]) -> dict[str, list[tuple[float, float]]]:
    """Each region's outline in the view from the front: (left, up), mm."""
    middle = at["subnasale"][0]
    base = at["subnasale"][1]
    eyes = float(
        np.mean([at[f"{p}_{s}"][1] for p in ("exocanthion", "endocanthion") for s in "LR"])
    )
    lower, chin = at["labiale_inferius"][1], at["pogonion"][1]
    mouth = 0.5 * (at["labiale_superius"][:2] + at["labiale_inferius"][:2])
    fold = lower + FOLD * (chin - lower)
    bottom = chin + CHIN * (chin - lower)
    lid = eyes + LID * (base - eyes)
    brow = eyes - BROW * (base - eyes)

    def out(name: str, side: str, factor: float) -> float:
        """A landmark's place from the midline, scaled."""
        return float(middle + factor * (at[f"{name}_{side}"][0] - middle))

    def both(name: str, factor: float, height: float) -> list[tuple[float, float]]:
        """The places at its left and its right, at a height."""
        return [(out(name, side, factor), height) for side in "LR"]

    wings = 0.5 * (at["alare_L"][1] + at["alare_R"][1])
    wing = wings + 0.4 * (wings - base)
    root_left, root_right = both("alare", NOSE_ROOT, float(at["nasion"][1]))
    wing_left, wing_right = both("alare", NOSE_WIDTH, float(wing))
    base_left, base_right = both("alare", NOSE_WIDTH, float(base))
    corner_left, corner_right = (tuple(at[f"cheilion_{s}"][:2]) for s in "LR")
    fold_left, fold_right = both("cheilion", CHIN_WIDTH, float(fold))
    line = (float(mouth[0]), float(mouth[1]))

    def cheek(side: str) -> list[tuple[float, float]]:
        root, broad, foot, corner, crease = (
            (root_left, wing_left, base_left, corner_left, fold_left)
            if side == "L"
            else (root_right, wing_right, base_right, corner_right, fold_right)
        )
        # Where the side of the nose is as high as the lower lid.
        part = (lid - broad[1]) / (root[1] - broad[1])
        beside = broad[0] + part * (root[0] - broad[0])
        outer = out("exocanthion", side, SIDE)
        return [(beside, lid), broad, foot, corner, crease, (outer, fold), (outer, lid)]

    side_left, side_right = both("exocanthion", SIDE, 0.0)
    return {
        "face": [
            (side_left[0], brow),
            (side_left[0], bottom),
            (side_right[0], bottom),
            (side_right[0], brow),
        ],
        "lower face": [
            (side_left[0], lid),
            (side_left[0], bottom),
            (side_right[0], bottom),
            (side_right[0], lid),
        ],
        "nose": [root_left, wing_left, base_left, base_right, wing_right, root_right],
        "upper lip": [base_left, corner_left, line, corner_right, base_right],
        "lower lip": [corner_left, fold_left, fold_right, corner_right, line],
        "chin": [fold_left, *both("cheilion", CHIN_WIDTH, float(bottom)), fold_right],
        "left cheek": cheek("L"),
        "right cheek": cheek("R"),
    }


def _unmoved_outlines(at: Mapping[str, Floats]) -> dict[str, list[tuple[float, float]]]:
    """The outlines of `UNMOVED_REGIONS` in the view from the front: (left, up), mm."""
    middle, base = at["subnasale"][0], at["subnasale"][1]
    eyes = float(
        np.mean([at[f"{p}_{s}"][1] for p in ("exocanthion", "endocanthion") for s in "LR"])
    )
    left, right = (float(at[f"exocanthion_{side}"][0] - middle) for side in "LR")

    def box(inner: float, outer: float, heights: tuple[float, float]) -> list[tuple[float, float]]:
        low, high = (eyes + share * (eyes - base) for share in heights)
        near, far = middle + inner, middle + outer
        return [(near, low), (near, high), (far, high), (far, low)]

    return {
        "forehead": box(left, right, FOREHEAD),
        "left temple": box(SIDE * left, TEMPLE_WIDTH * left, TEMPLE),
        "right temple": box(SIDE * right, TEMPLE_WIDTH * right, TEMPLE),
    }


def _inside(view: Floats, outline: Floats | Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Which points lie in a polygon: an odd number of its edges runs to their left."""
    corners = np.asarray(outline, dtype=np.float64)
    odd = np.zeros(len(view), dtype=bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        # Half-open in height, so that neighbours share no point and lose none.
        spans = (view[:, 1] >= min(ay, by)) & (view[:, 1] < max(ay, by))
        if ay != by:
            odd ^= spans & (view[:, 0] < ax + (view[:, 1] - ay) * (bx - ax) / (by - ay))
    return odd
