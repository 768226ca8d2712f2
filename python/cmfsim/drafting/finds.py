"""The contents of a folder: surfaces, images, landmarks and transforms, each read and measured."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cmfsim.drafting.roles import NameRole, name_role
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.images.dicom_series import dicom_places, is_marked
from cmfsim.io.images.image_files import read_image_file
from cmfsim.io.images.segmentations import NAMES_FILE, are_labels, read_labels
from cmfsim.io.landmarks import LandmarkFile, read_landmark_file
from cmfsim.io.meshes.plain_mesh import is_own_file
from cmfsim.io.meshes.surfaces import surface_as_stored
from cmfsim.surfaces.topology import edges_of
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# How far into folders, and how many files: a case has some hundred, DICOM a thousand slices.
# A CT in HU has air, some -1000 HU.
HU_AIR = -500.0
MAX_DEPTH, MAX_FILES = 6, 20_000
SURFACES = (".stl", ".ply", ".obj", ".vtp", ".vtk")
IMAGES = (".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd")
TRANSFORMS = (".tfm", ".h5", ".txt", ".mat")
LABELS = (".seg.nrrd", ".seg.nhdr")
MARKUPS = (".mrk.json", ".fcsv")
SCENES = (".mrml", ".mrb")
# Endings that files beside DICOM slices have, and no slice.
NO_SLICES = (
    ".txt", ".jpg", ".jpeg", ".png", ".pdf", ".json", ".xml", ".html", ".csv", ".zip", ".toml",
)  # fmt: skip
# Names of an entry that stands for several files.
SHOWN = 3
# The case file that is written.
CASE_FILE = "case.toml"
# Where what is made from a scene is put, below the folder of the case.
EXTRACTED = "from_scene"
# Files by which a folder is known as one that cmfsim wrote.
OURS = ("prediction.json", "build.json", "metrics.json", "cmfsim-scene.mrml")
# Why files are not read.
NOT_UTF8 = "its name is not UTF-8, so a case file cannot name it: rename it"
NOT_HERE = "is a link to a file that is not here: fetch it (with DataLad: datalad get)"
SEEN = "is a link to a folder that holds this one, or that was read already"


@dataclass(frozen=True, eq=False)
class Find:
    """Something that was found: its path, or its scene and node; what its name says; its file.

    to_world: (4, 4), mm, LPS. What its scene applies to it.
    chain: The names of the transforms that do, the nearest first.
    """

    label: str
    role: NameRole
    path: Path
    to_world: Floats = field(default_factory=lambda: np.eye(4), kw_only=True)
    chain: tuple[str, ...] = field(default=(), kw_only=True)
    in_scene: bool = field(default=False, kw_only=True)


@dataclass(frozen=True, eq=False)
class SurfaceFind(Find):
    """A surface, in its file's own numbers; `path` of a segment is that of all segments.

    stated: The frame that its header, or its scene, states.
    is_silent: Whether the file itself states none: its scene does, or nothing.
    is_made: Whether it was made of voxels: it has no file of its own.
    joined: The labels of the teeth that were added to it.
    """

    surface: SurfaceData
    stated: str | None
    is_closed: bool
    is_made: bool = False
    is_silent: bool = False
    joined: tuple[str, ...] = ()

    @property
    def extent(self) -> Floats:
        """Its length along each axis, in its file's unit, (3,)."""
        extent: Floats = np.ptp(self.surface.vertices, axis=0)
        return extent

    @property
    def is_moved(self) -> bool:
        """Whether its scene moves it."""
        return not np.array_equal(self.to_world, np.eye(4))


@dataclass(frozen=True, eq=False)
class ImageFind(Find):
    """A CT, or another image; `path` is a folder for DICOM.

    modality: Of DICOM; empty where the file does not state it.
    words: Its size and spacing.
    box: (2, 3), mm, LPS. Its lowest and highest corner.
    series: UID of the DICOM series that is meant, where the folder holds several.
    is_labels: Whether its values are labels of segments, and not those of a CT.
    to_hu: Slope and offset to HU and the expected error at bone, HU, where the values are not HU
        and their peaks clearly give the scale.
    """

    modality: str = ""
    values: tuple[float, float] = (0.0, 0.0)
    words: str = ""
    box: Floats | None = None
    error: str = ""
    series: str | None = None
    findings: tuple[Finding, ...] = ()
    is_labels: bool = False
    to_hu: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class LandmarkFind(Find):
    """A file of landmarks, as read."""

    read: LandmarkFile


class TransformFind(Find):
    """A separate transform file; its name identifies what it moves."""


@dataclass(frozen=True, eq=False)
class LooseMotion:
    """A transform (4, 4), mm, LPS, of a scene, applied to nothing: hardened, or never used."""

    label: str
    role: NameRole
    matrix: Floats


