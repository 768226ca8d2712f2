"""Muscle templates: their files, the built-in one, and the checks of their contents."""

import subprocess
import sys

import numpy as np
import pytest
from box_muscles import BOX, box, strap

import cmfsim
from cmfsim.io.cases.templates import write_template
from cmfsim.io.slicer.markups import read_curves, write_curves
from make_default_template import phantom_muscle

MIRROR = np.array([-1.0, 1.0, 1.0])


def same(one, other):
    """Whether two templates hold the same bits."""
    assert (one.name, one.licence, one.attribution, one.source) == (
        other.name,
        other.licence,
        other.attribution,
        other.source,
    )
    assert list(one.landmarks) == list(other.landmarks)
    for name, place in one.landmarks.items():
        assert np.array_equal(place, other.landmarks[name])
    assert dict(one.definitions) == dict(other.definitions)
    assert dict(one.concepts) == dict(other.concepts)
    assert [m.name for m in one.muscles] == [m.name for m in other.muscles]
    for a, b in zip((*one.muscles,), (*other.muscles,), strict=True):
        assert (a.side, a.kind, a.boxes) == (b.side, b.kind, b.boxes)
        assert len(a.course) == len(b.course)
        assert all(map(np.array_equal, a.course, b.course))
        assert np.array_equal(a.surface.vertices, b.surface.vertices)
        assert np.array_equal(a.surface.triangles, b.surface.triangles)
    assert np.array_equal(one.skull.vertices, other.skull.vertices)
    assert np.array_equal(one.skull.triangles, other.skull.triangles)


@pytest.mark.parametrize("name", ["atlas", "atlas.npz"])
def test_a_template_comes_back_from_disk_bit_by_bit(small, tmp_path, name):
    pytest.importorskip("meshio")
    small.save(tmp_path / name)
    same(cmfsim.MuscleTemplate.load(tmp_path / name), small)


def test_coordinates_that_single_precision_lacks_come_back_too(small, tmp_path):
    third = {name: place / 3.0 for name, place in small.landmarks.items()}
    moved = strap("masseter_L", (40.1, -60, -50), (50, -40, -10))
    other = cmfsim.MuscleTemplate(
        name="thirds", muscles=(moved,), skull=small.skull, landmarks=third, licence="none"
    )
    other.save(tmp_path / "thirds.npz")
    same(cmfsim.MuscleTemplate.load(tmp_path / "thirds.npz"), other)


def test_mirrored_muscles_are_stored_once(default, tmp_path):
    one = cmfsim.MuscleTemplate.of(default)
    left = cmfsim.MuscleTemplate(
        name="left",
        muscles=tuple(m for m in one.muscles if m.side != "R"),
        skull=one.skull,
        landmarks=one.landmarks,
        licence="none",
    )
    left.save(tmp_path / "left.npz")
    one.save(tmp_path / "both.npz")
    both = (tmp_path / "both.npz").stat().st_size
    assert both < 1.02 * (tmp_path / "left.npz").stat().st_size


def test_a_folder_may_state_other_units_and_frames(small, folder):
    text = (folder / "template.toml").read_text("utf-8")
    (folder / "template.toml").write_text(
        text.replace("version = 1\n", 'version = 1\nunits = "cm"\nframe = "RAS"\n'), "utf-8"
    )
    read = cmfsim.MuscleTemplate.load(folder)
    expected = np.asarray(small.skull.vertices) * [-10.0, -10.0, 10.0]
    assert np.allclose(read.skull.vertices, expected, rtol=1e-12)


# The built-in template.


def test_the_default_template_is_what_its_script_makes(default):
    """Two muscles stand for all: making all of them takes a minute."""
    pytest.importorskip("skimage")
    head = cmfsim.make_head()
    for name in ("corrugator_L", "depressor_labii_inferioris_L"):
        made = phantom_muscle(head, head.muscles[name])
        kept = default.musculature[name]
        assert np.allclose(made.surface.vertices, kept.surface.vertices, rtol=0, atol=1e-5)
        assert np.array_equal(made.surface.triangles, kept.surface.triangles)
        assert all(
            np.allclose(a, b, atol=1e-5) for a, b in zip(made.course, kept.course, strict=True)
        )
    for name, place in head.skull_landmarks.items():
        assert np.allclose(default.landmarks[name], place, rtol=0, atol=1e-9)
    assert [m.name for m in default.muscles] == list(head.muscles)
    assert [m.kind for m in default.muscles] == [m.kind for m in head.muscles.values()]


def test_the_default_template_is_symmetric_and_closed(default):
    muscles = default.musculature
    for muscle in muscles:
        report = cmfsim.check_surface(muscle.surface, crossings=False)
        assert report.is_closed, muscle.name
        assert report.volume > 0.0, muscle.name
        if muscle.side == "L":
            other = muscles[f"{muscle.name[:-1]}R"].surface
            assert np.array_equal(np.asarray(muscle.surface.vertices) * MIRROR, other.vertices)


