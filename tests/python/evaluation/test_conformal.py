"""Split conformal factors: their formula, what they hold, and what is refused."""

import json
import math

import numpy as np
import pytest
from scipy import stats

import cmfsim


@pytest.mark.parametrize("n", [9, 10, 19, 37, 99, 200])
@pytest.mark.parametrize("coverage", [0.5, 0.8, 0.9])
def test_the_factor_is_numpys_higher_quantile_of_the_scores_with_infinity(n, coverage):
    """Tibshirani et al. 2019: the quantile of the n scores and one at infinity."""
    scores = np.random.default_rng(n).gamma(2.0, 1.0, n)
    found = cmfsim.calibrate(scores, coverage)
    # The smallest value with a share of at least `coverage` of the n + 1 at or below it.
    extended = np.sort(np.append(scores, np.inf))
    enough = [v for i, v in enumerate(extended) if (i + 1) / (n + 1) >= coverage - 1e-12]
    assert found.factor == enough[0]
    assert np.quantile(extended, coverage, method="inverted_cdf") == pytest.approx(found.factor)
    assert found.n == n
    assert found.factor == np.sort(scores)[found.rank - 1]


@pytest.mark.parametrize(
    ("n", "coverage"), [(9, 0.9), (19, 0.9), (40, 0.9), (225, 0.9), (999, 0.95)]
)
def test_the_interval_is_that_of_the_beta_distribution(n, coverage):
    found = cmfsim.calibrate(np.arange(n, dtype=float), coverage)
    beta = stats.beta(found.rank, n + 1 - found.rank)
    assert found.interval == pytest.approx((beta.ppf(0.05), beta.ppf(0.95)), abs=1e-9)
    low, high = cmfsim.covered_interval(found, 100)
    binomial = stats.betabinom(100, found.rank, n + 1 - found.rank)
    assert (low, high) == (binomial.ppf(0.05), binomial.ppf(0.95))


def test_exchangeable_scores_are_covered_as_often_as_promised():
    """4000 calibrations of 39 cases, each with one further case: 90 % within binomial limits."""
    rng = np.random.default_rng(21)
    trials, n = 4000, 39
    scores = rng.lognormal(0.0, 0.8, (trials, n + 1))
    held = sum(row[-1] <= cmfsim.calibrate(row[:-1], 0.9).factor for row in scores)
    low, high = stats.binom(trials, 0.9).ppf([0.001, 0.999])
    assert low <= held <= high


def test_a_whole_region_is_covered_at_once_in_simulated_cases():
    """Correlated errors whose size the standard deviation gets wrong by a common factor."""
    rng = np.random.default_rng(5)
    trials, n, k = 300, 19, 40
    sd = rng.uniform(0.3, 2.0, k)
    regions = {"face": np.ones(k, dtype=bool), "chin": np.arange(k) < 10}
    held = dict.fromkeys(regions, 0)

    def case():
        common = rng.normal()
        return 1.7 * sd * (0.8 * common + 0.6 * rng.standard_t(4, k))

    for _ in range(trials):
        scores = [cmfsim.region_scores(case(), sd, regions) for _ in range(n)]
        error = case()
        for name, part in regions.items():
            factor = cmfsim.calibrate([s[name] for s in scores], 0.9).factor
            held[name] += bool((np.abs(error)[part] <= factor * sd[part]).all())
    low, high = stats.binom(trials, 0.9).ppf([0.001, 0.999])
    assert all(low <= count <= high for count in held.values()), held


@pytest.mark.parametrize(
    ("coverage", "needed"), [(0.5, 1), (0.8, 4), (0.9, 9), (0.95, 19), (0.99, 99)]
)
def test_too_few_cases_are_refused_with_how_many_are_needed(coverage, needed):
    assert cmfsim.cases_needed(coverage) == needed
    assert cmfsim.calibrate(np.ones(needed), coverage).rank == needed
    with pytest.raises(cmfsim.CalibrationError, match=f"at least {needed} calibration cases"):
        cmfsim.calibrate(np.ones(needed - 1), coverage)


@pytest.mark.parametrize("coverage", [0.0, 1.0, 90, -0.1, math.nan])
def test_a_coverage_is_a_share(coverage):
    with pytest.raises(ValueError, match="coverage"):
        cmfsim.calibrate(np.ones(50), coverage)


def test_scores_take_the_worst_vertex_of_each_region_that_was_measured():
    errors = np.ma.array([1.0, -4.0, 9.0, 0.5], mask=[False, False, True, False])
    sd = np.array([1.0, 2.0, 1.0, 0.25])
    regions = {"a": [0, 1], "b": np.array([False, False, True, True]), "c": [2]}
    assert cmfsim.region_scores(errors, sd, regions) == {"a": 2.0, "b": 2.0}


@pytest.mark.parametrize(
    ("errors", "sd", "message"),
    [
        ([1.0, np.nan], [1.0, 1.0], r"errors\[1\]"),
        ([1.0, 1.0], [1.0, 0.0], r"sd\[1\]"),
        ([1.0, 1.0], [1.0, np.nan], r"sd\[1\]"),
        ([1.0, 1.0], [1.0], "shape"),
    ],
)
def test_scores_of_what_does_not_fit_are_refused(errors, sd, message):
    with pytest.raises(cmfsim.CalibrationError, match=message):
        cmfsim.region_scores(errors, sd, {"a": [0]})


def calibration(n=9, **changes):
    cases = tuple(
        cmfsim.CalibrationCase(f"P{i}", {"chin": 1.0 + i, "face": 2.0 + i}, "virtual")
        for i in range(n)
    )
    values = {"model": "M+S", "settings": {"contact": "bilateral", "sd": 0.2}, "cases": cases}
    return cmfsim.Calibration(**{**values, **changes})


def test_a_calibration_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "calibration.json"
    given = calibration(note="virtual patients", coverage=0.9)
    cmfsim.write_calibration(path, given)
    found = cmfsim.read_calibration(path)
    assert found == given
    assert found.digest == given.digest
    first = path.read_bytes()
    cmfsim.write_calibration(path, found)
    assert path.read_bytes() == first
    assert found.scores("chin").tolist() == [1.0 + i for i in range(9)]
    assert found.scores("chin", "other").size == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "version"),
        ({"format": "cmfsim-case"}, "format"),
        ({"model": "X"}, "model"),
        ({"settings": {"contact": "unilateral", "sd": 0.2}}, "settings_digest"),
        ({"cases": []}, "at least one case"),
        ({"cases": [{"case": "P1", "scores": {"chin": -1.0}}]}, "scores.chin"),
        ({"cases": [{"case": "P1", "scores": {}}]}, "has no score"),
        ({"cases": [{"case": "P1", "scores": {"chin": 1.0}}] * 2}, "twice"),
        ({"more": 1}, "unknown name"),
    ],
)
def test_a_calibration_that_was_changed_or_is_none_is_refused(tmp_path, change, message):
    path = tmp_path / "calibration.json"
    cmfsim.write_calibration(path, calibration())
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**content, **change}), encoding="utf-8")
    with pytest.raises(cmfsim.CalibrationError, match=message) as error:
        cmfsim.read_calibration(path)
    assert "calibration.json" in str(error.value)


def test_a_missing_calibration_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.json"):
        cmfsim.read_calibration(tmp_path / "none.json")
