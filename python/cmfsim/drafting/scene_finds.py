"""What `cmfsim init` finds in scenes of 3D Slicer and in segmentations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.drafting import finds
from cmfsim.drafting.roles import JAWS_OF_TEETH, NameRole, name_role
from cmfsim.errors import CmfsimError, third_party
from cmfsim.io.images.segmentations import Segment, Segmentation, read_labels, read_segmentation
from cmfsim.io.slicer.slicer_scenes import SceneNode, SlicerScene
from cmfsim.surfaces.levels import block_of, surface_of_level
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Segments without a known name that are asked about, where some have one; the rest are organs.
MOST_UNNAMED = 6
# Grids that agree up to this, mm, are one.
SAME_GRID = 1e-3
# Bone counts as cut out of the skin where less than this share of it is in the skin's label.
CUT_OUT = 0.5
# Slicer's own planes in the 3-D view are models, too.
SLICE_MODELS = "Volume Slice"


@dataclass(frozen=True, eq=False)
class _Mask:
    """A segment that may be part of a case."""

    label: str
    role: NameRole
    path: Path
    segment: Segment
    read: Segmentation
    is_alone: bool

    def voxels(self) -> NDArray[np.bool_]:
        """Where it is."""
        return self.read.mask(self.segment)

    def is_on(self, other: "_Mask") -> bool:
        """Whether both have one grid."""
        return self.read.labels.shape[1:] == other.read.labels.shape[1:] and np.allclose(
            self.read.affine, other.read.affine, rtol=0.0, atol=SAME_GRID
        )


def segment_finds(
    files: Sequence[tuple[Path, str]],
) -> tuple[list[finds.SurfaceFind], list[finds.Taken]]:
    """The segments of files that may be skin, bone or teeth, each as a surface, and the others.

    Teeth are added to the jaw that their name says, where both have the same grid; so are the bones
    that a label image cuts out of its skin.
    files: Each with what reports call it; one mask per file is named after its file.
    """
    masks: list[_Mask] = []
    others: list[finds.Taken] = []
    for path, label in files:
        try:
            own, dropped = _masks(path, label)
        except (CmfsimError, OSError) as error:
            others.append(finds.unused(label, f"cannot be read: {error}"))
            continue
        masks += own
        others += dropped
    masks, dropped = _named(masks)
    others += dropped
    jaws = {id(teeth): jaw for teeth in masks if (jaw := _jaw_of(teeth, masks)) is not None}
    surfaces = []
    for mask in masks:
        if id(mask) in jaws:
            continue
        teeth = [other for other in masks if jaws.get(id(other)) is mask]
        surfaces.append(_surface_find(mask, teeth, masks))
    return surfaces, others


def _masks(path: Path, label: str) -> tuple[list[_Mask], list[finds.Taken]]:
    """The segments of a file that may be part of a case, and the others."""
    is_slicers = path.name.lower().endswith(finds.LABELS)
    read = read_segmentation(path) if is_slicers else read_labels(path)
    alone = not is_slicers and len(read.segments) == 1
    masks, others = [], []
    for segment in read.segments:
        role = name_role(segment.name)
        shown = label if alone else f"{label} / {segment.name}"
        if role.part == "other":
            why = f"its name contains {role.word!r}, which is not a bone of a case"
            others.append(finds.unused(shown, why))
        elif not (read.labels[segment.layer] == segment.label).any():
            others.append(finds.unused(shown, "is empty: it has no voxel"))
        else:
            masks.append(_Mask(shown, role, path, segment, read, alone))
    return masks, others


def _named(masks: Sequence[_Mask]) -> tuple[list[_Mask], list[finds.Taken]]:
    """The masks without those of organs, of which there are many, and with names of their own."""
    unnamed = [mask for mask in masks if not mask.role.part]
    if len(unnamed) == len(masks):
        return list(masks), []
    organs = unnamed if len(unnamed) > MOST_UNNAMED else [m for m in unnamed if m.is_alone]
    why = "its name is none of skin, bone or teeth, and others have such names"
    left = [mask for mask in masks if mask not in organs]
    return left, [finds.unused(mask.label, why) for mask in organs]


def _jaw_of(teeth: _Mask, masks: Sequence[_Mask]) -> _Mask | None:
    """The jaw of a row of teeth, where there is one on its grid, of its time."""
    for part in JAWS_OF_TEETH.get(teeth.role.part, ()):
        found = [
            mask
            for mask in masks
            if mask.role.part == part
            and mask.role.is_after == teeth.role.is_after
            and mask.is_on(teeth)
        ]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def _surface_find(mask: _Mask, teeth: Sequence[_Mask], masks: Sequence[_Mask]) -> finds.SurfaceFind:
    voxels = mask.voxels()
    for other in teeth:
        voxels = voxels | other.voxels()
    inside = [o for o in masks if o is not mask and o.role.part != "skin" and o.is_on(mask)]
    if mask.role.part == "skin" or (not mask.role.part and inside and _encloses(mask, inside)):
        voxels = _filled(voxels, [bone.voxels() for bone in inside])
    surface, joined = _surface(mask.segment.name, voxels, mask.read), tuple(o.label for o in teeth)
    own = (mask.label, mask.role, mask.path, surface, "LPS")
    return finds.SurfaceFind(*own, is_closed=True, is_made=True, joined=joined)


def _encloses(outer: _Mask, others: Sequence[_Mask]) -> bool:
    """Whether the block of a mask holds the blocks of all others: it is the skin, then."""
    low, high = block_of(outer.voxels())
    blocks = [block_of(other.voxels()) for other in others]
    return all((low <= b).all() and (high >= e).all() for b, e in blocks)


def _filled(skin: NDArray[np.bool_], bones: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """A skin without hollows: where each voxel has one label, bones are cut out of it."""
    for bone in bones:
        if (skin & bone).sum() < CUT_OUT * bone.sum():
            skin = skin | bone
    ndimage = third_party("scipy.ndimage", "hollows of labels are filled", "imaging")
    filled: NDArray[np.bool_] = ndimage.binary_fill_holes(skin)
    return filled


def _surface(name: str, mask: NDArray[np.bool_], read: Segmentation) -> SurfaceData:
    """The border of a mask, half a voxel outside its voxels' centres, in LPS mm."""
    lengths = np.linalg.norm(read.affine[:, :3], axis=0)
    level = ImageData(mask.astype(np.float32) - 0.5, lengths)
    surface = surface_of_level(name, level)
    turn = read.affine[:, :3] / lengths
    vertices = surface.vertices @ turn.T + read.affine[:, 3]
    triangles = surface.triangles
    # A grid of left-handed axes turns surfaces inside out.
    mirrored = bool(np.linalg.det(turn) < 0.0)
    return SurfaceData(vertices, triangles[:, ::-1] if mirrored else triangles)


