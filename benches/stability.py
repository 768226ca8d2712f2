"""The stiff and extreme suite: every method against references that are not cmfsim.

    python benches/stability.py [--markdown docs/stability.md] [--json out.json] [--quick]

solves each case with each method and writes a table with the condition number, the residual, the
error against a closed form or against 32-digit arithmetic (`extended.py`), and a verdict. The exit
status is 1 if any verdict is not the wanted one. Needs scipy beside numpy and cmfsim.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import signal
import sys
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import cmfsim
from extended import (
    ExtendedModel,
    Material,
    Reference,
    Twofold,
    isotropic,
    rigid_displacement,
    solve,
)
from meshes import box, oriented, spherical_shell

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]

EPS = float(np.finfo(np.float64).eps)
# Error over the largest displacement that is allowed however well the case is conditioned.
ERROR_LIMIT = 1e-9
# Allowed error over ε κ, where that is more than `ERROR_LIMIT`: κ of the equilibrated matrix.
CONDITION_FACTOR = 10.0
# The true error of an iterative method may be this many times the bound that it reports, beside
# the round-off that every method has.
BOUND_FACTOR = 1.0
# Bisection steps for the position of a squashed node.
BISECTIONS = 50
# Residual of a direct solve over its round-off, ε ‖|K| |u|‖ / ‖b‖ (times E_t/E_l for soft fibres,
# whose modulus Spencer's constants give as a difference of large ones).
RESIDUAL_FACTOR = 10.0
# Error above which an answer has no digits worth having: it must be refused, whatever κ is.
WORTHLESS = 1e-3
# Sweeps that the relaxation gets before it must give up. It needs about as many as κ says.
SWEEPS = 4000
# Seconds after which a solve counts as hanging.
PATIENCE = 60
# Moduli of fat and muscle, MPa, and the Poisson ratio of fat (Kim et al. 2010, Table 1).
FAT, MUSCLE, NU = 0.003, 0.79, 0.46

ALL = ("cholesky", "pcg", "relaxation")
FAST = ("cholesky", "pcg")


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


@dataclass(frozen=True)
class Case:
    """One line of the suite: how to build it, what solves it, and what must come out.

    Attributes
    ----------
    group, name : str
    parameter : str
        The extreme value, in words.
    build : callable
    methods : tuple of str
    refusal : tuple of str
        Words that the BoundaryError must hold; empty where the case has a solution.
    tolerance : float
        Asked of the iterative methods.
    quick : bool
        Whether `--quick` runs it.
    """

    group: str
    name: str
    parameter: str
    build: Callable[[], Problem]
    methods: tuple[str, ...] = FAST
    refusal: tuple[str, ...] = ()
    tolerance: float = 1e-9
    quick: bool = True

    @property
    def key(self) -> str:
        """A name that no other case has."""
        return f"{self.group}: {self.name}, {self.parameter}"


@dataclass(frozen=True)
class Row:
    """What one method made of one case; numbers are None where it was refused.

    Attributes
    ----------
    condition : float or None
        κ₂ of the equilibrated matrix.
    reference : str
        "closed form" or "32 digits".
    residual, true_residual : float or None
        As reported, and with 32 digits.
    error : float or None
        Largest nodal error over the largest displacement.
    error_bound : float or None
        As reported, over the largest displacement.
    allowed : float or None
        The error that the acceptance rule allows.
    verdict : str
        "ok", "refused: …" or "WRONG: …".
    passed : bool
        Whether the verdict is the wanted one.
    """

    group: str
    name: str
    parameter: str
    method: str
    condition: float | None = None
    reference: str = ""
    residual: float | None = None
    true_residual: float | None = None
    error: float | None = None
    error_bound: float | None = None
    allowed: float | None = None
    iterations: int | None = None
    seconds: float = 0.0
    verdict: str = ""
    passed: bool = False


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


# Cases with a closed form.

# An affine field with stretch, shear and change of volume, and a shift in mm.
GRADIENT = np.array([[0.05, 0.02, -0.01], [0.03, -0.04, 0.02], [-0.02, 0.01, 0.03]])
SHIFT = np.array([0.4, -0.3, 0.2])
BOX = (60.0, 50.0, 40.0)


def affine_patch(material: Material) -> Problem:
    """A uniform body with u = G x + s on its boundary and so inside (patch test, Irons 1972)."""
    nodes, tets = box((6, 6, 6), BOX, jitter=0.2)
    exact = nodes @ GRADIENT.T + SHIFT
    ids = hull(nodes)
    return Problem(
        nodes,
        tets,
        (material,),
        one(tets),
        joined={"all": ids},
        plan={"all": exact[ids]},
        exact=exact,
    )


def rigid_patch(angle: float, material: Material, translation: float = 0.0) -> Problem:
    """A uniform body with u = (R − I) x + t on its boundary: affine, so the same field inside."""
    nodes, tets = box((6, 6, 6), BOX, jitter=0.2)
    axis = np.array([1.0, 2.0, -1.0])
    matrix = cmfsim.rigid_motion(
        translation=translation * np.array([0.6, 0.0, 0.8]),
        angle=angle,
        axis=axis,
        centre=(5, 5, 5),
    )
    exact = nodes @ (matrix[:3, :3] - np.eye(3)).T + matrix[:3, 3]
    return Problem(
        nodes,
        tets,
        (material,),
        one(tets),
        joined={"all": hull(nodes)},
        plan={"all": matrix},
        exact=exact,
    )


def series_bar(contrast: float, cells: int = 8) -> Problem:
    """A bar of two materials pulled by d with ν = 0 and free sides.

    The stress is the same in both halves, so u′ = σ/E: the strains are d/(L/2) · E₂/(E₁+E₂) and
    d/(L/2) · E₁/(E₁+E₂), and nothing moves sideways.
    """
    nodes, tets = box((cells, 3, 3), (80.0, 20.0, 20.0), jitter=0.2, keep_layers=True)
    soft, stiff = 0.01, 0.01 * contrast
    half, pull = 40.0, 4.0
    centre = nodes[tets].mean(axis=1)[:, 0]
    x = nodes[:, 0]
    strains = np.array([stiff, soft]) / (soft + stiff) * pull / half
    exact = np.zeros_like(nodes)
    exact[:, 0] = np.minimum(x, half) * strains[0] + np.maximum(x - half, 0.0) * strains[1]
    end = where(x == x.max())
    return Problem(
        nodes,
        tets,
        (isotropic(soft, 0.0), isotropic(stiff, 0.0)),
        (centre > half).astype(np.uint32),
        fixed=where(x == 0.0),
        joined={"end": end},
        plan={"end": exact[end]},
        exact=exact,
    )


def fibre_bar(ratio: float) -> Problem:
    """A bar with fibres along it, pulled with ν = 0 and free sides: u = (d x / L, 0, 0)."""
    nodes, tets = box((8, 3, 3), (80.0, 20.0, 20.0), jitter=0.2)
    exact = np.zeros_like(nodes)
    exact[:, 0] = 0.05 * nodes[:, 0]
    end = where(nodes[:, 0] == 80.0)
    material = Material(0.01 * ratio, 0.01, 0.0, (1.0, 0.0, 0.0))
    return Problem(
        nodes,
        tets,
        (material,),
        one(tets),
        fixed=where(nodes[:, 0] == 0.0),
        joined={"end": end},
        plan={"end": exact[end]},
        exact=exact,
    )


def layered(contrast: float) -> Problem:
    """Six layers, soft and stiff in turn, compressed and sheared between plates.

    With u on the whole boundary of the piecewise linear field u(x) whose slopes are
    p/M (M = E(1−ν)/((1+ν)(1−2ν)), the oedometric modulus) and q/μ in every layer, tractions are
    continuous, so this is the field inside.
    """
    nodes, tets = box((6, 5, 5), BOX, jitter=0.2, keep_layers=True)
    nu = 0.45
    young = np.array([0.01, 0.01 * contrast])
    oedometric = young * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    shear = young / (2 * (1 + nu))
    layer = np.minimum((nodes[tets].mean(axis=1)[:, 0] / 10.0).astype(np.int64), 5)
    levels = np.arange(7) * 10.0
    fields = []
    for modulus, move in ((oedometric, -3.0), (shear, 2.0)):
        slope = 1.0 / modulus[np.arange(6) % 2]
        value = np.concatenate([[0.0], np.cumsum(slope)])
        fields.append(np.interp(nodes[:, 0], levels, move * value / value[-1]))
    exact = np.stack([fields[0], fields[1], np.zeros(len(nodes))], axis=1)
    ids = hull(nodes)
    return Problem(
        nodes,
        tets,
        (isotropic(young[0], nu), isotropic(young[1], nu)),
        (layer % 2).astype(np.uint32),
        joined={"all": ids},
        plan={"all": exact[ids]},
        exact=exact,
    )


# Cases against 32 digits: clamped at one end, a segment at the other end moved, sides free.


def clamped(
    nodes: Floats,
    tets: Indices,
    materials: tuple[Material, ...],
    material_of: Indices,
    matrix: Floats,
) -> Problem:
    """A body held at its least x; its greatest x is joined to a segment that moves by `matrix`."""
    x = nodes[:, 0]
    return Problem(
        nodes,
        tets,
        materials,
        material_of,
        fixed=where(x == x.min()),
        joined={"maxilla": where(x == x.max())},
        plan={"maxilla": matrix},
    )


def advance(angle: float = 5.0, translation: float = 6.0) -> Floats:
    """A segment's motion: a turn about a slanted axis and a translation in mm."""
    return cmfsim.rigid_motion(
        translation=(translation, 0.2 * translation, 0.0),
        angle=angle,
        axis=(1.0, 2.0, 3.0),
        centre=(60.0, 25.0, 20.0),
    )


