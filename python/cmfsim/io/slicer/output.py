"""A prediction as one file for 3D Slicer (`.mrb`): drag it into Slicer, and see the face.

The bundle holds the predicted face with its displacement as colours, the face before, each bone
where it is before the operation under a transform that carries it to where it goes, and the
landmarks. All coordinates are LPS mm, which every file states.
"""

import stat
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.meshes.vtk_writing import write_triangles
from cmfsim.io.slicer.markups import markup_of, markups_text
from cmfsim.io.slicer.transforms import motion_in_lps, transform_text
from cmfsim.values.checks import AnyPath, Floats
from cmfsim.values.prediction import Prediction
from cmfsim.values.surface_data import SurfaceData

# The bundle of a prediction, in its output folder.
SLICER_FILE = "prediction.mrb"

# Names of the arrays of the faces: their unit is part of the name, for Slicer shows no other.
DISPLACEMENT, LENGTH, FORWARDS = "displacement_mm", "displacement_length_mm", "forwards_mm"
# The table of colours that Slicer itself has.
COLOURS = "vtkMRMLColorTableNodeFileViridis.txt"
SKIN, BONE, BEFORE = (0.87, 0.72, 0.62), (0.95, 0.92, 0.80), (0.70, 0.75, 0.80)
# Members have this date, so that the same prediction gives the same bytes.
DATE = (1980, 1, 1, 0, 0, 0)
PLAIN_FILE = (stat.S_IFREG | 0o644) << 16


@dataclass
class _Scene:
    """The elements of a scene, and the files that belong to it."""

    elements: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    numbers: dict[str, int] = field(default_factory=dict)

    def add(self, element: str, cls: str, attributes: Mapping[str, str]) -> str:
        """The id of an element that was added."""
        self.numbers[cls] = self.numbers.get(cls, 0) + 1
        node = f"{cls}{self.numbers[cls]}"
        words = " ".join(f"{k}={quoteattr(v)}" for k, v in {"id": node, **attributes}.items())
        self.elements.append(f" <{element} {words}></{element}>")
        return node

    def store(self, element: str, cls: str, name: str, data: bytes) -> str:
        """The id of the storage node of a file that was added."""
        self.files[f"Data/{name}"] = data
        attributes = {"name": element, "fileName": f"Data/{name}", "coordinateSystem": "LPS"}
        if element == "TransformStorage":
            del attributes["coordinateSystem"]
        return self.add(element, cls, {**attributes, "hideFromEditors": "true"})

    def transform(self, name: str, file: str, matrix: Floats) -> str:
        """The id of a transform that carries what lies under it as a motion in LPS does."""
        text = transform_text(matrix, direction="from-parent").encode()
        stored = self.store("TransformStorage", "vtkMRMLTransformStorageNode", f"{file}.tfm", text)
        ras = motion_in_lps(matrix, "RAS")
        rows = "  ".join(" ".join(repr(float(v)) for v in row) for row in ras)
        references = f"storage:{stored};"
        attributes = {"name": name, "references": references, "matrixTransformToParent": rows}
        return self.add("LinearTransform", "vtkMRMLLinearTransformNode", attributes)

    def model(self, name: str, file: str, look: "_Look", surface: bytes) -> None:
        """Adds a model with its file and how it looks."""
        stored = self.store("ModelStorage", "vtkMRMLModelStorageNode", f"{file}.vtp", surface)
        shown = {
            "name": f"{name} display",
            "hideFromEditors": "true",
            "color": " ".join(f"{c:g}" for c in look.colour),
            "opacity": f"{look.opacity:g}",
            "visibility": "true" if look.is_visible else "false",
            "visibility2D": "true",
            "visibility3D": "true",
        }
        if look.scalars:
            shown |= {
                "scalarVisibility": "true",
                "activeScalarName": look.scalars,
                "activeAttributeLocation": "point",
                "scalarRangeFlag": "UseData",
                "references": f"color:{COLOURS};",
            }
        display = self.add("ModelDisplay", "vtkMRMLModelDisplayNode", shown)
        under = f"transform:{look.parent};" if look.parent else ""
        references = f"display:{display};storage:{stored};{under}"
        self.add("Model", "vtkMRMLModelNode", {"name": name, "references": references})

    def points(self, name: str, file: str, points: Mapping[str, ArrayLike]) -> None:
        """Adds landmarks."""
        places = [(label, np.asarray(point, dtype=np.float64)) for label, point in points.items()]
        text = markups_text([markup_of("Fiducial", places)]).encode()
        json_storage = ("MarkupsJsonStorage", "vtkMRMLMarkupsJsonStorageNode")
        stored = self.store(*json_storage, f"{file}.mrk.json", text)
        shown = {"name": f"{name} display", "hideFromEditors": "true", "visibility": "false"}
        display = self.add("MarkupsFiducialDisplay", "vtkMRMLMarkupsFiducialDisplayNode", shown)
        attributes = {"name": name, "references": f"display:{display};storage:{stored};"}
        self.add("MarkupsFiducial", "vtkMRMLMarkupsFiducialNode", attributes)

    def text(self) -> bytes:
        """The scene as MRML."""
        body = "\n".join(self.elements)
        head = '<?xml version="1.0" encoding="UTF-8"?>\n<MRML version="Slicer5" userTags="">\n'
        return f"{head}{body}\n</MRML>\n".encode()


