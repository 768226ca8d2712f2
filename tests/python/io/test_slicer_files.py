"""Files of 3D Slicer from strangers: scenes, bundles, segmentations, headers with SPACE."""

import gzip
import struct
import zipfile

import numpy as np
import pytest

import cmfsim
from cmfsim.drafting import init_case
from cmfsim.io.images.segmentations import read_segmentation
from cmfsim.io.slicer.slicer_scenes import read_slicer_scene, unpack_bundle

POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 2.0, 3.0], [1.0, 6.0, 3.0]])
LPS = POINTS * [-1.0, -1.0, 1.0]
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'


def stl(space):
    rows = struct.pack("<12fH", *([0.0] * 3), *POINTS.ravel(), 0)
    return (
        f"3D Slicer output. SPACE={space}".encode().ljust(80, b"\0") + struct.pack("<I", 1) + rows
    )


def ply(space):
    body = "".join(" ".join(str(v) for v in row) + "\n" for row in POINTS)
    return (
        f"ply\nformat ascii 1.0\ncomment VTK generated PLY File\ncomment SPACE={space}\n"
        "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{body}3 0 1 2\n"
    ).encode()


def obj(space):
    body = "".join("v " + " ".join(str(v) for v in row) + "\n" for row in POINTS)
    return f"#  3D Slicer output. SPACE={space}\n\nmtllib a.mtl\n{body}f 1 2 3\n".encode()


def vtk(space):
    body = "".join(" ".join(str(v) for v in row) + "\n" for row in POINTS)
    return (
        f"# vtk DataFile Version 4.2\n3D Slicer output. SPACE={space}\nASCII\nDATASET POLYDATA\n"
        f"POINTS 3 float\n{body}POLYGONS 1 4\n3 0 1 2\n"
    ).encode()


def vtp(space):
    codes = " ".join(str(ord(c)) for c in space)
    return (
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian"><PolyData><FieldData>'
        f'<Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">{codes} 0</Array>'
        '</FieldData><Piece NumberOfPoints="3" NumberOfPolys="1"><Points><DataArray '
        'type="Float64" NumberOfComponents="3" format="ascii">'
        f"{' '.join(str(v) for v in POINTS.ravel())}</DataArray></Points><Polys>"
        '<DataArray type="Int64" Name="connectivity" format="ascii">0 1 2</DataArray>'
        '<DataArray type="Int64" Name="offsets" format="ascii">3</DataArray>'
        "</Polys></Piece></PolyData></VTKFile>"
    ).encode()


FORMATS = {".stl": stl, ".ply": ply, ".obj": obj, ".vtk": vtk, ".vtp": vtp}


@pytest.mark.parametrize("ending", FORMATS)
def test_a_header_states_the_frame_of_a_surface(tmp_path, ending):
    """SPACE=RAS turns x and y; SPACE=LPS keeps them (Slicer's vtkMRMLModelStorageNode)."""
    path = tmp_path / f"a{ending}"
    for space, wanted in (("RAS", LPS), ("LPS", POINTS)):
        path.write_bytes(FORMATS[ending](space))
        found = np.asarray(cmfsim.read_surface(path).vertices)
        assert np.array_equal(np.sort(found, axis=0), np.sort(wanted, axis=0))


@pytest.mark.parametrize("ending", FORMATS)
def test_a_frame_against_the_header_is_an_error(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    path.write_bytes(FORMATS[ending]("RAS"))
    with pytest.raises(cmfsim.CaseError, match="states RAS, and frame is LPS"):
        cmfsim.read_surface(path, frame="LPS")
    path.write_bytes(FORMATS[ending]("XYZ"))
    with pytest.raises(cmfsim.CaseError, match="SPACE"):
        cmfsim.read_surface(path)


def scene(folder, body, head=HEAD):
    path = folder / "scene.mrml"
    path.write_text(f'{head}<MRML version="Slicer5">{body}</MRML>', encoding="utf-8")
    return path


BOMB = '<!DOCTYPE MRML [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{HEAD}{BOMB}<MRML>&b;</MRML>", "document type"),
        (f'{HEAD}<!DOCTYPE MRML SYSTEM "file:///etc/passwd"><MRML></MRML>', "document type"),
        (f"{HEAD}<MRML>" + 80 * "<a>" + 80 * "</a>" + "</MRML>", "nested"),
        (f"{HEAD}<html></html>", "MRML"),
        (f"{HEAD}<MRML><Model", "cut short"),
        ("", "cut short"),
        ("\0\0", "zero bytes"),
        (f'{HEAD}<MRML><Model id="a"/><Model id="a"/></MRML>', "two nodes"),
    ],
)
def test_a_hostile_scene_is_a_named_error(tmp_path, text, words):
    path = tmp_path / "scene.mrml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=words) as error:
        read_slicer_scene(path)
    assert str(error.value).startswith("scene.mrml")


