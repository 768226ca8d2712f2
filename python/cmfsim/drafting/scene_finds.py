"""The contents of a 3D Slicer scene, each with the effect of its transforms."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from cmfsim.drafting.finds import (
    ImageFind,
    LandmarkFind,
    OtherFind,
    SurfaceFind,
    image_find,
    landmark_find,
    surface_find,
)
from cmfsim.drafting.roles import NameRole, name_role
from cmfsim.drafting.segment_finds import segment_finds
from cmfsim.errors import CmfsimError
from cmfsim.io.slicer.slicer_scenes import SceneNode, SlicerScene
from cmfsim.values.checks import Floats

# Slicer's own planes in the 3-D view are models, too.
SLICE_MODELS = "Volume Slice"


@dataclass(frozen=True, eq=False)
class LooseMotion:
    """A transform of a scene that is applied to nothing: hardened, or never used.

    matrix: (4, 4), mm, LPS.
    """

    label: str
    role: NameRole
    matrix: Floats


@dataclass
class SceneFinds:
    """What was found in a scene, by kind, the files that it names, and what each transform moves.

    `links` has the name of each with the names of what lies directly under it.
    """

    surfaces: list[SurfaceFind] = field(default_factory=list)
    images: list[ImageFind] = field(default_factory=list)
    landmarks: list[LandmarkFind] = field(default_factory=list)
    loose: list[LooseMotion] = field(default_factory=list)
    others: list[OtherFind] = field(default_factory=list)
    files: set[Path] = field(default_factory=set)
    links: dict[str, tuple[str, ...]] = field(default_factory=dict)


def scene_finds(scene: SlicerScene, label: str) -> SceneFinds:
    """The models, segments, volumes, markups and transforms of a scene.

    Raises `CaseError`: What a case would be made of lies under a transform that is not rigid, or
        that cannot be read.
    """
    found = SceneFinds()
    for node in scene.nodes.values():
        if node.file is not None:
            found.files.add(node.file.resolve())
        shown = f"{label}: {node.name}"
        if node.kind == "transform":
            continue
        if node.name.endswith(SLICE_MODELS) or node.kind == "other":
            why = f"no case uses a {node.tag} of 3D Slicer"
            if node.name.endswith(SLICE_MODELS):
                why = "it is a plane in which Slicer shows the image"
            found.others.append(OtherFind(shown, why))
            continue
        if node.file is None or node.missing:
            why = node.missing or "the scene names no file for it: save the scene with its data"
            found.others.append(OtherFind(shown, why))
            continue
        try:
            _add(found, scene, node, shown)
        except (CmfsimError, OSError) as error:
            if node.kind == "model" and name_role(node.name).part not in {"", "other"}:
                raise
            found.others.append(OtherFind(shown, str(error)))
    _add_loose(found, scene, label)
    return found


def _add(found: SceneFinds, scene: SlicerScene, node: SceneNode, shown: str) -> None:
    if node.file is None:  # asked before
        raise AssertionError(node.name)
    chain = tuple(above.name for above in scene.chain(node))
    matrix, role = scene.to_world(node), name_role(node.name)
    if node.kind == "model":
        read = surface_find(node.file, shown)
        stated = read.stated or node.frame
        found.surfaces.append(
            replace(read, role=role, stated=stated, to_world=matrix, chain=chain, in_scene=True)
        )
    elif node.kind == "segmentation":
        _add_segments(found, node.file, shown, matrix, chain)
    elif node.kind == "volume":
        image = image_find(node.file, shown)
        if image.is_labels:
            _add_segments(found, node.file, shown, matrix, chain)
            return
        found.images.append(replace(image, role=role, to_world=matrix, chain=chain, in_scene=True))
    else:
        points = landmark_find(node.file, shown)
        found.landmarks.append(
            replace(points, role=role, to_world=matrix, chain=chain, in_scene=True)
        )


def _add_segments(
    found: SceneFinds, file: Path, shown: str, matrix: Floats, chain: tuple[str, ...]
) -> None:
    """Adds the segments of a file, where the scene shows them."""
    read = segment_finds([(file, shown)])
    found.others += read.others
    found.surfaces += [
        replace(segment, to_world=matrix, chain=chain, in_scene=True) for segment in read.surfaces
    ]


def _add_loose(found: SceneFinds, scene: SlicerScene, label: str) -> None:
    """Adds the transforms that nothing lies under."""
    for node in scene.of("transform"):
        below = tuple(other.name for other in scene.nodes.values() if other.parent == node.id)
        shown = f"{label}: {node.name}"
        if below:
            found.links[node.name] = below
            continue
        try:
            matrix = scene.to_parent(node)
        except CmfsimError as error:
            found.others.append(OtherFind(shown, str(error)))
            continue
        found.loose.append(LooseMotion(shown, name_role(node.name), matrix))
