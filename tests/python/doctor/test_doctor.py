"""A clean case gives no error and no warning; what is found in cuts, images, muscles and faces."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from diagnosed_heads import HALF_TURN, diagnosis, image_case, notes, scaled, serious

import cmfsim
from cmfsim.cli import main
from cmfsim.doctor.evidence import gather
from cmfsim.doctor.muscles import check_muscles
from cmfsim.values.landmark_sites import REFERENCE_PLACES
from head_case import HeadCase

DATA = Path(os.environ.get("CMFSIM_DATA") or Path(__file__).parents[4] / "shared/data")


def test_a_clean_case_has_no_findings(tmp_path):
    """Nothing to say about a head whose files fit together."""
    assert cmfsim.diagnose(cmfsim.Case.load(HeadCase().write(tmp_path))) == ()


def test_an_examination_shows_plan_and_findings_in_lines(tmp_path):
    head = HeadCase(rounds=2)
    head.replace("translation = [0, -4, 1]", "translation = [0, -24, 1]")
    title, plan, *found = repr(cmfsim.examine(head.write(tmp_path))).splitlines()
    assert title == "Examination"
    assert plan.startswith("  plan: mandible: 24.0 mm forwards")
    assert any(line.startswith("  warning: ") and line.endswith("[plan-far]") for line in found)


def test_what_build_mends_without_doubt_is_a_note(tmp_path):
    """An open neck, doubled and flat triangles, a tet too coarse in a few places when refined."""
    head = HeadCase()
    vertices = head.surfaces["skin"].vertices
    head.change("skin", triangles=lambda t: t[(vertices[t][:, :, 2] > 1390).all(axis=1)])
    assert notes(tmp_path, head) == ["surface-open"]
    head = HeadCase()
    head.change("skin", triangles=lambda t: np.concatenate([t, t[:3], [[5, 5, 6]]]))
    assert notes(tmp_path, head) == ["surface-degenerate"]


def test_one_bone_alone_has_landmarks_of_the_other_far_away(tmp_path):
    """The mandible without the skull is a case; landmarks turned about fit it no better."""
    head = HeadCase()
    head.replace('cranium = "cranium.ply"\n', "")
    assert "landmark-frame" not in [code for _, code in serious(tmp_path, head)]
    head.skull = {n: p * HALF_TURN for n, p in head.skull.items()}
    assert ("error", "landmark-frame") in serious(tmp_path, head)


def test_landmarks_off_the_face_after_the_operation_are_said(tmp_path):
    """Those of the skin before, on a face that came 20 mm forwards; those on it say nothing."""
    head = HeadCase()
    path = head.write(tmp_path)
    skin = head.surfaces["skin"]
    after = cmfsim.SurfaceData(skin.vertices + [0.0, -20.0, 0.0], skin.triangles)
    cmfsim.write_surface(tmp_path / "after.ply", after)
    places = {"pronasale": after.vertices[np.argmin(after.vertices[:, 1])]}
    more = '\n[postoperative]\nskin = "after.ply"\nlandmarks = "after.mrk.json"\n'
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    for shift, expected in ((0.0, False), (30.0, True)):
        moved = {name: place - [0.0, shift, 0.0] for name, place in places.items()}
        cmfsim.write_landmarks(tmp_path / "after.mrk.json", moved)
        found = [f.code for f in cmfsim.diagnose(cmfsim.Case.load(path))]
        assert ("landmarks-off" in found) == expected


def test_an_unstated_landmark_frame_is_said(tmp_path):
    """Neither file nor case says whether it is LPS: a warning; if the case says, a note."""
    head = HeadCase()
    head.write(tmp_path)
    path = tmp_path / "bare.mrk.json"
    text = (tmp_path / "skull.mrk.json").read_text(encoding="utf-8")
    path.write_text(text.replace('"coordinateSystem": "LPS",', ""), encoding="utf-8")
    head.replace("skull.mrk.json", "bare.mrk.json")
    assert serious(tmp_path, head) == [("warning", "frame-unstated")]
    head.replace("[landmarks]", '[landmarks]\nframe = "LPS"')
    assert notes(tmp_path, head) == ["frame-unstated"]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n",
        b"solid nothing\nendsolid nothing\n",
        b"\x00" * 500,
    ],
)
def test_a_surface_that_cannot_be_read_is_one_error(content, tmp_path):
    """Empty, cut short, without triangles, no surface at all: named, and nothing else happens."""
    path = HeadCase().write(tmp_path)
    name = "mandible.stl" if content.startswith(b"solid") else "mandible.ply"
    (tmp_path / name).write_bytes(content)
    path.write_text(path.read_text("utf-8").replace("mandible.ply", name), encoding="utf-8")
    before = sorted(p.name for p in tmp_path.iterdir())
    findings = cmfsim.diagnose(cmfsim.Case.load(path))
    codes = [f.code for f in findings if f.severity == "error"]
    assert codes == ["input-unreadable" if content else "file-missing"]
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_a_truncated_surface_is_unreadable(tmp_path):
    """A PLY cut in the middle of its triangles."""
    path = HeadCase().write(tmp_path)
    whole = (tmp_path / "skin.ply").read_bytes()
    (tmp_path / "skin.ply").write_bytes(whole[: len(whole) // 2])
    findings = cmfsim.diagnose(cmfsim.Case.load(path))
    assert [f.code for f in findings] == ["input-unreadable"]


def test_nan_in_a_surface_is_named_with_its_row(tmp_path):
    """The finding names the vertex."""
    path = HeadCase().write(tmp_path)
    (tmp_path / "skin.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", encoding="utf-8")
    path.write_text(path.read_text("utf-8").replace("skin.ply", "skin.obj"), encoding="utf-8")
    (finding,) = cmfsim.diagnose(cmfsim.Case.load(path))
    assert finding.code == "input-unreadable"
    assert "line 2: 'nan' is not finite" in finding.what


# Cuts, transforms, images.


def with_cut(head, table):
    head.replace("[tissue]", f"[[osteotomies]]\n{table}\n\n[tissue]")


def test_a_procedure_without_its_landmarks_or_with_a_wrong_option_is_said(tmp_path):
    """Le Fort I needs the second molars' points; one missing is estimated, both are asked for."""
    head = HeadCase()
    with_cut(head, 'procedure = "le_fort_1"')
    head.replace("[landmarks]", "[landmarks]\nautomatic = false")
    # The head of these tests is small, which a cut by distances in mm is warned of.
    small = ("warning", "cut-small-head")
    assert serious(tmp_path, head) == [small]
    del head.skull["supra_m2_L"]
    assert set(serious(tmp_path, head)) == {small, ("warning", "cut-site-estimated")}
    head.skull = {name: head.skull[name] for name in ("menton", "pogonion")}
    (finding,) = (f for f in diagnosis(tmp_path, head) if f.severity == "error")
    assert finding.code == "landmark-missing"
    assert "supra_m2_L" in finding.what
    head = HeadCase()
    with_cut(head, 'procedure = "le_fort_1"\nheight = 400')
    assert serious(tmp_path, head) == [("error", "cut-options")]


