"""Error where nothing was operated on: registration, swelling or weight, and no model's.

Forehead and temples stay under any plan for the jaws. What differs there between the face before
and the face after is in every other figure of an evaluation too, and belongs to no prediction.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.evaluation.comparison import SkinComparison, compare_skins
from cmfsim.values.checks import Floats, Plain, as_floats, in_files
from cmfsim.values.surface_data import SurfaceData

# What every model moves by less than this stays, mm: far below the noise of a scan.
STILL = 0.1
# Vertices below which a figure is one of single points.
LEAST_VERTICES = 20
# A change of the soft tissue's thickness beyond this is no swelling or weight, but another frame.
MOST_CHANGE = 0.5


@dataclass(frozen=True)
class ThicknessChange(Plain):
    """The change of the soft tissue's thickness, as one fraction of its depth, at n vertices.

    share: Of the depth; negative where it became thinner. `depth`: on average there, mm.
    before, after: mm. Mean |distance| there without and with the change.
    """

    share: float = field(metadata=in_files("share_of_depth"))
    n: int = field(metadata=in_files("vertices"))
    depth: float = field(metadata=in_files("mean_depth_mm"))
    before: float = field(metadata=in_files("mean_before_mm"))
    after: float = field(metadata=in_files("mean_after_mm"))


def compare_unmoved(
    preoperative: SurfaceData,
    postoperative: SurfaceData,
    regions: Mapping[str, ArrayLike],
    moved: Floats,
) -> SkinComparison | None:
    """The face before against the face after by closest points, where nothing was operated on.

    regions: mapping of str to (v,) bool, of the pre-operative skin: `unmoved_regions`.
    moved: (v,), mm. How far each vertex is moved by the model that moves it most.
    Returns: None where under 20 vertices of the regions stay: the mesh ends below the forehead.
    Raises `RegistrationError`: None of them has a partner: the scan after ends below the forehead.
    """
    still = moved < STILL
    parts: dict[str, NDArray[np.bool_]] = {n: np.asarray(p) & still for n, p in regions.items()}
    parts = {name: part for name, part in parts.items() if part.any()}
    if sum(int(part.sum()) for part in parts.values()) < LEAST_VERTICES:
        return None
    mask = np.logical_or.reduce(list(parts.values()))
    return compare_skins(preoperative, postoperative, method="closest", mask=mask, regions=parts)


def fitted_thickness(signed: ArrayLike, depth: ArrayLike) -> ThicknessChange:
    """The one change of thickness that leaves the least error where nothing was operated on.

    Moving the skin outward by a share s of its depth d adds s d to its signed distance e. The s
    with the least Σ |e + s d| is the median of −e/d with the weights d: a few vertices in hair or
    at a fold do not change it.

    Parameters
    ----------
    signed : (k,) float64, mm
        Signed distances there; negative where the skin lies behind the post-operative one.
    depth : (k,) float64, mm
        Of the soft tissue at the same vertices.

    Raises
    ------
    CaseError
        (also `ValueError`) No vertex, arrays that do not fit, a change beyond half of the depth.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.fitted_thickness([-0.5, -1.0, -0.5, 3.0], [5.0, 10.0, 5.0, 5.0]).share
    0.1
    """
    e, d = as_floats("signed distances", signed).ravel(), as_floats("depth", depth).ravel()
    if e.shape != d.shape or not len(e) or not (d > 0.0).any():
        raise CaseInputError(
            f"{len(e)} signed distances and {len(d)} depths are given: give the same number of "
            "each, with at least one depth above 0"
        )
    thick = d > 0.0
    ratios, weights = -e[thick] / d[thick], d[thick]
    order = np.argsort(ratios, kind="stable")
    sums = np.cumsum(weights[order])
    share = float(ratios[order][np.searchsorted(sums, 0.5 * sums[-1])])
    if abs(share) > MOST_CHANGE:
        raise CaseInputError(
            f"the soft tissue would have become {100 * share:+.0f} % thicker where nothing was "
            f"operated on, by {share * d.mean():+.1f} mm: swelling does not explain this; check "
            "that the face after the operation is in the same frame as the one before"
        )
    before, after = float(np.abs(e).mean()), float(np.abs(e + share * d).mean())
    return ThicknessChange(share, len(e), float(d.mean()), before, after)
