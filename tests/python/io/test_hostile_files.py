"""Scenes, plans, archives and landmarks from strangers: bounded, inside their folder, and named."""

import io
import json
import os
import zipfile

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.io.cases.tables import read_tables
from cmfsim.io.cases.template_archives import read_template_archive
from cmfsim.io.files.archives import read_archive

NODES, TETS = meshes.box((2, 2, 2), (4.0, 4.0, 4.0))
LOW = meshes.nodes_where(NODES[:, 2] == 0.0)
HIGH = meshes.nodes_where(NODES[:, 2] == 4.0)


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.npz"
    given = cmfsim.Scene(
        nodes=NODES,
        tets=TETS,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
        fixed=LOW,
        segments={"bone": cmfsim.SegmentData(joined=HIGH)},
        plan={"bone": np.eye(4)},
    )
    cmfsim.write_scene(path, given)
    return path


def packed(array, *, header=None):
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(array), allow_pickle=True)
    data = file.getvalue()
    return data if header is None else np.lib.format.MAGIC_PREFIX + header


def rewritten(path, changes, header=None):
    """The archive with other members; `header` changes its JSON text."""
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    if header is not None:
        text = json.loads(str(np.load(io.BytesIO(contents["scene.npy"]))))
        contents["scene.npy"] = packed(np.array(json.dumps({**text, **header})))
    contents |= changes
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return path


def refused(call, match):
    with pytest.raises(cmfsim.CmfsimError, match=match) as caught:
        call()
    assert isinstance(caught.value, ValueError)


# Units.


@pytest.mark.parametrize(
    ("units", "match"),
    [
        ({"length": "m"}, "units.length is 'm': only 'mm' is read. Convert every length"),
        ({"length": "mm", "stress": "kPa"}, "units.stress is 'kPa': only 'MPa'"),
        ({"force": "mN"}, "units.force is 'mN'"),
        ({"angle": "rad"}, "unknown key 'angle'"),
        ("mm", "a table of names and units"),
        (["mm"], "a table of names and units"),
    ],
)
def test_units_of_a_scene_and_of_a_plan_are_not_passed_over(units, match, scene, tmp_path):
    """A scene in metres was read as one in millimetres, exit code 0."""
    given = cmfsim.read_scene(scene)
    refused(lambda: cmfsim.read_scene(rewritten(scene, {}, {"units": units})), match)
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps({"units": units, "plan": {"bone": {"translation": [0, 0, 5]}}}))
    refused(lambda: cmfsim.read_plan(plan, given), match)
    plan.write_text(json.dumps({"plan": {"bone": {}}, "unit": "m"}))
    refused(
        lambda: cmfsim.read_plan(plan, given), r"^plan.json: unit is unknown; did you mean 'units'"
    )
    text = "".join(f"{k} = {v!r}\n" for k, v in units.items()) if isinstance(units, dict) else ""
    if text:
        toml = tmp_path / "scene.toml"
        toml.write_text(f'format = "cmfsim-scene"\nversion = 1\n[units]\n{text}')
        refused(lambda: cmfsim.read_scene(toml), match)


def test_the_usual_units_may_stand_there(scene, tmp_path):
    given = cmfsim.read_scene(scene)
    plan = tmp_path / "plan.toml"
    plan.write_text('[units]\nlength = "mm"\n[plan.bone]\ntranslation = [0, 0, 5]\n')
    assert cmfsim.read_plan(plan, given)["bone"][2, 3] == 5.0


# Archives.


def bomb():
    """A header of 8 GiB of zeros, and 8 MiB of them packed to 8 KiB."""
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1073741824,), }\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(2**23)


def test_members_that_nobody_asks_for_are_not_unpacked(scene):
    """A bomb and a pickle beside the arrays that are read change nothing."""
    more = {
        "bomb.npy": bomb(),
        "zeros.npy": packed(np.zeros(2**24)),
        "object.npy": packed(np.array([{}], dtype=object)),
    }
    header, arrays = read_archive(rewritten(scene, more), "cmfsim-scene", "scene")
    assert header["segments"][0]["name"] == "bone"
    assert np.array_equal(arrays["nodes"], NODES)


@pytest.mark.parametrize("name", ["loadt", "segment.1.joined", "tissue.fraction", "Nodes"])
def test_a_scene_takes_no_array_that_is_none_of_its_own(name, scene):
    """`loads` with one letter changed would be no loads at all."""
    path = rewritten(scene, {f"{name}.npy": packed(np.zeros(3))})
    refused(
        lambda: cmfsim.read_scene(path),
        f"has the array '{name}', which does not belong to this scen",
    )


