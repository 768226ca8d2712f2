"""A virtual patient's true face: mesh, tissue, equilibrium, and skin as a scanner sees it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, TetMesh
from cmfsim.errors import CaseInputError, third_party
from cmfsim.io import Case
from cmfsim.lab.virtual.mechanics.body import (
    FAT,
    MUSCLE,
    HyperelasticBody,
    HyperelasticTissue,
    Moduli,
    SkinLayer,
)
from cmfsim.lab.virtual.mechanics.equilibrium import (
    Contact,
    Equilibrium,
    EquilibriumOptions,
    find_equilibrium,
)
from cmfsim.lab.virtual.mechanics.lip_contact import LipContact, MouthSlit, lips_of, with_open_mouth
from cmfsim.lab.virtual.mechanics.muscle_field import muscle_field, skin_share, thickened
from cmfsim.lab.virtual.operation import (
    Operation,
    bone_distances,
    node_areas,
    operate,
    without_bite,
    without_gaps,
)
from cmfsim.lab.virtual.population import TrueTissue, VirtualPatient
from cmfsim.phantom.model import PhantomHead
from cmfsim.pipeline.building.case_model import build_model, kind_options_of
from cmfsim.surfaces.depth import moved_outward, tissue_depth
from cmfsim.surfaces.topology import tet_bodies
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats, as_index_rows, as_positive, as_rows
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import rigid_motion
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.progress import Progress, no_progress
from cmfsim.values.scene import NodeKinds
from cmfsim.values.surface_data import SurfaceData, used_nodes

# Where the sum of the distances to both tooth rows is less than the gap of the bite plus this, mm,
# there is no tissue.
BEYOND_BITE = 1.5
# The same if the mouth is open, and nothing else is removed from between the jaws, mm.
BEYOND_OPEN_BITE = 4.0
# Tissue is fixed from this height above the nasion, mm: no jaw surgery moves the skin there.
ABOVE_NASION = 20.0
# Steps in which the bones move if the lips may touch.
STEPS_WITH_LIPS = 6
# Depth to which tissue swells or shrinks, mm: deeper lie cartilage, eye, muscle and airway.
MOST_SWELLING = 12.0
# Nodes within this distance from the skin lie on it, mm.
NEAR_SKIN = 0.5
# Poisson's ratio of a layer of skin: mostly water, as far as linear tets allow.
SKIN_POISSON = 0.46
# How deep the zone is in which tissue slides, front and side of either jaw.
ZONE = ("upper_front", "upper_molars", "lower_front", "lower_molars")


@dataclass(frozen=True, eq=False)
class PostoperativeTruth:
    """A virtual patient after the operation, without scanner noise.

    nodes, tets, displacements: The true mesh at rest, and how it moves, (n, 3) mm.
    fraction, fibre: (m,) and (m, 3), of muscle, true.
    skin_before, skin: The whole head's skin before and after, vertex by vertex.
    skin_landmarks, skull_landmarks: After the operation; `segments` are those before it.
    motions: (4, 4), mm. Actual motion of every segment: the plan plus the patient's departures from
        it; the identity for segments that do not move.
    volume_ratios: (m,). Ratio of each tet's volume after the operation to that before.
    last_step: mm. Largest motion of the skin in the last Newton iteration.
    lips: The contact of the lips, if they are separate.
    """

    nodes: Floats
    tets: NDArray[np.uint32]
    displacements: Floats
    fraction: Floats
    fibre: Floats
    skin_before: SurfaceData
    skin: SurfaceData
    skin_landmarks: Mapping[str, Floats]
    skull_landmarks: Mapping[str, Floats]
    segments: Mapping[str, BoneSegment]
    motions: Mapping[str, Floats]
    equilibrium: Equilibrium
    operation: Operation
    volume_ratios: Floats
    last_step: float
    lips: LipContact | None = None

    @property
    def penetration(self) -> float:
        """Largest depth of a node inside a bone, mm."""
        depths = self.operation.contact.depths(self.displacements, 1.0)
        return max((float(depth.max(initial=0.0)) for depth in depths.values()), default=0.0)


def postoperative_truth(  # noqa: PLR0913 (options by name)
    patient: VirtualPatient,
    head: PhantomHead,
    case: Case,
    *,
    edge_length: float = 6.0,
    refine: bool = False,
    grid: float = 1.5,
    skin_spacing: float = 2.0,
    options: EquilibriumOptions | None = None,
    progress: Progress | None = None,
) -> PostoperativeTruth:
    """The face after the operation of a case, computed independently of the models under test.

    Bones are cut and moved according to the case, plus the patient's departures from the plan.
    Everything else belongs to the virtual patient: anatomy from level functions instead of a
    segmented CT, a separate mesh, the true muscles, hyperelastic tissue under large strain, contact
    that pushes and never pulls, periosteum stripped at the cuts, no tissue between the tooth rows,
    and skin that swells.

    case: Its osteotomies, plan and landmarks are used; its image is not read.
    refine: Whether tets are smaller where tissue is thin; always so if the lips are separate.
    grid, skin_spacing: mm, of the level images that the mesh is made from, and of the skin's cubes.
    options: By default, `STEPS_WITH_LIPS` steps if the lips are separate.
    """
    stage = progress or no_progress
    separate = patient.separate_lips
    if options is None and separate:
        options = EquilibriumOptions(steps=STEPS_WITH_LIPS)
    fine = _true_case(case, head, patient.tissue, edge_length, refine=refine or separate)
    stage("drawing the true anatomy")
    drawn = _drawn(head, as_positive("grid", grid), separate_lips=separate)
    model = build_model(fine, progress=progress, check=False, anatomy=drawn.anatomy)
    segments = {segment.name: segment for segment in model.segments}
    motions = {name: _departure(patient, head, name) @ _motion(case, name) for name in segments}

    stage("opening bite and cuts")
    distances = bone_distances(model.scene.nodes, segments)
    opened = _opened(model, drawn, distances, motions)
    nodes, tets = opened.nodes, opened.tets

    stage("placing the true muscles")
    depth = drawn.anatomy.skin.sample(nodes)
    fraction, fibre, tissue = _tissue(patient, head, nodes, tets, np.maximum(depth, 0.0))

    stage("moving the bones")
    body = HyperelasticBody(nodes, tets, tissue)
    operation, lips = _operated(opened, drawn.slit, distances, segments, motions)
    contacts: list[Contact] = [operation.contact, *([] if lips is None else [lips])]
    found = find_equilibrium(body, operation.held, operation.path, contacts, options)

    stage("moving the skin")
    before = head.surface("skin", skin_spacing)
    after, landmarks = _moved_skin(patient, head, opened, found.displacements, before, segments)
    return PostoperativeTruth(
        nodes=nodes,
        tets=tets,
        displacements=found.displacements,
        fraction=fraction,
        fibre=fibre,
        skin_before=before,
        skin=SurfaceData(after, before.triangles),
        skin_landmarks=landmarks,
        skull_landmarks=_moved_sites(head.skull_landmarks, segments, motions),
        segments=segments,
        motions=motions,
        equilibrium=found,
        operation=operation,
        volume_ratios=body.volume_ratios(found.displacements),
        last_step=float(np.linalg.norm(found.last_step[np.abs(depth) < NEAR_SKIN], axis=1).max()),
        lips=lips,
    )


def _tissue(
    patient: VirtualPatient,
    head: PhantomHead,
    nodes: Floats,
    tets: NDArray[np.uint32],
    depth: Floats,
) -> tuple[Floats, Floats, HyperelasticTissue]:
    """Muscle fraction (m,), fibre (m, 3) and law of the person's tissue."""
    own = patient.tissue
    present = {name: muscle for name, muscle in head.muscles.items() if name not in own.absent}
    muscles = thickened(present, patient.muscle_thickness)
    offsets = {name: offset for name, offset in own.offsets.items() if name in muscles}
    fraction, fibre = muscle_field(head, muscles, nodes, tets, depth, offsets=offsets)
    muscle = MUSCLE
    if own.muscle_young is not None:
        muscle = replace(MUSCLE, young_along=own.muscle_young[0], young_across=own.muscle_young[1])
    skin = None
    if own.skin_thickness > 0.0:
        moduli = Moduli(own.skin_young, own.skin_young, SKIN_POISSON)
        skin = SkinLayer(moduli, skin_share(nodes, tets, depth, own.skin_thickness))
    law = HyperelasticTissue.mixed(
        fraction,
        fibre,
        stiffness=patient.muscle_stiffness,
        muscle=muscle,
        fat=replace(FAT, poisson=own.fat_poisson),
        skin=skin,
    )
    return fraction, fibre, law


