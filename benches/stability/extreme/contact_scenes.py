"""Bodies on walls: flat, creased, bumpy, closed round the body, or the only constraint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import cmfsim
from benches.scenes.extended import Material, isotropic
from benches.scenes.meshes import box, icosphere, plane, spherical_shell
from benches.stability.extreme.problem import FAT, MUSCLE, NU, Problem, one, where

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]
    Wall = tuple[Floats, Indices]

SIZE = (60.0, 50.0, 40.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A body, the walls that it slides on, and what both do.

    Attributes
    ----------
    body : Problem
        Its `joined` segments and `plan`, without the walls.
    sliding : dict of str to (k,) uint32
    walls : dict of str to (vertices, triangles)
    moves : dict of str to (4, 4) float64
        What each wall does.
    contact : str
        "bilateral" or "unilateral".
    gap : float, mm
    contact_tolerance : float, mm
    may_not_settle : bool
        Whether contact may find no rest, and be refused.
    bend : float, degrees
        Largest angle between facets that the walls' normals are interpolated over; 0 for planes.
    """

    body: Problem
    sliding: Mapping[str, Indices]
    walls: Mapping[str, Wall]
    moves: Mapping[str, Floats]
    contact: str = "bilateral"
    gap: float = 0.0
    contact_tolerance: float = 1e-7
    may_not_settle: bool = False
    bend: float = 0.0


# Walls.


def flat(cells: int = 6, seed: int | None = 1, half: float = 150.0) -> Wall:
    """A plane at z = 0 under the block, normal up."""
    vertices, triangles = plane(half, cells, seed=seed)
    return vertices + [30.0, 25.0, 0.0], triangles


def relief(height: Callable[[Floats, Floats], Floats], cells: int, half: float = 90.0) -> Wall:
    """A graph z = height(x, y) over squares cut in two, normal up."""
    side = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(30.0 + side, 25.0 + side, indexing="ij")
    vertices = np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3)
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (
        q.ravel() for q in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
    )
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return vertices, triangles.astype(np.uint32)


# Scenes.


def push(translation: tuple[float, float, float], angle: float = 0.0) -> Floats:
    """A turn about a slanted axis through the top of the block, and a translation."""
    return cmfsim.rigid_motion(translation, angle, (1.0, 2.0, 3.0), (30.0, 25.0, 40.0))


def resting(
    wall: Wall,
    top: Floats,
    *,
    contrast: float = 1.0,
    cells: tuple[int, int, int] = (6, 5, 4),
    shape: Callable[[Floats, Floats], Floats] | None = None,
    move: Floats | None = None,
    scale: float = 1.0,
    jitter: float = 0.2,
    **options: Any,
) -> Scene:
    """A block whose lowest nodes slide on a wall and whose highest are joined to the maxilla.

    With a contrast its cells are soft or stiff at random. `shape` bends it to the wall.
    """
    nodes, tets = box(cells, SIZE, jitter=jitter)
    low, high = where(nodes[:, 2] == 0.0), where(nodes[:, 2] == SIZE[2])
    cell = np.floor(nodes[tets].mean(axis=1) / (np.array(SIZE) / np.array(cells))).astype(np.int64)
    draw = np.random.default_rng(11).random(cells) < 0.3
    inside = tuple(np.clip(cell[:, i], 0, cells[i] - 1) for i in range(3))
    if shape is not None:
        nodes[:, 2] += shape(nodes[:, 0], nodes[:, 1])
    materials: tuple[Material, ...] = (isotropic(FAT, NU), isotropic(FAT * contrast, NU))
    top = top.copy()
    top[:3, 3] *= scale
    body = Problem(
        nodes * scale,
        tets,
        materials,
        draw[inside].astype(np.uint32),
        joined={"maxilla": high},
        plan={"maxilla": top},
    )
    vertices, triangles = wall
    moves = {"wall": np.eye(4) if move is None else move}
    return Scene(body, {"wall": low}, {"wall": (vertices * scale, triangles)}, moves, **options)


def slope(angle: float, sign: float) -> Callable[[Floats, Floats], Floats]:
    """A roof over x = 30 mm (sign −1) or a gutter (+1), each side at `angle` degrees."""
    steep = sign * np.tan(np.radians(angle))

    def height(x: Floats, _: Floats) -> Floats:
        heights: Floats = steep * np.abs(x - 30.0)
        return heights

    return height


