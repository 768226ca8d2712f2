"""Scenes of 3D Slicer written by hand, of the head of ellipsoids: as text, without Slicer."""

import zipfile

import cmfsim
import head_case


def transform(name, numbers, parent=""):
    """A linear transform to its parent, RAS, row by row."""
    under = f' references="transform:{parent};"' if parent else ""
    return (
        f'<LinearTransform id="{name}" name="{name}"{under} matrixTransformToParent="{numbers}"/>'
    )


def shift(right, forwards, up):
    """The numbers of a translation, RAS mm."""
    return f"1 0 0 {right}  0 1 0 {forwards}  0 0 1 {up}  0 0 0 1"


def model(name, file, parent=""):
    """A model with its file."""
    under = f"transform:{parent};" if parent else ""
    key = name.replace(" ", "_")
    return (
        f'<ModelStorage id="s{key}" fileName="{file}"/>'
        f'<Model id="{key}" name="{name}" references="storage:s{key};{under}"/>'
    )


def points(name, file):
    """A list of points with its file."""
    return (
        f'<MarkupsJsonStorage id="s{name}" fileName="{file}"/>'
        f'<MarkupsFiducial id="{name}" name="{name}" references="storage:s{name};"/>'
    )


def write_scene(folder, *elements):
    """The path of scene.mrml in a folder that has the surfaces and skull landmarks as files."""
    case = head_case.HeadCase()
    for name, surface in case.surfaces.items():
        cmfsim.write_surface(folder / f"{name}.ply", surface)
    cmfsim.write_landmarks(folder / "skull.mrk.json", case.skull)
    path = folder / "scene.mrml"
    text = "\n".join([*elements, points("Skull", "skull.mrk.json")])
    path.write_text(f'<MRML version="Slicer5">{text}</MRML>', encoding="utf-8")
    return path


def pack(folder, path):
    """The bundle of a folder's scene and files, which are removed."""
    files = sorted(folder.iterdir())
    with zipfile.ZipFile(path, "w") as archive:
        for file in files:
            archive.write(file, f"{path.stem}/{file.name}")
            file.unlink()
    return path