def scene_finds(found: finds.Gathered, scene: SlicerScene, label: str) -> None:
    """Adds the models, segments, volumes, markups and transforms of a scene.

    Raises `CaseError`: What a case needs lies under a transform that is not rigid or not readable.
    """
    for node in scene.nodes.values():
        if node.file is not None:
            found.scene_files.add(node.file.resolve())
        shown = f"{label}: {node.name}"
        if node.kind == "transform":
            continue
        if node.name.endswith(SLICE_MODELS) or node.kind == "other":
            why = f"no case uses a {node.tag} of 3D Slicer"
            if node.name.endswith(SLICE_MODELS):
                why = "it is a plane in which Slicer shows the image"
            found.skip(shown, why)
            continue
        if node.file is None or node.missing:
            why = node.missing or "the scene names no file for it: save the scene with its data"
            found.skip(shown, why)
            continue
        try:
            _add(found, scene, node, shown)
        except (CmfsimError, OSError) as error:
            if node.kind == "model" and name_role(node.name).part not in {"", "other"}:
                raise
            found.skip(shown, str(error))
    _add_loose(found, scene, label)


def _add(found: finds.Gathered, scene: SlicerScene, node: SceneNode, shown: str) -> None:
    if node.file is None:  # asked before
        raise AssertionError(node.name)
    chain = tuple(above.name for above in scene.chain(node))
    matrix = scene.to_world(node)
    place: dict[str, Any] = {"to_world": matrix, "chain": chain, "in_scene": True}
    image = finds.image_find(node.file, shown) if node.kind == "volume" else None
    if node.kind == "segmentation" or (image is not None and image.is_labels):
        add_segments(found, [(node.file, shown)], **place)
        return
    place["role"] = name_role(node.name)
    if node.kind == "model":
        read = finds.surface_find(node.file, shown)
        found.surfaces.append(replace(read, stated=read.stated or node.frame, **place))
    elif image is not None:
        found.images.append(replace(image, **place))
    else:
        found.landmarks.append(replace(finds.landmark_find(node.file, shown), **place))


def add_segments(found: finds.Gathered, files: Sequence[tuple[Path, str]], **place: Any) -> None:
    """Adds the segments of files, with their place in a scene."""
    surfaces, others = segment_finds(files)
    found.others += others
    found.surfaces += [replace(segment, **place) for segment in surfaces]


def _add_loose(found: finds.Gathered, scene: SlicerScene, label: str) -> None:
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
            found.skip(shown, str(error))
            continue
        found.loose.append(finds.LooseMotion(shown, name_role(node.name), matrix))
