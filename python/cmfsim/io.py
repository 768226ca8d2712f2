"""Files and values: the scene, plan and result formats, each reader beside its writer.

The formats are described in docs/formats.md. Files come from strangers: nothing is unpickled or
evaluated, XML with a document type is refused, sizes are checked before memory is taken. A file is
written under a temporary name and renamed, so a run that fails leaves the old one whole.
"""

import base64
import contextlib
import io as stdio
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cmfsim.case import (
    TISSUE_ARRAYS,
    MovedSurface,
    Scene,
    SceneResult,
    SegmentData,
    SolverOptions,
    SurfaceData,
    TissueData,
)
from cmfsim.errors import CaseInputError
from cmfsim.planning import rigid_motion

__all__ = [
    "read_plan",
    "read_result",
    "read_scene",
    "result_suffixes",
    "write_result",
    "write_scene",
]

SCENE_FORMAT = "cmfsim-scene"
RESULT_FORMAT = "cmfsim-result"
FORMAT_VERSION = 1
UNITS = {"length": "mm", "stress": "MPa", "force": "N"}
# Unpacked size up to which an archive is read, bytes: a scene of 20 million tets fits, a
# decompression bomb does not.
MAX_UNPACKED = 16 * 2**30
# Text files (plans, scene descriptions) above this size are not what they say they are, bytes.
MAX_TEXT = 16 * 2**20
# Kinds of node in the point data of a VTU scene.
NODE_KINDS = ("free", "fixed", "joined", "sliding")
# Texts of a tissue, beside its arrays.
TISSUE_TEXTS = ("kind", "law", "preset", "mixing")
VTK_TETRA = 10
VTK_TYPES = {"float64": "Float64", "uint32": "UInt32", "int64": "Int64", "uint8": "UInt8"}


def read_scene(path: str | os.PathLike[str]) -> Scene:
    """The scene in a file: one `.npz`, or a `.toml` beside its mesh and surfaces.

    Parameters
    ----------
    path : path
        TOML scenes need the extra `mesh` (meshio).

    Returns
    -------
    Scene

    Raises
    ------
    FileNotFoundError
        The file, or one that it names, does not exist.
    CaseError
        (also `ValueError`) Not a scene, another version, an entry missing, misshapen or not finite.

    Examples
    --------
    >>> import cmfsim
    >>> scene = cmfsim.read_scene("scene.npz")  # doctest: +SKIP
    """
    path = Path(path)
    if path.suffix == ".toml":
        return _read_toml_scene(path)
    with _named(path):
        return _scene_from_members(*_read_archive(path, SCENE_FORMAT, "scene"))


def write_scene(path: str | os.PathLike[str], scene: Scene) -> None:
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
    >>> cmfsim.write_scene("scene.npz", scene)  # doctest: +SKIP
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise CaseInputError(f"{path.name}: a scene is written as .npz, not {path.suffix!r}")
    _write_archive(path, SCENE_FORMAT, "scene", scene.header(), scene.arrays())


def read_plan(path: str | os.PathLike[str], scene: Scene) -> dict[str, NDArray[Any] | MovedSurface]:
    """The plan in a `.toml` or `.json` file, for the segments of a scene.

    Parameters
    ----------
    path : path
        One table per segment under `plan`: `translation`, `angle` (degrees), `axis`, `centre`; or
        `matrix` (4 × 4); or `moved_surface` with `surface` (files beside this one).
    scene : Scene
        Its segments are those that the plan may name; those that it leaves out are an error.

    Returns
    -------
    dict of str to (4, 4) float64, mm, or MovedSurface

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a plan, an unknown segment or key, a segment missing.

    Examples
    --------
    >>> import cmfsim
    >>> plan = cmfsim.read_plan("plan.toml", scene)  # doctest: +SKIP
    """
    path = Path(path)
    with _named(path):
        document = _read_document(path)
        table = _table(document, "plan")
        for name in table:
            if name not in scene.segments:
                known = ", ".join(repr(s) for s in scene.segments) or "none"
                raise CaseInputError(f"[plan] names segment {name!r}; segments are: {known}")
        for name in scene.segments:
            if name not in table:
                raise CaseInputError(
                    f"[plan] lacks segment {name!r}: give it translation = [0, 0, 0] if it stays"
                )
        return {name: _motion(name, table, path.parent) for name in scene.segments}


