"""The distribution of landmarks, and how they follow those that are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from cmfsim.registration.proposed.proposal import (
    SitesOfKind,
    likeliest,
    with_model,
    without_outliers,
)
from cmfsim.registration.proposed.shape_model.site_covariance import (
    PLACED_STD,
    SITES,
    SiteDistribution,
    _aligned_prior,
    _measured,
    left_out_gaps,
    likeliest_places,
    placed_distribution,
    site_covariance,
)
from cmfsim.registration.proposed.template_head import average_head
from cmfsim.values.landmark_sites import site_part
from cmfsim.values.proposed_landmarks import ProposedLandmarks, ProposedSite


@pytest.fixture(scope="module")
def bone():
    return np.concatenate([s.vertices for s in average_head().bones.values()])


def proposal(errors=None, gone=(), shift=None):
    average = average_head()
    errors, shift = errors or {}, shift or {}
    skull = {
        name: ProposedSite(point + shift.get(name, 0.0), errors.get(name, 2.0))
        for name, point in average.skull.items()
        if name not in gone
    }
    skin = {name: ProposedSite(point, 2.0) for name, point in average.skin_landmarks.items()}
    return ProposedLandmarks(skull, skin)


def test_the_conditional_mean_and_covariance_are_those_of_the_normal_distribution():
    """Two sites by the textbook formula with blocks (Bishop 2006, equations 2.81 and 2.82)."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T
    names = (("skull", "a"), ("skull", "b"))
    mean = rng.normal(size=(2, 3))
    place = np.array([1.0, 2.0, 3.0])
    found = SiteDistribution(names, mean, covariance).given({names[0]: place}, {names[0]: 0.5})
    aa, ba, bb = covariance[:3, :3], covariance[3:, :3], covariance[3:, 3:]
    gain = ba @ np.linalg.inv(aa + 0.25 * np.eye(3))
    np.testing.assert_allclose(found.mean[1], mean[1] + gain @ (place - mean[0]))
    np.testing.assert_allclose(found.covariance[3:, 3:], bb - gain @ ba.T, atol=1e-12)
    np.testing.assert_allclose(found.errors[1], np.sqrt(np.trace(bb - gain @ ba.T)), rtol=1e-12)


def test_found_sites_are_their_own_mean_and_less_sure_ones_have_larger_errors(bone):
    given = proposal({"menton": 10.0})
    found = site_covariance(given, bone)
    for key, point in zip(found.names, found.mean, strict=True):
        kind, name = key
        site = (given.skull if kind == "skull" else given.skin)[name]
        np.testing.assert_array_equal(point, site.point)
    errors = dict(zip(found.names, found.errors, strict=True))
    assert errors["skull", "menton"] > 1.3 * errors["skull", "pogonion"]
    # A measurement only makes it surer.
    assert all(errors[key] < 2.0 * np.sqrt(1.0 + 1e-9) for key in errors if key[1] != "menton")
    values = np.linalg.eigvalsh(found.covariance)
    assert values.min() > -1e-9 * values.max()


def test_a_missing_site_is_where_the_others_put_it(bone):
    gone = ("gonion_L", "zygomatic_arch_R", "nasion")
    found = site_covariance(proposal(gone=gone), bone)
    for name in gone:
        i = found.names.index(("skull", name))
        away = np.linalg.norm(found.mean[i] - average_head().skull[name])
        assert away < 2.0
        assert away < found.errors[i]


def test_a_missing_site_departs_from_the_average_as_its_partner_does():
    places = dict(average_head().skull)
    del places["supra_m2_R"]
    places["supra_m2_L"] = places["supra_m2_L"] + [6.0, 0.0, 3.0]
    found = placed_distribution(places)
    row = found.names.index(("skull", "supra_m2_R"))
    away = found.mean[row] - average_head().skull["supra_m2_R"]
    assert -6.0 < away[0] < -3.0
    assert 1.5 < away[2] < 3.0


def test_a_site_is_likeliest_between_where_it_was_found_and_where_the_others_put_it():
    """Alone 5 mm up, a site returns by its expected error; a motion of the whole head stays."""
    head = average_head().skull
    gaps = []
    for error in (1.0, 6.0):
        sites = {
            ("skull", name): ProposedSite(p + [7.0, 0.0, 0.0], 2.0) for name, p in head.items()
        }
        up = head["nasion"] + [7.0, 0.0, 5.0]
        found = likeliest_places({**sites, ("skull", "nasion"): ProposedSite(up, error)})
        gaps.append(found["skull", "nasion"][0][2] - head["nasion"][2])
        shift = [found["skull", n][0] - p for n, p in head.items() if n != "nasion"]
        np.testing.assert_allclose(np.mean(shift, axis=0), [7.0, 0.0, 0.0], atol=0.4)
    assert 0.5 < gaps[1] < gaps[0] - 0.5 < 4.5


def test_a_site_far_from_the_models_goes_where_the_others_put_it_and_takes_none_with_it():
    head = average_head().skull
    sites = {n: ProposedSite(p + [0.0, 0.0, 100.0 * (n == "nasion")], 2.0) for n, p in head.items()}
    places = {("skull", n): p for n, p in head.items()} | {
        ("skin", n): p for n, p in average_head().skin_landmarks.items()
    }
    model = SimpleNamespace(sites=places, errors=dict.fromkeys(places, 6.0))
    found = likeliest([SitesOfKind("skull", sites, {}, {False: object(), True: object()})], model)
    for name, place in head.items():
        assert np.linalg.norm(found["skull", name][0] - place) < 1.0, name


