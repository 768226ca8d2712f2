"""The commands and Python code of README and docs run, in the order in which a reader types them.

Everything is read by `Reader`: commands are `cmfsim.cli.main`, Python blocks of a page share their
names. Pages that solve faces are run on coarse heads; those that take longer than some seconds are
marked `slow` (`make test-slow`), and the commands of all pages are at least parsed in every run.
"""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import cmfsim
import head_case
import phantom_case
from cmfsim.cli import main
from cmfsim.cli.parsing import make_parser
from cmfsim.drafting import init_case
from cmfsim.io.cases.templates import write_template
from cmfsim.io.files.reading_writing import toml_module
from cmfsim.pictures import faces
from scene_text import model, pack, shift, transform, write_scene
from shared_values import without_drawings

pytest.importorskip("skimage")
pytest.importorskip("SimpleITK")

ROOT = Path(__file__).parents[3]
PAGES = {
    path.relative_to(ROOT).as_posix(): path
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
BLOCK = re.compile(r"^( *)```([a-z]*)\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
# Blocks without a language that are drawings, lists of options, or what a command prints.
NOT_TYPED = re.compile(r"─|^plan: |^cmfsim demo \[FOLDER\]|^python (?:-m )?benches")


def blocks(page):
    """(language, text) of the blocks of a page, in their order."""
    text = PAGES[page].read_text("utf-8")
    found = []
    for indent, language, body in BLOCK.findall(text):
        lines = [line.removeprefix(indent) for line in body.splitlines()]
        found.append((language, "\n".join(lines) + "\n"))
    return found


def commands(text):
    """The lines of a block of commands as words; some go on in the next line."""
    joined = text.replace("\\\n", " ")
    lines = [line.partition(" #")[0].strip() for line in joined.splitlines()]
    return [shlex.split(line) for line in lines if line and not line.startswith("#")]


class Reader:
    """Somebody who types what a page says, in a folder of their own."""

    def __init__(self, also=()):
        self.also, self.names, self.done = list(also), {}, []

    def type(self, language, text):
        """Executes a block; what is neither Python nor commands is only read."""
        if language == "python":
            exec(compile(text, "page", "exec"), self.names)  # noqa: S102
        elif language == "sh":
            for words in commands(text):
                self.run(words)

    def run(self, words):
        """Runs a command of cmfsim; others are only looked at."""
        if words == ["make", "demo"]:
            words = ["cmfsim", "demo"]
        if words[0] != "cmfsim" or any(words[1:][: len(w)] == w for w, _ in NOT_RUN):
            return
        # Coarse, quiet, and without a window.
        options = [word for word in self.also if accepts(words[1], word.partition("=")[0])]
        if words[1] == "virtual-patients" and "--patients" not in words:
            options.append("--count=3" if "--count" in words else "--patients=1")
        code = main([*words[1:], *options])
        assert code == 0, words
        self.done.append(words)


def accepts(command, option):
    """Whether a command has an option."""
    choices = make_parser()._subparsers._group_actions[0].choices
    return option in choices[command]._option_string_actions


# ------------------------------------------------------------------ every page, every run


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_are_understood(page):
    """They parse; scripts and targets of make that they name are there; nothing is from PyPI."""
    makefile = (ROOT / "Makefile").read_text("utf-8")
    project = toml_module().loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for language, text in blocks(page):
        assert language or NOT_TYPED.search(text), f"{page}: say what this is: {text[:60]!r}"
        if language != "sh":
            continue
        for typed in commands(text):
            words = [word for word in typed if not re.fullmatch(r"[A-Z_]+=\S*", word)]
            if words[0] == "cmfsim":
                make_parser().parse_args(words[1:])
            elif words[0] == "make":
                assert re.search(rf"^{words[1]}:", makefile, re.MULTILINE), words
            elif words[0] == "pip":
                extras = re.fullmatch(r"\.\[(.*)\]", words[-1])[1].split(",")
                assert set(extras) <= set(project["optional-dependencies"]), words
            elif words[0] == "python" and words[1] != "-m":
                assert (ROOT / words[1]).is_file(), words
            else:
                assert words[0] in {"python", "pytest", "cargo", "cp"}, words


@pytest.mark.parametrize("path", sorted(PAGES.values()), ids=lambda path: path.name)
def test_no_page_installs_what_is_not_published(path):
    assert not re.search(r"pip install '?cmfsim", path.read_text("utf-8"))


def test_no_message_installs_what_is_not_published():
    for path in Path(cmfsim.__file__).parent.rglob("*.py"):
        assert not re.search(r"'?cmfsim\[", path.read_text("utf-8")), path


def names_after_python(page):
    """What the Python blocks of a page define, typed one after the other."""
    reader = Reader()
    for language, text in blocks(page):
        if language == "python":
            reader.type(language, text)
    return reader.names


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/templates.md"])
def test_python_that_needs_no_case_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert names_after_python(page)


# ------------------------------------------------------------------ the README's case


def readme_case(folder):
    """Steps 1 and 2 of the README: init, and its own lines below the case that init wrote."""
    steps = blocks("README.md")
    assert commands(next(text for _, text in steps if "cmfsim init" in text)) == [
        ["cmfsim", "init", "patient"]
    ]
    assert main(["init", str(folder), "-q"]) == 0
    lines = next(text for language, text in steps if language == "toml")
    path = folder / "case.toml"
    path.write_text(path.read_text("utf-8") + "\n" + lines, encoding="utf-8")
    return path


def small_image(path):
    """A block of tissue in air."""
    values = np.full((40, 50, 60), -1000, np.int16)
    values[10:30, 10:40, 10:50] = 40
    cmfsim.write_image(cmfsim.ImageData(values, (4.0, 4.0, 4.0), (-80.0, -100.0, 0.0)), path)


def test_the_lines_of_the_readme_fit_what_init_writes(tmp_path):
    (tmp_path / "patient").mkdir()
    small_image(tmp_path / "patient" / "ct.nii.gz")
    case = cmfsim.Case.load(readme_case(tmp_path / "patient"))
    assert case.muscles is not None
    assert list(case.plan) == ["maxilla"]
    assert [cut.procedure for cut in case.osteotomies] == ["le_fort_1"]


@pytest.mark.parametrize("bones", ["image", "cranium mandible", "cranium maxilla"])
def test_the_plan_that_init_proposes_is_accepted(tmp_path, bones):
    """With the signs of comments taken off: a piece that has to be cut is cut."""
    if bones == "image":
        small_image(tmp_path / "ct.nii.gz")
    else:
        for name in ("skin", *bones.split()):
            surface = head_case.ellipsoid("mandible" if name == "maxilla" else name)
            cmfsim.write_surface(tmp_path / f"{name}.ply", surface)
    init_case(tmp_path)
    path = tmp_path / "case.toml"
    before, _, proposed = path.read_text("utf-8").partition("such as:\n")
    lines, _, after = proposed.partition("\n\n")
    lines = "\n".join(line.removeprefix("#").strip() for line in lines.splitlines())
    lines = "\n".join(line for line in lines.splitlines() if not line.startswith("or,"))
    path.write_text(f"{before}\n{lines}\n\n{after}", encoding="utf-8")
    case = cmfsim.Case.load(path)
    assert list(case.plan) == ["maxilla"]
    assert bool(case.osteotomies) == (bones != "cranium maxilla")
    if bones == "cranium mandible":
        assert not [f for f in cmfsim.diagnose(case) if f.code == "unknown-name"]


# ------------------------------------------------------------------ pages about a case


@pytest.fixture(scope="module")
def coarse_case(tmp_path_factory):
    """The folder of a head with both jaws cut, its landmarks given, and its face after; coarse."""
    folder = tmp_path_factory.mktemp("documented")
    head = cmfsim.make_head()
    phantom_case.surface_case(folder, head, head.anatomy(4.0))
    path = folder / "case.toml"
    text = path.read_text("utf-8").replace("edge_length = 7.0", "edge_length = 14.0")
    after = "\n[muscles]\nsamples = 8\n\n"
    after += '[postoperative]\nskin = "skin.ply"\nverified = true\n'
    path.write_text(text + after, encoding="utf-8")
    (folder / "head").mkdir()
    for file in folder.iterdir():
        if file.is_file():
            (folder / "head" / file.name).write_bytes(file.read_bytes())
    cmfsim.write_surface(folder / "wished.stl", cmfsim.read_surface(folder / "skin.ply"))
    cmfsim.write_landmarks(folder / "wished.mrk.json", head.skin_landmarks)
    return folder


@pytest.mark.parametrize("page", ["docs/building.md", "docs/predicting.md"])
def test_python_about_a_case_runs(page, coarse_case, monkeypatch):
    monkeypatch.chdir(coarse_case)
    # A prediction's pictures are counted by test_demo.py, frames by test_animation.py.
    without_drawings(monkeypatch)
    monkeypatch.setattr(faces, "STEPS", 1)
    assert names_after_python(page)


# ------------------------------------------------------------------ whole pages, as typed

# What a reader of the test adds to commands, which know some of it: coarser, fewer, no window.
COARSE = (
    *("-q", "--no-open", "--screenshot=face.png", "--edge-length=14", "--trials=2"),
    *("--corrections=4", "--spacing=4", "--workers=1"),
)
# Commands that are not run: they never end, need data that is not ours, or take hours.
NOT_RUN = (
    (["plan", "case.toml", "--serve"], "until Ctrl-C"),
    (["desk"], "until Ctrl-C"),
    (["template", "import"], "BodyParts3D"),
    (["predict", "--band", "--calibration"], "a calibration of the 36 patients of the page"),
    (["bench", "frontier"], "hours"),
    (["study", "insilico/executed.toml"], "hours: thirty settings of every patient"),
)
WHOLE = (
    "README.md",
    "docs/band.md",
    "docs/benchmark.md",
    "docs/building.md",
    "docs/evaluation.md",
    "docs/from-slicer.md",
    "docs/kim2010.md",
    "docs/landmarks.md",
    "docs/planning-page.md",
    "docs/predicting.md",
    "docs/python.md",
    "docs/templates.md",
    "docs/virtual_patients.md",
)


def prepare(folder, coarse_case):
    """What the pages take for granted: a case, a CT, a scene, a cohort, an atlas."""
    for name in ("patient", "packed", "benches/scenes"):
        (folder / name).mkdir(parents=True)
    for file in coarse_case.iterdir():
        if file.is_file():
            (folder / file.name).write_bytes(file.read_bytes())
    head = cmfsim.make_head()
    cmfsim.write_image(head.ct(4.0), folder / "patient" / "ct.nii.gz")
    cohort = (
        'format = "cmfsim-cohort"\nversion = 1\nmodels = ["H"]\n[[cases]]\nfile = "case.toml"\n'
    )
    (folder / "cohort.toml").write_text(cohort, encoding="utf-8")
    write_scene(
        folder / "packed",
        transform("Mandible move", shift(0, 4, 1)),
        model("Skin", "skin.ply"),
        model("Cranium", "cranium.ply"),
        model("Mandible", "mandible.ply", "Mandible move"),
    )
    pack(folder / "packed", folder / "planning.mrb")
    plan = "[plan.maxilla]\ntranslation = [0, -3, 0]\n"
    (folder / "demo-B-6d0f1c2a.toml").write_text(plan, encoding="utf-8")
    variants = (ROOT / "benches/scenes/variants.toml").read_text("utf-8")
    (folder / "benches/scenes/variants.toml").write_text(variants, encoding="utf-8")
    write_template(folder / "atlas", cmfsim.MuscleTemplate.load("default"))


@pytest.mark.slow
@pytest.mark.parametrize("page", WHOLE)
def test_a_page_can_be_typed_from_top_to_bottom(page, coarse_case, tmp_path, monkeypatch):
    prepare(tmp_path, coarse_case)
    monkeypatch.chdir(tmp_path)
    if page == "docs/from-slicer.md":
        (tmp_path / "case.toml").unlink()
    reader = Reader(COARSE)
    for language, text in blocks(page):
        if page == "README.md" and language == "toml":
            path = tmp_path / "patient" / "case.toml"
            path.write_text(path.read_text("utf-8") + "\n" + text, encoding="utf-8")
        reader.type(language, text)
    assert reader.done or reader.names