def _true_case(
    case: Case, head: PhantomHead, tissue: TrueTissue, edge_length: float, *, refine: bool
) -> Case:
    """The case from which the true model is built: no muscles, nothing after the operation."""
    options = kind_options_of(case)
    zone = {name: getattr(options, name) + tissue.vestibule for name in ZONE}
    kinds = {**case.node_kinds, **zone, "contact_surface": tissue.slides_on}
    return replace(
        case,
        region=replace(case.region, upper=float(head.skull_landmarks["nasion"][2]) + ABOVE_NASION),
        mesh=replace(case.mesh, edge_length=as_positive("edge_length", edge_length), refine=refine),
        # The operation itself strips tissue off the bone, by how far the sides of a cut move apart.
        node_kinds=dict(kinds, lifted=0.0, septum=False),
        muscles=None,
        postoperative=None,
    )


@dataclass(frozen=True, eq=False)
class _Drawn:
    """The head's true anatomy; its mouth is open where the lips are separate."""

    anatomy: Anatomy
    # Gap between the tooth rows without tissue, mm.
    bite: float
    slit: MouthSlit | None


def _drawn(head: PhantomHead, grid: float, *, separate_lips: bool) -> _Drawn:
    anatomy = head.anatomy(grid)
    bite = head.parameters.bite_gap * head.parameters.scale + BEYOND_BITE
    if not separate_lips:
        return _Drawn(anatomy, bite, None)
    bite += BEYOND_OPEN_BITE - BEYOND_BITE
    return _Drawn(with_open_mouth(head, anatomy, bite), bite, MouthSlit(head))


