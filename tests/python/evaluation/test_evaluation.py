"""Skins against skins: closed forms on planes and spheres, known fields on a real face."""

import csv
import io
import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from real_faces import face, moved

import cmfsim
import real_heads
from benches.scenes import meshes

stats = pytest.importorskip("scipy.stats")


def plane(half, cells, height=0.0):
    vertices, triangles = meshes.plane(half, cells)
    return cmfsim.SurfaceData(vertices + [0.0, 0.0, height], triangles)


def sphere(radius, level=4):
    return cmfsim.SurfaceData(*meshes.icosphere(level, radius))


# --- covered skin ---------------------------------------------------------------------------------


def two_lips(gap):
    """Two balls of radius 10 mm above one another, `gap` mm apart, as one skin."""
    ball = sphere(10.0, level=3)
    shift = np.array([0.0, 0.0, 10.0 + gap / 2.0])
    return cmfsim.SurfaceData(
        np.concatenate([ball.vertices + shift, ball.vertices - shift]),
        np.concatenate([ball.triangles, ball.triangles + len(ball.vertices)]),
    )


@pytest.mark.parametrize("gap", [0.0, 0.5, 2.0])
def test_skin_between_lips_is_not_evaluated(gap):
    """3 mm in front of a vertex at an angle a from the pole lies a place that is inside the other
    ball if 13² + D² − 26 D cos a < 10², with D the distance of the centres.
    """
    lips = two_lips(gap)
    found = cmfsim.compare_skins(lips, lips, method="closest")
    covered = np.ones(len(lips.vertices), dtype=bool)
    covered[found.vertices] = False
    assert found.n_covered == found.back_covered == covered.sum()
    apart = 20.0 + gap
    cosine = (apart / 2.0 - np.abs(lips.vertices[:, 2])) / 10.0
    least = (69.0 + apart**2) / (26.0 * apart)
    # The balls of the mesh are up to 0.05 mm flatter.
    assert covered[cosine > least + 0.01].all()
    assert not covered[cosine < least - 0.01].any()
    assert covered.any()
    assert found.max == 0.0


def test_open_mouth_is_evaluated():
    lips = two_lips(3.5)
    assert cmfsim.compare_skins(lips, lips, method="closest").n_covered == 0


def test_lips_that_part_are_judged_by_their_outside():
    """The prediction has closed lips, the scan open ones: without the skin between them the
    distances are those of the outside, at most half the gap.
    """
    found = cmfsim.compare_skins(two_lips(0.5), two_lips(4.0), method="closest")
    assert found.max < 1.76
    assert found.back_covered == 0


# --- figures --------------------------------------------------------------------------------------


@given(
    st.lists(st.floats(-20, 20), min_size=1, max_size=60), st.floats(0.01, 100.0, allow_nan=False)
)
def test_figures_are_numpys(values, weight):
    """Equal weights, whatever they are, give numpy's mean, deviation and percentiles."""
    size = np.abs(values)
    for given_weights in (None, np.full(len(values), weight)):
        found = cmfsim.distance_statistics(values, weights=given_weights)
        expected = {
            "mean": size.mean(),
            "std": size.std(),
            "median": np.median(size),
            "rms": np.sqrt((size**2).mean()),
            "p90": np.percentile(size, 90),
            "p95": np.percentile(size, 95),
            "max": size.max(),
            "signed_mean": np.mean(values),
            "signed_std": np.std(values),
        }
        for name, value in expected.items():
            assert getattr(found, name) == pytest.approx(value, rel=1e-9, abs=1e-9), name
        assert found.within[2.0] == pytest.approx((size <= 2.0).mean())
        lower, upper = np.percentile(size, [25, 75])
        assert found.quartiles == pytest.approx((lower, upper), rel=1e-9, abs=1e-9)


def test_weights_count_and_outliers_are_counted():
    """A weight of 3 to 1 moves the mean three quarters of the way; 100 is far from a box at 1."""
    assert cmfsim.distance_statistics([1, -2], weights=[3, 1]).mean == 1.25
    assert cmfsim.distance_statistics([1, -2], weights=[3, 1]).signed_mean == 0.25
    found = cmfsim.distance_statistics([0.9, 1.0, 1.1, -1.0, 100.0])
    assert (found.outliers, found.max) == (1, 100.0)


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        (([],), "at least one"),
        (([1.0, np.nan],), r"signed distances\[1\] is nan"),
        (([[1.0]],), r"shape \(1, 1\)"),
    ],
)
def test_bad_distances_are_named(arguments, pattern):
    with pytest.raises(cmfsim.CaseError, match=pattern):
        cmfsim.distance_statistics(*arguments)


