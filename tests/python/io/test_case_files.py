"""A case file says what a case is, and an error in it names file, line and key."""

import os
import re
from dataclasses import MISSING, fields
from pathlib import Path

import numpy as np
import pytest

import cmfsim
import cmfsim.values.case_parts
from cmfsim.io.files.reading_writing import toml_module
from cmfsim.io.files.texts import line_of, toml_lines
from cmfsim.values import case_parts

HEAD = 'format = "cmfsim-case"\nversion = 1\n'
SURFACES = '[surfaces]\nskin = "skin.ply"\n[surfaces.bones]\nmandible = "jaw.stl"\n'
FULL = """# A case with everything.
format = "cmfsim-case"
version = 1
name = "P1"

[surfaces]
skin = "../scans/skin.ply"
units = "cm"
frame = "RAS"

[surfaces.bones]
cranium = "/big/cranium.stl"
mandible = "jaw.obj"

[landmarks]
skull = "skull.mrk.json"
frame = "LPS"

[region]
posterior_plane = {point = [0, 1, 2], normal = [0, 2, 0]}
lower = -40
upper = 120.5

[mesh]
edge_length = 2.5
refine = false
cleft = 3.5

[[osteotomies]]
procedure = "le_fort_1"
height = 4.5

[[osteotomies]]
plane = {point = [
    0, 0, 0,  # the symphysis
  ], normal = [1, 0, 0]}
bone = "mandible"
name = "half"

[plan.maxilla]
translation = [0, -5, 1]
angle = 90
axis = [0, 0, 1]
centre = [1, 0, 0]

[plan.half]
matrix = [[1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]

[plan.mandible]
transform = {file = "jaw.tfm", direction = "from-parent", frame = "LPS"}

[node_kinds]
joined_distance = 1.5

[tissue]
young = 0.003
poisson = 0.46

[solver]
method = "cholesky"
tolerance = 1e-9

[output]
folder = "results/first"

[lips]
contact = true
seam = "landmarks"
depth = 5
height = 11.5
"""


def load(folder, text):
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return cmfsim.Case.load(path)


def test_everything_in_a_case_file_arrives(tmp_path):
    """Each table, with paths resolved against the folder of the case."""
    case = load(tmp_path, FULL)
    assert case.name == "P1"
    assert case.surfaces.skin == tmp_path / "../scans/skin.ply"
    assert str(case.surfaces.bones["cranium"]) == "/big/cranium.stl"
    assert (case.surfaces.units, case.surfaces.frame) == ("cm", "RAS")
    assert case.landmarks.skull == tmp_path / "skull.mrk.json"
    assert case.landmarks.skin is None
    assert case.region.posterior_plane.normal.tolist() == [0.0, 1.0, 0.0]
    assert (case.region.lower, case.region.upper) == (-40.0, 120.5)
    assert (case.mesh.edge_length, case.mesh.refine, case.mesh.cleft) == (2.5, False, 3.5)
    assert case.lips == cmfsim.values.case_parts.CaseLips(
        contact=True, seam="landmarks", depth=5.0, height=11.5
    )
    assert case.osteotomies[0].segments == ("maxilla",)
    assert dict(case.osteotomies[0].options) == {"height": 4.5}
    assert case.osteotomies[1].segments == ("half",)
    # A quarter turn about (1, 0, 0), then the translation.
    moved = case.plan["maxilla"].matrix @ [2, 0, 0, 1]
    assert moved.tolist() == [1.0, -4.0, 1.0, 1.0]
    assert case.plan["half"].matrix[0, 3] == 2.0
    jaw = case.plan["mandible"]
    assert jaw.transform == tmp_path / "jaw.tfm"
    assert (jaw.direction, jaw.frame) == ("from-parent", "LPS")
    assert case.node_kinds["joined_distance"] == 1.5
    assert case.tissue.kind == "isotropic"
    assert case.solver.method == "cholesky"
    assert case.output == tmp_path / "results/first"