def storage(name, number=1, cls="Model"):
    return f'<{cls}Storage id="s{number}" fileName="{name}" coordinateSystem="LPS"></{cls}Storage>'


@pytest.mark.parametrize(
    "name", ["../a.stl", "/etc/passwd", "..%2Fa.stl", "C:/a.stl", "gone.stl", 1000 * "x" + ".stl"]
)
def test_files_outside_of_the_folder_are_not_opened(tmp_path, name):
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "a.stl").write_bytes(stl("LPS"))
    path = scene(
        folder, f'<Model id="m" name="Skin" references="storage:s1;"></Model>{storage(name)}'
    )
    node = read_slicer_scene(path).nodes["m"]
    assert node.missing
    with pytest.raises(cmfsim.CaseError, match="neither a CT nor surfaces"):
        init_case(folder)


MOVED = (
    '<Model id="m" name="Mandible" references="storage:s1;transform:t1;"></Model>'
    '<ModelStorage id="s1" fileName="a.stl"></ModelStorage>'
)


LINEAR = '<LinearTransform id="t1" name="A" matrixTransformToParent="{}"/>'


@pytest.mark.parametrize(
    ("transform", "words"),
    [
        ("", "is not in the scene"),
        ('<LinearTransform id="t1" name="A" references="transform:t1;"/>', "its own parent"),
        ('<LinearTransform id="t1" name="A" matrixTransformToParent="1 0 0"/>', "16 are needed"),
        (LINEAR.format("2 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1"), "cannot be used as a rigid motion"),
        (LINEAR.format("nan 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1"), "cannot be used as a rigid motion"),
        ('<BSplineTransform id="t1" name="A"></BSplineTransform>', "check that it is linear"),
        (
            '<LinearTransform id="t1" name="A" references="storage:s2;"/>'
            + storage("gone.h5", 2, "Transform"),
            "does not exist",
        ),
    ],
)
def test_a_bone_under_a_transform_that_is_not_rigid_is_an_error(tmp_path, transform, words):
    (tmp_path / "a.stl").write_bytes(stl("LPS"))
    scene(tmp_path, MOVED + transform)
    with pytest.raises(cmfsim.CaseError, match=words):
        init_case(tmp_path)
    assert not (tmp_path / "case.toml").exists()


def bundle(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


EMPTY = f"{HEAD}<MRML></MRML>"


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"../evil.mrml": EMPTY}, "outside"),
        ({"/evil.mrml": EMPTY}, "outside"),
        ({"a\\..\\evil.mrml": EMPTY}, "outside"),
        ({"C:evil.mrml": EMPTY}, "outside"),
        ({"a/one.mrml": EMPTY, "a/two.mrml": EMPTY}, "2 scenes"),
        ({"a/Data/x.stl": "x"}, "0 scenes"),
        ({"a/s.mrml": EMPTY, "a/S.MRML": EMPTY}, "twice"),
        ({"a": "x", "a/s.mrml": EMPTY}, "as a file and as a folder"),
        ({"b/" + 300 * "x": "x", "a/s.mrml": EMPTY}, "nothing is unpacked"),
        ({"a/s.mrml": EMPTY, "a/zeros": bytes(600 * 2**20)}, "unpacks to"),
    ],
)
def test_a_hostile_bundle_is_a_named_error_and_writes_nothing_outside(tmp_path, members, words):
    folder = tmp_path / "in" / "deep"
    folder.mkdir(parents=True)
    path = bundle(tmp_path / "scene.mrb", members)
    with pytest.raises(cmfsim.CaseError, match=words) as error:
        unpack_bundle(path, folder)
    assert str(error.value).startswith("scene.mrb")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "scene.mrb"]
    assert [p.name for p in (tmp_path / "in").iterdir()] == ["deep"]


def test_a_link_in_a_bundle_is_refused(tmp_path):
    path = tmp_path / "scene.mrb"
    with zipfile.ZipFile(path, "w") as archive:
        link = zipfile.ZipInfo("a/Data")
        link.external_attr = 0o120777 << 16
        archive.writestr(link, "/etc")
    (tmp_path / "in").mkdir()
    with pytest.raises(cmfsim.CaseError, match="link"):
        unpack_bundle(path, tmp_path / "in")


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"no zip at all"])
def test_a_damaged_bundle_is_a_named_error(tmp_path, data):
    (tmp_path / "scene.mrb").write_bytes(data)
    with pytest.raises(cmfsim.CaseError, match="not a 3D Slicer bundle"):
        init_case(tmp_path)


def segmentation(layers, sizes, packing="gzip", more=""):
    voxels = np.asfortranarray(layers).tobytes(order="F")
    data = gzip.compress(voxels) if packing == "gzip" else voxels
    kinds = "list domain domain domain" if len(sizes) == 4 else "domain domain domain"
    none = "none " if len(sizes) == 4 else ""
    head = (
        f"NRRD0004\ntype: unsigned char\ndimension: {len(sizes)}\n"
        "space: left-posterior-superior\n"
        f"sizes: {' '.join(map(str, sizes))}\n"
        f"space directions: {none}(-2,0,0) (0,1,0) (0,0,3)\nkinds: {kinds}\nendian: little\n"
        f"encoding: {packing}\nspace origin: (10,-20,30)\n{more}\n"
    )
    return head.encode() + data


