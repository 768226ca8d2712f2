"""The nasal septum: which nodes it has, when it is there, and what it does to the nose."""

from dataclasses import replace

import numpy as np
import pytest

import cmfsim
from benches.accuracy.nose_ratios import ratios
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.meshing.node_kinds.septum import septum
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient

ADVANCE = 4.0
FORWARDS = {"maxilla": cmfsim.rigid_motion(translation=(0.0, -ADVANCE, 0.0))}


@pytest.fixture(scope="module")
def patients(tmp_path_factory):
    """The demo's head, coarse and without muscles, without and with the septum."""
    made = write_demo_case(tmp_path_factory.mktemp("septum"), edge_length=10.0)
    found = {}
    for wanted in (False, True):
        case = replace(made.case, node_kinds={"septum": wanted})
        options = BuildOptions(anatomy=made.anatomy, check=False)
        found[wanted] = build_patient(case, ("H",), options).with_plan(FORWARDS)
    return found


def held(patient, moved=("maxilla",), **changes):
    """The septum of a patient built without one."""
    given = {"landmarks": patient.landmarks, "segments": patient.segments} | changes
    return septum(patient.scene.nodes, patient.kinds, given["segments"], moved, given["landmarks"])


def test_its_nodes_lie_between_nasal_bones_tip_and_columella(patients):
    """In the plane of the midline, clear of the maxilla; free nodes become fixed, no others."""
    without, patient = patients[False], patients[True]
    found = held(without)
    nodes = np.asarray(without.scene.nodes)[found.nodes]
    marks = {**without.landmarks["skull"], **without.landmarks["skin"]}
    assert len(nodes) >= 10
    assert np.abs(nodes[:, 0]).max() < 3.5
    assert nodes[:, 1].min() > marks["pronasale"][1] + 7.0
    assert nodes[:, 2].min() > marks["subnasale"][2] + 2.0
    assert nodes[:, 2].max() < marks["rhinion"][2] + 1.0
    maxilla = next(s.surface.searched for s in without.segments if s.name == "maxilla")
    away = np.linalg.norm(maxilla.closest(nodes)[0] - nodes, axis=1)
    assert away.min() > 6.0
    changed = np.flatnonzero(found.kinds.kind != without.kinds.kind)
    assert (np.asarray(without.kinds.kind)[changed] == 0).all()
    assert np.isin(changed, found.nodes).all()
    np.testing.assert_array_equal(found.kinds.kind, patient.kinds.kind)
    assert np.isin(changed, patient.scene.fixed).all()
    # What is lifted off the bone is not of the septum.
    assert not np.isin(patient.lifted.nodes, found.nodes).any()


def test_the_tip_follows_the_maxilla_less_and_the_alae_part(patients):
    """Towards the published ratios; the upper lip follows as before."""
    before, after = (
        np.array(ratios(cmfsim.predict_patient(patients[w], "H"), ADVANCE)) for w in (False, True)
    )
    assert 0.05 < after[0] < 0.7 * before[0]
    assert 0.0 < after[1] < 0.7 * before[1]
    assert after[3] == pytest.approx(before[3], abs=0.05)
    assert after[4] > before[4] + 0.1


def test_it_needs_a_nose_whose_floor_was_cut_off(patients):
    """Nothing without a cut, or if the nasal bones are cut off as well."""
    patient = patients[False]
    for moved in ((), ("mandible_body",)):
        found = held(patient, moved)
        assert not len(found.nodes)
        assert not found.findings
        np.testing.assert_array_equal(found.kinds.kind, patient.kinds.kind)
    # A maxilla that reaches up to the nasal bones.
    up = {"skull": dict(patient.landmarks["skull"]), "skin": patient.landmarks["skin"]}
    up["skull"]["rhinion"] = up["skull"]["mid_philtrum"]
    assert not len(held(patient, landmarks=up).nodes)


def test_missing_landmarks_are_reported(patients):
    patient = patients[False]
    bare = {"skull": patient.landmarks["skull"], "skin": {}}
    found = held(patient, landmarks=bare)
    assert not len(found.nodes)
    (note,) = found.findings
    assert (note.code, note.severity) == ("septum-left-out", "note")
    assert "pronasale, subnasale are not" in note.what


def test_it_stays_with_a_skull_that_moves_and_names_do_not_matter(patients):
    patient = patients[False]
    found = held(patient)
    moved = held(patient, ("maxilla", "cranium"))
    np.testing.assert_array_equal(moved.nodes, found.nodes)
    new = np.flatnonzero(found.kinds.kind != patient.kinds.kind)
    assert (np.asarray(found.kinds.kind)[new] == 1).all()
    assert (np.asarray(moved.kinds.kind)[new] == 2).all()
    names = {"cranium": "skull", "maxilla": "skull_2"}
    segments = [replace(s, name=names.get(s.name, s.name)) for s in patient.segments]
    kinds = replace(patient.kinds, segments=tuple(s.name for s in segments))
    again = septum(patient.scene.nodes, kinds, segments, ["skull_2"], patient.landmarks)
    np.testing.assert_array_equal(again.nodes, found.nodes)


def test_it_is_true_or_false():
    with pytest.raises(cmfsim.CaseError, match="septum is 3: true or false"):
        cmfsim.kind_options({"septum": 3})
