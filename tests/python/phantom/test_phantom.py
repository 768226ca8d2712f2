"""The phantom against what is known of it: closed form, symmetry, definitions of landmarks."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import cmfsim
from benches.scenes.angles import angle_between
from cmfsim import HeadParameters, PhantomHead, make_head
from cmfsim.phantom.grid import HOUNSFIELD, gradient_at, level_grid
from cmfsim.phantom.model import BONES, LABELS
from cmfsim.phantom.muscles import COURSES
from cmfsim.phantom.parameters import PARAMETER_RANGES

pytest.importorskip("skimage")

MIDLINE = """supraglabella glabella nasion rhinion mid_philtrum supradentale infradentale
    supramentale pogonion menton"""
PAIRED = """frontal_eminence supraorbital suborbital inferior_malar lateral_orbit zygomatic_arch
    supraglenoid gonion supra_m2 occlusal_line sub_m2"""
SKULL_LABELS = {*MIDLINE.split(), *(f"{n}_{s}" for n in PAIRED.split() for s in "LR")}
SKIN_MIDLINE = "nasion pronasale subnasale labiale_superius labiale_inferius pogonion"
SKIN_PAIRED = "exocanthion endocanthion alare cheilion"
SKIN_LABELS = {*SKIN_MIDLINE.split(), *(f"{n}_{s}" for n in SKIN_PAIRED.split() for s in "LR")}
SPACINGS = {"skin": 6.0, "cranium": 6.0, "mandible": 2.5, "upper_teeth": 2.5}
JAW = {"infradentale", "supramentale", "pogonion", "menton", "gonion", "occlusal_line", "sub_m2"}
EXTREME = HeadParameters(
    bite_gap=6.0,
    mandible_advance=6.0,
    jaw_width=1.08,
    chin_projection=5.0,
    asymmetry=5.0,
    fat_thickness=-1.0,
    lip_gap=8.0,
    nose_projection=5.0,
)


@cache
def head() -> PhantomHead:
    return make_head()


@cache
def extreme() -> PhantomHead:
    return make_head(EXTREME)


@cache
def coarse_labels() -> cmfsim.ImageData:
    return head().labels(4.0)


@cache
def coarse_anatomy() -> cmfsim.Anatomy:
    return head().anatomy(4.0)


def volume(surface: cmfsim.SurfaceData) -> float:
    """Six tetrahedra volumes from the origin, by the divergence theorem, mm³."""
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def open_edges(surface: cmfsim.SurfaceData) -> int:
    """Directed edges whose opposite is missing: none where closed and consistently turned."""
    t = surface.triangles.astype(np.int64)
    edges = np.vstack([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    n = len(surface.vertices)
    there, back = edges @ [n, 1], edges @ [1, n]
    return len(np.setdiff1d(there, back)) + len(np.setdiff1d(back, there))


@cache
def surface_of(name: str, spacing: float) -> cmfsim.SurfaceData:
    return head().surface(name, spacing)


def bone_points(who: PhantomHead, name: str, spacing: float) -> np.ndarray:
    return (surface_of(name, spacing) if who is head() else who.surface(name, spacing)).vertices


# --- shape ------------------------------------------------------------------------------------


def test_right_half_is_the_exact_mirror_image():
    points = np.random.default_rng(1).uniform([0, -120, -110], [80, 90, 125], (400, 3))
    mirrored = points * [-1.0, 1.0, 1.0]
    np.testing.assert_array_equal(head().skin_level(points), head().skin_level(mirrored))
    for name in BONES:
        level = head().bone_level(name, points)
        np.testing.assert_array_equal(level, head().bone_level(name, mirrored))
    values = coarse_labels().values
    np.testing.assert_array_equal(values, values[::-1])
    left, right = head().muscles["masseter_L"], head().muscles["masseter_R"]
    near = left.course[1] + [0.5, 0.2, 0.0]
    np.testing.assert_array_equal(left.level(near), right.level(near * [-1.0, 1.0, 1.0]))
    np.testing.assert_allclose(
        left.fibre(near) * [-1.0, 1.0, 1.0], right.fibre(near * [-1.0, 1.0, 1.0]), atol=1e-9
    )


@pytest.mark.parametrize("name", ["skin", "cranium", "mandible", "upper_teeth"])
def test_level_is_nearly_the_distance_close_to_the_surface(name):
    points = bone_points(head(), name, SPACINGS[name])[::5]
    field = head().field(name)
    slope = np.linalg.norm(gradient_at(field, points), axis=1)
    assert np.percentile(slope, 5) > 0.5
    assert np.percentile(slope, 95) < 1.6
    inside = points + 0.5 * gradient_at(field, points) / slope[:, None]
    distance = field(*inside.T)
    assert np.median(np.abs(distance - 0.5)) < 0.1


def test_grid_with_skipped_bricks_equals_the_levels_of_all_its_points():
    image = coarse_anatomy().skin
    shape = image.values.shape
    index = np.stack(np.meshgrid(*(np.arange(0, n, 3) for n in shape), indexing="ij"), axis=-1)
    index = index.reshape(-1, 3)
    points = image.lowest + index * np.asarray(image.spacing)
    clip = float(np.abs(image.values).max())
    expected = np.clip(head().skin_level(points), -clip, clip)
    found = image.values[tuple(index.T)]
    np.testing.assert_array_equal(found > 0.0, expected > 0.0)
    near = np.abs(expected) < 2.0
    assert near.sum() > 100
    np.testing.assert_allclose(found[near], expected[near], atol=2e-3)


def test_volumes_of_labels_agree_with_those_inside_the_surfaces():
    low, high = head()._box("mandible")
    axes = [np.arange(a - 2, b + 4, 1.5) for a, b in zip(low, high, strict=True)]
    counted = (level_grid(head().field("mandible"), axes, 3.0) > 0.0).sum() * 1.5**3
    assert counted == pytest.approx(volume(surface_of("mandible", 2.0)), rel=0.025)
    labels = coarse_labels().values
    whole = (labels > 0).sum() * 4.0**3
    assert whole == pytest.approx(volume(head().surface("skin", 6.0)), rel=0.01)
    # An adult head with its neck: 4 to 5 litres; brain 1.2 to 1.7.
    assert 3.8e6 < whole < 5.2e6
    assert 1.2e6 < (labels == LABELS["brain"]).sum() * 4.0**3 < 1.7e6


@pytest.mark.parametrize(
    ("name", "spacing"),
    [
        ("skin", 6.0),
        ("cranium", 6.0),
        ("mandible", 2.5),
        ("teeth", 1.8),
        ("masseter_R", 2.0),
        ("orbicularis_oris", 1.5),
    ],
)
def test_surfaces_are_closed_and_turned_outward(name, spacing):
    surface = surface_of(name, spacing)
    assert open_edges(surface) == 0
    assert volume(surface) > 0.0
    cmfsim.Surface(surface.vertices, surface.triangles)
    off = np.abs(head().field(name)(*surface.vertices.T))
    assert np.median(off) < 0.01


def test_adult_proportions():
    skull, skin = head().skull_landmarks, head().skin_landmarks

    def apart(points, a, b):
        return float(np.linalg.norm(points[a] - points[b]))

    assert apart(skull, "nasion", "menton") == pytest.approx(114.0, abs=3.0)
    assert apart(skull, "zygomatic_arch_L", "zygomatic_arch_R") == pytest.approx(134.0, abs=4.0)
    assert apart(skull, "gonion_L", "gonion_R") == pytest.approx(95.0, abs=4.0)
    assert apart(skin, "cheilion_L", "cheilion_R") == pytest.approx(51.0, abs=3.0)
    assert apart(skin, "alare_L", "alare_R") == pytest.approx(34.0, abs=3.0)
    # Skin over bone, forensic tables: glabella 4 to 7 mm, chin 8 to 12, arch 4 to 9.
    for name, low, high in (
        ("glabella", 4.0, 7.5),
        ("pogonion", 7.0, 12.0),
        ("zygomatic_arch_L", 4.0, 9.0),
        ("supra_m2_L", 18.0, 30.0),
    ):
        assert low < head().skin_level([skull[name]])[0] < high, name


# --- landmarks --------------------------------------------------------------------------------


@pytest.mark.parametrize("person", [head, extreme])
def test_landmarks_have_the_known_labels_and_lie_on_their_surfaces(person):
    who = person()
    assert set(who.skull_landmarks) == SKULL_LABELS
    assert set(who.skin_landmarks) == SKIN_LABELS
    for label, place in who.skull_landmarks.items():
        bone = "mandible" if label.removesuffix("_L").removesuffix("_R") in JAW else "cranium"
        assert abs(who.bone_level(bone, [place])[0]) < 0.1, label
    for label, place in who.skin_landmarks.items():
        assert abs(who.skin_level([place])[0]) < 0.1, label


def test_landmarks_stand_in_anatomical_order():
    skull, skin = head().skull_landmarks, head().skin_landmarks
    heights = [skull[name][2] for name in MIDLINE.split()]
    assert heights == sorted(heights, reverse=True)
    assert skull["nasion"][1] > skull["glabella"][1]
    assert skull["supramentale"][1] > skull["pogonion"][1]
    assert skin["pronasale"][1] == min(place[1] for place in skin.values())
    for label, place in {**skull, **skin}.items():
        if label.endswith("_L"):
            assert place[0] > 10.0, label
        elif not label.endswith("_R"):
            assert place[0] == 0.0, label


# --- parts and one another ----------------------------------------------------------------------


@pytest.mark.parametrize("person", [head, extreme, lambda: make_head(HeadParameters.random(3))])
def test_no_part_sticks_out_and_jaws_stay_apart(person):
    who = person()
    least = 2.0 * who.parameters.scale
    for name, spacing in (("cranium", 6.0), ("upper_teeth", 2.5)):
        assert who.skin_level(bone_points(who, name, spacing)).min() > least, name
    jaw = np.vstack([bone_points(who, "mandible", 2.5), bone_points(who, "lower_teeth", 2.5)])
    assert who.skin_level(jaw).min() > least
    assert who.skin_level(bone_points(who, "air", 5.0)).min() > 0.5
    assert who.bone_level("cranium", jaw).max() < 0.0
    assert who.bone_level("upper_teeth", jaw).max() < 0.0


def test_anatomy_keeps_the_jaws_and_the_air_apart():
    anatomy = coarse_anatomy()
    cranium, jaw = (anatomy.bones[name].values > 0.0 for name in ("cranium", "mandible"))
    assert anatomy.air is not None
    assert anatomy.teeth is not None
    assert not (cranium & jaw).any()
    assert not ((anatomy.air.values > 0.0) & (cranium | jaw)).any()
    assert (anatomy.teeth.values > 0.0).any()
    # Bones carry their teeth, so that tissue between skin and bones leaves the teeth out.
    assert not ((anatomy.teeth.values > 0.0) & ~(cranium | jaw)).any()
    assert not ((cranium | jaw) & (anatomy.skin.values <= 0.0)).any()
    assert anatomy.skin.values.dtype == np.float32


# --- muscles ------------------------------------------------------------------------------------


def test_twenty_kinds_of_muscle_lie_under_the_skin_and_outside_bone():
    assert len(COURSES) == 20
    assert len(head().muscles) == 38
    for name, muscle in head().muscles.items():
        assert muscle.kind in {"strap", "fan", "ring", "sheet"}
        assert muscle.origin.shape == muscle.insertion.shape == (len(muscle.course), 3)
        lines = np.vstack(muscle.course)
        inside = muscle.level(lines) > 0.0
        # What runs along bone is cut by it; most of every line lies in its muscle.
        assert inside.mean() > 0.6, name
        around = lines + np.random.default_rng(0).normal(scale=2.0, size=lines.shape)
        within = around[muscle.level(around) > 0.0]
        assert head().skin_level(within).min() >= 0.5, name
        assert head().bone_level("bone", within).max() <= 0.0, name


def test_muscles_of_an_extreme_face_follow_it():
    lines = np.vstack([line for muscle in extreme().muscles.values() for line in muscle.course])
    assert (extreme().skin_level(lines) > 0.5).mean() > 0.98
    assert (extreme().bone_level("bone", lines) < 1.0).mean() > 0.95


def test_muscles_attach_where_anatomy_has_them():
    for name, bone in (
        ("masseter_L", "cranium"),
        ("zygomaticus_major_R", "cranium"),
        ("levator_labii_superioris_L", "cranium"),
        ("mentalis_L", "mandible"),
        ("depressor_labii_inferioris_R", "mandible"),
    ):
        assert np.abs(head().bone_level(bone, head().muscles[name].origin)).max() < 1.5, name
    for name in ("masseter_L", "temporalis_R", "medial_pterygoid_L"):
        distance = head().bone_level("mandible", head().muscles[name].insertion)
        assert distance.min() > -3.0, name


def test_fibres_run_along_the_courses_and_turn_with_the_face():
    for who in (head(), extreme()):
        for name in ("zygomaticus_major_L", "masseter_R", "orbicularis_oculi_L"):
            muscle = who.muscles[name]
            line = muscle.course[0]
            middle = line[3:-3]
            along = line[4:-2] - line[2:-4]
            along /= np.linalg.norm(along, axis=1)[:, None]
            found = muscle.fibre(middle)
            np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
            angle = angle_between(found, along)
            assert np.percentile(angle, 95) < 6.0, name


# --- people -------------------------------------------------------------------------------------


def test_parameters_do_what_they_say():
    skull, skin = head().skull_landmarks, head().skin_landmarks

    def other(**values):
        return make_head(HeadParameters(**values))

    forward = other(mandible_advance=5.0, nose_projection=3.0)
    bone = forward.skull_landmarks
    assert bone["pogonion"][1] == pytest.approx(skull["pogonion"][1] - 5.0, abs=0.3)
    assert forward.skin_landmarks["pogonion"][1] < skin["pogonion"][1] - 3.0
    np.testing.assert_allclose(bone["nasion"], skull["nasion"], atol=1e-9)
    nose = forward.skin_landmarks["pronasale"][1]
    assert nose == pytest.approx(skin["pronasale"][1] - 3.0, abs=0.3)
    long = other(face_height=1.08, scale=1.1).skull_landmarks
    height = (skull["nasion"] - skull["menton"])[2]
    assert (long["nasion"] - long["menton"])[2] == pytest.approx(1.08 * 1.1 * height, rel=0.015)
    np.testing.assert_allclose(long["supraglabella"], 1.1 * skull["supraglabella"], atol=1e-6)
    wide = other(jaw_width=1.06, asymmetry=4.0).skull_landmarks
    ratio = (wide["gonion_L"] - wide["gonion_R"])[0] / (skull["gonion_L"] - skull["gonion_R"])[0]
    assert ratio == pytest.approx(1.06, abs=0.01)
    assert wide["menton"][0] == pytest.approx(4.0, abs=0.1)
    assert wide["nasion"][0] == pytest.approx(0.0, abs=0.1)
    gaping = other(bite_gap=5.0).skull_landmarks
    assert gaping["infradentale"][2] == pytest.approx(skull["infradentale"][2] - 4.0, abs=0.4)


def test_lip_gap_parts_the_lips():
    between = np.array([[0.0, -101.0, -44.4]])
    assert head().skin_level(between + [[0.0, 6.0, 0.0]])[0] > 0.0
    parted = make_head(HeadParameters(lip_gap=6.0))
    assert parted.skin_level(between)[0] < 0.0
    assert parted.bone_level("teeth", between)[0] < 0.0


def test_people_differ_and_the_same_seed_is_the_same_person():
    people = [HeadParameters.random(seed) for seed in range(6)]
    assert len(set(people)) == 6
    assert people[2] == HeadParameters.random(2)
    points = np.array([[0.0, -100.0, -75.0], [60.0, -40.0, -30.0], [0.0, -120.0, -5.0]])
    levels = {tuple(make_head(person).skin_level(points)) for person in people}
    assert len(levels) == 6


@pytest.mark.parametrize("name", sorted(PARAMETER_RANGES))
def test_values_out_of_range_are_named(name):
    low, high = PARAMETER_RANGES[name]
    for value in (low - 0.1, high + 0.1, float("nan"), "large"):
        with pytest.raises(cmfsim.CaseError, match=name):
            replace(HeadParameters(), **{name: value})


def test_wrong_questions_are_named():
    with pytest.raises(cmfsim.CaseError, match="surface is 'nose'"):
        head().surface("nose")
    with pytest.raises(cmfsim.CaseError, match="bone is 'skin'"):
        head().bone_level("skin", [[0.0, 0.0, 0.0]])
    with pytest.raises(cmfsim.CaseError, match="spacing"):
        head().labels(0.0)
    with pytest.raises(cmfsim.CaseError, match="voxels"):
        head().ct(0.2)
    with pytest.raises(cmfsim.CaseError, match="noise"):
        head().ct(4.0, noise=-1.0)
    with pytest.raises(cmfsim.CaseError, match="smaller spacing"):
        head().surface("teeth", 60.0)
    with pytest.raises(cmfsim.CaseError, match="parameters"):
        PhantomHead({"scale": 1.0})


# --- images -------------------------------------------------------------------------------------


def test_ct_has_the_hounsfield_units_of_its_tissues():
    image = head().ct(4.0, noise=10.0, seed=3)
    labels = coarse_labels()
    assert image.values.dtype == np.int16
    assert image.values.shape == labels.values.shape
    np.testing.assert_array_equal(image.lowest, labels.lowest)
    outside = image.values[:3]
    assert outside.mean() == pytest.approx(HOUNSFIELD["air"], abs=2.0)
    assert outside.std() == pytest.approx(10.0, rel=0.25)
    for tissue, low, high in (
        ("brain", 20.0, 60.0),
        ("muscle", -20.0, 110.0),
        ("fat", -120.0, 60.0),
        ("mandible", 350.0, 1200.0),
        ("upper_teeth", 1200.0, 2200.0),
        ("air", -1000.0, -300.0),
    ):
        median = np.median(image.values[labels.values == LABELS[tissue]])
        assert low < median < high, (tissue, median)
    # Skin stands between air and tissue near −480 HU, as partial volume has it.
    skin = coarse_anatomy().skin.values
    half = image.values[np.abs(skin) < 0.15]
    assert np.median(half) == pytest.approx(-480.0, abs=60.0)


def test_ct_is_drawn_by_its_seed():
    plain = head().ct(8.0, seed=1)
    np.testing.assert_array_equal(plain.values, head().ct(8.0, seed=1).values)
    assert (plain.values != head().ct(8.0, seed=2).values).any()


def test_anisotropic_images_cover_the_same_head():
    image = head().labels((3.0, 4.0, 5.0))
    assert np.asarray(image.spacing).tolist() == [3.0, 4.0, 5.0]
    whole = (image.values > 0).sum() * 60.0
    assert whole == pytest.approx((coarse_labels().values > 0).sum() * 4.0**3, rel=0.015)
