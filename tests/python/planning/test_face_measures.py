"""Measures of the face against other formulas, and sites on profiles whose sites are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import cmfsim
from cmfsim.planning.face_measures.profile import midline_profile

PLACES = st.lists(
    st.tuples(*[st.floats(-80.0, 80.0)] * 3), min_size=3, max_size=3, unique=True
).map(np.array)
# Profile of a face from the forehead to the neck: y (backwards) and z (up), mm.
PROFILE = {
    "forehead": (-86, 70),
    "glabella": (-92, 45),
    "nasion": (-88, 30),
    "pronasale": (-112, 0),
    "mid columella": (-105, -6),
    "subnasale": (-94, -8),
    "labiale_superius": (-97, -20),
    "upper edge": (-92, -25),
    "cleft": (-84, -26),
    "lower edge": (-91, -27.5),
    "labiale_inferius": (-95, -34),
    "sublabiale": (-88, -44),
    "pogonion": (-93, -56),
    "menton": (-82, -68),
    "throat": (-45, -58),
    "neck": (-40, -110),
    "nape": (60, -110),
    "vertex": (60, 70),
}
NAMED = ("nasion", "pronasale", "subnasale", "labiale_superius", "labiale_inferius", "pogonion")
WIDTH = 40.0


def prism(profile=PROFILE, tilt=0.0):
    """The skin that has this profile in every sagittal plane, and its landmarks."""
    rows = np.array(list(profile.values()), dtype=float)
    n = len(rows)
    sides = [np.column_stack([np.full(n, x), rows]) for x in (-WIDTH, 0.3, WIDTH)]
    vertices = np.concatenate(sides)
    ring = [(i, (i + 1) % n) for i in range(n)]
    triangles = [
        triangle
        for low in (0, n)
        for i, j in ring
        for triangle in ((low + i, low + j, low + n + i), (low + j, low + n + j, low + n + i))
    ]
    turn = cmfsim.rigid_motion(angle=tilt, axis=(0, 1, 0))[:3, :3]
    marks = {name: turn @ np.array([0.0, *profile[name]]) for name in NAMED}
    return cmfsim.SurfaceData(vertices @ turn.T, triangles), marks, turn


def patient(profile=PROFILE, tilt=0.0, extra=()):
    """What the sites are found on: a skin with landmarks, no bone."""
    skin, marks, turn = prism(profile, tilt)
    marks.update({name: turn @ place for name, place in extra})
    made = {"face": skin, "skin": skin, "landmarks": {"skin": marks}, "name": "prism"}
    return type("Prism", (), {**made, "anatomy": None, "segments": (), "findings": ()})(), turn


@given(PLACES)
def test_an_angle_is_that_of_the_law_of_cosines(places):
    a, b, c = (np.linalg.norm(places[i] - places[j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    if min(a, b, c) < 1.0:
        return
    # At site 1, between sites 0 and 2, from the lengths of the sides alone.
    wanted = np.degrees(np.arccos(np.clip((a * a + c * c - b * b) / (2 * a * c), -1, 1)))
    names = ("columella", "subnasale", "labiale_superius")
    found = cmfsim.measure_sites(dict(zip(names, places, strict=True)))["nasolabial_angle"]
    assert found == pytest.approx(wanted, abs=1e-4)


@given(PLACES)
def test_the_distance_from_the_e_line_is_that_of_the_nearest_point(places):
    lip, nose, chin = places
    if np.hypot(*(chin - nose)[1:]) < 1.0:
        return
    names = ("labiale_superius", "pronasale", "pogonion")
    found = cmfsim.measure_sites(dict(zip(names, places, strict=True)))["upper_lip_to_e_line"]
    along = (chin - nose)[1:]
    foot = nose[1:] + along * ((lip - nose)[1:] @ along) / (along @ along)
    assert abs(found) == pytest.approx(np.linalg.norm(lip[1:] - foot), abs=1e-9)
    if chin[2] < nose[2] and abs(found) > 1e-6:
        # In front of it is where P is less than on the line, at the lip's height.
        share = (lip[2] - nose[2]) / (chin[2] - nose[2])
        on_line = nose[1] + share * (chin[1] - nose[1])
        assert (found > 0) == (lip[1] < on_line)


def test_sites_move_as_measures_state():
    """An upper lip 2 mm further forwards is 2 mm nearer to a vertical E-line."""
    places = {
        "pronasale": np.array([0, -110.0, 0]),
        "pogonion": np.array([0, -110.0, -60]),
        "labiale_superius": np.array([0, -104.0, -20]),
        "subnasale": np.array([0, -95.0, -8]),
        "menton": np.array([0, -85.0, -70]),
    }
    found = cmfsim.measure_sites(places)
    assert found["upper_lip_to_e_line"] == pytest.approx(-6.0)
    assert found["lower_third"] == pytest.approx(62.0)
    assert found["nasolabial_angle"] is None
    places["labiale_superius"] = places["labiale_superius"] + [0, -2.0, 0]
    assert cmfsim.measure_sites(places)["upper_lip_to_e_line"] == pytest.approx(-4.0)


@pytest.mark.parametrize("tilt", [0.0, 6.0])
def test_sites_are_found_at_the_corners_of_a_drawn_profile(tilt):
    built, turn = patient(tilt=tilt)
    sites = cmfsim.face_sites(built)
    corners = {
        "glabella": "glabella",
        "stomion_superius": "upper edge",
        "stomion_inferius": "lower edge",
        "sublabiale": "sublabiale",
        "menton": "menton",
        "cervical_point": "throat",
    }
    for name, corner in corners.items():
        wanted = turn @ [0.0, *PROFILE[corner]]
        # The polyline has a point at each corner; a tilt moves them by less than this.
        assert np.linalg.norm(sites.skin[name][1:] - wanted[1:]) < 0.7, name
        assert name in sites.found
    # Half-way along the polyline of the columella.
    way = [np.array(PROFILE[n]) for n in ("pronasale", "mid columella", "subnasale")]
    first, second = np.linalg.norm(way[1] - way[0]), np.linalg.norm(way[2] - way[1])
    assert first < second
    share = (0.5 * (first + second) - first) / second
    wanted = turn @ [0.0, *(way[1] + share * (way[2] - way[1]))]
    np.testing.assert_allclose(sites.skin["columella"][1:], wanted[1:], atol=0.3)
    assert "no bone segments" in sites.absent["upper_incisor"]


def test_what_a_profile_does_not_show_is_absent_with_its_reason():
    closed = {**PROFILE, "upper edge": (-92, -25.9), "lower edge": (-92, -26.1)}
    sites = cmfsim.face_sites(patient(closed)[0])
    assert "lips are closed" in sites.absent["upper_lip_edge"]
    short = {n: p for n, p in PROFILE.items() if n not in {"neck", "nape", "throat", "vertex"}}
    short |= {"throat": (-45, -66), "neck": (-40, -72), "nape": (60, -72), "vertex": (60, 70)}
    sites = cmfsim.face_sites(patient(short)[0])
    assert "20 mm below menton" in sites.absent["cervical_point"]
    assert sites.why_absent(("menton", "cervical_point")).startswith("cervical point is absent")
    assert sites.why_absent(("menton",)) == ""


def test_landmarks_of_the_case_are_taken_before_those_of_the_profile():
    given_place = np.array([0.0, -91.0, 40.0])
    sites = cmfsim.face_sites(patient(extra=[("Glabella", given_place)])[0])
    np.testing.assert_allclose(sites.skin["glabella"], given_place)
    assert "glabella" not in sites.found


def test_a_profile_needs_landmarks_on_the_skin():
    skin, marks, _ = prism()
    with pytest.raises(cmfsim.LandmarkError, match="2 skin landmarks"):
        midline_profile(skin, {"nasion": marks["nasion"]})
    beside = {name: place + [500.0, 0, 0] for name, place in marks.items()}
    with pytest.raises(cmfsim.LandmarkError, match="does not cut the skin"):
        midline_profile(skin, beside)


def test_a_profile_follows_its_surface():
    skin, marks, _ = prism()
    profile = midline_profile(skin, marks)
    motion = cmfsim.rigid_motion((1, 2, 3), 8, (1, 2, -1))
    moved = np.asarray(skin.vertices) @ motion[:3, :3].T + motion[:3, 3]
    a, b = moved[profile.ends[:, 0]], moved[profile.ends[:, 1]]
    there = a + profile.share[:, None] * (b - a)
    np.testing.assert_allclose(there, profile.points @ motion[:3, :3].T + motion[:3, 3], atol=1e-9)
    assert (np.diff(profile.points[:4, 2]) < 0).all()


def test_doubtful_jaws_show_no_incisors():
    """On a jaw that was separated doubtfully, bone would pass for teeth."""
    built, _ = patient()
    built.findings = (cmfsim.Finding("jaw-doubtful", "the tooth rows rise by -23°"),)
    assert "rise by -23°" in cmfsim.face_sites(built).absent["upper_incisor"]