def test_a_case_is_that_of_the_folder_in_which_it_was_loaded(tmp_path, monkeypatch):
    """A script that goes to another patient's folder does not read that patient's files."""
    load(tmp_path, FULL)
    monkeypatch.chdir(tmp_path)
    case = cmfsim.Case.load("case.toml")
    (tmp_path / "plan.toml").write_text('[plan.half]\ntransform = "a.txt"\n', encoding="utf-8")
    planned = case.with_plan("plan.toml")
    monkeypatch.chdir("/")
    assert case.file == tmp_path / "case.toml"
    assert case.surfaces.skin == tmp_path / "../scans/skin.ply"
    assert case.output == tmp_path / "results/first"
    assert planned.plan["half"].transform == tmp_path / "a.txt"


def test_what_a_case_file_leaves_out_has_its_default(tmp_path):
    """The default fat, 4 mm, refinement, an output folder beside the file."""
    case = load(tmp_path, HEAD + SURFACES)
    assert case.name == tmp_path.name
    assert case.tissue is None
    assert case.fat.preset == "passive"
    assert case.fat.fraction.tolist() == [0.0]
    assert case.mesh == cmfsim.values.case_parts.CaseMesh(edge_length=4.0, refine=True)
    assert case.lips == cmfsim.values.case_parts.CaseLips()
    assert not case.lips.contact
    assert case.output == tmp_path / "out"
    assert (case.osteotomies, dict(case.plan)) == ((), {})


def test_an_image_may_stand_in_place_of_surfaces(tmp_path):
    """With its thresholds and working spacing."""
    text = '[image]\nfile = "ct.nii.gz"\nskin_threshold = -250\nworking_spacing = 1.0\n'
    case = load(tmp_path, HEAD + text)
    assert case.surfaces is None
    assert case.image.file == tmp_path / "ct.nii.gz"
    assert (case.image.skin_threshold, case.image.bone_threshold) == (-250.0, None)
    more = "metal_threshold = 1900\nseries = 3\nrescale = [1, -1024]\n"
    case = load(tmp_path, HEAD + text + more)
    assert case.image.metal_threshold == 1900.0
    assert (case.image.series, case.image.rescale) == ("3", (1.0, -1024.0))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("series = [3]", "number or UID"),
        ("series = true", "number or UID"),
        ('series = ""', "number or UID"),
        ("rescale = 1", r"\[slope, intercept\]"),
        ("rescale = [0, -1024]", "slope must be above 0"),
        ("rescale = [1, 1e9]", "intercept within"),
        ("metal_threshold = 5000", "metal_threshold"),
        ("metal_threshold = 200\nbone_threshold = 250", "the former must be smaller"),
    ],
)
def test_what_an_image_s_table_cannot_mean_is_refused(tmp_path, line, words):
    """With the file, the line and the key."""
    with pytest.raises(cmfsim.CaseError, match=words):
        load(tmp_path, HEAD + f'[image]\nfile = "ct"\n{line}\n')


