"""Scenes of 3D Slicer (`.mrml`, with their files `.mrb`): what a case may use, read only.

A scene is XML that names files and what moves what. Files come from strangers: a document type is
refused, sizes are limited, and only files in the scene's own folder are named.
"""

import re
import shutil
import stat
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from urllib.parse import unquote

import numpy as np

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.files.reading_writing import check_readable, is_below, is_there, named, walk_xml
from cmfsim.io.slicer.transforms import motion_in_lps, read_transform_file
from cmfsim.values.checks import AnyPath, Floats
from cmfsim.values.motion import rigid_matrix

# A planning scene has some hundred files, with a CT of half a gigabyte.
MAX_MEMBERS = 5000
MAX_UNPACKED = 8 * 2**30
# Surfaces and images pack tenfold at most, a decompression bomb a thousandfold.
MAX_RATIO, FREE = 100, 2**28
CHUNK = 2**20
ENCRYPTED = 0x1
DRIVE = re.compile(r"^[A-Za-z]:")
MAX_PATH = 500

# A scene of some hundred nodes has a megabyte.
MAX_SCENE = 64 * 2**20
MAX_ELEMENTS, MAX_DEPTH = 100_000, 64
# Bytes of a name that every system takes, and characters of one that are kept and shown.
MAX_NAME = 200
# What elements of a scene are, by their name in MRML.
KINDS: Mapping[str, str] = MappingProxyType({
    "Model": "model", "Segmentation": "segmentation", "Volume": "volume",
    "LabelMapVolume": "segmentation", "LinearTransform": "transform", "Transform": "transform",
    "BSplineTransform": "transform", "GridTransform": "transform", "MarkupsFiducial": "markups",
})  # fmt: skip
REFERENCE = re.compile(r"([A-Za-z0-9_./-]+):([^;]*)")
MATRIX = "matrixTransformToParent"


@dataclass(frozen=True, eq=False)
class SceneNode:
    """Something in a scene that a case may use.

    kind: "model", "segmentation", "volume", "transform", "markups", or "other": what no case uses.
    file: Where its data are kept; None where the scene alone has them.
    missing: Why the file cannot be used, in words; empty if it can.
    parent: The id of the transform that is applied to it.
    frame: The frame of a file that does not state its own. Of a model, "RAS" where the scene does
        not state it either: 3D Slicer reads scenes from before it stated frames so.
    tag: What Slicer calls its kind.
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
    """A scene, and where each of its nodes, by id in its order, lies in the world."""

    file: Path
    nodes: Mapping[str, SceneNode]

    def of(self, *kinds: str) -> list[SceneNode]:
        """The nodes of some kinds, in the order of the scene."""
        return [node for node in self.nodes.values() if node.kind in kinds]

    def chain(self, node: SceneNode) -> list[SceneNode]:
        """The transforms that are applied to a node, the nearest first."""
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
        """What carries a node's own coordinates to where Slicer shows it, (4, 4), LPS mm."""
        matrix = np.eye(4)
        for above in self.chain(node):
            matrix = self.to_parent(above) @ matrix
        return matrix

    def to_parent(self, node: SceneNode) -> Floats:
        """The motion that a transform applies to what lies under it, (4, 4), LPS mm."""
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


def read_slicer_scene(path: AnyPath) -> SlicerScene:
    """The nodes of a `.mrml` that a case may use; files that it names are not read."""
    path = Path(path)
    check_readable(path)
    with named(path):
        if path.stat().st_size > MAX_SCENE:
            raise CaseInputError(f"is larger than {MAX_SCENE} bytes: no scene is that large")
        elements: list[tuple[str, dict[str, str]]] = []
        limits = (MAX_ELEMENTS, MAX_DEPTH)
        walk_xml(path.read_bytes(), limits, lambda name, given: elements.append((name, given)))
        if elements[0][0] != "MRML":
            found = elements[0][0][:40]
            raise CaseInputError(f"begins with {found!r}: a scene of 3D Slicer with MRML")
        storages = {a["id"]: a for name, a in elements if name.endswith("Storage") and "id" in a}
        nodes: dict[str, SceneNode] = {}
        for name, attributes in elements:
            stores = bool(attributes.get("id")) and _stored(attributes, storages).get("fileName")
            if name not in KINDS and not stores:
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