def test_every_muscle_of_the_default_template_knows_its_fibres(default):
    for muscle in default.musculature:
        surface = cmfsim.Surface(muscle.surface.vertices, muscle.surface.triangles)
        assert muscle.course
        for line in muscle.course:
            inside = surface.winding_number(line) > 0.5
            distance = np.linalg.norm(surface.closest(line)[0] - line, axis=1)
            assert (inside | (distance < 6.0)).all(), muscle.name


def test_the_default_template_needs_numpy_alone():
    code = (
        "import sys\n"
        "for n in ('meshio','pyvista','scipy','skimage','SimpleITK','tomllib','tomli'):\n"
        "    sys.modules[n] = None\n"
        "import cmfsim\n"
        "t = cmfsim.MuscleTemplate.load('default')\n"
        "print(len(t.morph(t.landmarks)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "38"


def test_the_default_template_has_no_faults(default):
    """Without its largest muscles: looking for crossings takes a second for each of them."""
    lesser = [m for m in default.muscles if len(np.asarray(m.surface.vertices)) < 5000]
    assert len(lesser) > 25
    assert [f for f in with_muscles(default, *lesser).check() if f.severity != "note"] == []


def test_landmark_names_are_those_of_the_phantom():
    assert set(cmfsim.SKULL_LANDMARKS) == set(cmfsim.make_head().skull_landmarks)
    assert len(cmfsim.SKULL_LANDMARKS) == 32


# Faults of contents.


def with_muscles(small, *muscles, **changes):
    """The small template with other muscles or fields."""
    given = {name: getattr(small, name) for name in small.__dataclass_fields__}
    return cmfsim.MuscleTemplate(**{**given, "muscles": muscles or small.muscles, **changes})


def codes(template):
    """Severity by code of what is found."""
    return {f.code: f.severity for f in template.check()}


def test_the_small_template_is_sound(small):
    landmark_notes = {"template-off"}
    assert set(codes(small)) - landmark_notes == set()


def test_an_open_surface_is_found(small):
    left = small.muscles[0]
    cut = cmfsim.SurfaceData(left.surface.vertices, np.asarray(left.surface.triangles)[2:])
    opened = cmfsim.MuscleSurface(left.name, "L", cut)
    assert codes(with_muscles(small, opened, small.muscles[1]))["surface-open"] == "warning"


def test_a_surface_inside_out_is_found(small):
    left = small.muscles[0]
    turned = cmfsim.SurfaceData(left.surface.vertices, np.asarray(left.surface.triangles)[:, ::-1])
    turned = cmfsim.MuscleSurface(left.name, "L", turned)
    assert codes(with_muscles(small, turned, small.muscles[1]))["surface-normals"] == "error"


def test_a_surface_that_cuts_through_itself_is_found(small):
    one, other = box((40, -60, -50), (50, -40, -10)), box((45, -55, -40), (60, -45, -20))
    vertices = np.concatenate([one.vertices, other.vertices])
    crossed = cmfsim.SurfaceData(vertices, np.concatenate([BOX, BOX + 8]))
    crossed = cmfsim.MuscleSurface("masseter_L", "L", crossed)
    assert codes(with_muscles(small, crossed, small.muscles[1]))["surface-crossing"] == "note"


def test_a_muscle_without_a_partner_is_found(small):
    assert codes(with_muscles(small, small.muscles[0]))["template-sides"] == "warning"


def test_partners_of_another_kind_are_found(small):
    sheet = cmfsim.MuscleSurface("masseter_R", "R", small.muscles[1].surface, "sheet")
    found = codes(with_muscles(small, small.muscles[0], sheet))
    assert found["template-sides"] == "warning"


def test_a_name_of_another_side_is_found(small):
    wrong = cmfsim.MuscleSurface("masseter_L", "R", small.muscles[0].surface)
    assert codes(with_muscles(small, wrong))["template-sides"] == "error"


def test_muscles_on_the_wrong_side_are_found(small):
    left, right = small.muscles
    swapped = (
        cmfsim.MuscleSurface("masseter_L", "L", right.surface),
        cmfsim.MuscleSurface("masseter_R", "R", left.surface),
    )
    assert codes(with_muscles(small, *swapped))["left-right-swapped"] == "error"


def test_a_muscle_far_from_the_skull_is_found(small):
    away = strap("masseter_L", (240, -60, -50), (250, -40, -10))
    found = codes(with_muscles(small, away, small.muscles[1]))
    assert found["template-off"] == "warning"


def test_a_fibre_line_outside_its_muscle_is_found(small):
    line = [[0, 0, 0], [0, 0, 10]]
    stray = cmfsim.MuscleSurface("masseter_L", "L", small.muscles[0].surface, course=(line,))
    found = codes(with_muscles(small, stray, small.muscles[1]))
    assert found["template-off"] == "warning"


def test_a_skull_in_other_units_is_found(small):
    metres = cmfsim.SurfaceData(np.asarray(small.skull.vertices) / 1000, small.skull.triangles)
    assert codes(with_muscles(small, skull=metres))["surface-units"] == "error"


def test_faults_of_landmarks_are_found(small):
    points = dict(small.landmarks)
    few = {k: v for k, v in points.items() if k not in {"gonion_L", "menton"}}
    found = {f.code: f for f in with_muscles(small, landmarks=few).check()}
    assert "gonion_L" in found["template-landmarks-missing"].what
    extra = with_muscles(small, landmarks={**points, "tip": points["menton"] + 1.0})
    found = {f.code: f for f in extra.check()}
    assert "tip" in found["landmark-extra"].what
    assert found["landmark-extra"].severity == "warning"
    swapped = {**points, "gonion_L": points["gonion_R"], "gonion_R": points["gonion_L"]}
    found = {f.code: f for f in with_muscles(small, landmarks=swapped).check()}
    assert "1 pairs" in found["left-right-swapped"].what
    assert "gonion" in found["left-right-swapped"].what
    mirrored = {name: MIRROR * place for name, place in points.items()}
    found = {f.code: f for f in with_muscles(small, landmarks=mirrored).check()}
    assert "every pair" in found["left-right-swapped"].what
    flat = {name: place * [1, 1, 0] for name, place in points.items()}
    assert codes(with_muscles(small, landmarks=flat))["template-landmarks"] == "error"
    twice = {**points, "menton": points["pogonion"]}
    assert codes(with_muscles(small, landmarks=twice))["template-landmarks"] == "error"
    off = {**points, "nasion": points["nasion"] - [0, 30, 0]}
    found = [f for f in with_muscles(small, landmarks=off).check() if "nasion" in f.what]
    assert found[0].code == "template-off"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"name": "a/b"}, "letters, digits"),
        ({"licence": ""}, "licence"),
        ({"landmarks": {}}, "no landmark"),
        ({"landmarks": {"nasion": (0, 0)}}, "shape"),
        ({"landmarks": {"nasion": (0, 0, np.nan)}}, "finite"),
        ({"muscles": ()}, "no muscle"),
        ({"skull": None}, "SurfaceData"),
    ],
)
def test_templates_that_cannot_be_meant_are_refused(small, change, text):
    given = {name: getattr(small, name) for name in small.__dataclass_fields__}
    with pytest.raises(cmfsim.CmfsimError, match=text) as caught:
        cmfsim.MuscleTemplate(**{**given, **change})
    assert isinstance(caught.value, ValueError)


