"""The model fitted to a head from a rough pose: pose, jaw and shape together."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.proposed.shape_model.model import SKIN, HeadModel
from cmfsim.registration.proposed.shape_model.samples import HeadSamples
from cmfsim.registration.proposed.shape_model.search import SIZE_DEVIATION, Finder, pose_columns
from cmfsim.registration.proposed.shape_model.state import (
    N_JAW,
    N_POSE,
    POSE_UNITS,
    State,
    moved_with_jaw,
    similarity_step,
)
from cmfsim.values.checks import Floats

# Degrees of freedom of the distances: few, so that what the model lacks (spine, couch, metal) is
# outvoted rather than averaged.
FREEDOM = 3.0
# Pairs farther apart than this many deviations and mm are none.
MOST_DEVIATIONS, MOST_DISTANCE = 6.0, 3.0
# Neighbouring pairs see the same detail: so many count as one.
REDUNDANCY = 4.0
# What smooth modes cannot take of cranium, mandible and skin, mm: fine relief of the surfaces.
DETAIL = np.array([1.2, 1.2, 1.5])
# Precision that holds the jaw.
STILL = 1e8
# Distances count up to this in the choice among starts, mm.
MOST_GAP = 10.0
# A point of the model is seen where the image goes on for this far beyond it, mm.
SEEN_MARGIN = 2.0
# A site that is known: place in the patient's frame and its error, mm, by row of the sites.
Known = Mapping[int, tuple[Floats, float]]


@dataclass(frozen=True, eq=False)
class Evidence:
    """A round of the fit.

    precision: (7 + 6 + r, 7 + 6 + r), of a step of the pose (in lengths), of jaw and of shape; r
        modes as in `modes`.
    modes: (r,) int. The modes that took part.
    seen: (n,) bool. Points of the model that the image shows.
    gaps: (n,), mm. Distances of the model's points from the patient's surface along its normal, in
        the model's size; NaN where that was not asked.
    score: mm. Mean capped distance, both ways between patient and visible model, in the patient's
        size.
    """

    state: State
    precision: Floats
    modes: NDArray[np.int64]
    seen: NDArray[np.bool_]
    gaps: Floats
    score: float


@dataclass(frozen=True, eq=False)
class _Rows:
    """Linear equations of a step, with weights."""

    columns: NDArray[np.float32]
    distances: Floats
    weights: Floats


def refined(
    model: HeadModel,
    samples: HeadSamples,
    state: State,
    schedule: Sequence[tuple[float, int]],
    known: Known | None = None,
    *,
    still_jaw: bool = False,
) -> Evidence:
    """Pose, jaw and shape by steps to tangent planes in both directions.

    state: To begin with.
    schedule: Of each round: the noise, mm, and how many of the modes take part, those that move
        most.
    known: Sites whose place is known.
    still_jaw: Whether the jaw stays where it is against the cranium.
    """
    evidence = None
    for noise, count in schedule:
        effort = _Effort(noise, model.mode_order[:count], still_jaw)
        evidence = _stepped(model, samples, state, effort, known or {})
        state = evidence.state
    if evidence is None:
        raise AssertionError(schedule)
    return evidence


@dataclass(frozen=True, eq=False)
class _Effort:
    """What takes part in a round."""

    noise: float
    modes: NDArray[np.int64]
    still_jaw: bool


def _stepped(
    model: HeadModel, samples: HeadSamples, state: State, effort: _Effort, known: Known
) -> Evidence:
    noise, modes = effort.noise, effort.modes
    own = model.points + model.modes @ state.shape
    moved, by_jaw = moved_with_jaw(own, model.jaw_share, state.jaw)
    seen = samples.shows(state.out(moved), SEEN_MARGIN)
    leading = model.ordered_modes[:, :, : len(modes)]
    derivatives = np.concatenate([by_jaw, leading], axis=2, dtype=np.float32)
    gaps = np.full(len(moved), np.nan)
    scores = []
    rows = [*_known_rows(model, state, modes, known)]
    normals = state.normals(model)
    for is_skin in (False, True):
        part = np.flatnonzero((model.parts == SKIN) == is_skin)
        points = samples.skin if is_skin else samples.bone
        if not len(points):
            seen[part] = False
            continue
        target = Finder(
            state.into(points),
            (samples.skin_normals if is_skin else samples.bone_normals)
            @ state.linear.T
            / state.scale,
        )
        places, facing = moved[part], normals[part]
        away, there = Finder(places, facing).nearest(target.points, target.normals)
        _, back = target.nearest(places, facing)
        shape = _Surface(part, places, facing, derivatives, there, back)
        rows += [*_pairs(model, shape, target, seen, noise)]
        gaps[part] = _gaps(shape, target)
        scores.append(float(np.minimum(away / state.scale, MOST_GAP).mean()))
    if seen.any():
        near = np.minimum(gaps / state.scale, MOST_GAP)
        scores.append(float(np.average(near[seen], weights=model.areas[seen])))
    shown = seen, gaps, sum(scores)
    return _solved(model, state, rows, effort, shown)


@dataclass(frozen=True, eq=False)
class _Surface:
    """Points of the model on bone or on skin: their rows, where they are, and all derivatives.

    `there` is the nearest of them to each point of the patient, `back` the patient's to each.
    """

    rows: NDArray[np.int64]
    points: Floats
    normals: Floats
    derivatives: NDArray[np.float32]
    there: NDArray[np.int64]
    back: NDArray[np.int64]


def _gaps(surface: _Surface, target: Finder) -> Floats:
    """How far the model's points lie from the nearest points of the patient, along normals."""
    back = surface.back
    away = target.points[back] - surface.points
    along = np.abs((target.normals[back] * away).sum(axis=1))
    # The patient's points are some mm apart: what lies beside them is no distance.
    beside = np.sqrt(np.maximum((away**2).sum(axis=1) - along**2, 0.0))
    gaps: Floats = np.hypot(along, np.maximum(beside - SAMPLE_STEP, 0.0))
    # A surface that looks another way is none of the model's.
    facing = (target.normals[back] * surface.normals).sum(axis=1)
    gaps[facing < LEAST_FACING] = MOST_GAP
    return gaps