@dataclass(frozen=True)
class Taken:
    """How a file, or a node of a scene, was interpreted.

    Attributes
    ----------
    label : str
        Its path, or its scene and node.
    taken_for : str
        Such as "skin" or "motion of maxilla"; "not used"; empty if this is undecided.
    why : str
    unit, frame : str
        If they apply.
    question : bool
        Whether a person has to decide something about it.
    paths : tuple of Path
        The files that it is about, where its label does not name each.
    """

    label: str
    taken_for: str
    why: str
    unit: str = ""
    frame: str = ""
    question: bool = False
    paths: tuple[Path, ...] = ()

    def as_dict(self) -> dict[str, object]:
        """Plain values, ready for JSON."""
        own = ("taken_for", "unit", "frame", "why", "question")
        values = {"file": self.label, **{name: getattr(self, name) for name in own}}
        return {**values, "files": [p.name for p in self.paths]} if self.paths else values


def unused(label: str, why: str, paths: tuple[Path, ...] = ()) -> Taken:
    """What is not used, and why; files of one kind in one folder may share an entry."""
    return Taken(label, "not used", why, paths=paths)


@dataclass
class Gathered:
    """What was found, by kind; `seen` is every file of the folder.

    names: Those with the names of labels.
    scene_files: Those that the scene names; without a scene its label is empty.
    links: The transforms of the scene, with what lies directly under each.
    """

    folder: Path
    scene: str = ""
    by_slicer: bool = False
    surfaces: list[SurfaceFind] = field(default_factory=list)
    images: list[ImageFind] = field(default_factory=list)
    landmarks: list[LandmarkFind] = field(default_factory=list)
    transforms: list[TransformFind] = field(default_factory=list)
    loose: list[LooseMotion] = field(default_factory=list)
    others: list[Taken] = field(default_factory=list)
    seen: list[Path] = field(default_factory=list)
    names: list[Path] = field(default_factory=list)
    scene_files: set[Path] = field(default_factory=set)
    links: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def shown(self, path: Path) -> str:
        """A path as the case file will have it."""
        return path.relative_to(self.folder).as_posix()

    def skip(self, what: Path | str, why: str) -> None:
        """Notes a file, or what is in one, that is not used."""
        self.others.append(unused(what if isinstance(what, str) else self.shown(what), why))


@dataclass
class Listing:
    """The paths in a folder, by their endings; those that no case reads, by folder and reason."""

    surfaces: list[Path] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)
    labels: list[Path] = field(default_factory=list)
    transforms: list[Path] = field(default_factory=list)
    markups: list[Path] = field(default_factory=list)
    scenes: list[Path] = field(default_factory=list)
    dicom: list[tuple[Path, str | None]] = field(default_factory=list)
    unread: dict[tuple[Path, str], list[Path]] = field(default_factory=dict)
    seen: list[Path] = field(default_factory=list)

    def skip(self, path: Path, why: str) -> None:
        """Notes a file or folder that is not read."""
        self.unread.setdefault((path.parent, why), []).append(path)

    def others(self, folder: Path) -> list[Taken]:
        """What no case reads, with its names."""
        found = []
        for (_, why), paths in self.unread.items():
            names = [path.relative_to(folder).as_posix() for path in paths]
            if len(names) > SHOWN:
                more = f"{', '.join(names[:SHOWN])} and {len(names) - SHOWN} more"
                found.append(unused(more, why, tuple(paths)))
                continue
            found += [unused(n, why, (path,)) for n, path in zip(names, paths, strict=True)]
        return found


def listing(folder: Path) -> Listing:
    """The files of a folder and those below it, by kind; `CaseError` if they are too many."""
    found = Listing()
    dicom: dict[Path, None] = {}
    for path in _files(folder, found):
        found.seen.append(path)
        if len(found.seen) > MAX_FILES:
            raise CaseInputError(
                f"{folder}: contains more than {MAX_FILES} files: give the folder of one patient"
            )
        name = path.name.lower()
        kinds = (
            (LABELS, found.labels), (MARKUPS, found.markups), (SCENES, found.scenes),
            (SURFACES, found.surfaces), (IMAGES, found.images), (TRANSFORMS, found.transforms),
        )  # fmt: skip
        kind = next((paths for endings, paths in kinds if name.endswith(endings)), None)
        if kind is not None:
            kind.append(path)
        elif path.suffix.lower() in NO_SLICES or not (
            path.parent in dicom or (os.access(path, os.R_OK) and is_marked(path))
        ):
            names = path.name == NAMES_FILE
            found.skip(path, "it has names of labels" if names else "no case reads such files")
        else:
            dicom[path.parent] = None
    found.dicom = dicom_places(list(dicom))
    return found