def test_a_site_that_its_definition_finds_elsewhere_is_as_unsure_as_half_their_distance():
    place = np.array([60.0, -10.0, 5.0])
    key = ("skull", "supraglenoid_L")
    head = SimpleNamespace(sites={key: place}, shows=lambda _: True)
    surface = SimpleNamespace(closest=lambda points: (points, None, None))
    errors = []
    for gaps in ({}, {key: 18.0}):
        missing = {key[1]: "it is inconsistent"}
        found = SitesOfKind("skull", {}, missing, {False: surface}, gaps)
        errors.append(with_model(found, {key: (place, 2.9)}, head, 1.0)[0][key[1]].error)
    assert errors == [2.9, 9.0]


def test_a_head_in_another_pose_and_size_has_the_same_distribution(bone):
    angle = np.deg2rad(20.0)
    turn = np.array(
        [[1.0, 0.0, 0.0], [0.0, np.cos(angle), -np.sin(angle)], [0.0, np.sin(angle), np.cos(angle)]]
    )
    shift = np.array([10.0, 1500.0, -40.0])
    plain = site_covariance(proposal(gone=("gonion_L",)), bone)
    own = proposal(gone=("gonion_L",))
    moved = ProposedLandmarks(
        {n: ProposedSite(turn @ s.point + shift, s.error) for n, s in own.skull.items()},
        {n: ProposedSite(turn @ s.point + shift, s.error) for n, s in own.skin.items()},
    )
    found = site_covariance(moved, bone)
    np.testing.assert_allclose(found.mean, plain.mean @ turn.T + shift, atol=1e-6)
    np.testing.assert_allclose(found.errors, plain.errors, atol=1e-6)


def test_sites_of_a_doubtful_jaw_follow_one_that_is_placed_and_the_cranium_stays(bone):
    average = average_head().skull
    jaw = [n for n in average if site_part("skull", n) == "mandible"]
    wrong = np.array([0.0, 4.0, 12.0])
    given = proposal(dict.fromkeys(jaw, 10.0), shift=dict.fromkeys(jaw, wrong))
    before = site_covariance(given, bone)
    names = ("menton", "gonion_L", "infradentale")
    after = before.given({("skull", n): average[n] for n in names})
    errors = {True: [], False: []}
    for (kind, name), point in zip(after.names, after.mean, strict=True):
        if kind == "skull" and name not in names:
            errors[name in jaw].append(np.linalg.norm(point - average[name]))
    assert np.mean(errors[True]) < 3.0
    assert np.mean(errors[False]) < 0.7


def test_without_sites_the_head_is_guessed_from_the_bone_and_unsure(bone):
    found = site_covariance(ProposedLandmarks({}, {}), bone + [0.0, 0.0, 1500.0])
    truth = average_head().skull
    away = [
        np.linalg.norm(point - truth[name] - [0.0, 0.0, 1500.0])
        for (kind, name), point in zip(found.names, found.mean, strict=True)
        if kind == "skull"
    ]
    assert np.mean(away) < found.errors.mean()
    assert found.errors.min() > 15.0
    assert PLACED_STD == 1.0


def test_residuals_of_sites_left_out_are_those_of_the_normal_distribution(bone):
    """One site after the other against the textbook formula (Bishop 2006, equation 2.81)."""
    given = proposal({"menton": 5.0}, gone=("gonion_L",), shift={"nasion": [0.0, -6.0, 3.0]})
    sites = {("skull", n): site for n, site in given.skull.items()}
    sites |= {("skin", n): site for n, site in given.skin.items()}
    known = [k for k, key in enumerate(SITES) if key in sites]
    found = np.array([sites[SITES[k]].point for k in known])
    prior = _aligned_prior(sites, bone)
    rows = np.array([[3 * k, 3 * k + 1, 3 * k + 2] for k in known]).ravel()
    errors = np.array([sites[SITES[k]].error for k in known]) / np.sqrt(3.0)
    total = prior.covariance[np.ix_(rows, rows)] + _measured(found, known, errors)
    away = (found - prior.mean[known]).ravel()
    gaps = left_out_gaps(sites)
    assert gaps.keys() == sites.keys()
    for i in (0, 7, len(known) - 1):
        own = np.arange(3 * i, 3 * i + 3)
        others = np.setdiff1d(np.arange(len(away)), own)
        gain = total[np.ix_(own, others)] @ np.linalg.inv(total[np.ix_(others, others)])
        residual = away[own] - gain @ away[others]
        spread = total[np.ix_(own, own)] - gain @ total[np.ix_(others, own)]
        gap, deviations = gaps[SITES[known[i]]]
        assert gap == pytest.approx(np.linalg.norm(residual), rel=1e-8)
        squared = residual @ np.linalg.solve(spread, residual) / 3.0
        assert deviations == pytest.approx(np.sqrt(squared), rel=1e-8)


def test_a_site_that_all_others_place_elsewhere_is_doubtful_and_as_far_off_as_that():
    given = proposal(shift={"supraglenoid_R": np.array([0.0, 0.0, -11.0])})
    skull, skin = without_outliers(
        [SitesOfKind("skull", given.skull, {}, {}), SitesOfKind("skin", given.skin, {}, {})]
    )
    doubtful = {name: site for name, site in skull.sites.items() if site.doubt}
    assert doubtful.keys() == {"supraglenoid_R"}
    assert "the other sites place it" in doubtful["supraglenoid_R"].doubt
    assert 7.0 < doubtful["supraglenoid_R"].error < 12.0
    assert not any(site.doubt for site in skin.sites.values())


def test_an_unusual_head_is_not_doubtful():
    """A ramus 12 mm longer than average, on both sides: each of its sites fits the others."""
    down = np.array([0.0, 4.0, -12.0])
    given = proposal(shift={"gonion_L": down, "gonion_R": down})
    (skull,) = without_outliers([SitesOfKind("skull", given.skull, {}, {})])
    assert not any(site.doubt for site in skull.sites.values())
