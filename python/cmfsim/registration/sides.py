"""Left and right of landmarks: pairs called `…_L` and `…_R`, and the side that they lie on."""

from collections.abc import Mapping

import numpy as np

from cmfsim._core import rigid_fit
from cmfsim.errors import RegistrationError
from cmfsim.values.checks import Floats

# A landmark closer to the middle than this does not distinguish left from right, mm.
SIDE_MARGIN = 3.0
# Distance to the partner of the other side over that to the own one below which sides are swapped.
SWAPPED_SHARE = 0.5


def side_pairs(names: Mapping[str, object] | tuple[str, ...]) -> dict[str, tuple[str, str]]:
    """The left and the right name of each pair, by the name without its side."""
    return {
        name[:-2]: (name, f"{name[:-2]}_R")
        for name in names
        if name.endswith("_L") and f"{name[:-2]}_R" in names
    }


def side_vectors(landmarks: Mapping[str, Floats]) -> dict[str, Floats]:
    """The vector from the right to the left landmark of each pair, mm."""
    return {
        pair: landmarks[left] - landmarks[right]
        for pair, (left, right) in side_pairs(landmarks).items()
    }


def wrong_sides(landmarks: Mapping[str, Floats]) -> list[str]:
    """The pairs whose left landmark lies on the right; LPS, the head upright."""
    vectors = side_vectors(landmarks)
    return [pair for pair, vector in vectors.items() if vector[0] < -SIDE_MARGIN]


def swapped_pairs(names: tuple[str, ...], source: Floats, target: Floats) -> list[str] | None:
    """The pairs whose sides differ between two sets of the same landmarks, wherever those lie.

    The sets are brought together by what a swap does not move, landmarks without a side and the
    middles of pairs; then a pair is swapped if its two landmarks lie nearer to one another's
    partners, by half at least. None where those points do not tell.
    """
    index = {name: i for i, name in enumerate(names)}
    pairs = {p: (index[left], index[right]) for p, (left, right) in side_pairs(names).items()}
    sided = {i for pair in pairs.values() for i in pair}
    groups = [(i,) for i in range(len(names)) if i not in sided] + list(pairs.values())
    still, goal = (
        np.stack([points[list(group)].mean(axis=0) for group in groups])
        for points in (source, target)
    )
    try:
        fit = rigid_fit(still, goal, scale=True)
    except RegistrationError:
        return None
    moved = source @ fit.matrix[:3, :3].T + fit.matrix[:3, 3]
    swapped = []
    for pair, (left, right) in pairs.items():
        ends = target[[left, right]]
        kept = float(np.square(moved[[left, right]] - ends).sum())
        exchanged = float(np.square(moved[[right, left]] - ends).sum())
        if exchanged < SWAPPED_SHARE**2 * kept:
            swapped.append(pair)
    return swapped