def _operated(
    tissue: "_Opened",
    slit: MouthSlit | None,
    distances: Mapping[str, ImageData],
    segments: Mapping[str, BoneSegment],
    motions: Mapping[str, Floats],
) -> tuple[Operation, LipContact | None]:
    """The operation on the tissue, and the contact of the lips where they are separate."""
    nodes, tets = tissue.nodes, tissue.tets
    boundary = TetMesh(nodes, tets).boundary_triangles()
    lips, bared = None, tissue.bared
    if slit is not None:
        lips = LipContact(nodes, *lips_of(slit, nodes, boundary, node_areas(nodes, boundary)))
        bared = np.union1d(bared, np.concatenate([lips.upper.nodes, lips.lower.nodes]))
    operation = operate(
        nodes,
        tets,
        boundary,
        tissue.kinds,
        distances=distances,
        centres={name: s.surface.vertices.mean(axis=0) for name, s in segments.items()},
        plan=motions,
        bared=bared,
    )
    return operation, lips


def _moved_skin(  # noqa: PLR0917 (who, and what was done)
    patient: VirtualPatient,
    head: PhantomHead,
    tissue: "_Opened",
    displacements: Floats,
    before: SurfaceData,
    segments: Mapping[str, BoneSegment],
) -> tuple[Floats, dict[str, Floats]]:
    """Vertices and landmarks of the skin after the operation, carried by the tissue and swollen."""
    places, names = before.vertices, list(head.skin_landmarks)
    points = np.array([head.skin_landmarks[name] for name in names])
    after = places + carried(places, tissue.nodes, tissue.tets, displacements)
    moved = points + carried(points, tissue.nodes, tissue.tets, displacements)
    if patient.thickness_change:
        outward = _outward(patient, before, after, segments)
        spatial = third_party("scipy.spatial", "virtual patients are made", "study")
        nearest = spatial.cKDTree(places).query(points)[1]
        after, moved = after + outward, moved + outward[nearest]
    return after, dict(zip(names, moved, strict=True))


