"""`cmfsim view`: predictions, models, scenes, results and surfaces in a window."""

import argparse
import contextlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cmfsim._core import TetMesh
from cmfsim.cli.exit_codes import DONE
from cmfsim.errors import CaseInputError
from cmfsim.io import Case, read_parts, read_result, read_scene, read_surface
from cmfsim.io.results.predictions import predictions_of
from cmfsim.pictures import KIND_COLOURS, SKIN_COLOUR, ViewPart, segment_colours, view_parts
from cmfsim.pictures.window import OVER_BONES, prediction_parts
from cmfsim.values.surface_data import SurfaceData

SURFACES = (".stl", ".ply", ".obj", ".vtp")


def view(options: argparse.Namespace) -> int:
    """Shows the contents of a folder or file, or writes a picture of them."""
    path: Path = options.path
    parts = parts_of(path, options.model)
    view_parts(parts, title=f"{path.name} - cmfsim", screenshot=options.screenshot)
    if options.json:
        names = [part.name for part in parts]
        picture = None if options.screenshot is None else str(options.screenshot)
        print(json.dumps({"parts": names, "screenshot": picture}))
    elif options.screenshot is not None:
        print(f"wrote {options.screenshot}")
    return DONE


def parts_of(path: Path, model: str | None = None) -> list[ViewPart]:
    """The surfaces to show of a folder or file.

    Raises `FileNotFoundError`: It is not there.
    Raises `CaseError`: It holds nothing that can be shown.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_dir():
        return _of_folder(path, model)
    if path.name == "prediction.json":
        return prediction_parts(read_parts(path.parent))
    if path.suffix == ".toml" and "cmfsim-case" in path.read_text(encoding="utf-8"):
        output = Case.load(path).output
        if not output.is_dir():
            raise CaseInputError(f"{path}: has no results yet: run cmfsim predict {path} first")
        return _of_folder(output, model)
    readers: dict[str, Callable[[Path], list[ViewPart]]] = {
        **dict.fromkeys(SURFACES, _of_surface),
        ".toml": _of_scene,
        ".npz": _of_archive,
    }
    if path.suffix.lower() not in readers:
        known = ", ".join(readers)
        raise CaseInputError(f"{path.name}: view displays folders, and files ending in {known}")
    return readers[path.suffix.lower()](path)


def _of_folder(folder: Path, model: str | None) -> list[ViewPart]:
    """A prediction; else those of a folder by model; else a model of a patient; else a case."""
    with contextlib.suppress(FileNotFoundError):
        found = {entry["model"]: place for place, entry in predictions_of(folder).items()}
        if model is not None and model not in found:
            raise CaseInputError(f"{folder}: contains the models {', '.join(found)}, not {model}")
        # The case's own prediction before those in folders by model.
        own = next((name for name, place in found.items() if place == folder), None)
        return prediction_parts(read_parts(found[model or own or [*found][-1]]))
    if (folder / "build.json").exists():
        return _of_model(folder)
    if (folder / "case.toml").exists():
        return parts_of(folder / "case.toml", model)
    raise CaseInputError(
        f"{folder}: contains no prediction.json, build.json or case.toml, so there is nothing to "
        "display"
    )


def _of_model(folder: Path) -> list[ViewPart]:
    bones = {p.stem.removeprefix("segment-"): p for p in sorted(folder.glob("segment-*.ply"))}
    colours = segment_colours(list(bones))
    skin = ViewPart("skin", read_surface(folder / "skin.ply"), SKIN_COLOUR, OVER_BONES)
    return [skin, *(ViewPart(n, read_surface(p), colours[n]) for n, p in bones.items())]


def _of_surface(path: Path) -> list[ViewPart]:
    return [ViewPart(path.stem, read_surface(path), SKIN_COLOUR)]


def _of_archive(path: Path) -> list[ViewPart]:
    """A scene or a result: both are archives that state their own type."""
    with np.load(path, allow_pickle=False) as archive:
        names = set(archive.files)
    if "scene" in names:
        return _of_scene(path)
    if "result" not in names:
        raise CaseInputError(f"{path.name}: is neither a scene nor a result of cmfsim")
    result = read_result(path)
    nodes, triangles = result.nodes, result.skin_triangles
    moved = result.displacements
    size = np.linalg.norm(moved, axis=1)
    return [
        ViewPart("after", SurfaceData(nodes + moved, triangles), "#21918c", values=size),
        ViewPart("before", SurfaceData(nodes, triangles), SKIN_COLOUR, shown=False),
    ]


def _of_scene(path: Path) -> list[ViewPart]:
    scene = read_scene(path)
    boundary = TetMesh(scene.nodes, scene.tets).boundary_triangles()
    parts = [ViewPart("tissue", SurfaceData(scene.nodes, boundary), SKIN_COLOUR, OVER_BONES)]
    held = {"fixed": scene.fixed}
    for name, segment in scene.segments.items():
        held[f"{name} joined"] = segment.joined
        held[f"{name} sliding"] = segment.sliding
        if segment.contact is not None:
            parts.append(ViewPart(f"{name} contact", segment.contact, "#e6dcc3", shown=False))
    for name, nodes in held.items():
        touched = boundary[np.isin(boundary, nodes).any(axis=1)]
        if len(touched):
            kind = name.rsplit(" ", 1)[-1]
            parts.append(ViewPart(name, SurfaceData(scene.nodes, touched), KIND_COLOURS[kind]))
    return parts
