"""The band of a planning model against the band of each plan solved by itself."""

from dataclasses import replace

import numpy as np
import pytest

import cmfsim
import cmfsim.planning.page.content

pytest.importorskip("skimage")

from browser_page import open_page, until
from shared_values import coarse_demo_patient

# One calibration case would be too few: the factors are those of ten.
SCORES = np.linspace(0.8, 2.6, 10)


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    """A coarse head with sliding tissue and muscles so stiff that the band depends on the plan."""
    patient = coarse_demo_patient(tmp_path_factory)
    return cmfsim.with_muscles(patient, cmfsim.CaseMuscles(preset="kim2010", blur=0.0))


@pytest.fixture(scope="module", params=["M", "M+S"])
def banded(request, patient):
    """A planning model, the prediction of its reference with a band, and the band of plans."""
    planning = cmfsim.planning_model(patient, request.param)
    reference = cmfsim.predict_with_band(planning.patient, planning.model, solver=planning.solver)
    return planning, reference, cmfsim.plan_band(planning, reference)


def other_plan(planning):
    """Every segment 3 mm and 3° away from the reference."""
    away = cmfsim.rigid_motion((1.0, -2.5, 1.0), 3.0, (1.0, 0.3, -0.2), planning.columns.centres[0])
    return {name: away @ motion for name, motion in planning.reference.items()}


def test_the_reference_has_the_band_that_was_solved(banded):
    """To rounding, in each region as well."""
    planning, reference, band = banded
    assert np.abs(band.sd(planning.reference) - reference.band.sd).max() < 1e-12
    regions = reference.band.as_dict()["regions"]
    for name, width in band.half_widths(planning.reference).items():
        assert width == pytest.approx(regions[name]["half_width_mean_mm"], rel=1e-9)
    assert np.allclose(band.factor, reference.band.plain_factor)


def test_another_plan_has_nearly_the_band_of_its_own_solution(banded):
    """What is left is of second order; a band that did not follow the plan is far more off."""
    planning, reference, band = banded
    plan = other_plan(planning)
    moved = planning.patient.with_plan(plan)
    # As a planning model has it: what is lifted off the bone is as at the reference.
    scene = replace(moved.scene, fixed=planning.patient.scene.fixed)
    own = cmfsim.predict_with_band(replace(moved, scene=scene), planning.model).band
    face = own.regions["face"]
    off = np.abs(band.sd(plan) - own.sd)[face].mean()
    assert off < 0.02 * own.sd[face].mean()
    assert off < 0.75 * np.abs(reference.band.sd - own.sd)[face].mean()
    widths = {
        name: values["half_width_mean_mm"] for name, values in own.as_dict()["regions"].items()
    }
    for name, width in band.half_widths(plan).items():
        assert width == pytest.approx(widths[name], rel=0.03)


def test_what_does_not_belong_is_refused(banded):
    """A prediction without a band, and one of another skin."""
    planning, reference, _ = banded
    with pytest.raises(cmfsim.CaseError, match="has no band: make it with predict_with_band"):
        cmfsim.plan_band(planning, replace(reference, band=None))
    fewer = replace(reference.band, sd=reference.band.sd[:-1])
    with pytest.raises(cmfsim.CaseError, match="vertices and the planning model's skin"):
        cmfsim.plan_band(planning, replace(reference, band=fewer))


def test_the_page_states_the_band_of_the_plan_that_it_shows(patient, browser, tmp_path):
    """Calibrated half-widths by region and at vertices, before and after a move, in the browser."""
    planning = cmfsim.planning_model(patient, "M+S")
    plain = cmfsim.predict_with_band(planning.patient, "M+S", solver=planning.solver)
    cases = tuple(
        cmfsim.CalibrationCase(f"case {n}", dict.fromkeys(plain.band.regions, float(score)))
        for n, score in enumerate(SCORES)
    )
    settings = cmfsim.band_settings(plain)
    made = cmfsim.Calibration("M+S", settings, cases, "ten <made> cases")
    reference = cmfsim.predict_with_band(
        planning.patient, "M+S", cmfsim.BandOptions(calibration=made), solver=planning.solver
    )
    band = cmfsim.plan_band(planning, reference)
    errors = cmfsim.expected_error(planning, trials=1)
    path = tmp_path / "plan.html"
    with pytest.MonkeyPatch.context() as patch:
        # Browsers draw by software here.
        patch.setattr(cmfsim.planning.page.content, "FACE_TRIANGLES", 10_000)
        patch.setattr(cmfsim.planning.page.content, "BONE_TRIANGLES", 6_000)
        content = cmfsim.page_content(planning, reference, errors, band=band)
    cmfsim.write_planning_page(path, content)
    for page in open_page(browser, path):
        for plan in (planning.reference, other_plan(planning)):
            rows = [np.asarray(plan[name]).ravel().tolist() for name in planning.segments]
            found = page.evaluate("rows => cmfsimPage.face.band.widths(rows)", rows)
            assert found == pytest.approx(list(band.half_widths(plan).values()), abs=0.01)
            at = page.evaluate("rows => [...cmfsimPage.face.band.halfWidths(rows)]", rows)
            wanted = np.nan_to_num(band.factor * band.sd(plan))
            assert np.abs(np.array(at) - wanted).max() < 0.01
        text = page.locator("#panel").inner_text()
        assert "How far to trust it (calibrated)" in text
        assert "like the 10 of the calibration" in text
        assert "ten <made> cases" in text
        page.evaluate("document.getElementById('show-map').click()")
        page.evaluate("document.getElementById('show-band').click()")
        until(page, "!cmfsimPage.frame && !cmfsimPage.work")
        assert page.evaluate("[cmfsimPage.view.values.map, cmfsimPage.view.values.band]") == [
            False,
            True,
        ]
        assert "Half the width of the band" in page.locator("#legend").inner_text()
        shown = page.evaluate("[...cmfsimPage.amounts].reduce((a, b) => Math.max(a, b), 0)")
        assert 0.5 * np.nanmax(wanted) < shown <= 1.1 * max(at)
        best = page.evaluate(
            """() => {
              const { face, motions } = cmfsimPage;
              let best = Infinity;
              for (let i = 0; i < 20; i++) {
                const begun = performance.now();
                face.band.widths(motions);
                best = Math.min(best, performance.now() - begun);
              }
              return best;
            }"""
        )
        # It is to follow a slider: 10 ms at 20,000 nodes.
        assert best < 10.0 * max(1.0, len(at) / 20_000)
