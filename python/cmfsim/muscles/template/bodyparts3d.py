"""A muscle template from BodyParts3D, release 3.0: a real head's muscles, bones and teeth.

BodyParts3D (Mitsuhashi et al. 2009) is licensed under CC BY-SA 2.1 JP. Its files are not part of
this package; `WHERE` states where to download them.

Fibre lines of its flat muscles, whose outline does not determine them, have the origins and
insertions of anatomy textbooks: temporalis converges on the coronoid process, buccinator runs
forwards to the corner of the mouth, platysma up from the clavicle to the jaw, frontalis down from
the vertex to the brow. Frame LPS.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.io.landmarks import read_landmarks
from cmfsim.io.meshes.surfaces import read_surface
from cmfsim.muscles.template.fibre_lines import fan_lines, lane_lines
from cmfsim.muscles.template.muscle_template import MuscleTemplate
from cmfsim.registration import side_vectors
from cmfsim.surfaces.checks import SurfaceReport, check_surface
from cmfsim.surfaces.repair import RepairOptions, clean_surface, repair_surface
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import SKULL_LANDMARKS
from cmfsim.values.musculature import MuscleSurface, as_landmarks
from cmfsim.values.progress import Progress, no_progress
from cmfsim.values.surface_data import SurfaceData, joined_surface


class MusclePair(NamedTuple):
    """A muscle on either side: its name without side, its kind, its parts on the right and left."""

    name: str
    kind: str
    right: str
    left: str


# Of each part that makes the template, its id (FMA), our name and kind, and its file's hash.
PARTS = json.loads(files(__package__).joinpath("bodyparts3d.json").read_text(encoding="utf-8"))
PAIRED_MUSCLES = tuple(MusclePair(name, *entry) for name, entry in PARTS["paired"].items())
HASHES: Mapping[str, str] = PARTS["hashes"]
# Vertices that the tip of temporalis is the mean of; its tendon ends broadly.
TIP_VERTICES = 20
# Share of buccinator's vertices that its hind and its front end are the means of.
END_SHARE = 0.1
SAGITTAL = (1.0, 0.0, 0.0)
# Directions that platysma and frontalis face, on the left.
PLATYSMA_FACES, FRONTALIS_FACES = (0.7, -0.7, 0.0), (0.3, -1.0, 0.0)
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)

WHERE = (
    "https://github.com/LuisLuisLuisLuisLuisLuisLuisLuis/AnatomyExplorer3D at 53e1aebb, folder "
    "src/main/resources/Project/anatomy/BodyParts3D_3.0_obj_99"
)
LICENCE = "CC BY-SA 2.1 JP"
ATTRIBUTION = "BodyParts3D, © The Database Center for Life Science"
# Left and right of one person differ by 1 % in volume in these files; where they differ by more,
# the broken one of them has lost a part.
MIRROR_VOLUME_SHARE = 0.05
# Measured on these files: 49002 runs forward on its way down, behind and 2.4 mm inside 49005, as
# the deep part does. Names follow the ids all the same, so that they can be looked up.
_EXCHANGED_NAMES = Finding(
    "bodyparts3d-parts",
    "the parts called superficial lie behind and inside those called deep: the atlas seems to have "
    "exchanged them",
    severity="note",
    where="masseter_superficial, masseter_deep (FMA49001 to FMA49005)",
    why="only the names are affected: each part keeps its position and direction",
    fix="remember this when you interpret the names anatomically",
)


@dataclass(frozen=True, eq=False)
class _Part:
    """A file as it was and as it was repaired."""

    concept: str
    raw: SurfaceReport
    surface: SurfaceData
    volume: float
    is_sound: bool
    findings: tuple[Finding, ...]

    @property
    def damage(self) -> tuple[int, int, int]:
        """What was wrong with the file: borders, forks, pieces. Less is better."""
        return (len(self.raw.borders), len(self.raw.non_manifold), len(self.raw.components))


def import_bodyparts3d(
    folder: str | os.PathLike[str],
    landmarks: Mapping[str, ArrayLike] | str | os.PathLike[str],
    *,
    verify: bool = True,
    progress: Progress | None = None,
) -> MuscleTemplate:
    """The template from the OBJ files of BodyParts3D 3.0: 65 muscles, bones and teeth.

    Coincident vertices are merged, debris is dropped, gaps are closed, and a muscle that lacks a
    part on one side is mirrored from the other; each repair is a finding. Nothing is downloaded:
    get the files from the repository that `WHERE` in this file names.

    Parameters
    ----------
    folder : path
        Holds `FMA49001.obj` and the others, 99 % reduced, LPS mm. Release 4.0 has other
        coordinates.
    landmarks : mapping of str to (3,) float64, mm, or path
        On these bones, by the names of `cmfsim.SKULL_LANDMARKS`; or their file.
    verify : bool
        Whether files must have the known SHA-256 hashes; otherwise differences are warnings.
    progress : callable, optional
        Called with the name of each file that is read.

    Raises
    ------
    FileNotFoundError
        Files are missing: how many, which first, and where to get them.
    CaseError
        (also `ValueError`) A file is not the known one, or no surface; meshio is not installed.
    LandmarkError
        (also `ValueError`) The landmarks cannot be read.

    Examples
    --------
    >>> import cmfsim
    >>> template = cmfsim.import_bodyparts3d("obj_99", "skull.mrk.json")  # doctest: +SKIP
    >>> template.save("atlas")  # doctest: +SKIP
    """
    folder = Path(folder)
    findings = _verified(folder, must_be_known=verify)
    if isinstance(landmarks, str | os.PathLike):
        landmarks = read_landmarks(landmarks)
    points = as_landmarks(landmarks)
    say = progress or no_progress
    muscles: list[MuscleSurface] = []
    concepts: dict[str, tuple[str, ...]] = {}
    for pair in PAIRED_MUSCLES:
        say(pair.name)
        left, right = (_part(folder, concept) for concept in (pair.left, pair.right))
        surfaces, mirrored = _both_sides(pair, left, right, points)
        for side, part, surface in zip("LR", (left, right), surfaces, strict=True):
            name = f"{pair.name}_{side}"
            course = atlas_course(pair.name, side, surface)
            muscles.append(MuscleSurface(name, side, surface, pair.kind, course=course))
            concepts[name] = (part.concept,)
            findings += _renamed(part.findings, name)
        findings += mirrored
    for name, (kind, concept) in PARTS["midline"].items():
        say(name)
        part = _part(folder, concept)
        muscles.append(MuscleSurface(name, "both", part.surface, kind))
        concepts[name] = (concept,)
        findings += _renamed(part.findings, name)
    findings.append(_EXCHANGED_NAMES)
    say("bones")
    # Flat triangles would keep others from measuring distances to it.
    bones = (*PARTS["bones"], *PARTS["teeth"])
    skull = [clean_surface(read_surface(folder / f"{concept}.obj")) for concept in bones]
    return MuscleTemplate(
        name="bodyparts3d",
        muscles=tuple(muscles),
        skull=joined_surface(skull),
        landmarks=points,
        definitions={n: where for n, where in SKULL_LANDMARKS.items() if n in points},
        licence=LICENCE,
        attribution=ATTRIBUTION,
        source=f"BodyParts3D release 3.0, 99 % reduced; files from {WHERE}; repaired by cmfsim",
        concepts=concepts,
        findings=tuple(findings),
    )


def _verified(folder: Path, *, must_be_known: bool) -> list[Finding]:
    """Warnings about files with other hashes than the known ones, if these are allowed."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; get the files from {WHERE}")
    missing = [name for name in HASHES if not (folder / f"{name}.obj").is_file()]
    if missing:
        raise FileNotFoundError(
            f"{folder}: {len(missing)} of {len(HASHES)} files are missing, {missing[0]}.obj first; "
            f"get them from {WHERE}"
        )
    other = [
        name
        for name, known in HASHES.items()
        if hashlib.sha256((folder / f"{name}.obj").read_bytes()).hexdigest() != known
    ]
    if not other:
        return []
    named = ", ".join(f"{name}.obj" for name in other[:3]) + (", …" if len(other) > 3 else "")
    what = f"{len(other)} of {len(HASHES)} files do not have the known SHA-256 hashes: {named}"
    fix = f"download them again from {WHERE}"
    if must_be_known:
        raise CaseInputError(
            f"{folder.name}: {what}; {fix}, or import without verification (--any-files)"
        )
    why = "other releases have different coordinates, and files may have been damaged"
    return [
        Finding("bodyparts3d-parts", what, severity="warning", where=folder.name, why=why, fix=fix)
    ]


