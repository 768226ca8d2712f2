"""Bad input gives the named error with index and value: never a panic, hang or wrong answer."""

import numpy as np
import pytest
from small_box import EYE, HIGH, LOW, NODES, TETS, floor, refused, solver, tensors

import cmfsim
from benches.scenes import meshes

# Meshes.


def test_inverted_tet_is_named():
    """A negative volume names the tet and its volume."""
    tets = TETS.copy()
    tets[5] = tets[5][[1, 0, 2, 3]]
    with refused(cmfsim.MeshError, r"tet 5 is inverted: volume -1\.3"):
        cmfsim.TetMesh(NODES, tets)


def test_flat_tet_is_named():
    """A volume of nothing names the tet."""
    nodes = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]]
    with refused(cmfsim.MeshError, "tet 1 is degenerate"):
        cmfsim.TetMesh(nodes, [[0, 1, 2, 3], [0, 1, 2, 4]])


def test_repeated_node_is_named():
    """A tet that names a node twice."""
    with refused(cmfsim.MeshError, "tet 1 names node 2 twice"):
        cmfsim.TetMesh(NODES, [TETS[0], [0, 2, 2, 3]])


def test_coincident_nodes_are_found():
    """Two nodes in one place make a tet without volume."""
    nodes = NODES.copy()
    nodes[TETS[3, 1]] = nodes[TETS[3, 0]]
    with refused(cmfsim.MeshError, r"tet \d+ is (degenerate|inverted)"):
        cmfsim.TetMesh(nodes, TETS)


def test_repeated_tet_is_named():
    """Twice the same four nodes would count their stiffness twice."""
    with refused(cmfsim.MeshError, "tets 2 and 48"):
        cmfsim.TetMesh(NODES, np.concatenate([TETS, TETS[2:3][:, [1, 2, 0, 3]]]))


def test_unused_node_is_named():
    """A node of no tet has no stiffness."""
    with refused(cmfsim.MeshError, "node 27"):
        cmfsim.TetMesh(np.concatenate([NODES, [[9.0, 9.0, 9.0]]]), TETS)


def test_index_past_the_end_is_named_with_its_row():
    """Node 27 of 27 nodes: numbered from 1?"""
    tets = TETS.copy()
    tets[7, 2] = 27
    with refused(cmfsim.MeshError, r"tets\[7\].*27"):
        cmfsim.TetMesh(NODES, tets)


# Surfaces.


@pytest.mark.parametrize(
    ("vertices", "triangles", "pattern"),
    [
        (np.zeros((0, 3)), [[0, 1, 2]], "empty"),
        (NODES, np.zeros((0, 3), dtype=int), "empty"),
        (NODES, [[0, 1, 99]], "99"),
        (NODES, [[0, 1, -2]], "-2"),
        (NODES, [[0, 1, 1]], "triangle 0"),
        (NODES, [[0, 1, 2]], "triangle 0"),
        (NODES * np.nan, [[0, 1, 3]], "NaN"),
        (NODES[:, :2], [[0, 1, 3]], r"\(27, 2\)"),
    ],
)
def test_bad_surface_is_refused(vertices, triangles, pattern):
    """Empty, out of range, degenerate (nodes 0, 1, 2 are in line) or not finite."""
    with refused(cmfsim.MeshError, pattern):
        cmfsim.Surface(vertices, triangles)


@pytest.mark.parametrize("angle", [-1.0, 181.0, np.nan])
def test_crease_angle_has_a_range(angle):
    """0 to 180 degrees."""
    with refused(cmfsim.MeshError, "crease"):
        cmfsim.Surface(NODES, [[0, 1, 3]], crease_angle=angle)


def test_an_open_surface_has_no_volume_but_an_area():
    """Nothing returns NaN: the volume of an open surface is None."""
    surface = floor()
    assert not surface.is_closed
    assert surface.volume is None
    assert surface.area == pytest.approx(400.0)
    assert surface.n_border_edges == 4


# Materials.


@pytest.mark.parametrize("young", [0.0, -1.0, np.nan, np.inf])
def test_young_must_be_positive(young):
    """E ≤ 0 stores no energy."""
    with refused(cmfsim.MaterialError, "young"):
        cmfsim.Tissue.isotropic([1.0, young], 0.3)
    with refused(cmfsim.MaterialError, "young_along"):
        cmfsim.Tissue.transversely_isotropic(young, 1.0, 0.3, [1, 0, 0])
    with refused(cmfsim.MaterialError, "young_across"):
        cmfsim.Tissue.transversely_isotropic(1.0, young, 0.3, [1, 0, 0])


@pytest.mark.parametrize("poisson", [0.5, 0.7, -1.0, np.nan])
def test_poisson_has_a_range(poisson):
    """−1 < ν < 0.5 (positive bulk and shear modulus)."""
    with refused(cmfsim.MaterialError, "poisson"):
        cmfsim.Tissue.isotropic(1.0, [0.3, 0.2, poisson])


