"""Scenes and plans: one `.npz`, or a text beside its mesh and surfaces (docs/formats.md)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.io.cases.case_tables import motion_of, solver_of
from cmfsim.io.cases.tables import Table, read_tables
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.io.files.reading_writing import known_keys, named, table_of
from cmfsim.io.meshes.mesh_files import read_mesh, read_tets
from cmfsim.io.meshes.surfaces import read_moved_surface, read_surface
from cmfsim.values.checks import AnyPath
from cmfsim.values.scene import NODE_KINDS, Scene, SegmentData
from cmfsim.values.solver_options import SolverOptions
from cmfsim.values.surface_data import MovedSurface, SurfaceData
from cmfsim.values.tissue_data import TISSUE_ARRAYS, TissueData
from cmfsim.values.touching import ObstacleData, TouchingData

SCENE_FORMAT = "cmfsim-scene"
SCENE_KEYS = (
    *("format", "version", "units", "mesh", "conflicts"),
    *("tissue", "segments", "plan", "solver"),
)
# Keys of the JSON text of an archive, and of an entry of its segments.
ARCHIVE_KEYS = (
    *("format", "version", "units", "tissue", "segments", "conflicts", "solver"),
    *("touching", "obstacles"),
)
ENTRY_KEYS = ("name", "crease_angle", "gap", "motion", "motion_crease_angle")
# Arrays of an archive, and of its segment number N as segment.N.…; a name that is none of these is
# refused, for an array that may be absent would else be lost by one letter.
ARCHIVE_ARRAYS = ("nodes", "tets", "fixed", "loads")
SEGMENT_ARRAYS = (
    *("joined", "sliding", "gap", "contact.vertices", "contact.triangles"),
    *("motion", "motion.vertices", "motion.triangles", "motion.moved_vertices"),
)
# The same of one-sided contact, as touching.N.… and obstacle.N.….
TOUCHING_ARRAYS = ("nodes", "triangles")
OBSTACLE_ARRAYS = ("nodes", "vertices", "triangles")
OBSTACLE_KEYS = ("segment", "crease_angle")
# More pairs of surfaces than any face has.
MOST_CONTACTS = 1000
PLAN_KEYS = ("format", "version", "name", "note", "units", "plan")
# Texts of a tissue, beside its arrays.
TISSUE_TEXTS = ("kind", "law", "preset", "mixing")


def read_scene(path: AnyPath) -> Scene:
    """The scene in a file: one `.npz`, or a `.toml` next to its mesh and surfaces.

    Parameters
    ----------
    path : path
        TOML scenes need the extra `mesh` (meshio).

    Raises
    ------
    FileNotFoundError
        The file, or one that it names, does not exist.
    CaseError
        (also `ValueError`) Not a scene, another version, units other than mm, MPa and N, an entry
        missing, misshapen or not finite.

    Examples
    --------
    >>> import cmfsim
    >>> scene = cmfsim.read_scene("scene.npz")
    """
    path = Path(path)
    if path.suffix == ".toml":
        return _read_toml_scene(path)
    with named(path):
        return _scene_from_members(*read_archive(path, SCENE_FORMAT, "scene"))


def write_scene(path: AnyPath, scene: Scene) -> None:
    """Writes a scene as one `.npz` that `read_scene` and `cmfsim solve` take.

    The same scene gives the same bytes. An existing file is replaced in one step.

    Parameters
    ----------
    path : path
        Ends in `.npz`.
    scene : Scene

    Raises
    ------
    CaseError
        (also `ValueError`) Another ending.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_scene("scene.npz", scene)
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise CaseInputError(f"{path.name}: a scene is written as .npz, not {path.suffix!r}")
    write_archive(path, SCENE_FORMAT, "scene", scene.header(), scene.arrays())


def read_plan(path: AnyPath, scene: Scene) -> dict[str, NDArray[Any] | MovedSurface]:
    """The plan in a `.toml` or `.json` file, for the segments of a scene.

    Parameters
    ----------
    path : path
        One table per segment under `plan`: `translation`, `angle` (degrees), `axis`, `centre`; or
        `matrix` (4 × 4); or `moved_surface` with `surface` (files beside this one).
    scene : Scene
        The plan must name all of its segments and no others.

    Returns
    -------
    dict of str to (4, 4) float64, mm, or MovedSurface

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a plan, an unknown segment or key, a segment missing, units other
        than mm.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_plan("whole_plan.toml", cmfsim.scene_plan(scene))
    >>> plan = cmfsim.read_plan("whole_plan.toml", scene)
    """
    path = Path(path)
    document = read_tables(path, "plan file", json_too=True).only(*PLAN_KEYS)
    document.units()
    document.need("plan")
    table = document.table("plan")
    for name in table:
        if name not in scene.segments:
            known = ", ".join(repr(s) for s in scene.segments) or "none"
            table.fail(name, f"names segment {name!r}; segments are: {known}")
    for name in scene.segments:
        if name not in table:
            table.fail(
                None, f"lacks segment {name!r}: give it translation = [0, 0, 0] if it does not move"
            )
    return {name: _motion(table.table(name), path.parent) for name in scene.segments}


