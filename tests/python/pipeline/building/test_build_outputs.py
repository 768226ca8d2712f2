"""What `cmfsim build` writes or leaves where a stage fails, and meshes from elsewhere."""

import dataclasses
import errno
import json
import logging
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from build_runs import PICTURES, run

import cmfsim
from cmfsim.io.results import result_files
from cmfsim.pipeline.building import case_model
from cmfsim.pipeline.outputs import model as model_output
from head_case import HeadCase

pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")
meshio = pytest.importorskip("meshio", reason="needs meshio (pip install '.[mesh]')")


@pytest.fixture
def ellipsoids(tmp_path):
    """A small case that builds in a second, and its folder."""
    head = HeadCase()
    head.replace("edge_length = 4.0", "edge_length = 14.0")
    return head.write(tmp_path)


@pytest.fixture
def before(ellipsoids):
    """The files of an earlier build, which a later one may replace or leave, not damage."""
    folder = ellipsoids.parent / "out"
    folder.mkdir()
    for name in ("scene.npz", "tissue.vtu", "skin.ply", "segment-old.ply", "anatomy.png"):
        (folder / name).write_text(f"old {name}", encoding="utf-8")
    files = sorted([*contents(folder), "build.json", "../../escape.ply", "notes.txt"])
    (folder / "build.json").write_text(json.dumps({"files": files}), encoding="utf-8")
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    return contents(folder)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="session")
def small_model(tmp_path_factory):
    """The model of the small case, for tests of writing."""
    head = HeadCase()
    head.replace("edge_length = 4.0", "edge_length = 14.0")
    return cmfsim.build_model(cmfsim.Case.load(head.write(tmp_path_factory.mktemp("small"))))


@pytest.fixture
def ready(monkeypatch, small_model):
    """Leaves out all work before the writing."""
    monkeypatch.setattr(model_output, "build_model", lambda *_, **__: small_model)


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (cmfsim.MeshError("no tet fits"), 1, "no tet fits"),
        (FULL, 1, "No space left"),
        (MemoryError(), 1, "MemoryError"),
        (KeyboardInterrupt(), 1, "stopped"),
    ],
)
@pytest.mark.parametrize(
    "stage", ["read_anatomy", "cut_bones", "tissue_mesh", "segment_data", "write_model"]
)
def test_a_stage_that_fails_leaves_the_old_results(
    stage, error, code, said, ellipsoids, before, monkeypatch, small_model
):
    def fail(*_, **__):
        raise error

    if stage in {"tissue_mesh", "segment_data"}:
        # The stages before it have been seen to work.
        monkeypatch.setattr(case_model, "read_anatomy", lambda *_: (small_model.anatomy, ()))
    if stage == "write_model":
        monkeypatch.setattr(model_output, "build_model", lambda *_, **__: small_model)
    owner = {"write_model": model_output}.get(stage, case_model)
    monkeypatch.setattr(owner, stage, fail)
    found, out, err = run("build", ellipsoids, "-q", "--no-doctor")
    assert (found, out) == (code, "")
    assert said in err
    assert contents(ellipsoids.parent / "out") == before


@pytest.mark.parametrize("error", [FULL, KeyboardInterrupt(), MemoryError()])
@pytest.mark.parametrize("call", ["write_scene", "write_surface", "_write_tissue", "draw", "move"])
def test_writing_that_fails_half_way_leaves_the_old_results(
    call, error, ready, ellipsoids, before, monkeypatch
):
    """Disk full or Ctrl-C, in any file, in a picture, or while files take their places."""
    del ready
    calls = []

    def fail(*arguments, **options):
        calls.append(arguments)
        if len(calls) > (3 if call == "move" else 0):
            raise error
        return real(*arguments, **options)

    owner, name = {"draw": (model_output, "picture_anatomy"), "move": (Path, "replace")}.get(
        call, (result_files, call)
    )
    real = getattr(owner, name)
    with monkeypatch.context() as patch:
        if call != "draw":
            patch.setattr(model_output, "_draw", lambda *_: [])
        if call == "move":
            folder = ellipsoids.parent / "out"

            def move(path, target):
                # Files on their way into the folder, but not those that come back.
                into = Path(target).parent == folder and path.parent.name != "old"
                return fail(path, target) if into else real(path, target)

            patch.setattr(Path, "replace", move)
        else:
            patch.setattr(owner, name, fail)
        found, out, err = run("build", ellipsoids, "-q", "--no-doctor")
    assert calls
    assert (found, out) == (1, "")
    assert err.startswith("cmfsim: ")
    assert contents(ellipsoids.parent / "out") == before


