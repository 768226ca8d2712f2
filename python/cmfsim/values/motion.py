"""Bone plans: rigid motions from the numbers that a planner writes down, and back again."""

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import rigid_matrix as rigid_matrix  # noqa: PLC0414 (passed on)
from cmfsim.errors import BoundaryInputError, CaseInputError
from cmfsim.values.checks import as_unmasked
from cmfsim.values.surface_data import MovedSurface

# Entries of motions are distinguished to a millionth, mm or of a rotation.
DIGITS = 1e6


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """A rigid motion as used in plans: x ↦ R (x − centre) + centre + translation.

    Attributes
    ----------
    translation : (3,) float64, mm
    angle : float, degrees
        Turn about `axis` by the right-hand rule, from 0 to 180.
    axis : (3,) float64
        Unit vector; (1, 0, 0) where the motion does not turn.
    centre : (3,) float64, mm
    """

    translation: NDArray[np.float64]
    angle: float
    axis: NDArray[np.float64]
    centre: NDArray[np.float64]


def rigid_motion(
    translation: ArrayLike = (0.0, 0.0, 0.0),
    angle: float = 0.0,
    axis: ArrayLike = (1.0, 0.0, 0.0),
    centre: ArrayLike = (0.0, 0.0, 0.0),
) -> NDArray[np.float64]:
    """The matrix of a turn about an axis through a centre, followed by a translation.

    Parameters
    ----------
    translation : (3,) float64, mm
    angle : float, degrees
        By the right-hand rule: with `axis` towards you, a positive angle turns anticlockwise.
    axis : (3,) float64
        Any length but zero.
    centre : (3,) float64, mm
        The point that the turn leaves in place.

    Returns
    -------
    (4, 4) float64
        Homogeneous matrix, mm: x ↦ R (x − centre) + centre + translation.

    Raises
    ------
    BoundaryError
        (also `ValueError`) A zero axis, a wrong shape, NaN or infinity.

    Notes
    -----
    Rodrigues (1840): R = I + sin θ [k]× + (1 − cos θ) [k]×². Relocations are given like this in
    Table 2 of Kim et al. (2010). Quarter turns are exact: no cos 90° = 6e-17 is left over.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.rigid_motion(translation=(0, -5, 0), angle=90, axis=(0, 0, 2))
    >>> (motion @ [1, 0, 0, 1]).tolist()
    [0.0, -4.0, 0.0, 1.0]
    """
    t = _three("translation", translation)
    k = _three("axis", axis)
    c = _three("centre", centre)
    theta = _finite("angle", angle)
    # The largest component first: a length below 1e-154 would underflow when squared.
    largest = float(np.abs(k).max())
    if largest == 0.0:
        raise BoundaryInputError(
            "axis is (0, 0, 0): give the direction of the axis; any length above 0 is allowed"
        )
    k = k / largest
    k = k / math.sqrt(float(k @ k))
    sine, cosine = _sine_cosine(theta)
    # [k]×, for which [k]× v = k × v.
    cross = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
    rotation = np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    with np.errstate(over="ignore", invalid="ignore"):
        matrix[:3, 3] = c + t - rotation @ c
    if not np.isfinite(matrix).all():
        raise BoundaryInputError(
            f"translation {t.tolist()} about centre {c.tolist()} overflows: give both in mm"
        )
    return matrix