def nearly_incompressible(nu: float) -> Problem:
    """A uniform block between a held and a moved end, sides free."""
    nodes, tets = box((6, 5, 5), BOX, jitter=0.2)
    return clamped(nodes, tets, (isotropic(MUSCLE, nu),), one(tets), advance())


def pressed_shell(nu: float) -> Problem:
    """A thick sphere, its outside fixed and its inside blown up by 2 mm (the Lamé problem)."""
    nodes, tets, inner, outer = spherical_shell(2, 4, 20.0, 40.0)
    radial = nodes[inner] / np.linalg.norm(nodes[inner], axis=1, keepdims=True)
    return Problem(
        nodes,
        tets,
        (isotropic(MUSCLE, nu),),
        one(tets),
        fixed=outer,
        joined={"inside": inner},
        plan={"inside": 2.0 * radial},
    )


def checkerboard(contrast: float, cells: tuple[int, int, int] = (6, 5, 5)) -> Problem:
    """A block with cells soft or stiff at random: stiff inclusions, some afloat in soft tissue."""
    nodes, tets = box(cells, BOX, jitter=0.2)
    cell = np.floor(nodes[tets].mean(axis=1) / (np.array(BOX) / np.array(cells))).astype(np.int64)
    draw = np.random.default_rng(11).random(cells) < 0.3
    inside = tuple(np.clip(cell[:, i], 0, cells[i] - 1) for i in range(3))
    return clamped(
        nodes,
        tets,
        (isotropic(FAT, NU), isotropic(FAT * contrast, NU)),
        draw[inside].astype(np.uint32),
        advance(),
    )


