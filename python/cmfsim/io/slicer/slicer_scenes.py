"""Scenes of 3D Slicer (`.mrml`): models, transforms, markups, segmentations and volumes, read only.

A scene is XML that names files and what moves what. Files come from strangers: a document type is
refused, sizes are limited, and only files in the scene's own folder are named.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from urllib.parse import unquote
from xml.parsers import expat

import numpy as np

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.files.reading_writing import check_readable, is_below, is_there, named, strict_parser
from cmfsim.io.slicer.transforms import motion_in_lps, read_transform_file
from cmfsim.values.checks import Floats
from cmfsim.values.motion import rigid_matrix

# A scene of some hundred nodes has a megabyte.
MAX_SCENE = 64 * 2**20
MAX_ELEMENTS, MAX_DEPTH = 100_000, 64
MAX_NAME = 200
# What elements of a scene are, by their name in MRML.
KINDS: Mapping[str, str] = MappingProxyType(
    {
        "Model": "model",
        "Segmentation": "segmentation",
        "Volume": "volume",
        "LabelMapVolume": "segmentation",
        "LinearTransform": "transform",
        "Transform": "transform",
        "BSplineTransform": "transform",
        "GridTransform": "transform",
        "MarkupsFiducial": "markups",
    }
)
REFERENCE = re.compile(r"([A-Za-z0-9_./-]+):([^;]*)")
MATRIX = "matrixTransformToParent"


@dataclass(frozen=True, eq=False)
class SceneNode:
    """Something in a scene that a case may use.

    Attributes
    ----------
    kind : str
        "model", "segmentation", "volume", "transform", "markups", or "other": what no case uses.
    id, name : str
    file : Path or None
        Where its data are kept; None where the scene alone has them.
    missing : str
        Why the file cannot be used, in words; empty if it can.
    parent : str or None
        The id of the transform that is applied to it.
    frame : str or None
        The frame of a file that does not state its own. Of a model, "RAS" where the scene does not
        state it either: 3D Slicer reads scenes from before it stated frames so.
    tag : str
        What Slicer calls its kind.
    """

    kind: str
    id: str
    name: str
    file: Path | None
    missing: str
    parent: str | None
    frame: str | None
    matrix: str | None = None
    tag: str = ""


@dataclass(frozen=True, eq=False)
class SlicerScene:
    """A scene, and where each of its nodes lies in the world.

    Attributes
    ----------
    file : Path
    nodes : mapping of str to SceneNode
        By id, in the order of the scene.
    """

    file: Path
    nodes: Mapping[str, SceneNode]

    def of(self, *kinds: str) -> list[SceneNode]:
        """The nodes of some kinds, in the order of the scene."""
        return [node for node in self.nodes.values() if node.kind in kinds]

    def chain(self, node: SceneNode) -> list[SceneNode]:
        """The transforms that are applied to a node, the nearest first.

        Raises
        ------
        CaseError
            (also `ValueError`) A transform that is not there, or that is its own parent.
        """
        found: list[SceneNode] = []
        parent = node.parent
        while parent is not None:
            above = self.nodes.get(parent)
            if above is None or above.kind != "transform":
                raise CaseInputError(
                    f"{self.file.name}: {node.name!r} is under the transform {parent[:60]!r}, "
                    "which is not in the scene: save the scene again"
                )
            if above in found:
                raise CaseInputError(
                    f"{self.file.name}: the transform {above.name!r} is its own parent"
                )
            found.append(above)
            parent = above.parent
        return found

    def to_world(self, node: SceneNode) -> Floats:
        """What carries a node's own coordinates to where Slicer shows it, (4, 4), LPS mm.

        Raises
        ------
        CaseError
            (also `ValueError`) As `chain` and `to_parent`.
        """
        matrix = np.eye(4)
        for above in self.chain(node):
            matrix = self.to_parent(above) @ matrix
        return matrix

    def to_parent(self, node: SceneNode) -> Floats:
        """The motion that a transform applies to what lies under it, (4, 4), LPS mm.

        Raises
        ------
        CaseError
            (also `ValueError`) Scale, shear or bending; a file that is missing or damaged.
        """
        with named(self.file):
            try:
                return self._to_parent(node)
            except (CmfsimError, FileNotFoundError) as error:
                raise CaseInputError(
                    f"the transform {node.name!r} cannot be used as a rigid motion: {error}"
                ) from error

    def _to_parent(self, node: SceneNode) -> Floats:
        if node.file is not None:
            if node.missing:
                raise CaseInputError(node.missing)
            # Slicer's files hold the map from the parent; it is inverted here.
            return read_transform_file(node.file, direction="from-parent").matrix
        if node.matrix is None:
            raise CaseInputError(
                "the scene has neither a file nor a matrix for it: check that it is linear"
            )
        try:
            numbers = np.array([float(word) for word in node.matrix.split()])
        except ValueError as error:
            raise CaseInputError(
                f"its matrix contains an entry that is not a number ({error})"
            ) from error
        if len(numbers) != 16:
            raise CaseInputError(f"its matrix has {len(numbers)} numbers: 16 are needed")
        return motion_in_lps(rigid_matrix(numbers.reshape(4, 4)), "RAS")


def read_slicer_scene(path: str | os.PathLike[str]) -> SlicerScene:
    """The nodes of a scene file that a case may use.

    Parameters
    ----------
    path : path
        `.mrml`. Files that it names are looked for, and not read.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a scene, too large, a document type, two nodes of one id.
    """
    path = Path(path)
    check_readable(path)
    with named(path):
        if path.stat().st_size > MAX_SCENE:
            raise CaseInputError(f"is larger than {MAX_SCENE} bytes: no scene is that large")
        elements = _elements(path.read_bytes())
        storages = {a["id"]: a for name, a in elements if name.endswith("Storage") and "id" in a}
        nodes: dict[str, SceneNode] = {}
        for name, attributes in elements:
            if name not in KINDS and not _stores(attributes, storages):
                continue
            node = _node(name, attributes, storages, path.parent)
            if not node.id or node.id in nodes:
                raise CaseInputError(f"has two nodes, or one without a name, of id {node.id!r}")
            nodes[node.id] = node
    return SlicerScene(path, MappingProxyType(nodes))


def _stored(
    attributes: Mapping[str, str], storages: Mapping[str, Mapping[str, str]]
) -> Mapping[str, str]:
    """What the scene states of the file of a node."""
    references = dict(REFERENCE.findall(attributes.get("references", "")))
    storage = references.get("storage", attributes.get("storageNodeRef", "")).split(" ")[0]
    return storages.get(storage, {})


def _stores(attributes: Mapping[str, str], storages: Mapping[str, Mapping[str, str]]) -> bool:
    """Whether an element has a file of its own."""
    return bool(attributes.get("id")) and bool(_stored(attributes, storages).get("fileName"))


def _node(
    tag: str,
    attributes: Mapping[str, str],
    storages: Mapping[str, Mapping[str, str]],
    folder: Path,
) -> SceneNode:
    references = dict(REFERENCE.findall(attributes.get("references", "")))
    parent = references.get("transform", attributes.get("transformNodeRef", "")).strip() or None
    kind = KINDS.get(tag, "other")
    stored = _stored(attributes, storages)
    file, missing = _file(stored.get("fileName", ""), folder)
    frame = stored.get("coordinateSystem")
    # Slicer's own rule (vtkMRMLModelStorageNode), for scenes from before it stated the frame.
    unstated = "RAS" if kind == "model" else None
    return SceneNode(
        kind,
        attributes.get("id", ""),
        attributes.get("name", "")[:MAX_NAME],
        file,
        missing,
        parent,
        frame if frame in {"LPS", "RAS"} else unstated,
        attributes.get(MATRIX) if kind == "transform" else None,
        tag,
    )


def _file(name: str, folder: Path) -> tuple[Path | None, str]:
    """The file of a storage node, and why it cannot be used; Slicer encodes names as in a URL."""
    if not name:
        return None, ""
    decoded = unquote(name).replace("\\", "/")
    shown = decoded[:MAX_NAME]
    if "\0" in decoded:
        return folder / "?", f"{shown!r}: this is not a valid file name"
    path = folder / decoded
    if not is_below(path, folder):
        return path, (
            f"{shown}: is outside the folder of the scene, so it is not opened: save the scene "
            "as an .mrb, or copy the file to the scene's folder and save the scene there"
        )
    try:
        is_file = is_there(path) and path.is_file()
    except CaseInputError as error:
        return path, str(error)
    return path, "" if is_file else f"{shown}: the scene refers to this file, but it does not exist"


def _elements(text: bytes) -> list[tuple[str, dict[str, str]]]:
    """Name and attributes of each element of a scene."""
    parser = strict_parser(text)
    found: list[tuple[str, dict[str, str]]] = []
    depth = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH or len(found) > MAX_ELEMENTS:
            raise CaseInputError("is nested too deeply, or has too many elements, for a scene")
        found.append((name, attributes))

    def end(name: str) -> None:
        nonlocal depth
        del name
        depth -= 1

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(text, True)  # noqa: FBT003 (its signature)
    except expat.ExpatError as error:
        raise CaseInputError(f"is not XML in UTF-8, or is cut short ({error})") from error
    if found[0][0] != "MRML":
        raise CaseInputError(f"begins with {found[0][0][:40]!r}: a scene of 3D Slicer with MRML")
    return found