def _part(folder: Path, concept: str) -> _Part:
    """A muscle's file, repaired."""
    read = read_surface(folder / f"{concept}.obj")
    raw = check_surface(read, crossings=False)
    surface, findings = repair_surface(read, concept, RepairOptions())
    repaired = check_surface(surface, crossings=False)
    is_sound = repaired.is_closed and not len(repaired.non_manifold) and not repaired.inconsistent
    if not is_sound:
        findings = (
            *findings,
            Finding(
                "bodyparts3d-parts",
                f"{len(repaired.borders)} borders and {len(repaired.non_manifold)} forked edges "
                "remain",
                severity="warning",
                where=concept,
                why="generalised winding numbers bridge small gaps; the edge of the muscle is "
                "blurred",
                fix="check the muscle; repair it by hand if it is important",
            ),
        )
    return _Part(concept, raw, surface, repaired.volume, is_sound, findings)


def _both_sides(
    pair: MusclePair, left: _Part, right: _Part, landmarks: Mapping[str, Floats]
) -> tuple[tuple[SurfaceData, SurfaceData], list[Finding]]:
    """The surfaces of the left and the right muscle, a broken one mirrored from the other."""
    difference = abs(left.volume - right.volume) / max(left.volume, right.volume)
    sound = left.is_sound and right.is_sound
    if (sound and difference <= MIRROR_VOLUME_SHARE) or left.damage == right.damage:
        return (left.surface, right.surface), []
    if not sound and left.is_sound == right.is_sound:
        return (left.surface, right.surface), []
    # Without a volume that tells, the sound one is the better; else the less damaged file.
    left_is_better = left.is_sound if not sound else left.damage < right.damage
    good, bad = (left, right) if left_is_better else (right, left)
    sides = ("left", "right") if left_is_better else ("right", "left")
    mirrored = _mirrored(good.surface, landmarks)
    finding = Finding(
        "bodyparts3d-parts",
        f"the {sides[1]} one ({bad.concept}: {bad.volume:.0f} mm³, {bad.damage[2]} pieces) is "
        f"mirrored from the {sides[0]} one ({good.concept}: {good.volume:.0f} mm³)",
        severity="note",
        where=f"{pair.name}_{'R' if left_is_better else 'L'}",
        why="part of it is missing from its file",
    )
    surfaces = (good.surface, mirrored) if left_is_better else (mirrored, good.surface)
    return surfaces, [finding]