def carried(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where a motion takes points: (n, 3) mm."""
    moved: NDArray[np.float64] = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def decompose_motion(matrix: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> RigidMotion:
    """The translation, angle and axis of a rigid motion about a centre: inverse of `rigid_motion`.

    Parameters
    ----------
    matrix : (4, 4) float64, mm
        A rotation with a translation; no scale, shear or mirror. The result of `rigid_matrix` is
        decomposed.
    centre : (3,) float64, mm
        The centre of the rotation. It affects the translation, not the angle.

    Raises
    ------
    BoundaryError
        (also `ValueError`) What `rigid_matrix` refuses: not a (4, 4) matrix, not finite, last row
        other than (0, 0, 0, 1), or not a rotation. A centre that is not three finite numbers.

    Notes
    -----
    The axis comes from the antisymmetric part of R, near a half turn from its symmetric part, where
    the former vanishes. A half turn is the same about k and −k; the sign with the first non-zero
    component positive is returned.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.decompose_motion(cmfsim.rigid_motion((1, 2, 3), 10, (0, 0, 1)))
    >>> round(motion.angle, 9), motion.translation.tolist()
    (10.0, [1.0, 2.0, 3.0])
    """
    m = rigid_matrix(matrix)
    c = _three("centre", centre)
    rotation = m[:3, :3]
    # Vector (R − Rᵀ)∨ = 2 sin θ k and trace = 1 + 2 cos θ.
    twice_sine_axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    twice_sine = float(np.linalg.norm(twice_sine_axis))
    twice_cosine = float(np.trace(rotation)) - 1.0
    theta = math.atan2(twice_sine, twice_cosine)
    if theta == 0.0:
        axis = np.array([1.0, 0.0, 0.0])
    elif twice_cosine >= 0.0:
        # Scaled by its largest entry first: squares of angles below 1e-154 would lose their digits.
        axis = twice_sine_axis / np.abs(twice_sine_axis).max()
        axis = axis / float(np.linalg.norm(axis))
    else:
        # R + Rᵀ − 2 cos θ I = 2 (1 − cos θ) k⊗k: its longest column is along k.
        outer = rotation + rotation.T - twice_cosine * np.eye(3)
        column = outer[:, int(np.argmax(np.diagonal(outer)))]
        axis = column / float(np.linalg.norm(column))
        along = float(axis @ twice_sine_axis)
        if along == 0.0:
            along = float(axis[np.flatnonzero(axis)[0]])
        axis = math.copysign(1.0, along) * axis
    translation = m[:3, 3] - c + rotation @ c
    return RigidMotion(translation, math.degrees(theta), axis, c)


def _three(name: str, value: ArrayLike) -> NDArray[np.float64]:
    try:
        vector = as_unmasked(name, value).astype(np.float64)
    except CaseInputError as error:
        raise BoundaryInputError(str(error)) from error
    except (TypeError, ValueError) as error:
        raise BoundaryInputError(f"{name} is not three numbers: {value!r}") from error
    except OverflowError as error:
        raise BoundaryInputError(f"{name} holds a number of more than 308 digits") from error
    if vector.shape != (3,):
        raise BoundaryInputError(f"{name} has shape {vector.shape}: three numbers are needed")
    for index, entry in enumerate(vector):
        if not math.isfinite(entry):
            raise BoundaryInputError(f"{name}[{index}] is {entry}: must be finite")
    return vector


def _finite(name: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise BoundaryInputError(f"{name} is not a number: {value!r}") from error
    except OverflowError as error:
        raise BoundaryInputError(f"{name} is a number of more than 308 digits") from error
    if not math.isfinite(number):
        raise BoundaryInputError(f"{name} is {number}: must be finite")
    return number


def _sine_cosine(degrees: float) -> tuple[float, float]:
    """Sine and cosine of an angle in degrees, exact at quarter turns."""
    # Reduced in degrees, where 360 is exact, to −45…45 and a count of quarter turns.
    quarters = round(math.remainder(degrees, 360.0) / 90.0)
    rest = math.radians(math.remainder(degrees, 360.0) - 90.0 * quarters)
    sine, cosine = math.sin(rest), math.cos(rest)
    for _ in range(quarters % 4):
        sine, cosine = cosine, -sine
    return sine, cosine


def plan_digits(motions: Mapping[str, NDArray[np.float64] | MovedSurface]) -> str:
    """Eight hexadecimal digits that plans of other motions do not share; what stays does not count.

    The planning page writes the same digits into the plans that it saves.
    motions: By segment: (4, 4), mm; or the motion of its vertices, (n, 3) or a surface.
    """
    texts = []
    for name, motion in motions.items():
        if isinstance(motion, MovedSurface):
            parts = motion.moved_vertices - motion.surface.vertices
        else:
            parts = motion - np.eye(4) if motion.shape == (4, 4) else motion
        numbers = np.floor(parts.ravel() * DIGITS + 0.5).astype(np.int64)
        if numbers.any():
            texts.append(f"{name}:{','.join(map(str, numbers.tolist()))}")
    return f"{zlib.crc32(chr(10).join(sorted(texts)).encode()):08x}"
