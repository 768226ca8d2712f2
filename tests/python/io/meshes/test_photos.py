"""3D photos are read with the colours that their textures or vertices have, or refused by name."""

import numpy as np
import pytest

import cmfsim
from cmfsim.io.meshes.photos import photo_files, read_photo

pytest.importorskip("vtkmodules")
image = pytest.importorskip("PIL.Image")

RED, GREEN, BLUE, YELLOW = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)
SQUARE = """mtllib a.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl m
f 1/1 2/2 3/3 4/4
"""
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
0 0 0 255 0 0
1 0 0 0 255 0
0 1 0 0 0 255
3 0 1 2
"""


@pytest.fixture
def square(tmp_path):
    """A square whose texture is red and green above, blue and yellow below."""
    pixels = np.array([[RED, GREEN], [BLUE, YELLOW]], dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    image.fromarray(pixels).save(tmp_path / "skin tone.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd skin tone.png\n")
    (tmp_path / "a.obj").write_text(SQUARE)
    return tmp_path / "a.obj"


def test_a_texture_gives_the_colours_where_the_surface_refers_to_it(square):
    photo = read_photo(square)
    assert len(photo.triangles) > 5_000
    wanted = {(0, 0): BLUE, (1, 0): YELLOW, (1, 1): GREEN, (0, 1): RED}
    for place, colour in zip(photo.vertices, photo.colours.tolist(), strict=True):
        if np.abs(place[:2] - 0.5).min() > 0.01:
            assert tuple(colour) == wanted[int(place[0] > 0.5), int(place[1] > 0.5)]


def test_the_files_of_a_photo_are_its_inputs(square):
    names = [path.name for path in photo_files(square)]
    assert names == ["a.obj", "a.mtl", "skin tone.png"]
    (square.parent / "skin tone.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"skin tone\.png"):
        read_photo(square)


def test_vertices_have_their_colours(tmp_path):
    (tmp_path / "a.ply").write_text(PLY)
    photo = read_photo(tmp_path / "a.ply")
    assert photo.colours.tolist() == [[*RED], [*GREEN], [*BLUE]]
    stated = PLY.replace("ascii 1.0\n", "ascii 1.0\ncomment SPACE=RAS\n")
    (tmp_path / "b.ply").write_text(stated)
    turned = read_photo(tmp_path / "b.ply")
    np.testing.assert_array_equal(turned.vertices, photo.vertices * (-1, -1, 1))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("a.obj", ("mtllib a.mtl\n", ""), "has no colours: it must name one material"),
        ("a.mtl", ("map_Kd skin tone.png\n", ""), "has no colours: it must name one material"),
        ("a.mtl", ("skin tone.png", "../skin.png"), "a file in the same folder or below is needed"),
        ("a.mtl", ("skin tone.png", "/etc/passwd"), "a file in the same folder or below is needed"),
        ("a.obj", ("usemtl m\n", "usemtl other\n"), "has no triangle with a texture"),
        ("a.obj", ("f 1/1 2/2 3/3 4/4", "f 1 2 3 4"), "has no triangle with a texture"),
        ("a.obj", ("v 1 1 0", "v nan 1 0"), "a.obj"),
    ],
)
def test_a_photo_without_colours_or_with_files_elsewhere_is_refused(square, name, change, message):
    file = square.parent / name
    file.write_text(file.read_text().replace(*change))
    with pytest.raises(cmfsim.CaseError, match=message):
        read_photo(square)


def test_a_texture_that_is_no_picture_is_refused(square):
    (square.parent / "skin tone.png").write_bytes(b"\x89PNG\r\n\x1a\nno picture")
    with pytest.raises(cmfsim.CaseError, match=r"a\.obj"):
        read_photo(square)


@pytest.mark.parametrize(
    ("name", "text"), [("a.ply", PLY.replace("uchar red", "uchar r")), ("a.stl", "solid")]
)
def test_a_surface_without_colours_is_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(cmfsim.CaseError, match="colours"):
        read_photo(tmp_path / name)