def _scene_from_members(header: Mapping[str, Any], members: Mapping[str, NDArray[Any]]) -> Scene:
    known_keys("scene", header, ARCHIVE_KEYS)
    tissue = table_of(header, "tissue")
    kind = _tissue_kind(tissue)
    arrays = {n: members[f"tissue.{n}"] for n in TISSUE_ARRAYS[kind] if f"tissue.{n}" in members}
    segments: dict[str, SegmentData] = {}
    plan: dict[str, NDArray[Any] | MovedSurface] = {}
    entries = header.get("segments")
    if not isinstance(entries, list):
        raise CaseInputError("'segments' is not a list")
    for number, entry in enumerate(entries):
        key = f"segment.{number}"
        if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
            raise CaseInputError(f"segments[{number}] has no name")
        name = entry["name"]
        known_keys(f"segments[{number}]", entry, ENTRY_KEYS)
        if name in segments:
            raise CaseInputError(f"segments[{number}] is {name!r} again")
        segments[name] = _stored_segment(entry, key, members)
        plan[name] = _stored_motion(entry, key, members)
    touching, obstacles = _one_sided(header, members)
    solver = table_of(header, "solver", optional=True)
    known = {
        "scene",
        *(f"touching.{i}.{name}" for i in range(len(touching)) for name in TOUCHING_ARRAYS),
        *(f"obstacle.{i}.{name}" for i in range(len(obstacles)) for name in OBSTACLE_ARRAYS),
        *ARCHIVE_ARRAYS,
        *(f"tissue.{name}" for name in TISSUE_ARRAYS[kind]),
        *(f"segment.{i}.{name}" for i in range(len(entries)) for name in SEGMENT_ARRAYS),
    }
    for member in members:
        if member not in known:
            raise CaseInputError(f"has the array {member!r}, which does not belong to this scene")
    return Scene(
        nodes=member_of(members, "nodes"),
        tets=member_of(members, "tets"),
        tissue=TissueData(**(known_keys("tissue", tissue, TISSUE_TEXTS) | arrays)),
        segments=segments,
        plan=plan,
        fixed=member_of(members, "fixed"),
        loads=members.get("loads"),
        options=SolverOptions(**known_keys("solver", solver, tuple(SolverOptions().as_dict()))),
        conflicts=header.get("conflicts", "error"),
        touching=touching,
        obstacles=obstacles,
    )


def _stored_segment(
    entry: Mapping[str, Any], key: str, members: Mapping[str, NDArray[Any]]
) -> SegmentData:
    contact = None
    if any(f"{key}.contact.{part}" in members for part in ("vertices", "triangles")):
        contact = SurfaceData(
            member_of(members, f"{key}.contact.vertices"),
            member_of(members, f"{key}.contact.triangles"),
            entry.get("crease_angle", 60.0),
        )
    gap = entry["gap"] if "gap" in entry else member_of(members, f"{key}.gap")
    return SegmentData(
        member_of(members, f"{key}.joined"), member_of(members, f"{key}.sliding"), contact, gap
    )


def _stored_motion(
    entry: Mapping[str, Any], key: str, members: Mapping[str, NDArray[Any]]
) -> NDArray[Any] | MovedSurface:
    if entry.get("motion") != "surface":
        return member_of(members, f"{key}.motion")
    surface = SurfaceData(
        member_of(members, f"{key}.motion.vertices"),
        member_of(members, f"{key}.motion.triangles"),
        entry.get("motion_crease_angle", 60.0),
    )
    return MovedSurface(surface, member_of(members, f"{key}.motion.moved_vertices"))