def test_the_motion_of_a_cut_segment_is_measured_on_its_bone(tmp_path):
    """A turn about the origin moves the front half of the mandible by more than 60 mm."""
    head = HeadCase()
    with_cut(
        head,
        "plane = {point = [0, -128, 1445], normal = [0, -1, 0]}\n"
        'bone = "mandible"\nname = "half"\n[plan.half]\nangle = 3',
    )
    (finding,) = (f for f in diagnosis(tmp_path, head) if f.severity != "note")
    assert (finding.severity, finding.code) == ("error", "plan-far")
    # 2 sin(θ/2) times the distance from the axis, the L axis, at the front of the mandible.
    far = 2 * np.sin(np.radians(1.5)) * np.hypot(1463, 158)
    assert float(finding.what.split(" mm")[0].split()[-1]) == pytest.approx(far, rel=0.02)


def test_a_transform_file_is_read_for_its_motion(tmp_path):
    """A 4 × 4 text moves the bone too far; a broken one cannot be read."""
    head = HeadCase()
    motion = "translation = [0, -4, 1]\nangle = 2\naxis = [1, 0, 0]\ncentre = [3, -100, 1450]"
    head.replace(motion, 'transform = "jaw.txt"')
    np.savetxt(tmp_path / "jaw.txt", cmfsim.rigid_motion(translation=(0, 30, 0)))
    assert serious(tmp_path, head) == [("warning", "plan-far")]
    (tmp_path / "jaw.txt").write_text("1 2 3\n", encoding="utf-8")
    assert serious(tmp_path, head) == [("error", "input-unreadable")]


