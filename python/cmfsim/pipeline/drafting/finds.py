"""The contents of a folder: surfaces, images, landmarks and transforms, each read and measured."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.dicom import dicom_places
from cmfsim.io.images import read_image_file
from cmfsim.io.landmarks import LandmarkFile, read_landmark_file
from cmfsim.io.stated_frames import is_own_file
from cmfsim.io.surfaces import surface_as_stored
from cmfsim.pipeline.drafting.roles import NameRole, name_role
from cmfsim.surfaces.topology import edges_of
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData

__all__ = [
    "EXTRACTED",
    "ImageFind",
    "LandmarkFind",
    "Listing",
    "OtherFind",
    "SurfaceFind",
    "TransformFind",
    "image_find",
    "landmark_find",
    "listing",
    "surface_find",
]

# How far into folders, and how many files: a case has some hundred, DICOM a thousand slices.
MAX_DEPTH, MAX_FILES = 6, 20_000
SURFACES = (".stl", ".ply", ".obj", ".vtp", ".vtk")
IMAGES = (".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd")
TRANSFORMS = (".tfm", ".h5", ".txt", ".mat")
MARKUPS = (".mrk.json", ".fcsv")
SCENES = (".mrml", ".mrb")
# Where what is made from a scene is put, below the folder of the case.
EXTRACTED = "from_scene"
# Files by which a folder is known as one that cmfsim wrote.
OURS = ("prediction.json", "build.json", "metrics.json", "cmfsim-scene.mrml")
# Why files are not read.
NOT_UTF8 = "its name is not UTF-8, so a case file cannot name it: rename it"
NOT_HERE = "is a link to a file that is not here: fetch it (with DataLad: datalad get)"
SEEN = "is a link to a folder that holds this one, or that was read already"
# What a DICOM file holds after its preamble.
PREAMBLE = 128


@dataclass(frozen=True, eq=False)
class SurfaceFind:
    """A surface, in its file's own numbers.

    Attributes
    ----------
    label : str
        What reports call it: its path, or its scene and node.
    role : NameRole
    path : Path
        The file; for a segment of a segmentation, that of all segments.
    surface : SurfaceData
    stated : str or None
        The frame that its header, or its scene, states.
    is_closed : bool
    to_world : (4, 4) float64, mm, LPS
        What its scene applies to it.
    chain : tuple of str
        The names of the transforms that do, the nearest first.
    in_scene : bool
    is_made : bool
        Whether it was made of voxels: it has no file of its own.
    """

    label: str
    role: NameRole
    path: Path
    surface: SurfaceData
    stated: str | None
    is_closed: bool
    to_world: Floats = field(default_factory=lambda: np.eye(4))
    chain: tuple[str, ...] = ()
    in_scene: bool = False
    is_made: bool = False

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
class ImageFind:
    """A CT, or another image.

    Attributes
    ----------
    label, role, path
        As of a surface; `path` is a folder for DICOM.
    modality : str
        Of DICOM; empty where the file does not state it.
    values : tuple of float
        Lowest and highest.
    words : str
        Its size and spacing.
    box : (2, 3) float64, mm, LPS
        Its lowest and highest corner.
    error : str
        Why it cannot be read; empty if it can.
    series : str or None
        UID of the DICOM series that is meant, where the folder holds several.
    """

    label: str
    role: NameRole
    path: Path
    modality: str = ""
    values: tuple[float, float] = (0.0, 0.0)
    words: str = ""
    box: Floats | None = None
    error: str = ""
    series: str | None = None
    findings: tuple[Finding, ...] = ()
    to_world: Floats = field(default_factory=lambda: np.eye(4))
    chain: tuple[str, ...] = ()
    in_scene: bool = False


@dataclass(frozen=True, eq=False)
class LandmarkFind:
    """A file of landmarks, as read."""

    label: str
    role: NameRole
    path: Path
    read: LandmarkFile
    to_world: Floats = field(default_factory=lambda: np.eye(4))
    chain: tuple[str, ...] = ()
    in_scene: bool = False


@dataclass(frozen=True, eq=False)
class TransformFind:
    """A separate transform file; its name identifies what it moves."""

    label: str
    role: NameRole
    path: Path


@dataclass(frozen=True)
class OtherFind:
    """What is not used, and why."""

    label: str
    why: str


@dataclass
class Listing:
    """The paths in a folder, by what their endings say."""

    surfaces: list[Path] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)
    labels: list[Path] = field(default_factory=list)
    transforms: list[Path] = field(default_factory=list)
    markups: list[Path] = field(default_factory=list)
    scenes: list[Path] = field(default_factory=list)
    dicom: list[tuple[Path, str | None]] = field(default_factory=list)
    unread: dict[tuple[Path, str], list[Path]] = field(default_factory=dict)

    def skip(self, path: Path, why: str) -> None:
        """Notes a file that is not read."""
        self.unread.setdefault((path.parent, why), []).append(path)

    def others(self, folder: Path) -> list[OtherFind]:
        """What is not read, and why."""
        return [
            OtherFind(path.relative_to(folder).as_posix(), why)
            for (_, why), paths in self.unread.items()
            for path in paths
        ]


def listing(folder: Path) -> Listing:
    """The files of a folder and those below it, by kind.

    Raises
    ------
    CaseError
        (also `ValueError`) More files than a case has.
    """
    found = Listing()
    dicom: dict[Path, None] = {}
    for count, path in enumerate(_files(folder, found)):
        if count >= MAX_FILES:
            raise CaseInputError(
                f"{folder}: contains more than {MAX_FILES} files: give the folder of one patient"
            )
        name = path.name.lower()
        kind = (
            found.labels
            if name.endswith((".seg.nrrd", ".seg.nhdr"))
            else found.markups
            if name.endswith(MARKUPS)
            else next(
                (
                    paths
                    for endings, paths in (
                        (SCENES, found.scenes),
                        (SURFACES, found.surfaces),
                        (IMAGES, found.images),
                        (TRANSFORMS, found.transforms),
                    )
                    if name.endswith(endings)
                ),
                None,
            )
        )
        if kind is not None:
            kind.append(path)
        elif path.parent not in dicom and _is_dicom(path):
            dicom[path.parent] = None
    found.dicom = dicom_places(list(dicom))
    return found


def _files(folder: Path, found: Listing) -> Iterator[Path]:
    """The plain files of a folder in a fixed order; hidden ones and cmfsim's results left out.

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
            continue
        deep = len(here.relative_to(folder).parts) >= MAX_DEPTH
        folders[:] = [] if deep else sorted(f for f in folders if f[0] != "." and f != EXTRACTED)
        for name in sorted(names):
            path = here / name
            if name[0] == ".":
                continue
            if not _is_utf8(path.relative_to(folder).as_posix()):
                found.skip(path, NOT_UTF8)
            elif path.is_symlink() and not path.exists():
                found.skip(path, NOT_HERE)
            elif path.is_file():
                yield path


def _is_utf8(name: str) -> bool:
    """Whether a name can stand in a case file, which is UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def _is_dicom(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(PREAMBLE + 4)[PREAMBLE:] == b"DICM"
    except OSError:
        return False


def surface_find(path: Path, label: str) -> SurfaceFind:
    """A surface file, read.

    Raises
    ------
    CaseError
        (also `ValueError`) As `read_surface`.
    """
    read = surface_as_stored(path)
    surface, stated = read.surface, read.frame
    if stated is None and is_own_file(path):
        stated = "LPS"
    name = path.name[: -len(path.suffix)]
    return SurfaceFind(label, name_role(name), path, surface, stated, is_closed(surface))


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
    )


def landmark_find(path: Path, label: str) -> LandmarkFind:
    """A file of landmarks, read.

    Raises
    ------
    LandmarkError
        (also `ValueError`) As `read_landmarks`.
    """
    name = path.name.partition(".")[0]
    return LandmarkFind(label, name_role(name), path, read_landmark_file(path))
