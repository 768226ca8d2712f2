"""Bones of a label image beside a CT: the skin is the CT's, and both must lie in one place."""

import json

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.pipeline.building.inputs import input_hashes, read_anatomy
from label_images import ORIGIN, SPACING, labels, masks

pytest.importorskip("scipy")
pytest.importorskip("skimage")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A CT and the labels of both jaws in a folder, with the case that `init` makes of them."""
    path = tmp_path_factory.mktemp("labelled")
    head = masks()
    values = np.where(head.pop("Skin"), 40.0, -1000.0)
    for mask in head.values():
        values[mask] = 1000.0
    cmfsim.write_image(cmfsim.ImageData(values.astype(np.int16), SPACING, ORIGIN), path / "ct.nrrd")
    (path / "dataset.json").write_text(
        json.dumps({"labels": {name: n for n, name in enumerate(head, start=1)}}), encoding="utf-8"
    )
    cmfsim.write_image(cmfsim.ImageData(labels(head), SPACING, ORIGIN), path / "labels.nrrd")
    assert main(["init", str(path)]) == 0
    return path


def test_init_takes_bones_of_labels_and_the_skin_of_the_ct(folder):
    case = cmfsim.Case.load(folder / "case.toml")
    assert case.image.file.name == "ct.nrrd"
    assert set(case.image.bones) == {"cranium", "mandible"}
    assert all(path.is_file() for path in case.image.bones.values())
    assert any("mandible.ply" in name for name in input_hashes(case))


def test_bones_are_those_of_the_labels_with_their_teeth(folder):
    anatomy, findings = read_anatomy(cmfsim.Case.load(folder / "case.toml"), {}, lambda _: None)
    assert set(anatomy.bones) == {"cranium", "mandible"}
    # By the labels, so that nothing separates the jaws by their shape.
    assert not any(finding.code.startswith("jaws-") for finding in findings)
    voxel = float(np.prod(anatomy.skin.spacing))
    head = masks()
    for name, parts in (
        ("cranium", ("Maxilla & Upper Skull", "Upper Teeth")),
        ("mandible", ("Mandible", "Lower Teeth")),
    ):
        label = np.logical_or(*(head[part] for part in parts)).sum() * np.prod(SPACING)
        found = np.count_nonzero(anatomy.bones[name].values > 0.0) * voxel
        assert found == pytest.approx(label, rel=0.15)


def test_bones_of_another_scan_are_refused_by_name(folder, tmp_path):
    surface = cmfsim.read_surface(folder / "from_scene" / "mandible.ply")
    moved = cmfsim.SurfaceData(surface.vertices + [0.0, 12.0, 0.0], surface.triangles)
    cmfsim.write_surface(tmp_path / "mandible.ply", moved)
    text = (folder / "case.toml").read_text(encoding="utf-8")
    for name in ("ct.nrrd", "from_scene/cranium.ply"):
        text = text.replace(f'"{name}"', f'"{(folder / name).as_posix()}"')
    text = text.replace("from_scene/mandible.ply", "mandible.ply")
    (tmp_path / "case.toml").write_text(text, encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"mandible\.ply lies where .* \(bones-not-of-image"):
        read_anatomy(cmfsim.Case.load(tmp_path / "case.toml"), {}, lambda _: None)


def test_a_bone_without_a_file_is_refused_and_never_becomes_soft_tissue(folder, tmp_path):
    text = (folder / "case.toml").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("cranium =")]
    text = "\n".join(lines).replace('"ct.nrrd"', f'"{(folder / "ct.nrrd").as_posix()}"')
    mandible = (folder / "from_scene/mandible.ply").as_posix()
    text = text.replace('"from_scene/mandible.ply"', f'"{mandible}"')
    (tmp_path / "case.toml").write_text(text, encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"image\.bones.*cranium has no file"):
        read_anatomy(cmfsim.Case.load(tmp_path / "case.toml"), {}, lambda _: None)
