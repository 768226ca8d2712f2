"""A person's true muscles in a mesh, and their fibres."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.phantom.model import PhantomHead
from cmfsim.phantom.muscles import MELT, Muscle
from cmfsim.phantom.shapes import Tube, smooth_max
from cmfsim.values.checks import Floats, as_index_rows, as_positive, as_rows

# Barycentric places at which a tet is asked whether it is muscle: corners of the four smaller tets
# about its corners and the middle, drawn in so that none lies on a face.
NEAR_CORNER = 0.7
PLACES = np.vstack(
    [
        np.full((1, 4), 0.25),
        np.eye(4) * (NEAR_CORNER - 0.1) + 0.1,
        *(
            [0.42 * (np.eye(4)[p] + np.eye(4)[q]) + 0.08 * (1.0 - np.eye(4)[p] - np.eye(4)[q])]
            for p in range(4)
            for q in range(p + 1, 4)
        ),
    ]
)
# A place counts as muscle in part within this share of an edge from the muscle's surface.
BLUR = 0.15
# Muscle lies this far below the skin, mm, as in the phantom.
BELOW_SKIN = 0.6
# Places further than this outside a strap do not feel it, mm: more than straps melt.
NEAR = 2.0
# The level there, mm.
FAR = -24.0


def thickened(muscles: Mapping[str, Muscle], factor: float) -> dict[str, Muscle]:
    """Muscles whose straps are thicker by a factor, though not wider, along the same courses."""
    times = as_positive("factor of muscle thickness", factor)
    return {
        name: replace(
            muscle, tubes=tuple(replace(tube, thick=times * tube.thick) for tube in muscle.tubes)
        )
        for name, muscle in muscles.items()
    }


def skin_share(nodes: ArrayLike, tets: ArrayLike, depth: Floats, thickness: float) -> Floats:
    """The part of each tet (m, 4) that lies within a thickness, mm, below the skin, (m,).

    Asked at eleven places; nodes (n, 3) lie at a depth (n,), mm, below the skin.
    """
    points = as_rows("nodes", nodes, 3)
    rows = as_index_rows("tets", tets, 4, len(points), "nodes")
    blur = BLUR * np.linalg.norm(points[rows[:, 1]] - points[rows[:, 0]], axis=1)
    inside = thickness - depth[rows] @ PLACES.T
    share: Floats = np.clip(0.5 + inside / (2.0 * blur)[:, None], 0.0, 1.0).mean(axis=1)
    return share


def muscle_field(
    head: PhantomHead,
    muscles: Mapping[str, Muscle],
    nodes: ArrayLike,
    tets: ArrayLike,
    depth: Floats,
    *,
    offsets: Mapping[str, tuple[float, float, float]] | None = None,
) -> tuple[Floats, Floats]:
    """The muscle fraction (m,) and fibre (m, 3) of each tet, from the muscles' own levels.

    No surface of a muscle and no sampler of the tested models is used: each of eleven places in a
    tet is asked for its level. Fractions of muscles that overlap add up to 1 at most; the fibre is
    the principal axis of Σ p a aᵀ over them.

    depth: (n,), mm, of the nodes (n, 3) below the skin.
    offsets: mm, by muscle, the distance left, backwards and up by which it lies elsewhere.
    """
    points = as_rows("nodes", nodes, 3)
    rows = as_index_rows("tets", tets, 4, len(points), "nodes")
    shifts = offsets or {}
    corners = points[rows]
    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    blur = BLUR * np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    total = np.zeros(len(rows))
    axes = np.zeros((len(rows), 3, 3))
    warp, scale = head.warp, head.parameters.scale
    unmoved = np.column_stack(warp.inverse(*middles.T))
    for name, muscle in muscles.items():
        shift = np.array(shifts.get(name, (0.0, 0.0, 0.0)))
        drawn = np.column_stack(warp.inverse(*(middles - shift).T)) if shift.any() else unmoved
        box, room = muscle.box, float(reach.max()) / scale
        low, high = np.array(box.low) - room, np.array(box.high) + room
        chosen = np.flatnonzero(((drawn >= low) & (drawn <= high)).all(axis=1))
        if not len(chosen):
            continue
        level = scale * _level(muscle, _folded(muscle, drawn[chosen])[:, None], room)[:, 0]
        chosen = chosen[level > -(reach + blur)[chosen]]
        if not len(chosen):
            continue
        asked = np.einsum("pc,tci->tpi", PLACES, corners[chosen]) - shift
        folded = _folded(muscle, np.column_stack(warp.inverse(*asked.reshape(-1, 3).T)))
        level = scale * _level(muscle, folded.reshape(asked.shape), room)
        level = np.minimum(level, depth[rows[chosen]] @ PLACES.T - BELOW_SKIN)
        share = np.clip(0.5 + level / (2.0 * blur[chosen])[:, None], 0.0, 1.0)
        part = share.mean(axis=1)
        touched = part > 0.0
        chosen, part = chosen[touched], part[touched]
        if not len(chosen):
            continue
        along = muscle.fibre(middles[chosen] - shift)
        total[chosen] += part
        axes[chosen] += part[:, None, None] * along[:, :, None] * along[:, None, :]
    fibre = np.tile([1.0, 0.0, 0.0], (len(rows), 1))
    found = np.flatnonzero(total > 0.0)
    fibre[found] = np.linalg.eigh(axes[found])[1][:, :, 2]
    return np.minimum(total, 1.0), fibre


def _folded(muscle: Muscle, drawn: NDArray[np.floating]) -> Floats:
    """Points on the left side, where muscles are drawn."""
    x = drawn[:, 0]
    folded = {"both": np.abs(x), "R": -x, "L": x}[muscle.side]
    return np.column_stack([folded, drawn[:, 1:]]).astype(np.float64)


def _level(muscle: Muscle, asked: Floats, room: float) -> Floats:
    """The level of a muscle's straps at places in tets, (t, p) mm; only near segments are asked.

    `asked` (t, p, 3) lies in the symmetric head, all places of a tet within `room` mm of its first.
    """
    middles = asked[:, 0]
    levels: list[Floats] = []
    for tube in muscle.tubes:
        best = np.full(asked.shape[:2], FAR)
        reach = np.maximum(tube.thick, tube.wide) + room + NEAR
        for i in range(len(tube.points) - 1):
            part = slice(i, i + 2)
            ends, margin = tube.points[part], float(reach[part].max())
            low, high = ends.min(axis=0) - margin, ends.max(axis=0) + margin
            near = np.flatnonzero(((middles >= low) & (middles <= high)).all(axis=1))
            if not len(near):
                continue
            piece = Tube(ends, tube.normals[part], tube.thick[part], tube.wide[part])
            there = piece.level(*asked[near].reshape(-1, 3).T).reshape(len(near), -1)
            best[near] = np.maximum(best[near], there)
        levels.append(best)
    level = levels[0]
    for other in levels[1:]:
        level = np.asarray(smooth_max(level, other, MELT), dtype=np.float64)
    return level
