"""Files of VTK, in XML and of old: each form is read, and each fault has an error that names it."""

import base64
import os
import struct
import sys
import zlib

import numpy as np
import pytest
from refused_surfaces import refused, saved

import cmfsim
from cmfsim.io.meshes.mesh_files import read_mesh

meshio = pytest.importorskip("meshio")

# VTK's XML files.


def vtp(**change):
    """A tetrahedron; a change gives an array other bytes, or the root other attributes."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    corners = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], dtype=np.int64)
    given = {"points": points, "corners": corners, "ends": 3 * np.arange(1, 5), "n": 4}
    given |= {"type": "Float64", "root": 'header_type="UInt64"', "head": "", **change}

    def array(name, kind, values, width=1):
        raw = np.ascontiguousarray(values).tobytes()
        text = base64.b64encode(struct.pack("<Q", len(raw)) + raw).decode()
        return (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" '
            f'format="binary">{text}</DataArray>'
        )

    return (
        f'{given["head"]}<VTKFile type="PolyData" byte_order="LittleEndian" {given["root"]}>'
        f'<PolyData><Piece NumberOfPoints="{len(points)}" NumberOfPolys="{given["n"]}"><Points>'
        f"{array('points', given['type'], given['points'], 3)}</Points><Polys>"
        f"{array('connectivity', 'Int64', given['corners'])}"
        f"{array('offsets', 'Int64', given['ends'])}</Polys></Piece></PolyData></VTKFile>"
    )


TETRA = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], dtype=np.int64)
ENTITIES = '<!DOCTYPE v [<!ENTITY a "1">]>'
BAD_VTP = {
    "negative": ({"corners": np.where(TETRA == 3, -1, TETRA)}, "face 1 names vertex -1"),
    "too large": ({"corners": np.where(TETRA == 3, 4, TETRA)}, "face 1 names vertex 4.*from 1"),
    "huge": ({"corners": np.where(TETRA == 3, 2**62, TETRA)}, "names vertex 4611686018427387904"),
    "type": ({"type": "Float32"}, "'points': states 96 bytes, 48 are needed"),
    "count": ({"n": 3}, "states 32 bytes, 24 are needed"),
    "offsets": ({"ends": np.array([3, 9, 6, 12])}, r"offsets\[2\] is 6: below the one before"),
    "ends": ({"ends": np.array([3, 6, 9, 11])}, "states 96 bytes, 88 are needed"),
    "header": ({"root": 'header_type=""'}, "header_type ''"),
    "packer": ({"root": 'compressor="vtkNoDataCompressor"'}, "is packed by 'vtkNoDataCompressor'"),
    "entities": ({"head": ENTITIES}, "document type"),
    "after a line": ({"head": "\n\n" + ENTITIES}, "document type"),
    "after a mark": ({"head": "\ufeff" + ENTITIES}, "document type"),
    "after both": ({"head": "\ufeff\n " + ENTITIES}, "document type"),
    "later": ({"head": '<?xml version="1.0"?>' + "<!-- x -->" * 9 + ENTITIES}, "document type"),
}


@pytest.mark.parametrize("fault", BAD_VTP)
def test_a_fault_in_vtp_is_named(fault, tmp_path):
    change, match = BAD_VTP[fault]
    path = saved(tmp_path, "it.vtp", vtp())
    assert cmfsim.read_surface(path).triangles.tolist() == TETRA.tolist()
    refused(saved(tmp_path, "it.vtp", vtp(**change)), match)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp037"])
def test_xml_in_another_encoding_hides_nothing(encoding, tmp_path):
    content = vtp(head=f'<?xml version="1.0" encoding="{encoding}"?>{ENTITIES}').encode(encoding)
    refused(saved(tmp_path, "it.vtp", content), "not XML in UTF-8")
    refused(saved(tmp_path, "it.vtp", content.replace(ENTITIES.encode(encoding), b"")), "UTF-8")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("Polys>", "Polyt>", "Piece has the element 'Polyt': PointData"),
        ("Piece", "Pieze", "PolyData has the element 'Pieze'"),
        (' NumberOfPolys="4"', "", "array 'connectivity': states 96 bytes, 0 are needed"),
        ("<Points>", "<a:Points>", "not XML in UTF-8"),
        ('"Int64"', '"Float64"', "whole numbers are needed"),
    ],
)
def test_names_that_vtk_does_not_know_are_not_passed_over(old, new, match, tmp_path):
    refused(saved(tmp_path, "it.vtp", vtp().replace(old, new)), match)


def test_deep_xml_is_refused(tmp_path):
    for content in ("<a>" * 100_000, "<VTKFile>" + "<a/>" * 200_000 + "</VTKFile>"):
        refused(saved(tmp_path, "it.vtp", content), "too deeply, or has too many")


@pytest.mark.parametrize("mode", ["ascii", "binary", "appended", "raw"])
@pytest.mark.parametrize("packer", ["None", "ZLib", "LZ4", "LZMA"])
def test_vtp_of_vtk_is_read_in_every_form(mode, packer, tmp_path):
    """What VTK writes, in four modes and four packings, as VTK reads it."""
    pyvista = pytest.importorskip("pyvista")
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter  # noqa: PLC0415 (needs the extra)

    ball = pyvista.Sphere(theta_resolution=30, phi_resolution=30)
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(ball)
    writer.SetFileName(str(tmp_path / "it.vtp"))
    {
        "ascii": writer.SetDataModeToAscii,
        "binary": writer.SetDataModeToBinary,
        "appended": writer.SetDataModeToAppended,
        "raw": writer.SetDataModeToAppended,
    }[mode]()
    writer.SetEncodeAppendedData(mode == "appended")
    getattr(writer, f"SetCompressorTypeTo{packer}")()
    writer.SetBlockSize(4096)
    writer.SetByteOrder(packer == "LZ4")
    writer.Write()
    mesh = read_mesh(tmp_path / "it.vtp")
    known = pyvista.read(tmp_path / "it.vtp")
    assert np.array_equal(mesh.points, known.points)
    assert np.array_equal(mesh.cells_dict["triangle"], known.faces.reshape(-1, 4)[:, 1:])
    assert np.array_equal(mesh.point_data["Normals"], known["Normals"])
    whole = (tmp_path / "it.vtp").read_bytes()
    for share in (0.3, 0.6, 0.9, 0.99):
        refused(saved(tmp_path, "cut.vtp", whole[: int(share * len(whole))]), "cut short")


def test_a_packed_block_is_not_unpacked_beyond_its_stated_size(tmp_path):
    """A bomb of 256 MB that states 96 bytes ends at the ninety-seventh."""
    packed = zlib.compress(bytes(2**28), 9)
    head = struct.pack("<4Q", 1, 96, 96, len(packed))
    text = (base64.b64encode(head) + base64.b64encode(packed)).decode()
    whole = vtp(root='header_type="UInt64" compressor="vtkZLibDataCompressor"')
    first = whole.index('format="binary">') + len('format="binary">')
    content = whole[:first] + text + whole[whole.index("</DataArray>") :]
    refused(saved(tmp_path, "it.vtp", content), "'points': a packed block is .*larger than stated")


# Its older files.


def vtk_ball(**arrays):
    pyvista = pytest.importorskip("pyvista")
    ball = pyvista.Sphere(radius=50.0, theta_resolution=8, phi_resolution=8)
    for name, values in arrays.items():
        ball.point_data[name] = values(ball.n_points)
    return ball


def vtk_saved(path, poly, version=42, *, binary=True):
    vtk = pytest.importorskip("vtkmodules.vtkIOLegacy")
    writer = vtk.vtkPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(poly)
    writer.SetFileVersion(version)
    writer.SetHeader("3D Slicer output. SPACE=RAS")
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    assert writer.Write()
    return path


@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("binary", [True, False])
def test_vtk_models_of_slicer_are_read(version, binary, tmp_path):
    """Colours, texts and names with blanks beside triangles; lines that end as on Windows."""
    ball = vtk_ball(
        RGB=lambda n: np.arange(3 * n).reshape(n, 3).astype(np.uint8),
        **{"a name": lambda n: np.linspace(-1.0, 1.0, n).astype(np.float32)},
    )
    ball.point_data.set_scalars(np.asarray(ball.point_data["RGB"]), "RGB")
    ball.add_field_data(["a text", "of two"], "names")
    path = vtk_saved(tmp_path / "it.vtk", ball, version, binary=binary)
    content = path.read_bytes()
    for form in (content,) if binary else (content, content.replace(b"\n", b"\r\n")):
        path.write_bytes(form)
        mesh = read_mesh(path)
        assert mesh.frame == "RAS"
        assert np.allclose(mesh.points, ball.points, atol=1e-4)
        assert np.array_equal(mesh.cells[0].data, ball.faces.reshape(-1, 4)[:, 1:])


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes are those of Linux")
def test_names_that_are_not_utf_8_keep_no_library_from_a_surface(tmp_path):
    ball = vtk_ball()
    cells = [("triangle", ball.faces.reshape(-1, 4)[:, 1:])]
    meshio.Mesh(np.asarray(ball.points, dtype=float), cells).write(tmp_path / "it.off")
    vtk_saved(tmp_path / "it.vtk", ball)
    folder = tmp_path / os.fsdecode(b"Pati\xe9nt")
    folder.mkdir()
    for name in ("it.off", "it.vtk"):
        (tmp_path / name).rename(folder / name)
        assert len(cmfsim.read_surface(folder / name).triangles) == len(cells[0][1])


def test_vtk_cells_whose_first_bytes_look_like_a_line_are_read(tmp_path):
    """Cells of 4.2 follow their line at once, and may hold a line feed or none for long."""
    for n in (10, 200, 2000):
        lone = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], *[[2.0, 2, 2]] * n])
        poly = pytest.importorskip("pyvista").PolyData(lone, np.array([3, 0, 1, n + 2] * n))
        surface = cmfsim.read_surface(vtk_saved(tmp_path / "it.vtk", poly))
        assert len(surface.triangles) == n


def test_triangle_strips_become_triangles_that_face_one_way(tmp_path):
    vtk = pytest.importorskip("vtkmodules.vtkFiltersCore")
    xml = pytest.importorskip("vtkmodules.vtkIOXML")
    ball = vtk_ball()
    stripper = vtk.vtkStripper()
    stripper.SetInputData(ball)
    stripper.Update()
    strips = stripper.GetOutput()
    assert strips.GetNumberOfStrips()
    writer = xml.vtkXMLPolyDataWriter()
    writer.SetInputData(strips)
    writer.SetFileName(str(tmp_path / "it.vtp"))
    writer.Write()
    for path in (
        tmp_path / "it.vtp",
        vtk_saved(tmp_path / "old.vtk", strips),
        vtk_saved(tmp_path / "new.vtk", strips, 51, binary=False),
    ):
        report = cmfsim.check_surface(cmfsim.read_surface(path))
        assert report.is_closed
        assert report.inconsistent == 0
        assert report.volume == pytest.approx(ball.volume, rel=1e-4)


STRIP = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 5 float\n"
STRIP += "0 0 0 1 0 0 0 1 0 1 1 0 2 1 0\n"


def test_a_corner_twice_in_a_strip_joins_its_parts(tmp_path):
    text = STRIP + "TRIANGLE_STRIPS 1 7\n6 0 1 2 3 3 4\n"
    surface = cmfsim.read_surface(saved(tmp_path, "it.vtk", text))
    assert surface.triangles.tolist() == [[0, 1, 2], [2, 1, 3]]


@pytest.mark.parametrize(
    ("cells", "match"),
    [
        ("TRIANGLE_STRIPS 1 4\n3 0 1 5\n", "names vertex 5, but there are 5"),
        ("POLYGONS 1 4\n3 0 1 -1\n", "names vertex -1"),
        ("POLYGONS 2 8\n3 0 1 2\n", "cut short or damaged"),
        ("POLYGONS 1 8\n3 0 1 2 3 0 2 3\n", "cut short or damaged"),
        ("POLYGONS 1 4\n3 0 1 x\n", "cut short or damaged"),
        ("POLYGONS 1 4\n3 0 1 2\nHELLO 3\n", "cut short or damaged"),
        ("", "found nothing"),
    ],
)
def test_what_vtk_passes_on_of_a_damaged_file_is_refused(cells, match, tmp_path):
    refused(saved(tmp_path, "it.vtk", STRIP + cells), match)


def test_offsets_of_vtk_that_do_not_begin_at_0_are_refused(tmp_path):
    text = STRIP.replace("3.0", "5.1").replace("POLYDATA", "UNSTRUCTURED_GRID")
    text += "CELLS 3 8\nOFFSETS vtktypeint64\n{} 4 8\nCONNECTIVITY vtktypeint64\n"
    text += "0 1 2 4 0 1 2 4\nCELL_TYPES 2\n10 10\n"
    saved(tmp_path, "it.vtk", text.format(0))
    assert len(cmfsim.read_tet_mesh(tmp_path / "it.vtk")[1]) == 2
    saved(tmp_path, "it.vtk", text.format(-2))
    with pytest.raises(cmfsim.CaseError, match="cut short or damaged"):
        cmfsim.read_tet_mesh(tmp_path / "it.vtk")
