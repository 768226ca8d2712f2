"""Everything in a folder, or in the scene of 3D Slicer that it holds, read once."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from cmfsim.drafting import finds
from cmfsim.drafting.roles import name_role
from cmfsim.drafting.scene_finds import add_segments, scene_finds
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.images.segmentations import NAMES_FILE
from cmfsim.io.slicer.slicer_scenes import read_slicer_scene, unpack_bundle

# Images that are read to see which is the CT.
MAX_IMAGES = 6
# Masks that are read by their names.
MAX_MASKS = 40
NOT_NAMED = "the scene does not name this file"
# Bytes of a header in which Slicer states itself, or the frame.
HEADER = 1024
BY_SLICER = (b"3D Slicer output", b"SPACE=LPS", b"SPACE=RAS", b"Segmentation_")

Found = TypeVar("Found")


def gather(
    folder: Path, scene: Path | None, unpacked: Path, progress: Callable[[str], None]
) -> finds.Gathered:
    """What a folder holds.

    scene: The scene that is meant; else the only one of the folder.
    unpacked: An empty folder for the files of a bundle.
    Raises `CaseError`: Several scenes, one that is damaged or hostile, or moves something bent.
    """
    found = finds.Gathered(folder)
    paths = finds.listing(folder)
    found.others += paths.others(folder)
    found.seen = paths.seen
    _gather_scene(found, paths, scene, unpacked, progress)

    def rest(of: list[Path]) -> list[Path]:
        return [path for path in of if path.resolve() not in found.scene_files]

    if found.scene:
        for path in (*rest(paths.surfaces), *rest(paths.labels)):
            role = name_role(path.name)
            if role.is_after and path in paths.surfaces:
                progress(f"reading {found.shown(path)}")
                _read(found, path, finds.surface_find, found.surfaces)
            else:
                found.skip(path, f"the scene {found.scene} does not have it")
        for path in rest(paths.transforms):
            found.skip(path, f"the scene {found.scene} does not have it")
    else:
        _gather_files(found, paths, progress)
    # Landmarks of a scene come before those of files.
    has_marks = bool(found.landmarks)
    for path in rest(paths.markups):
        if has_marks and not name_role(path.name).is_after:
            found.skip(path, f"the scene {found.scene} has landmarks of its own")
        else:
            _read(found, path, finds.landmark_find, found.landmarks)
    # A folder of DICOM is named last where it is the case's own: it holds all else as well.
    files = [(path, None) for path in rest(paths.images)]
    places = sorted(paths.dicom, key=lambda place: place[0] == folder)
    _gather_images(found, [*files, *places], progress)
    found.by_slicer = bool(found.scene) or any(map(_by_slicer, (*paths.surfaces, *paths.labels)))
    return found


def _gather_images(
    found: finds.Gathered, places: list[tuple[Path, str | None]], progress: Callable[[str], None]
) -> None:
    """Adds the images of files and folders; the CT of a scene comes before them."""
    has_ct = any(not image.role.is_after and not image.error for image in found.images)
    labels: list[tuple[Path, str]] = []
    # Masks of a hundred organs come one per file: those of a head have its names.
    named = [path for path, _ in places if name_role(path.name).part not in {"", "other"}]
    others = [path for path, _ in places if path not in named]
    read = {*named[:MAX_MASKS], *others[:MAX_IMAGES]}
    for path, series in places:
        label = found.shown(path) + ("" if series is None else f" (series {series})")
        if has_ct and not name_role(path.name).is_after:
            found.skip(label, f"the scene {found.scene} has another CT")
        elif path not in read:
            why = f"more than {MAX_IMAGES} images, and its name is none of a head's part: not read"
            found.skip(label, why)
        else:
            progress(f"reading {label}")
            image = finds.image_find(path, label, series)
            if image.is_labels and found.scene and not image.role.is_after:
                found.skip(label, f"the scene {found.scene} does not have it")
            elif image.is_labels:
                labels.append((path, label))
            else:
                found.images.append(image)
    add_segments(found, labels)
    folders = {path.parent for path, _ in labels}
    found.names = [
        path for path in found.seen if path.name == NAMES_FILE and path.parent in folders
    ]


def _gather_scene(
    found: finds.Gathered,
    paths: finds.Listing,
    scene: Path | None,
    unpacked: Path,
    progress: Callable[[str], None],
) -> None:
    """Adds what the scene of the folder has."""
    if scene is None and len(paths.scenes) > 1:
        names = ", ".join(found.shown(path) for path in paths.scenes)
        raise CaseInputError(
            f"{found.folder}: holds {len(paths.scenes)} scenes of 3D Slicer ({names}): give the "
            f"right one, such as cmfsim init {paths.scenes[0]}"
        )
    if scene is None:
        scene = next(iter(paths.scenes), None)
    if scene is None:
        return
    for path in (path for path in paths.scenes if not path.samefile(scene)):
        found.skip(path, "another scene was given")
    found.scene = found.shown(scene)
    progress(f"reading {found.scene}")
    bundled = scene.suffix.lower() == ".mrb"
    file = unpack_bundle(scene, unpacked) if bundled else scene
    scene_finds(found, read_slicer_scene(file), found.scene)
    if bundled:
        for path in sorted(unpacked.rglob("*")):
            if path.is_file() and path != file and path.resolve() not in found.scene_files:
                found.skip(f"{found.scene}: {path.relative_to(unpacked).as_posix()}", NOT_NAMED)


def _gather_files(
    found: finds.Gathered, paths: finds.Listing, progress: Callable[[str], None]
) -> None:
    for path in paths.surfaces:
        progress(f"reading {found.shown(path)}")
        _read(found, path, finds.surface_find, found.surfaces)
    for path in paths.labels:
        label = found.shown(path)
        progress(f"reading {label}")
        add_segments(found, [(path, label)])
    for path in paths.transforms:
        label = found.shown(path)
        role = name_role(path.name[: -len(path.suffix)])
        if path.suffix.lower() == ".txt" and not _is_matrix(path):
            found.skip(label, "is no transform: not 16 numbers")
            continue
        found.transforms.append(finds.TransformFind(label, role, path))


def _read(
    found: finds.Gathered, path: Path, read: Callable[[Path, str], Found], into: list[Found]
) -> None:
    label = found.shown(path)
    try:
        into.append(read(path, label))
    except (CmfsimError, OSError) as error:
        found.skip(label, f"cannot be read: {error}")


def _is_matrix(path: Path) -> bool:
    """Whether a text holds a transform, and is not somebody's notes."""
    with path.open("rb") as file:
        begin = file.read(HEADER)
    if begin.startswith(b"#Insight Transform File"):
        return True
    lines = [line.partition(b"#")[0] for line in begin.splitlines()]
    words = b" ".join(lines).replace(b",", b" ").split()
    try:
        return len([float(word) for word in words]) == 16
    except ValueError:
        return False


def _by_slicer(path: Path) -> bool:
    with path.open("rb") as file:
        begin = file.read(HEADER)
    return any(mark in begin for mark in BY_SLICER)