def with_muscles(head, kept=None):
    """The case with muscles, and the landmarks of an average head that are kept."""
    head.toml += "\n[muscles]\n"
    head.replace("[landmarks]", "[landmarks]\nautomatic = false")
    places = REFERENCE_PLACES["skull"]
    # On no surface of the ellipsoids: what is asked for here is names alone.
    head.skull = {name: places[name] + [3.0, -100.0, 1500.0] for name in kept or places}
    return head


def muscle_findings(folder, head):
    """Severity, code and text of findings about muscles."""
    case = cmfsim.Case.load(head.write(folder))
    codes = ("template-landmarks", "muscles-left-out", "template-landmarks-missing")
    return [(f.severity, f.code, f.what) for f in check_muscles(gather(case)) if f.code in codes]


def test_missing_landmarks_are_a_warning_that_names_them(tmp_path):
    """One of 32 was an error that blocked every model; six are enough, three are not."""
    names = [*HeadCase().skull]
    assert muscle_findings(tmp_path, with_muscles(HeadCase())) == []
    head = with_muscles(HeadCase())
    del head.skull["nasion"]
    ((severity, code, what),) = muscle_findings(tmp_path, head)
    assert (severity, code) == ("warning", "template-landmarks-missing")
    assert "1 of the template's 32 landmarks are missing: nasion;" in what
    six = ("nasion", "menton", "gonion_L", "gonion_R", "zygomatic_arch_L", "zygomatic_arch_R")
    ((severity, _, what),) = muscle_findings(tmp_path, with_muscles(HeadCase(), six))
    assert severity == "warning"
    assert "26 of" in what
    found = muscle_findings(tmp_path, with_muscles(HeadCase(), names[:3]))
    assert [(s, c) for s, c, _ in found] == [("warning", "muscles-left-out")]


def test_muscles_are_checked_only_for_models_that_have_them(tmp_path):
    """Three landmarks place no muscle, and a homogeneous model needs none."""
    head = HeadCase()
    head.toml += "\n[muscles]\n"
    head.replace("[landmarks]", "[landmarks]\nautomatic = false")
    head.skull = {n: head.skull[n] for n in ("nasion", "menton", "pogonion")}
    for models, count in ((["H"], 0), (["H", "H+S"], 0), (["M"], 1), (["H", "M+S"], 1), (None, 1)):
        case = cmfsim.Case.load(head.write(tmp_path))
        found = [f for f in cmfsim.diagnose(case, models=models) if f.code == "muscles-left-out"]
        assert len(found) == count, models


def test_the_command_states_that_it_has_not_segmented_an_image(tmp_path, capsys):
    path = image_case(tmp_path, 2.5).write(tmp_path)
    main(["doctor", str(path), "--json", "-q"])
    (found,) = [
        f for f in json.loads(capsys.readouterr().out)["findings"] if f["code"] == "not-segmented"
    ]
    assert found["severity"] == "note"
    assert "cmfsim landmarks" in found["fix"]
    # Of the other commands the work itself follows.
    assert "not-segmented" not in {f.code for f in cmfsim.diagnose(cmfsim.Case.load(path))}


def test_an_image_is_compared_with_its_landmarks_and_its_voxels_are_looked_at(tmp_path):
    """Fine and fitting: nothing; coarse, in another frame, of another patient, damaged: said."""
    head = image_case(tmp_path, 2.5)
    assert serious(tmp_path, head) == []
    assert serious(tmp_path, image_case(tmp_path, 3.0)) == [("warning", "ct-spacing-coarse")]
    head = image_case(tmp_path, 2.5)
    head.skull = {n: p * HALF_TURN for n, p in head.skull.items()}
    assert serious(tmp_path, head) == [("error", "landmark-frame")]
    head.skull = {n: p + [0, 0, 900.0] for n, p in HeadCase().skull.items()}
    assert serious(tmp_path, head) == [("error", "landmark-outside-image")]
    (tmp_path / "ct.nrrd").write_bytes(b"NRRD0004\n")
    head.skull = HeadCase().skull
    assert serious(tmp_path, head) == [("error", "input-unreadable")]