def test_bad_weights_are_named():
    with pytest.raises(cmfsim.CaseError, match=r"weights\[1\] is 0"):
        cmfsim.distance_statistics([1.0, 2.0], weights=[1.0, 0.0])
    with pytest.raises(cmfsim.CaseError, match="one for each of 2"):
        cmfsim.distance_statistics([1.0, 2.0], weights=[1.0])


# --- distances ------------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [-2.5, 0.75])
def test_a_plane_below_another_lies_behind_it(height):
    """The distance is the height, negative below, both ways alike; nothing at the rim counts."""
    found = cmfsim.compare_skins(plane(10, 10, height), plane(10, 20))
    np.testing.assert_allclose(found.signed, height, rtol=0, atol=1e-12)
    assert found.n_border == 4 * 10
    assert len(found.vertices) == 9 * 9
    np.testing.assert_allclose(found.back_signed, height, rtol=0, atol=1e-12)
    assert found.back_border == 4 * 20
    assert found.symmetric.mean == pytest.approx(abs(height))
    assert found.hausdorff == pytest.approx(abs(height))
    np.testing.assert_allclose(found.partners[:, 2], 0.0, atol=1e-12)


def test_concentric_spheres_are_their_radii_apart():
    """A smaller prediction lies behind by the difference, to the height of the facets."""
    inner, outer = sphere(20.0), sphere(21.5)
    facet = 21.5 * (1 - np.cos(np.pi / 60))
    found = cmfsim.compare_skins(inner, outer)
    assert np.abs(found.signed + 1.5).max() < facet
    assert np.abs(found.back_signed + 1.5).max() < facet
    assert (found.n_border, found.back_border, found.share) == (0, 0, 1.0)
    turned = cmfsim.compare_skins(outer, inner)
    assert np.abs(turned.signed - 1.5).max() < facet


def test_what_reaches_past_the_scan_is_left_out_and_counted():
    """A prediction over 20 mm, a scan over 10: the rest would be matched to the scan's rim."""
    wide, scan = plane(20, 20, -1.0), plane(10.5, 21)
    found = cmfsim.compare_skins(wide, scan)
    within = (np.abs(np.asarray(wide.vertices)[:, :2]) < 10.5).all(axis=1)
    assert found.n_border == np.count_nonzero(~within)
    assert set(found.vertices) == set(np.flatnonzero(within))
    assert found.max == pytest.approx(1.0, abs=1e-12)
    assert [f.code for f in found.findings] == ["many-border-matches"]
    # Each vertex has a cell of 2 mm, corners of the square a little less by their triangles.
    assert found.share == pytest.approx(within.sum() * 4.0 / 40.0**2, rel=1e-2)


def test_a_mask_limits_both_directions():
    """Only vertices with x > 0: post-operative ones beyond are matched to the mask's border."""
    skin, scan = plane(10, 10, 0.5), plane(10, 20)
    x = np.asarray(skin.vertices)[:, 0]
    found = cmfsim.compare_skins(skin, scan, mask=x > 0)
    assert (x[found.vertices] > 0).all()
    assert found.n_masked == np.count_nonzero(x <= 0)
    assert np.asarray(scan.vertices)[found.back_vertices, 0].min() > x[x > 0].min()
    indices = cmfsim.compare_skins(skin, scan, mask=np.flatnonzero(x > 0))
    np.testing.assert_array_equal(found.signed, indices.signed)
    field = found.field(len(x))
    assert field.count() == len(found.vertices)
    assert field.mask[x <= 0].all()


