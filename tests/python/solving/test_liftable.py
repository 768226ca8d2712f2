"""Nodes that plans hold or free: one factor for all plans, against a solver of each of them."""

import os
import subprocess
import sys

import numpy as np
import pytest
from block_scene import floor

import cmfsim
from benches.scenes import meshes

NODES, TETS = meshes.box((4, 3, 3), (12.0, 9.0, 6.0), jitter=0.1)
SIDE = meshes.nodes_where((NODES[:, 0] == 0.0) & (NODES[:, 2] > 0.0))
LOW = meshes.nodes_where(NODES[:, 2] == 0.0)
FAR = meshes.nodes_where((NODES[:, 0] == 12.0) & (NODES[:, 2] > 0.0))
HIGH = np.setdiff1d(meshes.nodes_where(NODES[:, 2] == 6.0), np.concatenate([SIDE, FAR]))
OPTIONS = {"method": "cholesky", "contact_tolerance": 1e-9}
PLAN = {
    "bone": cmfsim.rigid_motion((0.4, 0.3, -0.2), 4.0, (1, 2, 0.5), (6, 4, 6)),
    "floor": cmfsim.rigid_motion((0.1, 0.0, 0.3), 3.0, (1, -1, 0), (6, 4, 0)),
}
SOME = FAR[::2]


def tensors():
    young = np.random.default_rng(0).uniform(0.1, 1.0, len(TETS))
    return cmfsim.MassTensors(cmfsim.TetMesh(NODES, TETS), cmfsim.Tissue.isotropic(young, 0.4))


def boundary(held, segment, *, slides=True, liftable=None):
    """With the nodes `held` fixed, or joined to the segment."""
    fixed = np.concatenate([SIDE, held]) if segment is None else SIDE
    bone = HIGH if segment is None else np.concatenate([HIGH, held])
    joined, sliding = {"bone": bone}, {}
    if slides:
        sliding = {"sliding": {"floor": LOW}, "contact": {"floor": floor().searched}}
    return cmfsim.Boundary(fixed, joined, **sliding, liftable=liftable)


def solvers(held, segment, *, slides=True):
    """One for these nodes alone, and one that was made for others."""
    made, plan = tensors(), PLAN if slides else {"bone": PLAN["bone"]}
    alone = cmfsim.StaticSolver(made, boundary(held, segment, slides=slides), **OPTIONS)
    others = boundary(FAR[:3], segment, slides=slides, liftable=(FAR, segment))
    return alone, cmfsim.StaticSolver(made, others, **OPTIONS).holding(held), plan


def check_equal(found, expected):
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max(initial=1e-9))


@pytest.mark.parametrize("slides", [False, True])
@pytest.mark.parametrize("segment", [None, "bone"])
@pytest.mark.parametrize("held", [FAR[:0], FAR[:3], SOME, FAR], ids=["none", "own", "some", "all"])
def test_solutions_are_those_of_a_solver_of_the_held_nodes(held, segment, slides):
    alone, shared, plan = solvers(held, segment, slides=slides)
    loads = np.random.default_rng(1).normal(0, 1e-3, NODES.shape)
    expected, found = (solver.solve(plan, loads=loads) for solver in (alone, shared))
    check_equal(found.displacements, expected.displacements)
    check_equal(found.forces, expected.forces)
    check_equal(found.contact_forces, expected.contact_forces)
    assert found.residual < 1e-8
    assert shared.n_unknowns == alone.n_unknowns
    np.testing.assert_array_equal(np.sort(shared.boundary.fixed), np.sort(alone.boundary.fixed))
    operators = [solver.plan_operator(plan=plan) for solver in (alone, shared)]
    check_equal(operators[1].matrix, operators[0].matrix)
    check_equal(operators[1](plan), operators[0](plan))
    rate = np.zeros((4, 4))
    rate[:3, 3], rate[0, 1], rate[1, 0] = (0.3, -0.2, 0.5), -0.1, 0.1
    both = zip((alone, shared), (expected, found), strict=True)
    changes = [s.responses(solution, plan, [loads, {"bone": rate}]) for s, solution in both]
    for one, other in zip(*changes, strict=True):
        check_equal(other, one)


def test_doubtful_tissue_is_refined_with_held_nodes_at_rest():
    young = np.where(np.arange(len(TETS)) % 2, 1e6, 1.0)
    mesh = cmfsim.TetMesh(NODES, TETS)
    made = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(young, 0.4))
    whole = boundary(FAR, None, slides=False, liftable=(FAR, None))
    found = cmfsim.StaticSolver(made, whole, **OPTIONS).holding(SOME).solve({"bone": PLAN["bone"]})
    alone = cmfsim.StaticSolver(made, boundary(SOME, None, slides=False), **OPTIONS)
    check_equal(found.displacements, alone.solve({"bone": PLAN["bone"]}).displacements)
    assert not found.displacements[SOME].any()


def thread_digest():
    _, shared, plan = solvers(SOME, "bone")
    values = [shared.solve(plan).displacements, shared.plan_operator(plan=plan).matrix]
    return b"".join(np.ascontiguousarray(v).tobytes() for v in values).hex()


def test_bits_do_not_depend_on_threads_or_earlier_plans():
    script = f"import sys; sys.path[:0] = {sys.path!r}; import test_liftable as t; "
    script += "print(t.thread_digest())"
    digests = {
        subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "RAYON_NUM_THREADS": str(threads)},
            check=True,
            capture_output=True,
            text=True,
            timeout=300,
        ).stdout.strip()
        for threads in (1, 2)
    }
    assert len(digests) == 1
    _, shared, plan = solvers(SOME, "bone")
    before = shared.solve(plan).displacements
    between = shared.holding(FAR).holding(FAR[:0]).holding(SOME)
    np.testing.assert_array_equal(between.solve(plan).displacements, before)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "pcg"}, "liftable nodes needs"),
        ({"kinematics": "corotational"}, "liftable nodes needs"),
        ({"element": "p2"}, "liftable nodes needs"),
    ],
)
def test_what_cannot_hold_and_free_nodes_is_refused(change, words):
    options = {**OPTIONS, **change}
    element = options.pop("element", "p1")
    mesh = cmfsim.TetMesh(NODES, TETS)
    made = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(0.3, 0.4), element=element)
    with pytest.raises(cmfsim.SolverError, match=words):
        cmfsim.StaticSolver(made, boundary(SOME, None, liftable=(FAR, None)), **options)


def test_nodes_of_another_kind_are_refused():
    for nodes, segment, words in (
        (LOW, None, "both sliding and liftable"),
        (HIGH, None, "both joined and liftable"),
        (SIDE, "bone", "both fixed and liftable"),
        (FAR, "jaw", 'segment "jaw"'),
    ):
        with pytest.raises(cmfsim.BoundaryError, match=words):
            boundary(FAR[:0], None, liftable=(nodes, segment))
    solver = cmfsim.StaticSolver(tensors(), boundary(SOME, None, liftable=(SOME, None)), **OPTIONS)
    with pytest.raises(cmfsim.BoundaryError, match=f'held node is "{FAR[1]}"'):
        solver.holding(FAR)
    with pytest.raises(cmfsim.BoundaryError, match="liftable"):
        cmfsim.StaticSolver(
            tensors(), boundary(SOME, None, liftable=([len(NODES)], None)), **OPTIONS
        )