def test_the_offending_tet_is_named():
    """Index and value stand in the text."""
    with refused(cmfsim.MaterialError, r"poisson\[2\] is 0\.5"):
        cmfsim.Tissue.isotropic(1.0, [0.3, 0.2, 0.5])


@pytest.mark.parametrize("fibre", [[0, 0, 0], [2, 0, 0], [1, 1, 0], [[1, 0, 0], [0, 0, 0.5]]])
def test_fibre_must_be_a_unit_vector(fibre):
    """|a| = 1."""
    with refused(cmfsim.MaterialError, "fibre"):
        cmfsim.Tissue.transversely_isotropic(1.0, 0.5, 0.3, fibre)


def test_lengths_must_agree():
    """Constants of 3 tets with fibres of 2; tissue of 3 tets on a mesh of 48."""
    with refused(cmfsim.MaterialError, "3"):
        cmfsim.Tissue.transversely_isotropic([1.0] * 3, 0.5, 0.3, [[1, 0, 0]] * 2)
    with refused(cmfsim.MaterialError, "48"):
        tensors(tissue=cmfsim.Tissue.isotropic([1.0] * 3, 0.3))


def test_indefinite_laws_are_refused_with_tet_constants_and_eigenvalue():
    """C_iso(E_t) + (Δλ + 2Δμ) A⊗A with the paper's Table 1 has a negative eigenvalue (3.2)."""
    with refused(cmfsim.MaterialError, r"tet 0 .*eigenvalue -2\.6\d*e-2"):
        cmfsim.Tissue.transversely_isotropic(0.5, 0.79, 0.43, [1, 0, 0], law="picinbono")
    stiffness = cmfsim.Tissue.isotropic(1.0, 0.3).stiffness()[0]
    bad = stiffness.copy()
    bad[3, 3] = -0.1
    with refused(cmfsim.MaterialError, "tet 1 .*eigenvalue"):
        cmfsim.Tissue.from_stiffness(np.stack([stiffness, bad]))
    skew = stiffness.copy()
    skew[0, 1] *= 1.1
    with refused(cmfsim.MaterialError, "not symmetric"):
        cmfsim.Tissue.from_stiffness(skew)
    with refused(cmfsim.MaterialError, r"\(3, 3\)"):
        cmfsim.Tissue.from_stiffness(np.eye(3))


@pytest.mark.parametrize("fraction", [-0.1, 1.1, np.nan])
def test_fraction_lies_between_none_and_all(fraction):
    """0 ≤ p ≤ 1."""
    with refused(cmfsim.MaterialError, "fraction"):
        cmfsim.Tissue.preset("kim2010", [0.5, fraction], [[1, 0, 0]] * 2)


def test_unknown_names_list_the_known_ones():
    """Preset, law, mixing, method and contact."""
    with refused(cmfsim.MaterialError, "kim2010"):
        cmfsim.Tissue.preset("kim", 0.5, [1, 0, 0])
    with refused(cmfsim.MaterialError, "spencer"):
        cmfsim.Tissue.transversely_isotropic(1.0, 1.0, 0.3, [1, 0, 0], law="hill")
    with refused(cmfsim.MaterialError, "moduli"):
        cmfsim.Tissue.preset("kim2010", 0.5, [1, 0, 0], mixing="half")
    with refused(cmfsim.SolverError, "cholesky"):
        solver(cmfsim.Boundary(fixed=LOW), method="lu")
    with refused(cmfsim.SolverError, "bilateral"):
        solver(cmfsim.Boundary(fixed=LOW), contact="glue")
    with refused(cmfsim.BoundaryError, "resolve"):
        cmfsim.Boundary(fixed=LOW, conflicts="ignore")


# Boundaries.


def test_a_node_of_two_kinds_is_named():
    """Fixed and joined, joined twice, joined and sliding."""
    with refused(cmfsim.BoundaryError, "node 4 is both"):
        cmfsim.Boundary(fixed=[0, 4], joined={"a": [4, 5]})
    with refused(cmfsim.BoundaryError, "node 5 is both"):
        cmfsim.Boundary(joined={"a": [4, 5], "b": [5, 6]})
    with refused(cmfsim.BoundaryError, "node 7 is both"):
        cmfsim.Boundary(joined={"a": [7]}, sliding={"b": [7]}, contact={"b": floor()})


def test_conflicts_can_be_resolved_and_are_counted():
    """Fixed wins over joined, joined over sliding."""
    boundary = cmfsim.Boundary(
        fixed=[0, 1],
        joined={"a": [1, 2]},
        sliding={"a": [0, 2, 3]},
        contact={"a": floor()},
        conflicts="resolve",
    )
    assert boundary.conflicts == 3
    assert boundary.fixed.tolist() == [0, 1]
    assert boundary.joined["a"].tolist() == [2]
    assert boundary.sliding["a"].tolist() == [3]


