"""A scene pays for what it has: stages that it lacks take no time and load no module."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.deferred import PUBLIC
from cmfsim.errors import MeshInputError, third_party
from head_case import HeadCase

PACKAGE = Path(cmfsim.__file__).parent
OUTSIDE = {"scipy", "skimage", "SimpleITK", "meshio", "matplotlib", "pyvista", "vtk", "jinja2"}
MUSCLES = {
    "cmfsim.values.musculature",
    "cmfsim.muscles.template",
    "cmfsim.muscles.equivalent",
    "cmfsim.pipeline.building.tissue.muscles",
    "cmfsim.doctor.muscles",
}
IMAGING = {"cmfsim.imaging"}
# What a plain scene has no use for, beside muscles and images.
STAGES = {
    "cmfsim.bones.achieved",
    "cmfsim.pipeline.building",
    "cmfsim.doctor",
    "cmfsim.evaluation",
    "cmfsim.lab.virtual",
    "cmfsim.solving.inversion",
    "cmfsim.io",
    "cmfsim.meshing",
    "cmfsim.meshing.node_kinds",
    "cmfsim.bones",
    "cmfsim.phantom",
    "cmfsim.pictures",
    "cmfsim.registration",
    "cmfsim.report",
    "cmfsim.study",
}
SCENE = """
scene = cmfsim.Scene(
    nodes=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    tets=[[0, 1, 2, 3]],
    tissue=cmfsim.TissueData("isotropic", young=1.0, poisson=0.0),
    fixed=[0, 1, 2],
    segments={"tip": cmfsim.SegmentData(joined=[3])},
    plan={"tip": cmfsim.rigid_motion(translation=(0, 0, 0.1))},
)
assert abs(cmfsim.solve_scene(scene).forces[3, 2] - 0.1 / 6) < 1e-12
"""


def loaded(script: str) -> set[str]:
    """The modules that a fresh interpreter has after a script."""
    text = f"import json, sys\nimport cmfsim\n{script}\nprint(json.dumps(sorted(sys.modules)))"
    run = [sys.executable, "-c", text]
    out = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    return set(json.loads(out.splitlines()[-1]))


def of_package(modules: set[str]) -> set[str]:
    return {name for name in modules if name.split(".")[0] == "cmfsim"}


def test_the_command_line_sets_the_threads_of_numpy_before_numpy_is_loaded():
    """Loaded earlier, its threads spin for a fifth of the processor time of a prediction."""
    assert "numpy" not in loaded("import cmfsim.cli")
    begin = "import os, sys, cmfsim.cli\nsys.argv[1:] = ['info', 'none.npz']\n"
    assert "numpy" in loaded(
        f"{begin}os.environ.pop('OPENBLAS_NUM_THREADS', None)\ncmfsim.cli.main()\n"
        "assert os.environ['OPENBLAS_NUM_THREADS'] == '1'"
    )
    kept = "cmfsim.cli.main()\nassert os.environ['OPENBLAS_NUM_THREADS'] == '2'"
    loaded(f"{begin}os.environ['OPENBLAS_NUM_THREADS'] = '2'\n{kept}")


def test_importing_the_package_loads_none_of_its_stages():
    found = loaded("")
    assert of_package(found) == {"cmfsim", "cmfsim.deferred"}
    assert not found & (OUTSIDE | {"numpy"})


@pytest.mark.parametrize(
    ("name", "home"),
    [
        ("MuscleTemplate", "cmfsim.muscles.template"),
        ("equivalent_material", "cmfsim.muscles.equivalent"),
        ("segment_head", "cmfsim.imaging"),
        ("with_muscles", "cmfsim.pipeline.building.tissue.muscles"),
    ],
)
def test_a_stage_is_loaded_when_it_is_asked_for(name, home):
    """What the other tests look for is what these modules are called."""
    assert home in loaded(f"cmfsim.{name}")


def test_a_scene_loads_neither_muscles_nor_imaging_nor_any_other_stage():
    found = loaded(SCENE)
    assert "cmfsim.solving.simulation" in found
    assert not found & (MUSCLES | IMAGING | STAGES | OUTSIDE)


def test_a_case_of_surfaces_without_muscles_loads_neither_muscles_nor_imaging(tmp_path):
    """From the files to the face by model H: skimage and scipy serve meshing and cutting."""
    head = HeadCase()
    head.replace("edge_length = 4.0", "edge_length = 14.0")
    file = head.write(tmp_path)
    found = loaded(
        f"made = cmfsim.predict(cmfsim.Case.load({str(file)!r}), model='H')\n"
        "stages = made.summary['timings']\n"
        "assert stages['filling the tissue with tets'] > 0.0, stages\n"
        "assert not [s for s in stages if 'muscle' in s or 'imag' in s or 'segment' in s], stages\n"
        "solve = made.result.summary['timings']\n"
        "assert solve['solve']['contact'] == solve['set_up']['contact_setup'] == 0.0, solve"
    )
    assert {"cmfsim.meshing", "cmfsim.solving.models"} <= found
    assert not found & (MUSCLES | IMAGING | {"SimpleITK", "pyvista", "vtk", "matplotlib", "jinja2"})
    assert not found & {
        "cmfsim.bones.achieved",
        "cmfsim.evaluation",
        "cmfsim.lab.virtual",
        "cmfsim.phantom",
    }


@pytest.mark.parametrize("method", ["cholesky", "pcg", "relaxation"])
def test_without_sliding_nodes_contact_takes_no_time(method):
    """`timings` of a stage that a scene lacks is zero exactly; with sliding nodes it is not."""
    nodes, tets = meshes.box((3, 3, 3))
    low, high = (meshes.nodes_where(nodes[:, 2] == z) for z in (0.0, 1.0))
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(0.1, 0.4))
    push = {"bone": cmfsim.rigid_motion((0.0, 0.0, -0.05))}
    wall = cmfsim.Surface(*meshes.plane(5.0))
    held = cmfsim.Boundary(fixed=low, joined={"bone": high})
    slides = cmfsim.Boundary(joined={"bone": high}, sliding={"wall": low}, contact={"wall": wall})

    def contact_times(boundary, plan):
        laps = cmfsim.StaticSolver(tensors, boundary, method).solve(plan).timings
        return [seconds for stage, seconds in laps.items() if stage.startswith("contact")]

    assert contact_times(held, push)
    assert set(contact_times(held, push)) == {0.0}
    assert min(contact_times(slides, {**push, "wall": np.eye(4)})) > 0.0


def test_the_stub_of_the_package_is_its_list_of_public_names():
    """Each line of it makes one name public, none twice, none that of a module, whose import would
    take its place.
    """
    lines = (PACKAGE / "__init__.pyi").read_text("utf-8").splitlines()
    imports = [line for line in lines if not line.startswith("#")]
    names = [line.rpartition(" ")[2] for line in imports]
    assert all(PUBLIC.match(line) for line in imports)
    assert cmfsim.__all__ == sorted(set(names))
    assert len(names) == len(set(names))
    assert not set(names) & {path.stem for path in PACKAGE.iterdir()}
    for name in names:
        assert getattr(cmfsim, name) is not None


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'cmfsim' has no attribute 'solve'"):
        cmfsim.solve  # noqa: B018
    assert set(cmfsim.__all__) <= set(dir(cmfsim))
    assert cmfsim.io.read_surface is cmfsim.read_surface


def test_a_missing_dependency_is_named_with_the_line_that_installs_it():
    with pytest.raises(
        cmfsim.MeshError, match=r"^teeth are counted with nosuch, .*'\.\[x\]' in cmfsim's folder$"
    ):
        third_party("nosuch.part", "teeth are counted", "x", MeshInputError)
    assert third_party("json.decoder", "nothing", "x").JSONDecoder