def test_landmarks_find_what_slid_along_the_skin():
    """A sphere turned in itself: the closest point sees nothing, landmarks see 2 ρ sin(θ/2)."""
    skin = sphere(40.0, 5)
    vertices = np.asarray(skin.vertices)
    angle = 6.0
    turn = meshes.rotation((0, 0, 1), angle)
    marks = 40.0 * meshes.unit_vectors(14, seed=1)
    plain = cmfsim.compare_skins(skin, skin, method="closest")
    assert plain.max < 1e-9
    found = cmfsim.compare_skins(skin, skin, landmarks=(marks, marks @ turn.T))
    assert found.method == "landmarks"
    chord = 2 * np.linalg.norm(vertices[:, :2], axis=1) * np.sin(np.radians(angle) / 2)
    # The partner lies on a facet, at most its height below the sphere.
    np.testing.assert_allclose(np.abs(found.signed), chord, rtol=0, atol=0.05)
    np.testing.assert_allclose(found.partners, vertices @ turn.T, rtol=0, atol=0.05)
    assert found.backward.mean == pytest.approx(found.mean, rel=1e-2)


def test_mappings_are_matched_by_name_and_the_result_ignores_their_order():
    skin, scan = sphere(30.0, 3), sphere(31.0, 3)
    names = [f"p{i}" for i in range(8)]
    places = 30.0 * meshes.unit_vectors(8, seed=2)
    ours = dict(zip(names, places, strict=True))
    theirs = {n: 31.0 / 30.0 * ours[n] for n in reversed(names)}
    more = {**theirs, "other": [0, 0, 0]}
    by_name = cmfsim.compare_skins(skin, scan, landmarks=(ours, more))
    assert [f.code for f in by_name.findings] == ["landmark-extra"]
    by_order = cmfsim.compare_skins(skin, scan, landmarks=(places, places * 31.0 / 30.0))
    np.testing.assert_allclose(by_name.signed, by_order.signed, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_name.signed, -1.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "error", "pattern"),
    [
        ({"method": "nearest"}, cmfsim.CaseError, "use one of landmarks, closest"),
        ({"method": "landmarks"}, cmfsim.LandmarkError, "there are none"),
        ({"mask": [True]}, cmfsim.CaseError, r"mask has shape \(1,\)"),
        ({"mask": []}, cmfsim.CaseError, "mask contains no vertex"),
        ({"mask": [10_000]}, cmfsim.CaseError, r"mask\[0\] is 10000"),
        ({"mask": "face"}, cmfsim.LandmarkError, "give all landmarks"),
        ({"regions": {"nose": [9999]}}, cmfsim.CaseError, r"region 'nose'\[0\] is 9999"),
        ({"landmarks": ([[0, 0, 0]], {"a": [0, 0, 0]})}, cmfsim.LandmarkError, "one set"),
        (
            {"landmarks": ({"a": [0, 0, 0]}, {"A": [0, 0, 0]})},
            cmfsim.LandmarkError,
            r"of the predicted skin .*: 1 landmarks are shared",
        ),
        (
            {"landmarks": (np.eye(4)[:, :3], np.eye(3))},
            cmfsim.LandmarkError,
            "4 landmarks of one skin and 3",
        ),
        ({"landmarks": (np.eye(3), np.eye(3))}, cmfsim.RegistrationError, "four|4"),
    ],
)
def test_bad_comparisons_are_named(arguments, error, pattern):
    with pytest.raises(error, match=pattern) as caught:
        cmfsim.compare_skins(plane(5, 4, 1.0), plane(5, 4), **arguments)
    assert isinstance(caught.value, ValueError)


def test_swapped_landmarks_are_named():
    """Left and right of the mouth exchanged on one skin would fold the map between them."""
    skin, marks = face()
    wrong = {**marks, "cheilion_L": marks["cheilion_R"], "cheilion_R": marks["cheilion_L"]}
    with pytest.raises(cmfsim.LandmarkError, match=r"swapped .*cheilion"):
        cmfsim.compare_skins(skin, skin, landmarks=(marks, wrong))


def test_skins_that_do_not_meet_are_refused():
    aside = moved(plane(5, 4), np.asarray(plane(5, 4).vertices) + [50.0, 0.0, 0.0])
    with pytest.raises(cmfsim.RegistrationError, match="all 25 vertices are matched to the border"):
        cmfsim.compare_skins(aside, plane(5, 4))


# --- the real face --------------------------------------------------------------------------------


def carried(landmarks, field):
    return {n: p + field(p[None])[0] for n, p in landmarks.items()}


