"""What 3D Slicer's own code does with scenes: run by an interpreter that has `slicer-core`.

    python in_slicer_tasks.py make FOLDER...   # scene.mrml and scene.mrb of FOLDER/surfaces.npz
    python in_slicer_tasks.py look FILE OUT  # where Slicer shows what a scene or bundle holds

Nothing of cmfsim is imported here. Coordinates of `.npz` files are LPS mm.
"""

import json
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import vtk
from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

import slicer

FLIP = np.array([-1.0, -1.0, 1.0])
# Node classes that the headless build does not know by name.
CLASSES = ("vtkMRMLMarkupsJsonStorageNode",)


def new_scene():
    """An empty scene that knows every class of the tests."""
    scene = slicer.vtkMRMLScene()
    for name in CLASSES:
        scene.RegisterNodeClass(getattr(slicer, name)())
    return scene


def poly_data(vertices, triangles):
    """RAS vertices in double precision."""
    points = vtk.vtkPoints()
    points.SetDataTypeToDouble()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(vertices), deep=True))
    rows = np.column_stack([np.full(len(triangles), 3), triangles]).astype(np.int64).ravel()
    cells = vtk.vtkCellArray()
    cells.SetCells(len(triangles), numpy_to_vtkIdTypeArray(rows, deep=True))
    made = vtk.vtkPolyData()
    made.SetPoints(points)
    made.SetPolys(cells)
    return made


def matrix_of(rows):
    """A VTK matrix."""
    matrix = vtk.vtkMatrix4x4()
    for i, row in enumerate(rows):
        for k, value in enumerate(row):
            matrix.SetElement(i, k, float(value))
    return matrix


def rows_of(matrix):
    """An array of a VTK matrix."""
    return np.array([[matrix.GetElement(i, k) for k in range(4)] for i in range(4)])


def store(scene, node, cls, path):
    """Writes a node's data as Slicer does, and keeps where."""
    storage = scene.AddNewNodeByClass(cls)
    node.SetAndObserveStorageNodeID(storage.GetID())
    storage.SetFileName(str(path))
    if not storage.WriteData(node):
        raise SystemExit(f"Slicer cannot write {path}")
    return storage


