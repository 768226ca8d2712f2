"""Jaws that a plan moves through each other, out of the joint, or the wrong way round."""

import numpy as np
import pytest

import cmfsim
from cmfsim.doctor.surgery.bone_overlap import BonePart, check_jaws, jaw_of
from cmfsim.pipeline.building.case_checks import jaws
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from cmfsim.values.surface_data import joined_surface
from head_case import HeadCase, icosphere
from shared_values import coarse_demo_patient

TEETH = {"supradentale": np.array([0.0, -93.0, -32.0]), "infradentale": np.array([0.0, -90.0, -53])}


def shifted(x=0.0, y=0.0, z=0.0):
    motion = np.eye(4)
    motion[:3, 3] = x, y, z
    return motion


def ball(centre, axes, rounds=2):
    vertices, triangles = icosphere(rounds)
    return cmfsim.SurfaceData(vertices * axes + centre, triangles)


def lower_jaw():
    """A body under the skull, 2 mm away, and two heads beside it, 2 mm away."""
    heads = [ball((48.0 * side, -10.0, 0.0), (5.0, 5.0, 10.0)) for side in (-1, 1)]
    return joined_surface([ball((0.0, -60.0, -52.0), (40.0, 30.0, 15.0), 3), *heads])


def found(motion, *, upper=None, segments=("mandible",)):
    skull = ball((0.0, -50.0, 15.0), (60.0, 60.0, 50.0), 3)
    parts = [
        BonePart("cranium", "upper", "plan.cranium", skull, np.eye(4) if upper is None else upper)
    ]
    jaw = lower_jaw()
    for name in segments:

        def owns(points, name=name):
            body = points[:, 2] < -30.0
            return {"mandible": body | True, "mandible_body": body, "ramus": ~body}[name]

        moved = np.eye(4) if name == "ramus" else motion
        parts.append(BonePart(name, "lower", f"plan.{name}", jaw, moved, owns))
    return {f.code: f for f in check_jaws(parts, TEETH)}


def test_a_jaw_that_is_not_moved_is_no_finding():
    assert found(np.eye(4)) == {}
    assert found(shifted(y=2.0, z=-1.0)) == {}


def test_teeth_nine_millimetres_up_through_the_others_are_found():
    up = found(shifted(z=9.0), segments=("mandible_body", "ramus"))
    assert set(up) == {"plan-through-bone"}
    assert "mandible_body lies" in up["plan-through-bone"].what
    assert "cranium is not moved" in up["plan-through-bone"].fix
    # Both jaws together pass through nothing.
    assert found(shifted(z=9.0), upper=shifted(z=9.0), segments=("mandible_body",)) == {}


def test_bones_that_overlapped_before_are_found_only_if_they_do_more():
    skull = ball((0.0, -50.0, 15.0), (60.0, 60.0, 50.0), 3)
    deep = cmfsim.SurfaceData(skull.vertices + [0.0, 0.0, -5.0], skull.triangles)
    for shift, expected in ((0.5, []), (4.0, ["plan-through-bone"])):
        parts = [
            BonePart("maxilla", "upper", "", deep, np.eye(4)),
            BonePart("mandible_body", "lower", "", lower_jaw(), shifted(z=shift)),
        ]
        assert [f.code for f in check_jaws(parts, {})] == expected


def test_a_bone_that_is_followed_by_its_vertices_is_looked_up_too():
    jaw = lower_jaw()
    up = cmfsim.MovedSurface(jaw, jaw.vertices + [0.0, 0.0, 9.0])
    assert set(found(up)) == {"plan-through-bone", "joint-left"}


def test_a_whole_jaw_that_leaves_its_joint_lacks_a_split():
    whole = found(shifted(z=-5.0))
    assert set(whole) == {"joint-left"}
    assert "sagittal split missing" in whole["joint-left"].fix
    assert found(shifted(z=-4.0)) == {}
    # With the split, the joint heads stay.
    assert found(shifted(z=-5.0), segments=("mandible_body", "ramus")) == {}
    # A jaw that opens turns about its joints.
    opened = cmfsim.rigid_motion(angle=12.0, axis=(1, 0, 0), centre=(0, -10, 0))
    assert found(opened) == {}


@pytest.mark.parametrize("wrong", ["exchanged", "reversed"])
def test_tables_of_the_jaws_exchanged_or_with_other_signs_are_found(tmp_path_factory, wrong):
    """The embedded case: the maxilla forwards, the mandible back; and the other way round."""
    patient = coarse_demo_patient(tmp_path_factory)
    plan = {"maxilla": shifted(y=-5.0, z=0.5), "mandible_body": shifted(y=3.5, z=0.5)}
    made = {
        "exchanged": {"maxilla": plan["mandible_body"], "mandible_body": plan["maxilla"]},
        "reversed": {name: np.linalg.inv(motion) for name, motion in plan.items()},
    }
    landmarks = patient.landmarks["skull"]
    case = cmfsim.Case.load(HeadCase(rounds=1).write(tmp_path_factory.mktemp("head")))
    good = jaws(PlannedBones(patient.segments, plan), landmarks, case, ())
    assert [f.code for f in good] == []
    bad = jaws(PlannedBones(patient.segments, made[wrong]), landmarks, case, ())
    assert [f.code for f in bad] == ["bite-odd"]
    assert wrong in bad[0].fix


def test_the_doctor_finds_it_before_any_work(tmp_path):
    head = HeadCase()
    head.replace("translation = [0, -4, 1]", "translation = [0, -4, 16]")
    codes = [f.code for f in cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path)))]
    assert "plan-through-bone" in codes


def test_jaws_are_known_by_the_names_of_their_bones():
    names = ("mandible_body", "ramus_left", "chin", "maxilla_2", "midface", "cranium", "tongue")
    jaw = ("lower", "lower", "lower", "upper", "upper", "upper", None)
    assert tuple(map(jaw_of, names)) == jaw