def advancement(points):
    """A lower face that comes forward by up to 6 mm and rises by 2, faded out to eyes and neck."""
    z = points[:, 2]
    part = np.exp(-(((z - 1455.0) / 28.0) ** 2))
    return part[:, None] * np.array([0.0, -6.0, 2.0])


def test_a_shift_of_the_real_skin_is_found_at_every_vertex():
    """An affine map: the spline is exact, so each vertex finds itself."""
    skin, marks = face()
    vertices, shift = np.asarray(skin.vertices), np.array([1.0, -2.0, 0.5])
    there = {n: p + shift for n, p in marks.items()}
    found = cmfsim.compare_skins(moved(skin, vertices + shift), skin, landmarks=(there, marks))
    np.testing.assert_allclose(np.abs(found.signed), np.linalg.norm(shift), rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.partners, vertices[found.vertices], rtol=0, atol=1e-5)
    # Where the shift points out of the skin the prediction lies in front, and the other way round.
    _, normals, _ = real_heads.core_surface("atlas_head", "skin_open").closest(vertices)
    out = normals[found.vertices] @ shift / np.linalg.norm(shift)
    # But behind the ears, where the shift carries skin through a fold.
    assert (found.signed[out > 0.5] > 0).mean() > 0.95
    assert (found.signed[out < -0.5] < 0).mean() > 0.95
    assert set(found.regions) == set(cmfsim.skin_regions(vertices, marks))
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False)) == found.as_dict()


def test_a_known_field_on_the_real_face_is_found_within_the_splines_error():
    """Fourteen landmarks do not know the field between them; closest points know less."""
    skin, marks = face()
    vertices = np.asarray(skin.vertices)
    field = advancement(vertices)
    predicted = moved(skin, vertices + field)
    sides = (carried(marks, advancement), marks)
    by_marks = cmfsim.compare_skins(predicted, skin, landmarks=sides, mask="face")
    closest = cmfsim.compare_skins(predicted, skin, landmarks=sides, mask="face", method="closest")
    for found, limit in ((by_marks, 0.6), (closest, 2.0)):
        true = np.linalg.norm(field[found.vertices], axis=1)
        assert np.abs(np.abs(found.signed) - true).mean() < limit
    assert by_marks.mean > closest.mean
    assert by_marks.regions["upper lip"].signed_mean > 3.0
    assert by_marks.share < 0.7


def test_models_are_compared_at_the_same_vertices_and_with_no_change():
    """Half of the true motion leaves half of the error, the whole none, too much makes it worse."""
    skin, marks = face()
    vertices, shift = np.asarray(skin.vertices), np.array([0.0, -4.0, 1.0])
    post = moved(skin, vertices + shift)
    predictions = {
        "half": vertices + 0.5 * shift,
        "whole": vertices + shift,
        "triple": vertices + 3.0 * shift,
    }
    after = {n: p + shift for n, p in marks.items()}
    found = cmfsim.compare_models(skin, predictions, post, landmarks=(marks, after), mask="face")
    size = np.linalg.norm(shift)
    assert found.models == ("half", "whole", "triple")
    for name, part in (("no change", 1.0), ("half", 0.5), ("whole", 0.0), ("triple", 2.0)):
        np.testing.assert_allclose(np.abs(found.errors[name]), part * size, rtol=0, atol=1e-5)
    for region in ("whole", "nose", "chin"):
        assert found.improvements["half"][region].gain == pytest.approx(size / 2, abs=1e-5)
        assert found.improvements["whole"][region].share_better == 1.0
        assert found.improvements["triple"][region].gain == pytest.approx(-size, abs=1e-5)
        assert found.improvements["triple"][region].share_better == 0.0
    test = found.wilcoxon("half", "no change")
    assert test.p < 1e-6
    assert test.effect == 1.0
    assert "not independent" in test.caveat
    json.dumps(found.as_dict(), allow_nan=False)

    table = cmfsim.error_table({"P1": found, "=P2": found})
    rows = list(csv.DictReader(io.StringIO(table.csv())))
    assert len(rows) == 2 * 4 * 9
    assert {r["patient"] for r in rows} == {"P1", "'=P2"}
    row = next(r for r in rows if (r["region"], r["model"]) == ("nose", "half"))
    assert float(row["mean_mm"]) == found.regions["nose"]["half"].mean
    assert f"{size / 2:.2f} ± 0.00" in table.text()
    assert table.average("triple") == pytest.approx(2 * size, abs=1e-5)
    assert table.wilcoxon("half", "triple").caveat.startswith("2 pairs cannot give p below 0.5")
    assert table.as_dict()["averages_mm"]["nose"]["half"] == table.average("half", "nose")


