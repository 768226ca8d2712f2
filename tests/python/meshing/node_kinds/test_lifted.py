"""Tissue lifted off the bone above a Le Fort I cut: where, and under which plans it is free."""

from dataclasses import replace

import numpy as np
import pytest

import cmfsim
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient

FORWARDS, BACK = (0.0, -5.0, 0.0), (0.0, 5.0, 0.0)


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    """The demo's head, coarse, without muscles and septum, whose nodes are not lifted."""
    made = write_demo_case(tmp_path_factory.mktemp("lifted"), edge_length=10.0)
    case = replace(made.case, node_kinds={"septum": False})
    return build_patient(case, ("H",), BuildOptions(anatomy=made.anatomy, check=False))


def plan_of(translation):
    """A plan that moves the maxilla without turning it."""
    return {"maxilla": cmfsim.rigid_motion(translation=translation)}


def solved(patient, translation):
    """The patient and the displacements of all nodes with the maxilla moved."""
    moved = patient.with_plan(plan_of(translation))
    return moved, np.asarray(cmfsim.predict_patient(moved, "H").result.displacements)


def depth_in(bone, points):
    """How deep points lie in a closed surface, mm."""
    surface = cmfsim.Surface(bone.vertices, bone.triangles)
    inside = surface.winding_number(points) > 0.5
    closest, _, _ = surface.closest(points)
    return np.where(inside, np.linalg.norm(closest - points, axis=1), 0.0)


def test_it_lies_on_the_cranium_within_reach_of_the_maxilla(patient):
    """Fixed nodes of the cranium, all of those within 10 mm of the maxilla, and no other."""
    lifted, kinds = patient.lifted, patient.kinds
    surfaces = {segment.name: segment.surface for segment in patient.segments}
    maxilla = cmfsim.Surface(surfaces["maxilla"].vertices, surfaces["maxilla"].triangles)
    fixed = kinds.nodes("fixed")
    on_cranium = fixed[kinds.segment[fixed] == kinds.segments.index("cranium")]
    places = np.asarray(patient.scene.nodes)[on_cranium]
    near = np.linalg.norm(maxilla.closest(places)[0] - places, axis=1) < 10.0
    assert 20 < near.sum() < len(near)
    assert np.array_equal(lifted.nodes, on_cranium[near])
    assert np.allclose(np.linalg.norm(lifted.normals, axis=1), 1.0)


def test_a_plan_frees_what_it_does_not_press_against_the_bone(patient):
    """Forwards most are free, back most are fixed, each by the sign of its way along the normal."""
    lifted = patient.lifted
    forwards, back = (lifted.free(plan_of(t)) for t in (FORWARDS, BACK))
    assert len(forwards) > len(back)
    outward = lifted.normals @ np.array(FORWARDS)
    assert np.array_equal(forwards, lifted.nodes[outward >= 0.0])
    assert np.array_equal(back, lifted.nodes[outward <= 0.0])
    # Nothing moves: nothing is pressed.
    assert len(lifted.free({"maxilla": np.eye(4)})) == len(lifted.nodes)
    surface = next(s.surface for s in patient.segments if s.name == "maxilla")
    by_surface = cmfsim.MovedSurface(surface, np.asarray(surface.vertices) + FORWARDS)
    assert np.array_equal(lifted.free({"maxilla": by_surface}), forwards)
    for plan in (FORWARDS, BACK):
        scene = patient.with_plan(plan_of(plan)).scene
        held = set(np.asarray(scene.fixed).tolist())
        assert held.isdisjoint(lifted.free(plan_of(plan)).tolist())
        assert held | set(lifted.nodes.tolist()) >= set(patient.kinds.nodes("fixed").tolist())


def test_skin_beside_the_nose_goes_along_and_bone_is_not_entered(patient):
    """Against the same with all of it fixed: farther forwards; no deeper in bone if set back."""
    skin = patient.skin_nodes
    places = np.asarray(patient.scene.nodes)[skin]
    lifted = patient.lifted
    above = np.median(lifted.places[lifted.normals[:, 1] < -0.5], axis=0)
    beside = np.linalg.norm(places - above, axis=1) < 20.0
    attached = replace(
        patient,
        lifted=None,
        scene=replace(patient.scene, fixed=np.union1d(patient.scene.fixed, lifted.nodes)),
    )
    _, free = solved(patient, FORWARDS)
    _, held = solved(attached, FORWARDS)
    assert -free[skin][beside, 1].mean() > -held[skin][beside, 1].mean() + 0.2
    moved, back = solved(patient, BACK)
    _, held_back = solved(attached, BACK)
    cranium = next(s.surface for s in patient.segments if s.name == "cranium")
    points = np.asarray(moved.scene.nodes)
    deepest = depth_in(cranium, (points + back)[lifted.nodes]).max()
    assert deepest < depth_in(cranium, (points + held_back)[lifted.nodes]).max() + 0.6


