"""The readers that are fuzzed: small valid files of each format, how they are read, what to check.

A new reader is one entry of `READERS`.
"""

import base64
import contextlib
import gzip
import io
import json
import math
import os
import re
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cmfsim
import oracles
from cmfsim.io.images.segmentations import read_labels, read_segmentation
from cmfsim.io.meshes.mesh_files import read_mesh
from cmfsim.io.meshes.photos import read_photo
from cmfsim.io.meshes.vtk_writing import write_tets
from cmfsim.io.slicer.markups import read_curves, write_curves
from cmfsim.io.slicer.slicer_scenes import read_slicer_scene, unpack_bundle
from cmfsim.pictures.canvas import write_picture


@dataclass(frozen=True)
class Reader:
    """A reader and its seeds.

    Attributes
    ----------
    name : str
        The format.
    target : str
        The file that is changed, in a folder of its own.
    make : callable
        Fills a folder with one valid case per call number; returns False where there is none left.
    read : callable
        What is fuzzed: takes the folder's target.
    oracle : callable, optional
        What the bytes of the target mean by the format's rules; see `oracles`.
    inside : bool
        The target is packed: half of the changes are made to what it holds.
    sealed : bool
        The target has checksums: a change to its bytes is refused or changes nothing.
    slow : bool
        Its seed takes a minute to make: left out of the tests.
    optional : bool
        This version may refuse the format; then it must refuse every mutant.
    """

    name: str
    target: str
    make: Callable[[Path, int], bool]
    read: Callable[[Path], Any]
    oracle: Callable[[bytes], Any] | None = None
    inside: bool = False
    sealed: bool = False
    slow: bool = False
    optional: bool = False


def plain(value: Any) -> Any:
    """A result as nested tuples of plain values and bytes, to be compared and checked."""
    if isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        return ("array", array.dtype.str, array.shape, array.tobytes())
    if isinstance(value, Mapping):
        return tuple((str(k), plain(v)) for k, v in value.items())
    if isinstance(value, list | tuple):
        return tuple(plain(v) for v in value)
    if hasattr(value, "__dataclass_fields__"):
        # Where a file lies and what it is called are no part of what it holds.
        names = [n for n in value.__dataclass_fields__ if n not in {"file", "output", "lines"}]
        return tuple((name, plain(getattr(value, name))) for name in names)
    if isinstance(value, float):
        return struct.pack("<d", value)
    return str(value) if isinstance(value, Path) else value


def changed_in_silence(reader: Reader, data: bytes, result: Any) -> str | None:
    """What is wrong with a result that was accepted; None if nothing is known to be."""
    fault = _fault(result)
    if fault is not None or reader.oracle is None:
        return fault
    try:
        wanted = reader.oracle(data)
    except oracles.UndecidedError:
        return None
    except Exception as error:  # noqa: BLE001 (whatever a strict reader stumbles over)
        return (
            f"accepted, and by the format's rules it is not valid ({type(error).__name__} {error})"
        )
    return _difference(result, wanted)


def _fault(value: Any) -> str | None:
    """Numbers that are not finite and indices that are not there, anywhere in a result."""
    if isinstance(value, np.ndarray):
        bad = value.dtype.kind in "fc" and not np.isfinite(value).all()
        return "a number is not finite" if bad else None
    if isinstance(value, float):
        return None if math.isfinite(value) else "a number is not finite"
    if isinstance(value, Mapping):
        return next((f for v in value.values() if (f := _fault(v))), None)
    if isinstance(value, list | tuple):
        return next((f for v in value if (f := _fault(v))), None)
    if hasattr(value, "__dataclass_fields__"):
        vertices, triangles = (getattr(value, n, None) for n in ("vertices", "triangles"))
        if triangles is not None and np.size(triangles) and _is_outside(triangles, vertices):
            return "a triangle names a vertex that is not there"
        return next(
            (f for n in value.__dataclass_fields__ if (f := _fault(getattr(value, n)))), None
        )
    return None


def _is_outside(triangles: Any, vertices: Any) -> bool:
    return bool(np.min(triangles) < 0 or np.max(triangles) >= len(np.asarray(vertices)))


def _difference(result: Any, wanted: Any) -> str | None:
    if isinstance(result, cmfsim.SurfaceData):
        points, faces = wanted
        corners = np.asarray(result.vertices)[np.asarray(result.triangles)]
        known = np.array(points, dtype=float).reshape(-1, 3)[
            np.array(faces, dtype=int).reshape(-1, 3)
        ]
        if corners.shape != known.shape:
            return f"{len(corners)} triangles where the file holds {len(known)}"
        return None if np.array_equal(corners, known) else "other vertices than the file's"
    if isinstance(result, tuple):
        nodes, tets = (np.asarray(a) for a in result)
        known = np.array(wanted[0], dtype=float).reshape(-1, 3)
        cells = np.array(wanted[1], dtype=int).reshape(-1, 4)
        same = np.array_equal(nodes, known) and np.array_equal(np.sort(tets), np.sort(cells))
        return None if same else "other nodes or tets than the file's"
    if isinstance(result, Mapping):
        if list(result) != list(wanted):
            return f"other labels: {list(result)[:5]} and {list(wanted)[:5]}"
        if not all(np.allclose(result[k], wanted[k], rtol=1e-15, atol=0) for k in result):
            return "other points than the file's"
        return None
    if isinstance(result, cmfsim.ImageData):
        return _image_difference(result, wanted)
    return None


