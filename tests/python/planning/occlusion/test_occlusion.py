"""Measures of occlusion against those from known places of teeth."""

import numpy as np
import pytest

import cmfsim
from cmfsim.planning.face_measures.occlusion import poor_bite

# Teeth in a head with an upright face: a flat occlusal plane that rises by 10° to the front.
SLOPE = np.radians(10.0)
FORWARDS = np.array([0.0, -np.cos(SLOPE), np.sin(SLOPE)])
UP = np.array([0.0, np.sin(SLOPE), np.cos(SLOPE)])
LEFT = np.array([1.0, 0.0, 0.0])
MIDDLE = np.array([0.0, -80.0, -45.0])


@pytest.fixture(scope="module", params=[0.0, 4.0])
def skull(request):
    """The landmarks of a synthetic head, symmetric or with the chin to the left."""
    head = cmfsim.make_head(cmfsim.HeadParameters(asymmetry=request.param))
    return {name: np.asarray(place) for name, place in head.skull_landmarks.items()}


def teeth(overjet, overbite, midlines, molars, cant):
    """Places of incisors and first molars with these measures."""
    high = np.tan(np.radians(cant))
    found = {}
    for jaw, sign, middle in (("U", 1.0, midlines[0]), ("L", -1.0, midlines[1])):
        edge = MIDDLE + 12 * FORWARDS + 0.5 * sign * (overjet * FORWARDS - overbite * UP)
        for side, across in (("L", 4.0), ("R", -4.0)):
            found[f"{jaw}{side}1O"] = edge + (middle + across) * LEFT
            ahead = 0.5 * sign * molars[side] * FORWARDS
            lift = (
                np.array([0.0, 0.0, 1.0]) * high * (25.0 if side == "L" else -25.0) * (jaw == "U")
            )
            found[f"{jaw}{side}6MB"] = (
                MIDDLE - 20 * FORWARDS + ahead + 25.0 * np.sign(across) * LEFT + lift
            )
    return found


def midline_of(skull):
    """The direction to the left of a cranium, and where its middle lies along it."""
    cranial = "frontal_eminence supraorbital suborbital lateral_orbit zygomatic_arch supraglenoid"
    pairs = [(skull[f"{n}_L"], skull[f"{n}_R"]) for n in cranial.split()]
    of_jaw = [(skull[f"{n}_L"], skull[f"{n}_R"]) for n in ("supra_m2", "inferior_malar")]
    left = np.sum([one - other for one, other in pairs + of_jaw], axis=0)
    left /= np.linalg.norm(left)
    middles = [0.5 * (one + other) for one, other in pairs]
    middles += [skull[n] for n in ("supraglabella", "glabella", "nasion", "rhinion")]
    return left, np.mean(middles, axis=0) @ left


def test_measures_are_those_the_teeth_were_placed_with(skull):
    placed = teeth(3.5, 1.5, (1.25, -0.75), {"L": 4.0, "R": -4.0}, 0.0)
    found = cmfsim.occlusion({**skull, **placed})
    wanted = {
        "overjet": 3.5,
        "overbite": 1.5,
        # In class I, the mesiobuccal cusp of the upper molar lies 2 mm behind that of the lower.
        "molar_left": 4.0 + 2.0,
        "molar_right": -4.0 + 2.0,
    }
    for key, value in wanted.items():
        assert found[key] == pytest.approx(value, abs=1e-6), key
    left, middle = midline_of(skull)
    for key, jaw in (("upper_midline", "U"), ("lower_midline", "L")):
        edges = 0.5 * (placed[f"{jaw}L1O"] + placed[f"{jaw}R1O"])
        assert found[key] == pytest.approx(edges @ left - middle, abs=1e-6)
        # An asymmetric jaw draws the sites of the cranium along by hundredths.
        assert found[key] == pytest.approx(edges[0], abs=0.05)


@pytest.mark.parametrize("cant", [-3.0, 4.5])
def test_a_cant_has_the_sign_of_its_left_side(skull, cant):
    placed = teeth(2.0, 2.0, (0.0, 0.0), {"L": -2.0, "R": -2.0}, cant)
    found = cmfsim.occlusion({**skull, **placed})["cant"]
    assert np.sign(found) == np.sign(cant)
    # The horizontal of the head is that of the average cranium, to within 1°.
    assert found == pytest.approx(cant, abs=0.002)


