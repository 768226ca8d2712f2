"""Hard CTs and given surfaces of real heads through the whole build, at coarse settings."""

import contextlib
import functools
import io
import json

import numpy as np
import pytest

import cmfsim
import phantom_reference
from benches.scenes import ct_variants as variants
from cmfsim.cli import main
from cmfsim.pipeline.outputs import model as model_output
from real_heads import data_folder

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")

CASE = """format = "cmfsim-case"
version = 1
name = "head"

[mesh]
edge_length = 8.0

[landmarks]
skull = "skull.mrk.json"

[[osteotomies]]
procedure = "le_fort_1"

[plan.maxilla]
translation = [0, -4, 0]
"""
IMAGE = """
[image]
file = "ct.nrrd"
"""
SURFACES = """
[surfaces]
skin = "skin.ply"

[surfaces.bones]
cranium = "cranium.ply"
mandible = "mandible.ply"
"""
# Tissue of the phantom's CT at 2 mm and this edge, as the build found it, mm³.
ORDINARY = 1.2056e6
# How each is made harder, the finding that reports it, the part of the ordinary volume of tissue
# that is left (a head cut off has less of it), how near the face is to the reference: median
# and 95th percentile of distances, mm, and least Dice of the mandible; None: not measured.
HARD = {
    "metal": (variants.with_metal, {"metal"}, (0.9, 1.1), (0.4, 3.0, 0.75)),
    "chin off": (
        lambda i: variants.cropped(i, 2, low=352.0),
        {"ct-cut-off"},
        (0.5, 0.95),
        (0.3, 1.0, None),
    ),
    "forehead off": (
        lambda i: variants.cropped(i, 2, high=455.0),
        {"ct-cut-off"},
        (0.5, 1.0),
        (0.3, 1.0, 0.85),
    ),
    "nose off": (
        lambda i: variants.cropped(i, 1, low=-308.0),
        {"ct-cut-off"},
        (0.9, 1.0),
        (0.3, 3.0, 0.9),
    ),
    "pillow and holder": (
        lambda i: variants.with_holder(variants.with_pillow(variants.without_couch(i, -107.0))),
        {"rest-removed"},
        (0.9, 1.1),
        (0.3, 1.0, 0.9),
    ),
    "noise": (lambda i: variants.with_noise(i, 60.0), set(), (0.9, 1.1), (0.3, 1.0, 0.85)),
    "voxels of 3 mm": (lambda i: resampled(i, 3.0), {"ct-spacing-coarse"}, (0.85, 1.1), None),
    "raw": (
        lambda i: i.with_values((i.values.astype(np.int32) + 1024).astype(np.uint16)),
        {"ct-not-hu"},
        (0.95, 1.05),
        (0.3, 1.0, 0.9),
    ),
}


def resampled(image, step):
    """The image at another spacing, linearly."""
    sitk = pytest.importorskip("SimpleITK")
    whole = sitk.GetImageFromArray(np.ascontiguousarray(image.values.T))
    whole.SetSpacing(np.asarray(image.spacing).tolist())
    size = [int(n * s / step) for n, s in zip(image.values.shape, image.spacing, strict=True)]
    made = sitk.Resample(
        whole, size, sitk.Transform(), sitk.sitkLinear, (0.0,) * 3, (step,) * 3, np.eye(3).ravel()
    )
    return cmfsim.ImageData(sitk.GetArrayFromImage(made).T, (step,) * 3, image.lowest)


@pytest.fixture(scope="module")
def coarse():
    """The phantom's CT at about 2 mm."""
    return variants.coarser(
        cmfsim.read_image(data_folder() / "ct_phantom" / "ct.nii.gz"), (2, 2, 1)
    )


def landmarks_of(head, folder):
    """Its landmarks, beside the case."""
    text = (data_folder() / head / "skull_landmarks.mrk.json").read_text(encoding="utf-8")
    (folder / "skull.mrk.json").write_text(text, encoding="utf-8")


def built(folder):
    """The summary of a case that the command line builds, and its anatomy.

    Without pictures, which are a third of the time; test_build.py looks at those of a head.
    """
    out, err = io.StringIO(), io.StringIO()
    models = []
    build = model_output.build_model

    def build_model(case, **options):
        models.append(build(case, **options))
        return models[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_output, "build_model", build_model)
        patch.setattr(model_output, "_draw", lambda *_: [])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(["build", str(folder / "case.toml"), "--json", "-q"])
    assert code == 0, err.getvalue()
    summary = json.loads(out.getvalue())
    mesh = summary["mesh"]
    assert mesh["min_dihedral"] >= 10.0
    assert mesh["boundary_error_mean"] <= 8.0 / 4.0
    assert abs(mesh["volume_error"]) < 0.06
    assert summary["segments"]["maxilla"]["joined"] > 30
    assert summary["segments"]["maxilla"]["sliding"] > 30
    assert not [f for f in summary["findings"] if f["severity"] == "error"]
    return summary, models[0].anatomy