def fibres(ratio: float, fibre: tuple[float, float, float]) -> Problem:
    """A block of fibred tissue, fat across (or along) and `ratio` times that along (or across)."""
    nodes, tets = box((6, 5, 5), BOX, jitter=0.2)
    material = Material(0.01 * ratio, 0.01, 0.43, fibre)
    return clamped(nodes, tets, (material,), one(tets), advance())


def squashed(degrees: float, nu: float = 0.45, contrast: float = 1.0) -> Problem:
    """A block with a squashed tet at every second inner node; with a contrast, in random halves."""
    nodes, tets = slivers((8, 6, 6), BOX, degrees)
    stiff = np.random.default_rng(5).random(len(tets)) < 0.3
    materials = (isotropic(FAT, nu), isotropic(FAT * contrast, nu))
    if contrast == 1.0:
        return clamped(nodes, tets, materials[:1], one(tets), advance())
    return clamped(nodes, tets, materials, stiff.astype(np.uint32), advance())


def scaled(length: float, modulus: float = 1.0) -> Problem:
    """The face-like checkerboard in other units: lengths × `length`, moduli × `modulus`."""
    p = checkerboard(MUSCLE / FAT)
    matrix = p.plan["maxilla"].copy()
    matrix[:3, 3] *= length
    materials = tuple(
        Material(m.along * modulus, m.across * modulus, m.poisson, m.fibre) for m in p.materials
    )
    return Problem(
        p.nodes * length,
        p.tets,
        materials,
        p.material_of,
        fixed=p.fixed,
        joined=p.joined,
        plan={"maxilla": matrix},
    )


def far_away(distance: float) -> Problem:
    """The face-like checkerboard far from the origin, moved about its own centre."""
    p = checkerboard(MUSCLE / FAT)
    away = distance * np.array([1.0, -1.0, 1.0])
    matrix = cmfsim.rigid_motion((6.0, 1.2, 0.0), 5.0, (1, 2, 3), away + (60.0, 25.0, 20.0))
    return Problem(
        p.nodes + away,
        p.tets,
        p.materials,
        p.material_of,
        fixed=p.fixed,
        joined=p.joined,
        plan={"maxilla": matrix},
    )


def moved(angle: float, translation: float) -> Problem:
    """One segment moved far, the other end held."""
    p = checkerboard(MUSCLE / FAT)
    return clamped(p.nodes, p.tets, p.materials, p.material_of, advance(angle, translation))


def slender(slenderness: int, load: float) -> Problem:
    """A cantilever of square cells with a tip load in N; nothing is prescribed but the clamp."""
    nodes, tets = box((slenderness, 1, 1), (float(slenderness), 1.0, 1.0))
    tip = nodes[:, 0] == nodes[:, 0].max()
    loads = np.zeros_like(nodes)
    loads[tip, 2] = load / tip.sum()
    return Problem(
        nodes,
        tets,
        (isotropic(MUSCLE, 0.3),),
        one(tets),
        fixed=where(nodes[:, 0] == 0.0),
        loads=loads,
    )