def _image_difference(image: Any, wanted: tuple[tuple[int, ...], int, bool]) -> str | None:
    """An image against what its header and length say: the voxels of each axis, and their bytes.

    One whose axes run obliquely comes on another grid.
    """
    shape, more, upright = wanted
    # Bytes after the last voxel change nothing, unless the header lost voxels to them.
    if more < 0 or (more > 0 and math.prod(shape) < math.prod(SHAPE)):
        return f"the file has {abs(more)} bytes {'fewer' if more < 0 else 'more'} than its header"
    found = tuple(sorted(image.values.shape))
    return (
        None
        if found == tuple(sorted(shape)) or not upright
        else f"voxels {found}, by its header {shape}"
    )


# Seeds: a tetrahedron, a ball of 20 triangles, a box of 5 tets, a grid of 6 × 7 × 8 voxels.

GOLD = (1.0 + math.sqrt(5.0)) / 2.0


def _ball() -> Any:
    corners = [(0, a, b * GOLD) for a in (-1, 1) for b in (-1, 1)]
    points = np.array([np.roll(c, k) for k in range(3) for c in corners], dtype=float)
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 2.1
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    turned = [f if np.linalg.det(points[list(f)]) > 0 else (f[0], f[2], f[1]) for f in faces]
    # Numbers that single precision holds, so that STL does.
    return cmfsim.SurfaceData(np.round(points * 8.0) / 8.0 + [1.0, -90.5, 12.25], turned)


NODES = np.array([[x, y, z] for z in (0.0, 10.0) for y in (0.0, 10.0) for x in (0.0, 10.0)])
TETS = np.array([[0, 1, 3, 5], [0, 3, 2, 6], [0, 5, 6, 4], [3, 6, 5, 7], [0, 3, 6, 5]])


def _surface_to(name: str) -> Callable[[Path, int], bool]:
    def make(folder: Path, number: int) -> bool:
        if number:
            return False
        cmfsim.write_surface(folder / name, _ball())
        return True

    return make


def _texts(name: str, *texts: Callable[[], bytes]) -> Callable[[Path, int], bool]:
    def make(folder: Path, number: int) -> bool:
        if number >= len(texts):
            return False
        (folder / name).write_bytes(texts[number]())
        return True

    return make


def _stl_text() -> bytes:
    lines = ["solid ball"]
    ball = _ball()
    for corners in np.asarray(ball.vertices)[np.asarray(ball.triangles)].tolist():
        lines += ["facet normal 0 0 0", "  outer loop"]
        lines += [f"    vertex {x} {y} {z}" for x, y, z in corners]
        lines += ["  endloop", "endfacet"]
    return "\n".join([*lines, "endsolid ball", ""]).encode()


def _ply(order: str, kinds: str, *, colours: bool) -> bytes:
    ball = _ball()
    points, faces = np.asarray(ball.vertices).tolist(), np.asarray(ball.triangles).tolist()
    names = ("red", "green", "blue") if colours else ()
    more = "".join(f"property uchar {name}\n" for name in names)
    head = (
        f"ply\nformat {order} 1.0\ncomment a ball\nelement vertex {len(points)}\n"
        f"property float x\nproperty float y\nproperty float z\n{more}"
        f"element face {len(faces)}\nproperty list {kinds} vertex_indices\nend_header\n"
    ).encode()
    if order == "ascii":
        rows = [" ".join(map(str, p)) + (" 7 8 9" if colours else "") for p in points]
        return head + "\n".join([*rows, *(f"3 {a} {b} {c}" for a, b, c in faces), ""]).encode()
    e = ">" if "big" in order else "<"
    letters = {"uchar": "B", "int": "i", "uint": "I", "ushort": "H"}
    count, whole = (letters[k] for k in kinds.split())
    body = b"".join(struct.pack(e + "3f", *p) + (b"\7\10\11" if colours else b"") for p in points)
    return head + body + b"".join(struct.pack(f"{e}{count}3{whole}", 3, *f) for f in faces)


def _obj(style: str) -> bytes:
    ball = _ball()
    points, faces = np.asarray(ball.vertices).tolist(), np.asarray(ball.triangles).tolist()
    lines = ["# a ball", *(f"v {x} {y} {z}" for x, y, z in points)]
    for a, b, c in faces:
        corners = (a + 1, b + 1, c + 1) if style != "back" else (a - 12, b - 12, c - 12)
        lines.append(
            "f " + " ".join(f"{i}//{i}" if style == "normals" else str(i) for i in corners)
        )
    return "\n".join([*lines, ""]).encode()


def _photo_obj(folder: Path, number: int) -> bool:
    """A square with a texture, which is not damaged."""
    if number:
        return False
    lines = ["mtllib it.mtl", "v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", "vt 0 0", "vt 1 0"]
    lines += ["vt 1 1", "vt 0 1", "usemtl skin", "f 1/1 2/2 3/3", "f 1/1 3/3 4/4", ""]
    (folder / "it.obj").write_text("\n".join(lines))
    (folder / "it.mtl").write_text("newmtl skin\nmap_Kd it.png\n")
    write_picture(folder / "it.png", np.full((4, 4, 3), 200, dtype=np.uint8))
    return True