def make(folder):
    """A scene of the surfaces, transforms and landmarks that FOLDER/scene.json asks for."""
    asked = json.loads((folder / "scene.json").read_text())
    arrays = np.load(folder / "surfaces.npz")
    data = folder / asked.get("data", "Data")
    data.mkdir(exist_ok=True)
    scene, transforms = new_scene(), {}
    for entry in asked["transforms"]:
        node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", entry["name"])
        node.SetMatrixTransformToParent(matrix_of(entry["ras"]))
        if "centre" in entry:
            node.SetCenterOfTransformation(*entry["centre"])
        if "parent" in entry:
            node.SetAndObserveTransformNodeID(transforms[entry["parent"]].GetID())
        transforms[entry["name"]] = node
        ending = entry.get("ending", "h5")
        store(scene, node, "vtkMRMLTransformStorageNode", data / f"{entry['file']}.{ending}")
    for entry in asked["models"]:
        node = scene.AddNewNodeByClass("vtkMRMLModelNode", entry["name"])
        key = entry["key"]
        node.SetAndObservePolyData(
            poly_data(arrays[f"{key}.vertices"] * FLIP, arrays[f"{key}.triangles"])
        )
        if "parent" in entry:
            node.SetAndObserveTransformNodeID(transforms[entry["parent"]].GetID())
        storage = scene.AddNewNodeByClass("vtkMRMLModelStorageNode")
        if entry.get("space") == "RAS":
            storage.SetCoordinateSystem(slicer.vtkMRMLStorageNode.CoordinateSystemRAS)
        node.SetAndObserveStorageNodeID(storage.GetID())
        storage.SetFileName(str(data / f"{key}.{entry['ending']}"))
        if not storage.WriteData(node):
            raise SystemExit(f"Slicer cannot write {key}")
    for entry in asked["markups"]:
        node = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", entry["name"])
        for label, place in entry["points"].items():
            node.AddControlPoint(vtk.vtkVector3d(*(np.array(place) * FLIP)), label)
        if "parent" in entry:
            node.SetAndObserveTransformNodeID(transforms[entry["parent"]].GetID())
        ending = entry["ending"]
        kind = "Json" if ending == "mrk.json" else "Fiducial"
        store(scene, node, f"vtkMRMLMarkups{kind}StorageNode", data / f"{entry['file']}.{ending}")
    if "segments" in asked:
        add_segments(scene, asked["segments"], data / "Segmentation.seg.nrrd")
    scene.SetRootDirectory(str(folder))
    scene.SetURL(str(folder / "scene.mrml"))
    scene.Commit()
    bundle = folder / "bundle" / "scene"
    bundle.mkdir(parents=True)
    scene.SetRootDirectory(str(bundle))
    if not scene.SaveSceneToSlicerDataBundleDirectory(str(bundle), None):
        raise SystemExit("Slicer cannot save the bundle")
    with zipfile.ZipFile(folder / "scene.mrb", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(bundle.rglob("*")):
            archive.write(path, path.relative_to(bundle.parent))
    shutil.rmtree(bundle.parent)
    # As Slicer reads it again: files of single precision hold other numbers than its memory.
    look(folder / "scene.mrml", folder / "shown.npz")


def add_segments(scene, segments, path):
    """A segmentation of ellipsoids on one grid of left-handed axes, as Slicer writes it."""
    node = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Segmentation")
    for entry in segments:
        steps = np.array([-entry["step"], -entry["step"], entry["step"]])
        first = np.array(entry["first"]) * FLIP
        places = np.indices(entry["size"]).reshape(3, -1).T * steps + first
        ratio = (places - np.array(entry["centre"]) * FLIP) / entry["axes"]
        inside = ((ratio**2).sum(axis=1) < 1.0).reshape(entry["size"])
        image = slicer.vtkOrientedImageData()
        image.SetDimensions(*entry["size"])
        values = numpy_to_vtk(inside.astype(np.uint8).ravel(order="F"), deep=True)
        image.GetPointData().SetScalars(values)
        rows = np.eye(4)
        rows[:3, :3], rows[:3, 3] = np.diag(steps), first
        image.SetGeometryFromImageToWorldMatrix(matrix_of(rows))
        if not node.AddSegmentFromBinaryLabelmapRepresentation(image, entry["name"], [1, 0, 0]):
            raise SystemExit(f"Slicer takes no segment {entry['name']}")
    store(scene, node, "vtkMRMLSegmentationStorageNode", path)


def shown(scene):
    """Where Slicer shows the vertices and points of a scene, LPS mm, with the arrays of models."""
    found = {}
    for i in range(scene.GetNumberOfNodes()):
        node = scene.GetNthNode(i)
        world = vtk.vtkMatrix4x4()
        if not hasattr(node, "GetParentTransformNode"):
            continue
        parent = node.GetParentTransformNode()
        if parent is not None:
            parent.GetMatrixTransformToWorld(world)
        rows, name = rows_of(world), node.GetName()
        if node.IsA("vtkMRMLModelNode") and node.GetPolyData() is not None:
            poly = node.GetPolyData()
            points = vtk_to_numpy(poly.GetPoints().GetData()).astype(np.float64)
            found[f"{name}.points"] = (points @ rows[:3, :3].T + rows[:3, 3]) * FLIP
            for k in range(poly.GetPointData().GetNumberOfArrays()):
                array = poly.GetPointData().GetArray(k)
                found[f"{name}.array.{array.GetName()}"] = vtk_to_numpy(array)
            display = node.GetDisplayNode()
            if display is not None and display.GetActiveScalarName():
                found[f"{name}.active"] = np.array(display.GetActiveScalarName())
        elif node.IsA("vtkMRMLLinearTransformNode"):
            node.GetMatrixTransformToParent(world)
            found[f"{name}.matrix"] = rows_of(world)
        elif node.IsA("vtkMRMLMarkupsNode"):
            count = node.GetNumberOfControlPoints()
            places = [node.GetNthControlPointPositionWorld(k) for k in range(count)]
            labels = [node.GetNthControlPointLabel(k) for k in range(count)]
            found[f"{name}.places"] = np.array([[p[0], p[1], p[2]] for p in places]) * FLIP
            found[f"{name}.labels"] = np.array(labels)
    return found


def look(file, out):
    """Where Slicer shows what a scene (.mrml) or bundle (.mrb) holds."""
    if file.suffix == ".mrb":
        folder = out.with_suffix("")
        with zipfile.ZipFile(file) as archive:
            archive.extractall(folder)
        file = next(folder.rglob("*.mrml"))
    scene = new_scene()
    scene.SetRootDirectory(str(file.parent))
    scene.SetURL(str(file))
    if not scene.Import():
        raise SystemExit(f"Slicer cannot read {file}")
    np.savez(out, **shown(scene))


if __name__ == "__main__":
    if sys.argv[1] == "make":
        for name in sys.argv[2:]:
            make(Path(name))
    else:
        look(Path(sys.argv[2]), Path(sys.argv[3]))
