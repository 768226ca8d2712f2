"""Iterative closest points between arrays and surfaces, and a robust similarity of pairs."""

import math

import numpy as np
from numpy.typing import ArrayLike

from cmfsim import _core
from cmfsim._core import IcpFit, Surface
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData


def icp(  # noqa: PLR0913 (options by name)
    moving: ArrayLike | Surface | SurfaceData,
    fixed: ArrayLike | Surface | SurfaceData,
    *,
    initial: ArrayLike | None = None,
    trim: float = 0.0,
    method: str | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-9,
    max_distance: float | None = None,
    max_angle: float | None = None,
    keep_border: bool = False,
) -> IcpFit:
    """The rigid motion that brings points closest to a surface or to other points.

    Parameters
    ----------
    moving : (n, 3) array_like, Surface or SurfaceData, mm
        Of a surface, its vertices, all with equal weight.
    fixed : (k, 3) array_like, Surface or SurfaceData, mm
    initial : (4, 4) array_like, optional
        Rigid motion to begin with; `matrix` includes it.
    trim : float
        Share of the pairs, those farthest apart, that each step excludes: 0 to below 1. Choose
        slightly more than the share of points without a partner.
    method : str, optional
        "plane" steps to tangent planes and needs a surface; "point" steps to the closest points.
        Without it, "plane" for a surface and "point" for points.
    max_iterations : int
    tolerance : float
        The iteration has converged when a step moves no point by more than this share of their
        radius. 0: exactly `max_iterations` steps.
    max_distance : float, optional, mm
        Pairs farther apart are excluded.
    max_angle : float, optional, degrees
        Pairs of surfaces whose normals differ by more are excluded.
    keep_border : bool
        Whether pairs on the border of an open surface count. Where the moving points extend past
        the border, their closest points on it are not their partners.

    Returns
    -------
    IcpFit
        `matrix` (4, 4), `rms` (mm, of the pairs that count), `iterations`, `converged`,
        `kept` (n,), `kept_fraction`, `distances` (n,), `rms_history`.

    Raises
    ------
    RegistrationError
        Not converged after `max_iterations`, with `rms_history`; too few pairs left; a motion that
        the surface leaves open; as `ValueError` too: points in one line, options out of range.

    Notes
    -----
    Besl & McKay (1992), with trimming (Chetverikov et al. 2002) and steps to tangent planes (Chen &
    Medioni 1992); one that increases the distances is replaced by a step to the points. It finds
    the nearest solution, so start within about 20 mm and 10°.

    Examples
    --------
    >>> import cmfsim
    >>> corner = [[0, 0, 0], [30, 0, 0], [0, 20, 0], [0, 0, 10]]
    >>> fixed = cmfsim.Surface(corner, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> points = [[5, 5, 0], [9, 3, 0], [4, 0, 3], [9, 0, 2], [0, 4, 3], [0, 8, 2]]
    >>> fit = cmfsim.icp([[x + 0.5, y, z - 0.3] for x, y, z in points], fixed)
    >>> fit.matrix[:3, 3].round(6).tolist()
    [-0.5, 0.0, 0.3]
    """
    fixed = _surface(fixed)
    moving = _surface(moving)
    normals = None
    if isinstance(moving, Surface):
        normals = moving.vertex_normals if max_angle is not None else None
        moving = moving.vertices
    return _core.icp(
        moving,
        fixed,
        initial=initial,
        trim=trim,
        method=method,
        max_iterations=max_iterations,
        tolerance=tolerance,
        max_distance=max_distance,
        max_angle=None if max_angle is None else math.radians(max_angle),
        keep_border=keep_border,
        normals=normals,
    )


def _surface(value: ArrayLike | Surface | SurfaceData) -> ArrayLike | Surface:
    if isinstance(value, SurfaceData):
        return Surface(value.vertices, value.triangles, crease_angle=value.crease_angle)
    return value


# Rounds of weights.
ROUNDS = 30


def robust_similarity(
    source: Floats, target: Floats, weight: Floats, half_distance: float, rounds: int = ROUNDS
) -> tuple[Floats, Floats, float]:
    """Linear part (3, 3), offset (3,) and scale of the best similarity (Umeyama 1991).

    Unlike `rigid_fit`, it gives outliers little weight, and fits points in a line by any of the
    similarities that fit them alike.

    source, target: (n, 3), mm.
    weight: (n,), of each pair where it fits.
    half_distance: mm. The distance at which a pair counts half.
    """
    own = weight
    linear, offset, scale = np.eye(3), np.zeros(3), 1.0
    for _ in range(rounds):
        share = own / own.sum()
        a, b = share @ source, share @ target
        u, s, vt = np.linalg.svd((source - a).T @ ((target - b) * share[:, None]))
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
        scale = float((s * signs).sum() / (share @ ((source - a) ** 2).sum(axis=1)))
        linear = scale * vt.T @ np.diag(signs) @ u.T
        offset = b - linear @ a
        gap = np.linalg.norm(source @ linear.T + offset - target, axis=1)
        own = weight / (1.0 + (gap / half_distance) ** 2)
    return linear, offset, scale