@pytest.mark.parametrize(
    "header",
    [
        {"conflictt": "resolve"},
        {"segments": [{"name": "bone", "motion": "array", "creasd_angle": 20.0}]},
    ],
)
def test_a_scene_takes_no_key_that_is_none_of_its_own(header, scene):
    refused(lambda: cmfsim.read_scene(rewritten(scene, {}, header)), "has the unknown key")


def test_an_array_that_states_more_than_it_has_is_refused_before_memory_is_taken(scene):
    refused(
        lambda: cmfsim.read_scene(rewritten(scene, {"nodes.npy": bomb()})),
        "array 'nodes' states float64 of shape .1073741824,., 8589934592 bytes, and has 8388608",
    )


def test_what_unpacks_to_hundreds_of_times_its_size_is_refused(scene, monkeypatch):
    monkeypatch.setattr("cmfsim.io.files.archives.FREE", 2**20)
    path = rewritten(scene, {"loads.npy": packed(np.zeros((2**18, 3)))})
    refused(lambda: cmfsim.read_scene(path), "array 'loads' unpacks to .* more are read of an arch")


def test_archives_of_very_many_members_are_refused(scene, monkeypatch):
    monkeypatch.setattr("cmfsim.io.files.archives.MAX_MEMBERS", 20)
    path = rewritten(scene, {f"x{i}.npy": b"" for i in range(20)})
    refused(lambda: cmfsim.read_scene(path), "members")


BAD_MEMBERS = {
    "another format": b"no numpy",
    "empty": b"",
    "version 9": packed([0.0]).replace(b"NUMPY\x01", b"NUMPY\x09"),
    "a header cut short": packed([0.0])[:9],
    "no Python": packed(0, header=b"\x01\x00\x04\x00{'a\n"),
    "brackets": packed(0, header=b"\x01\x00\xe8\x03" + b"(" * 1000),
    "minus": packed(0, header=b"\x01\x00\xe8\x03" + b"-" * 999 + b"1"),
    "a long number": packed(0, header=b"\x01\x00\x88\x13" + b"9" * 5000),
    "not text": packed(0, header=b"\x01\x00\x04\x00\xff\xfe\x00\x01"),
    "fields": packed(np.zeros(3, dtype=[("a", "f8")])),
    "objects": packed(np.array([[1, {}, 3]], dtype=object)),
    "negative": packed([[0.0]]).replace(b"(1, 1)", b"(-1, -1)"),
    "cut short": packed(NODES)[:-8],
    "too long": packed(NODES) + b"1",
    "imaginary": packed(NODES * 1j),
    "text": packed(NODES.astype(str)),
}


@pytest.mark.parametrize("fault", BAD_MEMBERS)
def test_a_damaged_member_is_named(fault, scene):
    path = rewritten(scene, {"nodes.npy": BAD_MEMBERS[fault]})
    refused(lambda: cmfsim.read_scene(path), r"scene.npz: (array 'nodes'|nodes has dtype)")


def test_every_cut_of_an_archive_is_refused(scene):
    whole = scene.read_bytes()
    for length in range(0, len(whole), 37):
        scene.write_bytes(whole[:length])
        refused(lambda: cmfsim.read_scene(scene), "scene.npz: ")


@pytest.mark.parametrize("name", ["readme.txt", "loads.npz", "", "load\0.npy"])
def test_a_member_that_is_no_array_is_refused(name, scene):
    """One letter of a name is not covered by any checksum: the loads would be gone."""
    whole = rewritten(scene, {"loads.npy": packed(np.zeros((27, 3)))}).read_bytes()
    at = whole.rindex(b"loads.npy")
    scene.write_bytes(whole[:at] + name.encode().ljust(9, b"x")[:9] + whole[at + 9 :])
    refused(lambda: cmfsim.read_scene(scene), "has the member|cannot be read|has the array")