def test_a_later_build_takes_its_own_old_files_away_and_no_others(ready, ellipsoids, before):
    """A segment that is no longer cut; what a person put beside it stays."""
    del ready
    folder = ellipsoids.parent / "out"
    outside = ellipsoids.parent.parent / "escape.ply"
    outside.write_text("not yours", encoding="utf-8")
    code, out, _ = run("build", ellipsoids, "-q", "--no-doctor", "--json")
    assert code == 0
    summary = json.loads(out)
    assert summary["output"] == str(folder)
    assert {path.name for path in folder.iterdir()} == {*summary["files"], "notes.txt"}
    assert (folder / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert outside.read_text(encoding="utf-8") == "not yours"
    assert "segment-old.ply" in before


def test_segments_of_any_name_have_files_of_their_own(tmp_path, small_model):
    """Letters of other scripts, capitals alone, digits: names that a case file allows."""
    segments = [
        dataclasses.replace(small_model.segments[0], name=name)
        for name in ("1", "kiefer_größe", "Chin", "chin", "0")
    ]
    model = dataclasses.replace(small_model, segments=tuple(segments))
    names = cmfsim.write_model(tmp_path / "out", model)
    drawn = [name for name in names if name.startswith("segment-")]
    assert drawn == [f"segment-{n}.ply" for n in ("1", "+1", "Chin", "+3", "0")]
    assert set(contents(tmp_path / "out")) == set(names)


def test_a_folder_made_for_nothing_goes_again(ready, ellipsoids, monkeypatch):
    del ready

    def fail(*_):
        raise FULL

    monkeypatch.setattr(result_files, "write_scene", fail)
    code, _, _ = run("build", ellipsoids, "-q", "--no-doctor", "-o", ellipsoids.parent / "a" / "b")
    assert code == 1
    assert not (ellipsoids.parent / "a").exists()


def test_an_output_that_cannot_be_is_found_before_the_work(ellipsoids, monkeypatch):
    """A file in its place, a folder that takes nothing, an input that would be replaced."""

    def work(*_, **__):
        raise AssertionError

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(model_output, "build_model", work)
    taken = ellipsoids.parent / "taken"
    taken.write_text("", encoding="utf-8")
    words = ("build", ellipsoids, "-q", "--no-doctor", "-o")
    code, _, err = run(*words, taken)
    assert code == 2
    assert "is a file" in err
    code, _, err = run(*words, taken / "deeper")
    assert code == 2
    skin = (ellipsoids.parent / "skin.ply").read_bytes()
    code, _, err = run(*words, ellipsoids.parent)
    assert code == 2
    assert "would replace this input" in err
    assert (ellipsoids.parent / "skin.ply").read_bytes() == skin
    # As on a disk that is read-only: permissions do not tell root.
    monkeypatch.setattr("cmfsim.io.files.folders.tempfile.mkdtemp", refuse)
    code, _, err = run(*words, ellipsoids.parent / "closed")
    assert code == 1
    assert "the output folder is not writable" in err


def test_a_folder_in_the_place_of_a_file_is_named(ready, ellipsoids, before):
    """And nothing is replaced."""
    del ready
    folder = ellipsoids.parent / "out"
    (folder / "skin.ply").unlink()
    (folder / "skin.ply").mkdir()
    code, _, err = run("build", ellipsoids, "-q", "--no-doctor")
    assert code == 1
    assert "skin.ply: is a folder" in err
    del before["skin.ply"]
    kept = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    assert kept == before


def test_the_doctor_is_asked_once_or_not_at_all(ellipsoids, monkeypatch, small_model):
    """His findings are in the model; with --no-doctor nobody asks him."""
    asked = []

    def diagnose(case, models=None):
        asked.append((case, models))
        return (cmfsim.Finding("said-once", "something", severity="note"),)

    def examine(case, models=None):
        return cmfsim.doctor.Examination(diagnose(case, models), {})

    monkeypatch.setattr(case_model, "diagnose", diagnose)
    monkeypatch.setattr("cmfsim.cli.case_commands.examine", examine)
    monkeypatch.setattr(case_model, "read_anatomy", lambda *_: (small_model.anatomy, ()))
    monkeypatch.setattr(model_output, "_draw", lambda *_: [])
    for words, times in (((), 1), (("--no-doctor",), 0)):
        asked.clear()
        code, out, err = run("build", ellipsoids, "--json", *words)
        assert code == 0, err
        assert len(asked) == times
        said = [f["code"] for f in json.loads(out)["findings"]]
        assert said.count("said-once") == times
        assert err.count("checking the case") == times


def test_json_is_one_object_and_quiet_is_quiet(ready, ellipsoids, monkeypatch):
    del ready
    monkeypatch.setattr(model_output, "_draw", lambda *_: [])
    code, out, err = run("build", ellipsoids, "--json", "-q", "--no-doctor")
    assert code == 0
    assert err == ""
    assert len(out.splitlines()) == 1
    assert set(json.loads(out)) >= {"case", "nodes", "mesh", "findings", "timings", "inputs"}


def test_without_opengl_there_is_a_model_and_a_warning(ready, ellipsoids, before, monkeypatch):
    """The pictures of an earlier build go: they would show another model."""
    del ready

    def cannot(*_, **__):
        raise cmfsim.CaseError("anatomy.png: the picture cannot be drawn (no OpenGL)")

    monkeypatch.setattr(model_output, "picture_anatomy", cannot)
    code, _, err = run("build", ellipsoids, "-q", "--no-doctor")
    assert code == 0
    assert "no pictures: anatomy.png: the picture cannot be drawn" in err
    names = {path.name for path in (ellipsoids.parent / "out").iterdir()}
    assert not names & PICTURES
    assert "anatomy.png" in before


DRAWING = """
import cmfsim
from cmfsim.pictures import picture_anatomy
surface = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3]])
level = cmfsim.ImageData([[[0.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]], (1, 1, 1))
try:
    picture_anatomy(PATH, surface, [cmfsim.BoneSegment("a", level, surface)], size=(60, 40))
except cmfsim.CaseError as error:
    print(error)
"""


def test_a_crash_of_opengl_is_a_named_error(tmp_path, monkeypatch):
    """VTK ends the process that asks for a window where there is none: only the probe's."""
    pytest.importorskip("pyvista", reason="needs PyVista (pip install '.[view]')")
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkXOpenGLRenderWindow")
    monkeypatch.delenv("DISPLAY", raising=False)
    done = subprocess.run(
        [sys.executable, "-c", f"PATH = {str(tmp_path / 'one.png')!r}\n{DRAWING}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    if (tmp_path / "one.png").exists():
        pytest.skip("this machine draws into an X window without a screen")
    assert done.stdout.startswith("one.png: the picture cannot be drawn (OpenGL does not work)")


def test_tets_from_elsewhere_are_taken(ellipsoids, small_model, caplog):
    """`[mesh] file`, through meshio; the same nodes come back in the scene."""
    scene = small_model.scene
    tets = [("tetra", np.asarray(scene.tets).astype(np.int64))]
    meshio.Mesh(np.asarray(scene.nodes), tets).write(ellipsoids.parent / "mine.vtu")
    text = ellipsoids.read_text(encoding="utf-8")
    ellipsoids.write_text(
        text.replace("edge_length = 14.0", 'edge_length = 14.0\nfile = "mine.vtu"'),
        encoding="utf-8",
    )
    with caplog.at_level(logging.INFO):
        model = cmfsim.build_model(cmfsim.Case.load(ellipsoids))
    assert np.array_equal(model.scene.nodes, scene.nodes)
    # The sides of clefts are a boundary now, and those of them that lie on bone are held as well.
    held = small_model.kinds.kind > 0
    assert np.array_equal(model.kinds.kind[held], small_model.kinds.kind[held])
    assert model.summary["mesh"]["boundary_error_mean"] is None
    assert "mine.vtu" in model.summary["inputs"]


def test_poor_tets_from_elsewhere_are_a_finding(ellipsoids, small_model):
    """One node drawn nearly into the face opposite."""
    nodes, tets = np.array(small_model.scene.nodes), np.asarray(small_model.scene.tets)
    inner = np.setdiff1d(np.arange(len(nodes)), small_model.boundary_triangles)
    node = inner[0]
    at_node = tets[(tets == node).any(axis=1)]
    others = np.array([tet[tet != node] for tet in at_node])
    heights = np.linalg.norm(nodes[others].mean(axis=1) - nodes[node], axis=1)
    nodes[node] += 0.97 * (nodes[others[np.argmin(heights)]].mean(axis=0) - nodes[node])
    cells = [("tetra", tets.astype(np.int64))]
    meshio.Mesh(nodes, cells).write(ellipsoids.parent / "mine.vtu")
    text = ellipsoids.read_text(encoding="utf-8")
    text = text.replace("edge_length = 14.0", 'edge_length = 14.0\nfile = "mine.vtu"')
    ellipsoids.write_text(text, encoding="utf-8")
    model = cmfsim.build_model(cmfsim.Case.load(ellipsoids))
    (finding,) = (f for f in model.findings if f.code == "mesh-poor-tet")
    assert finding.severity == "warning"
    assert model.summary["mesh"]["min_dihedral"] < 10.0


def test_a_surface_parts_the_mesh(ellipsoids, small_model):
    """`[lips] seam`: more nodes, tets cut along the sheet, and the report of the whole."""
    x, y, z = 0.0, -185.0, 1480.0
    corners = [[x - 60, y - 40, z], [x + 60, y - 40, z], [x + 60, y + 10, z], [x - 60, y + 10, z]]
    sheet = cmfsim.SurfaceData(corners, [[0, 1, 2], [0, 2, 3]])
    cmfsim.write_surface(ellipsoids.parent / "lips.ply", sheet)
    text = ellipsoids.read_text(encoding="utf-8")
    text += '\n[lips]\ncontact = true\nseam = "lips.ply"\n'
    ellipsoids.write_text(text, encoding="utf-8")
    model = cmfsim.build_model(cmfsim.Case.load(ellipsoids), check=False)
    whole, parted = small_model.summary["mesh"], model.summary["mesh"]
    assert whole["n_tets"] < parted["n_tets"] < 1.05 * whole["n_tets"]
    assert parted["n_nodes"] > whole["n_nodes"]
    assert parted["boundary_error_mean"] == whole["boundary_error_mean"]


def test_files_of_one_name_in_two_folders_have_their_own_hashes(ellipsoids):
    folder = ellipsoids.parent / "other"
    folder.mkdir()
    bone = (ellipsoids.parent / "mandible.ply").read_bytes()
    (folder / "cranium.ply").write_bytes(bone)
    text = ellipsoids.read_text(encoding="utf-8")
    ellipsoids.write_text(text.replace('"mandible.ply"', '"other/cranium.ply"'), encoding="utf-8")
    hashes = case_model.input_hashes(cmfsim.Case.load(ellipsoids))
    assert hashes["cranium.ply"] != hashes["other/cranium.ply"]
