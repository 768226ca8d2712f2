"""Muscle templates as one `.npz` archive: plain arrays and a JSON text."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.values.checks import Floats
from cmfsim.values.musculature import MuscleSurface, TemplateData
from cmfsim.values.surface_data import SurfaceData

TEMPLATE_FORMAT = "cmfsim-template"
# The factors by which a place is mirrored to the other side.
MIRROR = np.array([-1.0, 1.0, 1.0])


def write_template_archive(path: Path, template: TemplateData) -> None:
    """Replaces an archive. A muscle that is the exact mirror image of an earlier one says so."""
    vertices: list[Floats] = []
    triangles: list[NDArray[np.int64]] = []
    course: list[Floats] = []
    entries: list[dict[str, Any]] = []
    for muscle in template.muscles:
        entry: dict[str, Any] = {"name": muscle.name, "side": muscle.side, "kind": muscle.kind}
        if muscle.boxes is not None:
            entry["boxes"] = muscle.boxes
        if concepts := template.concepts.get(muscle.name):
            entry["concepts"] = list(concepts)
        mirror = next((m for m in template.muscles if _are_mirrored(m, muscle)), None)
        if mirror is not None and mirror.name in {e["name"] for e in entries}:
            entry["mirror_of"] = mirror.name
        else:
            entry.update(_counts(muscle.surface))
            entry["course"] = [len(line) for line in muscle.course]
            vertices.append(muscle.surface.vertices)
            triangles.append(muscle.surface.triangles.astype(np.int64))
            course += muscle.course
        entries.append(entry)
    vertices.append(template.skull.vertices)
    triangles.append(template.skull.triangles.astype(np.int64))
    header = {
        **{key: getattr(template, key) for key in ("name", "licence", "attribution", "source")},
        "landmarks": list(template.landmarks),
        "definitions": dict(template.definitions),
        "muscles": entries,
        "skull": _counts(template.skull),
    }
    corners = np.concatenate(triangles).reshape(-1)
    arrays: dict[str, NDArray[Any]] = {
        "vertices": _packed(np.concatenate(vertices)),
        # Neighbouring triangles have neighbouring corners: the steps between them pack well.
        "triangle_steps": np.diff(corners, prepend=0).astype(np.int32),
        "course": _packed(np.concatenate([np.zeros((0, 3)), *course])),
        "landmarks": np.array(list(template.landmarks.values())),
    }
    write_archive(path, TEMPLATE_FORMAT, "template", header, arrays)


def _packed(points: Floats) -> NDArray[Any]:
    """Coordinates by axis, in single precision where that keeps every digit."""
    single = points.astype(np.float32)
    return np.ascontiguousarray((single if (single == points).all() else points).T)


def _counts(surface: SurfaceData) -> dict[str, int]:
    return {"vertices": len(surface.vertices), "triangles": len(surface.triangles)}


def _are_mirrored(one: MuscleSurface, other: MuscleSurface) -> bool:
    """Whether the second muscle is the first on the other side, bit for bit."""
    if {one.side, other.side} != {"L", "R"} or one.name[:-1] != other.name[:-1]:
        return False
    mirrored = mirrored_muscle(one, other.name, other.side)
    return (
        (mirrored.kind, mirrored.boxes) == (other.kind, other.boxes)
        and np.array_equal(mirrored.surface.vertices, other.surface.vertices)
        and np.array_equal(mirrored.surface.triangles, other.surface.triangles)
        and len(mirrored.course) == len(other.course)
        and all(map(np.array_equal, mirrored.course, other.course))
    )


def mirrored_muscle(muscle: MuscleSurface, name: str, side: str) -> MuscleSurface:
    """A muscle's mirror image on the other side of the plane x = 0, triangles turned round."""
    surface = SurfaceData(
        muscle.surface.vertices * MIRROR,
        muscle.surface.triangles[:, ::-1],
        muscle.surface.crease_angle,
    )
    course = tuple(line * MIRROR for line in muscle.course)
    return MuscleSurface(name, side, surface, muscle.kind, muscle.boxes, course)