def _one_sided(
    header: Mapping[str, Any], members: Mapping[str, NDArray[Any]]
) -> tuple[tuple[TouchingData, ...], tuple[ObstacleData, ...]]:
    """What tissue may not enter, as an archive holds it."""
    count = header.get("touching", 0)
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= MOST_CONTACTS:
        raise CaseInputError(f"'touching' is {count!r}: a number from 0 to {MOST_CONTACTS}")
    touching = tuple(
        TouchingData(*(member_of(members, f"touching.{i}.{name}") for name in TOUCHING_ARRAYS))
        for i in range(count)
    )
    entries = header.get("obstacles", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise CaseInputError("'obstacles' is not a list of tables")
    obstacles = []
    for number, entry in enumerate(entries):
        known_keys(f"obstacles[{number}]", entry, OBSTACLE_KEYS)
        nodes, vertices, triangles = (
            member_of(members, f"obstacle.{number}.{name}") for name in OBSTACLE_ARRAYS
        )
        surface = SurfaceData(vertices, triangles, entry.get("crease_angle", 60.0))
        obstacles.append(ObstacleData(nodes, entry.get("segment", ""), surface))
    return touching, tuple(obstacles)


def _tissue_kind(table: Mapping[str, Any]) -> str:
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in TISSUE_ARRAYS:
        raise CaseInputError(f"tissue kind is {kind!r}: use one of {', '.join(TISSUE_ARRAYS)}")
    return kind


def _read_toml_scene(path: Path) -> Scene:
    document = read_tables(path, "scene")
    document.check_format(SCENE_FORMAT)
    document.only(*SCENE_KEYS).units()
    folder = path.parent
    mesh_path = document.beside("mesh", folder)
    with named(path):
        mesh = read_mesh(mesh_path)
        tets, tet_data = read_tets(mesh, mesh_path)
        tables, plan = document.table("segments"), document.table("plan")
        kinds = _node_integers(mesh, "kind", mesh_path)
        owners = _node_integers(mesh, "segment", mesh_path) if list(tables) else kinds
        segments = {
            name: _segment(tables.table(name), kinds, owners == number, folder)
            for number, name in enumerate(tables)
        }
        _check_kinds(kinds, owners, len(segments))
        return Scene(
            nodes=mesh.points,
            tets=tets,
            tissue=_tissue(document.table("tissue"), tet_data),
            segments=segments,
            plan={name: _motion(plan.table(name), folder) for name in plan},
            fixed=np.flatnonzero(kinds == NODE_KINDS.index("fixed")),
            loads=mesh.point_data.get("load"),
            options=solver_of(document.table("solver")),
            conflicts=document.text("conflicts", "error"),
        )


def _tissue(table: Table, tet_data: Mapping[str, NDArray[Any]]) -> TissueData:
    wanted = TISSUE_ARRAYS[_tissue_kind(table.values())]
    given = table.only(*TISSUE_TEXTS, *wanted).values()
    for name, tail in wanted.items():
        if name in tet_data:
            if name in given:
                table.fail(name, "is both in the file and in the mesh: remove one")
            values = tet_data[name]
            # VTK has tensors of 9 components at most, so 6 × 6 travel as 36.
            given[name] = values.reshape(-1, 6, 6) if tail == (6, 6) else values
    with table.at(None):
        return TissueData(**given)


def _segment(
    table: Table, kinds: NDArray[np.int64], mine: NDArray[np.bool_], folder: Path
) -> SegmentData:
    table.only("contact", "crease_angle", "gap")
    contact = None
    if "contact" in table:
        angle = table.plain("crease_angle") if "crease_angle" in table else 60.0
        contact = read_surface(table.beside("contact", folder), angle)
    with table.at("gap" if "gap" in table else None):
        return SegmentData(
            joined=np.flatnonzero((kinds == NODE_KINDS.index("joined")) & mine),
            sliding=np.flatnonzero((kinds == NODE_KINDS.index("sliding")) & mine),
            contact=contact,
            gap=table.plain("gap") if "gap" in table else "rest",
        )


def _motion(table: Table, folder: Path) -> NDArray[Any] | MovedSurface:
    if "moved_surface" in table:
        # Files come from strangers: those of a case are its owner's.
        table.only("surface", "moved_surface")
        return read_moved_surface(
            *(table.beside(key, folder) for key in ("surface", "moved_surface"))
        )
    if "transform" in table:
        table.fail("transform", "is for a case: write matrix, or translation, angle, axis, centre")
    matrix = motion_of(table, folder).matrix
    if matrix is None:
        table.fail("surface", "lacks moved_surface")
    return matrix


def _node_integers(mesh: Any, name: str, path: Path) -> NDArray[np.int64]:
    if name not in mesh.point_data:
        raise CaseInputError(f"{path.name}: lacks the point data {name!r}")
    values = np.asarray(mesh.point_data[name]).reshape(-1)
    is_one_each = values.shape == (len(mesh.points),)
    if not is_one_each or not np.isfinite(values).all() or (values % 1 != 0).any():
        raise CaseInputError(f"{path.name}: point data {name!r} is not one whole number per node")
    return values.astype(np.int64)


def _check_kinds(kinds: NDArray[np.int64], owners: NDArray[np.int64], n_segments: int) -> None:
    known = ", ".join(f"{i} {name}" for i, name in enumerate(NODE_KINDS))
    bad = np.flatnonzero((kinds < 0) | (kinds >= len(NODE_KINDS)))
    if len(bad):
        raise CaseInputError(f"kind[{bad[0]}] is {kinds[bad[0]]}: use {known}")
    bad = np.flatnonzero((kinds >= 2) & ((owners < 0) | (owners >= n_segments)))
    if len(bad):
        raise CaseInputError(
            f"segment[{bad[0]}] is {owners[bad[0]]}, but there are {n_segments} segments "
            "(numbered from 0 in the order of [segments])"
        )
