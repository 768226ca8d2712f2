"""Derivatives of the face against central differences of whole solutions, to 1 %."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cmfsim
from cmfsim.solving.models import model_scene
from cmfsim.solving.rates import skin_rates, tissue_parts
from cmfsim.solving.simulation import scene_plan, scene_solver, solved_scene
from cmfsim.values.calibration import PLAN
from shared_values import coarse_demo_patient

# Half the distance between the two solutions of a difference, in standard deviations.
HALF = 0.05
# Contact and equations are solved far below what the differences show, mm and share.
OPTIONS = {"contact_tolerance": 1e-7, "tolerance": 1e-11, "method": "cholesky"}


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    return coarse_demo_patient(tmp_path_factory)


def solved(patient, model):
    scene = model_scene(patient, model)
    scene = replace(scene, options=replace(scene.options, **OPTIONS))
    solver = scene_solver(scene)
    _, solution = solved_scene(scene, solver)
    return scene, solver, solution


def with_tissue(solver, tissue):
    tensors = cmfsim.MassTensors(solver.tensors.mesh, tissue)
    return cmfsim.StaticSolver(tensors, solver.boundary, **OPTIONS)


@pytest.mark.parametrize(
    "model", [*(pytest.param(m, marks=pytest.mark.slow) for m in ("H", "H+S", "M")), "M+S"]
)
def test_derivatives_equal_central_differences_to_one_percent(patient, model):
    scene, solver, solution = solved(patient, model)
    found = skin_rates(patient, scene, solver, solution)
    plan = scene_plan(scene)
    fraction = None if model.startswith("H") else patient.fraction
    parts = tissue_parts(scene.tissue, scene.n_tets, patient.fat, fraction)
    moved = [name for name, motion in scene.plan.items() if not np.array_equal(motion, np.eye(4))]
    assert len(found.rates) == (1 if model.startswith("H") else 9) + len(PLAN) * len(moved)
    assert not found.left_out
    for name, rate in found.rates.items():
        source = found.sources[name]
        ends = []
        for sign in (1.0, -1.0):
            if ": " in name:
                other = replace(scene, plan=executed(scene, name, sign * HALF))
                there = solver.solve(scene_plan(other), start=solution)
            else:
                tissue = parts.changed(name, sign * HALF * source.sd).tissue()
                there = with_tissue(solver, tissue).solve(plan)
            assert there.contact_converged
            ends.append(patient.skin_field(there.displacements))
        difference = (ends[0] - ends[1]) / (2.0 * HALF)
        size = np.linalg.norm(difference, axis=1)
        off = np.linalg.norm(rate - difference, axis=1)
        assert size.max() > 1e-3, name
        assert np.sqrt((off**2).mean() / (size**2).mean()) < 0.01, name
        assert off.max() < 0.01 * size.max(), name


def executed(scene, name, share):
    """The plan with one segment shifted or turned by a share of a standard deviation."""
    segment, _, kind = name.partition(": ")
    number = [source.name for source in PLAN].index(kind)
    matrix = np.array(scene.plan[segment], dtype=float)
    middle = np.asarray(scene.nodes)[np.asarray(scene.segments[segment].joined)].mean(axis=0)
    middle = matrix[:3, :3] @ middle + matrix[:3, 3]
    size, axis = share * PLAN[number].sd, np.eye(3)[number % 3]
    more = np.eye(4)
    if PLAN[number].unit == "mm":
        more[:3, 3] = size * axis
    else:
        more[:3, :3] = Rotation.from_rotvec(np.radians(size) * axis).as_matrix()
        more[:3, 3] = middle - more[:3, :3] @ middle
    return {**scene.plan, segment: more @ matrix}


@pytest.mark.parametrize("model", ["M", "M+S"])
def test_all_moduli_scaled_together_move_nothing(patient, model):
    """Euler: displacements are of degree 0 in the moduli, so derivatives by logarithms cancel."""
    scene, solver, solution = solved(patient, model)
    found = skin_rates(patient, scene, solver, solution)
    names = ("fat modulus", "muscle modulus along", "muscle modulus across")
    each = [found.rates[name] / found.sources[name].sd for name in names]
    assert np.abs(sum(each)).max() < 2e-3 * max(np.abs(u).max() for u in each)


def test_iterative_and_direct_solves_give_the_same_derivatives(patient):
    scene, solver, solution = solved(patient, "M+S")
    direct = skin_rates(patient, scene, solver, solution)
    scene = replace(scene, options=replace(scene.options, method="pcg"))
    solver = scene_solver(scene)
    iterative = skin_rates(patient, scene, solver, solved_scene(scene, solver)[1])
    for name, rate in direct.rates.items():
        off = np.linalg.norm(rate - iterative.rates[name], axis=1)
        assert off.max() < 0.01 * np.linalg.norm(rate, axis=1).max(), name


def test_a_scene_without_a_linear_map_is_refused(patient):
    scene, solver, solution = solved(patient, "H")
    other = replace(scene, options=replace(scene.options, kinematics="corotational"))
    with pytest.raises(cmfsim.CaseError, match="linear kinematics"):
        skin_rates(patient, other, solver, solution)


def test_changes_that_do_not_fit_are_named(patient):
    scene, solver, solution = solved(patient, "H")
    plan = scene_plan(scene)
    with pytest.raises(cmfsim.BoundaryError, match="no such segment"):
        solver.responses(solution, plan, [{"jaw": np.zeros((4, 4))}])
    with pytest.raises(cmfsim.BoundaryError, match="last row of a rate is zero"):
        solver.responses(solution, plan, [{"maxilla": np.eye(4)}])
    with pytest.raises(cmfsim.BoundaryError, match="changes\\[1\\]"):
        solver.responses(solution, plan, [np.zeros((scene.n_nodes, 3)), np.zeros((3, 2))])
    with pytest.raises(cmfsim.SolverError, match="accuracy"):
        solver.responses(solution, plan, [], accuracy=0.0)
    bad = np.full((4, 4), np.nan)
    bad[3] = 0.0
    with pytest.raises(cmfsim.BoundaryError):
        solver.responses(solution, plan, [{"maxilla": bad}])
