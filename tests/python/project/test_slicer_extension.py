"""The extension for 3D Slicer: its logic without Slicer, its descriptions, a run of its own."""

import ast
import importlib
import json
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

import cmfsim
import head_case

ROOT = Path(__file__).parents[3] / "slicer"
if not ROOT.is_dir():
    pytest.skip("the extension is not part of an installed package", allow_module_level=True)
sys.path.insert(0, str(ROOT / "CmfSim"))

from CmfSimLib import case_folder, running  # noqa: E402 (its folder is no package of the path)

FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
MOTION = cmfsim.rigid_motion((0.0, 4.0, 1.0), angle=2.0, axis=(1, 0, 0), centre=(-3, 128, 1445))


def chosen(folder, **more):
    """What a person chose: skin, cranium that stays, mandible under a transform."""
    case = head_case.HeadCase()
    for name, surface in case.surfaces.items():
        cmfsim.write_surface(folder / f"{name}.vtp", surface)
    cmfsim.write_landmarks(folder / "skull_landmarks.mrk.json", case.skull)
    segments = [
        case_folder.Segment("cranium", folder / "cranium.vtp"),
        case_folder.Segment("mandible", folder / "mandible.vtp", MOTION.tolist()),
    ]
    given = {
        "skin": folder / "skin.vtp",
        "segments": segments,
        "skull_landmarks": folder / "skull_landmarks.mrk.json",
        "edge_length": 20.0,
        "model": "H",
    }
    return case_folder.Choice(**{**given, **more})


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A case of the module, predicted in a process of its own: folder, lines, answer."""
    folder = tmp_path_factory.mktemp("chosen")
    path = case_folder.write_case(folder, chosen(folder))
    run = running.Run(running.predict_command(path, "H", python=sys.executable))
    lines = []
    while run.code is None:
        lines += run.poll()
        time.sleep(0.05)
    lines += run.poll()
    code, answer = run.code, run.answer()
    run.close()
    assert code == 0, answer
    return folder, lines, answer


def test_the_choice_becomes_the_plan_of_the_case(tmp_path):
    """Slicer's matrix is RAS; the motion of the case is the same one on LPS points."""
    case = cmfsim.Case.load(case_folder.write_case(tmp_path, chosen(tmp_path)))
    assert list(case.plan) == ["mandible"]
    wanted = FLIP @ MOTION @ FLIP
    assert np.abs(np.asarray(case.plan["mandible"].matrix) - wanted).max() < 1e-12
    assert not [f for f in cmfsim.diagnose(case, ["H"]) if f.severity == "error"]


def test_a_volume_is_cut_by_the_procedures_that_the_segments_need(tmp_path):
    text = case_folder.case_text(
        case_folder.Choice(
            volume=tmp_path / "ct.nrrd",
            segments=[
                case_folder.Segment("maxilla", None, MOTION.tolist()),
                case_folder.Segment("mandible_body", None, MOTION.tolist()),
                case_folder.Segment("chin"),
            ],
            model="H+S",
        )
    )
    (tmp_path / "case.toml").write_text(text, encoding="utf-8")
    case = cmfsim.Case.load(tmp_path)
    assert [cut.procedure for cut in case.osteotomies] == ["le_fort_1", "bsso"]
    assert case.image is not None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"skin": None}, "Choose a CT volume"),
        ({"segments": []}, "at least one model of a bone"),
        ({"model": "X"}, "one of H, M"),
        (
            {"segments": [case_folder.Segment("a b", Path("a.vtp"), MOTION.tolist())]},
            "not a valid bone name",
        ),
        ({"segments": [case_folder.Segment("cranium", Path("a.vtp"))]}, "No segment moves"),
        ({"segments": 2 * [case_folder.Segment("chin", Path("a.vtp"))]}, "Two bones"),
    ],
)
def test_a_choice_that_makes_no_case_is_refused_in_a_sentence(tmp_path, change, words):
    with pytest.raises(case_folder.ChoiceError, match=words):
        case_folder.case_text(chosen(tmp_path, **change))