# Samples lie about this far apart at most, mm, and surfaces look the same way within 45°.
SAMPLE_STEP, LEAST_FACING = 9.0, 0.7


def _pairs(
    model: HeadModel, surface: _Surface, target: Finder, seen: NDArray[np.bool_], noise: float
) -> Iterator[_Rows]:
    """The equations of the pairs from the patient to the model, and back where it is seen."""
    index, back = surface.there, surface.back
    share = model.weight_of(surface.rows)
    everything = np.arange(len(surface.rows))
    for at, goal, normals, facing, weight in (
        (
            index,
            target.points,
            surface.normals[index],
            target.normals,
            np.full(len(index), share.sum() / len(index)),
        ),
        (
            everything,
            target.points[back],
            target.normals[back],
            surface.normals,
            share * seen[surface.rows],
        ),
    ):
        away = goal - surface.points[at]
        far = np.linalg.norm(away, axis=1)
        deviation = np.hypot(noise, DETAIL[model.parts[surface.rows[at]]])
        w = weight * (FREEDOM + 1.0) / (FREEDOM + (far / deviation) ** 2) / deviation**2
        w *= np.clip((normals * facing).sum(axis=1), 0.0, 1.0) * 0.5 / REDUNDANCY
        used = (w > 0.0) & (far < MOST_DEVIATIONS * deviation + MOST_DISTANCE)
        n, at_used = normals[used], at[used]
        pose = -pose_columns(surface.points[at_used], goal[used], n)
        rest = np.matmul(n[:, None].astype(np.float32), surface.derivatives[surface.rows[at_used]])[
            :, 0
        ]
        columns = np.concatenate([pose, rest], axis=1, dtype=np.float32)
        yield _Rows(columns, (n * away[used]).sum(axis=1), w[used])


def _known_rows(
    model: HeadModel, state: State, modes: NDArray[np.int64], known: Known
) -> Iterator[_Rows]:
    if not known:
        return
    places, derivatives = state.sites(model)
    taken = np.concatenate([np.arange(N_JAW), N_JAW + modes])
    for row, (point, error) in known.items():
        own, goal = np.tile(places[row], (3, 1)), np.tile(state.into(point[None]), (3, 1))
        columns = np.concatenate(
            [-pose_columns(own, goal, np.eye(3)), derivatives[row][:, taken]],
            axis=1,
            dtype=np.float32,
        )
        weight = np.full(3, 1.0 / (error * state.scale) ** 2)
        yield _Rows(columns, goal[0] - places[row], weight)


def _solved(
    model: HeadModel,
    state: State,
    rows: Sequence[_Rows],
    effort: _Effort,
    shown: tuple[NDArray[np.bool_], Floats, float],
) -> Evidence:
    modes = effort.modes
    columns = np.concatenate([r.columns for r in rows])
    weights = np.concatenate([r.weights for r in rows])
    distances = np.concatenate([r.distances for r in rows])
    current = np.concatenate([np.zeros(N_POSE), state.jaw, state.shape[modes]])
    # The pose is free but for its size.
    prior = np.concatenate([np.full(N_POSE, 1e-4), np.ones(N_JAW + len(modes))])
    current[0] = POSE_UNITS[0] * np.log(state.scale)
    prior[0] = 1.0 / (POSE_UNITS[0] * SIZE_DEVIATION) ** 2
    if effort.still_jaw:
        jaw_rows = slice(N_POSE, N_POSE + N_JAW)
        current[jaw_rows], prior[jaw_rows] = 0.0, STILL
    half = columns * np.sqrt(weights)[:, None].astype(np.float32)
    precision = (half.T @ half).astype(np.float64) + np.diag(prior)
    step = np.linalg.solve(precision, columns.T @ (weights * distances) - prior * current)
    grow, move = similarity_step(step[:N_POSE] / POSE_UNITS)
    shape = np.zeros(model.n_modes)
    shape[modes] = state.shape[modes] + step[N_POSE + N_JAW :]
    jaw = state.jaw + step[N_POSE : N_POSE + N_JAW]
    new = State(grow @ state.linear, grow @ state.offset + move, jaw, shape)
    return Evidence(new, precision, modes, *shown)