def _vtk_array(name: str, kind: str, values: Any, width: int, form: str) -> str:
    types = {"Float32": "f4", "Float64": "f8", "Int64": "i8", "Int32": "i4", "UInt8": "u1"}
    array = np.asarray(values).astype(types[kind])
    if form == "ascii":
        text = " ".join(map(repr, array.reshape(-1).tolist()))
    elif form == "packed":
        raw = zlib.compress(array.tobytes())
        head = struct.pack("<4I", 1, array.nbytes, array.nbytes, len(raw))
        text = (base64.b64encode(head) + base64.b64encode(raw)).decode()
    else:
        text = base64.b64encode(struct.pack("<I", array.nbytes) + array.tobytes()).decode()
    form = "ascii" if form == "ascii" else "binary"
    return (
        f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" format="{form}">\n'
        f"{text}\n</DataArray>\n"
    )


def _vtk(kind: str, form: str) -> bytes:
    ball = _ball()
    surface = kind == "PolyData"
    points = np.asarray(ball.vertices) if surface else NODES
    cells = np.asarray(ball.triangles) if surface else TETS
    n, width = cells.shape
    arrays = _vtk_array("connectivity", "Int64", cells.reshape(-1), 1, form)
    arrays += _vtk_array("offsets", "Int64", width * np.arange(1, n + 1), 1, form)
    if not surface:
        arrays += _vtk_array("types", "UInt8", np.full(n, 10), 1, form)
    group, count = ("Polys", "NumberOfPolys") if surface else ("Cells", "NumberOfCells")
    packer = ' compressor="vtkZLibDataCompressor"' if form == "packed" else ""
    values = _vtk_array("kind", "Int32", np.arange(len(points)) % 3, 1, form)
    return (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="0.1" byte_order="LittleEndian" '
        f'header_type="UInt32"{packer}>\n<{kind}>\n<Piece NumberOfPoints="{len(points)}" '
        f'{count}="{n}">\n<PointData>\n{values}</PointData>\n<Points>\n'
        f"{_vtk_array('points', 'Float32', points, 3, form)}</Points>\n"
        f"<{group}>\n{arrays}</{group}>\n</Piece>\n</{kind}>\n</VTKFile>\n"
    ).encode()


def _vtk_appended() -> bytes:
    ball = _ball()
    triangles = np.asarray(ball.triangles)
    arrays = {
        "points": np.asarray(ball.vertices, dtype="<f8").tobytes(),
        "connectivity": triangles.astype("<i8").tobytes(),
        "offsets": (3 * np.arange(1, len(triangles) + 1)).astype("<i8").tobytes(),
    }
    data, at = b"", {}
    for name, raw in arrays.items():
        at[name] = len(data)
        data += struct.pack("<Q", len(raw)) + raw

    def array(name: str, kind: str, width: int) -> str:
        return (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" '
            f'format="appended" offset="{at[name]}"/>'
        )

    return (
        (
            '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">'
            f'<PolyData><Piece NumberOfPoints="12" NumberOfPolys="20"><Points>'
            f"{array('points', 'Float64', 3)}</Points><Polys>{array('connectivity', 'Int64', 1)}"
            f"{array('offsets', 'Int64', 1)}</Polys></Piece></PolyData>"
            '<AppendedData encoding="raw">\n_'
        ).encode()
        + data
        + b"\n</AppendedData>\n</VTKFile>\n"
    )


def _legacy(form: str, *, new: bool) -> bytes:
    n, width = TETS.shape
    words = form == "ASCII"

    def numbers(kind: str, values: Any) -> bytes:
        array = np.asarray(values)
        if words:
            return (" ".join(map(str, array.reshape(-1).tolist())) + "\n").encode()
        return array.astype(f">{kind}").tobytes() + b"\n"

    head = f"# vtk DataFile Version {'5.1' if new else '4.2'}\ntets\n{form}\n"
    out = f"{head}DATASET UNSTRUCTURED_GRID\nPOINTS {len(NODES)} double\n".encode()
    out += numbers("f8", NODES)
    if new:
        out += f"CELLS {n + 1} {n * width}\nOFFSETS vtktypeint64\n".encode()
        out += numbers("i8", width * np.arange(n + 1)) + b"CONNECTIVITY vtktypeint64\n"
        out += numbers("i8", TETS)
    else:
        out += f"CELLS {n} {n * (width + 1)}\n".encode()
        out += numbers("i4", np.insert(TETS, 0, width, axis=1))
    out += f"CELL_TYPES {n}\n".encode() + numbers("i4", np.full(n, 10))
    out += f"POINT_DATA {len(NODES)}\nSCALARS kind int 1\nLOOKUP_TABLE default\n".encode()
    return out + numbers("i4", np.arange(len(NODES)) % 3)