def read_result(path: str | os.PathLike[str]) -> SceneResult:
    """The result in a `.npz` file that `write_result` made.

    Parameters
    ----------
    path : path

    Returns
    -------
    SceneResult

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    CaseError
        (also `ValueError`) Not a result, another version, an entry missing.

    Examples
    --------
    >>> import cmfsim
    >>> result = cmfsim.read_result("out.npz")  # doctest: +SKIP
    """
    path = Path(path)
    with _named(path):
        summary, members = _read_archive(path, RESULT_FORMAT, "result")
        names = [f for f in SceneResult.__dataclass_fields__ if f != "summary"]
        return SceneResult(**{n: _member(members, n) for n in names}, summary=summary)


def write_result(path: str | os.PathLike[str], result: SceneResult) -> None:
    """Writes a result as `.npz` (everything), `.vtu` (tissue) or `.vtp` (its boundary).

    An existing file is replaced in one step.

    Parameters
    ----------
    path : path
    result : SceneResult

    Raises
    ------
    CaseError
        (also `ValueError`) Another ending.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_result("out.vtu", result)  # doctest: +SKIP
    """
    path = Path(path)
    if path.suffix not in result_suffixes():
        known = ", ".join(result_suffixes())
        raise CaseInputError(f"{path.name}: a result is written as {known}, not {path.suffix!r}")
    if path.suffix == ".npz":
        _write_archive(path, RESULT_FORMAT, "result", dict(result.summary), result.arrays())
        return
    with _replacing(path) as file:
        if path.suffix == ".vtu":
            _write_vtu(file, result)
        else:
            _write_vtp(file, result)


def result_suffixes() -> tuple[str, ...]:
    """The file endings that `write_result` knows."""
    return (".npz", ".vtu", ".vtp")


# One archive: arrays and a JSON text.