WRONG = {
    "format": ('format = "cmfsim-case"', 'format = "cmfsim-scene"', 2, "format is 'cmfsim-scene'"),
    "version": ("version = 1", "version = 2", 3, "version is 2: this cmfsim reads 1"),
    "version flag": ("version = 1", "version = true", 3, "version is True"),
    "unknown table": ("[landmarks]", "[landmark]", 15, "landmark is unknown; did you mean 'landm"),
    "unknown key": ("edge_length", "edge_lenght", 25, "did you mean 'edge_length'"),
    "units": ('"cm"', '"parsec"', 8, "surfaces.units is 'parsec'"),
    "frame": ('"RAS"', '"ras"', 9, "surfaces.frame is 'ras'"),
    "no text": ('"../scans/skin.ply"', "3", 7, "surfaces.skin is 3: a text"),
    "no number": ("edge_length = 2.5", 'edge_length = "2.5"', 25, "holds '2.5': a number"),
    "range": ("edge_length = 2.5", "edge_length = -2.5", 25, "is -2.5: must be at least 1"),
    "infinity": ("edge_length = 2.5", "edge_length = inf", 25, "must be finite"),
    "nan": ("lower = -40", "lower = nan", 21, "region.lower holds nan"),
    "swapped bounds": ("upper = 120.5", "upper = -41", 21, "lower is -40, upper -41"),
    "flag": ("refine = false", "refine = 0", 26, "mesh.refine is 0: true or false"),
    "plane": ("normal = [0, 2, 0]", "normal = [0, 0, 0]", 20, "normal is (0, 0, 0)"),
    "two numbers": ("point = [0, 1, 2]", "point = [0, 1]", 20, "three numbers [x, y, z]"),
    "procedure": ('"le_fort_1"', '"le_fort_2"', 30, "did you mean 'le_fort_"),
    "no osteotomy": ('procedure = "le_fort_1"', "", 29, "osteotomies[0] needs procedure"),
    "same segment": ('name = "half"', 'name = "maxilla"', 33, "as the one on line 29 does"),
    "name": ('name = "half"', 'name = "../half"', 38, "osteotomies[1].name is not a valid name"),
    "unknown motion": ("angle = 90", "angel = 90", 42, "did you mean 'angle'"),
    "zero axis": ("axis = [0, 0, 1]", "axis = [0, 0, 0]", 43, "axis is (0, 0, 0)"),
    "no angle": ("angle = 90\n", "", 42, "axis turns nothing without an angle: give angle"),
    "no rotation": ("[[1, 0, 0, 2]", "[[2, 0, 0, 2]", 47, "matrix is not rigid"),
    "three rows": (", [0, 0, 0, 1]]", "]", 47, "four rows of four numbers"),
    "poisson": ("poisson = 0.46", "poisson = 0.5", 57, "must be above -1 and at most 0.4999"),
    "one modulus": ("poisson = 0.46\n", "", 55, "needs both young (MPa) and poisson"),
    "method": ('"cholesky"', '"cholesk"', 60, "did you mean 'cholesky'"),
    "tolerance": ("tolerance = 1e-9", "tolerance = 0", 61, "tolerance is 0"),
    "output up": ('"results/first"', '"../out"', 64, "a folder below the case's own"),
    "output absolute": ('"results/first"', '"/tmp"', 64, "a folder below the case's own"),
    "output itself": ('"results/first"', '"."', 64, "a folder below the case's own"),
    "syntax": ("lower = -40", "lower = = 40", 21, "is not TOML"),
    "twice": ("lower = -40", "lower = 1\nlower = 2", 22, "is not TOML"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_faulty_case_file_is_refused_with_line_and_key(name, tmp_path):
    """A CaseError that is a ValueError too: file, line, key, value and what is allowed."""
    old, new, line, words = WRONG[name]
    assert FULL.count(old) >= 1
    with pytest.raises(cmfsim.CaseError, match=re.escape(words)) as caught:
        load(tmp_path, FULL.replace(old, new, 1))
    assert isinstance(caught.value, ValueError)
    assert str(caught.value).startswith(f"case.toml:{line}: ")


def test_a_typed_matrix_is_made_exactly_rigid(tmp_path):
    """Four decimals pass the case file, and the solver gets what `rigid_matrix` makes of them."""
    typed = cmfsim.rigid_motion((2, 0, 0), 8, (1, 2, 0), (0, 0, 900)).round(4).tolist()
    old = "[[1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    case = load(tmp_path, FULL.replace(old, str(typed), 1))
    kept = [motion.matrix for motion in case.plan.values() if motion.matrix is not None]
    assert any(np.array_equal(m, cmfsim.rigid_matrix(typed)) for m in kept)
    assert np.abs(np.asarray(typed) - cmfsim.rigid_matrix(typed)).max() > 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "lacks 'format'"),
        (HEAD, r"needs \[image\] or \[surfaces\]"),
        (HEAD + SURFACES + '[image]\nfile = "ct.nrrd"\n', "is given together with"),
        (HEAD + '[surfaces]\nskin = "skin.ply"\n', "names no bone|lacks|bones"),
        (HEAD + SURFACES + "plan = 3\n", "case.toml:7: surfaces.bones.plan|is 3"),
        (HEAD + "osteotomies = 3\n" + SURFACES, r"write \[\[osteotomies\]\]"),
        (HEAD + SURFACES + "[plan.x]\nangle = [1]\n", "plan.x.angle holds"),
        ("\x00", "is not TOML"),
        ("a = " + "[" * 50_000, "TOML|nested"),
        ("x = 1" + "0" * 5000 + "\n" + HEAD, "TOML|unknown"),
    ],
)
def test_a_case_file_that_is_none_is_refused(text, words, tmp_path):
    """Empty, incomplete, of other types, hostile."""
    with pytest.raises(cmfsim.CaseError, match=words):
        load(tmp_path, text)