def _msh(version: str, *, words: bool) -> bytes:
    n, m = len(NODES), len(TETS)

    def row(kinds: str, *values: Any) -> bytes:
        if words:
            return (" ".join(map(str, values)) + "\n").encode()
        return struct.pack("<" + kinds, *values)

    out = f"$MeshFormat\n{version} {0 if words else 1} 8\n".encode()
    out += b"" if words else struct.pack("<i", 1) + b"\n"
    out += b"$EndMeshFormat\n$Nodes\n"
    if version == "2.2":
        out += b"%d\n" % n + b"".join(row("iddd", i + 1, *p) for i, p in enumerate(NODES.tolist()))
        out += (b"" if words else b"\n") + b"$EndNodes\n$Elements\n%d\n" % m
        if words:
            out += b"".join(row("", i + 1, 4, 2, 1, 1, *(t + 1)) for i, t in enumerate(TETS))
        else:
            out += struct.pack("<3i", 4, m, 2)
            out += b"".join(row("7i", i + 1, 1, 1, *(t + 1)) for i, t in enumerate(TETS))
            out += b"\n"
        return out + b"$EndElements\n"
    out += row("4q", 1, n, 1, n) + row("3iq", 3, 1, 0, n)
    out += b"".join(row("q", i + 1) for i in range(n))
    out += b"".join(row("3d", *p) for p in NODES.tolist()) + (b"" if words else b"\n")
    out += b"$EndNodes\n$Elements\n" + row("4q", 1, m, 1, m) + row("3iq", 3, 1, 4, m)
    out += b"".join(row("5q", i + 1, *(t + 1)) for i, t in enumerate(TETS))
    return out + (b"" if words else b"\n") + b"$EndElements\n"


def _other(suffix: str) -> bytes:
    if suffix == ".off":
        ball = _ball()
        points, faces = np.asarray(ball.vertices).tolist(), np.asarray(ball.triangles).tolist()
        rows = [" ".join(map(str, p)) for p in points] + [f"3 {a} {b} {c}" for a, b, c in faces]
        return "\n".join(["OFF", f"{len(points)} {len(faces)} 0", *rows, ""]).encode()
    rows = [" ".join(map(str, p)) + " 0" for p in NODES.tolist()]
    tets = [" ".join(str(i + 1) for i in t) + " 0" for t in TETS.tolist()]
    return "\n".join(
        ["MeshVersionFormatted 2", "Dimension", "3", "Vertices", str(len(rows)), *rows]
        + ["Tetrahedra", str(len(tets)), *tets, "End", ""]
    ).encode()


POINTS = {
    "nasion": (0.5, -90.25, 60.0),
    "menton": (0.0, -80.5, -50.75),
    "orbitale_L": (30.0, -75.0, 40.5),
}


def _markups(kind: str) -> Callable[[Path, int], bool]:
    def make(folder: Path, number: int) -> bool:
        if number:
            return False
        if kind == "Fiducial":
            cmfsim.write_landmarks(folder / "it.mrk.json", POINTS)
        else:
            write_curves(folder / "it.mrk.json", [list(POINTS.values())] * 2)
        return True

    return make


SLICER_SCENE = """<?xml version="1.0" encoding="UTF-8"?>
<MRML version="Slicer5">
 <Model id="m" name="Mandible" references="storage:s;transform:t;"></Model>
 <ModelStorage id="s" fileName="Data/it.stl" coordinateSystem="LPS"></ModelStorage>
 <LinearTransform id="t" name="Move" references="transform:h;"
  matrixTransformToParent="1 0 0 1  0 0.8 -0.6 4  0 0.6 0.8 1  0 0 0 1"></LinearTransform>
 <LinearTransform id="h" name="Head" matrixTransformToParent="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>
</MRML>
"""


def _slicer_nodes(path: Path) -> Any:
    """The nodes of a scene and where each lies; files that are not there are stated."""
    scene = read_slicer_scene(path)
    return [(node.kind, node.id, node.name, scene.to_world(node)) for node in scene.nodes.values()]


