"""The similarity between paired points of which some do not belong."""

import numpy as np

from cmfsim.values.checks import Floats

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
