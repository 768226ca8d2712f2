"""The motion of a bone by its shape alone: robust steps to tangent planes, with a change of size.

Only distances along the normals of the post-operative bone count, so vertices of a fitted template
that slid along the surface do not rotate the result.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface
from cmfsim.errors import RegistrationInputError
from cmfsim.values.checks import Floats, Frozen, Plain, frozen, in_files
from cmfsim.values.motion import carried, rigid_motion
from cmfsim.values.surface_data import SurfaceData, vertex_areas

# Tukey's constant, with which the biweight is 95 % as efficient as least squares on normal noise,
# and what makes the median of absolute values a standard deviation (Huber 1981).
TUKEY, TO_SIGMA = 4.685, 1.4826
# The least standard deviation that weights are made with, mm: the best surfaces of scans. Below it,
# the triangles of clean surfaces would separate sound vertices from one another.
LEAST_SIGMA = 0.1
# Points of a fit: 0.3 mm of noise then leaves an error of 0.003 mm in a shift.
MOST_POINTS = 20000
# The fit has converged when a step moves the points by less than this, mm (rms), a thousandth of
# the stated accuracy; below it, noise swaps partners.
REST, MOST_STEPS = 1e-4, 100
# A direction is open if its eigenvalue is below this share of the largest: an error of the surface
# is then ten times as large in it as in the best direction. A noisy ball reaches 0.007.
OPEN = 0.01
# Blocks of the jackknife, a power of two, and Student's t of 31 degrees of freedom (95 %).
BLOCKS, STUDENT = 32, 2.04
# Accuracy of the surface of a bone as a whole, mm: thresholds and triangles of two scans shift all
# of it in or out, which no block shows. 0.1 mm is a third of a small voxel.
ALL_ROUND = 0.1
# Pairs that the fit needs: seven unknowns with room to tell a sound one.
LEAST_PAIRS = 50
# Ratios of size possible for one bone in two scans. Beyond them, the unit or the bone differs.
LEAST_SIZE, MOST_SIZE = 0.85, 1.15


@dataclass(frozen=True, eq=False)
class OpenDirection(Frozen):
    """A motion of a bone that its shape hardly determines, such as the rotation of a ball.

    turn, shift: (3,). The turn about the bone's middle, times its radius, and the shift; together
        of unit length.
    ratio: Of the eigenvalues of the normal equations, to the direction that is determined best.
    """

    turn: Floats
    shift: Floats
    ratio: float

    @property
    def is_turn(self) -> bool:
        """Whether it is more a turn than a shift."""
        return bool(np.linalg.norm(self.turn) >= np.linalg.norm(self.shift))

    @property
    def axis(self) -> Floats:
        """Unit vector of the turn's axis, or of the shift."""
        main = self.turn if self.is_turn else self.shift
        return main / np.linalg.norm(main)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as JSON holds them."""
        return {
            "kind": "turn" if self.is_turn else "shift",
            "axis": self.axis.tolist(),
            "eigenvalue_ratio": self.ratio,
        }


@dataclass(frozen=True, eq=False)
class ShapeFit(Plain, Frozen):
    """The registration of a bone to the post-operative bone, by shape.

    matrix: (4, 4), mm. The rigid motion; a change of size, `scale`, is about the `middle` of the
        vertices before, which it does not move further.
    scale_interval: 95 %: block jackknife, and a surface that is known to 0.1 mm all round.
    eigenvalue_ratio: Of the normal equations of the rigid motion: smallest to largest.
    open: What the shape does not determine; in these directions the motion is that of the start.
    sigma: mm. Standard deviation of the distances along normals, robust.
    off: (n,), mm. Distance of each vertex, moved and scaled, from the bone after.
    kept: (n,) bool. Vertices that count: near enough, on bone with a similar normal.
    """

    matrix: Floats = field(metadata=in_files(None))
    scale: float
    scale_interval: tuple[float, float]
    eigenvalue_ratio: float
    open: tuple[OpenDirection, ...]
    sigma: float = field(metadata=in_files("sigma_mm"))
    off: Floats = field(metadata=in_files(None))
    kept: NDArray[np.bool_] = field(metadata=in_files(None))
    middle: Floats = field(metadata=in_files(None))

    @property
    def image(self) -> Floats:
        """Where the rigid motion takes the middle, (3,) mm."""
        return self.matrix[:3, :3] @ self.middle + self.matrix[:3, 3]

    @property
    def similarity(self) -> Floats:
        """The motion with the change of size, (4, 4) mm."""
        found = self.matrix.copy()
        found[:3, :3] *= self.scale
        found[:3, 3] += (1.0 - self.scale) * (self.matrix[:3, :3] @ self.middle)
        return found

    def carried(self, points: Floats) -> Floats:
        """Where the motion takes points, with the change of size, (n, 3) mm."""
        return carried(self.similarity, points)

    @property
    def rms(self) -> float:
        """Of the distances of the vertices that count, mm."""
        return float(np.sqrt((self.off[self.kept] ** 2).mean())) if self.kept.any() else np.inf


def fit_shape(
    segment: SurfaceData,
    bone: Surface,
    start: Floats,
    *,
    max_angle: float = 60.0,
    most_points: int = MOST_POINTS,
) -> ShapeFit:
    """The motion that registers a segment to the post-operative bone, by the shape of both.

    start: (4, 4), mm. Rigid motion to start from, kept where the shape determines none.
    max_angle: degrees, between normals of partners.
    Raises `RegistrationError`: Fewer partners than unknowns; sizes that differ too much for one
        bone.

    Steps to tangent planes (Chen & Medioni 1992) of a similarity, weighted by area and Tukey's
    biweight of the distances (Huber 1981; as iterative closest points, Fitzgibbon 2003). Directions
    in which the normal equations have small eigenvalues are not solved for (Zhang et al. 2016).
    The interval of the size omits one block of neighbouring vertices at a time (Künsch 1989),
    because the distances of neighbours are not independent.
    """
    points = segment.vertices
    middle = points.mean(axis=0)
    own = Surface(segment.vertices, segment.triangles)
    whole = _Sample(
        points - middle, own.vertex_normals, vertex_areas(segment.vertices, segment.triangles)
    )
    # Points from all over the segment, in whatever order the file has the vertices.
    few = whole.some(np.random.default_rng(0).permutation(len(points))[:most_points])
    radius = float(np.sqrt((few.arms**2).sum(axis=1).mean()))
    facing = np.cos(np.radians(max_angle))
    pose = _Pose(start[:3, :3], start[:3, :3] @ middle + start[:3, 3], 1.0)
    for _ in range(MOST_STEPS):
        step = _Equations(few, bone, pose, radius, facing).step()
        pose = pose.stepped(step, radius)
        if not LEAST_SIZE < pose.scale < MOST_SIZE:
            raise RegistrationInputError(
                f"the bone after the operation is {pose.scale:.3g} times as large as the segment "
                f"(allowed {LEAST_SIZE:g} to {MOST_SIZE:g}): check the units of both files, and "
                "that they show the same bone"
            )
        if float(np.linalg.norm(step)) <= REST:
            break
    last = _Equations(few, bone, pose, radius, facing)
    pairs = _Pairs(whole, bone, pose, facing)
    matrix = np.eye(4)
    matrix[:3, :3] = pose.turn
    matrix[:3, 3] = pose.image - pose.turn @ middle
    return ShapeFit(
        frozen(matrix),
        pose.scale,
        last.interval(pose.scale),
        last.ratio,
        last.open,
        last.sigma,
        frozen(pairs.off),
        frozen(pairs.alike & (pairs.off < TUKEY * last.sigma)),
        frozen(middle),
    )


@dataclass(frozen=True, eq=False)
class _Pose:
    """The pose of a segment: rotated and scaled about its centre, and where that lies."""

    turn: Floats
    image: Floats
    scale: float

    def of(self, arms: Floats) -> Floats:
        return self.scale * arms @ self.turn.T + self.image

    def stepped(self, step: Floats, radius: float) -> "_Pose":
        angle = float(np.linalg.norm(step[:3])) / radius
        turn = self.turn
        if angle > 0.0:
            turn = rigid_motion(angle=np.degrees(angle), axis=step[:3])[:3, :3] @ turn
        return _Pose(turn, self.image + step[3:6], self.scale * (1.0 + float(step[6]) / radius))


class _Sample:
    """Vertices of a segment relative to its centre, with normals and the areas they represent."""

    def __init__(self, arms: Floats, normals: Floats, areas: Floats) -> None:
        self.arms, self.normals, self.areas = arms, normals, areas

    def some(self, chosen: NDArray[np.int64]) -> "_Sample":
        return _Sample(self.arms[chosen], self.normals[chosen], self.areas[chosen])


class _Pairs:
    """The points of the post-operative bone nearest to a sample in a pose."""

    def __init__(self, sample: _Sample, bone: Surface, pose: _Pose, facing: float) -> None:
        self.moved = pose.of(sample.arms)
        closest, self.facing, _ = bone.closest(self.moved)
        apart = self.moved - closest
        self.off: Floats = np.linalg.norm(apart, axis=1)
        self.rest: Floats = (apart * self.facing).sum(axis=1)
        self.alike = ((sample.normals @ pose.turn.T) * self.facing).sum(axis=1) >= facing


class _Equations:
    """Normal equations of a step: turn times radius, shift, growth of the radius, all in mm."""

    def __init__(
        self, sample: _Sample, bone: Surface, pose: _Pose, radius: float, facing: float
    ) -> None:
        pairs = _Pairs(sample, bone, pose, facing)
        if int(pairs.alike.sum()) < LEAST_PAIRS:
            raise RegistrationInputError(
                f"{int(pairs.alike.sum())} vertices of the segment lie near post-operative bone "
                f"with a similar normal; {LEAST_PAIRS} are needed: check that both are in one "
                "frame and that the normals of both point outwards"
            )
        self.sigma = max(TO_SIGMA * float(np.median(pairs.off[pairs.alike])), LEAST_SIGMA)
        size = np.minimum(pairs.off / (TUKEY * self.sigma), 1.0)
        self.weight = sample.areas * (1.0 - size**2) ** 2 * pairs.alike
        arms = pairs.moved - pose.image
        self.rows = _rows(arms, pairs.facing, radius)
        self.rest, self.arms, self.radius = pairs.rest, sample.arms, radius
        # Noise tilts the normals of both surfaces, which makes even a ball seem to resist rotation.
        # In the product of the rows of both surfaces it averages out.
        own = _rows(arms, sample.normals @ pose.turn.T, radius)
        both = (own[:, :6] * self.weight[:, None]).T @ self.rows[:, :6]
        values, vectors = np.linalg.eigh(0.5 * (both + both.T))
        shares = values / values[-1]
        held = shares >= OPEN
        self.ratio = max(float(shares[0]), 0.0)
        self.open = tuple(
            OpenDirection(vectors[:3, n].copy(), vectors[3:, n].copy(), max(float(shares[n]), 0.0))
            for n in np.flatnonzero(~held)
        )
        # Unknowns solved for: the directions that the shape determines, and the size.
        basis = np.zeros((7, int(held.sum()) + 1))
        basis[:6, :-1], basis[6, -1] = vectors[:, held], 1.0
        rows = self.rows @ basis
        inverse = np.linalg.pinv((rows * self.weight[:, None]).T @ rows, hermitian=True)
        self.has_size = bool(0.0 < inverse[-1, -1] * OPEN * values[-1] < 1.0)
        self.basis = basis if self.has_size else basis[:, :-1]

    def step(self, keep: NDArray[np.bool_] | None = None) -> Floats:
        """The step, (7,) mm; of some of the points."""
        return self._solved(self.rest, slice(None) if keep is None else keep)

    def interval(self, scale: float) -> tuple[float, float]:
        """The 95 % interval of the size; the allowed range where the shape leaves it open."""
        if not self.has_size:
            return LEAST_SIZE, MOST_SIZE
        block = _blocks(self.arms)
        found = np.array([self.step(block != n)[6] for n in range(BLOCKS)])
        variance = (BLOCKS - 1) / BLOCKS * float(((found - found.mean()) ** 2).sum())
        thicker = self._solved(np.full(len(self.rest), -ALL_ROUND), slice(None))[6]
        half = STUDENT * scale * float(np.hypot(np.sqrt(variance), thicker)) / self.radius
        return scale - half, scale + half

    def _solved(self, rest: Floats, keep: NDArray[np.bool_] | slice) -> Floats:
        rows = self.rows[keep] @ self.basis
        weighted = (rows * self.weight[keep, None]).T
        solved = np.linalg.lstsq(weighted @ rows, -weighted @ rest[keep], rcond=None)[0]
        solution: Floats = self.basis @ solved
        return solution


def _rows(arms: Floats, normals: Floats, radius: float) -> Floats:
    """How far turn, shift and growth by 1 mm move points along their normals, (n, 7)."""
    turns = np.cross(arms, normals) / radius
    return np.column_stack([turns, normals, (arms * normals).sum(axis=1) / radius])


def _blocks(points: Floats) -> NDArray[np.int64]:
    """The number of the block of neighbours that each point is in: halves of halves, by length."""
    blocks = [np.arange(len(points))]
    while len(blocks) < BLOCKS:
        halves = []
        for block in blocks:
            axis = int(np.argmax(np.ptp(points[block], axis=0)))
            order = block[np.argsort(points[block, axis], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        blocks = halves
    number = np.empty(len(points), dtype=np.int64)
    for n, block in enumerate(blocks):
        number[block] = n
    return number