def test_files_that_are_no_case_files_are_refused(tmp_path):
    """No file, a folder, another ending, too large, not UTF-8."""
    with pytest.raises(FileNotFoundError):
        cmfsim.Case.load(tmp_path / "none.toml")
    with pytest.raises(cmfsim.CaseError, match="is a folder"):
        cmfsim.Case.load(tmp_path)
    (tmp_path / "case.json").write_text("{}", encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"ends in \.toml"):
        cmfsim.Case.load(tmp_path / "case.json")
    (tmp_path / "big.toml").write_bytes(b"# " + b"x" * 2**20)
    with pytest.raises(cmfsim.CaseError, match="bytes"):
        cmfsim.Case.load(tmp_path / "big.toml")
    (tmp_path / "raw.toml").write_bytes(b'name = "\xff"')
    with pytest.raises(cmfsim.CaseError, match="UTF-8"):
        cmfsim.Case.load(tmp_path / "raw.toml")


SKIN = 'skin = "../scans/skin.ply"'
PATHS = {
    "windows": (r'skin = "C:\Users\me\skin.ply"', "is not TOML", '"C:/Users/me/skin.ply"'),
    "share": (r'skin = "\\\\server\\data\\skin.ply"', "a path of Windows", "/mnt/"),
    "share unescaped": (r'skin = "\\server\data\skin.ply"', "is not TOML", "single quotes"),
    "drive with codes": (r'skin = "C:\new\table.ply"', "control character", "single quotes"),
    "codes": (r'skin = "new\table.ply"', "control character", "single quotes"),
    "single quotes": (r"skin = 'D:\a\skin.ply'", "a path of Windows", "/mnt/"),
    "typographic": ("skin = \u201cskin.ply\u201d", "is not TOML", "typographic"),
}


@pytest.mark.skipif(os.name == "nt", reason="Windows reads its own paths")
@pytest.mark.parametrize("name", PATHS)
def test_a_path_that_toml_or_this_system_does_not_read_has_a_remedy(name, tmp_path):
    line, *words = PATHS[name]
    with pytest.raises(cmfsim.CaseError) as caught:
        load(tmp_path, FULL.replace(SKIN, line, 1))
    said = str(caught.value)
    assert said.startswith("case.toml:")
    assert len(said) <= 400
    for word in words:
        assert word in said


@pytest.mark.skipif(os.name == "nt", reason="Windows reads its own paths")
def test_a_relative_path_with_backslashes_is_that_with_slashes(tmp_path):
    case = load(tmp_path, FULL.replace(SKIN, "skin = 'surfaces\\skin.ply'", 1))
    assert case.surfaces.skin == tmp_path / "surfaces" / "skin.ply"
    # Unless there is a file of this very name.
    (tmp_path / "surfaces\\skin.ply").write_bytes(b"")
    case = load(tmp_path, FULL.replace(SKIN, "skin = 'surfaces\\skin.ply'", 1))
    assert case.surfaces.skin.name == "surfaces\\skin.ply"


@pytest.mark.parametrize(
    ("encoding", "words"),
    [
        ("latin-1", ("line 2 is not UTF-8", "'ö' in Latin-1", "save the file as UTF-8")),
        ("utf-16", ("is UTF-16", "save it as UTF-8")),
    ],
)
def test_another_encoding_is_named_with_a_remedy(encoding, words, tmp_path):
    (tmp_path / "case.toml").write_bytes(("# a\n# Höhe\n" + FULL).encode(encoding))
    with pytest.raises(cmfsim.CaseError) as caught:
        cmfsim.Case.load(tmp_path / "case.toml")
    for word in ("case.toml", *words):
        assert word in str(caught.value)


def test_a_mark_of_utf_8_and_windows_line_ends_change_nothing(tmp_path):
    (tmp_path / "case.toml").write_bytes(FULL.replace("\n", "\r\n").encode("utf-8-sig"))
    assert cmfsim.Case.load(tmp_path / "case.toml").name == load(tmp_path, FULL).name