def _node(
    tag: str, attributes: Mapping[str, str], storages: Mapping[str, Mapping[str, str]], folder: Path
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


def unpack_bundle(path: Path, folder: Path) -> Path:
    """The scene file of a bundle (`.mrb`), unpacked into the caller's own empty folder."""
    check_readable(path)
    with named(path):
        try:
            archive = zipfile.ZipFile(path)
        # Damaged archives raise whatever zipfile, zlib and struct raise.
        except Exception as error:
            raise CaseInputError(
                f"is not a 3D Slicer bundle, or is damaged ({error}): save it again"
            ) from error
        with archive:
            scenes = _unpack(archive, path.stat().st_size, folder)
        if len(scenes) != 1:
            raise CaseInputError(f"holds {len(scenes)} scenes (.mrml): one is needed")
        return scenes[0]


def _unpack(archive: zipfile.ZipFile, packed: int, folder: Path) -> list[Path]:
    members = archive.infolist()
    if len(members) > MAX_MEMBERS:
        raise CaseInputError(f"holds {len(members)} files: at most {MAX_MEMBERS} are unpacked")
    _check_names(members)
    limit = min(MAX_UNPACKED, FREE + MAX_RATIO * packed)
    total = sum(member.file_size for member in members)
    if total > limit:
        raise CaseInputError(
            f"unpacks to {total} bytes: at most {limit} are unpacked from an archive of {packed}"
        )
    free = shutil.disk_usage(folder).free
    if total > free:
        raise CaseInputError(f"unpacks to {total} bytes, and {free} are free at {folder}")
    scenes: list[Path] = []
    for member in members:
        target = folder / member.filename
        if member.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            for block in _blocks(archive, member):
                file.write(block)
        if target.suffix.lower() == ".mrml":
            scenes.append(target)
    return scenes


def _blocks(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Iterator[bytes]:
    """The content of a member, no more than its header states."""
    try:
        # zipfile reads no more than the header states, and compares the checksum.
        with archive.open(member) as source:
            while block := source.read(CHUNK):
                yield block
    except Exception as error:
        raise CaseInputError(
            f"{member.filename[:80]!r} in it is damaged ({error}): save the bundle again"
        ) from error


def _check_names(members: Sequence[zipfile.ZipInfo]) -> None:
    seen: set[str] = set()
    files: set[str] = set()
    for member in members:
        name = member.filename
        shown = name[:80]
        place = PurePosixPath(name)
        leads_out = place.is_absolute() or ".." in place.parts or DRIVE.match(name)
        too_long = len(name) > MAX_PATH or any(len(p.encode()) > MAX_NAME for p in place.parts)
        if leads_out or not place.parts or too_long or any(c in name for c in "\\\0"):
            raise CaseInputError(
                f"names the file {shown!r}, which would be outside the folder: nothing is unpacked"
            )
        if stat.S_ISLNK(member.external_attr >> 16):
            raise CaseInputError(f"holds the link {shown!r}: links are not unpacked")
        if member.flag_bits & ENCRYPTED:
            raise CaseInputError(f"is encrypted ({shown!r}): save it without a password")
        key = str(place).casefold()
        if key in seen:
            raise CaseInputError(f"holds {shown!r} twice")
        seen.add(key)
        if not name.endswith("/"):
            files.add(key)
    for key in seen:
        above = next((str(p) for p in PurePosixPath(key).parents if str(p) in files), None)
        if above is not None:
            raise CaseInputError(f"holds {above[:80]!r} as a file and as a folder")
