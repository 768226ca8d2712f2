"""The pose of a head from many starts: a similarity of bone and skin to the average head."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import third_party
from cmfsim.registration.proposed.shape_model.model import SKIN, HeadModel
from cmfsim.registration.proposed.shape_model.samples import HeadSamples
from cmfsim.registration.proposed.shape_model.state import (
    N_JAW,
    N_POSE,
    POSE_UNITS,
    State,
    rotation_of,
    similarity_step,
)
from cmfsim.values.checks import Floats

# Normals at a right angle count as this far apart times √2, mm of the average head.
NORMAL_REACH = 14.0

# Heads are offered nodding, leaning and turned by this much, degrees, in these sizes, and, where
# the image ends above, with so much missing there, mm.
TURNS = (-28.0, 0.0, 28.0)
SIZES = (0.72, 0.88, 1.08)
MISSING_ABOVE = (0.0, 45.0, 90.0)
# Standard deviation of the size of a head as a logarithm: adults differ by 0.05, and a child of
# four is at −0.2.
SIZE_DEVIATION = 0.1
# Distances count up to this, mm: in the first round, by how much less in each, and in the last.
FIRST_CAP, SHRINK, LAST_CAP = 25.0, 0.8, 8.0
# Points of bone and skin, rounds, and how many starts are kept, in turn.
STAGES = ((150, 5, 30), (300, 14, 3))
# Threads of a look-up.
WORKERS = 2
# Damping of a step, and weight of a usual size, as shares of the points.
DAMPING, SIZE_WEIGHT = 0.02, 0.002


class Finder:
    """Looks up the nearest of a set of points with normals."""

    def __init__(self, points: Floats, normals: Floats) -> None:
        spatial = third_party("scipy.spatial", "landmarks are found", "imaging")
        self.points, self.normals = points, normals
        self._tree: Any = spatial.cKDTree(_joined(points, normals))

    def nearest(self, points: Floats, normals: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Distance, with that of the normals, and index, both of the leading shape of points."""
        gaps, index = self._tree.query(_joined(points, normals).reshape(-1, 6), workers=WORKERS)
        return gaps.reshape(points.shape[:-1]), index.reshape(points.shape[:-1])


def _joined(points: Floats, normals: Floats) -> Floats:
    return np.concatenate([points, NORMAL_REACH * normals], axis=-1)


def pose_columns(goal: Floats, moved: Floats, normals: Floats) -> Floats:
    """Derivatives of n·(x − goal), over the scale, by a small similarity of x, in lengths.

    Divided by the scale, distances count in the patient's mm: else a patient who shrinks to a point
    would lie near everything.
    """
    grow = (normals * goal).sum(axis=-1, keepdims=True)
    columns = np.concatenate([grow, np.cross(moved, normals), normals], axis=-1)
    lengths: Floats = columns / POSE_UNITS
    return lengths


@dataclass(frozen=True, eq=False)
class Start:
    """A similarity and how well it fits: the mean capped distance in the patient's mm."""

    linear: Floats
    offset: Floats
    score: float = np.inf

    def state(self, model: HeadModel) -> State:
        """It with the average shape and the mouth closed."""
        return State(self.linear, self.offset, np.zeros(N_JAW), np.zeros(model.n_modes))


def found_poses(
    model: HeadModel,
    samples: HeadSamples,
    turn: Floats | None = None,
    stages: Sequence[tuple[int, int, int]] = STAGES,
) -> list[Start]:
    """The best similarities, best first.

    Parameters
    ----------
    model : HeadModel
    samples : HeadSamples
    turn : (3, 3) float64, optional
        What comes first: how an image lies whose axes are wrong.
    stages : sequence of (int, int, int)
        Points, rounds and starts that are kept.
    """
    starts = list(_starts(model, samples, np.eye(3) if turn is None else turn))
    for count, rounds, kept in stages:
        starts = _descended(model, samples.fewer(count), starts, rounds)[:kept]
    return starts