def test_a_segment_must_be_whole():
    """Sliding needs a contact surface; a contact or gap needs sliding nodes."""
    with refused(cmfsim.BoundaryError, 'segment "teeth".*contact'):
        cmfsim.Boundary(sliding={"teeth": LOW})
    with refused(cmfsim.BoundaryError, 'segment "teeth"'):
        cmfsim.Boundary(fixed=LOW, contact={"teeth": floor()})
    with refused(cmfsim.BoundaryError, "gap"):
        cmfsim.Boundary(
            sliding={"teeth": LOW}, contact={"teeth": floor()}, gap={"teeth": [0.0, 1.0]}
        )
    with refused(cmfsim.BoundaryError, "gap"):
        cmfsim.Boundary(sliding={"teeth": LOW}, contact={"teeth": floor()}, gap={"teeth": "worst"})
    with refused(cmfsim.BoundaryError, "jaw"):
        cmfsim.Boundary(fixed=LOW, gap={"jaw": 0.0})


@pytest.mark.parametrize("ids", [[27], [-1], [0.5], [[0, 1]], [True], ["0"]])
def test_bad_node_indices_are_refused(ids):
    """Out of range (found with the mesh), negative, fractional, misshapen, boolean, text."""
    for boundary in (
        lambda: cmfsim.Boundary(fixed=ids),
        lambda: cmfsim.Boundary(fixed=LOW, joined={"a": ids}),
        lambda: cmfsim.Boundary(joined={"a": HIGH}, sliding={"b": ids}, contact={"b": floor()}),
    ):
        with refused(cmfsim.BoundaryError, r"27|-1|float64|shape|bool|<U1|str"):
            solver(boundary())


def test_a_free_body_names_its_rigid_modes():
    """Nothing held: three translations and three rotations are free."""
    with refused(cmfsim.BoundaryError, r"not constrained: all six rigid modes are free"):
        solver(cmfsim.Boundary())


@pytest.mark.parametrize("fixed", [[0], [0, 2], [0, 1, 2]])
def test_a_partly_held_body_names_its_rigid_modes(fixed):
    """One node leaves three rotations; two or three in line leave one."""
    with refused(cmfsim.BoundaryError, r"not constrained.*rotation"):
        solver(cmfsim.Boundary(fixed=fixed))


def test_three_nodes_not_in_line_hold_a_body():
    """The least that holds."""
    result = solver(cmfsim.Boundary(fixed=[0, 2, 6])).solve({})
    assert np.abs(result.displacements).max() == 0.0


def test_a_loose_island_is_found():
    """Two bodies, one held: the other one is named with a node of its own."""
    nodes = np.concatenate([NODES, NODES + [20.0, 0.0, 0.0]])
    tets = np.concatenate([TETS, TETS + 27])
    with refused(cmfsim.BoundaryError, r"not constrained.*node (2[7-9]|[345]\d)"):
        cmfsim.StaticSolver(tensors(nodes, tets), cmfsim.Boundary(fixed=LOW))


def test_a_hinge_is_found():
    """Two bodies that share an edge only: one is held, the other turns about the edge."""
    other = NODES * [-1, -1, 1]
    nodes = np.concatenate([NODES, other[(other[:, 0] != 0) | (other[:, 1] != 0)]])
    index = {tuple(x): i for i, x in enumerate(nodes)}
    renumber = np.array([index[tuple(x)] for x in other])
    tets = np.concatenate([TETS, meshes.oriented(nodes, renumber[TETS])])
    held = meshes.nodes_where(nodes[:, 0] == 4.0)
    with refused(cmfsim.BoundaryError, r"not constrained.*rotation"):
        cmfsim.StaticSolver(tensors(nodes, tets), cmfsim.Boundary(fixed=held))


def test_a_body_that_only_slides_is_not_held():
    """On a plane: two translations and one rotation are free."""
    boundary = cmfsim.Boundary(sliding={"floor": LOW}, contact={"floor": floor()})
    with refused(cmfsim.BoundaryError, "not constrained"):
        solver(boundary)


def test_unilateral_contact_holds_nothing():
    """A body that may lift off must be held without its sliding nodes."""
    boundary = cmfsim.Boundary(
        joined={"a": [20]}, sliding={"floor": LOW}, contact={"floor": floor()}
    )
    with pytest.raises(cmfsim.CmfsimError):
        solver(boundary, contact="unilateral").solve(
            {"a": cmfsim.rigid_motion((0, 0, 1)), "floor": EYE}
        )


# Plans.


