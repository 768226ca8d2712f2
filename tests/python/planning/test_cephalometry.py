"""Cephalometry against trigonometry on synthetic heads, whose landmarks are known."""

import dataclasses

import numpy as np
import pytest

import cmfsim
import shared_values
from cmfsim.pipeline.banding import face_motion
from cmfsim.values.landmark_sites import profile_sites

# Sites that synthetic heads do not have, LPS mm: as on a lateral radiograph.
MORE = {
    "S": (0, -22, 25),
    "Po_L": (60, 2, 4),
    "Po_R": (-60, 2, 4),
    "Gn": (0, -88, -82),
    "U1": (0, -96, -43),
    "UR1R": (2, -84, -20),
    "UL1R": (-2, -84, -20),
    "L1": (0, -93, -42),
    "L1R": (0, -86, -64),
    "U6": (24, -60, -42),
    "L6": (24, -60, -44),
}


@pytest.fixture(scope="module", params=[-5.0, 0.0, 5.0])
def known(request):
    """The landmarks of a symmetric synthetic head with a short, usual or long mandible."""
    head = cmfsim.make_head(cmfsim.HeadParameters(mandible_advance=request.param))
    return {name: np.asarray(place) for name, place in head.skull_landmarks.items()}


def slope(places, a, b):
    """The direction from a site to another in the lateral view, degrees above forwards."""
    step = places[b] - places[a]
    return np.degrees(np.arctan2(step[2], -step[1]))


def within(angle):
    return (angle + 180.0) % 360.0 - 180.0


def test_values_are_those_of_the_slopes_between_known_landmarks(known):
    """Each angle is a difference of two slopes; distances are by the feet of perpendiculars."""
    sites = {**known, **{name: np.array(place, dtype=float) for name, place in MORE.items()}}
    p = profile_sites(sites)
    found = cmfsim.cephalometry(sites) | cmfsim.occlusion(sites)
    level = slope(p, "Po", "Or")
    p["back"], p["front"] = 0.5 * (p["U6"] + p["L6"]), 0.5 * (p["U1"] + p["L1"])
    bite = slope(p, "back", "front")
    plane = slope(p, "Go", "Me")
    sna, snb = (slope(p, "N", n) - slope(p, "N", "S") for n in "AB")
    angles = {
        "sna": sna,
        "snb": snb,
        "anb": sna - snb,
        "convexity": slope(p, "N", "A") - slope(p, "A", "Pog"),
        "facial_angle": slope(p, "N", "Pog") - slope(p, "Or", "Po"),
        "mandibular_plane": level - plane,
        "sn_gogn": slope(p, "S", "N") - slope(p, "Go", "Gn"),
        "occlusal_plane": level - bite,
        "u1_na": slope(p, "U1R", "U1") - slope(p, "N", "A"),
        "l1_nb": slope(p, "B", "N") - slope(p, "L1R", "L1"),
        "l1_mp": slope(p, "Me", "Go") - slope(p, "L1R", "L1"),
        "interincisal": slope(p, "L1", "L1R") - slope(p, "U1", "U1R"),
    }
    for name, angle in angles.items():
        assert found[name] == pytest.approx(within(angle), abs=1e-6), name
    forwards = np.array([0.0, -np.cos(np.radians(bite)), np.sin(np.radians(bite))])
    up = np.array([0.0, np.sin(np.radians(bite)), np.cos(np.radians(bite))])
    assert found["wits"] == pytest.approx((p["A"] - p["B"]) @ forwards, abs=1e-6)
    assert found["overjet"] == pytest.approx((p["U1"] - p["L1"]) @ forwards, abs=1e-6)
    assert found["overbite"] == pytest.approx((p["L1"] - p["U1"]) @ up, abs=1e-6)
    for key, edge, low in (("u1_na_mm", "U1", "A"), ("l1_nb_mm", "L1", "B")):
        along = (p[low] - p["N"])[1:]
        foot = p["N"][1:] + along * ((p[edge] - p["N"])[1:] @ along) / (along @ along)
        assert abs(found[key]) == pytest.approx(np.linalg.norm(p[edge][1:] - foot), abs=1e-6)
        share = (p[edge] - p["N"])[2] / along[1]
        assert (found[key] > 0) == (p[edge][1] < p["N"][1] + share * along[0])
    assert set(angles) | {"wits", "u1_na_mm", "l1_nb_mm"} == set(cmfsim.cephalometry(sites))


def test_values_do_not_depend_on_the_pose_of_the_head(known):
    sites = {**known, **MORE}
    motion = cmfsim.rigid_motion((20, -7, 30), 14, (1, 2, -1))
    turned = {n: motion[:3, :3] @ np.asarray(p) + motion[:3, 3] for n, p in sites.items()}
    for chosen in (tuple(sites), tuple(known)):
        at_rest = cmfsim.cephalometry({name: sites[name] for name in chosen})
        found = cmfsim.cephalometry({name: turned[name] for name in chosen})
        assert found == pytest.approx(at_rest, abs=1e-6)


def test_without_porion_the_frankfort_plane_is_that_of_the_synthetic_head(known):
    """It is z = 0 there; the sites of a cranium tell it to within 1°."""
    found = cmfsim.cephalometry(known)
    p = profile_sites(known)
    assert found["mandibular_plane"] == pytest.approx(-slope(p, "Go", "Me"), abs=1.0)
    assert found["sna"] is None
    assert found["u1_na"] is None


