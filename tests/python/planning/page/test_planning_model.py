"""Planning models against exact solutions: the product, its correction, the expected error."""

import dataclasses
import json
import re

import numpy as np
import pytest

import cmfsim
import cmfsim.planning.page.content
from cmfsim.cli import main
from cmfsim.cli.plan_command import _correction_text
from cmfsim.planning.occlusion.rows import patient_rows
from cmfsim.planning.replanning.expected_error import plan_distance, plans_near
from planning_head import other_plan

pytest.importorskip("skimage")
pytest.importorskip("meshio")


def test_the_product_is_the_exact_solution_at_the_reference(planning, reference):
    product = planning.displacements(planning.reference)
    # Contact ends at 1e-4 mm.
    np.testing.assert_allclose(product, reference.skin_displacements, atol=2e-4)


def test_the_columns_are_the_operator_of_the_core(bare):
    """With the skin continued where the tissue ends, as in every prediction."""
    plan = other_plan(bare)
    operator = bare.solver.plan_operator(nodes=bare.patient.skin_nodes, plan=dict(bare.reference))
    np.testing.assert_allclose(
        bare.displacements(plan), bare.patient.skin_end.continued(operator(plan)), atol=1e-9
    )


def test_the_correction_lowers_the_error_at_plans_that_it_was_not_fitted_to(bare, planning, errors):
    plans = [trial.plan for trial in errors.trials]
    plans += [other_plan(planning), other_plan(planning, 0.5)]
    squares = []
    for plan in plans:
        exact = planning.solve(plan).skin_displacements
        away = [np.linalg.norm(m.displacements(plan) - exact, axis=1) for m in (bare, planning)]
        squares.append([(row**2).sum() for row in away])
    before, after = np.sum(squares, axis=0)
    assert after < before
    fitted = planning.correction.plans
    apart = [
        np.abs(fitted - planning.correction.numbers.of(plan)).max(axis=(1, 2)) for plan in plans
    ]
    assert np.min(apart) > 0.5
    # Carried points are corrected too.
    points = np.asarray(planning.skin_before.vertices)[::300]
    difference = planning.carried(plans[0], points) - bare.carried(plans[0], points)
    np.testing.assert_allclose(
        difference, planning.correction.displacements(plans[0])[::300], atol=1e-9
    )