NAMES = (
    "Segment0_Name:=Mandible\nSegment0_LabelValue:=1\nSegment0_Layer:=0\n"
    "Segment1_Name:=Skin\nSegment1_LabelValue:=1\nSegment1_Layer:=1\n"
)


def test_segments_are_read_by_name_from_their_layers(tmp_path):
    """Two segments that overlap lie in two layers, both with label 1."""
    layers = np.zeros((2, 8, 8, 8), np.uint8)
    layers[0, 3:5, 3:5, 3:5] = 1
    layers[1, 1:7, 1:7, 1:7] = 1
    path = tmp_path / "s.seg.nrrd"
    path.write_bytes(segmentation(layers, (2, 8, 8, 8), more=NAMES))
    found = read_segmentation(path)
    assert [segment.name for segment in found.segments] == ["Mandible", "Skin"]
    assert found.mask(found.segments[0]).sum() == 8
    assert found.mask(found.segments[1]).sum() == 216
    assert np.array_equal(found.affine, [[-2, 0, 0, 10], [0, 1, 0, -20], [0, 0, 3, 30]])


def test_a_segmentation_becomes_closed_outward_surfaces_where_its_voxels_lie(tmp_path):
    """The grid's axes are left-handed; the surface's volume is positive all the same."""
    pytest.importorskip("skimage")
    i, j, k = np.indices((80, 160, 60))
    ball = ((i - 40) / 30.0) ** 2 + ((j - 80) / 60.0) ** 2 + ((k - 30) / 20.0) ** 2
    layers = np.stack([ball < 0.25, ball < 1.0]).astype(np.uint8)
    (tmp_path / "s.seg.nrrd").write_bytes(segmentation(layers, layers.shape, more=NAMES))
    init_case(tmp_path)
    case = cmfsim.Case.load(tmp_path)
    skin = cmfsim.read_surface(case.surfaces.skin)
    corners = np.asarray(skin.vertices)[np.asarray(skin.triangles)]
    volume = np.linalg.det(corners).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 60.0 * 60.0 * 60.0, rel=0.03)
    middle = np.asarray(skin.vertices).mean(axis=0)
    assert np.abs(middle - [10.0 - 80.0, -20.0 + 80.0, 30.0 + 90.0]).max() < 1.0


@pytest.mark.parametrize("place", range(4))
def test_layers_are_found_by_the_axis_without_a_direction(tmp_path, place):
    """NRRD lets a file have them at any of its four axes; 3D Slicer writes them first."""
    layers = np.zeros((2, 4, 5, 6), np.uint8)
    layers[0, 1:3, 2:4, 3:5] = 1
    layers[1, 1:3, 1:5, 1:6] = 1
    stored = np.moveaxis(layers, 0, place)
    data = segmentation(stored, stored.shape, more=NAMES)
    directions = ["(-2,0,0)", "(0,1,0)", "(0,0,3)"]
    directions.insert(place, "none")
    kinds = ["domain"] * 3
    kinds.insert(place, "list")
    data = data.replace(b"none (-2,0,0) (0,1,0) (0,0,3)", " ".join(directions).encode())
    data = data.replace(b"list domain domain domain", " ".join(kinds).encode())
    path = tmp_path / "s.seg.nrrd"
    path.write_bytes(data)
    found = read_segmentation(path)
    assert [found.mask(segment).sum() for segment in found.segments] == [8, 40]
    assert np.array_equal(found.affine, [[-2, 0, 0, 10], [0, 1, 0, -20], [0, 0, 3, 30]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data.replace(b"list domain domain", b"domain domain list"), "four axes"),
        (lambda data: data[:-40], "cut short|damaged"),
        (lambda data: data.replace(b"unsigned char", b"double"), "labels are needed"),
        (lambda data: data.replace(b"Segment1_Layer:=1", b"Segment1_Layer:=7"), "layers"),
        (lambda data: data.replace(b"Segment1_Layer:=1", b"Segment1_Layer:=" + 5000 * b"9"), "lay"),
        (lambda data: data.replace(b"encoding: gzip", b"encoding: hex"), "voxels are damaged"),
        (lambda data: data.replace(b"NRRD0004", b"NOPE0004"), "not an NRRD"),
    ],
)
def test_a_damaged_segmentation_is_a_named_error(tmp_path, change, words):
    layers = np.zeros((2, 8, 8, 8), np.uint8)
    layers[:, 2:5, 2:5, 2:5] = 1
    path = tmp_path / "s.seg.nrrd"
    path.write_bytes(change(segmentation(layers, layers.shape, more=NAMES)))
    with pytest.raises(cmfsim.ImageError, match=words):
        read_segmentation(path)