def hung_on_three_nodes(offset: float) -> Problem:
    """A block held by three nodes almost in line: the third is `offset` mm off the line."""
    nodes, tets = box((5, 4, 4), (50.0, 40.0, 40.0), jitter=0.2)
    edge = (nodes[:, 1] == 0.0) & (nodes[:, 2] == 0.0)
    low, middle, high = (where(edge & (nodes[:, 0] == x))[0] for x in (0.0, 20.0, 50.0))
    nodes[middle, 1] = -offset
    plan = np.array([[0.0, 0.0, 0.0], [0.5 * offset, 0.0, 0.3 * offset], [0.1, 0.0, 0.0]])
    ids = np.array([low, middle, high], dtype=np.uint32)
    material = (isotropic(MUSCLE, 0.3),)
    return Problem(nodes, tets, material, one(tets), joined={"pins": ids}, plan={"pins": plan})


def neck(contrast: float, cells: int = 3) -> Problem:
    """Two blocks joined by a thin soft neck, the first one's end moved by t: u = t everywhere.

    The second block hangs on the neck alone: its rigid motion is the slow mode of an iteration.
    """
    nodes, tets = box((3 * cells, cells, cells), (90.0, 30.0, 30.0))
    cell = np.floor(nodes[tets].mean(axis=1) / (30.0 / cells)).astype(np.int64)
    between = (cell[:, 0] >= cells) & (cell[:, 0] < 2 * cells)
    core = (cell[:, 1:] == cells // 2).all(axis=1)
    used, renumbered = np.unique(tets[~between | core], return_inverse=True)
    nodes, tets = nodes[used], oriented(nodes[used], renumbered.reshape(-1, 4))
    x = nodes[tets].mean(axis=1)[:, 0]
    end = where(nodes[:, 0] == 0.0)
    exact = np.tile([3.0, 4.0, 0.0], (len(nodes), 1))
    return Problem(
        nodes,
        tets,
        (isotropic(1.0, NU), isotropic(1.0 / contrast, NU)),
        ((x > 30.0) & (x < 60.0)).astype(np.uint32),
        joined={"end": end},
        plan={"end": exact[end]},
        exact=exact,
    )


def afloat_in_soft(contrast: float) -> Problem:
    """A stiff cube in the middle of soft tissue: it moves with nothing but that tissue."""
    nodes, tets = box((6, 6, 6), (60.0, 60.0, 60.0), jitter=0.2)
    centre = nodes[tets].mean(axis=1)
    stiff = ((centre > 20.0) & (centre < 40.0)).all(axis=1)
    materials = (isotropic(FAT, NU), isotropic(FAT * contrast, NU))
    return clamped(nodes, tets, materials, stiff.astype(np.uint32), advance())


def loaded(shift: float) -> Problem:
    """The face-like checkerboard under nodal loads, its segment moved by next to nothing."""
    p = checkerboard(MUSCLE / FAT)
    matrix = np.eye(4)
    matrix[0, 3] = shift
    x = p.nodes[:, 0]
    loads = np.zeros_like(p.nodes)
    loads[(x > 20.0) & (x < 40.0), 1] = 1e-3
    moved_little = clamped(p.nodes, p.tets, p.materials, p.material_of, matrix)
    return replace(moved_little, loads=loads)


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


def _number(value: float) -> str:
    return f"{value:g}"


def cases(*, quick: bool = False) -> list[Case]:
    """All cases of the suite, or with `quick` those that take less than a second each."""
    every = list(_cases())
    return [c for c in every if c.quick or not quick]


def _cases() -> Iterator[Case]:
    bind = functools.partial
    ratios = (0.0, 0.3, 0.45, 0.49, 0.499, 0.4999)
    for nu in ratios:
        group, text = "Poisson ratio", f"ν = {_number(nu)}"
        methods = ALL if nu <= 0.49 else FAST
        yield Case(group, "affine patch", text, bind(affine_patch, isotropic(MUSCLE, nu)), methods)
        yield Case(group, "clamped block", text, bind(nearly_incompressible, nu), ALL)
        yield Case(group, "blown-up sphere", text, bind(pressed_shell, nu), FAST, quick=nu >= 0.49)
    for power in (0, 2, 4, 6, 8):
        contrast = 10.0**power
        text = f"contrast 1e{power}"
        yield Case("contrast", "bar in series", text, bind(series_bar, contrast), ALL)
        yield Case("contrast", "layers", text, bind(layered, contrast), ALL)
        yield Case("contrast", "random inclusions", text, bind(checkerboard, contrast), ALL)
    for power in (4, 8):
        yield Case(
            "contrast",
            "random inclusions, 10 368 tets",
            f"contrast 1e{power}",
            bind(checkerboard, 10.0**power, (12, 12, 12)),
            quick=False,
        )
    for power in (0, 4, 8):
        text = f"contrast 1e{power}"
        yield Case("contrast", "stiff cube afloat", text, bind(afloat_in_soft, 10.0**power), ALL)
    for power in (0, 2, 4, 8):
        text = f"contrast 1e{power}"
        yield Case("contrast", "thin neck", text, bind(neck, 10.0**power), ALL)
    yield Case("contrast", "thinner neck", "contrast 1e2", bind(neck, 1e2, 5), FAST)
    yield Case("contrast", "thinner neck", "contrast 1e8", bind(neck, 1e8, 5), ALL)
    for power, tolerance in ((6, 1e-6), (4, 1e-4), (2, 1e-2)):
        yield Case(
            "contrast",
            "thin neck",
            f"contrast 1e{power}, tolerance {tolerance:.0e}",
            bind(neck, 10.0**power),
            ("pcg", "relaxation"),
            tolerance=tolerance,
        )
    diagonal = (0.5**0.5, 0.5**0.5, 0.0)
    for power in (-3, -1, 1, 3):
        ratio = 10.0**power
        text = f"E_l/E_t = 1e{power}"
        patch = Material(0.01 * ratio, 0.01, 0.43, diagonal)
        yield Case("fibres", "affine patch, 45°", text, bind(affine_patch, patch))
        yield Case("fibres", "bar along, ν = 0", text, bind(fibre_bar, ratio))
        yield Case("fibres", "block along", text, bind(fibres, ratio, (1.0, 0.0, 0.0)))
        yield Case("fibres", "block across", text, bind(fibres, ratio, (0.0, 0.0, 1.0)))
        yield Case("fibres", "block at 45°", text, bind(fibres, ratio, diagonal), ALL)
    stiff_fibre = Material(10.0, 0.01, 0.4999, diagonal)
    yield Case("fibres", "affine patch, 45°", "1e3, ν = 0.4999", bind(affine_patch, stiff_fibre))
    for degrees in (10.0, 1.0, 0.1):
        text = f"dihedral {_number(degrees)}°"
        yield Case("slivers", "block", text, bind(squashed, degrees), ALL)
        yield Case("slivers", "block, ν = 0.49", text, bind(squashed, degrees, 0.49))
    for length, text in ((1e3, "mm → µm (× 1e3)"), (1e-3, "mm → m (× 1e-3)"), (1e-6, "× 1e-6")):
        yield Case("units", "random inclusions", text, bind(scaled, length), ALL)
    for modulus, text in ((1e6, "MPa → Pa (× 1e6)"), (1e-9, "MPa → 1e15 Pa (× 1e-9)")):
        yield Case("units", "random inclusions", text, bind(scaled, 1.0, modulus))
    for distance in (1e4, 1e6):
        yield Case("units", "far from the origin", f"{distance:.0e} mm", bind(far_away, distance))
    for angle in (30.0, 90.0, 180.0):
        text = f"{_number(angle)}°"
        yield Case(
            "large moves", "rigid boundary", text, bind(rigid_patch, angle, isotropic(FAT, NU)), ALL
        )
        yield Case("large moves", "one segment turned", text, bind(moved, angle, 0.0))
    yield Case(
        "large moves", "rigid boundary", "50 mm", bind(rigid_patch, 0.0, isotropic(FAT, NU), 50.0)
    )
    yield Case("large moves", "one segment moved", "50 mm", bind(moved, 0.0, 50.0), ALL)
    yield Case("large moves", "one segment moved", "50 mm and 90°", bind(moved, 90.0, 50.0))
    yield Case("large moves", "one segment moved", "1e-9 mm", bind(moved, 0.0, 1e-9), ALL)
    for shift in (0.0, 1e-15):
        text = f"segment moved by {_number(shift)} mm"
        yield Case("loads", "random inclusions", text, bind(loaded, shift), ALL)
    yield Case("loads", "cantilever 1:3", "1e-03 N", bind(slender, 3, 1e-3), ALL)
    yield Case("loads", "cantilever 1:3", "1e+06 N", bind(slender, 3, 1e6), ALL)
    for load in (1e-3, 1e-12):
        yield Case("loads", "cantilever 1:20", f"{load:.0e} N", bind(slender, 20, load), ALL)
    yield Case("loads", "cantilever 1:200", "1e-03 N", bind(slender, 200, 1e-3), ALL)
    yield Case("loads", "cantilever 1:1000", "1e-03 N", bind(slender, 1000, 1e-3))
    for offset in (1.0, 1e-1, 1e-2, 1e-3):
        text = f"{_number(offset)} mm off the line"
        build = bind(hung_on_three_nodes, offset)
        # From there on κ ε > 1e-4: counted as in line.
        refusal = ("rotation about x",) if offset < 1e-2 else ()
        yield Case("holding", "three nodes almost in line", text, build, FAST, refusal)
    yield Case("small", "single tet", "all joined", bind(single_tet, 4), ALL)
    yield Case("small", "single tet", "3 joined, 1 free", bind(single_tet, 3), ALL)
    yield Case("small", "single tet", "3 joined, 1 fixed", bind(single_tet, 3, fixed=1), ALL)
    yield Case("small", "single tet", "all fixed", bind(single_tet, 0, fixed=4), ALL)
    yield Case(
        "holding", "single tet", "2 joined, 2 free", bind(single_tet, 2), ALL, ("rotation about x",)
    )
    yield Case(
        "holding",
        "single tet",
        "1 joined, 3 free",
        bind(single_tet, 1),
        ALL,
        ("rotation about",) * 3,
    )
    for count in (1, 30, 31):
        text = f"{count} apart from one another"
        yield Case("holding", "three-hinged arches", text, bind(arches, count), ALL)
    yield Case("holding", "two islands", "both held", bind(islands, second_held=True), ALL)
    free = "all six rigid modes are free"
    yield Case(
        "holding",
        "two islands",
        "one unheld",
        bind(islands, second_held=False),
        ALL,
        (free, "part"),
    )
    yield Case(
        "holding", "block afloat in a cavity", "touches nothing", afloat, ALL, (free, "part")
    )
    yield Case("holding", "body", "no node held", unheld, ALL, (free, "the body"))
    yield Case("holding", "body", "one node held", bind(pinned, 1), ALL, ("rotation about",) * 3)
    yield Case("holding", "body", "two nodes held", bind(pinned, 2), ALL, ("rotation about x",))
    yield Case("holding", "hinge", "edge", bind(hinge, "edge"), ALL, ("rotation about z", "part"))
    yield Case(
        "holding", "hinge", "node", bind(hinge, "node"), ALL, ("rotation about",) * 3 + ("part",)
    )
    for shared in ("edge", "node"):
        text = f"{shared}, far end held"
        yield Case("holding", "hinge", text, bind(hinge, shared, far_end_held=True), ALL)
    for degrees, nu, power in ((1.0, 0.49, 4), (1.0, 0.499, 6), (0.1, 0.4999, 8)):
        text = f"ν = {_number(nu)}, contrast 1e{power}, {_number(degrees)}°"
        yield Case("all at once", "block", text, bind(squashed, degrees, nu, 10.0**power), ALL)


# Running.


@functools.cache
def problem(case: Case) -> Problem:
    """The built case."""
    return case.build()


@functools.cache
def model(case: Case) -> ExtendedModel:
    """Its forces with 32 digits."""
    p = problem(case)
    return ExtendedModel(p.nodes, p.tets, p.materials, p.material_of)


@functools.cache
def reference(case: Case) -> Reference:
    """Its displacements with 32 digits."""
    p = problem(case)
    return solve(model(case), *p.prescribed(), p.loads)


def run_cmfsim(case: Case, method: str) -> cmfsim.Solution:
    """What a user would do with the case."""
    p = problem(case)
    along, across, nu = (
        np.array([getattr(m, name) for m in p.materials])[p.material_of]
        for name in ("along", "across", "poisson")
    )
    if all(m.fibre is None for m in p.materials):
        tissue = cmfsim.Tissue.isotropic(along, nu)
    else:
        fibre = np.array([m.fibre for m in p.materials])[p.material_of]
        tissue = cmfsim.Tissue.transversely_isotropic(along, across, nu, fibre)
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(p.nodes, p.tets), tissue)
    boundary = cmfsim.Boundary(fixed=p.fixed, joined=p.joined)
    limit = SWEEPS if method == "relaxation" else None
    solver = cmfsim.StaticSolver(
        tensors, boundary, method, max_iterations=limit, tolerance=case.tolerance
    )
    return solver.solve(p.plan, loads=p.loads)