def _slicer_bundle(folder: Path, number: int) -> bool:
    if number:
        return False
    with zipfile.ZipFile(folder / "it.mrb", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("it/it.mrml", SLICER_SCENE)
        archive.writestr("it/Data/it.stl", b"x" * 500)
    return True


def _read_bundle(path: Path) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        return _slicer_nodes(unpack_bundle(path, Path(folder)))


def _segments() -> bytes:
    labels = np.zeros((2, 6, 5, 4), np.uint8)
    labels[:, 2:4, 2:4, 1:3] = 1
    head = (
        "NRRD0004\ntype: unsigned char\ndimension: 4\nspace: left-posterior-superior\n"
        "sizes: 2 6 5 4\nspace directions: none (2,0,0) (0,1,0) (0,0,3)\n"
        "kinds: list domain domain domain\nendian: little\nencoding: gzip\n"
        "space origin: (10,-20,30)\nSegment0_Name:=Mandible\nSegment0_LabelValue:=1\n"
        "Segment0_Layer:=0\nSegment1_Name:=Skin\nSegment1_LabelValue:=1\nSegment1_Layer:=1\n\n"
    )
    return head.encode() + gzip.compress(labels.tobytes(order="F"), mtime=0)


def _read_segments(path: Path) -> Any:
    found = read_segmentation(path)
    return [(s.name, found.affine, found.mask(s)) for s in found.segments]


def _label_image(folder: Path, number: int) -> bool:
    if number:
        return False
    values = np.zeros((6, 5, 4), np.uint8)
    values[1:3, 1:4, 1:3], values[3:5, 1:4, 1:3] = 1, 2
    cmfsim.write_image(cmfsim.ImageData(values, (2.0, 1.0, 3.0), (-10, -20, 30)), folder / "it.nii")
    return True


def _read_labels(path: Path) -> Any:
    found = read_labels(path)
    return [(s.name, found.affine, found.mask(s)) for s in found.segments]


def _fcsv() -> bytes:
    lines = ["# Markups fiducial file version = 4.11", "# CoordinateSystem = LPS"]
    lines.append("# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID")
    for i, (label, (x, y, z)) in enumerate(POINTS.items()):
        lines.append(f"vtk_{i},{x},{y},{z},0,0,0,1,1,1,0,{label},,")
    return "\n".join([*lines, ""]).encode()


MOTION = cmfsim.rigid_motion((0, -5, 1), 4.0, (1, 0, 0), (0, 40, 10))


def _transform(suffix: str) -> Callable[[Path, int], bool]:
    def make(folder: Path, number: int) -> bool:
        if number:
            return False
        cmfsim.write_transform(folder / f"it{suffix}", MOTION, direction="to-parent")
        return True

    return make


def _h5(folder: Path, number: int) -> bool:
    if number:
        return False
    import SimpleITK

    transform = SimpleITK.AffineTransform(3)
    transform.SetMatrix(MOTION[:3, :3].reshape(-1).tolist())
    transform.SetTranslation(MOTION[:3, 3].tolist())
    SimpleITK.WriteTransform(transform, str(folder / "it.h5"))
    return True


def _read_transform(path: Path) -> Any:
    return cmfsim.read_transform(path, direction="to-parent")


CASE = """format = "cmfsim-case"
version = 1
name = "P1"
note = "a made head"

[surfaces]
skin = "skin.ply"
bones = {cranium = "cranium.ply", mandible = "mandible.ply"}
units = "mm"
frame = "LPS"

[landmarks]
skull = "skull.mrk.json"

[region]
posterior_depth = 10.0

[mesh]
edge_length = 8.0
refine = true

[[osteotomies]]
procedure = "le_fort_1"

[plan.maxilla]
translation = [0, -5, 1]
angle = 4
axis = [1, 0, 0]
centre = [0, 40, 10]

[plan.chin]
matrix = [[1, 0, 0, 0], [0, 1, 0, 5], [0, 0, 1, 0], [0, 0, 0, 1]]

[tissue]
young = 0.003
poisson = 0.46

[muscles]
smoothing = 1.5
samples = 100

[solver]
method = "auto"
tolerance = 1e-8

[output]
folder = "out"
"""
COHORT = """format = "cmfsim-cohort"
version = 1
name = "two"
models = ["H", "M+S"]
output = "study"

[[cases]]
file = "P1/case.toml"
name = "P1"

[[cases]]
file = "P2/case.toml"
"""
SCENE = """format = "cmfsim-scene"
version = 1
mesh = "tissue.vtu"

[units]
length = "mm"

[tissue]
kind = "isotropic"
young = 0.003
poisson = 0.46

[segments.bone]

[segments.teeth]
contact = "teeth.ply"
crease_angle = 60
gap = "rest"

[plan.bone]
translation = [0, -5, 1]
angle = 4

[plan.teeth]
surface = "teeth.ply"
moved_surface = "moved.ply"

[solver]
method = "cholesky"
"""


def _scene() -> Any:
    contact = _ball()
    return cmfsim.Scene(
        nodes=NODES,
        tets=TETS,
        tissue=cmfsim.TissueData("isotropic", young=np.full(5, 0.003), poisson=0.46),
        fixed=[0, 1],
        segments={
            "bone": cmfsim.SegmentData(joined=[6, 7]),
            "teeth": cmfsim.SegmentData(sliding=[2, 3], contact=contact, gap=[0.1, 0.2]),
        },
        plan={
            "bone": MOTION,
            "teeth": cmfsim.MovedSurface(contact, np.asarray(contact.vertices) + [0, 0, 1.0]),
        },
        loads=np.full((8, 3), 1e-3),
    )


def _scene_npz(folder: Path, number: int) -> bool:
    if number:
        return False
    cmfsim.write_scene(folder / "it.npz", _scene())
    return True


def _scene_toml(folder: Path, number: int) -> bool:
    if number:
        return False
    (folder / "it.toml").write_text(SCENE)
    kinds = np.array([1, 1, 3, 3, 0, 0, 2, 2])
    owners = np.array([-1, -1, 1, 1, -1, -1, 0, 0])
    with (folder / "tissue.vtu").open("wb") as file:
        write_tets(file, NODES, TETS, {"kind": kinds, "segment": owners}, {})
    cmfsim.write_surface(folder / "teeth.ply", _ball())
    moved = _ball()
    vertices = np.asarray(moved.vertices) + [0, 0, 1.0]
    cmfsim.write_surface(folder / "moved.ply", cmfsim.SurfaceData(vertices, moved.triangles))
    return True


def _read_scene(path: Path) -> Any:
    scene = cmfsim.read_scene(path)
    return {"header": scene.header(), **scene.arrays()}


PLAN = {
    "bone": {"translation": [0, -5, 1], "angle": 4, "axis": [1, 0, 0], "centre": [0, 40, 10]},
    "teeth": {"matrix": np.eye(4).tolist()},
}


def _plan_text(suffix: str) -> bytes:
    if suffix == ".json":
        return json.dumps({"units": {"length": "mm"}, "plan": PLAN}, indent=1).encode()
    lines = ['[units]\nlength = "mm"']
    for name, entries in PLAN.items():
        lines += [f"[plan.{name}]", *(f"{key} = {value}" for key, value in entries.items())]
    return "\n".join([*lines, ""]).encode()


def _result(folder: Path, number: int) -> bool:
    if number:
        return False
    scene = cmfsim.Scene(
        nodes=NODES,
        tets=TETS,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
        fixed=[0, 1, 2, 3],
        segments={"bone": cmfsim.SegmentData(joined=[4, 5, 6, 7])},
        plan={"bone": MOTION},
    )
    cmfsim.write_result(folder / "it.npz", cmfsim.solve_scene(scene))
    return True


def _template_value() -> Any:
    low = np.asarray(_ball().vertices)

    def muscle(name: str, shift: float) -> Any:
        surface = cmfsim.SurfaceData(low + [shift, 0, 0], _ball().triangles)
        line = np.array([[shift, -90.0, 10.0], [shift, -90.0, 12.0], [shift, -90.0, 14.0]])
        return cmfsim.MuscleSurface(name, name[-1], surface, boxes=2, course=(line,))

    return cmfsim.MuscleTemplate(
        name="small",
        muscles=(muscle("masseter_L", 40.0), muscle("masseter_R", -42.0)),
        skull=_ball(),
        landmarks={k: np.array(v) for k, v in POINTS.items()},
        licence="none",
        attribution="nobody",
        source="a test",
        concepts={"masseter_L": ("X1", "X2")},
    )


def _template_folder(folder: Path, number: int) -> bool:
    if number:
        return False
    _template_value().save(folder / "atlas")
    for path in (folder / "atlas").iterdir():
        path.replace(folder / path.name)
    (folder / "atlas").rmdir()
    return True


def _template_npz(folder: Path, number: int) -> bool:
    if number:
        return False
    _template_value().save(folder / "it.npz")
    return True


def _report(folder: Path, number: int) -> bool:
    """The results of the demo, coarse, without its tets."""
    if number > 1:
        return False
    made = Path(os.environ.get("CMFSIM_FUZZ_DEMO") or folder.parent.parent / "demo")
    if not (made / "out/metrics.json").exists():
        from cmfsim.cli import main

        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            if main(["demo", str(made), "--edge-length", "12", "--no-open", "-q"]):
                message = "the demo failed"
                raise RuntimeError(message)
    for path in (made / "out").rglob("*"):
        if path.suffix in {".json", ".csv", ".png", ".vtp", ".stl", ".ply"}:
            there = folder / path.relative_to(made / "out")
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, there)
    return number == 0