def _motion(case: Case, segment: str) -> Floats:
    motion = case.plan.get(segment)
    if motion is None:
        return np.eye(4)
    if motion.matrix is None:
        raise CaseInputError(
            f"{case.where(f'plan.{segment}')}: a rigid motion in numbers is needed"
        )
    return motion.matrix


def _departure(patient: VirtualPatient, head: PhantomHead, segment: str) -> Floats:
    """The motion by which the operation departs from the plan of a segment, (4, 4) mm."""
    error = patient.departures.get(segment)
    if error is None:
        return np.eye(4)
    centre = head.skull_landmarks[error.centre]
    return rigid_motion(error.translation, error.angle, error.axis, centre)


def _outward(
    patient: VirtualPatient, before: SurfaceData, after: Floats, segments: Mapping[str, BoneSegment]
) -> Floats:
    """Swelling of each vertex of the skin: outward by a share of the tissue's depth, (v, 3) mm."""
    depth = tissue_depth(before.vertices, [segment.surface for segment in segments.values()])
    depth = np.minimum(depth, MOST_SWELLING)
    skin = Surface(before.vertices, before.triangles)
    return moved_outward(skin, after, patient.thickness_change * depth) - after


@dataclass(frozen=True, eq=False)
class _Opened:
    """The tissue that remains when bite and gaps are open."""

    nodes: Floats
    tets: NDArray[np.uint32]
    kinds: NodeKinds
    bared: NDArray[np.int64]


def _opened(
    model: PatientModel,
    drawn: _Drawn,
    distances: Mapping[str, ImageData],
    motions: Mapping[str, Floats],
) -> _Opened:
    """The largest body without tissue between separated bones and, in a shut mouth, tooth rows."""
    nodes, tets, open_mouth = model.scene.nodes, model.scene.tets, drawn.slit is not None
    upper = next((name for name in ("maxilla", "cranium") if name in distances), None)
    lower = next((name for name in ("mandible_body", "mandible") if name in distances), None)
    jaws = tuple(name for name in (upper, lower) if name is not None)
    kept = without_gaps(nodes, tets, distances, motions, jaws if open_mouth else ())
    if upper is not None and lower is not None and not open_mouth:
        kept &= without_bite(nodes, tets, distances[upper], distances[lower], drawn.bite)
    bared = np.zeros(len(nodes), dtype=bool)
    bared[tets[~kept]] = True
    tets = tets[kept]
    used, left = used_nodes(tets[largest_body(tets)])
    kinds = model.kinds.of_nodes(used)
    return _Opened(nodes[used], left.astype(np.uint32), kinds, np.flatnonzero(bared[used]))


def largest_body(tets: NDArray[Any]) -> NDArray[np.bool_]:
    """Which tets (m, 4) belong to the largest body connected through faces, (m,).

    A flap attached by a single edge or node would move without resistance.
    """
    body = tet_bodies(tets)
    largest: NDArray[np.bool_] = body == np.argmax(np.bincount(body))
    return largest


def _moved_sites(
    sites: Mapping[str, Floats], segments: Mapping[str, BoneSegment], motions: Mapping[str, Floats]
) -> dict[str, Floats]:
    """Bone landmarks, each moved with the segment in which it lies deepest."""
    points = np.array(list(sites.values()))
    names = list(segments)
    levels = np.array([segments[name].level.sample(points) for name in names])
    moved = {}
    for label, point, owner in zip(sites, points, levels.argmax(axis=0), strict=True):
        matrix = motions[names[owner]]
        moved[label] = matrix[:3, :3] @ point + matrix[:3, 3]
    return moved


