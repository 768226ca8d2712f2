"""What is left out between segments, on tissue between two plates of bone."""

import itertools

import numpy as np
import pytest

import cmfsim
from cmfsim.pipeline.building.skin import held_part, lifted_where_held
from cmfsim.pipeline.building.tissue.contacts import (
    cleft_tets,
    crushed_tets,
    without_clefts,
    without_crushed,
)
from cmfsim.surfaces.topology import tet_bodies
from cmfsim.values.patient_model import LiftedTissue

EDGE = 1.0


def plate(low, high, name):
    """A box of bone as a segment; its level is not asked for."""
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))), dtype=float)
    triangles = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                 [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    level = cmfsim.ImageData(np.zeros((2, 2, 2)), (1, 1, 1), (0, 0, 0))
    return cmfsim.BoneSegment(name, level, cmfsim.SurfaceData(corners, triangles))


def block(shape):
    """Cubes of Kuhn's six tets each, with corners on whole numbers."""
    nodes = np.stack(np.indices(np.array(shape) + 1), axis=-1).reshape(-1, 3).astype(float)
    number = np.arange(len(nodes)).reshape(np.array(shape) + 1)
    tets = []
    for order in itertools.permutations(range(3)):
        corner = np.stack(np.indices(shape), axis=-1).reshape(-1, 3)
        path = [corner]
        for axis in order:
            path.append(path[-1] + np.eye(3, dtype=int)[axis])
        tets.append(np.stack([number[tuple(p.T)] for p in path], axis=1))
    tets = np.concatenate(tets)
    edges = nodes[tets[:, 1:]] - nodes[tets[:, :1]]
    turned = np.linalg.det(edges) < 0.0
    tets[turned, :2] = tets[turned, 1::-1]
    return nodes, tets


@pytest.fixture
def bite():
    """Tissue 12 x 4 x 6 mm, between two plates 4 mm apart for x < 6 and beside both beyond."""
    nodes, tets = block((12, 4, 6))
    between = (nodes[tets][:, :, 0].max(axis=1) <= 6.0) & (
        (nodes[tets][:, :, 2].max(axis=1) <= 1.5) | (nodes[tets][:, :, 2].min(axis=1) >= 4.5)
    )
    tets = tets[~between]
    upper = plate((0, 0, 5), (6, 4, 9), "maxilla")
    lower = plate((0, 0, -3), (6, 4, 1), "mandible")
    kind = np.zeros(len(nodes), dtype=np.uint8)
    owner = np.full(len(nodes), -1, dtype=np.int16)
    for number, height in enumerate((5.0, 1.0)):
        lies = (nodes[:, 0] <= 6.0) & (nodes[:, 2] == height)
        kind[lies], owner[lies] = 2, number
    used = np.unique(tets)
    again = np.full(len(nodes), -1)
    again[used] = np.arange(len(used))
    kinds = cmfsim.NodeKinds(kind[used], owner[used], ("maxilla", "mandible"))
    return cmfsim.TetMesh(nodes[used], again[tets]), kinds, (upper, lower)


def inside(bite, width, moved=("maxilla",)):
    mesh, kinds, segments = bite
    return cleft_tets(
        np.asarray(mesh.nodes), np.asarray(mesh.tets), kinds, segments, moved=moved, width=width
    )


def test_tissue_between_rows_goes_and_tissue_beside_stays(bite):
    mesh = bite[0]
    middle = np.asarray(mesh.nodes)[np.asarray(mesh.tets)].mean(axis=1)
    # Between plates 4 mm apart the two distances come to 4 mm everywhere.
    gone = inside(bite, 4.5)
    assert gone[middle[:, 0] < 6.0].all()
    assert not gone[middle[:, 0] > 7.5].any()
    assert not inside(bite, 3.5).any()


def test_distances_from_both_are_those_of_the_plates(bite):
    mesh = bite[0]
    x, _, z = np.asarray(mesh.nodes)[np.asarray(mesh.tets)].mean(axis=1).T
    beyond = np.maximum(x - 6.0, 0.0)
    away = [np.hypot(beyond, np.maximum(d, 0.0)) for d in (5.0 - z, z - 1.0)]
    for width in (4.2, 5.0, 6.5):
        assert np.array_equal(inside(bite, width), sum(away) < width)


@pytest.mark.parametrize("moved", [("maxilla",), ("mandible",), ("mandible", "maxilla")])
def test_either_segment_that_moves_opens_the_cleft(bite, moved):
    assert np.array_equal(inside(bite, 5.0, moved), inside(bite, 5.0))


def test_nothing_goes_where_nothing_moves_or_no_width_is_given(bite):
    assert not inside(bite, 5.0, ()).any()
    assert not inside(bite, 0.0).any()


def test_a_tet_that_holds_nodes_of_both_goes_whatever_its_size():
    mesh = cmfsim.TetMesh(20.0 * np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])
    kinds = cmfsim.NodeKinds([2, 0, 1, 0], [0, -1, 1, -1], ("maxilla", "cranium"))
    far = [plate((90, 90, 90), (91, 91, 91), name) for name in ("maxilla", "cranium")]
    both = (np.asarray(mesh.nodes), np.asarray(mesh.tets), kinds, far)
    assert cleft_tets(*both, moved=("maxilla",), width=1.0).all()
    assert not cleft_tets(*both, moved=(), width=1.0).any()