def dome(x: Floats, y: Floats) -> Floats:
    """A sphere of 80 mm under the block, its top at z = 0."""
    return np.sqrt(80.0**2 - np.minimum((x - 30.0) ** 2 + (y - 25.0) ** 2, 75.0**2)) - 80.0


def hollow(x: Floats, y: Floats) -> Floats:
    """The dome upside down."""
    return -dome(x, y)


def waves(height: float, length: float) -> Callable[[Floats, Floats], Floats]:
    """Bumps of twice `height` mm, `length` mm apart."""

    def shape(x: Floats, y: Floats) -> Floats:
        turn = 2 * np.pi / length
        return height * (np.cos(turn * x) * np.cos(turn * y) - 1.0)

    return shape


def in_a_cup(contrast: float, *, carried: bool) -> Scene:
    """A ball in half a cup, stiff inside: carried along, u = t everywhere, or turned in it by 20°.

    Its core is joined to a bone, its lower outside slides in the cup.
    """
    nodes, tets, inner, outer = spherical_shell(2, 3, 8.0, 20.0)
    radius = np.linalg.norm(nodes[tets].mean(axis=1), axis=1)
    low = outer[nodes[outer, 2] < -4.0]
    ball, triangles = icosphere(3, 20.0)
    below = (ball[triangles][:, :, 2] < 8.0).all(axis=1)
    cup = triangles[below][:, ::-1].astype(np.uint32)
    used, renumbered = np.unique(cup, return_inverse=True)
    shift = cmfsim.rigid_motion((4.0, -3.0, 2.0))
    turn = cmfsim.rigid_motion((0.3, 0.0, -0.2), 20.0, (1.0, 1.0, 0.0))
    body = Problem(
        nodes,
        tets,
        (isotropic(FAT, NU), isotropic(FAT * contrast, NU)),
        (radius < 14.0).astype(np.uint32),
        joined={"core": inner},
        plan={"core": shift if carried else turn},
        exact=np.tile([4.0, -3.0, 2.0], (len(nodes), 1)) if carried else None,
    )
    walls = {"cup": (ball[used], renumbered.reshape(-1, 3).astype(np.uint32))}
    return Scene(body, {"cup": low}, walls, {"cup": shift if carried else np.eye(4)}, bend=15.0)


def cornered(walls: int, contrast: float = 1.0) -> Scene:
    """A block that nothing holds but planes at right angles; all move by t, and so it does."""
    nodes, tets = box((4, 4, 3), SIZE, jitter=0.2)
    shift = cmfsim.rigid_motion((3.0, -2.0, 1.0))
    stiff = np.random.default_rng(5).random(len(tets)) < 0.3
    vertices, triangles = plane(200.0, 3, seed=2)
    taken = np.zeros(len(nodes), dtype=bool)
    sliding, surfaces = {}, {}
    for axis, name in zip((2, 0, 1)[:walls], ("below", "left", "front"), strict=False):
        on = (nodes[:, axis] == 0.0) & ~taken
        taken |= on
        sliding[name] = where(on)
        # A cyclic turn of the axes takes z to `axis`.
        surfaces[name] = (np.roll(vertices, axis + 1, axis=1), triangles)
    body = Problem(
        nodes,
        tets,
        (isotropic(MUSCLE, NU), isotropic(MUSCLE * contrast, NU)),
        stiff.astype(np.uint32),
        exact=np.tile(shift[:3, 3], (len(nodes), 1)),
    )
    return Scene(body, sliding, surfaces, dict.fromkeys(sliding, shift))


def pinned_on_a_wall(apart: float | None) -> Scene:
    """A block on a plane, kept from turning by two joined nodes `apart` mm from each other."""
    nodes, tets = box((5, 4, 3), SIZE, jitter=0.2)
    top = where((nodes[:, 1] == 0.0) & (nodes[:, 2] == SIZE[2]))[:2]
    if apart is not None:
        nodes[top[1]] = nodes[top[0]] + [apart, 0.0, 0.0]
    shift = cmfsim.rigid_motion((3.0, -2.0, 1.0))
    body = Problem(
        nodes,
        tets,
        (isotropic(MUSCLE, NU),),
        one(tets),
        joined={"pins": top if apart is not None else top[:1]},
        plan={"pins": shift},
        exact=np.tile(shift[:3, 3], (len(nodes), 1)),
    )
    return Scene(body, {"wall": where(nodes[:, 2] == 0.0)}, {"wall": flat()}, {"wall": shift})
