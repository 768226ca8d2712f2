"""The correction of a plan operator: zero with its gradient at the reference, honest elsewhere."""

import numpy as np
import pytest

import cmfsim
from cmfsim.planning.replanning.correction import PlanNumbers, fitted_correction

NODES = 30
BOXES = {
    name: np.array([[x, y, z] for x in (-30.0, 30.0) for y in (-20.0, 20.0) for z in (-10.0, 10.0)])
    + middle
    for name, middle in (("maxilla", (0.0, -60.0, 10.0)), ("mandible", (0.0, -50.0, -30.0)))
}
REFERENCE = {
    "maxilla": cmfsim.rigid_motion((0, -4, 1), 3, (1, 0, 0), (0, -60, 10)),
    "mandible": cmfsim.rigid_motion((0, 3, 0), -2, (0, 1, 1), (0, -50, -30)),
}


@pytest.fixture(scope="module")
def numbers():
    return PlanNumbers.about(REFERENCE, BOXES)


def near(rng, size=5.0):
    return {
        name: motion
        @ cmfsim.rigid_motion(
            rng.uniform(-size, size, 3),
            size * rng.uniform(),
            rng.normal(size=3),
            BOXES[name].mean(axis=0),
        )
        for name, motion in REFERENCE.items()
    }


def curved(numbers, plan):
    """An error as contact makes it: second order in some of the numbers, smooth, at every node."""
    (ax, ay, _, at, _, _), (_, by, bz, _, _, bt) = numbers.of(plan) / 5.0
    along = np.linspace(0.0, 1.0, NODES)[:, None]
    return (
        0.3 * ay * at * np.exp(-4.0 * along) * [1.0, 0.0, 0.5]
        + 0.2 * (bz * bz - by * bt) * along * [0.0, 1.0, 0.0]
        + 0.1 * ax * by * bz * (1.0 - along) * [0.3, 0.0, 1.0]
    )


@pytest.fixture(scope="module")
def fitted(numbers):
    rng = np.random.default_rng(0)
    plans = [near(rng) for _ in range(120)]
    places = np.array([numbers.of(plan) for plan in plans])
    errors = np.array([curved(numbers, p) for p in plans])
    return fitted_correction(numbers, places, np.ones(len(plans)), errors)


def test_numbers_are_shifts_and_turns_of_the_middle(numbers):
    middle = BOXES["maxilla"].mean(axis=0)
    apart = cmfsim.rigid_motion((1, -2, 3), 4, (0, 0, 1), middle)
    rows = numbers.of({**REFERENCE, "maxilla": REFERENCE["maxilla"] @ apart})
    arm = 0.6 * np.linalg.norm([30, 20, 10])
    np.testing.assert_allclose(rows[0], [1, -2, 3, 0, 0, arm * np.radians(4)], atol=1e-9)
    np.testing.assert_allclose(rows[1], 0.0, atol=1e-9)


def test_smooth_errors_are_predicted_at_plans_that_were_not_fitted(numbers, fitted):
    correction, pays = fitted
    assert pays
    rng = np.random.default_rng(1)
    errors, left = [], []
    for _ in range(60):
        plan = near(rng)
        error = curved(numbers, plan)
        errors.append(np.linalg.norm(error, axis=1).max())
        away = error - correction.displacements(plan)
        left.append(np.linalg.norm(away, axis=1).max())
    assert np.sqrt(np.mean(np.square(left))) < 0.5 * np.sqrt(np.mean(np.square(errors)))
    # What is stated of plans that were left out is what is found at other plans.
    stated = np.sqrt(np.mean(correction.left_out**2))
    assert stated == pytest.approx(np.sqrt(np.mean(np.square(left))), rel=0.35)


def test_nothing_is_added_at_the_reference_and_little_near_it(fitted):
    correction, _ = fitted
    np.testing.assert_allclose(correction.displacements(REFERENCE), 0.0, atol=1e-9)
    # First order is the operator's: a hundredth of the way adds a ten-thousandth.
    rng = np.random.default_rng(2)
    for _ in range(5):
        plan = near(rng)
        way = {name: REFERENCE[name] for name in plan}
        way["maxilla"] = plan["maxilla"]
        whole = np.abs(correction.displacements(way)).max()
        apart = cmfsim.decompose_motion(
            np.linalg.inv(REFERENCE["maxilla"]) @ plan["maxilla"], BOXES["maxilla"].mean(axis=0)
        )
        small = cmfsim.rigid_motion(
            0.01 * apart.translation, 0.01 * apart.angle, apart.axis, BOXES["maxilla"].mean(axis=0)
        )
        way["maxilla"] = REFERENCE["maxilla"] @ small
        assert np.abs(correction.displacements(way)).max() <= 2e-3 * max(whole, 0.01)


def test_far_from_every_plan_the_operator_is_left_alone(fitted):
    correction, _ = fitted
    far = {**REFERENCE, "maxilla": cmfsim.rigid_motion((0, -200, 0))}
    near_by = correction.displacements(near(np.random.default_rng(3)))
    assert np.abs(near_by).max() > 1e-3
    assert np.abs(correction.displacements(far)).max() < 1e-4 * np.abs(near_by).max()


def test_errors_without_order_are_not_corrected(numbers):
    rng = np.random.default_rng(4)
    places = np.array([numbers.of(near(rng)) for _ in range(60)])
    _, pays = fitted_correction(numbers, places, np.ones(60), rng.normal(size=(60, NODES, 3)))
    assert not pays


def test_what_is_left_out_is_what_a_fit_to_the_others_leaves(numbers):
    """The closed form against a second fit, with the same length and next to no noise in both."""
    rng = np.random.default_rng(5)
    plans = [near(rng) for _ in range(40)]
    places = np.array([numbers.of(plan) for plan in plans])
    errors = np.array([curved(numbers, plan) for plan in plans])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cmfsim.planning.replanning.correction.LENGTHS", (10.0,))
        patch.setattr("cmfsim.planning.replanning.correction.NOISES", (1e-8,))
        patch.setattr("cmfsim.planning.replanning.correction.KEPT_ENERGY", 1.0 - 1e-12)
        whole, _ = fitted_correction(numbers, places, np.ones(len(places)), errors)
        for out in (0, 17):
            others = np.arange(len(plans)) != out
            part, _ = fitted_correction(
                numbers, places[others], np.ones(others.sum()), errors[others]
            )
            away = np.linalg.norm(errors[out] - part.displacements(plans[out]), axis=1)
            assert whole.left_out[out] == pytest.approx(away.max(), rel=1e-3, abs=1e-5)
            assert whole.left_out_mean[out] == pytest.approx(away.mean(), rel=1e-3, abs=1e-5)


def test_some_of_the_nodes_are_corrected_as_all_of_them(fitted):
    correction, _ = fitted
    plan = near(np.random.default_rng(6))
    nodes = np.array([4, 9, 1])
    np.testing.assert_array_equal(
        correction.at(nodes).displacements(plan), correction.displacements(plan)[nodes]
    )