def _read_archive(
    path: Path, format_name: str, text_name: str
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > MAX_UNPACKED:
            raise CaseInputError(f"unpacks to {unpacked} bytes: at most {MAX_UNPACKED} are read")
        with np.load(path, allow_pickle=False) as archive:
            members = {name: archive[name] for name in archive.files}
    except zipfile.BadZipFile as error:
        raise CaseInputError(f"is not an .npz archive, or is cut short ({error})") from error
    except (ValueError, EOFError, KeyError, zlib.error, MemoryError, NotImplementedError) as error:
        if isinstance(error, CaseInputError):
            raise
        raise CaseInputError(f"holds an array that cannot be read ({error})") from error
    if text_name not in members:
        raise CaseInputError(f"lacks the member {text_name!r}: it is not a {format_name} file")
    text = members.pop(text_name)
    if text.shape != () or text.dtype.kind != "U":
        raise CaseInputError(f"member {text_name!r} is not a text")
    try:
        header = json.loads(str(text), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise CaseInputError(f"member {text_name!r} is not JSON ({error})") from error
    if not isinstance(header, dict):
        raise CaseInputError(f"member {text_name!r} is not a JSON object")
    if header.get("format") != format_name:
        raise CaseInputError(f"format is {header.get('format')!r}: {format_name!r} is needed")
    _check_version(header.get("version"))
    return header, members


def _write_archive(
    path: Path,
    format_name: str,
    text_name: str,
    header: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    head = {"format": format_name, "version": FORMAT_VERSION, "units": UNITS, **header}
    text = json.dumps(head, ensure_ascii=True, allow_nan=False)
    with _replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **{text_name: np.array(text), **arrays})


def _check_version(version: object) -> None:
    if isinstance(version, bool) or not isinstance(version, int):
        raise CaseInputError(f"version is {version!r}: a whole number is needed")
    if version != FORMAT_VERSION:
        hint = "a newer cmfsim made it: update" if version > FORMAT_VERSION else "unknown version"
        raise CaseInputError(f"version is {version}, this cmfsim reads {FORMAT_VERSION}; {hint}")


def _refuse_constant(name: str) -> float:
    message = f"{name} is not a JSON number"
    raise ValueError(message)


def _member(members: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    if name not in members:
        raise CaseInputError(f"lacks the array {name!r}")
    return members[name]


def _scene_from_members(header: Mapping[str, Any], members: dict[str, NDArray[Any]]) -> Scene:
    tissue = _table(header, "tissue")
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
        if name in segments:
            raise CaseInputError(f"segments[{number}] is {name!r} again")
        contact = None
        if f"{key}.contact.vertices" in members:
            contact = SurfaceData(
                members[f"{key}.contact.vertices"],
                _member(members, f"{key}.contact.triangles"),
                entry.get("crease_angle", 60.0),
            )
        gap = entry["gap"] if "gap" in entry else _member(members, f"{key}.gap")
        segments[name] = SegmentData(
            _member(members, f"{key}.joined"), _member(members, f"{key}.sliding"), contact, gap
        )
        if entry.get("motion") == "surface":
            surface = SurfaceData(
                _member(members, f"{key}.motion.vertices"),
                _member(members, f"{key}.motion.triangles"),
                entry.get("motion_crease_angle", 60.0),
            )
            plan[name] = MovedSurface(surface, _member(members, f"{key}.motion.moved_vertices"))
        else:
            plan[name] = _member(members, f"{key}.motion")
    return Scene(
        nodes=_member(members, "nodes"),
        tets=_member(members, "tets"),
        tissue=TissueData(**(_known_keys("tissue", tissue, TISSUE_TEXTS) | arrays)),
        segments=segments,
        plan=plan,
        fixed=_member(members, "fixed"),
        loads=members.get("loads"),
        options=_options(header),
        conflicts=header.get("conflicts", "error"),
    )


def _tissue_kind(table: Mapping[str, Any]) -> str:
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in TISSUE_ARRAYS:
        raise CaseInputError(f"tissue kind is {kind!r}: use one of {', '.join(TISSUE_ARRAYS)}")
    return kind


def _options(header: Mapping[str, Any]) -> SolverOptions:
    table = _table(header, "solver", optional=True)
    return SolverOptions(**_known_keys("solver", table, tuple(SolverOptions().as_dict())))


def _known_keys(where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> dict[str, Any]:
    for name in table:
        if name not in known:
            raise CaseInputError(f"[{where}] has the unknown key {name!r}: use {', '.join(known)}")
    return dict(table)


def _table(header: Mapping[str, Any], name: str, *, optional: bool = False) -> dict[str, Any]:
    if name not in header and optional:
        return {}
    table = header.get(name)
    if not isinstance(table, dict):
        raise CaseInputError(f"lacks the table {name!r}" if table is None else f"{name!r} no table")
    return table


# A scene or plan as text, with the mesh and surfaces in files beside it.


def _read_document(path: Path) -> dict[str, Any]:
    if path.suffix not in {".toml", ".json"}:
        raise CaseInputError(f"ends in {path.suffix!r}: .toml or .json is needed")
    if path.stat().st_size > MAX_TEXT:
        raise CaseInputError(f"is larger than {MAX_TEXT} bytes")
    try:
        text = path.read_bytes().decode("utf-8-sig")
        if path.suffix == ".json":
            document = json.loads(text, parse_constant=_refuse_constant)
        else:
            document = _toml().loads(text)
    except (ValueError, RecursionError) as error:
        raise CaseInputError(f"cannot be read: {error}") from error
    if not isinstance(document, dict):
        raise CaseInputError("is not a table of names and values")
    return document


def _toml() -> Any:
    for name in ("tomllib", "tomli"):
        with contextlib.suppress(ModuleNotFoundError):
            return import_module(name)
    raise CaseInputError("Python 3.10 reads TOML with tomli: pip install tomli, or use .json")


def _meshio() -> Any:
    try:
        return import_module("meshio")
    except ModuleNotFoundError as error:
        raise CaseInputError(
            "meshes and surfaces are read with meshio: pip install 'cmfsim[mesh]'"
        ) from error


def _read_toml_scene(path: Path) -> Scene:
    with _named(path):
        document = _read_document(path)
        if document.get("format") != SCENE_FORMAT:
            raise CaseInputError(f"format is {document.get('format')!r}: {SCENE_FORMAT!r} needed")
        _check_version(document.get("version"))
        keys = ("format", "version", "mesh", "conflicts", "tissue", "segments", "plan", "solver")
        _known_keys("scene", document, keys)
        mesh_path = _beside(path.parent, "mesh", document.get("mesh"))
        mesh = _read_mesh(mesh_path)
        tets, tet_data = _tets(mesh, mesh_path)
        tables = _table(document, "segments", optional=True)
        kinds = _node_integers(mesh, "kind", len(mesh.points), mesh_path)
        owners = _node_integers(mesh, "segment", len(mesh.points), mesh_path) if tables else kinds
        segments = {
            name: _segment(name, tables, kinds, owners == number, path.parent)
            for number, name in enumerate(tables)
        }
        _check_kinds(kinds, owners, len(tables))
        plans = _table(document, "plan", optional=True)
        plan = {name: _motion(name, plans, path.parent) for name in plans}
        tissue = _table(document, "tissue")
        return Scene(
            nodes=mesh.points,
            tets=tets,
            tissue=_tissue(tissue, tet_data),
            segments=segments,
            plan=plan,
            fixed=np.flatnonzero(kinds == NODE_KINDS.index("fixed")),
            loads=mesh.point_data.get("load"),
            options=_options(document),
            conflicts=document.get("conflicts", "error"),
        )


def _tissue(table: Mapping[str, Any], tet_data: Mapping[str, NDArray[Any]]) -> TissueData:
    wanted = TISSUE_ARRAYS[_tissue_kind(table)]
    given = _known_keys("tissue", table, (*TISSUE_TEXTS, *wanted))
    for name, tail in wanted.items():
        if name in tet_data:
            if name in given:
                raise CaseInputError(f"tissue {name} stands in the file and in the mesh: drop one")
            values = tet_data[name]
            # VTK has tensors of 9 components at most, so 6 × 6 travel as 36.
            given[name] = values.reshape(-1, 6, 6) if tail == (6, 6) else values
    return TissueData(**given)


def _segment(
    name: str,
    tables: Mapping[str, Any],
    kinds: NDArray[np.int64],
    mine: NDArray[np.bool_],
    folder: Path,
) -> SegmentData:
    table = _known_keys(
        f"segments.{name}", _table(tables, name), ("contact", "crease_angle", "gap")
    )
    contact = None
    if "contact" in table:
        surface_path = _beside(folder, f"segments.{name}.contact", table["contact"])
        contact = _read_surface(surface_path, table.get("crease_angle", 60.0))
    return SegmentData(
        joined=np.flatnonzero((kinds == NODE_KINDS.index("joined")) & mine),
        sliding=np.flatnonzero((kinds == NODE_KINDS.index("sliding")) & mine),
        contact=contact,
        gap=table.get("gap", 0.0),
    )


def _motion(name: str, plans: Mapping[str, Any], folder: Path) -> NDArray[Any] | MovedSurface:
    where = f"plan.{name}"
    table = _table(plans, name)
    if "matrix" in table:
        return np.asarray(_known_keys(where, table, ("matrix",))["matrix"])
    if "moved_surface" in table:
        files = _known_keys(where, table, ("surface", "moved_surface"))
        before, weld = _read_triangles(_beside(folder, f"{where}.surface", files.get("surface")))
        after = _beside(folder, f"{where}.moved_surface", files["moved_surface"])
        moved = np.asarray(_read_mesh(after).points)
        if len(moved) != weld.n_read:
            raise CaseInputError(
                f"{after.name} has {len(moved)} vertices, {files.get('surface')} {weld.n_read}"
            )
        return MovedSurface(before, moved[weld.kept])
    return rigid_motion(**_known_keys(where, table, ("translation", "angle", "axis", "centre")))


def _beside(folder: Path, where: str, name: object) -> Path:
    """A path given by a text file, which may not lead out of that file's folder."""
    if not isinstance(name, str) or not name:
        raise CaseInputError(f"{where} names no file")
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or "\\" in name or ":" in name:
        raise CaseInputError(f"{where} is {name!r}: a file in the folder of the scene is needed")
    return folder / relative


def _read_mesh(path: Path) -> Any:
    meshio = _meshio()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    _refuse_entities(path)
    with _named(path):
        try:
            # meshio prints what it finds and, in some readers, exits: neither is the caller's.
            with (
                contextlib.redirect_stdout(stdio.StringIO()),
                contextlib.redirect_stderr(stdio.StringIO()),
            ):
                return meshio.read(path)
        except (Exception, SystemExit) as error:
            raise CaseInputError(f"cannot be read as a mesh ({error})") from error


def _refuse_entities(path: Path) -> None:
    """Refuses XML with a document type, in which entities could grow without bound."""
    data = path.read_bytes()
    if data[:1] == b"<" and (b"<!DOCTYPE" in data or b"<!ENTITY" in data):
        raise CaseInputError(f"{path.name}: XML with a document type is not read")
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        raise CaseInputError(f"{path.name}: XML in UTF-16 is not read")


@dataclass(frozen=True)
class _Weld:
    """Which vertices of a file were kept when equal ones became one."""

    n_read: int
    kept: NDArray[np.intp]


def _read_surface(path: Path, crease_angle: float = 60.0) -> SurfaceData:
    return _read_triangles(path, crease_angle)[0]


def _read_triangles(path: Path, crease_angle: float = 60.0) -> tuple[SurfaceData, _Weld]:
    """A surface with vertices in the same place made one: STL repeats them for each triangle."""
    mesh = _read_mesh(path)
    triangles = [b.data for b in mesh.cells if b.type == "triangle"]
    if not triangles or any(b.type not in {"triangle", "vertex", "line"} for b in mesh.cells):
        found = ", ".join(sorted({b.type for b in mesh.cells})) or "nothing"
        raise CaseInputError(f"{path.name}: a surface of triangles is needed, found {found}")
    points = np.asarray(mesh.points)
    _, first, back = np.unique(points, axis=0, return_index=True, return_inverse=True)
    # In the order of the file, so that a surface without repetitions keeps its numbers.
    order = np.argsort(first)
    number = np.empty(len(first), dtype=np.int64)
    number[order] = np.arange(len(first))
    kept = first[order]
    welded = number[back.reshape(-1)][np.concatenate(triangles)]
    return SurfaceData(points[kept], welded, crease_angle), _Weld(len(points), kept)


def _tets(mesh: Any, path: Path) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
    blocks = [i for i, b in enumerate(mesh.cells) if b.type == "tetra"]
    if not blocks:
        found = ", ".join(sorted({b.type for b in mesh.cells})) or "nothing"
        raise CaseInputError(f"{path.name}: linear tets are needed, found {found}")
    tets = np.concatenate([mesh.cells[i].data for i in blocks])
    data = {
        name: np.concatenate([np.asarray(values[i]) for i in blocks])
        for name, values in mesh.cell_data.items()
    }
    return tets, data


def _node_integers(mesh: Any, name: str, count: int, path: Path) -> NDArray[np.int64]:
    if name not in mesh.point_data:
        raise CaseInputError(f"{path.name}: lacks the point data {name!r}")
    values = np.asarray(mesh.point_data[name]).reshape(-1)
    if values.shape != (count,) or not np.isfinite(values).all() or (values % 1 != 0).any():
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


# VTK's XML files, base64 in one block per array.


def _write_vtu(file: BinaryIO, result: SceneResult) -> None:
    n_tets = len(result.tets)
    head = f'<Piece NumberOfPoints="{len(result.nodes)}" NumberOfCells="{n_tets}">'
    cells = (
        _data_array("connectivity", result.tets.reshape(-1).astype(np.int64))
        + _data_array("offsets", 4 * np.arange(1, n_tets + 1, dtype=np.int64))
        + _data_array("types", np.full(n_tets, VTK_TETRA, dtype=np.uint8))
    )
    body = f"{head}{_points(result.nodes, result)}<Cells>{cells}</Cells></Piece>"
    _write_vtk(file, "UnstructuredGrid", body)


def _write_vtp(file: BinaryIO, result: SceneResult) -> None:
    used, triangles = np.unique(result.skin_triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    n = len(triangles)
    head = (
        f'<Piece NumberOfPoints="{len(used)}" NumberOfVerts="0" NumberOfLines="0" '
        f'NumberOfStrips="0" NumberOfPolys="{n}">'
    )
    polys = _data_array("connectivity", triangles.reshape(-1).astype(np.int64)) + _data_array(
        "offsets", 3 * np.arange(1, n + 1, dtype=np.int64)
    )
    body = f"{head}{_points(result.nodes, result, used)}<Polys>{polys}</Polys></Piece>"
    _write_vtk(file, "PolyData", body)


def _points(nodes: NDArray[Any], result: SceneResult, used: NDArray[Any] | None = None) -> str:
    rows = slice(None) if used is None else used
    data = (
        _data_array("displacement", result.displacements[rows])
        + _data_array("force", result.forces[rows])
        + ("" if used is None else _data_array("node", used.astype(np.int64)))
    )
    points = _data_array("points", nodes[rows])
    return f"<Points>{points}</Points><PointData>{data}</PointData>"


def _data_array(name: str, array: NDArray[Any]) -> str:
    raw = np.ascontiguousarray(array).tobytes()
    block = base64.b64encode(np.uint64(len(raw)).tobytes() + raw).decode()
    components = array.shape[1] if array.ndim == 2 else 1
    return (
        f'<DataArray type="{VTK_TYPES[array.dtype.name]}" Name="{name}" '
        f'NumberOfComponents="{components}" format="binary">{block}</DataArray>\n'
    )


def _write_vtk(file: BinaryIO, kind: str, body: str) -> None:
    order = "LittleEndian" if np.little_endian else "BigEndian"
    file.write(
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="{order}" '
        f'header_type="UInt64">\n<{kind}>{body}</{kind}>\n</VTKFile>\n'.encode()
    )


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """A file under a temporary name in the same folder, renamed to `path` when all went well."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes files that only their owner reads; results follow the user's umask.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Puts the file's name before the text of an error about its content."""
    try:
        yield
    except FileNotFoundError as error:
        if error.filename is None:
            raise
        raise FileNotFoundError(f"{error.filename}: no such file") from error
    except IsADirectoryError as error:
        raise CaseInputError(f"{path.name}: is a folder, not a file") from error
    except ValueError as error:
        raise CaseInputError(f"{path.name}: {error}") from error