# The others take as long again, and are near to one of these.
OFTEN = ("metal", "chin off")


@pytest.fixture(
    scope="module",
    params=[k if k in OFTEN else pytest.param(k, marks=pytest.mark.slow) for k in HARD],
)
def hard(request, coarse, tmp_path_factory):
    """A hard CT, built: its name, summary and anatomy."""
    folder = tmp_path_factory.mktemp("hard")
    cmfsim.write_image(HARD[request.param][0](coarse), folder / "ct.nrrd")
    landmarks_of("ct_phantom", folder)
    (folder / "case.toml").write_text(CASE + IMAGE, encoding="utf-8")
    return request.param, *built(folder)


def test_a_hard_ct_builds_and_says_what_was_hard(hard):
    name, summary, _ = hard
    _, expected, (least, most), _ = HARD[name]
    assert expected <= {f["code"] for f in summary["findings"]}
    assert least < summary["mesh"]["volume"] / ORDINARY < most


# test_imaging.py compares faces of changed images in the ordinary run.
@pytest.mark.slow
@pytest.mark.parametrize("hard", [name for name in HARD if HARD[name][-1]], indirect=True)
def test_a_hard_ct_keeps_its_face(hard):
    name, _, anatomy = hard
    phantom_reference.check_face(anatomy, phantom_reference.reference(), *HARD[name][-1])


def test_a_flipped_ct_is_refused(coarse, tmp_path, capsys):
    """Its landmarks say so before anything is built."""
    flipped = coarse.with_values(np.flip(coarse.values, 1))
    cmfsim.write_image(flipped, tmp_path / "ct.nrrd")
    landmarks_of("ct_phantom", tmp_path)
    (tmp_path / "case.toml").write_text(CASE + IMAGE, encoding="utf-8")
    assert main(["build", str(tmp_path / "case.toml"), "-q"]) == 2
    assert not (tmp_path / "out").exists()
    assert "error" in capsys.readouterr().err


@pytest.fixture(scope="module")
def from_surfaces(tmp_path_factory):
    """The atlas head by its closed skin or by its open one, built once: folder and summary."""

    @functools.cache
    def made(skin):
        folder = tmp_path_factory.mktemp(skin)
        for name in (skin, "cranium", "mandible"):
            (folder / f"{name}.ply").symlink_to(data_folder() / "atlas_head" / f"{name}.ply")
        landmarks_of("atlas_head", folder)
        text = (CASE + SURFACES).replace("skin.ply", f"{skin}.ply")
        (folder / "case.toml").write_text(text, encoding="utf-8")
        return folder, built(folder)[0]

    return made


def test_sliding_settles_on_a_real_dental_arch(from_surfaces):
    """The upper jaw of the atlas head moves: all sliding nodes end on their surfaces, soon."""
    folder, _ = from_surfaces("skin")
    scene = cmfsim.read_scene(folder / "out" / "scene.npz")
    solver = cmfsim.scene_solver(scene)
    middle = np.asarray(scene.nodes)[scene.segments["maxilla"].sliding].mean(axis=0)
    for motion in (
        cmfsim.rigid_motion((0, -8, 0)),
        cmfsim.rigid_motion((0, 5, 0)),
        cmfsim.rigid_motion((0, 0, 3)),
        cmfsim.rigid_motion((0, 0, 5)),
        cmfsim.rigid_motion((0, 0, 0), 5.0, (1, 0, 0), middle),
        cmfsim.rigid_motion((0, 0, 0), 5.0, (0, 0, 1), middle),
    ):
        result = solver.solve({"maxilla": motion, "mandible": np.eye(4)})
        assert result.contact_converged
        assert result.contact_gap <= 1e-4
        assert result.contact_iterations <= 20
        assert result.residual < 1e-5


# That the open skin closes to the closed one is tested by surfaces/test_surface_checks.py.
@pytest.mark.slow
def test_open_and_closed_skin_give_the_same_tissue(from_surfaces):
    closed, opened = (from_surfaces(n)[1]["mesh"]["volume"] for n in ("skin", "skin_open"))
    assert opened == pytest.approx(closed, rel=0.005)
    assert 0.5e6 < closed < 2.5e6
    assert "surface-open" in {f["code"] for f in from_surfaces("skin_open")[1]["findings"]}
