"""Planning from the face: plans are found again from their faces, and what is open is stated."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

import cmfsim
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient
from cmfsim.planning.face_planning.planning import bounded_least_squares
from head_case import HeadCase

pytest.importorskip("skimage")
pytest.importorskip("meshio")

SEGMENTS = ("maxilla", "mandible")
CUT = """
[[osteotomies]]
plane = { point = [0, 0, 1500], normal = [0, 0, -1] }
bone = "cranium"
name = "maxilla"

[plan.maxilla]
translation = [0, -3, 0.5]

[tissue]
"""
NUMBERS = ("forwards", "up", "left", "pitch", "yaw", "roll")


@pytest.fixture(scope="module")
def planning(tmp_path_factory):
    """Two segments without sliding: the operator is exact, so that the search is what is tested."""
    case = HeadCase()
    case.replace("\n[tissue]\n", CUT)
    case.replace("edge_length = 4.0", "edge_length = 9.0")
    path = case.write(tmp_path_factory.mktemp("face"))
    return cmfsim.planning_model(build_patient(path, ("H",), BuildOptions(check=False)), "H")


def stated(planning, plan):
    skull = planning.patient.landmarks["skull"]
    rows = [cmfsim.clinical_motion(name, plan[name], landmarks=skull) for name in SEGMENTS]
    return np.array([getattr(row, number) for row in rows for number in NUMBERS])


def random_plan(planning, rng, size=5.0):
    skull = planning.patient.landmarks["skull"]
    points = {"maxilla": skull["supradentale"], "mandible": skull["infradentale"]}
    return {
        name: cmfsim.planned_motion(
            point, shift=rng.uniform(-size, size, 3), turn=rng.uniform(-size, size, 3)
        )
        for name, point in points.items()
    }


def moving_points(planning, count, rng):
    moves = np.abs(planning.columns.matrix[..., -3:]).max(axis=(1, 2)) > 0.1
    moves |= np.abs(planning.columns.matrix[..., 9:12]).max(axis=(1, 2)) > 0.1
    chosen = rng.choice(np.flatnonzero(moves), count, replace=False)
    return np.asarray(planning.skin_before.vertices)[chosen]


def test_plans_are_found_again_from_their_own_faces(planning):
    rng = np.random.default_rng(0)
    points = moving_points(planning, 100, rng)
    for _ in range(10):
        plan = random_plan(planning, rng)
        goals = points + planning.carried(plan, points)
        found = cmfsim.plan_for_face(planning, [cmfsim.PointTarget(points, goals)], exact=False)
        assert found.converged
        np.testing.assert_allclose(
            stated(planning, found.plan), stated(planning, plan), atol=0.1, rtol=0
        )
        assert max(np.abs(found.residuals[0])) * 0.5 < 0.05


def test_noise_is_within_the_stated_deviations(planning):
    """0.2 mm at 30 points: errors are those of the covariance, and small where it is small."""
    rng = np.random.default_rng(1)
    free = cmfsim.FaceSearch(prior_shift=None, prior_turn=None, shift=60.0, turn=60.0)
    errors, deviations = [], []
    for _ in range(25):
        plan = random_plan(planning, rng)
        points = moving_points(planning, 30, rng)
        goals = points + planning.carried(plan, points) + rng.normal(scale=0.2, size=points.shape)
        target = cmfsim.PointTarget(points, goals, std=0.2)
        found = cmfsim.plan_for_face(planning, [target], free, exact=False)
        errors.append(np.abs(stated(planning, found.plan) - stated(planning, plan)))
        deviations.append(np.concatenate([found.std[name] for name in SEGMENTS]))
    errors, deviations = np.array(errors), np.array(deviations)
    # Of normal errors 95 % lie within two deviations; 300 of them are counted here.
    assert 0.92 < (errors <= 2.0 * deviations).mean() <= 1.0
    determined = deviations <= 0.25
    assert determined.any()
    assert np.percentile(errors[determined], 95) <= 0.5


def test_bounds_hold_and_are_named(planning):
    rng = np.random.default_rng(2)
    points = moving_points(planning, 60, rng)
    plan = {"maxilla": cmfsim.rigid_motion((0, -9, 0)), "mandible": cmfsim.rigid_motion((0, 2, 0))}
    goals = points + planning.carried(plan, points)
    search = cmfsim.FaceSearch(shift=6.0)
    found = cmfsim.plan_for_face(planning, [cmfsim.PointTarget(points, goals)], search, exact=False)
    assert "maxilla: forwards" in found.at_bounds
    assert found.motions["maxilla"].forwards == pytest.approx(6.0)
    assert found.std["maxilla"][0] == 0.0
    assert np.abs(stated(planning, found.plan)).max() <= 15.0 + 1e-6
    # What is out of reach is left in the residuals.
    assert np.abs(found.residuals[0]).max() * 0.5 > 0.5


def test_a_follower_keeps_the_final_bite(planning):
    rng = np.random.default_rng(3)
    points = moving_points(planning, 40, rng)
    goals = points + [0.0, -2.0, 1.0]
    search = cmfsim.FaceSearch(follows={"mandible": "maxilla"})
    found = cmfsim.plan_for_face(planning, [cmfsim.PointTarget(points, goals)], search, exact=False)
    assert list(found.motions) == ["maxilla"]
    assert found.covariance.shape == (6, 6)
    for plan in (found.plan, planning.reference):
        bite = np.linalg.inv(plan["maxilla"]) @ plan["mandible"]
        wanted = np.linalg.inv(planning.reference["maxilla"]) @ planning.reference["mandible"]
        np.testing.assert_allclose(bite, wanted, atol=1e-9)


def test_a_measure_is_met_by_the_smallest_move(planning):
    """A wider mouth is asked for: met, with much left open, and the exact face has it too."""
    sites = cmfsim.face_sites(planning.patient)
    names = list(sites.skin)
    before = np.array([sites.skin[name] for name in names])
    now = before + planning.carried(planning.reference, before)
    is_now = cmfsim.measure_sites(dict(zip(names, now, strict=True)))["mouth_width"]
    wish = cmfsim.MeasureTarget("mouth_width", is_now + 0.3, std=0.01)
    found = cmfsim.plan_for_face(planning, [wish])
    assert abs(found.residuals[0][0]) < 1.0
    measured = cmfsim.measure_face(found.exact)["mouth_width"]
    assert measured == pytest.approx(is_now + 0.3, abs=0.02)
    assert found.exact_residuals[0][0] == pytest.approx((measured - is_now - 0.3) / 0.01, abs=1e-6)
    assert len(found.undetermined) >= 8


def test_the_face_of_a_plan_is_found_as_a_surface(planning):
    plan = {"maxilla": cmfsim.rigid_motion((0, -4, 1)), "mandible": cmfsim.rigid_motion((1, 3, 0))}
    wish = cmfsim.SurfaceTarget(planning.skin(plan), std=0.1)
    found = cmfsim.plan_for_face(planning, [wish], exact=False)
    reached = planning.displacements(found.plan)
    asked = planning.displacements(plan)
    start = planning.displacements(planning.reference)
    # Skin may slide on itself: what is seen is how far the surfaces are apart.
    assert np.abs(found.residuals[0]).mean() * 0.1 < 0.02
    assert np.linalg.norm(reached - asked, axis=1).mean() < 0.2 * (
        np.linalg.norm(start - asked, axis=1).mean()
    )


def test_directions_count_alone(planning):
    rng = np.random.default_rng(4)
    points = moving_points(planning, 30, rng)
    goals = points + planning.carried({"mandible": cmfsim.rigid_motion((4, 2, 0))}, points)
    sideways = goals + np.outer(rng.normal(size=30) * 50.0, [1.0, 0.0, 0.0])
    depth = np.tile([0.0, 2.0, 0.0], (30, 1))
    found = [
        cmfsim.plan_for_face(
            planning, [cmfsim.PointTarget(points, wanted, directions=depth)], exact=False
        )
        for wanted in (goals, sideways)
    ]
    np.testing.assert_allclose(found[0].plan["mandible"], found[1].plan["mandible"], atol=1e-6)


def test_targets_that_cannot_be_met_are_refused(planning):
    point = np.asarray(planning.skin_before.vertices)[:1]
    with pytest.raises(cmfsim.CaseError, match="no target"):
        cmfsim.plan_for_face(planning, [])
    with pytest.raises(cmfsim.CaseError, match="is outside the tissue"):
        cmfsim.plan_for_face(planning, [cmfsim.PointTarget(point + 500.0, point)])
    with pytest.raises(cmfsim.CaseError, match="one goal for each"):
        cmfsim.PointTarget(point, np.zeros((2, 3)))
    with pytest.raises(ValueError, match="target goals"):
        cmfsim.PointTarget(point, point * np.nan)
    with pytest.raises(cmfsim.CaseError, match="measure is 'beauty'"):
        cmfsim.MeasureTarget("beauty", 1.0)
    with pytest.raises(cmfsim.CaseError, match="incisor_show cannot be a target"):
        cmfsim.plan_for_face(planning, [cmfsim.MeasureTarget("incisor_show", 2.0)])
    far = planning.skin(planning.reference)
    far = cmfsim.SurfaceData(np.asarray(far.vertices) + 900.0, far.triangles)
    with pytest.raises(cmfsim.CaseError, match="in the frame of the case"):
        cmfsim.plan_for_face(planning, [cmfsim.SurfaceTarget(far)])
    wish = [cmfsim.PointTarget(point, point)]
    for search, said in (
        (cmfsim.FaceSearch(segments=["chin"]), "no segment 'chin'"),
        (cmfsim.FaceSearch(follows={"maxilla": "maxilla"}), "does not move independently"),
        (cmfsim.FaceSearch(["mandible"], follows={"mandible": "maxilla"}), "nothing is free"),
    ):
        with pytest.raises(cmfsim.CaseError, match=said):
            cmfsim.plan_for_face(planning, wish, search)


@settings(max_examples=25)
@given(st.integers(0, 2**31))
def test_the_search_ends_where_another_does(seed):
    """Bounded linear and mildly curved problems, against SciPy's trust-region method."""
    rng = np.random.default_rng(seed)
    matrix, right = rng.normal(size=(12, 4)), 3.0 * rng.normal(size=12)

    def residuals(x):
        return matrix @ (x + 0.02 * x**2) - right

    low, high = np.full(4, -0.8), np.full(4, 0.9)
    found = bounded_least_squares(residuals, np.zeros(4), low, high, steps=100)
    other = least_squares(residuals, np.zeros(4), bounds=(low, high), xtol=1e-12, gtol=1e-12)
    assert found.converged
    assert found.residuals @ found.residuals <= 2.0 * other.cost * (1.0 + 1e-6)
    assert (found.x >= low).all()
    assert (found.x <= high).all()