def test_what_is_left_keeps_its_kinds_and_what_went_is_said(bite):
    mesh, kinds, segments = bite
    left, now, findings = without_clefts(mesh, kinds, segments, ("maxilla",), 4.5)
    assert left.n_tets == mesh.n_tets - np.count_nonzero(inside(bite, 4.5))
    before = {tuple(p): k for p, k in zip(np.asarray(mesh.nodes), kinds.kind, strict=True)}
    assert [before[tuple(p)] for p in np.asarray(left.nodes)] == now.kind.tolist()
    assert [f.code for f in findings] == ["clefts-left-out"]
    lost = float(np.sum(mesh.volumes) - np.sum(left.volumes))
    assert f"{lost:.0f} mm³" in findings[0].what


def crushed(bite, width=4.0, **motions):
    mesh, kinds, segments = bite
    return crushed_tets(
        np.asarray(mesh.nodes),
        np.asarray(mesh.tets),
        kinds,
        segments,
        motions={name: cmfsim.rigid_motion(shift) for name, shift in motions.items()},
        width=width,
    )


def test_tissue_between_plates_that_meet_is_crushed_and_tissue_beside_is_not(bite):
    mesh = bite[0]
    middle = np.asarray(mesh.nodes)[np.asarray(mesh.tets)].mean(axis=1)
    between = (middle[:, 0] < 6.0) & (middle[:, 2] > 2.0) & (middle[:, 2] < 4.0)
    assert between.sum() > 100
    for motions in ({"maxilla": (0, 0, -4.2)}, {"maxilla": (0, 0, -2), "mandible": (0, 0, 2.2)}):
        gone = crushed(bite, **motions)
        assert gone[between].all()
        assert not gone[middle[:, 0] > 9.0].any()


def test_tissue_that_keeps_room_stays(bite):
    for shift in ((0, 0, -1.0), (0, 0, 4.0), (3.0, 0, 0)):
        assert not crushed(bite, maxilla=shift).any(), shift
    together = (0, 2.0, -4.2)
    assert not crushed(bite, maxilla=together, mandible=together).any()
    assert not crushed(bite, width=0.0, maxilla=(0, 0, -4.2)).any()
    assert not crushed(bite).any()
    # Three times the width: plates 4 mm apart are not that near.
    assert not crushed(bite, width=1.3, maxilla=(0, 0, -4.2)).any()