def test_measures_do_not_depend_on_the_pose_of_the_head(skull):
    sites = {**skull, **teeth(-2.0, 3.0, (2.0, 1.0), {"L": 1.0, "R": 3.0}, 2.0)}
    motion = cmfsim.rigid_motion((9, -7, 30), 14, (1, 2, -1))
    turned = {n: motion[:3, :3] @ p + motion[:3, 3] for n, p in sites.items()}
    assert cmfsim.occlusion(turned) == pytest.approx(cmfsim.occlusion(sites), abs=1e-6)


def test_a_moved_jaw_is_measured_in_the_face_before_the_operation(skull):
    before = {**skull, **teeth(2.0, 2.0, (0.0, 0.0), {"L": -2.0, "R": -2.0}, 0.0)}
    moved = {
        name: place + [3.0, 0.0, 0.0] if name[0] == "U" or "dentale" in name else place
        for name, place in before.items()
    }
    moved |= {
        name: before[name] + [3.0, 0.0, 0.0] for name in before if name.startswith("supra_m2")
    }
    at_rest = cmfsim.occlusion(before)
    change = cmfsim.occlusion(moved, before)["upper_midline"] - at_rest["upper_midline"]
    assert change == pytest.approx(3.0 * midline_of(skull)[0][0], abs=1e-6)


def test_bone_stands_in_for_teeth_and_one_incisor_is_no_midline(skull):
    found = cmfsim.occlusion(skull)
    left, middle = midline_of(skull)
    for key, site in (("upper_midline", "supradentale"), ("lower_midline", "infradentale")):
        assert found[key] == pytest.approx(skull[site] @ left - middle, abs=1e-6)
    assert found["overjet"] is found["molar_left"] is None
    one = {**skull, "U1": np.array([4.0, -96.0, -43.0])}
    assert cmfsim.occlusion(one)["upper_midline"] == found["upper_midline"]
    # Another cusp of each jaw is no pair.
    mixed = {
        **skull,
        "UL6MB": np.zeros(3),
        "LL6O": np.zeros(3),
        "U1": np.zeros(3),
        "L1": np.ones(3),
    }
    assert cmfsim.occlusion(mixed)["molar_left"] is None
    assert set(cmfsim.occlusion({}).values()) == {None}


def bite_rows(**values):
    """Rows of all measures: (before, planned) by key, both nought where they are not given."""
    pairs = [values.get(measure.key, (0.0, 0.0)) for measure in cmfsim.OCCLUSAL_MEASURES]
    return [{"before": before, "planned": planned} for before, planned in pairs]


def test_a_plan_that_leaves_a_bad_bite_is_stated_with_values_limits_and_source():
    (found,) = poor_bite(bite_rows(overjet=(6.2, 13.3), overbite=(1.0, -6.0), cant=(0.0, -6.5)))
    assert (found.code, found.severity) == ("plan-bite-poor", "warning")
    assert "overjet is 13.3 mm, 6.2 before (limits: −3.5 to 9, Brook and Shaw 1989)" in found.what
    assert "overbite is −6.0 mm, 1.0 before (limits: −4 or more" in found.what
    assert "cant of the upper molars is −6.5°" in found.what
    assert "midline" not in found.what
    assert "cmfsim bite" in found.fix


@pytest.mark.parametrize(
    "values",
    [
        {"overjet": (6.2, 2.5), "overbite": (-5.0, 1.0)},
        # The patient came with it, and it became no worse; within what edges are found to.
        {"overjet": (13.0, 13.3), "upper_midline": (7.0, 5.2)},
        {"overjet": (2.0, 9.9), "lower_midline": (0.0, 4.9)},
        # A class III that is closed to an edge-to-edge bite, and what has no value.
        {"overjet": (-9.0, -3.0), "cant": (None, None), "overbite": (2.0, None)},
    ],
)
def test_a_sensible_plan_has_no_poor_bite(values):
    assert not poor_bite(bite_rows(**values))