def test_two_members_of_one_name_are_refused(scene):
    with zipfile.ZipFile(scene, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("nodes.npy", packed(NODES + 1.0))
    refused(lambda: cmfsim.read_scene(scene), "1 members of the same name")


def test_concepts_of_an_archive_are_a_list(tmp_path):
    head = {"format": "cmfsim-template", "version": 1, "muscles": [{"name": "a", "concepts": 5}]}
    path = tmp_path / "t.npz"
    arrays = {"vertices": np.zeros((3, 0)), "course": np.zeros((3, 0))}
    arrays |= {"triangle_steps": np.zeros(0, np.int32), "landmarks": np.zeros((0, 3))}
    np.savez(path, template=np.array(json.dumps({**head, "skull": {}})), **arrays)
    refused(lambda: read_template_archive(path), "concepts of a are 5")


def test_a_name_twice_in_one_table_is_refused(scene, tmp_path):
    """JSON's usual reader takes the last of two values in silence."""
    given = cmfsim.read_scene(scene)
    (tmp_path / "plan.json").write_text(
        '{"plan": {"bone": {"translation": [0, 0, 5], "translation": [0, 0, -5]}}}'
    )
    refused(lambda: cmfsim.read_plan(tmp_path / "plan.json", given), "'translation' appears tw")
    (tmp_path / "a.mrk.json").write_text(
        '{"markups": [{"controlPoints": [{"label": "a", "position": [0, 0, 0], '
        '"position": [0, 0, 1]}]}]}'
    )
    refused(lambda: cmfsim.read_landmarks(tmp_path / "a.mrk.json"), "'position' appears twice")


# Long numbers and deep keys.

LONG = "9" * 400


@pytest.mark.parametrize("number", [LONG, "9" * 5000, "-" + LONG])
def test_numbers_of_hundreds_of_digits_are_refused(number, scene, tmp_path):
    given = cmfsim.read_scene(scene)
    for name, text in (
        ("plan.json", f'{{"plan": {{"bone": {{"angle": {number}}}}}}}'),
        ("plan.json", f'{{"plan": {{"bone": {{"matrix": [[1, {number}]]}}}}}}'),
        ("plan.toml", f"plan.bone.angle = {number}"),
    ):
        (tmp_path / name).write_text(text)
        refused(lambda name=name: cmfsim.read_plan(tmp_path / name, given), "digits")
    point = {"label": "nasion", "position": [0, 0, 1]}
    text = json.dumps({"markups": [{"coordinateSystem": "LPS", "controlPoints": [point]}]})
    (tmp_path / "skull.mrk.json").write_text(text.replace("[0, 0, 1]", f"[0, 0, {number}]"))
    refused(lambda: cmfsim.read_landmarks(tmp_path / "skull.mrk.json"), "digits")
    (tmp_path / "skull.fcsv").write_text(
        f"# CoordinateSystem = LPS\n1,0,0,{number},0,0,0,1,1,1,0,n"
    )
    refused(lambda: cmfsim.read_landmarks(tmp_path / "skull.fcsv"), "finite")
    (tmp_path / "case.toml").write_text(f'format = "cmfsim-case"\nversion = {number}\n')
    refused(lambda: cmfsim.Case.load(tmp_path / "case.toml"), "case.toml.*digits")
    refused(lambda: cmfsim.TissueData("isotropic", young=int(LONG), poisson=0.4), "dtype object")
    refused(lambda: cmfsim.SurfaceData(NODES, TETS[:, :3], int(LONG)), "more than 308 digits")


@pytest.mark.parametrize(
    "text",
    [
        ".".join(["a"] * 40) + " = 1",
        "[" + ".".join(["a"] * 40) + "]",
        "[[" + " . ".join(["a"] * 40) + "]]",
        "x = {" + ".".join(["a"] * 40) + " = 1}",
        ".".join(['"a b"'] * 20 + ["'c'"] * 20) + " = 1",
        ".".join(["a"] * 500_000) + " = 1",
    ],
)
def test_keys_of_many_parts_are_refused_with_their_line(text, scene, tmp_path):
    """A MiB of them took 1.6 GB."""
    path = tmp_path / "case.toml"
    path.write_text(f"# first\n{text}\n")
    refused(lambda: cmfsim.Case.load(path), "line 2: a key has more than 8 parts")
    given = cmfsim.read_scene(scene)
    refused(lambda: cmfsim.read_plan(path, given), "line 2: a key has more than 8 parts")


def test_texts_with_many_points_are_no_deep_keys(tmp_path):
    path = tmp_path / "case.toml"
    note = " . ".join(["a"] * 50) + "..." * 99
    path.write_text(f"# {'.'.join('ab')}\nnote = '''{note}'''\nlist = [{'1.5, ' * 99}]\n")
    assert read_tables(path).text("note") == note


@pytest.mark.parametrize("text", ["x = " + "[" * 50_000, "x = " + "{a=" * 50_000, "[" * 99_999])
def test_deep_brackets_are_refused(text, scene, tmp_path):
    given = cmfsim.read_scene(scene)
    for name in ("plan.toml", "plan.json"):
        (tmp_path / name).write_text(text)
        refused(lambda name=name: cmfsim.read_plan(tmp_path / name, given), name)


# Names.


def test_a_home_folder_of_nobody_is_named_with_its_line(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(
        'format = "cmfsim-case"\nversion = 1\n[image]\nfile = "~nosuchuser/x.nrrd"\n[osteotomies]\n'
    )
    refused(lambda: cmfsim.Case.load(path), r"case.toml:4: image.file is '~nosuchuser/x.nrrd': no")
    path = tmp_path / "cohort.toml"
    path.write_text('format = "cmfsim-cohort"\nversion = 1\n[[cases]]\nfile = "~nosuchuser/x"\n')
    refused(lambda: cmfsim.Cohort.load(path), "cohort.toml:4: .*~nosuchuser")


def readers(scene):
    given = cmfsim.read_scene(scene)
    return {
        ".npz": cmfsim.read_scene,
        ".toml": cmfsim.read_scene,
        ".json": lambda path: cmfsim.read_plan(path, given),
        ".fcsv": cmfsim.read_landmarks,
        ".mrk.json": cmfsim.read_landmarks,
    }


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with a name are POSIX")
def test_no_reader_waits_for_a_pipe(scene, tmp_path):
    for suffix, read in readers(scene).items():
        path = tmp_path / f"pipe{suffix}"
        os.mkfifo(path)
        refused(lambda read=read, path=path: read(path), "pipe or a device")
    os.mkfifo(tmp_path / "case.toml")
    refused(lambda: cmfsim.Case.load(tmp_path / "case.toml"), "pipe or a device")


def test_no_reader_fails_on_a_strange_name(scene, tmp_path):
    for suffix, read in readers(scene).items():
        refused(
            lambda read=read, suffix=suffix: read("a\0b" + suffix),
            "which no file name can have|not a valid file name",
        )
        refused(lambda read=read, suffix=suffix: read("a" * 999 + suffix), "cannot be opened")
        (tmp_path / f"folder{suffix}").mkdir()
        refused(lambda r=read, s=suffix: r(tmp_path / f"folder{s}"), "is a folder")
        with pytest.raises(FileNotFoundError):
            read(tmp_path / f"absent{suffix}")


NAMELESS = "a" * 5000


def test_names_that_no_file_can_have_are_refused_by_every_reader(tmp_path):
    """Python's own Path.exists raises an OSError for them."""
    pytest.importorskip("SimpleITK")
    for read, name in (
        (cmfsim.read_image, NAMELESS),
        (cmfsim.read_transform, NAMELESS + ".tfm"),
        (cmfsim.Case.load, NAMELESS),
        (cmfsim.Cohort.load, NAMELESS),
        (cmfsim.MuscleTemplate.load, NAMELESS),
        (cmfsim.io.read_parts, NAMELESS),
    ):
        refused(lambda read=read, name=name: read(tmp_path / name), "cannot be opened")
    refused(lambda: cmfsim.MuscleTemplate.load(NAMELESS), "cannot be opened")


@pytest.mark.parametrize("key", ["image", "output", "landmarks", "cohort"])
def test_names_in_a_case_that_no_file_can_have_are_refused_with_their_line(key, tmp_path):
    image = f'file = "{NAMELESS if key == "image" else "ct.nrrd"}"'
    lines = ['format = "cmfsim-case"', "version = 1", "[image]", image, "[osteotomies]"]
    if key == "output":
        lines += ["[output]", f'folder = "{NAMELESS}"']
    if key == "landmarks":
        lines += ["[landmarks]", f'skin = "{NAMELESS}"']
    path, load = tmp_path / "case.toml", cmfsim.Case.load
    if key == "cohort":
        lines = ['format = "cmfsim-cohort"', "version = 1", "[[cases]]", f'file = "{NAMELESS}"']
        path, load = tmp_path / "cohort.toml", cmfsim.Cohort.load
    path.write_text("\n".join(lines))
    line = len(lines) if key != "image" else 4
    refused(lambda: load(path), rf"{path.name}:{line}: .*names aaa.*cannot be opened")


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_plan_reads_nothing_outside_its_folder(scene, tmp_path):
    """Not by a link either, nor one that leads round in a circle."""
    given = cmfsim.read_scene(scene)
    inside = tmp_path / "inside"
    inside.mkdir()
    vertices, triangles = meshes.icosphere(1, 5.0)
    cmfsim.write_surface(tmp_path / "bone.ply", cmfsim.SurfaceData(vertices, triangles))
    cmfsim.write_surface(inside / "here.ply", cmfsim.SurfaceData(vertices, triangles))
    (inside / "link.ply").symlink_to("../bone.ply")
    (inside / "round.ply").symlink_to("round.ply")
    (inside / "folder").symlink_to(tmp_path, target_is_directory=True)
    plan = inside / "plan.toml"
    names = ["link.ply", "round.ply", "folder/bone.ply", "../bone.ply", "C:bone.ply", "a\\\\b.ply"]
    for name in [*names, str(tmp_path / "bone.ply"), "a\\u0000b"]:
        plan.write_text(f'[plan.bone]\nsurface = "here.ply"\nmoved_surface = "{name}"\n')
        refused(
            lambda: cmfsim.read_plan(plan, given), "a file in the same folder or below is needed"
        )
    plan.write_text('[plan.bone]\nsurface = "here.ply"\nmoved_surface = "here.ply"\n')
    cmfsim.read_plan(plan, given)


def test_an_archive_of_another_kind_is_refused(scene):
    refused(lambda: read_archive(scene, "cmfsim-result", "scene"), "format is 'cmfsim-scene'")