@contextmanager
def patience(seconds: int) -> Iterator[None]:
    """A TimeoutError after some seconds, where the platform has alarms."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def ring(_number: int, _frame: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def judge(case: Case, method: str) -> Row:
    """Solves a case with a method and compares."""
    blank = Row(
        case.group,
        case.name,
        case.parameter,
        method,
    )
    problem(case)
    begin = time.perf_counter()
    try:
        with patience(PATIENCE):
            result = run_cmfsim(case, method)
    except cmfsim.CmfsimError as error:
        return _refused(case, blank, error, time.perf_counter() - begin)
    except TimeoutError:
        return replace(blank, verdict=f"WRONG: no answer in {PATIENCE} s")
    except BaseException as error:  # a Rust panic is no Exception
        if isinstance(error, KeyboardInterrupt):
            raise
        return replace(blank, verdict=f"WRONG: {type(error).__name__}: {error}")
    return _compared(case, method, blank, result, time.perf_counter() - begin)


def _refused(case: Case, row: Row, error: cmfsim.CmfsimError, seconds: float) -> Row:
    """A refusal: wanted where nothing holds the body, and open to the iterative methods."""
    text = f"{type(error).__name__}: {error}"
    verdict = f"refused: {text}"
    if case.refusal:
        counts = {word: case.refusal.count(word) for word in case.refusal}
        named = all(text.count(word) >= count for word, count in counts.items())
        passed = isinstance(error, cmfsim.BoundaryError) and named
        if not passed:
            verdict = f"WRONG: the refusal must be a BoundaryError with {case.refusal}: {text}"
        return replace(row, seconds=seconds, verdict=verdict, passed=passed, reference="mechanism")
    condition = reference(case).condition
    round_off = CONDITION_FACTOR * EPS * condition
    open_to = {
        "cholesky": round_off > WORTHLESS,
        "pcg": round_off > case.tolerance,
        "relaxation": round_off > case.tolerance or condition > SWEEPS,
    }
    passed = open_to[row.method] and isinstance(error, cmfsim.SolverError)
    if not passed:
        verdict = f"WRONG: refused though κ ε leaves room to solve it: {text}"
    return replace(
        row,
        seconds=seconds,
        verdict=verdict,
        passed=passed,
        condition=condition,
        reference=_kind(case),
    )


def _kind(case: Case) -> str:
    return "32 digits" if problem(case).exact is None else "closed form"


def _compared(case: Case, method: str, row: Row, result: cmfsim.Solution, seconds: float) -> Row:
    p = problem(case)
    if case.refusal:
        return replace(row, seconds=seconds, verdict="WRONG: solved, but it is a mechanism")
    known = reference(case)
    exact = known.displacements if p.exact is None else p.exact
    u = result.displacements
    size = float(np.linalg.norm(exact, axis=1).max()) or 1.0
    error = float(np.linalg.norm(u - exact, axis=1).max()) / size
    bound = result.error_bound / size
    rounding, true_residual = _residual(case, u)
    round_off = min(CONDITION_FACTOR * EPS * known.condition, WORTHLESS)
    if method == "cholesky":
        allowed = min(max(ERROR_LIMIT, round_off), bound + round_off)
    else:
        allowed = BOUND_FACTOR * bound + round_off
    floor = RESIDUAL_FACTOR * rounding
    faults = []
    if not error <= allowed:
        faults.append(f"error {error:.1e} where {allowed:.1e} is allowed")
    if not abs(result.residual - true_residual) <= floor + 0.01 * true_residual:
        faults.append(f"reports residual {result.residual:.1e}, true is {true_residual:.1e}")
    if method == "cholesky" and not true_residual <= floor:
        faults.append(f"residual {true_residual:.1e} above round-off {floor:.1e}")
    return replace(
        row,
        condition=known.condition,
        reference=_kind(case),
        residual=result.residual,
        true_residual=true_residual,
        error=error,
        error_bound=bound,
        allowed=allowed,
        iterations=result.iterations,
        seconds=seconds,
        verdict="ok" if not faults else "WRONG: " + "; ".join(faults),
        passed=not faults,
    )


def _residual(case: Case, u: Floats) -> tuple[float, float]:
    """ε ‖|K| |u|‖ / ‖b‖ and ‖K u − loads‖ / ‖b‖ over the unknowns, b the forces brought in."""
    p = problem(case)
    mask, motion = p.prescribed()
    unknown = np.repeat(~mask, 3)
    if not unknown.any():
        return 0.0, 0.0
    loads = np.zeros_like(u) if p.loads is None else p.loads
    brought = (model(case).forces(motion) - Twofold(loads)).hi.ravel()[unknown]
    rest = (model(case).forces(Twofold(u)) - Twofold(loads)).hi.ravel()[unknown]
    size = float(np.linalg.norm(brought)) or 1.0
    products = (abs(model(case).matrix) @ np.abs(u).ravel())[unknown]
    softening = max(max(m.across / m.along, 1.0) for m in p.materials)
    rounding = EPS * softening * float(np.linalg.norm(products)) / size
    return rounding, float(np.linalg.norm(rest)) / size


INTRODUCTION = f"""# Numerical stability: the stiff and extreme suite

