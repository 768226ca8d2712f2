"""Linear cases on one body: closed forms, contrast, fibres, slivers, units, moves and loads."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

import cmfsim
from benches.scenes.extended import Material, isotropic
from benches.scenes.meshes import box, oriented, spherical_shell
from benches.stability.extreme.problem import FAT, MUSCLE, NU, Problem, hull, one, slivers, where

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]

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