def read_template_archive(path: Path) -> TemplateData:
    """The template of an archive; needs numpy alone."""
    header, members = read_archive(path, TEMPLATE_FORMAT, "template")
    rows = _Rows(members)
    entries = header.get("muscles")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise CaseInputError("'muscles' is not a list of tables")
    skull = header.get("skull")
    if not isinstance(skull, dict):
        raise CaseInputError("'skull' is not a table")
    muscles, concepts = _muscles_of(entries, rows)
    names = header.get("landmarks")
    points = member_of(members, "landmarks")
    if not isinstance(names, list) or len(set(map(str, names))) != len(points):
        raise LandmarkInputError(f"has {len(points)} landmarks, but a different number of names")
    definitions = header.get("definitions", {})
    if not isinstance(definitions, dict):
        raise CaseInputError("'definitions' is not a table")
    texts = [str(header.get(key, "")) for key in ("name", "licence", "attribution", "source")]
    return TemplateData(
        name=texts[0],
        muscles=muscles,
        skull=rows.surface(skull),
        landmarks=dict(zip(map(str, names), points, strict=True)),
        licence=texts[1],
        attribution=texts[2],
        source=texts[3],
        definitions={str(key): str(text) for key, text in definitions.items()},
        concepts=concepts,
    )


class _Rows:
    """The rows of an archive's arrays, handed out in order: muscle by muscle, the skull last."""

    def __init__(self, members: Mapping[str, NDArray[Any]]) -> None:
        steps = member_of(members, "triangle_steps")
        if steps.ndim != 1 or steps.dtype.kind != "i" or len(steps) % 3:
            raise CaseInputError(f"triangle_steps has {steps.dtype} of shape {steps.shape}: (3 t,)")
        self._rows: dict[str, NDArray[Any]] = {
            "vertices": _rows(members, "vertices"),
            "triangles": np.cumsum(steps, dtype=np.int64).reshape(-1, 3),
            "course": _rows(members, "course"),
        }
        self._taken = dict.fromkeys(self._rows, 0)

    def take(self, kind: str, count: object) -> NDArray[Any]:
        """The next rows of a kind."""
        start, rows = self._taken[kind], self._rows[kind]
        if isinstance(count, bool) or not isinstance(count, int) or not count >= 0:
            raise CaseInputError(f"number of {kind} is {count!r}: a whole number is needed")
        if start + count > len(rows):
            raise CaseInputError(f"has {len(rows)} {kind}, {start + count} are needed")
        self._taken[kind] = start + count
        return rows[start : start + count]

    def surface(self, entry: Mapping[str, Any]) -> SurfaceData:
        """The next surface, of as many vertices and triangles as its entry states."""
        return SurfaceData(
            self.take("vertices", entry.get("vertices")),
            self.take("triangles", entry.get("triangles")),
        )


def _muscles_of(
    entries: list[dict[str, Any]], rows: _Rows
) -> tuple[tuple[MuscleSurface, ...], dict[str, tuple[str, ...]]]:
    """The muscles of an archive, and the concepts of those that have some."""
    muscles: dict[str, MuscleSurface] = {}
    concepts: dict[str, tuple[str, ...]] = {}
    for number, entry in enumerate(entries):
        name = entry.get("name")
        if not isinstance(name, str):
            raise CaseInputError(f"muscle {number} has the name {name!r}: a text is needed")
        given = entry.get("concepts", [])
        if not isinstance(given, list):
            raise CaseInputError(f"concepts of {name} are {given!r}: a list of texts is needed")
        if given:
            concepts[name] = tuple(map(str, given))
        side, kind, boxes = (entry.get(key) for key in ("side", "kind", "boxes"))
        if "mirror_of" in entry:
            other = muscles.get(str(entry["mirror_of"]))
            if other is None:
                raise CaseInputError(
                    f"{name} mirrors {entry['mirror_of']!r}, which does not come before it"
                )
            muscles[name] = mirrored_muscle(other, name, str(side))
            continue
        counts = entry.get("course", [])
        if not isinstance(counts, list):
            raise CaseInputError(f"course of {name} is not a list of point counts")
        lines = tuple(rows.take("course", count) for count in counts)
        surface = rows.surface(entry)
        muscles[name] = MuscleSurface(name, str(side), surface, str(kind), boxes, lines)
    if len(muscles) != len(entries):
        raise CaseInputError("two muscles have the same name")
    return tuple(muscles.values()), concepts


def _rows(members: Mapping[str, NDArray[Any]], name: str) -> Floats:
    array = member_of(members, name)
    if array.ndim != 2 or array.shape[0] != 3 or array.dtype.kind != "f":
        raise CaseInputError(f"{name} has {array.dtype} of shape {array.shape}: (3, n) is needed")
    return np.ascontiguousarray(array.T, dtype=np.float64)