Made by `python benches/stability.py --markdown docs/stability.md`; `tests/python/test_extreme.py`
runs the same cases. Numbers near 1e-15 differ from machine to machine.

## How to read the tables

- **condition** is the extreme value of the case.
- **κ** is the condition number κ₂ of D^-½ K D^-½ over the unknowns (K the stiffness, D its
  diagonal): the number that bounds the error of Cholesky's method (van der Sluis 1969). Moduli in
  another unit, or a stiff layer on a soft one, do not raise it; a stiff body that only soft tissue
  holds does.
- **reference** is never cmfsim. *Closed form*: a field that the mesh can represent (affine, rigid,
  piecewise linear in layers), so the discrete answer is the analytical one. *32 digits*:
  `benches/extended.py` builds elasticity from the engineering compliance with 60 decimal digits,
  sums forces tet by tet in pairs of float64 (Dekker 1971), and refines until the last correction is
  below 1e-18 of the displacements; the tests hold it against the closed forms and against a
  solution in exact fractions. *Mechanism*: there is no solution, and it must be refused.
- **residual** is `result.residual`: forces out of balance over the forces that the plan brings in.
  It is checked against the residual in 32 digits. It says little about the error where κ is large.
- **error** is the largest distance of a node from its reference position over the largest
  displacement.