def _starts(model: HeadModel, samples: HeadSamples, upright: Floats) -> Iterator[Start]:
    """Similarities that bring the front onto the front and the top onto the top."""
    points = samples.skin if len(samples.skin) else samples.bone
    own = model.points[(model.parts == SKIN) == bool(len(samples.skin))]
    front, top = np.quantile(own[:, 1], 0.02), own[:, 2].max()
    above = MISSING_ABOVE if samples.ends_above else MISSING_ABOVE[:1]
    for nod, lean, turn in product(np.radians(TURNS), repeat=3):
        rotation = rotation_of(np.array([nod, 0.0, 0.0])) @ rotation_of(np.array([0.0, lean, 0.0]))
        rotation = rotation @ rotation_of(np.array([0.0, 0.0, turn])) @ upright
        turned = points @ rotation.T
        for size, missing in product(SIZES, above):
            x, y, z = turned.T / size
            offset = np.array(
                [-np.median(x), front - np.quantile(y, 0.02), top - missing - np.quantile(z, 0.99)]
            )
            yield Start(rotation / size, offset)


@dataclass(eq=False)
class _Step:
    """The sums of a step of many similarities."""

    matrix: Floats
    right: Floats
    score: Floats


def _descended(
    model: HeadModel, samples: HeadSamples, starts: Sequence[Start], rounds: int
) -> list[Start]:
    """The starts after steps to tangent planes, all at once, best first."""
    groups = [
        (points, normals, Finder(model.points[own], model.normals[own]))
        for points, normals, own in (
            (samples.bone, samples.bone_normals, model.parts != SKIN),
            (samples.skin, samples.skin_normals, model.parts == SKIN),
        )
        if len(points)
    ]
    count = sum(len(points) for points, _, _ in groups)
    linear = np.array([start.linear for start in starts])
    offset = np.array([start.offset for start in starts])
    for k in range(rounds):
        cap = max(LAST_CAP, FIRST_CAP * SHRINK**k)
        # A mirrored similarity has a negative determinant.
        scale = np.cbrt(np.abs(np.linalg.det(linear)))
        total = _Step(
            np.tile(DAMPING * count * np.eye(N_POSE), (len(linear), 1, 1)),
            np.zeros((len(linear), N_POSE)),
            np.zeros(len(linear)),
        )
        total.matrix[:, 0, 0] += SIZE_WEIGHT * count
        total.right[:, 0] -= SIZE_WEIGHT * count * np.log(scale) * POSE_UNITS[0]
        for points, normals, finder in groups:
            _add(total, (points, normals), finder, (linear, offset, scale), cap)
        if k == rounds - 1:
            break
        steps = np.linalg.solve(total.matrix, total.right[..., None])[..., 0] / POSE_UNITS
        for s, step in enumerate(steps):
            grow, move = similarity_step(step)
            linear[s], offset[s] = grow @ linear[s], grow @ offset[s] + move
    fits = [Start(*of) for of in zip(linear, offset, total.score.tolist(), strict=True)]
    return sorted(fits, key=lambda fit: fit.score)


def _add(
    total: _Step,
    samples: tuple[Floats, Floats],
    finder: Finder,
    similarity: tuple[Floats, Floats, Floats],
    cap: float,
) -> None:
    """Adds what one surface says to the sums."""
    (points, normals), (linear, offset, scale) = samples, similarity
    moved = np.einsum("sij,nj->sni", linear, points) + offset[:, None]
    turned = np.einsum("sij,nj->sni", linear, normals) / scale[:, None, None]
    gaps, index = finder.nearest(moved, turned)
    # Capped in the patient's size: a cap in the model's would favour small patients.
    total.score += np.minimum(gaps / scale[:, None], cap).mean(axis=1)
    weight = 1.0 / (1.0 + (gaps / (0.4 * cap)) ** 2) ** 2
    goal, n = finder.points[index], finder.normals[index]
    columns = pose_columns(goal, moved, n)
    distance = (n * (goal - moved)).sum(axis=2)
    weighted = columns * weight[..., None]
    total.matrix += np.matmul(weighted.transpose(0, 2, 1), columns)
    total.right += np.matmul(weighted.transpose(0, 2, 1), distance[..., None])[..., 0]