# The command.


def test_the_command_prints_plain_lines_and_exits_with_0(tmp_path, capsys):
    """No colour in a pipe, no errors: 0."""
    assert main(["doctor", str(HeadCase().write(tmp_path))]) == 0
    out, err = capsys.readouterr()
    plan, findings = out.splitlines()
    assert plan.startswith("plan: mandible: 4.0 mm forwards")
    assert findings == "nothing found"
    assert "\x1b" not in out + err


def test_the_command_exits_with_2_on_an_error_and_speaks_json(tmp_path, capsys):
    """`--json` gives every part of every finding and the counts."""
    head = HeadCase()
    scaled(head, 0.001)
    path = head.write(tmp_path)
    assert main(["doctor", str(path), "--json", "-q"]) == 2
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert err == ""
    assert report["errors"] == 1
    assert report["findings"][0]["code"] == "surface-units"
    assert set(report["findings"][0]) == {"severity", "code", "what", "where", "why", "fix"}
    assert main(["doctor", str(path), "-q"]) == 2
    assert "surface-units" in capsys.readouterr().out


def test_names_from_files_cannot_steer_the_terminal(tmp_path, capsys):
    """A label with an escape sequence is printed as its code."""
    head = HeadCase()
    head.skull = head.skull | {"bad\x1b[2J": head.skull["nasion"] + [0, -40.0, 0]}
    assert main(["doctor", str(head.write(tmp_path))]) == 2
    out, _ = capsys.readouterr()
    assert "\x1b" not in out
    assert "\\x1b[2J" in out


def test_a_case_file_that_cannot_be_read_exits_with_2(tmp_path, capsys):
    """The error names file and line."""
    head = HeadCase()
    head.replace("edge_length = 4.0", "edge_lenght = 4.0")
    assert main(["doctor", str(head.write(tmp_path))]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "case.toml:19: mesh.edge_lenght is unknown; did you mean 'edge_length'?" in err


# Real anatomy.


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real data at {DATA}")
@pytest.mark.parametrize("skin", ["skin.ply", "skin_open.ply"])
def test_the_atlas_head_has_no_error(skin, tmp_path):
    """Closed and open skin with two bones, landmarks and an ordinary plan."""
    folder = DATA / "atlas_head"
    text = f"""format = "cmfsim-case"
version = 1
[surfaces]
skin = "{folder / skin}"
[surfaces.bones]
cranium = "{folder / "cranium.ply"}"
mandible = "{folder / "mandible.ply"}"
[landmarks]
skull = "{folder / "skull_landmarks.mrk.json"}"
skin = "{folder / "skin_landmarks.mrk.json"}"
[[osteotomies]]
procedure = "le_fort_1"
[plan.maxilla]
translation = [0, -5, 0]
[plan.mandible]
translation = [0, -4, 0]
"""
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    findings = cmfsim.diagnose(cmfsim.Case.load(path))
    assert not [f for f in findings if f.severity != "note"]
    assert any(f.code == "surface-open" for f in findings) == (skin == "skin_open.ply")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real data at {DATA}")
def test_the_ct_of_the_phantom_has_no_error(tmp_path):
    """Image and landmarks with three procedures, which may have a warning about the chin."""
    pytest.importorskip("SimpleITK")
    folder = DATA / "ct_phantom"
    cuts = ("le_fort_1", "bsso", "genioplasty")
    text = f"""format = "cmfsim-case"
version = 1
[image]
file = "{folder / "ct.nii.gz"}"
[landmarks]
skull = "{folder / "skull_landmarks.mrk.json"}"
skin = "{folder / "skin_landmarks.mrk.json"}"
""" + "".join(f'[[osteotomies]]\nprocedure = "{cut}"\n' for cut in cuts)
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    findings = cmfsim.diagnose(cmfsim.Case.load(path))
    assert not [f for f in findings if f.severity == "error"]