def test_the_more_a_jaw_moves_forwards_the_larger_its_angle(known):
    sites = {**known, "S": MORE["S"]}
    before = cmfsim.cephalometry(sites)
    moved = {**sites, "mid_philtrum": sites["mid_philtrum"] + np.array([0, -5.0, 0])}
    after = cmfsim.cephalometry(moved, sites)
    assert after["sna"] > before["sna"] + 3.0
    assert after["anb"] - before["anb"] == pytest.approx(after["sna"] - before["sna"], abs=1e-9)
    assert after["wits"] - before["wits"] == pytest.approx(5.0, abs=0.1)
    assert after["snb"] == before["snb"]
    level = {**sites, "Po": MORE["Po_L"]}
    orbit = {**level, "suborbital_L": (31, -75, 9), "suborbital_R": (-31, -75, 9)}
    planned = cmfsim.cephalometry(orbit, level)
    assert planned["mandibular_plane"] == cmfsim.cephalometry(level)["mandibular_plane"]


def test_norms_have_a_source_and_labels_differ():
    measures = (*cmfsim.CEPHALOMETRIC_MEASURES, *cmfsim.MEASURES)
    assert all(bool(measure.norm) == bool(measure.source) for measure in measures)
    labels = [(measure.label, measure.unit) for measure in measures]
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("label", ["Po_L", "LPo", "po left", "Po"])
def test_abbreviations_of_both_sides_are_one_site(label):
    found = profile_sites(
        {label: (1.0, 2.0, 3.0), "Po_R": (3.0, 2.0, 3.0), "supra_m2_L": (0, 0, 1)}
    )
    np.testing.assert_allclose(found["Po"], (2.0, 2.0, 3.0))
    assert set(found) == {"Po", "supra_m2"}


def test_figures_of_a_prediction_follow_its_plan(tmp_path_factory):
    """Sites of bone move with their segments, those of the skin with the skin."""
    motion = cmfsim.rigid_motion((0, -4, 1), 3, (1, 0, 0), (0, -60, -30))
    patient = shared_values.coarse_demo_patient(tmp_path_factory)
    skull = {**patient.landmarks["skull"], "S": np.array(MORE["S"], dtype=float)}
    patient = dataclasses.replace(patient, landmarks={**patient.landmarks, "skull": skull})
    prediction = cmfsim.predict_patient(patient.with_plan({"maxilla": motion}), "H")
    figures = cmfsim.clinical_figures(prediction)
    shifts = {s["name"]: (s["forwards_mm"], s["up_mm"], s["left_mm"]) for s in figures["sites"]}
    moves_with = {site["name"]: site["moves_with"] for site in figures["sites"]}
    assert moves_with["mid_philtrum"] == moves_with["U1"] == "maxilla"
    assert moves_with["S"] == moves_with["nasion"] == "cranium"
    a = skull["mid_philtrum"]
    x, y, z = motion[:3, :3] @ a + motion[:3, 3] - a
    np.testing.assert_allclose(shifts["mid_philtrum"], (-y, z, x), atol=1e-12)
    assert shifts["pogonion"] == (0.0, 0.0, 0.0)
    lip = patient.landmarks["skin"]["labiale_superius"]
    x, y, z = prediction.carried(lip[None])[0]
    np.testing.assert_allclose(shifts["labiale_superius (skin)"], (-y, z, x), atol=1e-12)
    rows = {row["label"]: row for row in figures["cephalometry"]}
    moved = {**skull, "mid_philtrum": motion[:3, :3] @ a + motion[:3, 3]}
    wanted = cmfsim.cephalometry(moved, skull)["sna"]
    assert rows["SNA"]["planned"] == pytest.approx(wanted, abs=1e-9)
    assert rows["SNB"]["planned"] == pytest.approx(rows["SNB"]["before"], abs=1e-9)
    assert "Gn" in rows["Mandibular plane to SN"]["absent"]
    face = {row["label"]: row["planned"] for row in figures["face"]}
    assert face["Nasolabial angle"] == cmfsim.measure_face(prediction)["nasolabial_angle"]
    moved = np.linalg.norm(prediction.skin_displacements, axis=1)
    mean = face_motion(prediction)["face_mean"]
    # The upper jaw moves the face more than neck, forehead and cheeks beside it.
    assert 1.2 * moved.mean() < mean < moved.max()
    few = {**patient.landmarks, "skin": {"labiale_superius": lip}}
    fewer = dataclasses.replace(prediction.patient, landmarks=few)
    assert not face_motion(dataclasses.replace(prediction, patient=fewer))


@pytest.mark.parametrize("measured", [cmfsim.cephalometry, cmfsim.occlusion])
def test_what_are_no_landmarks_of_a_head_has_no_values(known, measured):
    """Sides exchanged turned the ANB of 5° into -5°, in any position of the head."""
    motion = cmfsim.rigid_motion((5.0, 6.0, 7.0), 140.0, (1.0, 2.0, 3.0))
    mirrored = {name: (motion @ [-x, y, z, 1.0])[:3] for name, (x, y, z) in known.items()}
    with pytest.raises(cmfsim.LandmarkError, match="left and right are swapped in the landm"):
        measured(mirrored)
    with pytest.raises(cmfsim.LandmarkError, match="left and right are swapped"):
        measured(known, mirrored)
    for place in ((np.nan, 0.0, 0.0), (0.0, 0.0), "front"):
        with pytest.raises(cmfsim.LandmarkError, match="landmark pogonion"):
            measured(known | {"pogonion": place})
