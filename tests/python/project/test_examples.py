"""Examples and documented code run, and give the numbers that they promise."""

import doctest
import importlib
import pkgutil
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from example_world import example_values, write_example_files

ROOT = Path(__file__).parents[3]
MODULES = sorted(
    m.name for m in pkgutil.walk_packages(cmfsim.__path__, "cmfsim.") if m.name != "cmfsim._core"
)
# Values that only stages make: their attributes are described, an example would say nothing.
MADE_BY_STAGES = {
    "AchievedMotion",
    "AchievedPlan",
    "Anatomy",
    "BoneSegment",
    "BoneSite",
    "CaseDraft",
    "CaseEvaluation",
    "DistanceStatistics",
    "ErrorTable",
    "ExpectedError",
    "FacePlan",
    "FaceSites",
    "Finding",
    "Folds",
    "Frontier",
    "FrontierRow",
    "IcpFit",
    "Improvement",
    "LandmarkAgreement",
    "LandmarkMatch",
    "MeshReport",
    "ModelComparison",
    "NodeKinds",
    "PageContent",
    "PairedTest",
    "PlanTrial",
    "PlanningModel",
    "Prediction",
    "RepairedTets",
    "RigidFit",
    "RigidMotion",
    "SceneResult",
    "SensitivityReport",
    "SkinComparison",
    "StudyReport",
    "Taken",
    "TissueMesh",
    "VolumeAlignment",
}


@pytest.fixture
def _examples(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")


@pytest.mark.usefixtures("_examples")
def test_first_solve_slides_on_its_plane():
    """The sliding nodes end on z = 0, the joined ones where the bone takes them."""
    result = importlib.import_module("first_solve").main()
    low = result.contact_nodes
    assert len(low) == 12 * 9
    assert np.abs(result.displacements[low, 2]).max() < 1e-6
    assert result.residual < 1e-10


@pytest.mark.usefixtures("_examples")
def test_replanning_is_exact():
    """The operator's answer is the solver's."""
    assert importlib.import_module("replan").main() < 1e-9


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The values that examples speak of, in the folder that holds their files."""
    values = example_values(tmp_path_factory)
    folder = tmp_path_factory.mktemp("examples") / "case"
    write_example_files(folder, values)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield values


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_hold(name, world):
    """Every example in a docstring, but for those that are marked: they take minutes."""
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    module = importlib.import_module(name)
    assert doctest.testmod(module, extraglobs=world, optionflags=flags).failed == 0


def test_every_public_function_of_the_package_has_an_example():
    """STYLE 23: numpydoc with one runnable example per public function."""
    for name in set(cmfsim.__all__) - MADE_BY_STAGES:
        value = getattr(cmfsim, name)
        if callable(value) and not issubclass(type(value), type(ValueError)):
            assert "Examples\n" in (value.__doc__ or ""), name


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/templates.md"])
def test_documented_code_runs(page, tmp_path, monkeypatch):
    """Python blocks of the page, in order, in one namespace."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    assert blocks
    namespace: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, page, "exec"), namespace)  # noqa: S102


def test_every_export_exists_and_the_version_is_one():
    """`__all__` names what is there; package and core carry one version."""
    for name in cmfsim.__all__:
        assert hasattr(cmfsim, name)
    assert sorted(cmfsim.__all__) == sorted(set(cmfsim.__all__))
    cargo = (ROOT / "Cargo.toml").read_text("utf-8")
    assert f'version = "{cmfsim.__version__}"' in cargo
    assert cmfsim.__version__ in (ROOT / "CITATION.cff").read_text("utf-8")
    assert sys.modules["cmfsim._core"].__version__ == cmfsim.__version__