def _read_report(path: Path) -> Any:
    from cmfsim.cli import main

    folder = path.parent if path.name == "metrics.json" else path.parent.parent
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(shown):
        code = main(["report", str(folder), "-q"])
    if code not in {0, 1, 2}:
        message = f"exit code {code}"
        raise RuntimeError(message)
    if code:
        raise cmfsim.errors.CaseInputError(shown.getvalue())
    return (folder / "report.html").read_text(encoding="utf-8")


# Images.

SHAPE = (6, 7, 8)


def _image() -> Any:
    values = np.arange(np.prod(SHAPE), dtype=np.int16).reshape(SHAPE) - 100
    return cmfsim.ImageData(values, spacing=(0.5, 0.75, 1.5), origin=(-10, -20, 30))


def _image_to(name: str, *, packed: bool = False) -> Callable[[Path, int], bool]:
    def make(folder: Path, number: int) -> bool:
        import SimpleITK as itk  # noqa: N813

        if number > (1 if packed else 0):
            return False
        image = _image()
        written = itk.GetImageFromArray(np.ascontiguousarray(image.values.T))
        written.SetSpacing(image.spacing.tolist())
        written.SetOrigin([-10, -20, 30])
        itk.WriteImage(written, str(folder / name), useCompression=bool(number))
        return True

    return make


def _dicom(folder: Path, number: int) -> bool:
    import SimpleITK as itk  # noqa: N813

    if number:
        return False
    values = np.arange(np.prod(SHAPE), dtype=np.int16).reshape(SHAPE)
    writer = itk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for i in range(SHAPE[2]):
        layer = itk.GetImageFromArray(np.ascontiguousarray(values[:, :, i].T)[None])
        layer.SetSpacing((0.5, 0.75, 1.5))
        tags = {
            "0008|0060": "CT",
            "0008|0016": "1.2.840.10008.5.1.4.1.1.2",
            "0008|0018": f"1.2.826.0.1.3680043.2.1125.{i + 1}",
            "0020|000d": "1.2.826.0.1.3680043.2.1125.100",
            "0020|000e": "1.2.826.0.1.3680043.2.1125.200",
            "0020|0013": str(i + 1),
            "0020|0032": f"-10\\-20\\{30 + 1.5 * i}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0018|0050": "1.5",
        }
        for name, value in tags.items():
            layer.SetMetaData(name, value)
        writer.SetFileName(str(folder / f"slice{i}.dcm"))
        writer.Execute(layer)
    return True


BYTES = {"short": 2, "int16": 2, "signed short": 2, "MET_SHORT": 2}


def _is_upright(axes: Sequence[Sequence[float]]) -> bool:
    """Whether the axes of an image run along the patient's: others come on another grid."""
    return all(sum(n != 0.0 for n in axis) <= 1 for axis in axes)


