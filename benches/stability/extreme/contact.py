"""Sliding contact: stiff and extreme scenes against the moved surface itself and 32 digits.

The displacements are compared with those of a body in equilibrium under the same walls and normals:
u = u_p + Z y, N u_p = N (c − x) + g, Z spanning the null space of the normals N, and Zᵀ f(u) = 0
refined with 32 digits. Only the final normals come from cmfsim, and these are compared with the
facets of the wall. Where the wall bends, the contact points also come from cmfsim, because its
facets are curved and its edges rounded.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import cmfsim
from benches.scenes.extended import ExtendedModel, Twofold, condition_number
from benches.stability.extreme.contact_scenes import (
    Scene,
    cornered,
    dome,
    flat,
    hollow,
    in_a_cup,
    pinned_on_a_wall,
    push,
    relief,
    resting,
    slope,
    waves,
)
from benches.stability.extreme.distance import closest
from benches.stability.extreme.rows import (
    CONDITION_FACTOR,
    EPS,
    FAST,
    PATIENCE,
    SWEEPS,
    WORTHLESS,
    Case,
    Row,
    patience,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Indices = NDArray[np.uint32]

# Largest distance from the moved surface, mm, and largest tangential share of the contact forces.
DISTANCE = 1e-6
TANGENTIAL = 1e-6
# The same from a wall that bends, over the mean edge of the tissue: facets are felt as curved, and
# edges sharper than the tissue's mesh as round.
ROUNDED = 0.3
# Error over the largest displacement from the equilibrium with the same normals.
ERROR = 1e-7
# A body that is carried along has no contact forces to compare with: there they count as this share
# of E |u| L, the force that the displacements would bring if the body were strained by them.
UNSTRESSED = 1e-3
# A held node presses with more than this share of the largest contact force.
PRESSED = 1e-9
# Refinement steps of the equilibrium; each gains log10(1 / (ε κ)) digits.
REFINEMENTS = 12
# Sides of a crease, degrees, between which a body that is pushed across may find no rest.
STEEPEST = 85.0
# Largest angle between a unit normal and a flat wall, as a cosine.
FLAT = 1.0 - 1e-12
COLUMNS = ("κ", "true residual", "error", "distance, mm", "tangential")


# Cases.


def cases(*, quick: bool = False) -> list[Case]:
    """All scenes, or with `quick` the ones that the tests run."""
    return [c for c in _cases() if c.quick or not quick]


def _cases() -> Iterator[Case]:
    bind = functools.partial
    flat_wall, press = flat(), push((2.0, 1.0, -3.0), 4.0)
    for power in (0, 4, 6, 8):
        text = f"contrast 1e{power}"
        build = bind(resting, flat_wall, press, contrast=10.0**power)
        yield Case("contact", "flat wall", text, build, FAST, quick=power in (0, 6))
        carried = bind(in_a_cup, 10.0**power, carried=True)
        yield Case("contact", "ball carried in a cup", text, carried, FAST, quick=power == 6)
        turned = bind(in_a_cup, 10.0**power, carried=False)
        yield Case("contact", "ball turned in a cup", text, turned, FAST, quick=False)
    for angle in (15.0, 45.0, 70.0, STEEPEST):
        for name, sign in (("roof", -1.0), ("gutter", 1.0)):
            shape = slope(angle, sign)
            # Steep sides turn jittered tets over.
            jitter = 0.2 if angle <= 45.0 else 0.0
            across = push((6.0, 1.0, -3.0), 4.0)
            build = bind(
                resting,
                relief(shape, 6),
                across,
                shape=shape,
                bend=90.0,
                jitter=jitter,
                may_not_settle=angle == STEEPEST,
            )
            yield Case("contact", name, f"{angle:g}° a side", build, quick=angle == 45.0)
    for name, shape in (("dome", dome), ("hollow", hollow), ("waves", waves(1.5, 24.0))):
        for text, cells in (("coarse wall", 8), ("fine wall", 90)):
            build = bind(resting, relief(shape, cells), press, shape=shape, bend=40.0)
            yield Case("contact", name, text, build, quick=cells == 8)
    for height, length in ((1.0, 8.0), (4.0, 24.0)):
        shape = waves(height, length)
        text = f"{2 * height:g} mm high, {length:g} mm apart, moved by 20 mm"
        build = bind(resting, relief(shape, 120), push((20.0, 0.0, -1.0)), shape=shape, bend=60.0)
        yield Case("contact", "bumps", text, build, quick=False)
    for text, cells in (("2 triangles", 1), ("20 000 triangles", 100)):
        build = bind(resting, flat(cells, 2), press, contrast=1e4)
        yield Case("contact", "flat wall", text, build, quick=False)
    far = push((20.0, 0.0, 0.0), 30.0)
    yield Case("contact", "flat wall", "20 mm and 30°", bind(resting, flat_wall, far, contrast=1e4))
    yield Case(
        "contact",
        "dome",
        "20 mm and 30°",
        bind(resting, relief(dome, 16), far, shape=dome, bend=40.0),
        quick=False,
    )
    wall_moves = cmfsim.rigid_motion((20.0, 0.0, 5.0), 30.0, (0.0, 0.0, 1.0), (30.0, 25.0, 0.0))
    yield Case(
        "contact",
        "dome that moves",
        "20 mm and 30°",
        bind(resting, relief(dome, 16), np.eye(4), shape=dome, move=wall_moves, bend=40.0),
        quick=False,
    )
    lift = cmfsim.rigid_motion((0.0, 0.0, -0.5), 12.0, (0.0, 1.0, 0.0), (30.0, 25.0, 40.0))
    for power in (0, 4, 6):
        build = bind(resting, flat_wall, lift, contrast=10.0**power, contact="unilateral")
        yield Case("lift-off", "flat wall", f"contrast 1e{power}", build, quick=power == 4)
    for name, shape in (("dome", dome), ("gutter of 45°", slope(45.0, 1.0))):
        build = bind(resting, relief(shape, 12), lift, shape=shape, contact="unilateral", bend=90.0)
        yield Case("lift-off", name, "tilted by 12°", build, quick=False)
    away = push((0.0, 0.0, 6.0))
    build = bind(resting, flat_wall, away, contrast=1e4, contact="unilateral")
    yield Case("lift-off", "flat wall", "all nodes let go", build)
    for tolerance in (1e-4, 1e-6, 1e-12, 1e-15):
        build = bind(
            resting, relief(dome, 16), press, shape=dome, contact_tolerance=tolerance, bend=40.0
        )
        yield Case("contact tolerance", "dome", f"{tolerance:.0e}", build, quick=False)
    for gap in (0.5, -0.5, 5.0):
        build = bind(resting, relief(dome, 16), press, shape=dome, gap=gap, bend=40.0)
        yield Case("contact tolerance", "dome", f"gap {gap:g} mm", build, quick=gap == 0.5)
    for scale in (1e3, 1e-3, 1e-6):
        build = bind(resting, flat_wall, press, contrast=1e4, scale=scale)
        yield Case("contact", "flat wall", f"lengths × {scale:.0e}", build, quick=False)
    yield Case("held by contact", "three walls", "carried", bind(cornered, 3))
    yield Case("held by contact", "three walls", "contrast 1e6", bind(cornered, 3, 1e6))
    free = ("translation along",)
    yield Case("held by contact", "two walls", "carried", bind(cornered, 2), FAST, free)
    yield Case("held by contact", "one wall", "carried", bind(cornered, 1), FAST, ("rotation",))
    for apart in (10.0, 0.1, 1e-3):
        text = f"pins {apart:g} mm apart"
        # The nearest pins count as one.
        refusal = ("rotation about z",) if apart < 0.01 else ()
        build = bind(pinned_on_a_wall, apart)
        yield Case("held by contact", "block on a wall", text, build, FAST, refusal)
    build = bind(pinned_on_a_wall, None)
    yield Case("held by contact", "block on a wall", "one pin", build, FAST, ("rotation about z",))


# Running.


@functools.cache
def scene(case: Case) -> Scene:
    """The built scene."""
    built: Scene = case.build()
    return built


@functools.cache
def model(case: Case) -> ExtendedModel:
    """The forces of its body with 32 digits."""
    p = scene(case).body
    return ExtendedModel(p.nodes, p.tets, p.materials, p.material_of)


def forget() -> None:
    """Drops what is kept of the scenes."""
    scene.cache_clear()
    model.cache_clear()


def run_cmfsim(case: Case, method: str) -> cmfsim.Solution:
    """What a user would do with the scene."""
    s = scene(case)
    p = s.body
    young = np.array([m.along for m in p.materials])[p.material_of]
    poisson = np.array([m.poisson for m in p.materials])[p.material_of]
    tensors = cmfsim.MassTensors(
        cmfsim.TetMesh(p.nodes, p.tets), cmfsim.Tissue.isotropic(young, poisson)
    )
    boundary = cmfsim.Boundary(
        fixed=p.fixed,
        joined=p.joined,
        sliding=s.sliding,
        contact={name: cmfsim.Surface(*wall) for name, wall in s.walls.items()},
        gap=dict.fromkeys(s.sliding, s.gap),
    )
    solver = cmfsim.StaticSolver(
        tensors,
        boundary,
        method,
        contact=s.contact,
        tolerance=case.tolerance,
        contact_tolerance=s.contact_tolerance,
        max_iterations=SWEEPS if method == "relaxation" else None,
    )
    return solver.solve({**p.plan, **s.moves})


def judge(case: Case, method: str) -> Row:
    """Solves a scene with a method and holds it against the wall and the equilibrium."""
    blank = Row(case.group, case.name, case.parameter, method)
    scene(case)
    begin = time.perf_counter()
    try:
        with patience(PATIENCE):
            result = run_cmfsim(case, method)
    except cmfsim.CmfsimError as error:
        text = f"{type(error).__name__}: {error}"
        row = replace(blank, seconds=time.perf_counter() - begin)
        return _refused(case, row, error, text)
    except TimeoutError:
        return replace(blank, verdict=f"WRONG: no answer in {PATIENCE} s")
    row = replace(blank, seconds=time.perf_counter() - begin, iterations=result.contact_iterations)
    if case.refusal:
        return replace(row, verdict="WRONG: solved, but it is a mechanism")
    return _compared(case, row, result)


def _refused(case: Case, row: Row, error: cmfsim.CmfsimError, text: str) -> Row:
    wanted = bool(case.refusal) and isinstance(error, cmfsim.BoundaryError)
    wanted &= all(word in text for word in case.refusal)
    if scene(case).may_not_settle and isinstance(error, cmfsim.ContactError):
        return replace(row, verdict=f"refused: {text}", passed=True)
    verdict = f"refused: {text}" if wanted else f"WRONG: refused: {text}"
    return replace(row, verdict=verdict, passed=wanted, reference="mechanism" if wanted else "")


@dataclass(frozen=True, eq=False)
class _Held:
    """Sliding nodes that walls hold, where these are, and their normals."""

    nodes: list[int] = field(default_factory=list)
    points: list[Floats] = field(default_factory=list)
    normals: list[Floats] = field(default_factory=list)


def _compared(case: Case, row: Row, result: cmfsim.Solution) -> Row:
    s = scene(case)
    p = s.body
    u = result.displacements
    moved_to = p.nodes + u
    faults = []
    normal_of = dict(zip(result.contact_nodes.tolist(), result.contact_normals, strict=True))
    force_of = dict(zip(result.contact_nodes.tolist(), result.contact_forces, strict=True))
    gap_of = dict(zip(result.contact_nodes.tolist(), result.contact_gaps, strict=True))
    largest = max(map(abs, force_of.values()), default=0.0)
    distances, held = [], _Held()
    for name, ids in s.sliding.items():
        vertices, triangles = s.walls[name]
        matrix = s.moves[name]
        near = closest(moved_to[ids], vertices @ matrix[:3, :3].T + matrix[:3, 3], triangles)
        rows = zip(ids.tolist(), near.points, near.distances - s.gap, near.normals, strict=True)
        for node, point, distance, facets in rows:
            n = normal_of[node]
            presses = s.contact == "bilateral" or force_of[node] > PRESSED * largest
            if not presses:
                distances.append(min(distance, 0.0))
                continue
            distances.append(distance)
            least = FLAT if s.bend == 0.0 else np.cos(np.radians(s.bend))
            if (facets @ n).max() < least:
                faults.append(f"normal of node {node} is not that of the wall")
            on_wall = point + s.gap * _away(moved_to[node] - point, n)
            held.nodes.append(node)
            held.points.append(on_wall if s.bend == 0.0 else moved_to[node] - gap_of[node] * n)
            held.normals.append(n[None])
    if s.contact == "unilateral":
        pull = -min(min(force_of.values(), default=0.0), 0.0)
        if pull > TANGENTIAL * largest:
            faults.append(f"a contact pulls with {pull / largest:.1e} of the largest force")
    lost = float(np.abs(distances).max())
    found, condition, residual = _equilibrium(case, held, u)
    # On a wall that bends, what nodes feel is near its facets, not on them.
    is_exact = p.exact is not None and s.bend == 0.0
    exact = p.exact if is_exact and p.exact is not None else found
    size = float(np.linalg.norm(exact, axis=1).max())
    error = float(np.linalg.norm(u - exact, axis=1).max()) / size
    tangential = _tangential(case, held, u)
    round_off = min(CONDITION_FACTOR * EPS * condition, WORTHLESS)
    allowed = max(ERROR, round_off, 10 * s.contact_tolerance / size)
    limit = max(DISTANCE, 2 * s.contact_tolerance)
    if s.bend > 0.0:
        corners = p.nodes[p.tets]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        limit += ROUNDED * float(edges.mean())
    if lost > limit:
        faults.append(f"a node is {lost:.1e} mm from its place on the surface")
    if tangential > max(TANGENTIAL, 10 * s.contact_tolerance):
        faults.append(f"tangential force {tangential:.1e} of the largest")
    if error > allowed:
        faults.append(f"error {error:.1e} where {allowed:.1e} is allowed")
    return replace(
        row,
        condition=condition,
        reference="closed form" if is_exact else "32 digits",
        residual=result.residual,
        true_residual=residual,
        error=error,
        error_estimate=result.error_estimate / size,
        allowed=allowed,
        distance=lost,
        tangential=tangential,
        verdict="ok" if not faults else "WRONG: " + "; ".join(faults[:3]),
        passed=not faults,
    )


def _away(offset: Floats, normal: Floats) -> Floats:
    """Unit vector from a closest point to its node, on the side of the normal."""
    length = float(np.linalg.norm(offset))
    return normal if length == 0.0 else offset / np.copysign(length, offset @ normal)


def _equilibrium(case: Case, held: _Held, start: Floats) -> tuple[Floats, float, float]:
    """Equilibrium on the tangents of the walls, its condition, and the residual of `start`."""
    p = scene(case).body
    mask, motion = p.prescribed()
    n = len(p.nodes)
    columns, bases, offsets = np.zeros(n, dtype=np.int64), [], np.zeros((n, 3))
    at = {node: i for i, node in enumerate(held.nodes)}
    for node in range(n):
        if mask[node]:
            bases.append(np.zeros((3, 0)))
        elif node in at:
            i = at[node]
            normals = held.normals[i]
            _, sizes, rows = np.linalg.svd(normals)
            rank = int((sizes > 1e-6).sum())
            bases.append(rows[rank:].T)
            goal = normals @ (held.points[i] - p.nodes[node])
            offsets[node] = np.linalg.lstsq(normals, goal, rcond=None)[0]
        else:
            bases.append(np.eye(3))
        columns[node] = bases[-1].shape[1]
    z: Any = sp.block_diag(bases, format="csr")
    u = motion + Twofold(offsets)
    matrix = sp.csc_matrix(z.T @ model(case).matrix @ z)
    scale = 1.0 / np.sqrt(matrix.diagonal())
    scaled = sp.csc_matrix(sp.diags(scale) @ matrix @ sp.diags(scale))
    factor = spla.splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    brought = np.linalg.norm(z.T @ model(case).forces(u).hi.ravel()) or 1.0
    for _ in range(REFINEMENTS):
        rest = z.T @ model(case).forces(u).hi.ravel()
        change = z @ (scale * factor.solve(scale * rest))
        u = u - Twofold(change.reshape(-1, 3))
        if np.abs(change).max() <= EPS * np.abs(u.hi).max():
            break
    left = np.linalg.norm(z.T @ model(case).forces(Twofold(start)).hi.ravel())
    return u.hi, condition_number(scaled, factor), float(left / brought)


def _tangential(case: Case, held: _Held, u: Floats) -> float:
    """Largest force across the normals of held nodes over the largest force along them."""
    forces = model(case).forces(Twofold(u)).hi
    across, along = 0.0, 0.0
    for node, normals in zip(held.nodes, held.normals, strict=True):
        part = normals.T @ np.linalg.lstsq(normals.T, forces[node], rcond=None)[0]
        across = max(across, float(np.linalg.norm(forces[node] - part)))
        along = max(along, float(np.linalg.norm(part)))
    p = scene(case).body
    extent = float(np.ptp(p.nodes, axis=0).max())
    moved = float(np.linalg.norm(u, axis=1).max())
    return across / max(along, UNSTRESSED * max(m.along for m in p.materials) * moved * extent)
