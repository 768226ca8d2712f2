"""Linear cases on the constraints of a body: smallest meshes, islands, hinges, arches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

import cmfsim
from benches.scenes.extended import isotropic
from benches.scenes.meshes import box, oriented
from benches.stability.extreme.bodies import advance, clamped
from benches.stability.extreme.problem import FAT, MUSCLE, NU, Problem, joined_bodies, one, where

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]


def arches(count: int) -> Problem:
    """Three-hinged arches: two tets that share an edge, each with its other edge held.

    Each tet alone could turn about its held edge, but the two turns move the common edge apart.
    """
    arch = np.array(
        [[0, 0, 0], [0, 0, 5], [10, 0, 0], [10, 0, 5], [5, 4, 1], [6, 4, 4]], dtype=np.float64
    )
    nodes = np.concatenate([arch + [0.0, 0.0, 20.0 * i] for i in range(count)])
    offsets = 6 * np.arange(count)[:, None]
    tets = np.concatenate([offsets + [0, 1, 4, 5], offsets + [2, 3, 4, 5]])
    left, right = (offsets + [0, 1]).ravel(), (offsets + [2, 3]).ravel()
    return Problem(
        nodes,
        oriented(nodes, tets),
        (isotropic(MUSCLE, NU),),
        one(tets),
        fixed=left.astype(np.uint32),
        joined={"maxilla": right.astype(np.uint32)},
        plan={"maxilla": advance(0.0, 1.0)},
    )


# Smallest meshes, islands, hinges.

SINGLE = (
    np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [2.0, 9.0, 0.0], [3.0, 2.0, 8.0]]),
    np.array([[0, 1, 2, 3]], dtype=np.uint32),
)


def single_tet(n_joined: int, *, fixed: int = 0, angle: float = 20.0) -> Problem:
    """One tet with its first nodes joined, the next ones fixed and the rest free."""
    nodes, tets = SINGLE
    joined = np.arange(n_joined, dtype=np.uint32)
    rest = np.arange(n_joined, n_joined + fixed, dtype=np.uint32)
    matrix = cmfsim.rigid_motion((1.0, -2.0, 3.0), angle, (1, 1, 0))
    exact = nodes @ (matrix[:3, :3] - np.eye(3)).T + matrix[:3, 3] if n_joined == 4 else None
    return Problem(
        nodes,
        tets,
        (isotropic(MUSCLE, 0.49),),
        one(tets),
        fixed=rest,
        joined={"bone": joined} if n_joined else {},
        plan={"bone": matrix} if n_joined else {},
        exact=exact,
    )


def block(
    at: tuple[float, float, float], edge: float = 20.0, cells: int = 3
) -> tuple[Floats, Indices]:
    """A cube at a corner, without jitter, so that neighbours share nodes exactly."""
    nodes, tets = box((cells, cells, cells), (edge, edge, edge))
    return nodes + np.array(at), tets


def islands(*, second_held: bool) -> Problem:
    """Two blocks far apart, the first held and moved, the second held or not."""
    nodes, tets = joined_bodies(block((0, 0, 0)), block((100, 0, 0)))
    x = nodes[:, 0]
    fixed = (x == 0.0) | (second_held & (x == 100.0))
    end = {"maxilla": where(x == 20.0)}
    plan = {"maxilla": advance()}
    if second_held:
        end["mandible"] = where(x == 120.0)
        plan["mandible"] = advance(-10.0, 3.0)
    materials = (isotropic(MUSCLE, NU), isotropic(FAT, NU))
    material_of = (nodes[tets].mean(axis=1)[:, 0] > 50.0).astype(np.uint32)
    return Problem(nodes, tets, materials, material_of, where(fixed), end, plan)


def afloat() -> Problem:
    """A block inside the cavity of a held box, touching nothing."""
    nodes, tets = box((6, 6, 6), (60.0, 60.0, 60.0))
    centre = nodes[tets].mean(axis=1)
    shell = ((centre < 10.0) | (centre > 50.0)).any(axis=1)
    used, renumbered = np.unique(tets[shell], return_inverse=True)
    outside = (nodes[used], renumbered.reshape(-1, 4).astype(np.uint32))
    nodes, tets = joined_bodies(outside, block((20.0, 20.0, 20.0)))
    return clamped(nodes, tets, (isotropic(MUSCLE, NU),), one(tets), advance())


def unheld() -> Problem:
    """A block with no node held."""
    nodes, tets = block((0, 0, 0))
    loads = np.zeros_like(nodes)
    loads[0, 0] = 1.0
    return Problem(nodes, tets, (isotropic(MUSCLE, NU),), one(tets), loads=loads)


def hinge(shared: str, *, far_end_held: bool = False) -> Problem:
    """A held block, and a second one that shares an edge or a node with it."""
    at = {"edge": (20.0, 20.0, 0.0), "node": (20.0, 20.0, 20.0)}[shared]
    nodes, tets = joined_bodies(block((0, 0, 0)), block(at))
    fixed = nodes[:, 0] == 0.0
    if far_end_held:
        fixed |= nodes[:, 0] == 40.0
    top = {"maxilla": where((nodes[:, 0] > 0.0) & (nodes[:, 0] < 10.0))}
    return Problem(
        nodes,
        tets,
        (isotropic(MUSCLE, NU),),
        one(tets),
        fixed=where(fixed),
        joined=top,
        plan={"maxilla": advance(0.0, 1.0)},
    )


def pinned(n_fixed: int) -> Problem:
    """A block held at one node, or at two, with the rotations about them free."""
    nodes, tets = block((0, 0, 0))
    corners = where((nodes[:, 1] == 0.0) & (nodes[:, 2] == 0.0))[[0, -1]]
    loads = np.zeros_like(nodes)
    loads[-1, 2] = 0.01
    return Problem(
        nodes, tets, (isotropic(MUSCLE, NU),), one(tets), fixed=corners[:n_fixed], loads=loads
    )
