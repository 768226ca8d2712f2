"""Bad options, absurd values and solves that fail give the named error with its figures."""

import re

import numpy as np
import pytest
from small_box import EYE, HIGH, LOW, NODES, TETS, floor, refused, solver, tensors

import cmfsim
from benches.scenes import meshes


@pytest.mark.parametrize(
    "option",
    [
        {"tolerance": 0.0},
        {"tolerance": -1e-9},
        {"tolerance": np.nan},
        {"contact_tolerance": 0.0},
        {"contact_tolerance": np.inf},
        {"memory_limit": 0.0},
        {"memory_limit": -5.0},
        {"memory_limit": np.nan},
    ],
)
def test_options_have_ranges(option):
    """Refused when the solver is made, not when it is used."""
    (name,) = option
    boundary = cmfsim.Boundary(
        joined={"top": HIGH}, sliding={"floor": LOW}, contact={"floor": floor()}
    )
    with refused(cmfsim.SolverError, name):
        solver(boundary, **option)


@pytest.mark.parametrize("name", ["max_iterations", "contact_iterations"])
@pytest.mark.parametrize(
    "value", [-1, 0, 2.5, 100.0, *[True], *np.array([True]), 10**12, 10**30, -(10**400), "7", [3]]
)
def test_counts_are_whole_numbers_of_a_range(name, value):
    """A named error that is a ValueError and states the option and its range: no OverflowError."""
    boundary = cmfsim.Boundary(fixed=LOW)
    with refused(cmfsim.SolverError, rf"^{name} is .*1 to 1000000000"):
        solver(boundary, **{name: value})


@pytest.mark.parametrize("value", [1, np.int64(7), np.uint8(3), 10**9])
def test_counts_take_any_integer(value):
    """Integers of numpy are integers."""
    boundary = cmfsim.Boundary(fixed=LOW)
    solver(boundary, max_iterations=value, contact_iterations=value)


@pytest.mark.parametrize("value", [1e7, 1e100, 1e200, 1e308])
def test_absurd_values_are_refused_where_they_enter(value):
    """Nothing of 1e100 becomes NaN on the way: each names its row, value and limit."""
    nodes = NODES.copy()
    nodes[4, 1] = value
    with refused(cmfsim.MeshError, r"nodes\[4\] is 1e\+?\d+|nodes\[4\] is 10000000.*1e6 mm"):
        cmfsim.TetMesh(nodes, TETS)
    with refused(cmfsim.MeshError, "1e6 mm"):
        cmfsim.Surface(nodes[[0, 4, 7]], [[0, 1, 2]])
    with refused(cmfsim.MaterialError, r"young\[0\].*1e-15 to 1e12 MPa"):
        cmfsim.Tissue.isotropic(value * 1e6 if value < 1e12 else value, 0.3)
    boundary = cmfsim.Boundary(fixed=LOW, joined={"bone": HIGH})
    made = solver(boundary)
    rows = np.zeros((len(HIGH), 3))
    rows[2, 0] = value
    with refused(cmfsim.BoundaryError, r'plan\["bone"\]\[2\].*1e6 mm'):
        made.solve({"bone": rows})
    far = EYE.copy()
    far[1, 3] = 10.0 * min(value, 1e300)
    for use in (made.solve, made.plan_operator()):
        with refused(cmfsim.BoundaryError, 'segment "bone".*1e7 mm'):
            use({"bone": far})
    loads = np.zeros_like(NODES)
    loads[3, 2] = value * 1e6 if value < 1e12 else value
    with refused(cmfsim.BoundaryError, r"loads\[3\].*1e12 N"):
        made.solve({"bone": EYE}, loads=loads)


def test_a_factor_that_does_not_fit_is_refused_with_the_need():
    """`memory_limit` in MB: the error says how much is needed."""
    nodes, tets = meshes.box((8, 8, 8), (8.0, 8.0, 8.0))
    boundary = cmfsim.Boundary(fixed=meshes.nodes_where(nodes[:, 2] == 0.0))
    with pytest.raises(cmfsim.SolverError, match="MB") as caught:
        cmfsim.StaticSolver(tensors(nodes, tets), boundary, "cholesky", memory_limit=0.1)
    assert not isinstance(caught.value, ValueError)


@pytest.mark.parametrize("method", ["pcg", "relaxation"])
def test_not_converging_is_an_error_with_the_figures(method):
    """One iteration is not enough: the text gives iterations and error."""
    boundary = cmfsim.Boundary(fixed=LOW, joined={"bone": HIGH})
    with pytest.raises(cmfsim.SolverError, match=r"1 iterations?.*(mm|computed)") as caught:
        solver(boundary, method=method, max_iterations=1).solve(
            {"bone": cmfsim.rigid_motion((0, 1, 1), 20, (0, 0, 1))}
        )
    assert not isinstance(caught.value, ValueError)


def test_a_failed_solve_states_what_failed():
    """With pcg that is the estimated error of a node or of the energy, above what was asked for."""
    nodes, tets = meshes.box((12, 2, 2), (24.0, 4.0, 4.0))
    boundary = cmfsim.Boundary(
        fixed=meshes.nodes_where(nodes[:, 0] == 0.0),
        joined={"bone": meshes.nodes_where(nodes[:, 0] == 24.0)},
    )
    plan = {"bone": cmfsim.rigid_motion((0, 1, 1), 20, (0, 0, 1))}
    number = r"(\d\.\d+e-?\d+)"
    for iterations in (8, 12):
        made = cmfsim.StaticSolver(
            tensors(nodes, tets), boundary, "pcg", max_iterations=iterations, tolerance=1e-12
        )
        with pytest.raises(cmfsim.SolverError) as caught:
            made.solve(plan)
        text = str(caught.value)
        found = re.search(rf"{number}.*? but {number}.*? was requested", text)
        if found is None:
            assert "could not be computed" in text
        else:
            assert float(found[1]) > float(found[2]), text
        assert "max_iterations" in text
