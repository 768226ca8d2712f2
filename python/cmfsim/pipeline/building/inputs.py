"""The contents of the files of a case: anatomy, landmarks, motions, and their hashes."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cmfsim._core import __version__
from cmfsim.errors import CaseInputError
from cmfsim.io import Case, read_bone_pair, read_landmark_file, read_surface_file, read_transform
from cmfsim.io.files.folders import check_below, check_writable
from cmfsim.io.images.dicom_series import dicom_files
from cmfsim.io.images.image_files import read_image_file
from cmfsim.io.landmarks import LandmarkFile
from cmfsim.io.meshes.photos import photo_files
from cmfsim.io.results.predictions import PREDICTION_FILE, check_own
from cmfsim.io.results.result_files import is_model_file
from cmfsim.io.slicer.transforms import read_transform_file
from cmfsim.meshing.levels import anatomy_from_surfaces, signed_level
from cmfsim.surfaces.levels import detailed_surface
from cmfsim.surfaces.repair import RepairOptions, repair_surface
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.calibration import settings_digest
from cmfsim.values.case_parts import CaseImage, CaseMesh, CaseMotion
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.progress import Progress
from cmfsim.values.proposed_landmarks import SiteState, site_state
from cmfsim.values.surface_data import MovedSurface, SurfaceData

if TYPE_CHECKING:
    from cmfsim.imaging import SegmentOptions
    from cmfsim.imaging.head import OpenHead
    from cmfsim.values.image_data import ImageData

# Heads that were opened, by image and options, with what was noticed on reading it.
OpenHeads: TypeAlias = "dict[str, tuple[OpenHead, tuple[Finding, ...]]]"

# Voxels of the grid that surfaces are worked on, in edges of the mesh to come, and in mm at least.
VOXELS_PER_EDGE = 3.0
LEAST_VOXEL = 0.5
# Share of a bone from a file that must lie where the image shows bone: on the CT phantom
# 0.91 (mandible) and 0.94, 3 mm off 0.76 and 0.83.
LEAST_SHOWN = 0.84
# Bytes that are hashed at a time.
CHUNK = 1 << 20


def read_case_landmarks(case: Case) -> tuple[dict[str, Mapping[str, Floats]], tuple[Finding, ...]]:
    """The landmarks of a case, "skull" and "skin", with what was noticed on reading them."""
    files = _landmark_files(case)
    findings = tuple(finding for file in files.values() for finding in file.findings)
    return {kind: file.points for kind, file in files.items()}, findings


def _landmark_files(case: Case) -> dict[str, LandmarkFile]:
    given = case.landmarks
    return {
        kind: read_landmark_file(path, frame=given.frame, kind=kind)
        for kind, path in (("skull", given.skull), ("skin", given.skin))
        if path is not None
    }


def read_placed_sites(case: Case) -> dict[tuple[str, str], tuple[Floats, SiteState]]:
    """The landmarks of a case by kind and label, and who placed each, as the files describe it."""
    return {
        (kind, name): (point, site_state(read.descriptions.get(name, "")))
        for kind, read in _landmark_files(case).items()
        for name, point in read.points.items()
    }


def read_anatomy(
    case: Case, landmarks: Mapping[str, Floats], progress: Progress, kept: OpenHeads | None = None
) -> tuple[Anatomy, tuple[Finding, ...]]:
    """The head of a case, from its CT or its surfaces.

    kept: Takes the opened head, or gives it once: other landmarks need no more of the image.
    """
    if case.image is not None:
        # A case of surfaces loads nothing of imaging.
        from cmfsim.imaging.head import segmented  # noqa: PLC0415

        tissue, key = replace(segment_options(case), part_jaws=not case.image.bones), ""
        head: ImageData | OpenHead | None = None
        noticed: tuple[Finding, ...] = ()
        if kept is not None:
            key = f"{input_hash(case.image.file)} {case.image.series} {tissue}"
            head, noticed = kept.pop(key, (None, noticed))
        is_new = head is None
        if head is None:
            progress("reading the image")
            read = read_image_file(case.image.file, series=case.image.series)
            head, noticed = read.image, tuple(read.findings)
        anatomy, opened = segmented(
            head,
            tissue,
            landmarks=landmarks or None,
            progress=lambda stage: progress(f"segmenting the head: {stage}"),
            # Landmarks that are to be found need the skin's surface first.
            on_skin=None if landmarks else partial(detailed_surface, "skin"),
        )
        if kept is not None and is_new:
            kept[key] = opened, noticed
        refuse_errors(anatomy, case.where("image"))
        if case.image.bones:
            anatomy = _with_given_bones(case, case.image, anatomy, progress)
        return anatomy, (*noticed, *anatomy.findings)
    given_surfaces = case.surfaces
    if given_surfaces is None:  # a Case has the one or the other
        raise AssertionError(case.name)
    findings: list[Finding] = []
    surfaces = {}
    files = {"skin": given_surfaces.skin, **given_surfaces.bones}
    for name, path in files.items():
        progress(f"reading surface {name}")
        given = read_surface_file(path, units=given_surfaces.units, frame=given_surfaces.frame)
        options = RepairOptions(outer_wall=name == "skin")
        surfaces[name], repaired = repair_surface(given.surface, name, options)
        findings.extend((*given.findings, *repaired))
    progress("measuring distances from the surfaces")
    spacing = max(case.mesh.edge_length / VOXELS_PER_EDGE, LEAST_VOXEL)
    skin = surfaces.pop("skin")
    anatomy = anatomy_from_surfaces(skin, surfaces, spacing=spacing)
    return anatomy, (*findings, *anatomy.findings)


def _with_given_bones(
    case: Case, image: CaseImage, anatomy: Anatomy, progress: Progress
) -> Anatomy:
    """The anatomy of a CT with bones of files; `CaseError` where these are not of this scan."""
    missing = [name for name in ("cranium", "mandible") if name not in image.bones]
    if missing:
        raise CaseInputError(
            f"{case.where('image.bones')}: {' and '.join(missing)} has no file: what the image "
            "shows of it would become soft tissue; give both cranium and mandible, or remove "
            "[image.bones]"
        )
    shown = np.maximum.reduce([level.values for level in anatomy.bones.values()]) > 0.0
    surfaces: dict[str, SurfaceData] = {}
    levels: dict[str, ImageData] = {}
    findings = list(anatomy.findings)
    for name, path in image.bones.items():
        progress(f"reading surface {name}")
        given = read_surface_file(path)
        surfaces[name], repaired = repair_surface(given.surface, name)
        findings.extend((*given.findings, *repaired))
        # As bone of the image, no bone reaches past the skin.
        level = signed_level(surfaces[name], anatomy.skin)
        levels[name] = level.with_values(np.minimum(level.values, anatomy.skin.values))
        own = level.values > 0.0
        share = int((own & shown).sum()) / max(int(own.sum()), 1)
        if share < LEAST_SHOWN:
            raise CaseInputError(
                f"{case.where(f'image.bones.{name}')}: {share:.0%} of {path.name} lies where "
                f"{image.file.name} shows bone (bones-not-of-image), {LEAST_SHOWN:.0%} at least "
                "is needed: check that both are of one scan, in mm and in one frame (LPS)"
            )
    return replace(
        anatomy, bones=levels, surfaces={**anatomy.surfaces, **surfaces}, findings=tuple(findings)
    )


def refuse_errors(anatomy: Anatomy, where: str) -> None:
    """Raise `CaseInputError` for the first error that segmentation found, such as a flipped image.

    Its surfaces can be looked at, but a face predicted from them would be wrong.
    """
    for finding in anatomy.findings:
        if finding.severity == "error":
            raise CaseInputError(f"{where}: {finding.what} ({finding.code}); {finding.fix}")


def segment_options(case: Case) -> SegmentOptions:
    """How tissue is read from a CT of the case, before the operation or after it."""
    from cmfsim.imaging import SegmentOptions  # noqa: PLC0415

    if case.image is None:
        return SegmentOptions()
    names = ("skin_threshold", "bone_threshold", "metal_threshold", "working_spacing", "rescale")
    given = {name: getattr(case.image, name) for name in names}
    return SegmentOptions(**{name: value for name, value in given.items() if value is not None})


def read_motion(
    case: Case, motion: CaseMotion
) -> Floats | MovedSurface | tuple[SurfaceData, SurfaceData]:
    """How a segment moves, by table and files; surfaces of different triangles stay a pair."""
    if motion.matrix is not None:
        return motion.matrix
    if motion.transform is not None:
        return read_transform(motion.transform, direction=motion.direction, frame=motion.frame)
    if motion.surface is None or motion.moved_surface is None:
        return np.eye(4)
    return read_bone_pair(motion.surface, motion.moved_surface, **stated_frame(case))


def stated_frame(case: Case) -> dict[str, Any]:
    """Unit and frame in which a case gives its surfaces, as their readers take them."""
    given = case.surfaces
    return {} if given is None else {"units": given.units, "frame": given.frame}


def motion_source(motion: CaseMotion) -> str:
    """Where a motion comes from and how its transform file was understood, in words."""
    if motion.transform is None:
        return motion.source()
    read = read_transform_file(motion.transform, direction=motion.direction, frame=motion.frame)
    return motion.source(read.text)


def input_hashes(case: Case) -> dict[str, str]:
    """The SHA-256 of every file that a case names, by its path from the case's folder.

    A file elsewhere counts by its name, the second as "name (2)"; a folder by the files in it.
    """
    return _hashes(_files(case), case.file.parent)


def _hashes(paths: Iterable[Path], folder: Path) -> dict[str, str]:
    found: dict[str, str] = {}
    # In the order of their parts in the case, so that two files of one name are not exchanged.
    for path in dict.fromkeys(paths):
        name = key = _path_from(path, folder)
        number = 1
        while key in found:
            number += 1
            key = f"{name} ({number})"
        found[key] = input_hash(path)
    return dict(sorted(found.items()))


def case_key(case: Case, hashes: Mapping[str, str] | None = None) -> str:
    """The SHA-256 of everything that results of a case depend on: files, plan, options, version.

    Results of one key may be shown together. Folders may be moved: paths count from the case's own,
    and where the results go does not count, nor does the band around them. Changes to the case in
    memory count as those in its file. Raises `OSError`: A file that the case names cannot be read.
    """
    folder = case.file.parent
    content = {
        "inputs": dict(input_hashes(case) if hashes is None else hashes),
        "case": {
            field.name: _plain(getattr(case, field.name), folder)
            for field in fields(case)
            if field.name not in {"file", "output", "places", "band", "made_for"}
        },
        "version": __version__,
    }
    return settings_digest(content)


def plan_key(case: Case) -> str:
    """The SHA-256 of what the numbers of a plan are about: image or surfaces, landmarks and cuts.

    A plan of one key means the same for every case of that key, whatever its mesh, tissue, muscles
    or own plan. Raises as `case_key`.
    """
    others: dict[str, Any] = dict.fromkeys(("muscles", "postoperative", "photo", "bite"))
    about = replace(case, plan={}, achieved=False, mesh=CaseMesh(), **others)
    folder = case.file.parent
    parts = ("image", "surfaces", "landmarks", "osteotomies")
    content = {name: _plain(getattr(about, name), folder) for name in parts}
    content["inputs"] = _hashes((p for p in _files(about) if p != case.file), folder)
    return settings_digest(content)


def _plain(value: Any, folder: Path) -> Any:
    """A value of a case as JSON holds it, so that equal values have equal texts."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name), folder) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): _plain(entry, folder) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), folder)
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(entry, folder) for entry in value]
    if isinstance(value, Path):
        return _path_from(value, folder)
    if value is None or isinstance(value, str | int | float):
        return value
    raise TypeError(f"{type(value).__name__} in a case")  # no repr: it may hold an address