def test_muscles_need_no_landmarks_of_a_person(tmp_path):
    """They are found automatically; the case says that it has muscles, for models with muscles."""
    for model, expected in (("M+S", True), ("H", False)):
        made = chosen(tmp_path, skull_landmarks=None, model=model)
        case = cmfsim.Case.load(case_folder.write_case(tmp_path, made))
        assert (case.muscles is not None) == expected
        assert case.landmarks.skull is None


def test_the_planning_page_of_what_was_chosen(ran):
    """One file for the browser in the folder of the case."""
    folder, _, _ = ran
    words = running.page_command(folder / "case.toml", "H", python=sys.executable)
    run = running.Run([*words, "--trials", "1", "--corrections", "0"])
    while run.code is None:
        time.sleep(0.05)
    code, answer = run.code, run.answer()
    run.close()
    assert code == 0, answer
    assert "mandible" in (folder / "out" / "plan.html").read_text(encoding="utf-8")


def test_a_run_tells_its_progress_and_gives_the_face(ran, tmp_path):
    folder, lines, answer = ran
    shares = [line.share for line in lines if line.share is not None]
    assert len(shares) > 4
    assert shares == sorted(shares)
    assert answer["predictions"][0]["model"] == "H"
    face = cmfsim.read_surface(case_folder.face_of(folder / "out" / "prediction.mrb", tmp_path))
    plain = cmfsim.read_surface(folder / "out" / "face.stl")
    assert len(face.vertices) == len(plain.vertices)
    # An STL numbers vertices by its triangles: each has its own nearest.
    apart = np.asarray(face.vertices)[:, None] - np.asarray(plain.vertices)
    assert np.linalg.norm(apart, axis=2).min(axis=1).max() < 1e-3


def test_a_failed_run_gives_the_words_of_the_doctor(tmp_path):
    """No bone: the case file itself is refused."""
    (tmp_path / "case.toml").write_text('format = "cmfsim-case"\nversion = 1\n', encoding="utf-8")
    run = running.Run(running.predict_command(tmp_path, "H", python=sys.executable))
    while run.code is None:
        time.sleep(0.05)
    code, answer = run.code, run.answer()
    run.close()
    assert code == 2
    assert "needs [image] or [surfaces]" in running.words_of(answer)


def test_stages_are_those_that_cmfsim_prints(ran):
    """Every stage of the bar that this case has is among the lines."""
    _, lines, _ = ran
    texts = [line.text for line in lines]
    for start in ("checking", "reading", "filling", "classifying", "solving", "writing"):
        assert any(text.startswith(start) for text in texts), (start, texts)


