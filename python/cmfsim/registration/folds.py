"""Where a warp turns tissue inside out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import ThinPlateSpline
from cmfsim.values.checks import Floats, as_rows


@dataclass(frozen=True, eq=False)
class FoldReport:
    """Where the Jacobian of a warp has a determinant of zero or less.

    Attributes
    ----------
    n_points, n_folded : int
        Points tested, and those where the warp folds.
    smallest : float or None
        Smallest determinant at the points: 1 keeps volumes, 0 and less folds; None without points.
    worst_point : (3,) float64, mm, or None
        Where it is.
    folded_landmarks : tuple of int
        Landmarks that the warp folds next to, by index: two that were swapped, or one misplaced.
    smallest_at_landmarks : float
        Smallest determinant on the approach to any landmark.
    """

    n_points: int
    n_folded: int
    smallest: float | None
    worst_point: Floats | None
    folded_landmarks: tuple[int, ...]
    smallest_at_landmarks: float

    @property
    def is_folded(self) -> bool:
        """Whether the warp folds at a point or next to a landmark."""
        return self.n_folded > 0 or bool(self.folded_landmarks)

    def __str__(self) -> str:
        """The report as a sentence."""
        if self.worst_point is None or self.smallest is None:
            text = "no points"
        else:
            place = ", ".join(f"{x:.1f}" for x in self.worst_point)
            text = (
                f"{self.n_folded} of {self.n_points} points folded, smallest determinant "
                f"{self.smallest:.3f} at ({place})"
            )
        near = len(self.folded_landmarks)
        return f"{text}; {near} landmarks with folds next to them"


def fold_report(warp: ThinPlateSpline, points: ArrayLike) -> FoldReport:
    """Where a warp folds, at points and next to its landmarks.

    Parameters
    ----------
    warp : ThinPlateSpline
    points : (k, 3) array_like, mm
        Before the warp, such as the vertices of the muscles to be mapped.

    Raises
    ------
    RegistrationError
        (also `ValueError`) A wrong shape, NaN or infinity.

    Examples
    --------
    >>> import cmfsim
    >>> corners = [[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9], [9, 9, 9], [4, 4, 4]]
    >>> warp = cmfsim.ThinPlateSpline(corners, [*corners[:5], [-9, -9, -9]])
    >>> report = cmfsim.fold_report(warp, [[2, 2, 2], [6, 6, 6]])
    >>> report.n_folded, report.worst_point.tolist()
    (1, [2.0, 2.0, 2.0])
    """
    folds, landmarks = warp.folds(points), warp.landmark_folds()
    worst = folds.worst
    return FoldReport(
        len(folds.determinants),
        folds.count,
        folds.smallest,
        None if worst is None else as_rows("points", points, 3)[worst],
        tuple(np.flatnonzero(landmarks.determinants <= 0.0).tolist()),
        float(landmarks.determinants.min()),
    )