- **bound** is `result.error_bound` over the largest displacement; for Cholesky an estimate, ten
  times the error with which the factor recovered a known solution.
- **verdict**: *ok*, *refused* with the error raised, or **WRONG**.

What is *ok*, with ε = 2.2e-16: Cholesky's error is within the larger of {ERROR_LIMIT:.0e} and
{CONDITION_FACTOR:g} ε κ. The error of `pcg` and `relaxation` is within {BOUND_FACTOR:g} × their
bound plus {CONDITION_FACTOR:g} ε κ: the bounds are of the equations in float64, whose own rounding
is of the order ε κ. No such allowance is ever more than {WORTHLESS:.0e}. A solvable case may be
refused (`SolverError`) by Cholesky where {CONDITION_FACTOR:g} ε κ > {WORTHLESS:.0e}, by `pcg` where
{CONDITION_FACTOR:g} ε κ exceeds the tolerance asked for (1e-9 unless stated), by `relaxation` there
or where κ exceeds the {SWEEPS} sweeps that it gets here.

The tables measure what the solvers make of a mesh, not what the mesh makes of the tissue: linear
tets lock as ν nears 0.5 however exactly their equations are solved.

## Where a method must not be used

- **cholesky**: it loses log10 κ of its 16 digits, so an answer at κ of 1e12 (a bar 1000 times as
  long as thick) has four; `result.error_bound` says so. Not far above, it is refused.