def _files(folder: Path, found: Listing) -> Iterator[Path]:
    """The plain files of a folder in a fixed order; the others are noted in `found`.

    Links are followed: the folder is the user's own. Files that no case can name are noted, and
    links to folders that were seen already, or that this one lies in.
    """
    top, seen = folder.resolve(), set[Path]()
    for place, folders, names in os.walk(folder, followlinks=True):
        here = Path(place)
        real = here.resolve()
        if real in seen or (real != top and top.is_relative_to(real)):
            found.skip(here, SEEN)
            folders.clear()
            continue
        seen.add(real)
        if here != folder and any(name in names for name in OURS):
            folders.clear()
            found.skip(here, "results that cmfsim wrote")
            continue
        if len(here.relative_to(folder).parts) >= MAX_DEPTH:
            for name in folders:
                found.skip(here / name, f"is more than {MAX_DEPTH} folders down")
            folders.clear()
        for name in folders:
            if name[0] == ".":
                found.skip(here / name, "is hidden: its name begins with a dot")
        folders[:] = sorted(f for f in folders if f[0] != "." and f != EXTRACTED)
        for name in sorted(names):
            path = here / name
            if name[0] == ".":
                found.skip(path, "is hidden: its name begins with a dot")
            elif not _is_utf8(path.relative_to(folder).as_posix()):
                found.skip(path, NOT_UTF8)
            elif path.is_symlink() and not path.exists():
                found.skip(path, NOT_HERE)
            elif not path.is_file():
                found.skip(path, "is no file")
            elif path != folder / CASE_FILE:
                yield path


def _is_utf8(name: str) -> bool:
    """Whether a name can stand in a case file, which is UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def surface_find(path: Path, label: str) -> SurfaceFind:
    """A surface file, read; raises as `read_surface`."""
    read = surface_as_stored(path)
    is_silent = read.frame is None
    stated = "LPS" if is_silent and is_own_file(path) else read.frame
    role, closed = name_role(path.name[: -len(path.suffix)]), is_closed(read.surface)
    return SurfaceFind(label, role, path, read.surface, stated, closed, is_silent=is_silent)


def is_closed(surface: SurfaceData) -> bool:
    """Whether a surface has no border."""
    triangles = surface.triangles.astype(np.int64)
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return not len(edges_of(triangles[distinct]).border)


def image_find(path: Path, label: str, series: str | None = None) -> ImageFind:
    """An image file, or a series of a DICOM folder, read; why, where it cannot be."""
    name = path.name.partition(".")[0] if path.is_file() else path.name
    role = name_role(name)
    try:
        read = read_image_file(path, series=series)
    except (CmfsimError, OSError) as error:
        return ImageFind(label, role, path, error=str(error), series=series)
    image = read.image
    spacing = np.abs(image.spacing)
    size = " × ".join(str(n) for n in image.values.shape)
    steps = " × ".join(f"{s:.3g}" for s in spacing)
    low = image.lowest
    box = np.stack([low, low + spacing * (np.array(image.values.shape) - 1)])
    is_labels = are_labels(image.values) or _are_turned_labels(path, read.findings)
    return ImageFind(
        label,
        role,
        path,
        read.modality,
        (float(image.values.min()), float(image.values.max())),
        f"{size} voxels of {steps} mm",
        box,
        series=series,
        findings=read.findings,
        is_labels=is_labels,
        to_hu=None if is_labels else _scale(image),
    )


def _scale(image: ImageData) -> tuple[float, float, float] | None:
    """How values become HU where they are not, if that is clear."""
    # A folder of surfaces loads nothing of imaging.
    from cmfsim.imaging.intensities.intensity import calibration  # noqa: PLC0415

    if float(image.values.min()) <= HU_AIR:
        return None
    try:
        found = calibration(image.values)
    except CmfsimError:
        return None
    if not found.is_clear or (found.slope, found.offset) == (1.0, 0.0):
        return None
    return found.slope, found.offset, found.error


def _are_turned_labels(path: Path, findings: tuple[Finding, ...]) -> bool:
    """Whether a file on a turned grid has labels, which are none once they are resampled."""
    if path.is_dir() or not any(f.code == "image-oblique" for f in findings):
        return False
    try:
        return are_labels(read_labels(path).labels[0])
    except CmfsimError:
        return False


def landmark_find(path: Path, label: str) -> LandmarkFind:
    """A file of landmarks, read; raises as `read_landmarks`."""
    name = path.name.partition(".")[0]
    return LandmarkFind(label, name_role(name), path, read_landmark_file(path))
