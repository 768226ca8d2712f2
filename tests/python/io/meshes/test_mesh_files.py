"""Files of surfaces and meshes: each form is read, and each fault has an error that names it."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from refused_surfaces import refused, saved

import cmfsim
from benches.scenes import meshes
from cmfsim.io.meshes.mesh_files import read_mesh
from head_case import icosphere

meshio = pytest.importorskip("meshio")
CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]

# OBJ.

CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OBJ = {
    "plain": CORNERS + "f 1 3 2\nf 1 2 4\n",
    "from the end": CORNERS + "f -4 -2 -3\nf 1 2 -1\n",
    "defined so far": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -1 -2\nv 0 0 1\nf 1 2 -1\n",
    "textures": "vt 0 0\n" + CORNERS + "f 1/1 3/1 2/1\nf 1/1/1 2/1/1 4/1/1\n",
    "normals": "vn 0 0 1\n" + CORNERS + "f 1//1 3//1 2//1\nf -4//-1 2//1 4//1\n",
    "other lines": "# by hand\nmtllib a.mtl\no it\n"
    + CORNERS
    + "usemtl x\ns 1\nf 1 3 2\nf 1 2 4\n",
    "colours": CORNERS.replace("\n", " 0.5 0.5 0.5\n") + "f 1 3 2\nf 1 2 4",
    "tabs and returns": (CORNERS + "f 1 3 2\nf\t1 2 4\n")
    .replace("\n", "\r\n")
    .replace("v ", "v\t"),
    "continued": CORNERS + "f 1 \\\n3 2\nf 1 2 4\n",
    "weights of 1": CORNERS.replace("\n", " 1.00000\n") + "f 1 3 2\nf 1 2 4\n",
    "weights of 1e0": CORNERS.replace("\n", " +1e+00\n") + "f 1 3 2\nf 1 2 4\n",
    "colours of four parts": CORNERS.replace("\n", " 0.5 0.5 0.5 1.0\n") + "f 1 3 2\nf 1 2 4",
    "comments behind": CORNERS.replace("\n", " # a corner\n") + "f 1 3 2 # a\nf 1 2 4 #\n",
    "returns alone": (CORNERS + "f 1 3 2\nf 1 2 4\n").replace("\n", "\r"),
    "slashes alone": CORNERS + "f 1// 3// 2//\nf 1/ 2/ 4/\n",
    "the end of DOS": CORNERS + "f 1 3 2\nf 1 2 4\n\x1a",
    "zeros at the end": CORNERS + "f 1 3 2\nf 1 2 4\n\0\0",
    "a mark of UTF-8": "\ufeff# by hand\n" + CORNERS + "f 1 3 2\nf 1 2 4\n",
}


@pytest.mark.parametrize("form", OBJ)
def test_obj_is_read_in_every_form(form, tmp_path):
    surface = cmfsim.read_surface(saved(tmp_path, "it.obj", OBJ[form]))
    assert surface.triangles.tolist() == [[0, 2, 1], [0, 1, 3]]
    assert surface.vertices[3].tolist() == [0, 0, 1]


BAD_OBJ = {
    "f 1 2 0": "line 5: names vertex 0; OBJ numbers vertices from 1 on",
    "f 1 2 5": "line 5: names vertex 5, but there are 4 vertices",
    "f 1 2 -5": "line 5: names vertex -5, but there are 4 vertices",
    "f 1 2": "line 5: a face has 2 corners",
    "f 1 2 3.0": "line 5: '3.0' is not a whole number",
    "f 1 2 99999999999999999999": "line 5: '99999999999999999999' is not a whole number",
    f"f 1 2 {'9' * 5000}": "line 5: '9*'… is not a whole number",
    "f 1 2 1_0": "line 5: '1_0' is not a whole number",
    "f 1/a 2 3": "line 5: '/a' is not a texture or normal",
    "f 1/1/1/1 2 3": "line 5: '/1/1/1' is not a texture or normal",
    "v 0 0\nf 1 2 3": "line 5: a vertex has 2 numbers",
    "v 0 0 nan\nf 1 2 3": "line 5: 'nan' is not finite",
    "v 0 0 1e999\nf 1 2 3": "line 5: '1e999' is not finite",
    "v 0 0 1e30\nf 1 2 3": "point 4 has the coordinate 1e.30: at most 1e.09 is read, in any unit",
    "f 1//1 2 //3 3": "line 5: '//3' is not a texture or normal",
    "v 0 0 1 2\nf 1 2 3": "line 5: a vertex has the weight '2': only 1 is read",
    "v 0 0 1 2 3\nf 1 2 3": "line 5: a vertex has 5 numbers",
    "fo 1 2 3": "line 5: 'fo' is not known in OBJ",
    "f 1 2 3\n# 5 vertices": "a comment states 5 vertices, the file holds 4",
    "f 1 2 3\n# Faces: 2": "a comment states 2 faces, the file holds 1",
    "f 1 2 3\0\n": "zero bytes",
    "": "found nothing",
}


@pytest.mark.parametrize("line", BAD_OBJ)
def test_a_fault_in_obj_is_named_with_its_line(line, tmp_path):
    refused(saved(tmp_path, "it.obj", CORNERS + line + "\n"), BAD_OBJ[line])


# PLY.


def ply(order="ascii", face="property list uchar int vertex_indices", faces=(), vertices=CUBE):
    """A PLY file; faces come before vertices and rows have colours, as the format allows."""
    head = (
        f"ply\nformat {order} 1.0\nobj_info x\nelement face {len(faces)}\nproperty uchar flags\n"
        f"{face}\nelement vertex {len(vertices)}\nproperty uchar red\nproperty double x\n"
        "property double y\nproperty double z\nproperty list uchar short more\nend_header\n"
    )
    kinds = {"uchar": "B", "char": "b", "short": "h", "ushort": "H", "int": "i", "uint": "I"}
    kinds |= {"float": "f", "double": "d"}
    _, _, count, whole, _ = face.split() if " list " in face else (None, None, "uchar", "int", None)
    if order == "ascii":
        rows = [f"7 {len(f)} {' '.join(map(str, f))}\n" for f in faces]
        rows += [f"9 {x!r} {y!r} {z!r} 2 5 6\n" for x, y, z in np.asarray(vertices).tolist()]
        return (head + "".join(rows)).encode()
    e = ">" if "big" in order else "<"
    rows = [struct.pack(f"{e}B{kinds[count]}{len(f)}{kinds[whole]}", 7, len(f), *f) for f in faces]
    rows += [struct.pack(f"{e}BdddBhh", 9, *v, 2, 5, 6) for v in vertices]
    return head.encode() + b"".join(rows)


TRIANGLES = [t for a, b, c, d in QUADS for t in ([a, b, c], [a, c, d])]
ORDERS = ["ascii", "binary_little_endian", "binary_big_endian"]
LISTS = ["uchar int", "int uint", "uchar ushort", "ushort short", "uchar char"]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("kinds", LISTS)
def test_ply_is_read_with_any_order_of_elements_and_types(order, kinds, tmp_path):
    face = f"property list {kinds} vertex_index"
    path = saved(tmp_path, "it.ply", ply(order, face, TRIANGLES))
    surface = cmfsim.read_surface(path)
    assert surface.triangles.tolist() == TRIANGLES
    assert np.array_equal(surface.vertices, CUBE)


@pytest.mark.parametrize("order", ORDERS)
def test_polygons_become_the_triangles_that_fill_them(order, tmp_path):
    """A cube of quads and one of mixed faces: volume 1, closed, outward."""
    for faces in (QUADS, [*TRIANGLES[:4], *QUADS[2:]]):
        surface = cmfsim.read_surface(saved(tmp_path, "it.ply", ply(order, faces=faces)))
        report = cmfsim.check_surface(surface)
        assert report.is_closed
        assert report.volume == pytest.approx(1.0, abs=1e-15)
        assert len(surface.triangles) == 12


def test_a_polygon_with_a_dent_is_cut_where_a_fan_fills_it_and_else_refused(tmp_path):
    dart = [[0, 0, 0], [2, 0, 0], [0.5, 0.5, 0], [0, 2, 0]]
    for start in range(4):
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in np.roll(dart, start, axis=0))
        surface = cmfsim.read_surface(saved(tmp_path, "dart.obj", text + "f 1 2 3 4\n"))
        assert cmfsim.check_surface(surface).area == pytest.approx(1.0)
    bow = "v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1.5 0\nf 1 2 3 4\n"
    refused(saved(tmp_path, "bow.obj", bow), "face 0 has 4 corners that no fan of triangles fills")


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"faces": [[0, 1, 8]]}, "face 0 names vertex 8, but there are 8 vertices.*from 1"),
        ({"faces": [[0, 2, 1], [0, 1, -1]]}, "face 1 names vertex -1, but there are 8"),
        ({"faces": [[0, 1, 2, -1]]}, "face 0 names vertex -1"),
        ({"faces": [[0, 1, 2], [0, 1]]}, "face 1 has 2 corners"),
        ({"faces": [[0, 1, 2]], "vertices": CUBE + np.inf}, "not finite"),
        (
            {"faces": [[0, 1, 2]], "face": "property list uchar float vertex_indices"},
            "not a list of whole",
        ),
        ({"faces": [[0, 1, 2]], "face": "property list uchar int corners"}, "0 properties"),
        ({"faces": [[0, 1, 2]], "face": "property list float int vertex_index"}, "types are"),
    ],
)
def test_a_fault_in_ply_is_named(order, change, match, tmp_path):
    content = ply(order, **{"face": "property list uchar int vertex_indices", **change})
    refused(saved(tmp_path, "it.ply", content), match)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("change", [-9, -1, 40])
def test_ply_with_another_length_than_its_header_states_is_refused(order, change, tmp_path):
    content = ply(order, faces=TRIANGLES)
    more = b"1 " if order == "ascii" else bytes(2)
    content = content[:change] if change < 0 else content + more * change
    if order == "ascii" and change == -1:
        content = content[:-4]
    refused(saved(tmp_path, "it.ply", content), "cut short|more than its header|numbers are left")


@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_ply_with_something_left_that_is_no_row_is_read_with_a_warning(order, tmp_path):
    """Three bytes, zeros, and a text; but not a face more than the header states."""
    content = ply_of_faces_last(order)
    more = (b"\0\0\0", bytes(100), b"made by hand") if order != "ascii" else (b"0 0", b"by hand")
    for extra in more:
        read = cmfsim.io.read_surface_file(saved(tmp_path, "it.ply", content + extra))
        assert read.surface.triangles.tolist() == TRIANGLES
        (finding,) = read.findings
        assert (finding.severity, finding.code) == ("warning", "field-ignored")
        assert finding.where == "it.ply"
        assert str(len(extra.split()) if order == "ascii" else len(extra)) in finding.what
    face = struct.pack("<B3i", 3, 0, 1, 2) if order != "ascii" else b"3 0 1 2\n"
    refused(saved(tmp_path, "it.ply", content + face), "they read as another face")


def ply_of_faces_last(order):
    head = (
        f"ply\nformat {order} 1.0\nelement vertex {len(CUBE)}\nproperty double x\n"
        f"property double y\nproperty double z\nelement face {len(TRIANGLES)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    if order == "ascii":
        rows = [" ".join(map(str, row)) for row in CUBE.tolist()]
        rows += [f"3 {a} {b} {c}" for a, b, c in TRIANGLES]
        return (head + "\n".join(rows) + "\n").encode()
    faces = b"".join(struct.pack("<B3i", 3, *t) for t in TRIANGLES)
    return head.encode() + CUBE.astype("<f8").tobytes() + faces


def test_what_was_ignored_in_a_surface_is_logged_where_nobody_asks(tmp_path, caplog):
    path = saved(tmp_path, "it.ply", ply_of_faces_last("binary_little_endian") + b"\0\0\0")
    cmfsim.read_surface(path)
    assert "it.ply: 3 bytes after the last row were ignored" in caplog.text


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_strips_of_a_ply_become_triangles_that_face_one_way(order, tmp_path):
    """One list in which -1 ends a strip, as scans of Stanford have it."""
    strips = [0, 1, 2, 3, -1, 4, 6, 5, 7, -1]
    head = (
        f"ply\nformat {order} 1.0\nelement vertex {len(CUBE)}\nproperty double x\n"
        "property double y\nproperty double z\nelement tristrips 1\n"
        "property list int int vertex_indices\nend_header\n"
    )
    if order == "ascii":
        rows = [" ".join(map(str, row)) for row in CUBE.tolist()]
        body = "\n".join([*rows, f"{len(strips)} {' '.join(map(str, strips))}\n"]).encode()
    else:
        e = ">" if "big" in order else "<"
        body = CUBE.astype(f"{e}f8").tobytes()
        body += struct.pack(f"{e}{1 + len(strips)}i", len(strips), *strips)
    surface = cmfsim.read_surface(saved(tmp_path, "it.ply", head.encode() + body))
    assert surface.triangles.tolist() == [[0, 1, 2], [2, 1, 3], [4, 6, 5], [5, 6, 7]]
    bad = head.encode() + body.replace(b" 3 -1", b" 9 -1")
    if order == "ascii":
        refused(saved(tmp_path, "bad.ply", bad), "names vertex 9")


# STL.


def stl_text(corners, name="it"):
    lines = [f"solid {name}"]
    for triangle in corners:
        lines += ["facet normal 0 0 0", " outer loop"]
        lines += ["  vertex {!r} {!r} {!r}".format(*map(float, corner)) for corner in triangle]
        lines += [" endloop", "endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""]).encode()


@pytest.fixture
def ball(tmp_path):
    vertices, triangles = icosphere(1)
    surface = cmfsim.SurfaceData(vertices.astype(np.float32).astype(float), triangles)
    path = tmp_path / "ball.stl"
    cmfsim.write_surface(path, surface)
    return path.read_bytes(), np.asarray(surface.vertices)[np.asarray(surface.triangles)]


def test_stl_is_told_apart_by_its_content(ball, tmp_path):
    """Bytes that begin with "solid" are bytes; text in capitals, or of two solids, is text."""
    binary, corners = ball
    half = len(corners) // 2
    for content in (
        b"solid " + binary[6:],
        stl_text(corners),
        stl_text(corners).upper(),
        stl_text(corners[:half], "one facet") + stl_text(corners[half:], "two"),
        b"\xef\xbb\xbf" + stl_text(corners) + b"\x1a",
        stl_text(corners).replace(b"normal 0 0 0", b"normal -1.#IND nan nan") + b"\0\0",
    ):
        surface = cmfsim.read_surface(saved(tmp_path, "it.stl", content))
        assert np.array_equal(surface.vertices[surface.triangles], corners)


def test_stl_of_another_length_than_its_count_is_refused(ball, tmp_path):
    binary, corners = ball
    count = struct.unpack("<I", binary[80:84])[0]
    for content, match in (
        (binary[:-50], f"states {count} triangles, which take {len(binary)} bytes"),
        (binary + bytes(50), f"states {count} triangles"),
        (b"solid " + binary[6:-50], f"states {count} triangles"),
        (binary[:80] + struct.pack("<I", count - 1) + binary[84:], "states 79 triangles"),
        (binary[:80] + struct.pack("<I", 2**32 - 1) + binary[84:], "states 4294967295"),
        (binary[:83], "83 bytes, a header has 84"),
        (stl_text(corners).replace(b"endsolid it\n", b""), "1 solids begin and 0 end"),
        (stl_text(corners).replace(b"endsolid it", b"endsolid= it"), "1 solids begin and 0 end"),
        (stl_text(corners).replace(b"endfacet", b"", 1), "words are not 21 for each facet"),
        (stl_text(corners).replace(b"vertex", b"vortex", 1), "facet 0 has 'vortex'"),
        (stl_text(corners).replace(b"loop\n  vertex", b"loop\n  vertex 1e999", 1), "words"),
        (stl_text([*corners, [[0, 0, np.nan]] * 3]), "facet 80: 'nan' is not finite"),
        (binary[:96] + struct.pack("<f", np.inf) + binary[100:], "triangle 0 .* not finite"),
    ):
        refused(saved(tmp_path, "it.stl", content), match)


def test_stl_with_a_few_bytes_left_is_read_with_a_warning(ball, tmp_path):
    """A triangle takes 50 bytes: fewer are none."""
    binary, corners = ball
    for more in (1, 2, 49):
        path = saved(tmp_path, "it.stl", binary + b"\0" * more)
        read = cmfsim.io.read_surface_file(path)
        assert np.array_equal(read.surface.vertices[read.surface.triangles], corners)
        assert [f.code for f in read.findings] == ["field-ignored"]


def test_stl_whose_count_was_never_written_is_read_with_a_warning(ball, tmp_path):
    """Programs that write as they go leave 0 there."""
    binary, corners = ball
    path = saved(tmp_path, "it.stl", binary[:80] + bytes(4) + binary[84:])
    read = cmfsim.io.read_surface_file(path)
    assert np.array_equal(read.surface.vertices[read.surface.triangles], corners)
    (finding,) = read.findings
    assert f"has bytes for {len(corners)}" in finding.what


# Volumes.

NODES, TETS = meshes.box((2, 2, 2), (4.0, 4.0, 4.0))


def volume(tmp_path, name, **how):
    """Tets, and triangles where the format takes them beside each other, with values on both."""
    path = tmp_path / name
    cells = {"tetra": TETS.astype(np.int64), "triangle": TETS[:4, :3].astype(np.int64)}
    gmsh = path.suffix == ".msh"
    if gmsh:
        del cells["triangle"]
    mesh = meshio.Mesh(
        NODES,
        cells,
        point_data={"kind": np.arange(len(NODES)) % 4.0},
        cell_data={"young": [np.arange(float(len(TETS))), np.zeros(4)][: len(cells)]},
    )
    if gmsh:
        mesh.point_data["gmsh:dim_tags"] = np.full((len(NODES), 2), 3)
        mesh.cell_data |= {
            f"gmsh:{key}": [np.full(len(TETS), 3)] for key in ("geometrical", "physical")
        }
        # meshio 5.3 writes numbers as np.float64(0.0) with numpy 2.
        with np.printoptions(legacy="1.25"):
            mesh.write(path, **how)
    else:
        mesh.write(path, **how)
    return path


FORMS = [
    ("it.vtu", {"binary": True}),
    ("it.vtu", {"binary": False}),
    ("it.vtu", {"compression": None}),
    ("it.vtk", {"file_format": "vtk42", "binary": True}),
    ("it.vtk", {"file_format": "vtk42", "binary": False}),
    ("it.vtk", {"file_format": "vtk51", "binary": True}),
    ("it.vtk", {"file_format": "vtk51", "binary": False}),
    ("it.msh", {"file_format": "gmsh22", "binary": False}),
    ("it.msh", {"file_format": "gmsh22", "binary": True}),
    ("it.msh", {"file_format": "gmsh", "binary": False}),
    ("it.msh", {"file_format": "gmsh", "binary": True}),
    ("it.mesh", {}),
    ("it.inp", {}),
]


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(("name", "how"), FORMS)
def test_a_volume_is_read_as_meshio_wrote_it(name, how, tmp_path):
    path = volume(tmp_path, name, **how)
    nodes, tets = cmfsim.read_tet_mesh(path)
    assert np.array_equal(nodes, NODES)
    assert np.array_equal(np.sort(tets, axis=1), np.sort(TETS, axis=1))
    mesh = read_mesh(path)
    if path.suffix in {".vtu", ".vtk", ".msh"}:
        assert np.array_equal(np.ravel(mesh.point_data["kind"]), np.arange(len(NODES)) % 4)
        assert np.array_equal(np.ravel(mesh.cell_data["young"][0]), np.arange(len(TETS)))
        whole = path.read_bytes()
        for share in (0.2, 0.5, 0.8, 0.97):
            path.write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(cmfsim.CaseError, match=path.name):
                cmfsim.read_tet_mesh(path)


def test_gmsh_numbers_of_nodes_are_looked_up(tmp_path):
    """In any order and with gaps; 0 and one that is not there are no node (meshio wraps round)."""
    text = (
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 4 3 40\n3 1 0 4\n40\n3\n7\n8\n"
        "0 0 0\n1 0 0\n0 1 0\n0 0 1\n$EndNodes\n"
        "$Elements\n1 1 1 1\n3 1 4 1\n1 40 3 7 {}\n$EndElements\n"
    )
    nodes, tets = cmfsim.read_tet_mesh(saved(tmp_path, "it.msh", text.format(8)))
    assert tets.tolist() == [[0, 1, 2, 3]]
    assert nodes[3].tolist() == [0, 0, 1]
    for node in (0, 9, 41, 2**62):
        with pytest.raises(cmfsim.CaseError, match=f"refers to node {node}, which does not exist"):
            cmfsim.read_tet_mesh(saved(tmp_path, "it.msh", text.format(node)))
    for old, new, match in (
        ("1 4 3 40", "1 5 3 40", "states 5 nodes, its blocks hold 4"),
        ("1 1 1 1\n", "1 2 1 1\n", "states 2 elements, its blocks hold 1"),
        ("40\n3\n", "3\n3\n", "node 3 appears twice"),
        ("0 0 1\n", "0 0 inf\n", "not finite"),
    ):
        with pytest.raises(cmfsim.CaseError, match=match):
            cmfsim.read_tet_mesh(saved(tmp_path, "it.msh", text.format(8).replace(old, new, 1)))


GMSH_2 = (
    "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n40 0 0 0\n3 1 0 0\n7 0 1 0\n8 0 0 1\n"
    "$EndNodes\n$Elements\n1\n1 4 2 1 1 40 3 7 8\n$EndElements\n"
    '$NodeData\n1\n"kind"\n1\n0\n3\n0\n1\n4\n8 8\n7 7\n3 3\n40 40\n$EndNodeData\n'
)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("40 3 7 8", "40 3 7 0", "refers to node 0, which does not exist"),
        ("40 3 7 8", "40 3 7 8 3", "element 1 has 10 numbers: 9 are needed"),
        ("\n3 1 0 0", "\n3.5 1 0 0", "a number that is not whole"),
        ("$Elements\n1\n", "$Elements\n0\n", "where .EndElements is needed"),
        ("$EndElements\n", "", "where .EndElements is needed"),
        ("$Elements", "$Nodes\n1\n40 9 0 0\n$EndNodes\n$Elements", "has .Nodes twice"),
        ("4 2 1 1 40 3 7 8", "11 2 1 1 40 3 7 8 3 7 8 40 3 7", "linear tets are needed"),
    ],
)
def test_gmsh_files_that_meshio_reads_as_another_mesh_are_refused(old, new, match, tmp_path):
    """All but the last, which other readers may pass on; values of nodes go by their numbers."""
    whole = read_mesh(saved(tmp_path, "it.msh", GMSH_2))
    assert whole.point_data["kind"].tolist() == [40.0, 3.0, 7.0, 8.0]
    assert GMSH_2.count(old) == 1
    with pytest.raises(cmfsim.CaseError, match=match):
        cmfsim.read_tet_mesh(saved(tmp_path, "it.msh", GMSH_2.replace(old, new)))


def test_other_volume_elements_are_refused_not_left_out(tmp_path):
    """A mesh of tets and a brick was read without the brick: a hole in the tissue."""
    brick = [0, 1, 4, 3, 9, 10, 13, 12]
    for name in ("it.vtu", "it.vtk", "it.msh"):
        path = tmp_path / name
        how = {"file_format": "gmsh22"} if path.suffix == ".msh" else {}
        cells = [("tetra", TETS[8:].astype(np.int64)), ("hexahedron", np.array([brick]))]
        meshio.Mesh(NODES, cells).write(path, **how)
        with pytest.raises(
            cmfsim.CaseError, match="linear tets are needed, found hexahedron, tetra"
        ):
            cmfsim.read_tet_mesh(path)


def test_files_that_name_others_or_have_no_reader_are_refused(tmp_path):
    for name in ("it.xdmf", "it.ele", "it", "it.stl.gz", "it.glb"):
        ending = f"files of {Path(name).suffix or 'no ending'} are not supported"
        refused(saved(tmp_path, name, "<Xdmf/>"), f"{ending}: save a surface as .stl")


# What is no file.


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with a name are POSIX")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "it.ply")
    refused(tmp_path / "it.ply", "is a pipe or a device")


def test_names_that_no_file_can_have_are_refused(tmp_path):
    with pytest.raises(cmfsim.CaseError, match="not a valid file name"):
        cmfsim.read_surface("a\0b.ply")
    with pytest.raises(cmfsim.CaseError, match="cannot be opened"):
        cmfsim.read_surface("a" * 5000 + ".ply")
    (tmp_path / "it.ply").mkdir()
    refused(tmp_path / "it.ply", "is a folder, not a file")
    with pytest.raises(FileNotFoundError):
        cmfsim.read_surface(tmp_path / "absent.ply")