def test_the_posterior_plane_is_given_or_placed_from_landmarks_or_depth():
    """Coronal, 10 mm behind the roots of the arches; without them at 0.6 of the depth."""
    region = cmfsim.values.case_parts.Region()
    roots = {"supraglenoid_L": np.array([60, -100, 0.0]), "supraglenoid_R": np.array([-60, -96, 0])}
    plane = region.plane(roots, -200.0, 0.0)
    assert plane.point.tolist() == [0.0, -88.0, 0.0]
    assert plane.normal.tolist() == [0.0, 1.0, 0.0]
    assert region.plane({}, -200.0, 0.0).point.tolist() == [0.0, -80.0, 0.0]
    near = cmfsim.values.case_parts.Region(posterior_depth=-5.0)
    assert near.plane(roots, -200.0, 0.0).point.tolist() == [0.0, -103.0, 0.0]
    with pytest.raises(cmfsim.CaseError, match="supraglenoid_L and supraglenoid_R"):
        near.plane({}, -200.0, 0.0)


def test_lines_are_found_through_texts_comments_and_arrays():
    """Multi-line values, quotes in them, dotted and quoted keys, arrays of tables."""
    text = (
        "a = 1 # [x]\n"
        'b = """\n[not]\nc = 2 \\""" "still"\n"""\n'
        "d = [\n  1, # ] }\n  '#',\n]\n"
        "e.f = {g = [1,\n2]}\n"
        "\n[[t]]\nk = '''x\n'''\n"
        '  [[t]]\n"k 2".l = 1\n'
        "[t.u]\nv = '''it''''\nw = 3"
    )
    lines = toml_lines(text)
    assert lines["a",] == 1
    assert lines["b",] == 2
    assert ("not",) not in lines
    assert lines["d",] == 6
    assert lines["e", "f"] == 10
    assert lines["t",] == lines["t", 0] == 13
    assert lines["t", 0, "k"] == 14
    assert lines["t", 1] == 16
    assert lines["t", 1, "k 2", "l"] == 17
    assert lines["t", 1, "u", "v"] == 19
    assert lines["t", 1, "u", "w"] == 20
    assert line_of(lines, ("e", "f", "g")) == 10
    assert line_of(lines, ("nowhere",)) == 1


def test_a_note_is_kept_and_must_be_text(tmp_path):
    path = tmp_path / "case.toml"
    text = 'format = "cmfsim-case"\nversion = 1\n[image]\nfile = "ct.nrrd"\n'
    path.write_text(text, encoding="utf-8")
    assert cmfsim.Case.load(path).note == ""
    path.write_text('note = "a made head"\n' + text, encoding="utf-8")
    assert cmfsim.Case.load(path).note == "a made head"
    path.write_text("note = 3\n" + text, encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"case\.toml:1: note is 3"):
        cmfsim.Case.load(path)


@pytest.mark.parametrize(
    ("motion", "complaint"),
    [
        ('transform = "a.tfm"', 'case.toml:8: plan.x.transform is an ITK file.*file = "a.tfm"'),
        ('transform = "a.H5"', "does not record its direction.*from-parent.*to-parent"),
        ('transform = {file = "a.h5"}', "case.toml:8: plan.x.transform lacks direction"),
        ('transform = {file = "a.tfm", direction = "both"}', "use one of: to-parent, from-parent"),
        (
            'transform = {file = "a.tfm", direction = "to-parent", frame = "RAS"}',
            'plan.x.transform.frame is "RAS", but ITK files',
        ),
        ('transform = {file = "a.txt", frame = "LAS"}', "use one of: LPS, RAS"),
        ('transform = {direction = "to-parent"}', "lacks 'file'"),
        ("transform = 3", "a text is needed"),
        ('translation = [1, 2, 3]\nframe = "LAS"', "use one of: LPS, RAS"),
    ],
)
def test_which_way_a_transform_carries_points_is_stated(motion, complaint, tmp_path):
    """3D Slicer and ITK write the same format in opposite directions: nothing is assumed."""
    with pytest.raises(cmfsim.CaseError, match=complaint):
        load(tmp_path, f"{HEAD}{SURFACES}[plan.x]\n{motion}\n")


