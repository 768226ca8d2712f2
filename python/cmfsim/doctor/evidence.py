"""Everything that a case names, as far as it can be read, and a finding for what cannot."""

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import PRESETS, Surface
from cmfsim.errors import CaseError, CmfsimError
from cmfsim.io import Case, read_bone_pair, read_landmark_file, read_surface_file
from cmfsim.io.images.image_files import read_image_file
from cmfsim.io.slicer.transforms import TransformFile, read_transform_file
from cmfsim.surfaces.checks import SurfaceReport, check_surface
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.repair import INNER_WALL, RepairOptions, repair_surface
from cmfsim.values.case_parts import CaseMotion, CaseSurfaces
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.image_data import ImageData
from cmfsim.values.landmark_sites import is_for_measures
from cmfsim.values.moduli import FatModuli, moduli_unusual
from cmfsim.values.surface_data import MovedSurface, SurfaceData

# A direction is named by its largest component, and by another that is at least this share of it.
NAMED_SHARE = 0.6
# Components of a shift that are named: at least this share of the largest.
SHIFT_SHARE = 0.3
# Towards the negative and the positive end of each axis, L, P, S.
DIRECTIONS = (("to the right of", "to the left of"), ("in front of", "behind"), ("below", "above"))
SHIFTS = (
    ("too far to the right", "too far to the left"),
    ("too far forwards", "too far back"),
    ("too low", "too high"),
)
# Points of a surface that distances are measured at; a few thousand describe a skull.
MAX_SAMPLES = 20_000
# No head or bone is longer, mm: ten times what the check of sizes lets pass.
FAR_TOO_LONG = 4200.0
Read = TypeVar("Read")


def place_text(point: Floats) -> str:
    """A point as (L, P, S) with a tenth of a mm."""
    return "(" + ", ".join(f"{x:.1f}" for x in point) + ")"


def direction_text(offset: Floats) -> str:
    """Where a thing lies that is off by an LPS vector, in words: "above", "behind and below"."""
    sizes = np.abs(offset)
    order = np.argsort(-sizes, kind="stable")[:2]
    named = [a for a in order if sizes[a] > 0.0 and sizes[a] >= NAMED_SHARE * sizes[order[0]]]
    return " and ".join(DIRECTIONS[a][int(offset[a] > 0.0)] for a in named) or "on"


def shift_text(offset: Floats) -> str:
    """An LPS vector in words: "5.0 mm too high and 2.0 mm too far back"."""
    sizes = np.abs(offset)
    named = [a for a in np.argsort(-sizes, kind="stable") if sizes[a] >= SHIFT_SHARE * sizes.max()]
    return " and ".join(f"{sizes[a]:.1f} mm {SHIFTS[a][int(offset[a] > 0.0)]}" for a in named)


