"""Rigid pieces in the motion of a bone that is given vertex by vertex.

Parts of one surface may move differently: a jaw within its skull, the chin of a mandible. Motions
of neighbourhoods are tried, and each in turn becomes a piece that explains most of what the pieces
before do not, as long as it is worth it. Vertices choose among the pieces.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, rigid_fit
from cmfsim.bones.pairs.paired_surfaces import AlongSurface
from cmfsim.bones.pairs.shape_fit import LEAST_SIGMA, TO_SIGMA, TUKEY
from cmfsim.surfaces.topology import connected_labels
from cmfsim.values.checks import Floats
from cmfsim.values.motion import carried, rigid_motion
from cmfsim.values.surface_data import MovedSurface

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Deviations from a rigid motion are judged by their root mean square over this length, mm: the
# standard deviation of the weights along the surface.
JUDGED = 2.5
# A deviation counts at most this much, mm: one vertex far off says no more.
MOST_DEVIATION = 3.0
# Rigid motions to try are those of so many neighbourhoods of this radius, mm, far from one another;
# the best few grow: fitted again and again to the vertices that they explain.
NEIGHBOURHOODS, PART = 32, 25.0
# And those of so many smaller ones where most is left to explain.
PLACES, PLACE = 6, 12.0
GROWN, GROWING = 3, 3
# One explains a vertex within so many times the usual deviation of a neighbourhood.
EXPLAINS = 2.0
# Deviations are alike over this area, mm²: a correlation length of 8 mm. A piece must lower the
# mean square deviation, in units of the usual one, by this much over all such areas that it
# explains: by chance, six unknowns lower it by 6 on average and hardly ever by 60.
ALIKE, LOWERED = 200.0, 60.0
# And on average by this factor: by chance, each area finds one of two motions that suits it.
EXPLAINED = 2.0
# A smaller part, mm², is not a piece of its own; nor is one with less than the second away from
# other pieces: the mesh stretches between them.
LEAST_PIECE, LEAST_WITHIN = 300.0, 100.0
# At its border it moves from its neighbours by so many times the usual deviation: bone that bends
# does not.
STEP = 3.0
MOST_PIECES = 12
# Rounds in which vertices choose a piece, and pieces are fitted to their vertices.
ROUNDS = 8
# They are the same when this share of the area changes its piece.
SAME = 1e-3
# How much less a deviation along the surface counts than one along the normal; and the most that
# it may count less in a fit.
ALONG, MOST_ALONG = 3.0, 10.0
# The mesh stretches between pieces: pieces pass into one another over this length, mm.
PASSES = 2.0
# Within a piece, this share of the surroundings over that length is its own.
WITHIN = 0.95
# The power of the share of its own piece with which a vertex counts in the fit of a piece.
AT_BORDER = 8
# What is too small to matter, mm rms: a tenth of the accuracy of a segmented bone.
QUIET = 0.03
# Vertices that a rigid motion is fitted to, steps of the fit, and the last one, mm.
MOST_FITTED, STEPS, LAST_STEP = 8000, 30, 1e-4


class PairedBone(AlongSurface):
    """A surface before and after."""

    def __init__(self, motion: MovedSurface) -> None:
        super().__init__(motion.surface)
        self.motion = motion
        self.there = motion.moved_vertices
        before = Surface(motion.surface.vertices, motion.surface.triangles)
        self.normals = before.vertex_normals

    def cost(self, matrix: Floats) -> Floats:
        """The mean square deviation from a rigid motion round each vertex, mm²."""
        off = self.there - carried(matrix, self.here)
        square = _square(off, self.normals @ matrix[:3, :3].T)
        return self.averaged(np.minimum(square, MOST_DEVIATION**2), JUDGED)

    def fitted(self, chosen: Mask, *, is_piece: bool = False) -> Floats:
        """The rigid motion of most of some vertices, normals counting more, (4, 4) mm.

        Of a piece, vertices next to others count little: the mesh is stretched there.
        """
        some = np.flatnonzero(chosen)
        if len(some) > MOST_FITTED:
            some = np.sort(np.random.default_rng(0).permutation(some)[:MOST_FITTED])
        here, there = self.here[some], self.there[some]
        normals, areas = self.normals[some], self.areas[some]
        if is_piece:
            areas = areas * self.averaged(chosen.astype(np.float64), PASSES)[some] ** AT_BORDER
        matrix = rigid_fit(here, there, weights=areas).matrix
        along = ALONG
        for round_ in range(STEPS):
            turned = normals @ matrix[:3, :3].T
            moved = carried(matrix, here)
            square = _square(there - moved, turned)
            reach = TUKEY * max(TO_SIGMA * float(np.sqrt(np.median(square))), LEAST_SIGMA)
            weight = areas * np.maximum(1.0 - square / reach**2, 0.0) ** 2
            if round_ < STEPS // 2:
                along = _ratio(there - moved, turned, weight)
            step = _step(moved, turned, there - moved, weight, along)
            matrix = step @ matrix
            if float(np.abs(carried(step, moved) - moved).max()) < LAST_STEP:
                break
        return matrix


def _square(off: Floats, normals: Floats) -> Floats:
    """The square of deviations, along the surface as a third, mm²."""
    out = (off * normals).sum(axis=1)
    slid = (off**2).sum(axis=1) - out**2
    square: Floats = out**2 + np.maximum(slid, 0.0) / ALONG**2
    return square


def _ratio(off: Floats, normals: Floats, weight: Floats) -> float:
    """How many times larger deviations along the surface are than along the normal."""
    out = (off * normals).sum(axis=1)
    slid = np.maximum((off**2).sum(axis=1) - out**2, 0.0)
    total = max(float(weight.sum()), 1e-300)
    normal = max(float((weight * out**2).sum()) / total, QUIET**2)
    return float(np.clip(np.sqrt(0.5 * (weight * slid).sum() / total / normal), 1.0, MOST_ALONG))


def _step(points: Floats, normals: Floats, off: Floats, weight: Floats, ratio: float) -> Floats:
    """The small rigid motion that takes points to where they went, normals counting more."""
    middle = np.average(points, axis=0, weights=weight + 1e-300)
    arms = points - middle
    n = len(points)
    rows = np.zeros((n, 3, 6))
    rows[:, 0, 1], rows[:, 0, 2] = arms[:, 2], -arms[:, 1]
    rows[:, 1, 0], rows[:, 1, 2] = -arms[:, 2], arms[:, 0]
    rows[:, 2, 0], rows[:, 2, 1] = arms[:, 1], -arms[:, 0]
    rows[:, :, 3:] = np.eye(3)
    tangent = weight / ratio**2
    normal = weight - tangent
    by_normal = np.einsum("na,nab->nb", normals, rows)
    left = np.einsum("n,nb,nc->bc", normal, by_normal, by_normal)
    left += np.einsum("n,nab,nac->bc", tangent, rows, rows)
    right = by_normal.T @ (normal * (off * normals).sum(axis=1))
    right += np.einsum("n,nab,na->b", tangent, rows, off)
    found = np.linalg.lstsq(left, right, rcond=1e-12)[0]
    angle = float(np.linalg.norm(found[:3]))
    if angle > 0:
        return rigid_motion(found[3:], np.degrees(angle), found[:3], middle)
    return rigid_motion(found[3:])


def rigid_pieces(paired: PairedBone) -> tuple[list[Floats], Integers]:
    """The rigid motions of the pieces, largest first, and the number of the piece of each vertex.

    Motions are fitted with Tukey's biweight (Huber 1981); deviations along the surface count less
    by the ratio in which they are larger. One becomes a piece if it lowers the mean square of what
    the others leave, in units of the usual deviation of a neighbourhood, by more than chance, and
    if the bone moves by a step at its border.
    """
    tried = _Candidates(paired)
    pieces: list[Floats] = []
    costs: list[Floats] = []
    while len(pieces) < MOST_PIECES:
        one = tried.best(np.min(costs, axis=0) if costs else None)
        if one is None:
            break
        more, its_costs = _shared_out(paired, [*pieces, one], tried.usual)
        if len(more) <= len(pieces):
            # Other pieces explain its vertices: it would be found again without end.
            break
        pieces, costs = more, its_costs
    piece = _without_islands(paired, np.argmin(costs, axis=0))
    areas = np.bincount(piece, paired.areas, minlength=len(pieces))
    order = np.argsort(-areas, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return [pieces[n] for n in order], rank[piece]


def _without_islands(paired: PairedBone, piece: Integers) -> Integers:
    """The pieces of vertices; patches too small to be one belong to what lies round them."""
    same = piece[paired.ends[:, 0]] == piece[paired.ends[:, 1]]
    label = connected_labels(paired.ends[same], len(piece))
    areas = np.bincount(label, paired.areas)
    a, b = paired.ends[~same].T
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    of_island = (areas[label[a]] < LEAST_PIECE) & (areas[label[b]] >= LEAST_PIECE)
    count = int(piece.max()) + 1
    # How often each piece borders each patch.
    borders = np.bincount(
        label[a[of_island]] * count + piece[b[of_island]], minlength=len(areas) * count
    ).reshape(-1, count)
    into = np.where(borders.any(axis=1), borders.argmax(axis=1), -1)[label]
    return np.where(into >= 0, into, piece)


class _Candidates:
    """Rigid motions of neighbourhoods, of which the pieces are chosen."""

    def __init__(self, paired: PairedBone) -> None:
        self.paired = paired
        self.found: list[tuple[Floats, Floats]] = []
        usual = []
        for part in _neighbourhoods(paired.here, NEIGHBOURHOODS):
            if paired.areas[part].sum() < LEAST_PIECE:
                continue
            own = paired.fitted(part)
            cost = paired.cost(own)
            self.found.append((own, cost))
            usual.append(median(cost[part], paired.areas[part]))
        if not self.found:
            own = paired.fitted(np.ones(len(paired.here), dtype=bool))
            self.found.append((own, paired.cost(own)))
        # The mean square deviation of a neighbourhood from its own motion, mm². Of a small bone
        # in several pieces, most neighbourhoods have parts of two.
        self.usual = max(float(np.quantile(usual, 0.25)) if usual else 0.0, LEAST_SIGMA**2)

    def best(self, before: Floats | None) -> Floats | None:
        """The motion that explains most of what the pieces before do not; None: none does."""
        worst = MOST_DEVIATION**2
        left = np.full(len(self.paired.here), worst) if before is None else before
        found = list(self.found) if before is None else [*self.found, *self._at_worst(left)]
        gains = [self._gain(left, cost) for _, cost in found]
        first = np.argsort(gains, kind="stable")[::-1][:GROWN]
        grown = [self._grown(found[n][0], found[n][1], left) for n in first]
        gain, motion = max(grown, key=lambda one: one[0])
        return motion if before is None or gain >= LOWERED * ALIKE * self.usual else None

    def _at_worst(self, left: Floats) -> Iterator[tuple[Floats, Floats]]:
        """Motions of small neighbourhoods where most is left to explain, and their costs."""
        open_, here = left.copy(), self.paired.here
        for _ in range(PLACES):
            centre = int(np.argmax(open_))
            away = np.linalg.norm(here - here[centre], axis=1)
            open_[away < 2.0 * PLACE] = 0.0
            if self.paired.areas[away < PLACE].sum() < LEAST_PIECE:
                continue
            own = self.paired.fitted(away < PLACE)
            yield own, self.paired.cost(own)

    def _gain(self, left: Floats, cost: Floats) -> float:
        """How much a motion lowers the mean square deviation where it explains it, mm⁴."""
        lower = np.maximum(left, self.usual) - np.maximum(cost, self.usual)
        lower[~self._explains(cost, left)] = 0.0
        return float((self.paired.areas * np.maximum(lower, 0.0)).sum())

    def _explains(self, cost: Floats, left: Floats) -> Mask:
        """Where a motion leaves the usual deviation, or far less than is left without it."""
        sound: Mask = (cost <= np.maximum(EXPLAINS**2 * self.usual, left / EXPLAINS**2)) & (
            cost < left
        )
        return sound

    def _grown(self, motion: Floats, cost: Floats, left: Floats) -> tuple[float, Floats]:
        """The gain of a motion fitted to all that it explains better than before, and itself."""
        gain = self._gain(left, cost)
        for _ in range(GROWING):
            sound = self._explains(cost, left)
            if self.paired.areas[sound].sum() < LEAST_PIECE:
                break
            fitted = self.paired.fitted(sound)
            cost = self.paired.cost(fitted)
            more = self._gain(left, cost)
            if more <= gain:
                break
            gain, motion = more, fitted
        return gain, motion


def _neighbourhoods(points: Floats, count: int) -> Iterator[Mask]:
    """Which points lie near each of some that are far from one another."""
    centre, away = 0, np.full(len(points), np.inf)
    for _ in range(count):
        off = np.linalg.norm(points - points[centre], axis=1)
        yield off < PART
        away = np.minimum(away, off)
        centre = int(np.argmax(away))


def _shared_out(
    paired: PairedBone, pieces: list[Floats], usual: float
) -> tuple[list[Floats], list[Floats]]:
    """Pieces that are worth it, fitted to the vertices that each explains best, and their costs."""
    while True:
        pieces, costs = _fitted_again(paired, pieces)
        kept = _worth(paired, pieces, costs, usual)
        if len(kept) == len(pieces):
            return pieces, costs
        pieces = [pieces[n] for n in kept]


def _fitted_again(paired: PairedBone, pieces: list[Floats]) -> tuple[list[Floats], list[Floats]]:
    """Pieces fitted to the vertices that each explains best, until these stay the same."""
    before, areas = None, paired.areas
    for _ in range(ROUNDS):
        costs = [paired.cost(matrix) for matrix in pieces]
        piece = np.argmin(costs, axis=0)
        if before is not None and areas[piece != before].sum() < SAME * areas.sum():
            return pieces, costs
        held = [n for n in range(len(pieces)) if areas[piece == n].sum() >= LEAST_PIECE]
        before = piece if len(held) == len(pieces) else None
        pieces = [paired.fitted(piece == n, is_piece=True) for n in held]
    return pieces, [paired.cost(matrix) for matrix in pieces]


def _worth(
    paired: PairedBone, pieces: list[Floats], costs: list[Floats], usual: float
) -> list[int]:
    """Numbers of the pieces without which much more would be left to explain."""
    piece = np.argmin(costs, axis=0)
    numbers = range(len(costs))
    if len(costs) == 1:
        return [0]
    within = paired.averaged(np.eye(len(costs))[piece], PASSES) > WITHIN
    steps = _steps(paired, piece, pieces)
    kept = []
    for n in numbers:
        others = np.min([costs[m] for m in numbers if m != n], axis=0)
        mine = piece == n
        area = paired.areas[mine]
        lower = (np.maximum(others, usual) - np.maximum(costs[n], usual))[mine]
        left = np.maximum(costs[n], usual)[mine]
        if (
            area.sum() >= LEAST_PIECE
            and paired.areas[mine & within[:, n]].sum() >= LEAST_WITHIN
            and (area * lower).sum() >= LOWERED * ALIKE * usual
            and others[mine].mean() >= EXPLAINED * left.mean()
            and steps[n] >= STEP * np.sqrt(usual)
        ):
            kept.append(n)
    return kept or [int(np.argmax(np.bincount(piece, paired.areas, minlength=len(costs))))]


def _steps(paired: PairedBone, piece: Integers, pieces: list[Floats]) -> list[float]:
    """How far each piece moves from those around it at its border, median, mm."""
    a, b = paired.ends[piece[paired.ends[:, 0]] != piece[paired.ends[:, 1]]].T
    middle = 0.5 * (paired.here[a] + paired.here[b])
    went = np.stack([carried(matrix, middle) for matrix in pieces])
    row = np.arange(len(middle))
    step = np.linalg.norm(went[piece[a], row] - went[piece[b], row], axis=1)
    found = []
    for n in range(len(pieces)):
        mine = (piece[a] == n) | (piece[b] == n)
        # One without a border is a surface of its own.
        found.append(float(np.median(step[mine])) if mine.any() else np.inf)
    return found


def median(values: Floats, weights: Floats) -> float:
    """The weighted median."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