- **pcg**: where κ is above about 1e7: stiff tissue that soft tissue holds with a contrast above
  1e6, slender bodies. Rounding then keeps it from its tolerance, and it raises `SolverError`.
- **relaxation**: stiff bodies in soft tissue with a contrast above 1e2, ν above 0.49, slivers: it
  runs out of sweeps and raises `SolverError`. It measures its error by conjugate gradients, so it
  is refused wherever these are.
- **p1**: bending tissue with ν above 0.45: it locks, silently. `anp` and `p2` do not (theory,
  *Elements*; `tests/python/test_elements.py`).
- **relaxation** and **plan_operator** with `corotational` or `hyperelastic`: they are of the linear
  model, and raise `SolverError`. So does a plan that Newton's method does not bring to rest in 64
  parts.
- Nodes that hold a body and lie within about 1e-4 of its size of one line count as in line:
  `BoundaryError`.
"""


def table(rows: list[Row]) -> str:
    """The rows as Markdown tables, one per group; methods that refuse alike share a line."""
    out = []
    groups = dict.fromkeys(r.group for r in rows)
    for group in groups:
        out += [
            f"## {group[0].upper()}{group[1:]}",
            "",
            "| case | condition | κ | reference | method | residual | error | bound | verdict |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        members = [r for r in rows if r.group == group]
        for _, alike in itertools.groupby(members, key=_line):
            same = list(alike)
            r = same[0]
            numbers = [_cell(v) for v in (r.residual, r.error, r.error_bound)]
            if r.method == "cholesky":
                numbers[2] = "–"
            methods = ", ".join(other.method for other in same)
            condition = _cell(r.condition)
            cells = [r.name, r.parameter, condition, r.reference, methods, *numbers, _verdict(r)]
            out.append("| " + " | ".join(cells) + " |")
        out.append("")
    return "\n".join(out)


def _line(row: Row) -> tuple[str, ...]:
    """What rows that share a line have in common: solved ones share with none."""
    method = row.method if row.error is not None else ""
    return (row.name, row.parameter, method, _verdict(row))


def _verdict(row: Row) -> str:
    """The verdict without the advice at the end of a message."""
    text = row.verdict
    for advice in ("; use ", "; fix or join", "; a part of the body may"):
        text = text.split(advice)[0]
    if not row.passed:
        text = f"**{text}**"
    return text.replace("|", "\\|")


def _cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.1e}"


def main(arguments: list[str] | None = None) -> int:
    """Runs the suite; 1 if any verdict is not the wanted one."""
    parser = argparse.ArgumentParser(description="stiff and extreme cases against references")
    parser.add_argument("--markdown", type=Path, help="file for the table with its introduction")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--quick", action="store_true", help="leave the larger cases out")
    parser.add_argument("--only", default="", help="run the cases whose name holds this text")
    options = parser.parse_args(arguments)
    rows = []
    for case in cases(quick=options.quick):
        if options.only not in case.key:
            continue
        for method in case.methods:
            row = judge(case, method)
            rows.append(row)
            print(
                f"{case.key:60.60} {method:10} κ {_cell(row.condition)} res {_cell(row.residual)} "
                f"err {_cell(row.error)} bound {_cell(row.error_bound)} it {row.iterations} "
                f"{row.seconds:6.2f} s  {row.verdict}",
                flush=True,
            )
        for cached in (problem, model, reference):
            cached.cache_clear()
    failed = [r for r in rows if not r.passed]
    if options.json:
        options.json.write_text(json.dumps([asdict(r) for r in rows], indent=1) + "\n")
    if options.markdown:
        options.markdown.write_text(INTRODUCTION + "\n" + table(rows), encoding="utf-8")
    print(f"{len(rows)} solves, {len(failed)} not as wanted")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