@pytest.mark.parametrize(
    ("plan", "pattern"),
    [
        ({}, '"bone".*missing'),
        ({"bone": EYE, "chin": EYE}, '"chin".*no such segment'),
        ({"Bone": EYE}, '"Bone"'),
        ({"bone": np.eye(3)}, "bone"),
        ({"bone": np.zeros((4, 3))}, "4 displacements for its 9"),
        ({"bone": np.zeros((9, 2))}, "bone"),
        ({"bone": "up"}, "bone"),
        ({"bone": None}, "bone"),
        ({"bone": np.diag([1.1, 1, 1, 1])}, "not rigid"),
        ({"bone": np.diag([-1.0, 1, 1, 1])}, "reflection|mirror"),
        ({"bone": np.eye(4) + np.eye(4, k=1) * 0.2}, "rigid|bottom"),
        ({"bone": cmfsim.rigid_motion((1, 2, 3)).T}, "bottom row"),
        ({"bone": np.zeros((4, 4))}, "bottom row|rigid"),
        ({"bone": EYE * 1e200}, "bottom row|rigid"),
        ({1: EYE}, "plan"),
        ([EYE], "plan"),
        (None, "plan"),
    ],
)
def test_a_plan_that_does_not_fit_is_refused(plan, pattern):
    """Unknown, missing or misspelt segments; motions that are none."""
    boundary = cmfsim.Boundary(fixed=LOW, joined={"bone": HIGH})
    with refused(cmfsim.BoundaryError, pattern):
        solver(boundary).solve(plan)
    if pattern != "4 displacements for its 9":
        with refused(cmfsim.BoundaryError, pattern):
            solver(boundary).plan_operator()(plan)


def test_a_surface_motion_needs_its_own_vertex_count():
    """As many moved vertices as the surface has."""
    surface = floor()
    with refused(cmfsim.BoundaryError, "3.*4|4.*3"):
        cmfsim.SurfaceMotion(surface, surface.vertices[:3])
    with refused(cmfsim.BoundaryError, "3.*4|4.*3"):
        surface.moved(surface.vertices[:3])


def test_displacements_do_not_say_how_a_contact_surface_moves():
    """A segment with sliding nodes needs a rigid motion or a SurfaceMotion."""
    boundary = cmfsim.Boundary(joined={"jaw": HIGH}, sliding={"jaw": LOW}, contact={"jaw": floor()})
    with refused(cmfsim.BoundaryError, "SurfaceMotion"):
        solver(boundary).solve({"jaw": np.zeros((len(HIGH), 3))})


def test_the_operator_takes_rigid_plans_only():
    """Displacements node by node are no affine motion."""
    operator = solver(cmfsim.Boundary(fixed=LOW, joined={"bone": HIGH})).plan_operator()
    with refused(cmfsim.BoundaryError, "bone"):
        operator({"bone": np.zeros((9, 3))})


@pytest.mark.parametrize("nodes", [[27], [-1], [0.5], [[0]]])
def test_operator_nodes_are_checked(nodes):
    """Out of range, negative, fractional, misshapen."""
    with refused(cmfsim.BoundaryError, "nodes"):
        solver(cmfsim.Boundary(fixed=LOW, joined={"bone": HIGH})).plan_operator(nodes)


@pytest.mark.parametrize("loads", [np.zeros((26, 3)), np.zeros(3), "none"])
def test_loads_are_one_row_per_node(loads):
    """(n, 3) and nothing else."""
    boundary = cmfsim.Boundary(fixed=LOW, joined={"bone": HIGH})
    with refused(cmfsim.CmfsimError, "loads"):
        solver(boundary).solve({"bone": EYE}, loads=loads)


# Contact surfaces.


def test_an_inverted_contact_surface_is_refused():
    """Normals that point away from the tissue would let it through."""
    boundary = cmfsim.Boundary(
        joined={"top": HIGH}, sliding={"floor": LOW}, contact={"floor": floor(flip=True)}
    )
    with refused(cmfsim.ContactError, "floor.*inverted"):
        solver(boundary, contact="unilateral")


def test_a_closed_contact_surface_inside_out_is_refused():
    """Negative volume, whichever kind of contact."""
    vertices, triangles = meshes.icosphere(2, 3.0)
    ball = cmfsim.Surface(vertices + [2, 2, -3], triangles[:, ::-1])
    boundary = cmfsim.Boundary(joined={"top": HIGH}, sliding={"ball": LOW}, contact={"ball": ball})
    with refused(cmfsim.ContactError, "ball.*inverted"):
        solver(boundary)


def test_an_empty_contact_surface_cannot_be_made():
    """No triangles: refused where the surface is made."""
    with refused(cmfsim.MeshError, "empty"):
        cmfsim.Surface(np.zeros((3, 3)), np.zeros((0, 3), dtype=int))