@dataclass(frozen=True)
class _Look:
    """How a model looks, and the transform that it lies under."""

    colour: tuple[float, float, float]
    opacity: float = 1.0
    scalars: str = ""
    parent: str = ""
    is_visible: bool = True


def write_slicer_bundle(path: AnyPath, prediction: Prediction) -> None:
    """Writes a prediction as one `.mrb`, which 3D Slicer opens by drag and drop.

    Models `face predicted` (arrays `displacement_mm`, `displacement_length_mm`, `forwards_mm`;
    coloured by the length), `face before` and one for each segment where it is before the
    operation, under a transform `plan NAME` with its motion (a segment whose motion is not rigid
    lies where it goes); landmarks. `cmfsim init` reads the plan back from it.

    Parameters
    ----------
    path : path
        Replaced when all is written. The same prediction gives the same bytes.
    prediction : Prediction

    Raises
    ------
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_slicer_bundle("face.mrb", prediction)
    """
    path = Path(path)
    scene = _Scene()
    _add_faces(scene, prediction)
    _add_bones(scene, prediction)
    for kind, points in prediction.patient.landmarks.items():
        scene.points(f"{kind} landmarks before", f"{kind}_landmarks", points)
    root = path.stem
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {f"{root}.mrml": scene.text(), **scene.files}.items():
            member = zipfile.ZipInfo(f"{root}/{name}", DATE)
            member.compress_type, member.external_attr = zipfile.ZIP_DEFLATED, PLAIN_FILE
            archive.writestr(member, data)


def _add_faces(scene: _Scene, prediction: Prediction) -> None:
    face, before = prediction.face, prediction.face_before
    carried = face.vertices - before.vertices
    # The patient looks along −P.
    lengths, forwards = np.linalg.norm(carried, axis=1), -carried[:, 1]
    data = {DISPLACEMENT: carried, LENGTH: lengths, FORWARDS: forwards}
    look = _Look(SKIN, scalars=LENGTH)
    scene.model("face predicted", "face_predicted", look, _vtp(face, data))
    hidden = _Look(BEFORE, opacity=0.4, is_visible=False)
    scene.model("face before", "face_before", hidden, _vtp(before, data))


def _add_bones(scene: _Scene, prediction: Prediction) -> None:
    for name, (surface, moved) in prediction.bones.items():
        motion = prediction.scene.plan.get(name)
        parent, shown = "", surface
        if isinstance(motion, np.ndarray) and motion.shape == (4, 4):
            if not np.array_equal(motion, np.eye(4)):
                parent = scene.transform(f"plan {name}", f"plan_{name}", motion)
        else:
            shown = SurfaceData(moved, surface.triangles)
        scene.model(name, name, _Look(BONE, parent=parent), _vtp(shown, {}))


def _vtp(surface: SurfaceData, data: Mapping[str, NDArray[np.float64]]) -> bytes:
    file = BytesIO()
    vectors = DISPLACEMENT if DISPLACEMENT in data else ""
    write_triangles(file, surface.vertices, surface.triangles, data, vectors=vectors, frame="LPS")
    return file.getvalue()