def test_the_face_is_continuous_where_nodes_change_sides(patient):
    """Plans a tenth of a degree apart, on either side of the change of many nodes."""
    turned = [
        {"maxilla": cmfsim.rigid_motion((0.0, 0.0, 0.0), angle, (1.0, 0.0, 0.0), (0.0, -70.0, 0.0))}
        for angle in (-0.05, 0.05)
    ]
    faces = [
        np.asarray(cmfsim.predict_patient(patient.with_plan(p), "H").skin_displacements)
        for p in turned
    ]
    assert np.abs(faces[1] - faces[0]).max() < 0.3


def test_none_where_nothing_was_separated_or_it_is_switched_off(patient):
    """No maxilla that moves, or 0 mm; and a reach into the orbits is refused."""
    nodes, kinds, segments = patient.scene.nodes, patient.kinds, patient.segments
    # The mandible and its rami touch the skull at no cut.
    assert cmfsim.lifted_tissue(nodes, kinds, segments, ["mandible_body"]) is None
    none = cmfsim.KindOptions(lifted=0.0)
    assert cmfsim.lifted_tissue(nodes, kinds, segments, ["maxilla"], none) is None
    with pytest.raises(cmfsim.CaseError, match="lifted is 30 mm: 0 \\(none\\) to 25"):
        cmfsim.KindOptions(lifted=30.0)


def renamed(patient, names):
    """The nodes, kinds and segments of a patient with other names of the segments."""
    segments = [replace(s, name=names.get(s.name, s.name)) for s in patient.segments]
    kinds = replace(patient.kinds, segments=tuple(names.get(n, n) for n in patient.kinds.segments))
    return patient.scene.nodes, kinds, segments


def test_the_cut_is_found_whatever_the_segments_are_called(patient):
    """Bit for bit the same nodes, and the same free ones under a plan."""
    names = {"cranium": "skull", "maxilla": "skull_2", "mandible_body": "jaw"}
    found = cmfsim.lifted_tissue(*renamed(patient, names), ["skull_2", "jaw"])
    assert (found.skull, found.pieces, found.is_joined) == ("skull", ("skull_2",), False)
    for name in ("nodes", "places", "normals", "piece"):
        np.testing.assert_array_equal(getattr(found, name), getattr(patient.lifted, name))
    plan = {"skull_2": cmfsim.rigid_motion(translation=FORWARDS)}
    np.testing.assert_array_equal(found.free(plan), patient.lifted.free(plan_of(FORWARDS)))


def test_a_skull_that_may_move_itself_has_its_nodes_lifted_as_well(patient):
    """Its nodes are joined to it instead of fixed: the motion that counts is that between both."""
    kinds, old = patient.kinds, patient.lifted
    kind, fixed = np.array(kinds.kind), kinds.nodes("fixed")
    kind[fixed[kinds.segment[fixed] == kinds.segments.index("cranium")]] = 2
    kinds = replace(kinds, kind=kind)
    found = cmfsim.lifted_tissue(
        patient.scene.nodes, kinds, patient.segments, ["maxilla", "cranium"]
    )
    assert found.is_joined
    np.testing.assert_array_equal(found.nodes, old.nodes)
    motion = plan_of(FORWARDS)
    np.testing.assert_array_equal(found.free(motion), old.free(motion))
    # Both move alike: nothing is pressed.
    alike = motion | {"cranium": motion["maxilla"]}
    assert len(found.free(alike)) == len(found.nodes)
    data = {"cranium": cmfsim.SegmentData(joined=kinds.nodes("joined", "cranium"))}
    still = motion | {"cranium": np.eye(4)}
    others, held = found.held(kinds.nodes("fixed"), data, still)
    np.testing.assert_array_equal(others, kinds.nodes("fixed"))
    left = set(held["cranium"].joined.tolist())
    assert left == set(data["cranium"].joined.tolist()) - set(found.free(still).tolist())
    # Back where it was: every node that the new plan presses is joined again.
    _, again = found.held(others, held, plan_of(BACK) | {"cranium": np.eye(4)})
    pressed = np.setdiff1d(found.nodes, found.free(plan_of(BACK)))
    assert np.isin(pressed, again["cranium"].joined).all()
