"""Nodes that slip further than bones moved are reported; those that the plan explains are not."""

import numpy as np
import pytest

import cmfsim
from benches.scenes.meshes import box, plane
from cmfsim.solving.simulation import slip_finding

MOTION = cmfsim.rigid_motion((5.0, 0.0, 0.0))


def block(contact="bilateral"):
    """A block held on one side, on a floor that moves 5 mm under it."""
    nodes, tets = box((4, 3, 3), (12.0, 9.0, 9.0))
    low = np.flatnonzero(nodes[:, 2] == 0.0)
    return cmfsim.Scene(
        nodes,
        tets,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.4),
        fixed=np.flatnonzero(nodes[:, 2] == 9.0),
        segments={
            "floor": cmfsim.SegmentData(sliding=low, contact=cmfsim.SurfaceData(*plane(80.0, 2)))
        },
        plan={"floor": MOTION},
        options=cmfsim.SolverOptions(contact=contact),
    )


def test_tissue_that_stays_slips_by_the_motion_and_is_no_finding():
    scene = block()
    result = cmfsim.solve_scene(scene)
    low = scene.segments["floor"].sliding
    slip = np.linalg.norm(result.displacements[low] - [5.0, 0.0, 0.0], axis=1)
    assert slip == pytest.approx(5.0, abs=1e-6)
    assert slip_finding(scene, result.displacements) is None
    assert result.summary["findings"] == []


def test_a_node_that_slips_further_than_bones_moved_is_reported():
    scene = block()
    displacements = np.zeros((scene.n_nodes, 3))
    low = scene.segments["floor"].sliding
    displacements[low[2]] = [-1.2, 0.0, 0.0]
    assert slip_finding(scene, displacements) is None
    displacements[low[2]] = [-1.3, 0.0, 0.0]
    found = slip_finding(scene, displacements)
    assert (found.severity, found.code) == ("warning", "contact-slipped-far")
    place = "({:.1f}, {:.1f}, {:.1f}) mm".format(*scene.nodes[low[2]])
    assert (
        f"1 sliding node slipped further than bones moved, at most 6.3 mm on 'floor' at {place}"
        in (found.what)
    )


def test_the_motion_of_other_bones_explains_slip():
    scene = block()
    both = cmfsim.Scene(
        scene.nodes,
        scene.tets,
        tissue=scene.tissue,
        segments=dict(scene.segments)
        | {"top": cmfsim.SegmentData(joined=np.flatnonzero(scene.nodes[:, 2] == 9.0))},
        plan={"floor": MOTION, "top": cmfsim.rigid_motion((-4.0, 0.0, 0.0))},
        options=scene.options,
    )
    result = cmfsim.solve_scene(both)
    low = scene.segments["floor"].sliding
    slip = np.linalg.norm(result.displacements[low] - [5.0, 0.0, 0.0], axis=1)
    assert slip == pytest.approx(9.0, abs=1e-6)
    assert result.summary["findings"] == []
    assert slip_finding(scene, result.displacements) is not None


def test_tissue_may_leave_the_bone_where_contact_is_unilateral():
    scene = block("unilateral")
    displacements = np.zeros((scene.n_nodes, 3))
    displacements[scene.segments["floor"].sliding[2]] = [0.0, 0.0, 9.0]
    assert slip_finding(scene, displacements) is None
