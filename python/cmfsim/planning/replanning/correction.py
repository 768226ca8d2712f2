"""A correction of the plan operator away from its reference, interpolated from exact solutions.

The operator continues contact to first order. What it misses, e(x), vanishes at the reference
together with its gradient. It is interpolated between plans that were solved exactly as a Gaussian
process of which that is known: with the covariance m(|x − y|) of Matérn 5/2, whose paths are as
rough as lips that slip over the edges of teeth, a process that vanishes with its gradient at 0 has

    k(x, y) = m(|x − y|) − m(|x|) m(|y|) − (5/3) (x·y) n(|x|) n(|y|),
    m(r) = (1 + √5 r + 5/3 r²) exp(−√5 r),    n(r) = (1 + √5 r) exp(−√5 r)

in multiples of a length ℓ (Rasmussen and Williams 2006, sections 4.2 and 9.4), here summed over the
segments, each by itself, and all of them together. x has six numbers for each segment: the shift of
its centre, mm, and the rotation times an arm, mm. Far away k tends to 0, and so does the
correction. Length ℓ and noise are those with the least error in cross-validation.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.values.checks import Floats

# Lengths ℓ, mm, and noise as a share of the variance, among which plans that are left out choose.
LENGTHS = (10.0, 14.0, 20.0, 30.0)
NOISES = (1e-3, 1e-2, 1e-1)
# A rotation counts by the path of a point at this share of the distance of the furthest corner.
ARM_SHARE = 0.6
# Shapes of the correction: as few as retain this share of the corrections, and at most this many.
KEPT_ENERGY, MOST_SHAPES = 0.99, 16
# A correction is used if, at plans that were left out, the largest error falls to this share.
PAYS = 0.9
# Below this, twice the sine of an angle equals twice the angle.
SMALL_SINE = 1e-9


@dataclass(frozen=True, eq=False)
class PlanNumbers:
    """The numbers of a plan that a correction depends on.

    segments: Those that count; the motion of others changes nothing.
    backwards: (s, 4, 4), mm. The inverse of each segment's motion under the reference plan.
    middles, arms: (s, 3) and (s,), mm. Each middle before, and what multiplies rotations, radians.
    """

    segments: tuple[str, ...]
    backwards: Floats
    middles: Floats
    arms: Floats

    @classmethod
    def about(cls, reference: Mapping[str, Floats], boxes: Mapping[str, Floats]) -> "PlanNumbers":
        """The numbers of the segments in `boxes`, (8, 3) mm each, away from a reference plan."""
        middles = np.array([corners.mean(axis=0) for corners in boxes.values()])
        reach = [
            np.linalg.norm(corners - middle, axis=1).max()
            for corners, middle in zip(boxes.values(), middles, strict=True)
        ]
        backwards = np.array([np.linalg.inv(reference[name]) for name in boxes])
        return cls(tuple(boxes), backwards, middles, ARM_SHARE * np.array(reach))

    def of(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The numbers of a plan, (s, 6) mm: shift of the middle, and turn times the arm."""
        rows = []
        for name, back, middle, arm in zip(
            self.segments, self.backwards, self.middles, self.arms, strict=True
        ):
            apart = back @ np.asarray(plan[name], dtype=np.float64)
            shift = apart[:3, :3] @ middle + apart[:3, 3] - middle
            rows.append(np.concatenate([shift, arm * _turn(apart)]))
        return np.array(rows)


