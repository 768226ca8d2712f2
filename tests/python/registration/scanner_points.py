"""Landmarks where a head lies in a scanner, and points moved and compared."""

import numpy as np

# Where a head lies in a scanner, mm.
OFFSET = np.array([0.0, -150.0, 1500.0])


def random_landmarks(n=32, *, seed=0, bend=5.0):
    rng = np.random.default_rng(seed)
    source = rng.uniform(-80, 80, (n, 3)) + OFFSET
    return source, source + rng.normal(0, bend, (n, 3))


def moved(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def gap(a, b):
    return float(np.linalg.norm(a - b, axis=1).max())