def _path_from(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def plan_of_other_case(case: Case, key: str) -> list[Finding]:
    """The finding about a plan whose file states another `plan_key` than this one of the case."""
    if case.made_for in {"", key}:
        return []
    return [Finding("plan-other-case", where="the file of the plan")]


def check_output(case: Case, is_written: Callable[[str], bool] = is_model_file) -> None:
    """Finds before the work what would keep results from being written, or spoil an input.

    is_written: Whether a file of a name is written: of a model where left out.
    Raises `CaseError`: The output folder is a file, a link that leads out of the case's folder, or
        holds an input of a name that is written there, or a summary or report of another program.
    Raises `OSError`: It cannot be written to.
    """
    folder = case.output
    check_below(folder, case.file.parent)
    check_writable(folder)
    for path in _files(case):
        written = folder / path.name
        if not is_written(path.name) or not path.exists() or not written.exists():
            continue
        if path.samefile(written):
            raise CaseInputError(
                f"{path}: the results would replace this input; choose another output folder"
            )
    if is_written(PREDICTION_FILE):
        check_own(folder)


def _files(case: Case) -> Iterator[Path]:
    yield case.file
    if case.image is not None:
        yield case.image.file
        yield from case.image.bones.values()
    for scans in (case.bite, case.image.teeth if case.image is not None else None):
        if scans is not None:
            yield from (scans.upper, scans.lower)
    if case.surfaces is not None:
        yield case.surfaces.skin
        yield from case.surfaces.bones.values()
    optional = [case.landmarks.skull, case.landmarks.skin, case.mesh.file]
    if isinstance(case.lips.seam, Path):
        optional.append(case.lips.seam)
    optional.extend(case.landmarks.templates)
    if case.muscles is not None and isinstance(case.muscles.template, Path):
        optional.append(case.muscles.template)
    after = case.postoperative
    if after is not None:
        optional += [after.skin, after.image, after.landmarks, *after.bones.values()]
    if case.photo is not None:
        optional += [*photo_files(case.photo.file), case.photo.landmarks]
    for motion in case.plan.values():
        optional += [motion.transform, motion.surface, motion.moved_surface]
    yield from (path for path in optional if path is not None)


def input_hash(path: Path) -> str:
    """The SHA-256 of a file, or of the DICOM files in a folder with their names."""
    digest = hashlib.sha256()
    for file in dicom_files(path) if path.is_dir() else [path]:
        if path.is_dir():
            digest.update(os.fsencode(f"{file.relative_to(path).as_posix()}\n"))
        with file.open("rb") as stream:
            while chunk := stream.read(CHUNK):
                digest.update(chunk)
    return digest.hexdigest()