def test_a_moved_surface_crushes_as_its_rigid_motion_does(bite):
    mesh, kinds, segments = bite
    shift = np.array([0.0, 0.0, -4.2])
    surface = segments[0].surface
    moved = cmfsim.MovedSurface(surface, surface.vertices + shift)
    arrays = (np.asarray(mesh.nodes), np.asarray(mesh.tets), kinds, segments)
    by_surface = crushed_tets(*arrays, motions={"maxilla": moved}, width=4.0)
    np.testing.assert_array_equal(by_surface, crushed(bite, maxilla=shift))
    assert by_surface.any()


def test_crushed_tissue_is_reported_with_its_volume(bite):
    mesh, kinds, segments = bite
    motions = {"maxilla": cmfsim.rigid_motion((0, 0, -4.2))}
    left, now, (said,) = without_crushed(mesh, kinds, segments, motions, 4.0)
    lost = float(np.sum(mesh.volumes) - np.sum(left.volumes))
    assert (said.code, said.severity) == ("crushed-left-out", "note")
    assert f"{mesh.n_tets - left.n_tets} tets of {lost:.0f} mm³" in said.what
    assert len(now.kind) == left.n_nodes
    assert without_crushed(mesh, kinds, segments, {}, 4.0) == (mesh, kinds, ())


def hinged(*sides):
    """Two cubes that share an edge, fixed at these x."""
    nodes, tets = block((2, 2, 1))
    corner = nodes[tets].mean(axis=1)
    tets = tets[(corner[:, 0] < 1) == (corner[:, 1] < 1)]
    used, tets = np.unique(tets, return_inverse=True)
    held = np.isin(nodes[used][:, 0], sides)
    kinds = cmfsim.NodeKinds(held.astype(np.uint8), np.full(len(used), -1), ())
    return cmfsim.TetMesh(nodes[used], tets.reshape(-1, 4)), kinds


def test_a_body_that_hangs_by_an_edge_goes():
    """Two cubes share an edge: each is held only by what is held of its own."""
    mesh, kinds = hinged(0.0)
    left, now, body, findings = held_part(mesh, kinds)
    assert body.tolist() == tet_bodies(left.tets).tolist()
    assert left.n_tets == 6
    assert np.asarray(left.nodes)[:, 0].max() == 1.0
    assert len(now.nodes("fixed")) == 4
    assert [(f.code, f.severity) for f in findings] == [("tissue-not-held", "note")]


def test_no_plan_lifts_a_body_off_all_that_holds_it():
    """Of two cubes that share an edge, lifted nodes alone hold one: these stay on the bone."""
    mesh, kinds = hinged(0.0, 2.0)
    nodes = np.asarray(mesh.nodes)
    # All of the far side may be lifted, and one node of the near one, which four hold.
    far = np.flatnonzero(nodes[:, 0] == 2.0)
    near = np.flatnonzero((nodes[:, 0] == 0.0) & (nodes[:, 1] <= 1.0))[:1]
    chosen = np.concatenate([far, near]).astype(np.uint32)
    n = len(chosen)
    lifted = LiftedTissue(
        skull="cranium",
        is_joined=False,
        pieces=("maxilla",),
        nodes=chosen,
        piece=np.zeros(n, dtype=np.int64),
        places=nodes[chosen],
        normals=np.tile([0.0, -1.0, 0.0], (n, 1)),
    )
    left = lifted_where_held(mesh, kinds, tet_bodies(mesh.tets), lifted)
    assert left.nodes.tolist() == near.tolist()
    fixed = np.setdiff1d(kinds.nodes("fixed"), left.free({"maxilla": np.eye(4)}))
    tensors = cmfsim.MassTensors(mesh, cmfsim.Tissue.isotropic(np.ones(mesh.n_tets), 0.3))
    cmfsim.StaticSolver(tensors, cmfsim.Boundary(fixed=fixed))
    every = np.setdiff1d(kinds.nodes("fixed"), lifted.free({"maxilla": np.eye(4)}))
    with pytest.raises(cmfsim.BoundaryError, match="free rigid modes"):
        cmfsim.StaticSolver(tensors, cmfsim.Boundary(fixed=every)).solve({})
