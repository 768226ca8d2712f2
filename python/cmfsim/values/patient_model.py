"""The patient's model: what building a case makes, ready to be solved."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import SurfaceMotion
from cmfsim.errors import CaseInputError
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.checks import Floats, Frozen, Indices, listing
from cmfsim.values.finding import Finding, counted_findings
from cmfsim.values.scene import NodeKinds, Scene, SegmentData
from cmfsim.values.skin_motion import SkinEnd, skin_end
from cmfsim.values.surface_data import MovedSurface, SurfaceData, used_nodes
from cmfsim.values.tissue_data import TissueData
from cmfsim.values.touching import LipRegion

Plan = Mapping[str, ArrayLike | MovedSurface]


@dataclass(frozen=True, eq=False)
class LiftedTissue(Frozen):
    """Nodes of the skull near the pieces that were cut off it, where periosteum was lifted.

    Attributes
    ----------
    skull : str
        The segment that the nodes lie on.
    is_joined : bool
        Whether its nodes are joined to it, because it may move itself; otherwise they are fixed.
    pieces : tuple of str
        The segments that were cut off it.
    nodes : (k,) uint32
    piece : (k,) int64
        Place in `pieces` of the one that is nearest to each node.
    places : (k, 3) float64, mm
    normals : (k, 3) float64
        Unit normals out of the skull.
    """

    skull: str
    is_joined: bool
    pieces: tuple[str, ...]
    nodes: Indices
    piece: NDArray[np.int64]
    places: Floats
    normals: Floats

    def without(self, others: Indices) -> LiftedTissue:
        """The same without some nodes, (l,) uint32."""
        kept = ~np.isin(self.nodes, others)
        own = {n: getattr(self, n)[kept] for n in ("nodes", "piece", "places", "normals")}
        return replace(self, **own)

    @property
    def segment(self) -> str | None:
        """The segment that the nodes are joined to; None where they are fixed."""
        return self.skull if self.is_joined else None

    def free(self, plan: Plan) -> Indices:
        """The nodes that the pieces' motions do not press against the skull, (l,) uint32.

        They follow the tissue around them; the others stay on the bone, through which nothing
        moves. At the border between both the motion is along the bone, so that a node that changes
        sides changes little.

        plan: As in `Scene.plan`; what it does not name stays.
        """
        moves = np.zeros_like(self.places)
        for number, name in enumerate(self.pieces):
            own = self.piece == number
            if name in plan and own.any():
                moves[own] = _moves(plan[name], self.places[own])
        if self.skull in plan and self.is_joined:
            moves -= _moves(plan[self.skull], self.places)
        away = np.einsum("ka,ka->k", moves, self.normals)
        found: Indices = self.nodes[away >= 0.0]
        return found

    def held(
        self, fixed: Indices, segments: Mapping[str, SegmentData], plan: Plan
    ) -> tuple[Indices, dict[str, SegmentData]]:
        """The fixed nodes and the segments of a scene under a plan, without the nodes it frees.

        fixed: (f,). Fixed nodes of the scene; whether lifted ones are among them does not matter.
        segments: Of the scene; the same is true of what is joined to them.
        plan: As for `free`.
        """
        made = dict(segments)
        if not self.is_joined:
            return self._without_free(fixed, plan), made
        own, motion = made.get(self.skull), plan.get(self.skull, np.eye(4))
        # Displacements of each joined node belong to these nodes, and to no others.
        if own is not None and (isinstance(motion, MovedSurface) or _is_matrix(motion)):
            made[self.skull] = replace(own, joined=self._without_free(own.joined, plan))
        return fixed, made

    def _without_free(self, others: Indices, plan: Plan) -> Indices:
        all_of = np.union1d(others, self.nodes)
        return np.setdiff1d(all_of, self.free(plan)).astype(np.uint32)


def _moves(motion: ArrayLike | MovedSurface, places: Floats) -> Floats:
    """How a motion moves bone at places, (k, 3) mm."""
    if isinstance(motion, MovedSurface):
        surface = motion.surface.searched
        return SurfaceMotion(surface, motion.moved_vertices).displacement(places)
    values = np.asarray(motion, dtype=np.float64)
    if _is_matrix(values):
        return places @ values[:3, :3].T + values[:3, 3] - places
    return np.broadcast_to(values.mean(axis=0), places.shape)


def _is_matrix(motion: ArrayLike) -> bool:
    return np.asarray(motion).shape == (4, 4)


if TYPE_CHECKING:
    from cmfsim.values.musculature import Musculature


@dataclass(frozen=True, eq=False)
class PatientModel(Frozen):
    """A patient's soft tissue with everything that constrains and moves it.

    Attributes
    ----------
    name : str
    scene : Scene
        Mesh, tissue, node kinds, contact surfaces and plan: what `solve_scene` takes.
    kinds : NodeKinds
    boundary_triangles : (t, 3) uint32
        Boundary of the mesh, outward, in node indices.
    skin_triangles : (s, 3) uint32
        Those of them that are the patient's skin.
    segments : tuple of BoneSegment
        All pieces of bone, including those that do not move.
    anatomy : Anatomy
    fat : TissueData
        The tissue of a homogeneous model; `scene.tissue` where there are no muscles.
    muscles : Musculature or None
        In the patient's frame; None if the case has none.
    fraction : (m,) float64 or None
        Share of muscle in each tet, blurred as the case states.
    fibre : (m, 3) float64 or None
        Unit direction of the fibres of each tet; zero where there is no muscle.
    landmarks : mapping of str to mapping of str to (3,) float64, mm
        "skull" and "skin", where given or found (`landmarks_are_found`).
    lifted : LiftedTissue or None
        Nodes lifted off the skull next to a Le Fort cut; `scene` holds those on the bone that the
        plan presses against it.
    lips : mapping of str to LipRegion
        "upper" and "lower", where the mesh was separated between them.
    findings : tuple of Finding
        What every stage noticed.
    summary : mapping
        Counts, quality, timings, versions, hashes of the inputs: plain values, ready for JSON.
    detailed_skin : callable or None
        Makes the skin of `face` if no surface of it was given.
    face_colours : (v, 3) uint8 or None
        Red, green, blue of the vertices of `face`, from the 3D photo of the case.
    """

    name: str
    scene: Scene
    kinds: NodeKinds
    boundary_triangles: Indices
    skin_triangles: Indices
    segments: tuple[BoneSegment, ...]
    anatomy: Anatomy
    fat: TissueData
    muscles: Musculature | None = None
    fraction: Floats | None = None
    fibre: Floats | None = None
    landmarks: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)
    lifted: LiftedTissue | None = None
    lips: Mapping[str, LipRegion] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    summary: Mapping[str, Any] = field(default_factory=dict)
    detailed_skin: Callable[[], SurfaceData | None] | None = None
    face_colours: NDArray[np.uint8] | None = None

    def __repr__(self) -> str:
        """Name, mesh, anatomy, plan and what was found."""
        places = [f"{len(sites)} of the {part}" for part, sites in self.landmarks.items() if sites]
        how = " (found automatically)" if places and self.landmarks_are_found else ""
        rows = {
            "mesh": f"{self.scene.n_nodes} nodes, {self.scene.n_tets} tets",
            "segments": ", ".join(segment.name for segment in self.segments),
            "muscles": f"{len(self.muscles)}" if self.muscles is not None else "none",
            "landmarks": f"{', '.join(places) or 'none'}{how}",
            "plan": self.scene.plan_text(),
            "findings": counted_findings(self.findings),
        }
        return listing(f"PatientModel {self.name!r}", rows)

    @property
    def landmarks_are_found(self) -> bool:
        """Whether the landmarks were found automatically: the case names none."""
        return "landmarks" in self.summary

    @cached_property
    def skin_nodes(self) -> NDArray[np.uint32]:
        """The nodes on the skin, (k,) uint32, ascending: vertex i of `skin` is node i of these."""
        return used_nodes(self.skin_triangles)[0].astype(np.uint32)

    @cached_property
    def skin(self) -> SurfaceData:
        """The patient's skin as the mesh has it, outward."""
        nodes, triangles = used_nodes(self.skin_triangles)
        return SurfaceData(self.scene.nodes[nodes], triangles)

    @cached_property
    def skin_end(self) -> SkinEnd:
        """The skin next to the planes on which the tissue ends, and what it is continued from."""
        on_plane = self.kinds.nodes("fixed")
        on_plane = on_plane[np.asarray(self.kinds.segment)[on_plane] < 0]
        return skin_end(self.skin, np.isin(self.skin_nodes, on_plane))

    def skin_field(self, values: Floats) -> Floats:
        """What vertices of `skin` have of a field of all nodes, (n, …): `skin_end` is continued."""
        return self.skin_end.continued(values[self.skin_nodes])

    def with_plan(self, plan: Mapping[str, ArrayLike | MovedSurface]) -> PatientModel:
        """The patient under another plan; segments that are not named stay.

        Neither mesh nor node kinds depend on how far segments move, so nothing is built again. What
        is lifted off the bone next to a Le Fort cut follows the plan.

        Parameters
        ----------
        plan : mapping of str to (4, 4) float64, mm, (j, 3) float64, mm, or MovedSurface

        Raises
        ------
        CaseError
            (also `ValueError`) A segment that the patient does not have; a misshapen motion.
        """
        unknown = [name for name in plan if name not in self.scene.segments]
        if unknown:
            known = ", ".join(self.scene.segments) or "none"
            raise CaseInputError(f"the plan moves {unknown[0]!r}; segments are: {known}")
        motions = {name: plan.get(name, np.eye(4)) for name in self.scene.segments}
        # What is known of the case's own motions says nothing of these.
        findings = tuple(f for f in self.findings if not f.code.startswith("plan-"))
        own = {"achieved", "plan_fits", "plan_sources"}
        summary = {k: v for k, v in self.summary.items() if k not in own}
        summary["findings"] = [
            entry
            for entry in summary.get("findings", ())
            if not str(entry.get("code", "")).startswith("plan-")
        ]
        fixed, segments = self.scene.fixed, dict(self.scene.segments)
        if self.lifted is not None:
            fixed, segments = self.lifted.held(fixed, segments, motions)
        # `replace` is typed by the fields; the scene converts what it is given.
        plan_given = cast("Mapping[str, Floats | MovedSurface]", motions)
        scene = replace(self.scene, plan=plan_given, fixed=fixed, segments=segments)
        return replace(self, scene=scene, findings=findings, summary=summary)

    def with_findings(self, found: Sequence[Finding]) -> PatientModel:
        """The patient with more findings, after its own."""
        findings = [*self.summary.get("findings", ()), *map(asdict, found)]
        summary = {**self.summary, "findings": findings}
        return replace(self, findings=(*self.findings, *found), summary=summary)

    @property
    def planned_bones(self) -> dict[str, tuple[SurfaceData, Floats]]:
        """Each bone segment with its vertices after the operation, (v, 3) mm, by name.

        A segment whose motion is known vertex by vertex has the surface on which it is known; a
        segment of which only the joined nodes have motions stays where it was.
        """
        found = {}
        for segment in self.segments:
            surface, motion = segment.surface, self.scene.plan.get(segment.name)
            vertices = surface.vertices
            if isinstance(motion, MovedSurface):
                surface = motion.surface
                vertices = motion.moved_vertices
            elif motion is not None and motion.shape == (4, 4) and (motion != np.eye(4)).any():
                vertices = vertices @ motion[:3, :3].T + motion[:3, 3]
            found[segment.name] = (surface, vertices)
        return found

    def segment_vertices(self, name: str) -> Floats:
        """The vertices that state a segment's motion, (v, 3) mm: of a given bone that is not cut.

        The surface of a segment itself is as coarse as its voxels.
        """
        given = None if self.summary.get("osteotomies") else self.anatomy.surfaces.get(name)
        found = given or next(s.surface for s in self.segments if s.name == name)
        return found.vertices

    @cached_property
    def face(self) -> SurfaceData | None:
        """The skin of the whole head in full detail, as it was given or as the image shows it.

        Tets are larger than visible details of lips and lids. None if scikit-image is missing. The
        skin of an image is extracted on first use, because solving does not need it.
        """
        given = self.anatomy.surfaces.get("skin")
        if given is not None or self.detailed_skin is None:
            return given
        return self.detailed_skin()
