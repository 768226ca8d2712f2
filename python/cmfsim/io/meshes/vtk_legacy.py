"""VTK's files before XML (`.vtk`): read by VTK in the child process, checked here.

VTK's reader forgives: it stops at damage, and passes on what it has. So its complaints are errors
here, and the counts that the file states are compared with what was read.
"""

import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.io.files.reading_writing import utf8_path
from cmfsim.io.meshes.plain_mesh import (
    Cells,
    PlainMesh,
    cells_by_type,
    stated_frame,
    triangles_of,
    triangles_of_strips,
)
from cmfsim.processes.child import ReaderError, read_in_child
from cmfsim.processes.worker import Answer, ReadLimits

# What the child process imports before the time of a file begins.
LIBRARIES = ("vtkmodules.vtkIOLegacy", "vtkmodules.util.numpy_support")
# Words by which VTK's writers begin a file; its third line states how numbers are written.
HEADER = re.compile(
    rb"# vtk DataFile Version [0-9]+\.[0-9]+[^\n]*\n[^\n]{0,4096}\n"
    rb"[ \t]*(?P<form>ASCII|BINARY)[ \t\r]*\n\s*DATASET[ \t]+(?P<kind>[A-Za-z_]+)",
    re.IGNORECASE,
)
READERS: Mapping[str, str] = {
    "POLYDATA": "vtkPolyDataReader",
    "UNSTRUCTURED_GRID": "vtkUnstructuredGridReader",
}
# Lines that state how many points and cells there are, and how many numbers those take.
STATED = re.compile(
    rb"^[ \t]*(?P<name>POINTS|VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|CELLS|CELL_TYPES)[ \t]+"
    rb"(?P<first>[0-9]{1,18})(?:[ \t]+(?P<second>[0-9A-Za-z_]{1,18}))?[ \t\r]*$",
    re.MULTILINE | re.IGNORECASE,
)
# Groups of cells of a surface, by VTK's names.
GROUPS: Mapping[str, str] = {"POLYGONS": "Polys", "TRIANGLE_STRIPS": "Strips"}
# From this version on, cells are offsets and corners; before, each row began with its count.
OFFSETS = re.compile(rb"^[ \t]*OFFSETS[ \t]", re.MULTILINE | re.IGNORECASE)
# The line before the numbers of an array of a FIELD: name, components, rows, type.
ARRAY = re.compile(
    rb"[ \t]*\S+[ \t]+(?P<width>[0-9]{1,9})[ \t]+(?P<rows>[0-9]{1,18})[ \t]+[A-Za-z]\w*\s*"
)
LETTERS = re.compile(rb"[A-Za-z]")
# Processor time, s, and memory, bytes, that a small file may take.
SECONDS, MEMORY = 4.0, 2**30


def read_vtk_legacy(path: Path) -> PlainMesh:
    """The mesh of a file; polygons and strips of a surface become triangles."""
    third_party(LIBRARIES[0].partition(".")[0], "files of .vtk are read", "mesh")
    data = path.read_bytes()
    header = HEADER.match(data)
    if header is None:
        raise CaseInputError(
            "is not a VTK file: '# vtk DataFile Version', a title, ASCII or BINARY and DATASET are "
            "its first lines"
        )
    kind = header["kind"].decode().upper()
    if kind not in READERS:
        raise CaseInputError(
            f"holds {kind!r}: a surface (DATASET {' or '.join(READERS)}) is needed"
        )
    limits = ReadLimits(SECONDS + len(data) / 2e6, MEMORY + 64 * len(data))
    try:
        with utf8_path(path) as plain:
            task = "cmfsim.io.meshes.vtk_legacy:legacy_answer"
            answer = read_in_child(task, limits, path=plain, reader=READERS[kind])
    except ReaderError as error:
        raise CaseInputError(
            f"is cut short or damaged ({error}): export it again, as STL or PLY if you can"
        ) from error
    _check_stated(data, answer.arrays, header.end())
    if header["form"].upper() == b"ASCII":
        _check_last_array(data)
    points = answer.arrays["points"]
    point_data = _named(answer, "point_data")
    if kind == "POLYDATA":
        found = []
        for name, cut in (("POLYGONS", triangles_of), ("TRIANGLE_STRIPS", triangles_of_strips)):
            counts = np.diff(answer.arrays[f"{name}.ends"])
            if len(counts):
                found.append(cut(points, counts, answer.arrays[f"{name}.corners"]))
        cells = (Cells("triangle", np.concatenate(found)),) if found else ()
        return PlainMesh(points, cells, point_data, frame=stated_frame(data, ".vtk"))
    counts = np.diff(answer.arrays["CELLS.ends"])
    blocks, rows = cells_by_type(answer.arrays["types"], counts, answer.arrays["CELLS.corners"])
    cell_data = {
        name: tuple(values[mine] for mine in rows)
        for name, values in _named(answer, "cell_data").items()
    }
    return PlainMesh(points, blocks, point_data, cell_data)