def test_figures_are_written_whole_or_not_at_all(tmp_path):
    skin = plane(5, 4)
    found = cmfsim.compare_models(skin, {"H": np.asarray(skin.vertices) + [0, 0, 1.0]}, skin)
    table = cmfsim.error_table({"P1": found})
    for name, value in (("all.json", found), ("one.json", {"a": [1.0, None]}), ("t.csv", table)):
        cmfsim.write_metrics(tmp_path / name, value)
    assert json.loads((tmp_path / "all.json").read_text("utf-8")) == found.as_dict()
    assert (tmp_path / "t.csv").read_text("utf-8") == table.csv()
    for name, value, pattern in [
        ("all.json", {"a": np.nan}, "cannot be written as JSON"),
        ("all.json", 3, "a int has no as_dict"),
        ("t.csv", found, r"ModelComparison has no csv\(\)"),
        ("t.txt", table, r"written as \.json or \.csv"),
    ]:
        with pytest.raises(cmfsim.CaseError, match=pattern):
            cmfsim.write_metrics(tmp_path / name, value)
    assert json.loads((tmp_path / "all.json").read_text("utf-8")) == found.as_dict()
    assert len(list(tmp_path.iterdir())) == 3


def test_models_that_cannot_be_compared_are_named():
    skin = plane(5, 4)
    vertices = np.asarray(skin.vertices)
    for predictions, pattern in [
        ({}, "no prediction"),
        ({"H": vertices[:-1]}, "has 24 vertices"),
        ({"no change": vertices}, "rename the model"),
    ]:
        with pytest.raises(cmfsim.CaseError, match=pattern):
            cmfsim.compare_models(skin, predictions, skin)
    found = cmfsim.compare_models(skin, {"H": vertices + [0, 0, 1.0]}, skin)
    with pytest.raises(cmfsim.CaseError, match="use one of no change, H"):
        found.wilcoxon("H", "M")
    with pytest.raises(cmfsim.CaseError, match="there is no patient"):
        cmfsim.error_table({})
    other = cmfsim.compare_models(skin, {"M": vertices}, skin)
    with pytest.raises(cmfsim.CaseError, match="patient 'P2' has the models no change, M"):
        cmfsim.error_table({"P1": found, "P2": other})


# --- tests of significance ------------------------------------------------------------------------


def test_the_signed_rank_test_against_all_sign_patterns():
    """Exact p: the share of the 2⁹ patterns of signs with a rank sum at least as far out."""
    rng = np.random.default_rng(4)
    a, b = rng.uniform(1, 3, 9), rng.uniform(1, 3, 9) + 0.4
    found = cmfsim.wilcoxon_test(a, b, by="patient")
    ranks = stats.rankdata(np.abs(a - b))
    positive = ranks[a > b].sum()
    sums = np.array([ranks @ s for s in itertools.product((0, 1), repeat=9)])
    least = min(positive, ranks.sum() - positive)
    assert found.statistic == least
    assert found.p == pytest.approx(min(1.0, 2 * np.mean(sums <= least)), rel=1e-12)
    assert found.effect == pytest.approx(1 - 2 * positive / ranks.sum(), rel=1e-12)
    assert found.caveat == ""


def test_equal_errors_differ_by_chance():
    found = cmfsim.wilcoxon_test([1.0, 2.0], [1.0, 2.0])
    assert (found.p, found.n_equal, found.effect) == (1.0, 2, 0.0)
    with pytest.raises(cmfsim.CaseError, match=r"\(2,\) and \(3,\)"):
        cmfsim.wilcoxon_test([1, 2], [1, 2, 3])
    with pytest.raises(cmfsim.CaseError, match="use one of vertex, patient"):
        cmfsim.wilcoxon_test([1, 2], [1, 3], by="node")
