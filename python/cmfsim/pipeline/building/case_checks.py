"""What the parts of a build hand to each other, and checks that the doctor cannot make before."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import TetMesh
from cmfsim.doctor.sites.landmarks import check_landmarks, nearest_of_level, nearest_of_surfaces
from cmfsim.doctor.surgery.bone_overlap import BonePart, check_jaws, jaw_of
from cmfsim.doctor.surgery.plan import SMALL, SizedMotion, check_motion_size, nothing_moves
from cmfsim.errors import CaseInputError
from cmfsim.io import Case
from cmfsim.meshing.levels import TissueRegion
from cmfsim.meshing.lips.seam import LipSeam
from cmfsim.meshing.node_kinds.arches import DentalArches
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from cmfsim.pipeline.building.tissue.contacts import CaseContacts
from cmfsim.planning.face_measures.occlusion import bite_frame
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.image_data import ImageData
from cmfsim.values.landmark_sites import is_for_measures
from cmfsim.values.mesh_report import MeshReport
from cmfsim.values.motion import carried
from cmfsim.values.patient_model import LiftedTissue, PatientModel
from cmfsim.values.proposed_landmarks import ProposedLandmarks
from cmfsim.values.scene import NodeKinds
from cmfsim.values.surface_data import MovedSurface, SurfaceData
from cmfsim.values.touching import LipRegion, ObstacleData, TouchingData

# A head that lies further turned is reported, degrees: the sine of 15° is a quarter.
TURNED = 15.0


@dataclass(frozen=True, eq=False)
class Head:
    """A case with what was read of it, and the landmarks, mm, of "skull" and "skin".

    proposed: The landmarks, where they were found automatically.
    skin: In full detail, where finding them has made it, with `colours` of a 3D photo.
    """

    case: Case
    landmarks: Mapping[str, Mapping[str, Floats]]
    anatomy: Anatomy
    proposed: ProposedLandmarks | None = None
    skin: SurfaceData | None = None
    colours: NDArray[np.uint8] | None = None

    @property
    def skull(self) -> Mapping[str, Floats]:
        """Landmarks of the skull by name, mm."""
        return self.landmarks.get("skull", {})


@dataclass(frozen=True, eq=False)
class MeshedTissue:
    """The soft tissue of a head before its bones are known to be cut.

    filled: Tets, report and findings; None if they have to follow the seam between the lips.
    """

    region: TissueRegion
    level: ImageData
    findings: tuple[Finding, ...]
    filled: tuple[TetMesh, MeshReport, tuple[Finding, ...]] | None = None


@dataclass(frozen=True, eq=False)
class Tissue:
    """The soft tissue of a head, the tets that fill it, and what it slides on."""

    region: TissueRegion
    level: ImageData
    mesh: TetMesh
    report: MeshReport
    arches: DentalArches | None
    seam: LipSeam | None
    contacts: CaseContacts


@dataclass(frozen=True, eq=False)
class CaseLipContact:
    """The lips of a case, "upper" and "lower" where they are separated; what they may not enter.

    kinds: Of all nodes, those that may lift off the teeth free.
    """

    regions: Mapping[str, LipRegion]
    kinds: NodeKinds
    touching: tuple[TouchingData, ...] = ()
    obstacles: tuple[ObstacleData, ...] = ()


@dataclass(frozen=True, eq=False)
class Nodes:
    """The mesh that is solved on, and what its nodes do."""

    mesh: TetMesh
    report: MeshReport
    kinds: NodeKinds
    contacts: CaseContacts
    level: ImageData
    seam: LipSeam | None
    lips: CaseLipContact
    lifted: LiftedTissue | None


def misplaced(
    case: Case,
    landmarks: Mapping[str, Mapping[str, Floats]],
    anatomy: Anatomy,
    segments: tuple[BoneSegment, ...],
) -> list[Finding]:
    """Findings about landmarks that do not lie on the bones and the skin that were segmented."""
    surfaces = [s.surface.searched for s in segments]
    findings: list[Finding] = []
    for key, given in landmarks.items():
        places = {name: place for name, place in given.items() if not is_for_measures(name)}
        where = case.where(f"landmarks.{key}")
        on_bone = key == "skull"
        nearest = (
            nearest_of_surfaces(surfaces)
            if on_bone
            else nearest_of_level(anatomy.skin, 0.0, places)
        )
        findings += check_landmarks(key, places, where, nearest)
    # What is too far from the bone of the CT has ended the work before; what only lies far from the
    # bone that was segmented may lie on bone that was lost.
    return [replace(f, severity="warning") if f.severity == "error" else f for f in findings]


def cut_segments(case: Case) -> list[str]:
    """The names of the segments that the osteotomies of a case make."""
    return [name for osteotomy in case.osteotomies for name in osteotomy.segments]


def plan_sizes(case: Case, bones: PlannedBones, known: Iterable[Finding]) -> list[Finding]:
    """Findings on the sizes of the motions now that every segment, cut by now, has its surface.

    Raises what the doctor would have raised: a bone that is torn away.
    """
    seen = {(finding.code, finding.where) for finding in known}
    found: list[Finding] = []
    surfaces = {segment.name: segment.surface for segment in bones.segments}
    if case.achieved:
        travels = (_travel(motion, surfaces[name]) for name, motion in bones.motions.items())
        far = max(travels, default=0.0)
        if far < SMALL:
            found.append(nothing_moves(case.where("plan"), far))
    for name, motion in bones.motions.items():
        if isinstance(motion, MovedSurface):
            continue
        given = case.plan.get(name)
        is_measured = case.achieved or name in bones.fits
        where = case.where("plan" if case.achieved else f"plan.{name}")
        sized = SizedMotion(
            name,
            motion,
            points=surfaces[name].vertices,
            typed=given is not None and given.typed,
            centre=None if given is None else given.centre,
        )
        # A measured motion may be as small as it likes.
        found += [
            finding
            for finding in findings_at(where, check_motion_size(sized))
            if (finding.code, finding.where) not in seen
            and not (is_measured and finding.code.startswith("plan-tiny"))
        ]
    if case.surfaces is None and (errors := [f for f in found if f.severity == "error"]):
        raise CaseInputError(f"{errors[0].where}: {errors[0].what}; {errors[0].fix}")
    return found


def _travel(motion: Floats | MovedSurface, surface: SurfaceData) -> float:
    """How far a bone moves at most, mm."""
    if isinstance(motion, MovedSurface):
        surface, moved = motion.surface, motion.moved_vertices
    else:
        moved = carried(motion, surface.vertices)
    return float(np.linalg.norm(moved - surface.vertices, axis=1).max())


def jaws(
    bones: PlannedBones, landmarks: Mapping[str, Floats], case: Case, known: Iterable[Finding]
) -> list[Finding]:
    """What the plan does to the jaws, now that every segment has its surface and its motion.

    The doctor has reported it before where the case gives surfaces and landmarks.
    """
    seen = {finding.code for finding in known}
    made = {name: cut for cut in case.osteotomies for name in cut.segments}
    parts = []
    for segment in bones.segments:
        cut = made.get(segment.name)
        # A piece that a plane of the user cuts has the jaw of its bone.
        names = (segment.name, cut.bone if cut is not None else None)
        jaw = next((jaw for name in names if name and (jaw := jaw_of(name))), None)
        if jaw is not None:
            where = case.where("plan" if case.achieved else f"plan.{segment.name}")
            motion = bones.motions.get(segment.name, np.eye(4))
            parts.append(BonePart(segment.name, jaw, where, segment.surface, motion))
    return [found for found in check_jaws(parts, landmarks) if found.code not in seen]


def turned_head(case: Case, landmarks: Mapping[str, Floats]) -> list[Finding]:
    """A finding for each typed translation if the head lies turned in its files.

    landmarks: Of the skull; with fewer than three of the cranium, a turn cannot be seen.
    """
    frame = bite_frame(landmarks)
    axes = np.stack([frame.left, -frame.forwards, frame.up])
    angle = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(axes) - 1.0), -1.0, 1.0))))
    if angle <= TURNED:
        return []
    found = []
    for name, motion in case.plan.items():
        if not motion.typed or motion.matrix is None:
            continue
        centre = np.zeros(3) if motion.centre is None else motion.centre
        shift = carried(motion.matrix, centre[None])[0] - centre
        if (length := float(np.linalg.norm(shift))) < SMALL:
            continue
        own = shift @ axes
        what = (
            f"the head is turned by {angle:.0f}° against the axes of its files, along which {name} "
            f"moves {length:.1f} mm: it ends {np.linalg.norm(own - shift):.1f} mm beside where the "
            "same numbers along the head's own axes would take it"
        )
        signs = [-1.0, -1.0, 1.0] if motion.frame == "RAS" else [1.0, 1.0, 1.0]
        numbers = ", ".join(f"{number:.2f}" for number in own * signs)
        fix = (
            f"if forwards and up are meant as the head has them: translation = [{numbers}]; "
            "nothing to do if the plan was made with the head as it lies"
        )
        where = case.where(f"plan.{name}")
        found.append(Finding("plan-head-turned", what, where=where, fix=fix))
    return found


def given_plan(patient: PatientModel) -> PatientModel:
    """The patient with the findings on a plan that was given in memory, without a case."""
    where = "the plan given in memory"
    parts: list[BonePart] = []
    found: list[Finding] = []
    for segment in patient.segments:
        motion = patient.scene.plan.get(segment.name, np.eye(4))
        if not isinstance(motion, MovedSurface) and motion.shape != (4, 4):
            continue
        if (jaw := jaw_of(segment.name)) is not None:
            parts.append(BonePart(segment.name, jaw, where, segment.surface, motion))
        if not isinstance(motion, MovedSurface):
            sized = SizedMotion(segment.name, motion, segment.surface.vertices)
            found += findings_at(where, check_motion_size(sized))
    found += check_jaws(parts, patient.landmarks.get("skull", {}))
    return patient.with_findings(found)


def untouched(
    case: Case, mesh: TetMesh, kinds: NodeKinds, bones: PlannedBones
) -> tuple[Finding, ...]:
    """A finding for each moved segment that lies beyond the mesh and holds none of its nodes.

    Raises `CaseError`: For one that the case names, or at the mesh: the face would not follow it.
    """
    findings = []
    segments = {segment.name: segment for segment in bones.segments}
    nodes = mesh.nodes
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    for name, motion in bones.motions.items():
        if len(kinds.nodes("joined", name)) or len(kinds.nodes("sliding", name)):
            continue
        if not isinstance(motion, MovedSurface) and np.array_equal(motion, np.eye(4)):
            continue
        vertices = segments[name].surface.vertices
        beside = ((vertices > low) & (vertices < high)).all(axis=1).any()
        what = (
            f"segment {name!r} moves, but no node of the tissue is joined to it or slides on it "
            "(segment-no-tissue)"
        )
        where = case.where(f"plan.{name}")
        fix = (
            "check the cut that creates it, bone_distance in [node_kinds], and the posterior plane"
        )
        if name in case.plan or name in cut_segments(case) or beside:
            raise CaseInputError(f"{where}: {what}: the face would not follow it; {fix}")
        findings.append(
            Finding(
                "segment-no-tissue",
                f"{what}; it is outside the meshed tissue, and the case does not mention it",
                severity="warning",
                where=where,
                fix="if it belongs to the face, widen [region]",
            )
        )
    return tuple(findings)
