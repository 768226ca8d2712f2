"""Muscle templates: files, checks, the built-in one, and morphing to patients."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

import cmfsim
from cmfsim.io.cases.templates import write_template
from cmfsim.io.markups import read_curves, write_curves
from cmfsim.muscles.template import phantom_muscle

MIRROR = np.array([-1.0, 1.0, 1.0])
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
BOX = np.array([t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))])


def box(low, high):
    """A closed box with outward normals."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return cmfsim.SurfaceData(low + CORNERS * (high - low), BOX)


def strap(name, low, high, **more):
    """A muscle that is a box, with a fibre line along its long axis."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    middle = 0.5 * (low + high)
    line = [[*middle[:2], low[2]], middle, [*middle[:2], high[2]]]
    return cmfsim.MuscleSurface(name, name[-1], box(low, high), course=(line,), **more)


@pytest.fixture(scope="module")
def default():
    """The built-in template."""
    return cmfsim.MuscleTemplate.load("default")


@pytest.fixture(scope="module")
def small(default):
    """Two boxes on either side of a skull that is a box, with the built-in one's landmarks."""
    points = dict(default.landmarks)
    low, high = np.min(list(points.values()), axis=0), np.max(list(points.values()), axis=0)
    left = strap("masseter_L", (40, -60, -50), (50, -40, -10), boxes=2)
    right = strap("masseter_R", (-50, -60, -50), (-40, -40, -10), boxes=2)
    return cmfsim.MuscleTemplate(
        name="small",
        muscles=(left, right),
        skull=box(low, high),
        landmarks=points,
        definitions=cmfsim.SKULL_LANDMARKS,
        licence='none "at all"\n\x7f',
        attribution="nobody",
        source="a test",
        concepts={"masseter_L": ("X1", "X2")},
    )


@pytest.fixture
def folder(small, tmp_path):
    """The small template on disk."""
    pytest.importorskip("meshio")
    small.save(tmp_path / "atlas")
    return tmp_path / "atlas"


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


# Faults on disk.


def edited(folder, old, new):
    """Changes the text of the template; the old text must be there."""
    path = folder / "template.toml"
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), "utf-8")
    return text[: text.index(old)].count("\n") + 1


def the_finding(folder, code):
    """The one finding of a code."""
    (found,) = [f for f in cmfsim.check_template(folder) if f.code == code]
    assert found.fix
    return found


def test_a_sound_folder_has_no_errors(folder):
    assert [f for f in cmfsim.check_template(folder) if f.severity == "error"] == []


@pytest.mark.parametrize(
    ("old", "new", "code", "text"),
    [
        ('kind = "strap"', 'knid = "strap"', "template-unusable", "did you mean 'kind'"),
        ('kind = "strap"', 'kind = "rope"', "template-unusable", "strap, fan, ring, sheet"),
        ('side = "L"', 'side = "left"', "template-unusable", "'left'"),
        ("boxes = 2", "boxes = 0", "template-unusable", "at least 1"),
        ("boxes = 2", "boxes = 1.5", "template-unusable", "whole number"),
        ("boxes = 2", "boxes = 65", "template-unusable", "at most 64"),
        ("licence =", "license =", "template-unusable", "did you mean 'licence'"),
        ("version = 1", "version = 2", "template-unusable", "reads 1"),
        ('"cmfsim-template"', '"cmfsim-case"', "template-unusable", "'cmfsim-template'"),
        ('"skull.ply"', '"../skull.ply"', "template-unusable", "inside the template's folder"),
        ('"skull.ply"', '"/skull.ply"', "template-unusable", "inside the template's folder"),
        ('"skull.ply"', '"C:skull.ply"', "template-unusable", "inside the template's folder"),
        ('"skull.ply"', '"none.ply"', "file-missing", "no such file"),
        ('"muscle-masseter_L.ply"', '"gone.ply"', "file-missing", "no such file"),
        ('"course-masseter_L.mrk.json"', '"no.json"', "file-missing", "no such file"),
        ('"X1"', "7", "template-unusable", "list of texts"),
    ],
)
def test_faults_in_the_text_are_found_with_their_line(folder, old, new, code, text):
    line = edited(folder, old, new)
    # A key in place of another is unknown, and the other is missing.
    wrong = [f for f in cmfsim.check_template(folder) if f.code == code]
    (found,) = [f for f in wrong if text in f.what]
    assert found.severity == "error"
    assert found.where.startswith(f"template.toml:{line}")
    with pytest.raises((cmfsim.CaseError, FileNotFoundError), match="template"):
        cmfsim.MuscleTemplate.load(folder)