def legacy_answer(path: str, reader: str) -> Answer:
    """What VTK reads from a file; called in the child process."""
    vtk: Any = import_module("vtkmodules.vtkIOLegacy")
    core: Any = import_module("vtkmodules.vtkCommonCore")
    complaints = core.vtkStringOutputWindow()
    core.vtkOutputWindow.SetInstance(complaints)
    source = getattr(vtk, reader)()
    source.SetFileName(path)
    for what in ("Scalars", "Vectors", "Normals", "Tensors", "TCoords", "Fields"):
        getattr(source, f"ReadAll{what}On")()
    source.Update()
    said = str(complaints.GetOutput()).strip()
    read = source.GetOutput()
    if said or read is None:
        # "ERROR: In …cxx, line 199", and then "vtkPolyDataReader (0x…): …".
        lines = [line.strip() for line in said.splitlines() if line.strip()]
        texts = [line for line in lines if not line.startswith(("ERROR: In", "Warning: In"))]
        first = re.sub(r"^\w+ \(0x[0-9a-f]+\): ", "", texts[0]) if texts else "it holds nothing"
        raise CaseInputError(
            f"is cut short or damaged (VTK reports: {first[:100]}): export it again, as STL or PLY "
            "if you can"
        )
    points = read.GetPoints()
    arrays = {"points": np.zeros((0, 3)) if points is None else _array(points.GetData())}
    arrays["points"] = arrays["points"].astype(np.float64)
    if reader == READERS["POLYDATA"]:
        for name, of in GROUPS.items():
            _add_cells(arrays, name, getattr(read, f"Get{of}")())
    else:
        _add_cells(arrays, "CELLS", read.GetCells())
        arrays["types"] = np.array(
            [read.GetCellType(i) for i in range(read.GetNumberOfCells())], dtype=np.int64
        )
    names = {}
    for key, data in (("point_data", read.GetPointData()), ("cell_data", read.GetCellData())):
        # Texts and bits are no arrays of numbers.
        found = [data.GetArray(i) for i in range(data.GetNumberOfArrays())]
        found = [a for a in found if a is not None and not a.IsA("vtkBitArray")]
        names[key] = [str(array.GetName()) for array in found]
        arrays |= {f"{key}.{i}": _array(array) for i, array in enumerate(found)}
    return Answer(names, arrays)


def _array(array: Any) -> NDArray[Any]:
    convert = import_module("vtkmodules.util.numpy_support").vtk_to_numpy
    return np.array(convert(array))


def _add_cells(arrays: dict[str, NDArray[Any]], name: str, cells: Any) -> None:
    """The corners of cells, and where those of each begin and end."""
    if cells is None or not cells.GetNumberOfCells():
        arrays[f"{name}.ends"] = np.zeros(1, dtype=np.int64)
        arrays[f"{name}.corners"] = np.zeros(0, dtype=np.int64)
        return
    arrays[f"{name}.ends"] = _array(cells.GetOffsetsArray()).astype(np.int64)
    arrays[f"{name}.corners"] = _array(cells.GetConnectivityArray()).astype(np.int64)


def _check_stated(data: bytes, arrays: Mapping[str, NDArray[Any]], start: int) -> None:
    """Refuses other counts than the file states: VTK stops at damage and gives what it has."""
    by_offsets = OFFSETS.search(data, start) is not None
    for line in STATED.finditer(data, start):
        name, first = line["name"].decode().upper(), int(line["first"])
        if name in {"POINTS", "CELL_TYPES"}:
            found = len(arrays["points" if name == "POINTS" else "types"])
            if found != first:
                raise CaseInputError(
                    f"is cut short or damaged: it states {first} {name}, {found} were read; export "
                    "it again"
                )
        elif f"{name}.ends" in arrays and line["second"]:
            ends = arrays[f"{name}.ends"]
            n, size = len(ends) - 1, len(arrays[f"{name}.corners"])
            # VTK reads the offsets of no cell as no offsets.
            count = int(line["second"])
            wanted = (max(first - 1, 0), count) if by_offsets else (first, count - first)
            if (n, size) != wanted or (np.diff(ends) < 0).any() or (ends[0], ends[-1]) != (0, size):
                raise CaseInputError(
                    f"is cut short or damaged: it states {wanted[0]} {name} with {wanted[1]} "
                    f"corners, {n} with {size} were read; export it again"
                )


def _check_last_array(data: bytes) -> None:
    """Refuses words that end within an array: VTK fills up what is missing of one in a FIELD."""
    count = 0
    end = len(data)
    while end > 0:
        start = data.rfind(b"\n", 0, end - 1) + 1
        line = data[start:end]
        if stated := ARRAY.fullmatch(line):
            wanted = int(stated["width"]) * int(stated["rows"])
            if count != wanted:
                raise CaseInputError(
                    f"is cut short or damaged: its last array states {wanted} numbers, {count} "
                    "are left; export it again"
                )
            return
        # Numbers have letters too: 1e-5, nan.
        if LETTERS.match(line.lstrip()) and line.lstrip()[:3].lower() not in {b"nan", b"inf"}:
            return
        count += len(line.split())
        end = start


def _named(answer: Answer, key: str) -> dict[str, NDArray[Any]]:
    return {name: answer.arrays[f"{key}.{i}"] for i, name in enumerate(answer.values[key])}
