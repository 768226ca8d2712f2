"""Contact on a head: random plans converge soon, and the face follows the plan continuously."""

from dataclasses import replace

import numpy as np
import pytest

import cmfsim
from benches.stability import contact_plans
from shared_values import phantom_model

pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")

REACH = (6.0, 6.0)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A synthetic head, coarse, from its surfaces."""
    return phantom_model(tmp_path_factory)


@pytest.fixture(scope="module")
def scene(model):
    return replace(model.scene, tissue=model.fat)


@pytest.fixture(scope="module")
def solver(scene):
    return cmfsim.scene_solver(scene)


@pytest.fixture(scope="module")
def plans(model):
    return contact_plans.draw(model, 5, REACH, 2.0, 5)


def test_random_plans_converge_in_few_steps(scene, plans):
    """The small twin of benches/stability/contact_plans.py."""
    assert len(plans) == 5
    tally = contact_plans.Tally("phantom", "H+S", scene.n_tets, 0)
    contact_plans.run(tally, scene, plans)
    assert not tally.failures
    assert max(tally.steps) <= 30
    assert np.median(tally.steps) <= 10
    assert max(tally.gaps) <= scene.options.contact_tolerance


def test_the_error_is_no_more_than_stated(scene, solver, plans):
    """What steps leave out of contact forces adds up over nodes, whose own imbalance is small."""
    options = replace(scene.options, contact_tolerance=1e-9)
    exact = cmfsim.scene_solver(replace(scene, options=options))
    for plan in plans:
        found, best = solver.solve(plan), exact.solve(plan)
        away = np.linalg.norm(found.displacements - best.displacements, axis=1)
        assert best.error_estimate <= 0.1 * found.error_estimate
        assert away.max() <= found.error_estimate + best.error_estimate


def test_the_face_is_a_continuous_function_of_the_plan(model, solver, plans):
    """0.01 mm more motion moves no point of the skin by more than 0.05 mm."""
    skin = model.skin_nodes
    for plan in plans[:2]:
        name = next(n for n, m in plan.items() if not np.allclose(m, np.eye(4)))
        more = {**plan, name: cmfsim.rigid_motion((0.006, -0.008, 0.0)) @ plan[name]}
        here, there = (solver.solve(p).displacements[skin] for p in (plan, more))
        assert np.linalg.norm(there - here, axis=1).max() <= 0.05


def test_a_solve_may_begin_at_another_plan(scene, solver, plans):
    """Fewer steps and the same end from near; a solution of another solver is refused.

    From far, contact converges as well, for some plans to another equilibrium (docs/contact.md).
    """
    name = next(n for n, m in plans[0].items() if not np.allclose(m, np.eye(4)))
    near = {**plans[0], name: cmfsim.rigid_motion((0.3, -0.2, 0.1)) @ plans[0][name]}
    start = solver.solve(near)
    for plan, other in ((plans[0], start), (plans[1], start)):
        cold, warm = solver.solve(plan), solver.solve(plan, start=other)
        assert warm.contact_converged
        assert warm.contact_gap <= max(cold.contact_gap, 1e-3)
        if plan is plans[0]:
            assert np.abs(warm.displacements - cold.displacements).max() <= 1e-3
            assert warm.contact_iterations < cold.contact_iterations
    bare = {n: replace(s, sliding=(), contact=None) for n, s in scene.segments.items()}
    bound = cmfsim.scene_solver(replace(scene, segments=bare))
    with pytest.raises(cmfsim.BoundaryError, match="sliding nodes of the start"):
        bound.solve(plans[0], start=start)


def mirrored(scene):
    """The scene seen in a mirror: x turns round, and so do tets and triangles."""
    flip = np.array([-1.0, 1.0, 1.0])
    turned = scene.tets[:, [0, 2, 1, 3]]
    segments = {
        name: replace(
            s,
            contact=s.contact
            and cmfsim.SurfaceData(s.contact.vertices * flip, s.contact.triangles[:, ::-1]),
        )
        for name, s in scene.segments.items()
    }
    plan = {name: seen_in_mirror(m) for name, m in scene.plan.items()}
    return replace(scene, nodes=scene.nodes * flip, tets=turned, segments=segments, plan=plan)


def seen_in_mirror(motion):
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    return mirror @ motion @ mirror


# test_mirror.py mirrors a case in the ordinary run.
@pytest.mark.slow
def test_a_mirrored_head_has_the_mirrored_face(scene, solver, plans):
    there = cmfsim.scene_solver(mirrored(scene))
    for plan in plans[:2]:
        face = solver.solve(plan)
        seen = there.solve({name: seen_in_mirror(m) for name, m in plan.items()})
        apart = np.linalg.norm(seen.displacements * [-1, 1, 1] - face.displacements, axis=1)
        assert apart.max() <= 1e-6, (face.contact_iterations, seen.contact_iterations)


def test_the_operator_about_a_plan_is_near_the_solution_beside_it(model, solver, plans):
    """A millimetre from its reference it is off by hundredths."""
    plan = plans[0]
    operator = solver.plan_operator(nodes=model.skin_nodes, plan=plan)
    name = next(n for n, m in plan.items() if not np.allclose(m, np.eye(4)))
    more = {**plan, name: cmfsim.rigid_motion((0.0, -0.8, 0.6)) @ plan[name]}
    exact = solver.solve(more).displacements[model.skin_nodes]
    error = np.linalg.norm(operator(more) - exact, axis=1)
    assert error.mean() <= 0.02
    assert error.max() <= 0.2
