"""Pictures: the colours that they must show, at the same place for the same input."""

import builtins
import sys
import warnings

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim import pictures
from cmfsim.values.anatomy import segment_colours

pv = pytest.importorskip("pyvista")
SIZE = (800, 300)


@pytest.fixture(scope="module")
def scene():
    """A shell of tissue about a ball; its inner nodes are of every kind, its outer ones free."""
    nodes, tets, inner, _ = meshes.spherical_shell(2, 1, 20.0, 30.0)
    triangles = cmfsim.TetMesh(nodes, tets).boundary_triangles()
    kind = np.zeros(len(nodes), np.uint8)
    z = nodes[inner, 2]
    kind[inner] = np.where(z > 7, 1, np.where(z > -7, 3, 2))
    segment = np.where(kind >= 2, 0, -1).astype(np.int16)
    return nodes, triangles, cmfsim.NodeKinds(kind, segment, ("maxilla",))


def draw_bones(path, bones, size=SIZE):
    """The bones about a skin too small to hide them."""
    pictures.picture_anatomy(path, segment("skin", 0.5, (0, 0, 0)).surface, bones, size=size)


def segment(name, radius, centre):
    vertices, triangles = meshes.icosphere(2, radius)
    image = cmfsim.ImageData(np.zeros((2, 2, 2)), (1, 1, 1))
    return cmfsim.BoneSegment(
        name, image, cmfsim.SurfaceData(vertices + np.asarray(centre), triangles)
    )


@pytest.fixture(scope="module", autouse=True)
def _screen(tmp_path_factory):
    """Skips where this machine cannot draw at all, saying why."""
    path = tmp_path_factory.mktemp("screen") / "ball.png"
    try:
        draw_bones(path, [segment("cranium", 5.0, (0, 0, 0))], (90, 60))
    except cmfsim.CaseError as error:
        pytest.skip(f"cannot draw here: {error}")


def read(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image = pv.read(path)
    width, height, _ = image.dimensions
    return np.asarray(image.active_scalars).reshape(height, width, 3)[::-1].astype(int)


def painted(image, colour, columns=slice(None)):
    """Pixels of a colour's hue in any shade: all channels the same part of the colour's."""
    part = image[:, columns].reshape(-1, 3)
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], dtype=float)
    length = np.linalg.norm(part, axis=1) + 1e-9
    same = part @ wanted / (length * np.linalg.norm(wanted)) > 0.998
    return int((same & (length > 60)).sum())


def test_node_kinds_are_painted_in_the_papers_colours(scene, tmp_path):
    nodes, triangles, kinds = scene
    path = tmp_path / "kinds.png"
    pictures.picture_node_kinds(path, nodes, triangles, kinds, size=SIZE)
    image = read(path)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert (image[0, -1] == 255).all()
    whole, bare = slice(100, 200), slice(400, 600)
    for name in ("fixed", "joined", "sliding"):
        colour = pictures.KIND_COLOURS[name]
        # Inside the shell: hidden in the whole, seen without the free part.
        assert painted(image[:-70], colour, whole) < 10, name
        assert painted(image[:-70], colour, bare) > 200, name
        assert painted(image[-70:], colour) >= 200, name
    # From the front, up is up: fixed is above, joined below.
    column = image[:-70, 500]
    rows = {
        name: np.mean([r for r in range(len(column)) if painted(column[r : r + 1][:, None], c)])
        for name, c in pictures.KIND_COLOURS.items()
        if name != "free"
    }
    assert rows["fixed"] < rows["sliding"] < rows["joined"]


def test_the_same_input_gives_the_same_picture(scene, tmp_path):
    nodes, triangles, kinds = scene
    for name in ("one.png", "other.png"):
        pictures.picture_node_kinds(tmp_path / name, nodes, triangles, kinds, size=SIZE)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "other.png").read_bytes()


def test_segments_and_anatomy_show_each_bone_in_its_colour(tmp_path):
    bones = [segment("maxilla", 8.0, (0, 0, -9)), segment("ramus_left", 8.0, (0, 0, 9))]
    draw_bones(tmp_path / "bones.png", bones)
    image = read(tmp_path / "bones.png")
    for name in ("maxilla", "ramus_left"):
        assert painted(image, segment_colours([name])[name], slice(266, None)) > 500
    skin = segment("skin", 25.0, (0, 0, 0)).surface
    pictures.picture_anatomy(tmp_path / "head.png", skin, bones, size=SIZE)
    through = read(tmp_path / "head.png")
    assert (through != 255).any(axis=2).sum() > 2 * (image != 255).any(axis=2).sum() * 0.5
    # The skin is translucent: the bones behind it stand out from it.
    middle = through[:, 266:532]
    assert len(np.unique(middle.reshape(-1, 3), axis=0)) > 20


def test_left_of_the_patient_is_right_in_the_front_view(tmp_path):
    """Facing the patient: +x (left) is drawn to the right."""
    bones = [segment("ramus_left", 5.0, (20, 0, 0)), segment("ramus_right", 5.0, (-20, 0, 0))]
    draw_bones(tmp_path / "bones.png", bones)
    front = read(tmp_path / "bones.png")[:-70, 266:532]
    left, right = segment_colours(["ramus_left", "ramus_right"]).values()
    assert painted(front, left, slice(133, None)) > 50
    assert painted(front, left, slice(0, 133)) == 0
    assert painted(front, right, slice(0, 133)) > 50


def test_what_cannot_be_drawn_is_named_and_leaves_the_old_picture(scene, tmp_path, monkeypatch):
    nodes, triangles, kinds = scene
    path = tmp_path / "kinds.png"
    path.write_bytes(b"old")
    with pytest.raises(cmfsim.CaseError, match=r"written as \.png"):
        pictures.picture_node_kinds(tmp_path / "kinds.jpg", nodes, triangles, kinds)
    with pytest.raises(cmfsim.CaseError, match="kinds are of"):
        pictures.picture_node_kinds(path, nodes[:-1], [[0, 1, 2]], kinds)
    with pytest.raises(cmfsim.CaseError, match="no boundary triangles"):
        pictures.picture_node_kinds(path, nodes, np.zeros((0, 3), int), kinds)

    def fail(*_, **__):
        message = "no display"
        raise RuntimeError(message)

    monkeypatch.setattr(pv, "Plotter", fail)
    with pytest.raises(cmfsim.CaseError, match=r"kinds\.png: .*no display.*OpenGL"):
        pictures.picture_node_kinds(path, nodes, triangles, kinds)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["kinds.png"]


def test_without_pyvista_the_package_to_install_is_named(scene, tmp_path, monkeypatch):
    nodes, triangles, kinds = scene
    real = builtins.__import__

    def without(name, *rest, **more):
        if name.split(".")[0] == "pyvista":
            message = "libGL.so.1: cannot open shared object file"
            raise ImportError(message)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(cmfsim.CaseError, match=r"pip install '\.\[view\]'.*libgl1"):
        pictures.picture_node_kinds(tmp_path / "kinds.png", nodes, triangles, kinds)