# Tets whose middles lie nearest to a point are tried for it.
CANDIDATES = 24
# Rounds of averaging over neighbours that give smooth noise its length: about 4 edges.
SMOOTHING = 12


def carried(
    points: ArrayLike, nodes: ArrayLike, tets: ArrayLike, displacements: ArrayLike
) -> Floats:
    """The displacements (k, 3) mm of points (k, 3) in or just outside a deformed mesh.

    A point takes the linear field of the tet that holds it; a point outside that of the tet it is
    least outside of, with its weights cut to 0…1, so that nothing is carried beyond the mesh.
    """
    places = as_rows("points", points, 3)
    corners = as_rows("nodes", nodes, 3)
    moves = as_rows("displacements", displacements, 3)
    rows = as_index_rows("tets", tets, 4, len(corners), "nodes").astype(np.int64)
    spatial = third_party("scipy.spatial", "skins of virtual patients are made", "study")
    tree = spatial.cKDTree(corners[rows].mean(axis=1))
    count = min(CANDIDATES, len(rows))
    near = tree.query(places, k=count)[1].reshape(len(places), count)
    best = np.full(len(places), -np.inf)
    weights = np.zeros((len(places), 4))
    home = np.zeros(len(places), dtype=np.int64)
    for tets_tried in near.T:
        lost = np.flatnonzero(best < 0.0)
        tet = tets_tried[lost]
        base = corners[rows[tet]]
        edges = (base[:, 1:] - base[:, :1]).transpose(0, 2, 1)
        rest = np.linalg.solve(edges, (places[lost] - base[:, 0])[..., None])[..., 0]
        inside = np.column_stack([1.0 - rest.sum(axis=1), rest])
        least = inside.min(axis=1)
        better = least > best[lost]
        at = lost[better]
        best[at], weights[at], home[at] = least[better], inside[better], tet[better]
    weights = np.clip(weights, 0.0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    moved: Floats = np.einsum("kc,kci->ki", weights, moves[rows[home]])
    return moved


def scanned(
    surface: SurfaceData, *, white: float, smooth: float, seed: int | list[int]
) -> SurfaceData:
    """The surface as a scanner would give it: vertices off along their normals.

    white, smooth: mm. Standard deviations of the noise that is new at each vertex, and of the noise
        that changes over a few edges (waves of the reconstruction).
    """
    vertices, triangles = surface.vertices, surface.triangles
    generator = np.random.default_rng(seed)
    offset = white * generator.standard_normal(len(vertices))
    wave = generator.standard_normal(len(vertices))
    average = _averaging(triangles, len(vertices))
    for _ in range(SMOOTHING):
        wave = average @ wave
    offset += smooth * wave / max(float(wave.std()), np.finfo(np.float64).tiny)
    return SurfaceData(vertices + offset[:, None] * _normals(vertices, triangles), triangles)


def _averaging(triangles: NDArray[Any], n: int) -> Any:
    """The matrix that takes the mean over each vertex and its neighbours."""
    sparse = third_party("scipy.sparse", "skins of virtual patients are made", "study")
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    ones = np.ones(len(ends))
    near = sparse.coo_array((ones, (ends[:, 0], ends[:, 1])), shape=(n, n)).tocsr()
    near = near + near.T + sparse.eye_array(n)
    return sparse.diags_array(1.0 / near.sum(axis=1)) @ near


def _normals(vertices: Floats, triangles: NDArray[Any]) -> Floats:
    """Unit normals of the vertices, weighted by the area of the triangles about each."""
    corners = vertices[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, triangles[:, corner], area)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals: Floats = total / np.maximum(length, np.finfo(np.float64).tiny)
    return normals