def test_a_missing_licence_is_found(folder):
    path = folder / "template.toml"
    lines = path.read_text("utf-8").splitlines()
    path.write_text("\n".join(x for x in lines if not x.startswith("licence")), "utf-8")
    assert "licence" in the_finding(folder, "template-unusable").what


def test_all_faults_are_found_at_once_and_loading_says_how_many(folder):
    edited(folder, 'name = "masseter_L"', 'nmae = "masseter_L"')
    edited(folder, '"muscle-masseter_R.ply"', '"gone.ply"')
    (folder / "skull.ply").write_bytes(b"no surface")
    codes = [f.code for f in cmfsim.check_template(folder)]
    assert sorted(codes) == ["file-missing", "template-unusable", "template-unusable"]
    with pytest.raises(cmfsim.CaseError, match="2 more"):
        cmfsim.MuscleTemplate.load(folder)


def test_a_link_out_of_the_folder_is_refused(folder, tmp_path):
    shutil.move(folder / "skull.ply", tmp_path / "outside.ply")
    try:
        (folder / "skull.ply").symlink_to(tmp_path / "outside.ply")
    except OSError:
        pytest.skip("this system makes no links")
    assert "inside the template's folder" in the_finding(folder, "template-unusable").what


def test_text_that_is_no_toml_is_one_finding(folder):
    (folder / "template.toml").write_text("name = [", "utf-8")
    assert "not TOML" in the_finding(folder, "template-unusable").what


def test_a_landmark_twice_is_found(folder):
    path = folder / "skull.mrk.json"
    path.write_text(path.read_text("utf-8").replace('"glabella"', '"nasion"'), "utf-8")
    assert "'nasion'" in the_finding(folder, "template-unusable").what


def test_names_of_no_template_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="built in: default"):
        cmfsim.MuscleTemplate.load("nobody")
    with pytest.raises(FileNotFoundError, match=r"template\.toml"):
        cmfsim.MuscleTemplate.load(tmp_path)


def test_broken_archives_are_refused(small, tmp_path):
    path = tmp_path / "t.npz"
    small.save(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(cmfsim.CaseError, match=r"t\.npz"):
        cmfsim.MuscleTemplate.load(path)
    path.write_bytes(data)
    with np.load(path) as archive:
        members = dict(archive)
    for name, value in (
        ("vertices", members["vertices"][:, :-1]),
        ("vertices", members["vertices"].T),
        ("triangle_steps", members["triangle_steps"] + 1),
        ("triangle_steps", members["triangle_steps"][:-1]),
        ("landmarks", members["landmarks"][:-1]),
        ("landmarks", members["landmarks"] * np.nan),
        ("template", np.array(str(members["template"]).replace('"vertices": 8', '"vertices": -8'))),
        ("template", np.array(str(members["template"]).replace('"strap"', '"rope"'))),
    ):
        np.savez(path, **{**members, name: value})
        with pytest.raises(cmfsim.CmfsimError):
            cmfsim.MuscleTemplate.load(path)


@pytest.mark.parametrize("boxes", ["1000000", "1e6", "0", "true", '"2"', "9" * 300])
def test_an_archive_that_asks_for_too_many_boxes_is_refused(small, tmp_path, boxes):
    """Only a folder's template was limited: 100 000 boxes ended the interpreter."""
    path = tmp_path / "t.npz"
    small.save(path)
    with np.load(path) as archive:
        members = dict(archive)
    text = str(members["template"])
    assert text.count('"boxes": 2') >= 1
    members["template"] = np.array(text.replace('"boxes": 2', f'"boxes": {boxes}'))
    np.savez(path, **members)
    with pytest.raises(cmfsim.CaseError, match=r"t\.npz.*boxes of masseter_L.* 1 to 64"):
        cmfsim.MuscleTemplate.load(path)
    findings = cmfsim.check_template(path)
    assert any(f.severity == "error" and "boxes of masseter_L" in f.what for f in findings)


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
