"""The page "From 3D Slicer to a predicted face": its code runs, its excerpts are real."""

import re
import shlex
import zipfile
from pathlib import Path

import pytest

import cmfsim
from cmfsim.cli.parsing import make_parser
from cmfsim.io.slicer.slicer_scenes import read_slicer_scene
from scene_text import model, pack, shift, transform, write_scene

pytest.importorskip("skimage")

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/from-slicer.md").read_text("utf-8")


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A bundle of the head of ellipsoids in the current folder, the mandible 4 mm forwards."""
    monkeypatch.chdir(tmp_path)
    packed = tmp_path / "packed"
    packed.mkdir()
    write_scene(
        packed,
        transform("Mandible move", shift(0, 4, 1)),
        model("Skin", "skin.ply"),
        model("Cranium", "cranium.ply"),
        model("Mandible", "mandible.ply", "Mandible move"),
    )
    pack(packed, tmp_path / "planning.mrb")
    return tmp_path


def test_the_code_of_the_page_runs(scene):
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(compile(block, "from-slicer.md", "exec"), namespace)  # noqa: S102
    with zipfile.ZipFile(scene / "face.mrb") as archive:
        archive.extractall(scene / "shown")
    names = {n.name for n in read_slicer_scene(scene / "shown/face/face.mrml").nodes.values()}
    assert {"face predicted", "face before", "mandible", "plan mandible"} <= names
    assert namespace["prediction"].skin_displacements.max() > 0.5


def test_the_excerpt_of_the_plan_is_what_is_written(scene):
    cmfsim.init_case("planning.mrb")
    text = (scene / "case.toml").read_text("utf-8").replace("\n# ", " ")
    excerpt = next(b for b in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) if "It moves" in b)
    for line in excerpt.replace("\n# ", " ").splitlines():
        assert line in text, line


def test_the_commands_of_the_page_are_known():
    lines = [
        line.partition("#")[0]
        for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
        for line in block.splitlines()
        if line.startswith("cmfsim ")
    ]
    assert len(lines) == 3
    for line in lines:
        make_parser().parse_args(shlex.split(line)[1:])