def test_muscle_names_that_cannot_be_files_are_refused(small):
    surface = small.muscles[0].surface
    for names in (("../x",), ("a", "A"), ("a", "a")):
        muscles = tuple(cmfsim.MuscleSurface(name, "both", surface) for name in names)
        with pytest.raises(cmfsim.CaseError):
            with_muscles(small, *muscles)


# Writing.


def test_a_folder_with_other_files_is_not_replaced(small, folder):
    (folder / "notes.txt").write_text("mine", "utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"notes\.txt"):
        small.save(folder)
    assert (folder / "notes.txt").read_text("utf-8") == "mine"


def test_a_template_replaces_the_one_before_it_whole(small, folder):
    with_muscles(small, small.muscles[0], name="other").save(folder)
    assert not (folder / "muscle-masseter_R.ply").exists()
    assert cmfsim.MuscleTemplate.load(folder).name == "other"
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


def test_a_failed_write_leaves_the_old_template_whole(small, folder, monkeypatch):
    def fails(*_):
        raise OSError("disk full")

    monkeypatch.setattr("cmfsim.io.cases.templates.write_curves", fails)
    with pytest.raises(OSError, match="disk full"):
        write_template(folder, with_muscles(small, name="other"))
    same(cmfsim.MuscleTemplate.load(folder), small)
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


def test_curves_come_back_and_closed_ones_end_where_they_start(tmp_path):
    path = tmp_path / "lines.mrk.json"
    lines = [[[0.1, 2, 3], [4, 5, 6]], [[1, 0, 0], [0, 1, 0], [0, 0, 1 / 3]]]
    write_curves(path, lines)
    read = read_curves(path)
    assert all(map(np.array_equal, read, lines))
    path.write_text(path.read_text("utf-8").replace('"Curve"', '"ClosedCurve"'), "utf-8")
    assert np.array_equal(read_curves(path)[1], [*lines[1], lines[1][0]])
    path.write_text(path.read_text("utf-8").replace('"LPS"', '"RAS"'), "utf-8")
    assert np.allclose(read_curves(path)[0][1], [-4, -5, 6])
    path.write_text(path.read_text("utf-8").replace('"ClosedCurve"', '"Fiducial"'), "utf-8")
    with pytest.raises(cmfsim.LandmarkError, match="Fiducial"):
        read_curves(path)
    write_curves(path, [[[0, 0, 0]]])
    with pytest.raises(cmfsim.LandmarkError, match="two are needed"):
        read_curves(path)