def test_the_command_corrects_the_page_and_states_it(folder, planning, capsys):
    case, out = folder / "case/case.toml", folder / "corrected"
    words = ["plan", str(case), "-o", str(out), "--model", "H+S", "--no-doctor", "-q", "--no-open"]
    assert main([*words, "--trials", "1", "--corrections", "24", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    found = answer["correction"]
    assert 8 <= found["plans"] <= 24
    assert len(found["largest_left_out_mm"]) == found["plans"]
    page = (out / "plan.html").read_text("utf-8")
    values = json.loads(re.search(r'id="page-values">([^<]*)<', page)[1])
    assert values["correction"]["plans"] == found["plans"]
    correction = planning.correction
    text = _correction_text(correction)
    assert f"by {len(correction.plans)} other plans: {correction.before.max():.2f} mm" in text
    usual = np.percentile(correction.left_out, 90)
    left_out = correction.left_out.max()
    assert (
        f"{left_out:.2f} mm when each is predicted from the others (nine of ten: {usual:.2f}"
        in text
    )


def test_corrections_are_the_same_each_time(bare, planning):
    again = cmfsim.corrected_planning(bare, 24).correction
    np.testing.assert_array_equal(again.shapes, planning.correction.shapes)
    np.testing.assert_array_equal(again.weights, planning.correction.weights)
    plans = plans_near(bare, np.random.default_rng((0, 1)), 2, (5.0, 5.0))
    serial = [planning.solve(plan).skin_displacements for plan in plans]
    largest = [
        np.linalg.norm(exact - bare.displacements(plan), axis=1).max()
        for exact, plan in zip(serial, plans, strict=True)
    ]
    np.testing.assert_array_equal(again.before[:2], largest)


def test_corrections_that_cannot_be_fitted_leave_the_operator_alone(bare, planning):
    assert cmfsim.corrected_planning(planning, 0).correction is None
    assert cmfsim.corrected_planning(bare, 4).correction is None
    patient = dataclasses.replace(bare.patient, lifted=None)
    assert cmfsim.corrected_planning(cmfsim.planning_model(patient, "H"), 24).correction is None
    with pytest.raises(cmfsim.CaseError, match="plans is -1"):
        cmfsim.corrected_planning(bare, -1)


def test_without_sliding_or_lifting_the_product_is_exact_for_every_plan(planning):
    patient = dataclasses.replace(planning.patient, lifted=None)
    model = cmfsim.planning_model(patient, "H")
    plan = other_plan(model, 3.0)
    exact = model.solve(plan).skin_displacements
    assert np.abs(exact).max() > 5.0
    np.testing.assert_allclose(model.displacements(plan), exact, atol=1e-8)
    found = cmfsim.expected_error(model)
    assert found.is_exact
    assert len(found.trials) == 1
    assert found.trials[0].largest < 1e-8
    assert found.at(100.0) == (0.0, 0.0)


def test_the_error_is_that_of_tissue_lifted_as_predict_lifts_it(planning):
    """Nothing slides in model H, but other plans lift other tissue off the bone."""
    model = cmfsim.planning_model(planning.patient, "H")
    found = cmfsim.expected_error(model, trials=1)
    assert not found.is_exact
    trial = found.trials[0]
    alone = cmfsim.predict_patient(model.patient.with_plan(trial.plan), "H")
    away = np.linalg.norm(model.displacements(trial.plan) - alone.skin_displacements, axis=1)
    assert trial.largest == pytest.approx(away.max(), abs=1e-4)
    assert trial.largest > 0.01
    assert found.at(trial.distance)[1] == pytest.approx(trial.largest)


def test_a_prediction_is_planned_again_as_the_model_solves_it(planning, reference):
    plan = {"maxilla": other_plan(planning)["maxilla"]}
    again, exact = reference.replan(plan), planning.solve(plan)
    np.testing.assert_allclose(again.skin_displacements, exact.skin_displacements, atol=1e-6)
    # Segments that are not named stay, and nothing is said of where the case's motions came from.
    np.testing.assert_array_equal(again.scene.plan["mandible_body"], np.eye(4))
    assert again.summary["plan"]["maxilla"]["clinical"]["source"] == ""
    assert again.summary["case_key"] != reference.summary["case_key"]
    assert "plan-far" not in [finding.code for finding in again.findings]
    far = reference.replan({"maxilla": cmfsim.rigid_motion((0.0, -25.0, 0.0))})
    assert "plan-far" in [finding.code for finding in far.findings]
    with pytest.raises(cmfsim.CaseError, match="'skull'; segments are"):
        reference.replan({"skull": np.eye(4)})
    with pytest.raises(cmfsim.CaseError, match="does not record how it was made"):
        dataclasses.replace(reference, predicted_by=None).replan({})


def test_the_expected_error_is_that_of_the_trials(planning, errors):
    trial = errors.trials[0]
    exact = planning.solve(trial.plan).skin_displacements
    away = np.linalg.norm(planning.displacements(trial.plan) - exact, axis=1)
    assert trial.largest == pytest.approx(away.max(), rel=1e-6)
    assert trial.mean == pytest.approx(away.mean(), rel=1e-6)
    assert trial.distance == pytest.approx(plan_distance(planning, trial.plan))
    mean, largest = errors.at(trial.distance)
    assert mean >= trial.mean * (1 - 1e-12)
    assert largest >= trial.largest * (1 - 1e-12)
    assert errors.at(0.0) == (0.0, 0.0)
    assert errors.at(1.01 * errors.reach) is None
    assert errors.usual(1.01 * errors.reach) is None
    # Plans of the correction count as well, each as the others predict it.
    correction = planning.correction
    ratios = np.concatenate(
        [
            [t.largest / t.distance for t in errors.trials],
            correction.left_out / correction.distances,
        ]
    )
    assert largest == pytest.approx(trial.distance * ratios.max())
    assert errors.usual(trial.distance) == pytest.approx(
        trial.distance * np.percentile(ratios, 90.0)
    )
    assert errors.usual(trial.distance) < largest
    drawn = plans_near(planning, np.random.default_rng((0, 1)), 1, (5.0, 5.0))
    assert correction.distances[0] == pytest.approx(plan_distance(planning, drawn[0]))
    # Trials differ from the reference, by no more than what was asked for.
    assert 1.0 < trial.distance < 5.0 * 3**0.5 + 15.0


def test_scenes_without_a_linear_rigid_answer_are_refused(planning):
    scene = planning.patient.scene
    options = dataclasses.replace(scene.options, kinematics="corotational")
    bent = dataclasses.replace(planning.patient, scene=dataclasses.replace(scene, options=options))
    with pytest.raises(cmfsim.CaseError, match="corotational kinematics"):
        cmfsim.planning_model(bent, "H")
    name = "maxilla"
    shifts = np.zeros((len(scene.segments[name].joined), 3))
    torn = planning.patient.with_plan({name: shifts})
    with pytest.raises(cmfsim.CaseError, match="'maxilla' moves vertex by vertex"):
        cmfsim.planning_model(torn, "H+S")
    with pytest.raises(cmfsim.BoundaryError):
        planning.displacements({name: 2.0 * np.eye(4)})
    with pytest.raises(ValueError, match="trials is 0"):
        cmfsim.expected_error(planning, trials=0)


def test_tooth_rows_pass_through_each_other_when_the_jaw_closes(planning):
    rows = cmfsim.planning.page.row_overlap(planning.patient)
    surface = patient_rows(planning.patient)[0].surface.searched
    found = []
    for up in (0.0, 4.0, 7.0):
        shift = cmfsim.rigid_motion((0.0, 0.0, up))
        places = rows.points + [0.0, 0.0, up]
        inside = np.asarray(surface.winding_number(places)) > 0.5
        away = np.linalg.norm(surface.closest(places)[0] - places, axis=1)
        depth = rows.passing({"mandible_body": shift})
        # A grid of 1 mm, against the surface itself.
        assert depth == pytest.approx(max(away[inside], default=0.0), abs=0.25)
        found.append(depth)
    assert found[0] < 0.3 < found[1] < found[2]
    # Both jaws together: nothing changes between them.
    both = cmfsim.rigid_motion((3, -2, 9), 7, (1, 2, 3))
    together = rows.passing({"maxilla": both, "mandible_body": both})
    assert together == pytest.approx(found[0], abs=1e-6)