def _mirrored(surface: SurfaceData, landmarks: Mapping[str, Floats]) -> SurfaceData:
    """A surface mirrored in the median plane that pairs of landmarks lie on either side of."""
    vectors = side_vectors(landmarks)
    if not vectors:
        raise LandmarkInputError(
            "a broken muscle must be mirrored, but no landmark is given on both sides (_L and _R)"
        )
    across = np.mean(list(vectors.values()), axis=0)
    normal = across / np.linalg.norm(across)
    pairs = [0.5 * (landmarks[f"{name}_L"] + landmarks[f"{name}_R"]) for name in vectors]
    middle = np.mean(pairs, axis=0)
    vertices = surface.vertices
    height = (vertices - middle) @ normal
    triangles = surface.triangles[:, ::-1]
    return SurfaceData(vertices - 2.0 * height[:, None] * normal, triangles)


def _renamed(findings: tuple[Finding, ...], name: str) -> list[Finding]:
    """Findings about a file as findings about a muscle."""
    return [replace(f, where=f"{name} ({f.where})") for f in findings]


def atlas_course(name: str, side: str, surface: SurfaceData) -> tuple[Floats, ...]:
    """The fibre lines (n, 3), mm, of an atlas muscle, origin to insertion; none for boxes."""
    vertices = surface.vertices
    mirror = np.array([-1.0 if side == "R" else 1.0, 1.0, 1.0])
    if name == "temporalis":
        tip = vertices[np.argsort(vertices[:, 2])[:TIP_VERTICES]].mean(axis=0)
        return fan_lines(surface, tip, SAGITTAL)
    if name == "buccinator":
        order = np.argsort(vertices[:, 1])
        count = max(1, int(END_SHARE * len(order)))
        front, back = (vertices[rows].mean(axis=0) for rows in (order[:count], order[-count:]))
        return lane_lines(surface, front - back, SAGITTAL)
    if name == "platysma":
        return lane_lines(surface, UP, mirror * PLATYSMA_FACES)
    if name == "frontalis":
        return lane_lines(surface, DOWN, mirror * FRONTALIS_FACES)
    return ()