@dataclass(frozen=True, eq=False)
class Body:
    """A surface of the case, "skin" or a bone by name, as read and as it would be repaired."""

    name: str
    where: str
    surface: SurfaceData

    @cached_property
    def report(self) -> SurfaceReport:
        """The state of the surface as read."""
        return check_surface(self.surface)

    @cached_property
    def _repair(self) -> tuple[SurfaceData, tuple[Finding, ...]]:
        options = RepairOptions(outer_wall=self.name == "skin")
        return repair_surface(self.surface, self.name, options)

    @property
    def repaired(self) -> SurfaceData:
        """The surface closed and outward, as `build` would make it."""
        return self._repair[0]

    @property
    def walls(self) -> tuple[Finding, ...]:
        """A finding where an inner wall is dropped."""
        found = (f for f in self._repair[1] if f.code == INNER_WALL)
        return tuple(findings_at(self.where, found))

    @cached_property
    def index(self) -> Surface:
        """Closest points and winding numbers of the repaired surface."""
        return Surface(self.repaired.vertices, self.repaired.triangles)

    @cached_property
    def samples(self) -> Floats:
        """Vertices, evenly taken from the list where there are many."""
        vertices = self.repaired.vertices
        step = -(-len(vertices) // MAX_SAMPLES)
        return vertices[::step]


def distances_from(bodies: Iterable[Body], points: Floats) -> Floats:
    """The distance of each point from the nearest of some surfaces, mm; infinite without any."""
    nearest = np.full(len(points), np.inf)
    for body in bodies:
        nearest = np.minimum(nearest, distances(points, body.index))
    return nearest


@dataclass(frozen=True, eq=False)
class Evidence:
    """What could be read of a case; what could not be read is empty.

    motions: mapping of str to (4, 4), mm, of the segments whose plan is a matrix.
    transforms: How the transform files of the plan were understood, by segment.
    """

    case: Case
    image: ImageData | None = None
    skin: Body | None = None
    bones: Mapping[str, Body] = field(default_factory=dict)
    skull_landmarks: Mapping[str, Floats] = field(default_factory=dict)
    skin_landmarks: Mapping[str, Floats] = field(default_factory=dict)
    motions: Mapping[str, Floats] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    transforms: Mapping[str, TransformFile] = field(default_factory=dict)

    @cached_property
    def moved(self) -> Mapping[str, MovedSurface | tuple[SurfaceData, SurfaceData] | CmfsimError]:
        """The motions that are given by surfaces before and after, or why they are not read.

        Surfaces with different triangles are both there.
        """
        found: dict[str, MovedSurface | tuple[SurfaceData, SurfaceData] | CmfsimError] = {}
        given = self.case.surfaces
        units, frame = ("mm", None) if given is None else (given.units, given.frame)
        for name, motion in self.case.plan.items():
            before, after = motion.surface, motion.moved_surface
            # A file that is missing is reported where files are looked for.
            if before is None or after is None or not (before.is_file() and after.is_file()):
                continue
            try:
                found[name] = read_bone_pair(before, after, units=units, frame=frame)
            except CmfsimError as error:
                found[name] = error
        return found

    def in_region(self, points: Floats) -> NDArray[np.bool_]:
        """Which of (n, 3) points lie in the part that is meshed; without a skin, all of them."""
        if self.skin is None:
            return np.ones(len(points), dtype=bool)
        depths = self.skin.repaired.vertices[:, 1]
        region = self.case.region
        try:
            plane = region.plane(self.skull_landmarks, float(depths.min()), float(depths.max()))
        except CaseError:
            # Landmarks that the plane is placed from are missing, which is said elsewhere.
            return np.ones(len(points), dtype=bool)
        inside = plane.distance(points) < 0.0
        if region.lower is not None:
            inside &= points[:, 2] > region.lower
        if region.upper is not None:
            inside &= points[:, 2] < region.upper
        return inside


def gather(case: Case) -> Evidence:
    """What can be read of a case, with a finding for each file that cannot."""
    findings: list[Finding] = []
    skin, bones = _surfaces(case, findings)
    image = _image(case, findings)
    skull = _landmarks(case, "landmarks.skull", case.landmarks.skull, findings)
    skin_points = _landmarks(case, "landmarks.skin", case.landmarks.skin, findings)
    _check_other_files(case, findings)
    motions, transforms = _motions(case, findings)
    _check_region(case, skull, findings)
    _check_preset(case, findings)
    _check_output(case, findings)
    return Evidence(
        case, image, skin, bones, skull, skin_points, motions, tuple(findings), transforms
    )


def _surfaces(case: Case, findings: list[Finding]) -> tuple[Body | None, dict[str, Body]]:
    """The skin and the bones of the surfaces that can be read."""
    skin: Body | None = None
    bones: dict[str, Body] = {}
    if case.surfaces is None:
        return skin, bones
    files = {"skin": case.surfaces.skin}
    files |= {f"bones.{name}": path for name, path in case.surfaces.bones.items()}
    for key, path in files.items():
        # A bone's size is checked against the skin's.
        is_sized = key == "skin" or skin is not None
        body = _body(case, case.surfaces, key, path, findings, is_sized=is_sized)
        if body is None:
            continue
        if key == "skin":
            skin = body
        else:
            bones[body.name] = body
    return skin, bones


def _check_other_files(case: Case, findings: list[Finding]) -> None:
    """Whether the files that no check looks into are there."""
    if case.lips.contact and isinstance(case.lips.seam, Path):
        _check_file(case, "lips.seam", case.lips.seam, findings)
    if case.mesh.file is not None:
        _check_file(case, "mesh.file", case.mesh.file, findings)
    after = case.postoperative
    if after is not None:
        files = {name: getattr(after, name) for name in ("skin", "image", "landmarks")}
        files |= {f"bones.{name}": path for name, path in after.bones.items()}
        for key, path in files.items():
            if path is not None:
                folder = key == "image"
                _check_file(case, f"postoperative.{key}", path, findings, folder=folder)


def _motions(
    case: Case, findings: list[Finding]
) -> tuple[dict[str, Floats], dict[str, TransformFile]]:
    """The motions of the plan that are known by now, and the transform files that give some."""
    motions: dict[str, Floats] = {}
    transforms: dict[str, TransformFile] = {}
    for name, motion in case.plan.items():
        for key in ("transform", "surface", "moved_surface"):
            if (path := getattr(motion, key)) is not None:
                _check_file(case, f"plan.{name}.{key}", path, findings)
        transform = _transform(case, name, motion, findings)
        if transform is not None:
            transforms[name] = transform
        matrix = motion.matrix if transform is None else transform.matrix
        if matrix is not None:
            motions[name] = matrix
    return motions, transforms


def _check_region(case: Case, skull: Mapping[str, Floats], findings: list[Finding]) -> None:
    """Whether the landmarks place the plane behind the face."""
    try:
        if not (case.landmarks.proposed or case.landmarks.is_completed(len(skull))):
            case.region.plane(skull, 0.0, 0.0)
    except CaseError as error:
        findings.append(
            Finding(
                "landmark-missing",
                str(error),
                severity="error",
                where=case.where("region.posterior_depth"),
                why="the face cannot be separated from the rest of the head",
                fix="place these landmarks, or give posterior_plane",
            )
        )


def _check_preset(case: Case, findings: list[Finding]) -> None:
    """Whether the constants of the tissue are known, and are those of a soft tissue."""
    if case.muscles is None and case.fat.kind == "isotropic":
        # With muscles, those of all tissues are checked together.
        findings += moduli_unusual({"fat": FatModuli.of(case.fat)}, case.where("tissue"))
    if case.fat.kind == "preset" and case.fat.preset not in PRESETS:
        findings.append(
            Finding(
                "unknown-name",
                f"preset is {case.fat.preset!r}",
                where=case.where("tissue.preset"),
                facts={"names": ", ".join(PRESETS)},
            )
        )


def _readable(
    read: Callable[[], Read], findings: list[Finding], where: str, fix: str, *, why: str = ""
) -> Read | None:
    """What a reader gives; None, with a finding, where it cannot read."""
    try:
        return read()
    except (CmfsimError, MemoryError) as error:
        findings.append(Finding("input-unreadable", str(error), where=where, why=why, fix=fix))
        return None


def _body(
    case: Case,
    given: CaseSurfaces,
    key: str,
    path: Path,
    findings: list[Finding],
    *,
    is_sized: bool,
) -> Body | None:
    where = f"{case.where(f'surfaces.{key}')} ({path.name})"
    if not _check_file(case, f"surfaces.{key}", path, findings):
        return None

    def read() -> Body:
        found = read_surface_file(path, units=given.units, frame=given.frame)
        findings.extend(found.findings)
        body = Body(key.removeprefix("bones."), where, found.surface)
        # Triangles that are all without area pass the reader and fail when the surface is repaired.
        # Coordinates in a wrong unit may fail too; the check of sizes reports the unit.
        if not (is_sized and np.ptp(body.surface.vertices, axis=0).max() > FAR_TOO_LONG):
            _ = body.index
        return body

    fix = "export it again from the program that made it, as STL, PLY, OBJ or VTP"
    return _readable(read, findings, where, fix)


def _image(case: Case, findings: list[Finding]) -> ImageData | None:
    given = case.image
    if given is None or not _check_file(case, "image.file", given.file, findings, folder=True):
        return None
    found = _readable(
        lambda: read_image_file(given.file, series=given.series),
        findings,
        f"{case.where('image.file')} ({given.file.name})",
        "export the CT series again, as DICOM, NRRD or NIfTI",
    )
    if found is None:
        return None
    findings.extend(found.findings)
    return found.image


def _transform(
    case: Case, name: str, motion: CaseMotion, findings: list[Finding]
) -> TransformFile | None:
    """The transform file of a segment, where there is one that can be read."""
    path = motion.transform
    if path is None or not path.is_file():
        return None
    return _readable(
        lambda: read_transform_file(path, direction=motion.direction, frame=motion.frame),
        findings,
        case.where(f"plan.{name}.transform"),
        "save it again as one rigid ITK transform (.tfm or .h5), or write a matrix",
        why=f"the motion of {name} is unknown",
    )


def _landmarks(
    case: Case, key: str, path: Path | None, findings: list[Finding]
) -> Mapping[str, Floats]:
    if path is None or not _check_file(case, key, path, findings):
        return {}
    found = _readable(
        lambda: read_landmark_file(path, frame=case.landmarks.frame),
        findings,
        case.where(key),
        "correct the file, or save it again from 3D Slicer",
        why="cuts and muscles are placed from landmarks",
    )
    if found is None:
        return {}
    findings.extend(found.findings)
    return {name: place for name, place in found.points.items() if not is_for_measures(name)}


def _check_file(
    case: Case, key: str, path: Path, findings: list[Finding], *, folder: bool = False
) -> bool:
    """Whether a file is there and can be read; a finding if not."""
    what = ""
    if not path.exists():
        what = f"{path} does not exist"
    elif path.is_dir() and not folder:
        what = f"{path} is a folder, not a file"
    elif not os.access(path, os.R_OK):
        what = f"{path} may not be read"
    elif path.is_file() and path.stat().st_size == 0:
        what = f"{path} is empty"
    if not what:
        return True
    findings.append(
        Finding(
            "file-missing",
            what,
            where=case.where(key),
            why="the case cannot be built without it",
            fix=f"correct the path; it is relative to {case.file.parent.resolve()}",
        )
    )
    return False


def _check_output(case: Case, findings: list[Finding]) -> None:
    folder = case.output
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if folder.is_dir() and os.access(folder, os.W_OK | os.X_OK):
        return
    what = "is not writable" if folder.is_dir() else "is a file, not a folder"
    findings.append(
        Finding("output-not-writable", f"{folder} {what}", where=case.where("output.folder"))
    )
