"""Scenes and their results.

A `Scene` is everything that one solve needs. Checks here are of shape, range and name, with the
index and value at fault; what geometry and physics forbid (inverted tets, indefinite materials,
bodies that are not held) the core finds when the scene is solved.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values import checks
from cmfsim.values.motion import carried, rigid_matrix
from cmfsim.values.solver_options import SolverOptions
from cmfsim.values.surface_data import MovedSurface, SurfaceData
from cmfsim.values.tissue_data import TissueData
from cmfsim.values.touching import ObstacleData, TouchingData

CONFLICTS = ("error", "resolve")
DEFAULT_OPTIONS = SolverOptions()
# Kinds of node (paper 2.5), by the number that files hold.
NODE_KINDS = ("free", "fixed", "joined", "sliding")


@dataclass(frozen=True, eq=False)
class NodeKinds(checks.Frozen):
    """The kind of each node of a mesh (paper 2.5, Figure 4).

    Attributes
    ----------
    kind : (n,) uint8
        0 free, 1 fixed, 2 joined, 3 sliding: the order of `NODE_KINDS` in scene files.
    segment : (n,) int16
        Index into `segments` of the nodes that lie on a segment: joined, sliding, and those that
        are fixed on bone; −1 elsewhere.
    segments : tuple of str
    """

    kind: NDArray[np.uint8]
    segment: NDArray[np.int16]
    segments: tuple[str, ...]

    def __post_init__(self) -> None:
        kind = np.asarray(self.kind, dtype=np.uint8)
        segment = np.asarray(self.segment, dtype=np.int16)
        if kind.ndim != 1 or segment.shape != kind.shape:
            raise CaseInputError(f"kind has shape {kind.shape}, segment {segment.shape}: (n,) both")
        bad = np.flatnonzero((kind > 3) | ((kind >= 2) & (segment < 0)))
        if len(bad) or (segment >= len(self.segments)).any():
            raise CaseInputError("kind is 0 to 3, and joined and sliding nodes need a segment")
        checks.keep(self, kind=checks.frozen(kind), segment=checks.frozen(segment))

    def of_nodes(self, nodes: NDArray[np.integer]) -> "NodeKinds":
        """The kinds of some nodes, in their order: of the mesh that has only these."""
        return NodeKinds(self.kind[nodes], self.segment[nodes], self.segments)

    def nodes(self, kind: str, segment: str | None = None) -> NDArray[np.uint32]:
        """The indices of the nodes of a kind ("free", "fixed", "joined", "sliding")."""
        checks.check_one_of("kind", kind, NODE_KINDS)
        chosen = self.kind == NODE_KINDS.index(kind)
        if segment is not None:
            checks.check_one_of("segment", segment, self.segments)
            chosen &= self.segment == self.segments.index(segment)
        return np.flatnonzero(chosen).astype(np.uint32)


@dataclass(frozen=True, eq=False)
class SegmentData(checks.Frozen):
    """A bone segment: the nodes that it carries and the surface that others slide on.

    Attributes
    ----------
    joined : (j,) uint32
        Nodes that move with the segment.
    sliding : (s,) uint32
        Nodes that slide on `contact`.
    contact : SurfaceData or None
        Contact surface (teeth, mucosa) at rest; it moves with the segment.
    gap : (s,) float64, mm, or float, or "rest"
        Distance that each sliding node keeps from the surface, negative behind it; "rest", the
        default, keeps its offset from it in the undeformed tissue, carried by the segment.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.SegmentData(joined=[0, 4, 7]).joined.tolist()
    [0, 4, 7]
    """

    joined: checks.Indices
    sliding: checks.Indices
    contact: SurfaceData | None
    gap: checks.Floats | str

    def __init__(
        self,
        joined: ArrayLike = (),
        sliding: ArrayLike = (),
        contact: SurfaceData | None = None,
        gap: ArrayLike | str = "rest",
    ) -> None:
        held, slides = checks.as_indices("joined", joined), checks.as_indices("sliding", sliding)
        if contact is not None:
            checks.check_instance("contact", contact, SurfaceData)
        if isinstance(gap, str):
            checks.check_one_of("gap", gap, ("rest",))
        else:
            gap = checks.frozen(checks.as_floats("gap", gap))
            if gap.shape not in {(), (len(slides),)}:
                raise CaseInputError(
                    f"gap has shape {gap.shape}: one number or {len(slides)} (one per sliding node)"
                )
        checks.keep(self, joined=held, sliding=slides, contact=contact, gap=gap)


@dataclass(frozen=True, eq=False)
class Scene(checks.Frozen):
    """Everything that one solve needs: mesh, tissue, node kinds, plan and options.

    Attributes
    ----------
    nodes : (n, 3) float64, mm
    tets : (m, 4) uint32
        Positively oriented.
    tissue : TissueData
    segments : mapping of str to SegmentData
        Order is kept.
    plan : mapping of str to (4, 4) float64, (j, 3) float64 or MovedSurface
        One entry for every segment: a rigid motion (mm; kept as `rigid_matrix` makes it exactly
        rigid), the displacements of its joined nodes (mm), or a surface before and after.
    fixed : (f,) uint32
        Nodes that do not move.
    loads : (n, 3) float64, N, or None
        Forces on the nodes.
    options : SolverOptions
    conflicts : str
        "error", or "resolve": fixed wins over joined, joined over sliding.
    touching : tuple of TouchingData
        Tissue that may not enter other tissue.
    obstacles : tuple of ObstacleData
        Tissue that may not enter segments.

    Raises
    ------
    CaseError
        (also `ValueError`) Misshapen or non-finite arrays, indices out of range, a plan that lacks
        a segment or names another one.
    BoundaryError
        (also `ValueError`) A (4, 4) plan that is not rigid.

    Examples
    --------
    >>> import cmfsim
    >>> scene = cmfsim.Scene(
    ...     nodes=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ...     tets=[[0, 1, 2, 3]],
    ...     tissue=cmfsim.TissueData("isotropic", young=1.0, poisson=0.3),
    ...     fixed=[0, 1, 2],
    ...     segments={"tip": cmfsim.SegmentData(joined=[3])},
    ...     plan={"tip": cmfsim.rigid_motion(translation=(0, 0, 0.1))},
    ... )
    >>> scene.n_nodes, scene.n_tets
    (4, 1)
    """

    nodes: checks.Floats
    tets: checks.Indices
    tissue: TissueData
    segments: Mapping[str, SegmentData]
    plan: Mapping[str, checks.Floats | MovedSurface]
    fixed: checks.Indices
    loads: checks.Floats | None
    options: SolverOptions
    conflicts: str
    touching: tuple[TouchingData, ...]
    obstacles: tuple[ObstacleData, ...]

    def __init__(  # noqa: PLR0913, PLR0917 (one for each field)
        self,
        nodes: ArrayLike,
        tets: ArrayLike,
        tissue: TissueData,
        segments: Mapping[str, SegmentData] = MappingProxyType({}),
        plan: Mapping[str, ArrayLike | MovedSurface] = MappingProxyType({}),
        fixed: ArrayLike = (),
        loads: ArrayLike | None = None,
        options: SolverOptions = DEFAULT_OPTIONS,
        conflicts: str = "error",
        touching: Iterable[TouchingData] = (),
        obstacles: Iterable[ObstacleData] = (),
    ) -> None:
        places = checks.as_rows("nodes", nodes, 3)
        corners = checks.as_index_rows("tets", tets, 4, len(places), "nodes")
        held = checks.as_indices("fixed", fixed, len(places))
        for name, value, kind in (
            ("tissue", tissue, TissueData),
            ("segments", segments, Mapping),
            ("plan", plan, Mapping),
            ("options", options, SolverOptions),
        ):
            checks.check_instance(name, value, kind)
        keep = partial(checks.keep, self)
        keep(nodes=places, tets=corners, fixed=held)
        keep(tissue=tissue, segments=segments, options=options)
        self._check_parts()
        if loads is not None:
            loads = checks.as_rows("loads", loads, 3)
            if len(loads) != self.n_nodes:
                raise CaseInputError(f"loads has {len(loads)} rows for {self.n_nodes} nodes")
        checks.check_one_of("conflicts", conflicts, CONFLICTS)
        keep(loads=loads, conflicts=conflicts, plan=self._checked_plan(plan))
        keep(touching=tuple(touching), obstacles=tuple(obstacles))
        self._check_contact()

    def _check_parts(self) -> None:
        """Tissue with a row for each tet, segments of nodes that there are."""
        for name, array in self.tissue.arrays().items():
            if len(array) not in {1, self.n_tets}:
                raise CaseInputError(
                    f"tissue {name} has {len(array)} rows: 1 or {self.n_tets} (one per tet) needed"
                )
        for name, segment in self.segments.items():
            checks.as_text("segment name", name)
            checks.check_instance(f"segment {name!r}", segment, SegmentData)
            for kind in ("joined", "sliding"):
                checks.as_indices(f"segment {name!r} {kind}", getattr(segment, kind), self.n_nodes)

    def _check_contact(self) -> None:
        """One-sided contact: nodes of the mesh, and segments that there are."""
        count = self.n_nodes
        for number, touch in enumerate(self.touching):
            name = f"touching[{number}]"
            checks.check_instance(name, touch, TouchingData)
            checks.as_indices(f"{name} nodes", touch.nodes, count)
            checks.as_index_rows(f"{name} triangles", touch.triangles, 3, count, "nodes")
        for number, obstacle in enumerate(self.obstacles):
            checks.check_instance(f"obstacles[{number}]", obstacle, ObstacleData)
            checks.as_indices(f"obstacles[{number}] nodes", obstacle.nodes, count)
            if obstacle.segment not in self.segments:
                known = ", ".join(repr(s) for s in self.segments) or "none"
                raise CaseInputError(
                    f"obstacles[{number}] is of segment {obstacle.segment!r}; segments are: {known}"
                )

    def _checked_plan(
        self, plan: Mapping[str, ArrayLike | MovedSurface]
    ) -> dict[str, checks.Floats | MovedSurface]:
        for name in plan:
            if name not in self.segments:
                known = ", ".join(repr(s) for s in self.segments) or "none"
                raise CaseInputError(f"plan names segment {name!r}; segments are: {known}")
        checked: dict[str, checks.Floats | MovedSurface] = {}
        for name, segment in self.segments.items():
            if name not in plan:
                raise CaseInputError(
                    f"plan lacks segment {name!r}: give the identity matrix if it does not move"
                )
            motion = plan[name]
            if isinstance(motion, MovedSurface):
                checked[name] = motion
                continue
            array = checks.as_floats(f"plan of segment {name!r}", motion)
            joined = len(segment.joined)
            if array.shape not in {(4, 4), (joined, 3)}:
                raise CaseInputError(
                    f"plan of segment {name!r} has shape {array.shape}: a (4, 4) matrix or "
                    f"({joined}, 3) displacements of its joined nodes are needed"
                )
            if array.shape == (4, 4):
                array = rigid_matrix(array, f"plan of segment {name!r}")
            checked[name] = checks.frozen(array)
        return checked

    def __repr__(self) -> str:
        """Sizes, segments and how far each moves."""
        segments = [
            f"{name} ({len(s.joined)} joined, {len(s.sliding)} sliding)"
            for name, s in self.segments.items()
        ]
        uniform = all(len(array) == 1 for array in self.tissue.arrays().values())
        options, law = self.options, self.tissue.preset or self.tissue.kind
        rows = {
            "mesh": f"{self.n_nodes} nodes, {self.n_tets} tets",
            "tissue": f"{law}, {'one for all tets' if uniform else 'one for each tet'}",
            "segments": ", ".join(segments),
            "fixed": f"{len(self.fixed)} nodes",
            "plan": self.plan_text(),
            "solver": f"{options.method}, {options.kinematics}, element {options.element}",
        }
        return checks.listing("Scene", rows)

    def plan_text(self) -> str:
        """How far each segment moves at most, in words."""
        return ", ".join(f"{name} {self._moved(name)}" for name in self.segments)

    def _moved(self, name: str) -> str:
        """How far the nodes on a segment move with it, in words."""
        motion, segment = self.plan[name], self.segments[name]
        if isinstance(motion, MovedSurface):
            steps = motion.moved_vertices - motion.surface.vertices
        elif motion.shape == (4, 4):
            steps = carried(motion, self.nodes) - self.nodes
            steps = steps[np.concatenate([segment.joined, segment.sliding])]
        else:
            steps = motion
        far = float(np.linalg.norm(steps, axis=1).max(initial=0.0))
        return f"moves up to {far:.1f} mm" if far else "stays"

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.nodes)

    @property
    def n_tets(self) -> int:
        """Number of tets."""
        return len(self.tets)

    def header(self) -> dict[str, Any]:
        """Names, kinds and options of the scene: everything except arrays, ready for JSON."""
        segments = []
        for name, segment in self.segments.items():
            entry: dict[str, Any] = {"name": name}
            if segment.contact is not None:
                entry["crease_angle"] = segment.contact.crease_angle
            if isinstance(segment.gap, str):
                entry["gap"] = segment.gap
            motion = self.plan[name]
            if isinstance(motion, MovedSurface):
                entry["motion"] = "surface"
                entry["motion_crease_angle"] = motion.surface.crease_angle
            else:
                entry["motion"] = "array"
            segments.append(entry)
        tissue = {"kind": self.tissue.kind}
        if self.tissue.kind == "transversely_isotropic":
            tissue["law"] = self.tissue.law
        elif self.tissue.kind == "preset":
            tissue |= {"preset": self.tissue.preset, "mixing": self.tissue.mixing}
        # A scene without one-sided contact has the content, and the hash, that it has always had.
        contact: dict[str, Any] = {}
        if self.touching:
            contact["touching"] = len(self.touching)
        if self.obstacles:
            contact["obstacles"] = [
                {"segment": obstacle.segment, "crease_angle": obstacle.surface.crease_angle}
                for obstacle in self.obstacles
            ]
        return {
            "tissue": tissue,
            "segments": segments,
            "conflicts": self.conflicts,
            "solver": self.options.header(),
            **contact,
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every array of the scene by the name it has in a scene file."""
        return dict(self._arrays())

    def _arrays(self) -> Iterator[tuple[str, NDArray[Any]]]:
        yield "nodes", self.nodes
        yield "tets", self.tets
        for name, array in self.tissue.arrays().items():
            yield f"tissue.{name}", array
        yield "fixed", self.fixed
        if self.loads is not None:
            yield "loads", self.loads
        # Segments are numbered: their names are free text and stay out of the archive's directory.
        for number, (name, segment) in enumerate(self.segments.items()):
            key = f"segment.{number}"
            yield f"{key}.joined", segment.joined
            yield f"{key}.sliding", segment.sliding
            if segment.contact is not None:
                yield f"{key}.contact.vertices", segment.contact.vertices
                yield f"{key}.contact.triangles", segment.contact.triangles
            if not isinstance(segment.gap, str):
                yield f"{key}.gap", segment.gap
            motion = self.plan[name]
            if isinstance(motion, MovedSurface):
                yield f"{key}.motion.vertices", motion.surface.vertices
                yield f"{key}.motion.triangles", motion.surface.triangles
                yield f"{key}.motion.moved_vertices", motion.moved_vertices
            else:
                yield f"{key}.motion", motion
        for number, touch in enumerate(self.touching):
            yield f"touching.{number}.nodes", touch.nodes
            yield f"touching.{number}.triangles", touch.triangles
        for number, obstacle in enumerate(self.obstacles):
            yield f"obstacle.{number}.nodes", obstacle.nodes
            yield f"obstacle.{number}.vertices", obstacle.surface.vertices
            yield f"obstacle.{number}.triangles", obstacle.surface.triangles

    def sha256(self) -> str:
        """The SHA-256 of the scene's content, the same from whichever file it was read."""
        digest = hashlib.sha256(json.dumps(self.header(), sort_keys=True).encode())
        for name, array in self._arrays():
            digest.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class SceneResult(checks.Frozen):
    """The solution of a scene, with the data needed to draw it and to trace its origin.

    Attributes
    ----------
    nodes : (n, 3) float64, mm
        At rest; deformed = nodes + displacements.
    tets : (m, 4) uint32
    skin_triangles : (t, 3) uint32
        Boundary of the mesh, outward, as node indices.
    displacements : (n, 3) float64, mm
    forces : (n, 3) float64, N
        K u.
    residual_history : (k,) float64
    contact_nodes : (s,) uint32
        From n on with element "p2": in the middle of an edge.
    contact_points, contact_normals : (s, 3) float64, mm
        On the moved contact surface.
    contact_forces : (s,) float64, N
    contact_gaps : (s,) float64, mm
    summary : dict
        Method, residual, estimated error, iterations, largest contact gap, tets that large
        deformation leaves inverted (None in linear kinematics, where the count means nothing),
        findings of the solution, timings, versions and the SHA-256 of the scene's content.
    """

    nodes: checks.Floats
    tets: checks.Indices
    skin_triangles: checks.Indices
    displacements: checks.Floats
    forces: checks.Floats
    residual_history: checks.Floats
    contact_nodes: checks.Indices
    contact_points: checks.Floats
    contact_normals: checks.Floats
    contact_forces: checks.Floats
    contact_gaps: checks.Floats
    summary: Mapping[str, Any]

    def __repr__(self) -> str:
        """Size, how far nodes move, how it was solved."""
        far = float(np.linalg.norm(self.displacements, axis=1).max(initial=0.0))
        error = self.summary.get("error_estimate")
        rows = {
            "mesh": f"{len(self.nodes)} nodes, {len(self.tets)} tets",
            "nodes": f"move up to {far:.1f} mm",
            "method": str(self.summary.get("method", "")),
            "error": "" if error is None else f"estimated at {error:.1g} mm",
            "contact": f"{len(self.contact_nodes)} nodes" if len(self.contact_nodes) else "",
        }
        return checks.listing("SceneResult", rows)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every array of the result by its name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "summary"}