def test_a_plan_typed_in_ras_is_the_same_motion_in_lps(tmp_path):
    """5 mm forwards is +A in RAS and −P in LPS; x and y of the centre change sign as well."""
    rows = "[[1, 0, 0, 1], [0, 1, 0, 5], [0, 0, 1, 2], [0, 0, 0, 1]]"
    turn = "angle = 90\naxis = [0, 0, 1]\ncentre = [10, 20, 30]"
    plans = [
        f'[plan.a]\nmatrix = {rows}\nframe = "RAS"\n',
        f'[plan.b]\ntranslation = [1, 5, 2]\n{turn}\nframe = "RAS"\n',
        f"[plan.c]\ntranslation = [-1, -5, 2]\n{turn.replace('[10, 20', '[-10, -20')}\n",
    ]
    plan = load(tmp_path, HEAD + SURFACES + "".join(plans)).plan
    assert plan["a"].matrix[:3, 3].tolist() == [-1.0, -5.0, 2.0]
    np.testing.assert_allclose(plan["b"].matrix, plan["c"].matrix, rtol=0, atol=1e-12)
    assert plan["b"].centre.tolist() == plan["c"].centre.tolist()


def test_the_seam_between_the_lips_may_be_a_surface(tmp_path):
    """Beside the case; the former key of another table is refused, and says where to write it."""
    case = load(tmp_path, HEAD + SURFACES + '[lips]\ncontact = true\nseam = "seam.ply"\n')
    assert case.lips.seam == tmp_path / "seam.ply"
    former = '[mesh]\nparting = {surface = "a.ply"}\n'
    with pytest.raises(
        cmfsim.CaseError, match=r'mesh.parting was removed: .* seam = "FILE" in .lips'
    ):
        load(tmp_path, HEAD + SURFACES + former)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("contact = 1", "true or false"),
        ("depth = -1", "depth"),
        ("height = 300", "height"),
        ("gap = 2", "gap"),
        ("seam = 3", "a text is needed"),
    ],
)
def test_wrong_values_of_the_lips_name_their_line(tmp_path, line, message):
    with pytest.raises(cmfsim.CaseError, match=message) as error:
        load(tmp_path, HEAD + SURFACES + "[lips]\n" + line + "\n")
    assert "lips" in str(error.value)


DOCUMENTED = {
    "image": case_parts.CaseImage,
    "surfaces": case_parts.CaseSurfaces,
    "landmarks": case_parts.CaseLandmarks,
    "region": case_parts.Region,
    "mesh": case_parts.CaseMesh,
    "lips": case_parts.CaseLips,
    "band": case_parts.CaseBand,
    "muscles": case_parts.CaseMuscles,
    "photo": case_parts.CasePhoto,
    "bite": case_parts.CaseBite,
    "postoperative": case_parts.CasePostoperative,
}
# What a reader of the page would have no use for.
LARGEST_SHOWN = 1e9


@pytest.mark.parametrize("name", DOCUMENTED)
def test_the_page_states_each_key_with_its_unit_range_and_default(name, tmp_path):
    page = Path(__file__).parents[3].joinpath("docs", "formats.md").read_text(encoding="utf-8")
    section = page.split("## Case: `case.toml`")[1]
    table = re.search(rf"(?ms)^\[{name}\](.*?)(?:^\[\[?[a-z]|^```)", section)[1]
    # What the page has as a comment is shown by another value than its default.
    rows = {key: (mark, text) for mark, key, text in re.findall(r"(?m)^(# )?(\w+) = (.*)$", table)}
    # No field is a key that the page does not have, such as "asked" of a band.
    for key in ("nothing", "asked"):
        lines = "" if name in {"surfaces", "image"} else SURFACES
        with pytest.raises(cmfsim.CaseError, match=f"{key} is unknown"):
            load(tmp_path, f"{HEAD}{lines}[{name}]\n{key} = true\n")
    for one in fields(DOCUMENTED[name]):
        if not one.metadata:
            continue
        mark, text = rows[one.name]
        value, _, comment = text.partition("  #")
        low, high = one.metadata["range"]
        assert one.metadata["unit"] in comment
        if high is not None and high < LARGEST_SHOWN:
            ends = [f"{end:g}".replace("e+0", "e") for end in (low, high)]
            assert " to ".join(ends) in comment
        if one.default not in {None, MISSING} and not mark:
            assert toml_module().loads(f"x = {value}")["x"] == one.default
