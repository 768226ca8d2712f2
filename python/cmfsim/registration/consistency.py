"""Whether landmarks agree with one another and their surface, and which one disagrees."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import ThinPlateSpline
from cmfsim.errors import LandmarkError, LandmarkInputError, RegistrationError
from cmfsim.values.checks import Floats, as_rows, frozen
from cmfsim.values.table import Table

# Landmarks of which four are left when one is taken away.
LEAST_LANDMARKS = 5
# Share of a landmark's place that the others' affine map must not need it for.
LEAST_FREEDOM = 1e-9
# Median of the length of a vector of three independent standard normal numbers.
NORMAL_LENGTH = 1.5382
# Score from which on a landmark stands out: 1 of 150 normal ones does.
OUTLIER_SCORE = 3.5
# A landmark of one head that the others' spline from another head misses by less than this, mm, or
# with a smaller score, may be where it should be: correct landmarks of two real heads are missed by
# up to 10.7 mm with a score of 4.1 (with 1 mm of noise 11.3 mm), those of synthetic heads by 5 mm
# with scores of 17.
MISPLACED_DISTANCE, MISPLACED_SCORE = 12.0, 4.0

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
class LandmarkAgreement:
    """The distance of each landmark from where the others place it.

    Attributes
    ----------
    names : tuple of str
    predicted : (n, 3) float64, mm
        Where the spline of all other landmarks takes the source landmark.
    distances : (n,) float64, mm
        From there to its target. A landmark far from the others is predicted less accurately,
        whether it is correct or not.
    scores : (n,) float64
        The distance relative to the distance expected from its position among the others, in robust
        standard deviations of this set: 3.5 and more is an outlier.
    """

    names: tuple[str, ...]
    predicted: Floats
    distances: Floats
    scores: Floats

    @property
    def ranking(self) -> tuple[str, ...]:
        """The names, the one that disagrees most first."""
        return tuple(self.names[i] for i in np.argsort(-self.scores, kind="stable"))

    @property
    def worst(self) -> str:
        """The landmark that disagrees most with the others."""
        return self.ranking[0]

    @property
    def outliers(self) -> tuple[str, ...]:
        """The outliers, worst first."""
        scores = dict(zip(self.names, self.scores, strict=True))
        return tuple(name for name in self.ranking if scores[name] >= OUTLIER_SCORE)

    @property
    def misplaced(self) -> tuple[str, ...]:
        """The outliers by more than the usual difference between heads, worst first.

        Correct landmarks of a real head differ from a template by up to 10 mm.
        """
        rows = {n: (d, s) for n, d, s in zip(self.names, self.distances, self.scores, strict=True)}
        return tuple(
            name
            for name in self.outliers
            if rows[name][0] >= MISPLACED_DISTANCE and rows[name][1] >= MISPLACED_SCORE
        )

    def table(self) -> str:
        """Name, distance and score of each landmark as lines, worst first."""
        rows = []
        for i in np.argsort(-self.scores, kind="stable"):
            distance, score = self.distances[i], self.scores[i]
            mark = "stands out" if score >= OUTLIER_SCORE else ""
            rows.append((self.names[i], f"{distance:.2f}", f"{score:.1f}", mark))
        return Table(("landmark", "distance mm", "score", ""), rows).text

    def __str__(self) -> str:
        """The table."""
        return self.table()


def leave_one_out(
    source: ArrayLike, target: ArrayLike, names: Sequence[str] | None = None
) -> LandmarkAgreement:
    """The distance of each landmark from where the thin-plate spline of the others places it.

    Parameters
    ----------
    source, target : (n, 3) array_like, mm
        Landmarks in the same order, at least five.
    names : sequence of str, optional
        Their names; numbers without.

    Raises
    ------
    RegistrationError, LandmarkError
        (also `ValueError`) Landmarks through which no spline passes; fewer than five landmarks; a
        landmark without which the others are in a plane; a wrong number of names, or a name twice.

    Notes
    -----
    With G the matrix that takes targets to spline weights, a = G y, the landmark k lies a_k / G_kk
    from the prediction of the others, and the expected size of that grows as G_kk^-1/2 (Dubrule
    1983, for kriging with the variogram |x − y|). The score is |a_k| G_kk^-1/2 over its median.

    Examples
    --------
    >>> import cmfsim
    >>> source = [[0, 0, 0], [9, 1, 0], [0, 9, 2], [1, 0, 9], [9, 9, 9], [5, 4, 3], [8, 1, 7]]
    >>> target = [[x + 0.1 * y * z, y, z] for x, y, z in source]
    >>> target[5][2] += 4
    >>> cmfsim.leave_one_out(source, target, list("abcdefg")).worst
    'f'
    """
    # The spline checks the points.
    spline = ThinPlateSpline(source, target)
    s, y = spline.source, spline.target
    n = len(s)
    labels = tuple(str(i) for i in range(n)) if names is None else tuple(names)
    if len(labels) != n or len(set(labels)) != n:
        raise LandmarkInputError(
            f"{len(labels)} names, {len(set(labels))} of them different, for {n} landmarks: give "
            "each landmark its own name"
        )
    if n < LEAST_LANDMARKS:
        raise LandmarkInputError(
            f"{n} landmarks: {LEAST_LANDMARKS} are needed to check each against the others"
        )
    about = s - s.mean(axis=0)
    about = about / np.linalg.norm(about, axis=1).max()
    kernel = -np.linalg.norm(about[:, None] - about, axis=2)
    q = np.linalg.qr(np.column_stack([np.ones(n), about]), mode="complete")[0]
    null = q[:, 4:]
    freedom = np.square(null).sum(axis=1)
    if freedom.min() < LEAST_FREEDOM:
        name = labels[int(np.argmin(freedom))]
        raise LandmarkInputError(
            f"without {name} the other {n - 1} landmarks are in one plane and cannot be used to "
            "check it: add more"
        )
    g = null @ np.linalg.solve(null.T @ kernel @ null, null.T)
    error = (g @ (y - y.mean(axis=0))) / np.diag(g)[:, None]
    distances = np.linalg.norm(error, axis=1)
    expected = 1.0 / np.sqrt(np.diag(g))
    scores = distances / expected
    typical = float(np.median(scores)) / NORMAL_LENGTH
    # Landmarks that an affine map carries exactly agree: rounding has no scores.
    rounding = np.finfo(np.float64).eps * float(np.abs(y).max()) * n
    scores = scores / typical if float(np.median(distances)) > rounding else np.zeros(n)
    return LandmarkAgreement(
        labels, frozen(as_rows("predicted", y - error, 3)), frozen(distances), frozen(scores)
    )


@dataclass(frozen=True, eq=False)
class CommonShift:
    """A translation that brings landmarks onto their surface.

    offset: (3,), mm. How far the landmarks are off: subtract it to bring them onto the surface.
    before, after: mm. Mean distance from the surface, at most 6 mm each, as they are and without
        the offset.
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

    points: (n, 3), mm.
    distances: The distance of each of (k, 3) points from the surface, mm.
    found: (n,), mm. That of the points as they are.
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
