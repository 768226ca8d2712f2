"""The page "From 3D Slicer to a predicted face": its code runs, its excerpts are real."""

import re
import shlex
import zipfile
from pathlib import Path

import pytest

import cmfsim
import head_case
from cmfsim.cli.parsing import make_parser
from cmfsim.io.slicer_scenes import read_slicer_scene

pytest.importorskip("skimage")

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/from-slicer.md").read_text("utf-8")
# What moves the mandible in the scene, RAS: 4 mm forwards, 1 mm up.
MATRIX = "1 0 0 0  0 1 0 4  0 0 1 1  0 0 0 1"


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A bundle of the head of ellipsoids in the current folder, with a transform and landmarks."""
    monkeypatch.chdir(tmp_path)
    case = head_case.HeadCase()
    elements = [
        f'<LinearTransform id="t" name="Mandible move" matrixTransformToParent="{MATRIX}"/>'
    ]
    with zipfile.ZipFile("planning.mrb", "w") as archive:
        for name, surface in case.surfaces.items():
            under = "transform:t;" if name == "mandible" else ""
            elements += [
                f'<ModelStorage id="s{name}" fileName="Data/{name}.ply"/>',
                f'<Model id="m{name}" name="{name.title()}" references="storage:s{name};{under}"/>',
            ]
            cmfsim.write_surface("surface.ply", surface)
            archive.write("surface.ply", f"planning/Data/{name}.ply")
        cmfsim.write_landmarks("skull.mrk.json", case.skull)
        archive.write("skull.mrk.json", "planning/Data/skull.mrk.json")
        elements += [
            '<MarkupsJsonStorage id="sp" fileName="Data/skull.mrk.json"/>',
            '<MarkupsFiducial id="p" name="Skull" references="storage:sp;"/>',
        ]
        text = "\n".join(elements)
        archive.writestr("planning/planning.mrml", f'<MRML version="Slicer5">{text}</MRML>')
    Path("surface.ply").unlink()
    Path("skull.mrk.json").unlink()
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
    text = (scene / "case.toml").read_text("utf-8")
    excerpt = next(b for b in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) if "It moves" in b)
    for line in excerpt.splitlines():
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
