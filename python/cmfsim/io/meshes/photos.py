"""3D photos: a skin with colours, from OBJ with its material and textures, or from PLY.

VTK reads them in the child process. The files that an OBJ names must lie next to it.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.io.files.reading_writing import beside, check_readable, named, utf8_path
from cmfsim.io.meshes.obj import read_obj
from cmfsim.io.meshes.ply import read_ply
from cmfsim.io.meshes.polygons import triangles_of
from cmfsim.io.meshes.stated_frames import stated_frame
from cmfsim.processes.child import ReaderError, read_in_child
from cmfsim.processes.worker import Answer, ReadLimits
from cmfsim.values.checks import Floats

# What the child process imports before the time of a file begins.
LIBRARIES = ("vtkmodules.vtkIOImport", "vtkmodules.vtkIOPLY", "vtkmodules.util.numpy_support")
# Processor time, s, and memory, bytes, that a photo may take: a texture has up to 8192² pixels.
SECONDS, MEMORY = 30.0, 4 * 2**30
# Textures are thinned out to so many pixels a side: 0.1 mm on a face.
MOST_PIXELS = 2048
# What names the next file: of an OBJ its material, of that a texture after its options.
NAMES: Mapping[str, re.Pattern[bytes]] = {
    ".obj": re.compile(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", re.MULTILINE),
    ".mtl": re.compile(rb"^[ \t]*map_Kd[ \t]+(?:-\S+[ \t]+\S+[ \t]+)*(.+?)[ \t\r]*$", re.MULTILINE),
}


@dataclass(frozen=True, eq=False)
class Photo:
    """A surface with colours: of its vertices, or in textures that its triangles refer to.

    vertices: In the unit of the file; LPS if it states RAS, otherwise in its own frame.
    colours: Red, green, blue of the vertices.
    places: Of the vertices in the texture, to the right and up, 0 to 1.
    number: Of the texture of each triangle.
    textures: Each (h, w, 3), from the lowest row up.
    """

    vertices: Floats
    triangles: NDArray[np.int64]
    colours: NDArray[np.uint8] | None = None
    places: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    number: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    textures: tuple[NDArray[np.uint8], ...] = ()

    def colours_at(self, triangles: NDArray[Any], shares: Floats) -> NDArray[np.uint8]:
        """The colours at points of triangles, (k, 3), given by the shares of their corners."""
        corners = self.triangles[triangles]
        if self.colours is not None:
            mixed = np.einsum("kc,kca->ka", shares, self.colours[corners].astype(np.float64))
            return np.asarray(np.rint(mixed).clip(0, 255), dtype=np.uint8)
        places = np.einsum("kc,kca->ka", shares, self.places[corners])
        found = np.zeros((len(places), 3), dtype=np.uint8)
        for number, texture in enumerate(self.textures):
            mine = self.number[triangles] == number
            size = np.array(texture.shape[1::-1])
            x, y = np.clip(places[mine] * size, 0, size - 1).astype(np.int64).T
            found[mine] = texture[y, x]
        return found


def photo_files(path: Path) -> list[Path]:
    """The files of a photo: itself, and of an OBJ its materials and their textures.

    Raises `FileNotFoundError`: One is missing.
    Raises `CaseError`: One that an OBJ names lies elsewhere.
    """
    found = [path]
    for file in found:
        check_readable(file)
        pattern = NAMES.get(file.suffix.lower())
        for name in dict.fromkeys(pattern.findall(file.read_bytes()) if pattern else ()):
            text = name.decode("utf-8", errors="replace")
            found.append(beside(path.parent, f"{file.name}: a file that it names", text))
    return list(dict.fromkeys(found))


def read_photo(path: Path) -> Photo:
    """The photo in a file.

    Raises `FileNotFoundError`: It, its material or its texture is missing.
    Raises `CaseError`: Another format, no colours, whatever VTK complains of; VTK is missing.
    """
    third_party("vtkmodules", "3D photos are read", "mesh")
    files = photo_files(path)
    materials = [file for file in files if file.suffix.lower() == ".mtl"]
    with named(path):
        if path.suffix.lower() not in {".obj", ".ply"}:
            raise CaseInputError(
                "a 3D photo is an OBJ with its MTL and texture, or a PLY with colours"
            )
        if path.suffix.lower() == ".obj" and (len(materials) != 1 or len(files) < 3):
            raise CaseInputError(
                "has no colours: it must name one material (mtllib) that names a texture (map_Kd)"
            )
        # VTK forgives damage; these do not.
        data = path.read_bytes()
        vertices = (read_ply(data) if path.suffix.lower() == ".ply" else read_obj(data))[0]
        limits = ReadLimits(SECONDS, MEMORY)
        try:
            with utf8_path(path) as plain:
                answer = read_in_child(
                    "cmfsim.io.meshes.photos:photo_answer",
                    limits,
                    path=plain,
                    material=str(materials[0].absolute()) if materials else "",
                )
        except ReaderError as error:
            raise CaseInputError(f"cannot be read as a 3D photo: {error}") from error
        photo = _checked(answer.arrays)
        if photo.colours is not None and len(photo.vertices) != len(vertices):
            raise CaseInputError(
                f"has {len(vertices)} vertices, of which VTK reads {len(photo.vertices)}"
            )
        if stated_frame(data, path.suffix.lower()) == "RAS":
            return replace(photo, vertices=photo.vertices * (-1.0, -1.0, 1.0))
        return photo


def _checked(arrays: Mapping[str, NDArray[Any]]) -> Photo:
    points = np.asarray(arrays["points"], dtype=np.float64)
    triangles = np.asarray(arrays["triangles"], dtype=np.int64)
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(points):
        raise CaseInputError("holds no triangles, or vertices that are not there")
    if not np.isfinite(points).all():
        raise CaseInputError("holds coordinates that are not finite")
    if "colours" in arrays:
        return Photo(points, triangles, arrays["colours"])
    if not np.isfinite(arrays["places"]).all():
        raise CaseInputError("holds places in its texture that are not finite")
    textures = tuple(arrays[f"texture.{k}"] for k in range(arrays["number"].max() + 1))
    places = np.asarray(arrays["places"], dtype=np.float64)
    return Photo(points, triangles, None, places, arrays["number"], textures)


def photo_answer(path: str, material: str) -> Answer:
    """What VTK reads of a photo; called in the child process."""
    numbers: Any = import_module("vtkmodules.util.numpy_support").vtk_to_numpy
    if not material:
        reader: Any = import_module("vtkmodules.vtkIOPLY").vtkPLYReader()
        reader.SetFileName(path)
        reader.Update()
        data = reader.GetOutput()
        colours = data.GetPointData().GetScalars()
        if colours is None or colours.GetNumberOfComponents() < 3 or colours.GetDataTypeSize() != 1:
            raise CaseInputError("has no colours: its vertices need red, green and blue (uchar)")
        points, triangles = _surface(data, numbers)
        arrays = {"points": points, "triangles": triangles, "colours": numbers(colours)[:, :3]}
        return Answer({}, arrays)
    return _textured(path, material, numbers)


def _textured(path: str, material: str, numbers: Any) -> Answer:
    """The triangles of an OBJ that have a texture, and the textures."""
    importer: Any = import_module("vtkmodules.vtkIOImport").vtkOBJImporter()
    importer.SetFileName(path)
    importer.SetFileNameMTL(material)
    importer.SetTexturePath(str(Path(material).parent))
    importer.Update()
    parts: dict[str, list[Any]] = {"points": [], "triangles": [], "places": [], "number": []}
    textures: list[Any] = []
    actors = importer.GetRenderer().GetActors()
    actors.InitTraversal()
    count = 0
    for _ in range(actors.GetNumberOfItems()):
        actor = actors.GetNextActor()
        data, texture = actor.GetMapper().GetInput(), actor.GetTexture()
        places = data.GetPointData().GetTCoords()
        if texture is None or places is None or not data.GetNumberOfPolys():
            continue
        points, triangles = _surface(data, numbers)
        parts["points"].append(points)
        parts["triangles"].append(triangles + count)
        parts["places"].append(numbers(places)[:, :2])
        parts["number"].append(np.full(len(triangles), len(textures)))
        count += len(points)
        texture.GetInputAlgorithm().Update()
        textures.append(_pixels(texture.GetInput(), numbers))
    if not textures:
        raise CaseInputError("has no triangle with a texture")
    arrays = {name: np.concatenate(array) for name, array in parts.items()}
    return Answer({}, arrays | {f"texture.{k}": pixels for k, pixels in enumerate(textures)})


def _surface(data: Any, numbers: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    cells = data.GetPolys()
    corners = numbers(cells.GetConnectivityArray()).astype(np.int64)
    lengths = np.diff(numbers(cells.GetOffsetsArray()).astype(np.int64))
    points = numbers(data.GetPoints().GetData()).astype(np.float64)
    return points, triangles_of(points, lengths, corners)


def _pixels(image: Any, numbers: Any) -> NDArray[np.uint8]:
    """The pixels of a texture, (h, w, 3), thinned out."""
    width, height, _ = image.GetDimensions()
    values = numbers(image.GetPointData().GetScalars())
    if width * height == 0 or values.dtype != np.uint8:
        raise CaseInputError("has a texture that cannot be read: JPEG or PNG of 8 bits is needed")
    values = values.reshape(height, width, -1)
    if values.shape[2] < 3:
        values = np.repeat(values[:, :, :1], 3, axis=2)
    step = -(-max(width, height) // MOST_PIXELS)
    return np.ascontiguousarray(values[::step, ::step, :3])
