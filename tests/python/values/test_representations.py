"""What the large values show of themselves at a prompt: a few lines, never their arrays."""

import json
from dataclasses import dataclass, field

import numpy as np
import pytest

import cmfsim
import phantom_case
from cmfsim.errors import CaseInputError
from cmfsim.values import checks
from shared_values import coarse_demo_patient, drawn_levels


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    return coarse_demo_patient(tmp_path_factory)


def lines_of(value):
    lines = repr(value).splitlines()
    assert 2 <= len(lines) <= 8
    assert max(map(len, lines)) < 250
    return lines


def test_a_patient_shows_its_size_anatomy_and_findings(patient):
    title, *rows = lines_of(patient)
    assert title == f"PatientModel {patient.name!r}"
    text = "\n".join(rows)
    assert f"{patient.scene.n_nodes} nodes, {patient.scene.n_tets} tets" in text
    assert f"{len(patient.muscles)}" in text
    notes = sum(f.severity == "note" for f in patient.findings)
    assert f"{notes} notes" in text


def test_a_scene_shows_how_far_each_segment_moves(patient):
    scene = patient.with_plan({"maxilla": cmfsim.rigid_motion((0.0, -3.0, 4.0))}).scene
    (plan,) = [line for line in lines_of(scene) if line.strip().startswith("plan")]
    assert "maxilla moves up to 5.0 mm" in plan
    assert "mandible_body stays" in plan


def test_a_planning_model_shows_what_may_move_and_whether_its_product_is_exact(patient):
    title, *rows = lines_of(cmfsim.planning_model(patient, "M"))
    assert title == f"PlanningModel {patient.name!r}"
    text = "\n".join(rows)
    assert ", ".join(patient.scene.segments) in text
    assert ("linearised contact" in text) == (
        patient.lifted is not None and len(patient.lifted.nodes) > 0
    )
    sliding = "\n".join(lines_of(cmfsim.planning_model(patient, "M+S")))
    assert "linearised contact" in sliding


def test_a_prediction_shows_its_skin_and_its_solution(patient):
    prediction = cmfsim.predict_patient(patient, "H")
    title, *rows = lines_of(prediction)
    assert title == f"Prediction of H for {patient.name!r}"
    assert any("moves up to" in row and row.strip().startswith("skin") for row in rows)
    assert any("estimated error" in row for row in rows)
    assert "estimated at" in repr(prediction.result)
    lines_of(prediction.result)


def test_a_case_shows_its_file_inputs_and_plan(tmp_path, tmp_path_factory):
    anatomy = drawn_levels(tmp_path_factory, 3.0)
    path = phantom_case.surface_case(tmp_path, cmfsim.make_head(), anatomy)
    case = cmfsim.Case.load(path)
    text = "\n".join(lines_of(case))
    assert str(path) in text
    assert "skin" in text
    assert all(name in text for name in case.plan)


def test_surfaces_images_and_comparisons_show_the_shapes_of_their_arrays(tmp_path_factory):
    levels = drawn_levels(tmp_path_factory, 6.0)
    anatomy = cmfsim.Anatomy(skin=levels.skin, bones=levels.bones)
    assert "cranium, mandible" in "\n".join(lines_of(anatomy))
    assert f"{anatomy.skin.values.shape} float32" in repr(anatomy.skin)
    head = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 5, [[0, 1, 2]])
    assert "vertices      (15, 3) float64" in lines_of(head)[1]
    assert max(map(len, repr(cmfsim.check_surface(head)).splitlines())) < 250


@dataclass(frozen=True)
class Measured(checks.Plain):
    """A value as files hold it."""

    place: np.ndarray = field(metadata=checks.in_files("place_mm"))
    count: int
    own: np.ndarray = field(metadata=checks.in_files(None))
    parts: dict = field(default_factory=dict)


def test_files_hold_fields_under_their_names_and_no_others():
    """Arrays, tuples and numbers of numpy become plain; values within values do as well."""
    inner = Measured(np.arange(2), np.int64(3), np.ones(4))
    outer = Measured(np.array([0.5]), 1, np.ones(4), {"a": (inner, None, np.float64(0.25))})
    assert outer.as_dict() == {
        "place_mm": [0.5],
        "count": 1,
        "parts": {"a": [{"place_mm": [0, 1], "count": 3, "parts": {}}, None, 0.25]},
    }
    assert json.loads(json.dumps(outer.as_dict())) == outer.as_dict()


@pytest.mark.parametrize("value", [0, 5, True, 2.0, "2", None])
def test_whole_numbers_are_checked_by_kind_and_range(value):
    """The error has the name, the value and the range; numpy's whole numbers become Python's."""
    with pytest.raises(CaseInputError, match=f"n is {value!r}: a whole number from 1 to 4 is"):
        checks.as_whole("n", value, 1, 4)
    assert type(checks.as_whole("n", np.uint8(4), 1, 4)) is int
    with pytest.raises(CaseInputError, match="contact_iterations is 0: a whole number from 1 on"):
        cmfsim.SolverOptions(contact_iterations=0)