def test_the_command_line_module_predicts_and_states_progress(ran, tmp_path):
    """As Slicer calls it: positional case and face, flags of the XML."""
    folder, _, _ = ran
    script = ROOT / "CmfSimPredict" / "CmfSimPredict.py"
    words = [sys.executable, str(script), str(folder), str(tmp_path / "face.vtp"), "--model", "H"]
    ended = subprocess.run(
        [*words, "--edge-length", "22"],
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    shares = [float(s) for s in re.findall(r"<filter-progress>([^<]*)<", ended.stdout)]
    assert shares == sorted(shares)
    assert ended.stdout.count("<filter-end>") == 1
    assert len(cmfsim.read_surface(tmp_path / "face.vtp").vertices) > 100


def test_the_command_line_module_describes_itself():
    """The XML has the channels and flags that the script takes."""
    script = ROOT / "CmfSimPredict" / "CmfSimPredict.py"
    ended = subprocess.run(
        [sys.executable, str(script), "--xml"], capture_output=True, text=True, check=True
    )
    root = ET.fromstring(ended.stdout)  # noqa: S314 (our own file)
    assert root.tag == "executable"
    indices = {
        e.findtext("name"): e.findtext("index") for e in root.iter() if e.find("index") is not None
    }
    assert indices == {"case": "0", "face": "1"}
    flags = {e.findtext("longflag") for e in root.iter() if e.find("longflag") is not None}
    source = script.read_text(encoding="utf-8")
    assert all(f'"--{flag}"' in source for flag in flags)
    models = [e.text for e in root.iter("element")]
    assert models == list(case_folder.MODELS) == ["H", "M", "H+S", "M+S"]


def test_the_logic_knows_no_slicer():
    """CmfSimLib runs outside of Slicer; the widget imports cmfsim nowhere."""
    for path in sorted((ROOT / "CmfSim").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = {
            name.split(".")[0]
            for node in ast.walk(tree)
            for name in (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
        }
        assert "cmfsim" not in names
        if path.parent.name == "CmfSimLib":
            assert not names & {"slicer", "qt", "ctk", "vtk"}, path


class _Widget:
    """In the place of Slicer's own class of panels."""

    def setup(self):
        self.layout = MagicMock()


@pytest.fixture
def panel(monkeypatch, tmp_path):
    """The panel's own code with stand-ins for Slicer, Qt and CTK, and nothing chosen in it."""
    stand_in = MagicMock()
    stand_in.app.temporaryPath = str(tmp_path)
    classes = SimpleNamespace(
        ScriptedLoadableModule=object,
        ScriptedLoadableModuleLogic=object,
        ScriptedLoadableModuleTest=object,
        ScriptedLoadableModuleWidget=_Widget,
    )
    modules = {
        "slicer": stand_in,
        "slicer.ScriptedLoadableModule": classes,
        "slicer.packaging": stand_in.packaging,
        "qt": MagicMock(),
        "ctk": MagicMock(),
        "vtk": MagicMock(),
    }
    modules["qt"].QPushButton.side_effect = lambda *_: MagicMock()
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "CmfSim", raising=False)
    widget = importlib.import_module("CmfSim").CmfSimWidget()
    widget.setup()
    widget.table.rowCount = 0
    for chooser in ("volume", "skin", "skull", "marks"):
        setattr(widget, chooser, MagicMock())
        getattr(widget, chooser).currentNode.return_value = None
    widget.model.currentText, widget.edge.value = "H", 6.0
    yield widget, stand_in
    sys.modules.pop("CmfSim", None)


def test_the_panel_refuses_an_empty_choice_and_starts_nothing(panel):
    widget, slicer = panel
    widget.onAddBone()
    widget.onButton()
    text = slicer.util.errorDisplay.call_args[0][0]
    assert "Choose a CT volume" in text
    assert widget.run is None
    slicer.packaging.pip_ensure.assert_called_once()


def test_the_panel_shows_progress_and_then_the_face(panel, monkeypatch):
    """The timer's turns with a run that ends: bar, face, colours."""
    widget, slicer = panel
    run = MagicMock(code=None)
    run.poll.return_value = [running.Line("solving H", 0.65)]
    widget.run, widget.case, widget.show = run, Path("case.toml"), widget.showPrediction
    widget.onTimer()
    assert widget.bar.value == 65
    assert widget.run is run
    run.code = 0
    shown = MagicMock()
    monkeypatch.setattr(widget.logic, "showFace", shown)
    widget.onTimer()
    assert widget.run is None
    run.close.assert_called_once()
    assert shown.call_args[0][0] == Path("out/prediction.mrb")
    run.code, widget.run = 2, run
    run.answer.return_value = {"error": {"kind": "CaseError", "text": "no bone"}}
    widget.onTimer()
    assert slicer.util.errorDisplay.call_args[0][0] == "no bone"


def test_the_panel_makes_a_planning_page_and_opens_it(panel, monkeypatch):
    widget, _ = panel
    qt = sys.modules["qt"]
    started = MagicMock()
    started.return_value.code = None
    module = sys.modules["CmfSim"]
    monkeypatch.setattr(module, "Run", started)
    monkeypatch.setattr(module, "write_case", lambda folder, _: Path(folder) / "case.toml")
    monkeypatch.setattr(widget.logic, "python", lambda: "python")
    widget.onPageButton()
    words = started.call_args[0][0]
    assert words[3:5] == ["plan", str(widget.case)]
    assert widget.button.text == widget.pageButton.text == "Stop"
    started.return_value.poll.return_value = []
    started.return_value.code = 0
    widget.onTimer()
    page = widget.case.parent / "out" / "plan.html"
    qt.QUrl.fromLocalFile.assert_called_once_with(str(page))
    assert str(page) in widget.status.text
    assert widget.pageButton.text == "Make the planning page"


def test_the_panel_shows_the_pieces_of_bone_before_any_moves(panel, monkeypatch, tmp_path):
    widget, slicer = panel
    started = MagicMock()
    started.return_value.code = None
    monkeypatch.setattr(sys.modules["CmfSim"], "Run", started)
    monkeypatch.setattr(widget.logic, "python", lambda: "python")
    made = case_folder.Choice(volume=Path("ct.nrrd"), segments=[case_folder.Segment("maxilla")])
    monkeypatch.setattr(widget.logic, "choice", lambda *_: made)
    widget.logic.folder = tmp_path
    widget.onButton()
    assert "No segment moves" in slicer.util.errorDisplay.call_args[0][0]
    widget.onPiecesButton()
    assert started.call_args[0][0][3:5] == ["build", str(tmp_path / "case.toml")]
    text = (tmp_path / "case.toml").read_text(encoding="utf-8")
    assert 'procedure = "le_fort_1"' in text
    (tmp_path / "out").mkdir()
    for name in ("cranium", "maxilla"):
        (tmp_path / "out" / f"segment-{name}.ply").touch()
    started.return_value.poll.return_value = []
    started.return_value.code = 0
    widget.onTimer()
    loaded = [Path(call[0][0]).name for call in slicer.util.loadModel.call_args_list]
    assert loaded == ["segment-cranium.ply", "segment-maxilla.ply"]
    assert "Pieces: cranium, maxilla." in widget.status.text
    assert widget.piecesButton.text == "Show the pieces of bone"


def test_a_wheel_beside_the_requirements_is_installed(panel, monkeypatch, tmp_path):
    """Without one, the package of the registry is asked for."""
    widget, slicer = panel
    widget.logic.ensureCmfsim()
    assert slicer.packaging.pip_ensure.call_args[0][0] == ["cmfsim[imaging]"]
    resources = tmp_path / "Resources"
    resources.mkdir()
    (resources / "requirements.txt").write_text("cmfsim[imaging]\n", encoding="utf-8")
    wheel = resources / "cmfsim-0.1.0-cp310-abi3-linux_x86_64.whl"
    wheel.write_bytes(b"")
    monkeypatch.setattr(sys.modules["CmfSim"], "__file__", str(tmp_path / "CmfSim.py"))
    widget.logic.ensureCmfsim()
    asked = slicer.packaging.pip_ensure.call_args[0][0]
    assert asked == [f"cmfsim[imaging] @ {wheel.as_uri()}"]


def test_descriptions_agree():
    """What the index of extensions reads is what CMake and the files have."""
    cmake = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    entry = json.loads((ROOT / "CmfSim.json").read_text(encoding="utf-8"))
    settings = dict(re.findall(r'set\(EXTENSION_(\w+) "([^"]*)"\)', cmake))
    assert entry["scm_url"].removesuffix(".git") == settings["HOMEPAGE"]
    assert settings["DEPENDS"] == "NA"
    assert entry["build_dependencies"] == []
    assert entry["tier"] == 1
    for name in re.findall(r"add_subdirectory\((\w+)\)", cmake):
        listed = (ROOT / name / "CMakeLists.txt").read_text(encoding="utf-8")
        assert f"NAME {name}" in listed or "NAME ${MODULE_NAME}" in listed
        for file in re.findall(r"^  (CmfSimLib/\S+|Resources/\S+)$", listed, re.MULTILINE):
            assert (ROOT / name / file.replace("${MODULE_NAME}", name)).is_file()
    for key in ("ICONURL", "SCREENSHOTURLS"):
        assert (ROOT / settings[key].partition("/slicer/")[2]).is_file()
