"""The parts of one linear case, and the meshes that the suite deforms and joins."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from benches.scenes.extended import Material, Twofold, rigid_displacement
from benches.scenes.meshes import box, oriented

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]

# Bisection steps for the position of a squashed node.
BISECTIONS = 50
# Moduli of fat and muscle, MPa, and the Poisson ratio of fat (Kim et al. 2010, Table 1).
FAT, MUSCLE, NU = 0.003, 0.79, 0.46


@dataclass(frozen=True, eq=False)
class Problem:
    """Mesh, materials, node kinds and plan of one case, with its closed form where there is one."""

    nodes: Floats
    tets: Indices
    materials: tuple[Material, ...]
    material_of: Indices
    fixed: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.uint32))
    joined: dict[str, Indices] = field(default_factory=dict)
    plan: dict[str, Floats] = field(default_factory=dict)
    loads: Floats | None = None
    exact: Floats | None = None

    def prescribed(self) -> tuple[NDArray[np.bool_], Twofold]:
        """Which nodes are prescribed, and by how much with 32 digits."""
        mask = np.zeros(len(self.nodes), dtype=bool)
        mask[self.fixed] = True
        motion = Twofold(np.zeros_like(self.nodes))
        for name, ids in self.joined.items():
            mask[ids] = True
            given = self.plan[name]
            if given.shape == (4, 4):
                moved = rigid_displacement(given, self.nodes[ids])
            else:
                moved = Twofold(given)
            motion.hi[ids], motion.lo[ids] = moved.hi, moved.lo
        return mask, motion


# Meshes.


def signed_volumes(nodes: Floats, tets: NDArray[np.integer[Any]]) -> Floats:
    """det(b − a, c − a, d − a) / 6."""
    a, b, c, d = (nodes[tets[:, i]] for i in range(4))
    volumes: Floats = np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6.0
    return volumes


def smallest_dihedrals(nodes: Floats, tets: NDArray[np.integer[Any]]) -> Floats:
    """Smallest angle between two faces of each tet, degrees."""
    x = nodes[tets]
    angles = []
    for a, b in itertools.combinations(range(4), 2):
        c, d = (i for i in range(4) if i not in (a, b))
        e = x[:, b] - x[:, a]
        n1, n2 = np.cross(e, x[:, c] - x[:, a]), np.cross(e, x[:, d] - x[:, a])
        sine = np.linalg.norm(np.cross(n1, n2), axis=1)
        angles.append(np.arctan2(sine, np.einsum("ij,ij->i", n1, n2)))
    smallest: Floats = np.degrees(np.min(angles, axis=0))
    return smallest


def slivers(
    cells: tuple[int, int, int], size: tuple[float, float, float], degrees: float
) -> tuple[Floats, Indices]:
    """A box in which every second inner node is pressed onto a face opposite to it.

    One tet round each such node is squashed until its smallest dihedral angle is `degrees`. The
    stars of these nodes are convex and have no tet in common, so no tet turns over; those whose
    outer face lies in the plane of the chosen one are squashed as well.
    """
    nodes, tets = box(cells, size)
    ids = np.arange(len(nodes)).reshape([n + 1 for n in cells])
    pressed = ids[1:-1:2, 1:-1:2, 1:-1:2].ravel()
    chosen = []
    for turn, node in enumerate(pressed):
        star = np.flatnonzero((tets == node).any(axis=1))
        chosen.append(star[turn % len(star)])
    flat = tets[chosen]
    feet = nodes[flat[flat != pressed[:, None]].reshape(-1, 3)].mean(axis=1)
    start = nodes[pressed]
    near, far = np.zeros(len(pressed)), np.ones(len(pressed))
    for _ in range(BISECTIONS):
        middle = 0.5 * (near + far)
        nodes[pressed] = start + middle[:, None] * (feet - start)
        wide = smallest_dihedrals(nodes, flat) > degrees
        near, far = np.where(wide, middle, near), np.where(wide, far, middle)
    nodes[pressed] = start + near[:, None] * (feet - start)
    return nodes, tets


def where(mask: NDArray[np.bool_]) -> Indices:
    """The indices at which a mask holds."""
    return np.flatnonzero(mask).astype(np.uint32)


def hull(nodes: Floats) -> Indices:
    """The nodes on the six sides of a box."""
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    return where(((nodes == low) | (nodes == high)).any(axis=1))


def one(tets: Indices) -> Indices:
    """The first material for every tet."""
    return np.zeros(len(tets), dtype=np.uint32)


def joined_bodies(*bodies: tuple[Floats, Indices]) -> tuple[Floats, Indices]:
    """Several meshes in one; nodes at exactly the same place become one node."""
    nodes = np.concatenate([n for n, _ in bodies])
    offsets = np.cumsum([0, *(len(n) for n, _ in bodies)])
    tets = np.concatenate([t + np.uint32(o) for (_, t), o in zip(bodies, offsets, strict=False)])
    unique, back = np.unique(nodes, axis=0, return_inverse=True)
    return unique, oriented(unique, back.ravel()[tets])