@dataclass(frozen=True, eq=False)
class PlanCorrection:
    """A sum of shapes whose amounts depend smoothly on the plan; zero at the reference.

    Attributes
    ----------
    numbers : PlanNumbers
    length : float, mm
        ℓ, over which the correction varies.
    plans : (n, s, 6) float64, mm
        The numbers of the plans that were solved exactly.
    weights : (n, m) float64
        Of k(x, plan) in the amount of each shape.
    shapes : (k, 3, m) float64, mm
        Displacements of the operator's nodes, their largest component 1.
    before, left_out : (n,) float64, mm
        The largest error at each plan, without the correction and with the one fitted to all other
        plans.
    left_out_mean : (n,) float64, mm
        The mean error at each plan with the correction fitted to all other plans.
    distances : (n,) float64, mm
        Of each plan from the reference, as `plan_distance`.
    """

    numbers: PlanNumbers
    length: float
    plans: Floats
    weights: Floats
    shapes: Floats
    before: Floats
    left_out: Floats
    left_out_mean: Floats
    distances: Floats

    def amounts(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The amount of each shape under a plan, (m,)."""
        here = self.numbers.of(plan)[None]
        left: Floats = (_covariance(here, self.plans, self.length) @ self.weights)[0]
        return left

    def displacements(self, plan: Mapping[str, ArrayLike]) -> Floats:
        """The correction of the operator's displacements under a plan, (k, 3) mm."""
        return self.shapes @ self.amounts(plan)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON: how many plans and shapes, and errors at these plans."""
        return {
            "plans": len(self.plans),
            "shapes": self.weights.shape[1],
            "length_mm": self.length,
            "largest_before_mm": self.before.tolist(),
            "largest_left_out_mm": self.left_out.tolist(),
        }

    def at(self, nodes: NDArray[np.integer]) -> "PlanCorrection":
        """The correction restricted to some nodes, by their positions in the operator."""
        return replace(self, shapes=self.shapes[nodes])


def fitted_correction(
    numbers: PlanNumbers, plans: Floats, distances: Floats, errors: Floats
) -> tuple[PlanCorrection, bool]:
    """The correction that interpolates errors of the operator, and whether it pays.

    plans: (n, s, 6), mm. Their values at plans that were solved exactly; at least two.
    distances: (n,), mm, of these plans from the reference.
    errors: (n, k, 3), mm. Exact displacements minus the operator's.
    It pays if the largest error at plans that are left out falls to `PAYS`, RMS over the plans.
    """
    count, nodes, _ = errors.shape
    rows = errors.reshape(count, -1)
    gram = rows @ rows.T
    length, noise = min(
        ((length, noise) for length in LENGTHS for noise in NOISES),
        key=lambda choice: _left_out_energy(plans, gram, *choice),
    )
    inverse = _inverse(plans, length, noise)
    # Each plan's error with the interpolation of all others (Rasmussen and Williams 2006, 5.12).
    apart = inverse / np.diagonal(inverse)[:, None]
    left_out = np.linalg.norm((apart @ rows).reshape(errors.shape), axis=2)
    before = np.linalg.norm(errors, axis=2).max(axis=1)
    energy, vectors = np.linalg.eigh(gram)
    energy, vectors = energy[::-1].clip(min=0.0), vectors[:, ::-1]
    total = max(float(energy.sum()), np.finfo(np.float64).tiny)
    kept = int(np.searchsorted(np.cumsum(energy) / total, KEPT_ENERGY)) + 1
    vectors = vectors[:, : min(kept, MOST_SHAPES)]
    shapes = rows.T @ vectors
    largest = np.maximum(np.abs(shapes).max(axis=0), np.finfo(np.float64).tiny)
    correction = PlanCorrection(
        numbers,
        length,
        plans,
        inverse @ vectors * largest,
        (shapes / largest).reshape(nodes, 3, -1),
        before,
        left_out.max(axis=1),
        left_out.mean(axis=1),
        distances,
    )
    pays = float((correction.left_out**2).sum()) < PAYS**2 * float((before**2).sum())
    return correction, pays


def _turn(motion: Floats) -> Floats:
    """The rotation vector of a motion, (3,) radians: (R − Rᵀ)∨ is twice its sine along the axis."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = motion[:3, :3].tolist()
    twice = np.array([zy - yz, xz - zx, yx - xy])
    sine = math.hypot(*twice)
    angle = math.atan2(sine, float(np.trace(motion[:3, :3])) - 1.0)
    # A half turn has no such axis; it is far beyond the plans near which the correction acts.
    return twice * (angle / sine if sine > SMALL_SINE else 0.5)


def _covariance(a: Floats, b: Floats, length: float) -> Floats:
    """The covariance k of plans (n, s, 6) and (m, s, 6): of each segment, and of all together."""
    whole = (a.reshape(len(a), 1, -1), b.reshape(len(b), 1, -1))
    pairs = [whole, *((a[:, s : s + 1], b[:, s : s + 1]) for s in range(a.shape[1]))]
    total = np.zeros((len(a), len(b)))
    for here, there in pairs:
        x, y = here[:, 0] / length, there[:, 0] / length
        inner = x @ y.T
        one, other = (x * x).sum(axis=1)[:, None], (y * y).sum(axis=1)
        (m_x, n_x), (m_y, n_y) = _matern(one), _matern(other)
        apart, _ = _matern((one + other - 2.0 * inner).clip(min=0.0))
        total += apart - m_x * m_y - 5.0 / 3.0 * inner * n_x * n_y
    return total


def _matern(square: Floats) -> tuple[Floats, Floats]:
    """The functions m and n of a squared distance, in multiples of the length."""
    root = np.sqrt(5.0 * square)
    slope = (1.0 + root) * np.exp(-root)
    return slope + 5.0 / 3.0 * square * np.exp(-root), slope


def _inverse(plans: Floats, length: float, noise: float) -> Floats:
    covariance = _covariance(plans, plans, length)
    scale = float(np.diagonal(covariance).mean())
    inverse = np.linalg.inv(covariance + noise * scale * np.eye(len(plans)))
    return np.asarray(inverse, dtype=np.float64)


def _left_out_energy(plans: Floats, gram: Floats, length: float, noise: float) -> float:
    """The sum of squared errors at all plans, each with the interpolation of all others."""
    inverse = _inverse(plans, length, noise)
    apart = inverse / np.diagonal(inverse)[:, None]
    return float(np.einsum("ij,jk,ik->", apart, gram, apart))
