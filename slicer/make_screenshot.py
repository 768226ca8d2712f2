"""Draws what 3D Slicer's own code holds after it read a bundle of `cmfsim predict --slicer`.

    PYTHON_WITH_SLICER_CORE slicer/make_screenshot.py prediction.mrb slicer/Screenshots/face.png

Models, transforms and arrays are Slicer's (slicer-core); the picture is drawn by VTK alone,
without Slicer's window.
"""

import sys
import tempfile
import zipfile
from pathlib import Path

import vtk

import slicer

SIZE = (1400, 700)
FACE, ACTIVE = "face predicted", "displacement_length_mm"
# Directions from which the patient is seen, RAS: the face and the bones under it.
VIEWS = ((-0.75, 0.6, 0.05), (-0.75, 0.6, 0.05))


def load(bundle, folder):
    """The scene of a bundle."""
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(folder)
    file = next(Path(folder).rglob("*.mrml"))
    scene = slicer.vtkMRMLScene()
    scene.RegisterNodeClass(slicer.vtkMRMLMarkupsJsonStorageNode())
    scene.SetRootDirectory(str(file.parent))
    scene.SetURL(str(file))
    if not scene.Import():
        raise SystemExit(f"Slicer cannot read {bundle}")
    return scene


def actors(scene):
    """An actor for each model that is visible, where its transforms carry it, and the colours."""
    table = vtk.vtkLookupTable()
    for i in range(scene.GetNumberOfNodesByClass("vtkMRMLModelNode")):
        node = scene.GetNthNodeByClass(i, "vtkMRMLModelNode")
        display = node.GetDisplayNode()
        if not display.GetVisibility():
            continue
        mapper = vtk.vtkPolyDataMapper()
        mapper.SetInputData(node.GetPolyData())
        mapper.ScalarVisibilityOff()
        actor = vtk.vtkActor()
        actor.SetMapper(mapper)
        actor.GetProperty().SetColor(display.GetColor())
        if node.GetName() == FACE:
            values = node.GetPolyData().GetPointData().GetArray(ACTIVE)
            table.SetRange(0.0, values.GetRange()[1])
            viridis(table)
            mapper.SetLookupTable(table)
            mapper.ScalarVisibilityOn()
            mapper.SetScalarModeToUsePointFieldData()
            mapper.SelectColorArray(ACTIVE)
            mapper.UseLookupTableScalarRangeOn()
        elif node.GetParentTransformNode() is not None:
            matrix = vtk.vtkMatrix4x4()
            node.GetParentTransformNode().GetMatrixTransformToWorld(matrix)
            actor.SetUserMatrix(matrix)
        yield actor, table if node.GetName() == FACE else None


def viridis(table):
    """The colours of the scene's table, by five of its values."""
    colours = vtk.vtkColorTransferFunction()
    for x, r, g, b in (
        (0.0, 0.267, 0.005, 0.329),
        (0.25, 0.229, 0.322, 0.546),
        (0.5, 0.128, 0.567, 0.551),
        (0.75, 0.369, 0.789, 0.383),
        (1.0, 0.993, 0.906, 0.144),
    ):
        colours.AddRGBPoint(x, r, g, b)
    table.SetNumberOfTableValues(256)
    for i in range(256):
        table.SetTableValue(i, *colours.GetColor(i / 255.0), 1.0)


def main():
    """Writes the picture."""
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetSize(*SIZE)
    window.SetMultiSamples(8)
    with tempfile.TemporaryDirectory() as folder:
        scene = load(sys.argv[1], folder)
        for number, view in enumerate(VIEWS):
            renderer = vtk.vtkRenderer()
            renderer.SetViewport(0.5 * number, 0.0, 0.5 * number + 0.5, 1.0)
            renderer.SetBackground(0.76, 0.76, 0.91)
            renderer.SetBackground2(0.45, 0.47, 0.75)
            renderer.GradientBackgroundOn()
            for actor, table in actors(scene):
                # The first view shows the face, the second the bones under it.
                if table is None or number == 0:
                    renderer.AddActor(actor)
                if table is not None and number == 0:
                    bar = vtk.vtkScalarBarActor()
                    bar.SetLookupTable(table)
                    bar.SetTitle("moved, mm")
                    bar.SetNumberOfLabels(6)
                    bar.SetMaximumWidthInPixels(90)
                    bar.SetPosition(0.03, 0.1)
                    bar.SetHeight(0.8)
                    renderer.AddViewProp(bar)
            camera = renderer.GetActiveCamera()
            camera.SetFocalPoint(0, 0, 0)
            camera.SetPosition(*view)
            camera.SetViewUp(0, 0, 1)
            renderer.ResetCamera()
            camera.Zoom(1.5)
            window.AddRenderer(renderer)
        window.Render()
        grab = vtk.vtkWindowToImageFilter()
        grab.SetInput(window)
        grab.ReadFrontBufferOff()
        writer = vtk.vtkPNGWriter()
        writer.SetFileName(sys.argv[2])
        writer.SetInputConnection(grab.GetOutputPort())
        writer.Write()


if __name__ == "__main__":
    main()
