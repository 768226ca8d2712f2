"""3D photos: a skin with colours, from OBJ with its material and textures, or from PLY.

VTK reads the colours in the child process. The files that an OBJ names must lie next to it.
"""

import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.io.files.reading_writing import beside, check_readable, named, utf8_path
from cmfsim.io.meshes.obj import read_obj
from cmfsim.io.meshes.plain_mesh import stated_frame
from cmfsim.io.meshes.ply import read_ply
from cmfsim.processes.child import ReaderError, read_in_child
from cmfsim.processes.worker import Answer, ReadLimits
from cmfsim.values.checks import Floats

# What the child process imports before the time of a file begins.
LIBRARIES = (
    *("vtkmodules.vtkIOImport", "vtkmodules.vtkIOPLY", "vtkmodules.vtkFiltersModeling"),
    "vtkmodules.util.numpy_support",
)
# Processor time, s, and memory, bytes, that a photo may take: a texture has up to 8192² pixels.
SECONDS, MEMORY = 30.0, 4 * 2**30
# Triangles with a texture are divided until there are so many: the colours are those of vertices.
LEAST_TRIANGLES, MOST_DIVISIONS = 150_000, 6
# What names the next file: of an OBJ its material, of that a texture after its options.
NAMES: Mapping[str, re.Pattern[bytes]] = {
    ".obj": re.compile(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", re.MULTILINE),
    ".mtl": re.compile(rb"^[ \t]*map_Kd[ \t]+(?:-\S+[ \t]+\S+[ \t]+)*(.+?)[ \t\r]*$", re.MULTILINE),
}


class Photo(NamedTuple):
    """A surface with a colour, red, green and blue, at each vertex.

    It is in the unit of the file; in LPS if the file states RAS, otherwise in a frame of its own.
    """

    vertices: Floats
    triangles: NDArray[np.int64]
    colours: NDArray[np.uint8]


def photo_files(path: Path) -> list[Path]:
    """The files of a photo: itself, and beside it an OBJ's materials and their textures."""
    found = [path]
    for file in found:
        check_readable(file)
        pattern = NAMES.get(file.suffix.lower())
        for name in dict.fromkeys(pattern.findall(file.read_bytes()) if pattern else ()):
            text = name.decode("utf-8", errors="replace")
            found.append(beside(path.parent, f"{file.name}: a file that it names", text))
    return list(dict.fromkeys(found))


def read_photo(path: Path) -> Photo:
    """The photo in a file."""
    third_party("vtkmodules", "3D photos are read", "mesh")
    suffix, files = path.suffix.lower(), photo_files(path)
    materials = [str(file.absolute()) for file in files if file.suffix.lower() == ".mtl"]
    with named(path):
        if suffix not in {".obj", ".ply"}:
            raise CaseInputError(
                "a 3D photo is an OBJ with its MTL and texture, or a PLY with colours"
            )
        if suffix == ".obj" and (len(materials) != 1 or len(files) < 3):
            raise CaseInputError(
                "has no colours: it must name one material (mtllib) that names a texture (map_Kd)"
            )
        # VTK forgives damage; these do not.
        data = path.read_bytes()
        vertices = (read_ply(data) if suffix == ".ply" else read_obj(data))[0]
        limits, task = ReadLimits(SECONDS, MEMORY), f"{__name__}:photo_answer"
        try:
            with utf8_path(path) as plain:
                answer = read_in_child(task, limits, path=plain, material="".join(materials))
        except ReaderError as error:
            raise CaseInputError(f"cannot be read as a 3D photo: {error}") from error
        photo = Photo(**answer.arrays)
        if not materials and len(photo.vertices) != len(vertices):
            raise CaseInputError(
                f"has {len(vertices)} vertices, of which VTK reads {len(photo.vertices)}"
            )
        if not len(photo.triangles) or photo.triangles.max() >= len(photo.vertices):
            raise CaseInputError("holds no triangles, or vertices that are not there")
        if stated_frame(data, suffix) == "RAS":
            return photo._replace(vertices=photo.vertices * (-1.0, -1.0, 1.0))
        return photo


def photo_answer(path: str, material: str) -> Answer:
    """What VTK reads of a photo; called in the child process."""
    numbers: Any = import_module(LIBRARIES[-1]).vtk_to_numpy
    parts = list(_textured(path, material, numbers) if material else _coloured(path, numbers))
    if not parts:
        raise CaseInputError("has no triangle with a texture")
    starts = np.cumsum([0, *(len(colours) for _, colours in parts)])
    triangles = [
        numbers(data.GetPolys().GetConnectivityArray()).astype(np.int64).reshape(-1, 3) + start
        for (data, _), start in zip(parts, starts, strict=False)
    ]
    vertices = [numbers(data.GetPoints().GetData()).astype(np.float64) for data, _ in parts]
    arrays = {"vertices": vertices, "triangles": triangles, "colours": [c for _, c in parts]}
    return Answer({}, {name: np.concatenate(found) for name, found in arrays.items()})


def _triangulated(data: Any, divisions: bool = False) -> Any:  # noqa: FBT001, FBT002
    """The triangles of a surface of VTK, divided until there are enough of them."""
    cut = import_module("vtkmodules.vtkFiltersCore").vtkTriangleFilter()
    cut.SetInputData(data)
    cut.Update()
    found = cut.GetOutput()
    few = LEAST_TRIANGLES / max(found.GetNumberOfPolys(), 1)
    if not divisions or few <= 1.0:
        return found
    divided = import_module("vtkmodules.vtkFiltersModeling").vtkLinearSubdivisionFilter()
    divided.SetInputData(found)
    divided.SetNumberOfSubdivisions(min(MOST_DIVISIONS, int(np.ceil(np.log(few) / np.log(4.0)))))
    divided.Update()
    return divided.GetOutput()


def _coloured(path: str, numbers: Any) -> Any:
    """The surface of a PLY, with the colours of its vertices."""
    reader = import_module("vtkmodules.vtkIOPLY").vtkPLYReader()
    reader.SetFileName(path)
    reader.Update()
    data = reader.GetOutput()
    colours = data.GetPointData().GetScalars()
    if colours is None or colours.GetNumberOfComponents() < 3 or colours.GetDataTypeSize() != 1:
        raise CaseInputError("has no colours: its vertices need red, green and blue (uchar)")
    yield _triangulated(data), numbers(colours)[:, :3]


def _textured(path: str, material: str, numbers: Any) -> Any:
    """The surfaces of an OBJ that have a texture, with its colours at their vertices."""
    importer = import_module("vtkmodules.vtkIOImport").vtkOBJImporter()
    importer.SetFileName(path)
    importer.SetFileNameMTL(material)
    importer.SetTexturePath(str(Path(material).parent))
    importer.Update()
    actors = importer.GetRenderer().GetActors()
    actors.InitTraversal()
    for _ in range(actors.GetNumberOfItems()):
        actor = actors.GetNextActor()
        data, texture = actor.GetMapper().GetInput(), actor.GetTexture()
        places = data.GetPointData().GetTCoords()
        if texture is None or places is None or not data.GetNumberOfPolys():
            continue
        texture.GetInputAlgorithm().Update()
        image = texture.GetInput()
        width, height, _ = image.GetDimensions()
        pixels = numbers(image.GetPointData().GetScalars())
        if width * height == 0 or pixels.dtype != np.uint8:
            raise CaseInputError(
                "has a texture that cannot be read: JPEG or PNG of 8 bits is needed"
            )
        # From the lowest row up; of grey, the same three times.
        pixels = pixels.reshape(height, width, -1)
        data = _triangulated(data, divisions=True)
        places = numbers(data.GetPointData().GetTCoords()).astype(np.float64)
        if not np.isfinite(places).all():
            raise CaseInputError("holds places in its texture that are not finite")
        x, y = (
            np.clip(places[:, a] * n, 0, n - 1).astype(int) for a, n in enumerate((width, height))
        )
        yield data, np.broadcast_to(pixels[y, x, :3], (len(x), 3))
