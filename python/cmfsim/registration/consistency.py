"""Whether landmarks agree with one another and their surface: names, symmetry, a common shift."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim.errors import LandmarkError, RegistrationError
from cmfsim.registration.agreement import LandmarkAgreement, leave_one_out
from cmfsim.values.checks import Floats

# What the bending of the spline falls to if two exchanged names are exchanged back, as a share. On
# two real and fourteen synthetic heads no exchange of a correct set gave less than 1, and each of
# the 496 of a wrong one less than 0.8.
SWAPPED_ENERGY = 0.8
# Landmarks that are needed to look for exchanged names.
LEAST_NAMES = 8
# A shift is looked for this far along each axis, in steps of this, mm, and again about the best.
SHIFT_REACH, SHIFT_STEP, FINE_STEP = 12.0, 2.0, 0.5
# Distances count up to this, mm: a single landmark that is far off must not move the others.
MOST_DISTANCE = 6.0
# Mean distance below which there is no shift to look for, mm.
CLOSE = 0.5
# Landmarks that a shift is read from.
LEAST_POINTS = 6


@dataclass(frozen=True, eq=False)
class CommonShift:
    """A translation that brings landmarks onto their surface.

    Attributes
    ----------
    offset : (3,) float64, mm
        How far the landmarks are off: subtract it to bring them onto the surface.
    before, after : float, mm
        Mean distance from the surface, at most 6 mm each, as they are and without the offset.
    """

    offset: Floats
    before: float
    after: float

    @property
    def size(self) -> float:
        """Its length, mm."""
        return float(np.linalg.norm(self.offset))


def partner(name: str) -> str:
    """The name on the other side; of a landmark of the midline its own."""
    if name.endswith(("_L", "_R")):
        return name[:-1] + ("R" if name.endswith("_L") else "L")
    return name


def mirror_agreement(landmarks: Mapping[str, Floats]) -> LandmarkAgreement | None:
    """How far each landmark lies from where the mirror image of the whole set puts it.

    The set is compared with its own mirror image by the spline of all other landmarks, so that a
    face that is crooked as a whole agrees with itself and one misplaced landmark does not. The
    error shows at both landmarks of a pair. None where too few are left.
    """
    names = [name for name in landmarks if partner(name) in landmarks]
    if not names:
        return None
    own = np.array([landmarks[name] for name in names])
    mirrored = np.array([landmarks[partner(name)] for name in names]) * [-1.0, 1.0, 1.0]
    try:
        return leave_one_out(mirrored, own, names)
    except (LandmarkError, RegistrationError):
        return None


def swapped_names(
    landmarks: Mapping[str, Floats], reference: Mapping[str, Floats]
) -> tuple[str, str] | None:
    """The two names whose exchange makes the set most like the reference; None if none does.

    Measured by the bending energy of the thin-plate spline from the reference to the set.
    """
    names = [name for name in reference if name in landmarks]
    if len(names) < LEAST_NAMES:
        return None
    s = np.array([reference[name] for name in names])
    y = np.array([landmarks[name] for name in names])
    about = s - s.mean(axis=0)
    about = about / np.linalg.norm(about, axis=1).max()
    kernel = -np.linalg.norm(about[:, None] - about, axis=2)
    affine = np.column_stack([np.ones(len(s)), about])
    if np.linalg.matrix_rank(affine) < affine.shape[1]:
        return None
    null = np.linalg.qr(affine, mode="complete")[0][:, affine.shape[1] :]
    # The energy of targets y is y·G y.
    g = null @ np.linalg.solve(null.T @ kernel @ null, null.T)
    gy = g @ y
    energy = float((y * gy).sum())
    # Rounding alone is no bending.
    if energy <= np.finfo(np.float64).eps * len(s) * float((y**2).sum()):
        return None
    gap = y[None] - y[:, None]
    slope = np.einsum("ija,ija->ij", gap, gy[:, None] - gy[None])
    stiff = np.diag(g)[:, None] + np.diag(g)[None] - 2.0 * g
    change = 2.0 * slope + np.einsum("ija,ija->ij", gap, gap) * stiff
    i, j = np.unravel_index(np.argmin(change), change.shape)
    if energy + float(change[i, j]) >= SWAPPED_ENERGY * energy:
        return None
    return names[min(i, j)], names[max(i, j)]


def common_shift(
    points: Floats, distances: Callable[[Floats], Floats], found: Floats
) -> CommonShift | None:
    """The translation by which all points lie off a surface, or None where there is no telling.

    Parameters
    ----------
    points : (n, 3) float64, mm
    distances : callable
        The distance of each of (k, 3) points from the surface, mm.
    found : (n,) float64, mm
        That of the points as they are.

    Returns
    -------
    CommonShift or None
    """
    before = float(np.minimum(found, MOST_DISTANCE).mean())
    if len(points) < LEAST_POINTS or before < CLOSE:
        return None
    centre = np.zeros(3)
    best = before
    for reach, step in ((SHIFT_REACH, SHIFT_STEP), (SHIFT_STEP, FINE_STEP)):
        steps = np.arange(-reach, reach + 0.5 * step, step)
        offsets = centre + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(
            -1, 3
        )
        moved = (points[None] - offsets[:, None]).reshape(-1, 3)
        mean = np.minimum(distances(moved), MOST_DISTANCE).reshape(len(offsets), -1).mean(axis=1)
        # The smallest of equally good ones.
        order = np.lexsort((np.linalg.norm(offsets, axis=1), mean.round(6)))
        centre, best = offsets[order[0]], float(mean[order[0]])
    return CommonShift(centre, before, best)