def _nrrd(data: bytes) -> tuple[tuple[int, ...], int, bool]:
    head, found, body = data.partition(b"\n\n")
    # Names of fields are read in any case, as Teem reads them.
    fields = {
        key.lower(): value
        for line in head.decode("latin-1").split("\n")[1:]
        for key, colon, value in (line.partition(": "),)
        if colon
    }
    rows = re.findall(r"\(([^()]*)\)", fields.get("space directions", ""))
    upright = _is_upright([[float(n) for n in row.split(",")] for row in rows])
    if not found or "data file" in fields or fields.get("encoding") not in {"raw", "gzip"}:
        raise oracles.UndecidedError
    if fields.get("type") not in BYTES or "byte skip" in fields or "line skip" in fields:
        raise oracles.UndecidedError
    shape = tuple(int(n) for n in fields["sizes"].split())
    if fields["encoding"] == "gzip":
        # Bytes after the packed voxels are no voxels.
        reader = zlib.decompressobj(zlib.MAX_WBITS + 16)
        body = reader.decompress(body)
        if not reader.eof:
            raise zlib.error
    return shape, len(body) - 2 * math.prod(shape), upright


def _nifti(data: bytes) -> tuple[tuple[int, ...], int, bool]:
    data = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    if struct.unpack("<i", data[:4])[0] != 348 or data[344:348] != b"n+1\0":
        raise oracles.UndecidedError
    dims = struct.unpack("<8h", data[40:56])
    bits, (start,) = struct.unpack("<h", data[72:74])[0], struct.unpack("<f", data[108:112])
    if dims[0] != 3 or bits != 16 or start != 352:
        raise oracles.UndecidedError
    turn = struct.unpack("<3f", data[256:268])
    rows = struct.unpack("<12f", data[280:328])
    upright = _is_upright([rows[0:3], rows[4:7], rows[8:11]])
    # A half turn about one axis, as the patient's axes have it.
    upright &= turn in {(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    return dims[1:4], len(data) - 352 - 2 * math.prod(dims[1:4]), upright


def _meta(data: bytes) -> tuple[tuple[int, ...], int, bool]:
    head, found, body = data.partition(b"ElementDataFile = LOCAL\n")
    # Blanks around the sign are free.
    fields = {
        key.strip(): value.strip()
        for line in head.decode("latin-1").split("\n")
        for key, equals, value in (line.partition("="),)
        if equals
    }
    turn = [float(n) for n in fields.get("TransformMatrix", "1 0 0 0 1 0 0 0 1").split()]
    upright = _is_upright([turn[:3], turn[3:6], turn[6:]])
    if not found or fields.get("ElementType") not in BYTES:
        raise oracles.UndecidedError
    if fields.get("CompressedData") != "False" or "HeaderSize" in fields:
        raise oracles.UndecidedError
    shape = tuple(int(n) for n in fields["DimSize"].split())
    return shape, len(body) - 2 * math.prod(shape), upright


def _read_tets(path: Path) -> Any:
    return tuple(cmfsim.read_tet_mesh(path))


def _read_plan(path: Path) -> Any:
    scene = cmfsim.Scene(
        nodes=NODES,
        tets=TETS,
        tissue=cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
        fixed=[0, 1],
        segments={"bone": cmfsim.SegmentData(joined=[6]), "teeth": cmfsim.SegmentData(joined=[7])},
        plan={"bone": np.eye(4), "teeth": np.eye(4)},
    )
    return cmfsim.read_plan(path, scene)


def _read_mesh(path: Path) -> Any:
    mesh = read_mesh(path)
    return {"points": mesh.points, **mesh.cells_dict}


def _read_template(path: Path) -> Any:
    folder = path.parent if path.name == "template.toml" else path
    template = cmfsim.MuscleTemplate.load(folder)
    return {n: getattr(template, n) for n in ("name", "muscles", "skull", "landmarks", "concepts")}


def _read_curves(path: Path) -> Any:
    return read_curves(path)


def _read_parts(path: Path) -> Any:
    return cmfsim.io.read_parts(path.parent)


def _read_folder(path: Path) -> Any:
    return cmfsim.read_image(path.parent)


READERS: tuple[Reader, ...] = (
    Reader("NRRD", "it.nrrd", _image_to("it.nrrd", packed=True), cmfsim.read_image, _nrrd),
    Reader("NHDR", "it.nhdr", _image_to("it.nhdr"), cmfsim.read_image),
    Reader("NIfTI", "it.nii", _image_to("it.nii"), cmfsim.read_image, _nifti),
    Reader(
        "NIfTI packed", "it.nii.gz", _image_to("it.nii.gz"), cmfsim.read_image, _nifti, inside=True
    ),
    Reader("MetaImage", "it.mha", _image_to("it.mha", packed=True), cmfsim.read_image, _meta),
    Reader("MHD", "it.mhd", _image_to("it.mhd"), cmfsim.read_image),
    Reader("DICOM folder", "slice3.dcm", _dicom, _read_folder),
    Reader("STL text", "it.stl", _texts("it.stl", _stl_text), cmfsim.read_surface, oracles.stl),
    Reader("STL binary", "it.stl", _surface_to("it.stl"), cmfsim.read_surface, oracles.stl),
    Reader(
        "PLY text",
        "it.ply",
        _texts(
            "it.ply",
            lambda: _ply("ascii", "uchar int", colours=False),
            lambda: _ply("ascii", "uchar int", colours=True),
        ),
        cmfsim.read_surface,
        oracles.ply,
    ),
    Reader(
        "PLY binary",
        "it.ply",
        _texts(
            "it.ply",
            lambda: _ply("binary_little_endian", "uchar int", colours=False),
            lambda: _ply("binary_big_endian", "uchar uint", colours=True),
            lambda: _ply("binary_little_endian", "ushort ushort", colours=True),
        ),
        cmfsim.read_surface,
        oracles.ply,
    ),
    Reader(
        "OBJ",
        "it.obj",
        _texts("it.obj", lambda: _obj(""), lambda: _obj("back"), lambda: _obj("normals")),
        cmfsim.read_surface,
        oracles.obj,
    ),
    Reader(
        "VTP",
        "it.vtp",
        _texts(
            "it.vtp",
            lambda: _vtk("PolyData", "binary"),
            lambda: _vtk("PolyData", "ascii"),
            lambda: _vtk("PolyData", "packed"),
            _vtk_appended,
        ),
        cmfsim.read_surface,
        oracles.vtk_xml,
    ),
    Reader(
        "VTU",
        "it.vtu",
        _texts(
            "it.vtu",
            lambda: _vtk("UnstructuredGrid", "binary"),
            lambda: _vtk("UnstructuredGrid", "ascii"),
            lambda: _vtk("UnstructuredGrid", "packed"),
        ),
        _read_tets,
        oracles.vtk_xml,
    ),
    Reader(
        "VTK legacy",
        "it.vtk",
        _texts(
            "it.vtk",
            lambda: _legacy("ASCII", new=False),
            lambda: _legacy("BINARY", new=False),
            lambda: _legacy("ASCII", new=True),
            lambda: _legacy("BINARY", new=True),
        ),
        _read_tets,
    ),
    Reader(
        "Gmsh",
        "it.msh",
        _texts(
            "it.msh",
            lambda: _msh("2.2", words=True),
            lambda: _msh("2.2", words=False),
            lambda: _msh("4.1", words=True),
            lambda: _msh("4.1", words=False),
        ),
        _read_tets,
    ),
    Reader(
        "3D photo PLY",
        "it.ply",
        _texts(
            "it.ply",
            lambda: _ply("ascii", "uchar int", colours=True),
            lambda: _ply("binary_little_endian", "uchar int", colours=True),
        ),
        read_photo,
    ),
    Reader("3D photo OBJ", "it.obj", _photo_obj, read_photo),
    Reader("OFF (meshio)", "it.off", _texts("it.off", lambda: _other(".off")), cmfsim.read_surface),
    Reader("Medit (meshio)", "it.mesh", _texts("it.mesh", lambda: _other(".mesh")), _read_mesh),
    Reader(
        "landmarks .mrk.json",
        "it.mrk.json",
        _markups("Fiducial"),
        cmfsim.read_landmarks,
        oracles.markups,
    ),
    Reader("curves .mrk.json", "it.mrk.json", _markups("Curve"), _read_curves),
    Reader(
        "landmarks .fcsv", "it.fcsv", _texts("it.fcsv", _fcsv), cmfsim.read_landmarks, oracles.fcsv
    ),
    Reader("transform .tfm", "it.tfm", _transform(".tfm"), _read_transform),
    Reader("transform .txt", "it.txt", _transform(".txt"), _read_transform),
    Reader("transform .h5", "it.h5", _h5, _read_transform),
    Reader("Slicer scene .mrml", "it.mrml", _texts("it.mrml", SLICER_SCENE.encode), _slicer_nodes),
    Reader("Slicer bundle .mrb", "it.mrb", _slicer_bundle, _read_bundle, inside=True),
    Reader(
        "segmentation .seg.nrrd", "it.seg.nrrd", _texts("it.seg.nrrd", _segments), _read_segments
    ),
    Reader("label image .nii", "it.nii", _label_image, _read_labels),
    Reader("case.toml", "case.toml", _texts("case.toml", CASE.encode), cmfsim.Case.load),
    Reader("cohort.toml", "cohort.toml", _texts("cohort.toml", COHORT.encode), cmfsim.Cohort.load),
    Reader("scene .npz", "it.npz", _scene_npz, _read_scene, inside=True, sealed=True),
    Reader("scene .toml", "it.toml", _scene_toml, _read_scene),
    Reader("plan .toml", "it.toml", _texts("it.toml", lambda: _plan_text(".toml")), _read_plan),
    Reader("plan .json", "it.json", _texts("it.json", lambda: _plan_text(".json")), _read_plan),
    Reader("result .npz", "it.npz", _result, cmfsim.read_result, inside=True, sealed=True),
    Reader("template folder", "template.toml", _template_folder, _read_template),
    Reader("template archive", "it.npz", _template_npz, _read_template, inside=True, sealed=True),
    Reader("prediction.json (view)", "H/prediction.json", _report, _read_parts, slow=True),
    Reader("metrics.json (report)", "metrics.json", _report, _read_report, slow=True),
    Reader("prediction.json (report)", "H/prediction.json", _report, _read_report, slow=True),
)
