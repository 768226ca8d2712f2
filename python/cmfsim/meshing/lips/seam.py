"""The seam along which the tissue of a closed mouth is separated, and each lip beside it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.meshing.lips.crease import (
    MouthFrame,
    MouthLine,
    SkinProfiles,
    crease_line,
    mouth_frame,
    skin_profiles,
)
from cmfsim.meshing.lips.sheet import lip_sheet
from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.anatomy import Anatomy, DentalArch
from cmfsim.values.case_parts import LIP_DEPTH, LIP_HEIGHT, LIP_SEAMS
from cmfsim.values.checks import (
    Floats,
    Indices,
    as_index_rows,
    as_number,
    as_positive,
    as_rows,
    check_instance,
    check_one_of,
    keep,
)
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import label_key
from cmfsim.values.scene import NODE_KINDS, NodeKinds
from cmfsim.values.surface_data import SurfaceData
from cmfsim.values.touching import LIPS, LipRegion

# A triangle lies above or below the seam, and not past a corner of the mouth or behind the teeth,
# where the way to it leads off the normal of the seam by this share of its length, or so many mm.
ASLANT, ASLANT_MM = 0.5, 1.0
# The side of a triangle is judged from a point this far inside the tissue, relative to its size.
INSIDE = 0.25
# Patches smaller than this share of the largest are dropped. The side facing the teeth may be a
# separate patch where the cut ends at an edge shared by many triangles.
LEAST_PATCH = 0.1
LIP_LANDMARKS = ("cheilion_R", "cheilion_L", "labiale_superius", "labiale_inferius")
# The mouth ends at a cheilion landmark if that lies within this distance of the line found on the
# skin, mm; a landmark further away is reported.
TRUSTED = 8.0
# Lips whose gap between the fronts of the arches is at least this high are open, mm.
OPEN = 0.5


def lip_regions(
    nodes: ArrayLike,
    boundary_triangles: ArrayLike,
    kinds: NodeKinds,
    seam: SurfaceData,
    *,
    height: float = LIP_HEIGHT,
) -> dict[str, LipRegion]:
    """The upper and the lower lip of a mesh that was separated at a seam.

    Parameters
    ----------
    nodes : (n, 3) float64, mm
    boundary_triangles : (t, 3) uint32
        Boundary of the separated mesh, outward.
    kinds : NodeKinds
        Before nodes of the lips are released. Joined and fixed nodes may be corners of a lip's
        triangles, as at the edges of teeth, which would otherwise cut it in two, but are not nodes
        of it.
    seam : SurfaceData
        Open, with normals towards the upper lip; from in front of the skin to behind the teeth.
    height : float, mm
        How far the lips extend from the seam.

    Returns
    -------
    dict of str to LipRegion
        "upper" and "lower".

    Raises
    ------
    CaseError
        (also `ValueError`) No triangle above or below the seam; misshapen arrays.

    Examples
    --------
    >>> import cmfsim
    >>> lips = cmfsim.lip_regions(nodes, triangles, kinds, seam.surface)  # doctest: +SKIP
    >>> lips["upper"].nodes  # doctest: +SKIP
    """
    points = as_rows("nodes", nodes, 3)
    triangles = as_index_rows("boundary triangles", boundary_triangles, 3, len(points), "nodes")
    side = _sides(points, triangles, seam, as_positive("height of the lips", height))
    held = np.isin(kinds.kind, [NODE_KINDS.index("fixed"), NODE_KINDS.index("joined")])
    patches = {}
    for name, sign in zip(LIPS, (1, -1), strict=True):
        mine = triangles[side == sign]
        if not len(mine):
            raise CaseInputError(
                f"no boundary of the tissue lies within {height:g} mm "
                f"{'above' if sign > 0 else 'below'} the seam between the lips: it must run "
                "through the mouth, with its normals up"
            )
        # Without small patches that no edge connects to the rest.
        label = connected_labels(edges_of(mine.astype(np.int64)).pairs, len(mine))
        size = np.bincount(label)
        patches[name] = mine[size[label] >= LEAST_PATCH * size.max()]
    return {
        name: _region(patches[name], patches[LIPS[name == "upper"]], kinds, held) for name in LIPS
    }


def _sides(
    points: Floats, triangles: Indices, seam: SurfaceData, height: float
) -> NDArray[np.int8]:
    """+1 for triangles above the seam, −1 for those below it, 0 for all others."""
    corners = points[triangles]
    centroids = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    inwards = normal / np.maximum(area, np.finfo(float).tiny)[:, None]
    # Faces on the seam itself lie on neither side of it: a point inside their tissue decides.
    places = centroids - INSIDE * np.sqrt(area)[:, None] * inwards
    side = np.zeros(len(triangles), dtype=np.int8)
    vertices = seam.vertices
    low, high = vertices.min(axis=0) - height, vertices.max(axis=0) + height
    near = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1))
    if not len(near):
        return side
    closest, normals, _ = Surface(seam.vertices, seam.triangles).closest(places[near])
    way = places[near] - closest
    length = np.linalg.norm(way, axis=1)
    upwards = np.einsum("na,na->n", way, normals)
    aslant = np.linalg.norm(way - upwards[:, None] * normals, axis=1)
    over = aslant <= np.maximum(ASLANT * length, ASLANT_MM)
    side[near] = np.where(over & (length <= height), np.sign(upwards).astype(np.int8), 0)
    return side


def _region(mine: Indices, other: Indices, kinds: NodeKinds, held: NDArray[np.bool_]) -> LipRegion:
    nodes = np.setdiff1d(mine, other)
    nodes = nodes[~held[nodes]].astype(np.uint32)
    slides = kinds.kind[nodes] == NODE_KINDS.index("sliding")
    released = {
        name: nodes[slides & (kinds.segment[nodes] == number)]
        for number, name in enumerate(kinds.segments)
    }
    return LipRegion(mine, nodes, {n: ids for n, ids in released.items() if len(ids)})


def seam_faces(nodes: ArrayLike, triangles: ArrayLike) -> NDArray[np.bool_]:
    """Which boundary triangles lie on a seam, (t,): they face another there, at rest."""
    points = as_rows("nodes", nodes, 3)
    corners = as_index_rows("boundary triangles", triangles, 3, len(points), "nodes")
    _, place = np.unique(points, axis=0, return_inverse=True)
    places = np.sort(place.reshape(-1)[corners], axis=1)
    _, which, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    return count[which.reshape(-1)] > 1


@dataclass(frozen=True, eq=False)
class LipSeam:
    """The seam between the lips of a head.

    Attributes
    ----------
    surface : SurfaceData or None
        An open sheet from corner to corner of the mouth, from in front of the skin to a little past
        the teeth; its normals point towards the upper lip. None if it could not be located.
    source : str
        "gap" (the image shows the lips apart), "crease" (of the skin), "landmarks", "file", or
        "none".
    summary : mapping
        The values for build.json: source, width of the mouth, thickness of the lips, height of the
        gap between them, and distances of the skin landmarks from the seam; mm.
    findings : tuple of Finding
    """

    surface: SurfaceData | None
    source: str
    summary: Mapping[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        keep(self, summary=self.summary)


def lip_seam(
    anatomy: Anatomy,
    arches: Mapping[str, DentalArch],
    landmarks: Mapping[str, ArrayLike] | None = None,
    *,
    way: str = "auto",
    depth: float = LIP_DEPTH,
) -> LipSeam:
    """The seam between the lips, from the gap or crease on the skin, otherwise from landmarks.

    Parameters
    ----------
    anatomy : Anatomy
    arches : mapping of str to DentalArch
        "upper" and "lower", or none: the seam is then not found.
    landmarks : mapping of str to (3,) float64, mm, optional
        Of the skin: `cheilion_L/R` are the ends of a seam that runs near them, and all four lip
        landmarks place it where the skin shows neither gap nor crease.
    way : str
        "auto", or "landmarks": from them alone.
    depth : float, mm
        How far it extends behind the teeth.

    Raises
    ------
    CaseError
        (also `ValueError`) Another way, a landmark that is not three finite numbers.

    Examples
    --------
    >>> import cmfsim
    >>> seam = cmfsim.lip_seam(anatomy, arches.by_jaw, skin_landmarks)  # doctest: +SKIP
    >>> seam.source  # doctest: +SKIP
    'crease'
    """
    check_instance("anatomy", anatomy, Anatomy)
    check_one_of("way of the lip seam", way, LIP_SEAMS)
    as_number("depth of the lip seam", depth)
    marks = _lip_marks(landmarks or {})
    if not {"upper", "lower"} <= set(arches):
        return _not_found("neither landmarks nor teeth locate the dental arches")
    frame = mouth_frame(arches)
    profiles = skin_profiles(anatomy, frame)
    shown = crease_line(profiles, frame) if way == "auto" else None
    given = _landmark_line(profiles, frame, marks)
    line = given if shown is None else _with_corners(shown, profiles, frame, marks)
    if line is None:
        missing = [name for name in LIP_LANDMARKS if name not in marks]
        shows = "the skin shows no gap or crease between the lips" if way == "auto" else ""
        lacks = (
            f"skin landmarks {', '.join(missing)} are missing"
            if missing
            else "the order of the lip landmarks is not that of a mouth"
        )
        return _not_found(" and ".join(filter(None, (shows, lacks))))
    sheet = lip_sheet(anatomy, frame, profiles, line, depth)
    if isinstance(sheet, str):
        return _not_found(sheet)
    source = "landmarks" if shown is None else "gap" if sheet.opening >= OPEN else "crease"
    from_marks = _from_landmarks(line, frame, marks)
    findings = [*_told(source, way), *_far(from_marks)]
    findings += _outside(line, frame, marks) if shown is not None else []
    corners = frame.out_of(
        np.stack([line.across[[0, -1]], line.ahead[[0, -1]], line.heights[[0, -1]]], axis=1)
    )
    summary = {
        "source": source,
        "width": round(float(line.across[-1] - line.across[0]), 1),
        "thickness": round(sheet.thickness, 1),
        "gap": round(sheet.opening, 1),
        "corners": np.round(corners, 1).tolist(),
        "landmark_distances": {name: round(away, 1) for name, away in from_marks.items()},
    }
    return LipSeam(sheet.surface, source, summary, tuple(findings))


def _lip_marks(landmarks: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """The lip landmarks among those given, by name."""
    names = {label_key(name): name for name in LIP_LANDMARKS}
    return {
        names[label_key(label)]: as_rows(f"landmark {label!r}", np.reshape(place, (1, -1)), 3)[0]
        for label, place in landmarks.items()
        if label_key(label) in names
    }


def _landmark_line(
    profiles: SkinProfiles, frame: MouthFrame, marks: Mapping[str, Floats]
) -> MouthLine | None:
    """The line over the skin from corner to corner, half-way between the borders of the lips."""
    if len(marks) < len(LIP_LANDMARKS):
        return None
    right, left, upper, lower = (frame.into(marks[name][None])[0] for name in LIP_LANDMARKS)
    stomion = 0.5 * (upper + lower)
    order = right[0] < stomion[0] < left[0] and lower[2] < stomion[2] < upper[2]
    inside = profiles.across[0] <= right[0] and left[0] <= profiles.across[-1]
    if not (order and inside):
        return None
    inner = profiles.across[(profiles.across > right[0]) & (profiles.across < left[0])]
    at = np.concatenate([[right[0]], inner, [left[0]]])
    # A parabola on either side of the stomion, horizontal there.
    end = np.where(at < stomion[0], right[0], left[0])
    height = np.where(at < stomion[0], right[2], left[2])
    share = (at - stomion[0]) / (end - stomion[0])
    heights = stomion[2] + (height - stomion[2]) * share**2
    return MouthLine(at, profiles.at(at, heights), heights)


def _with_corners(
    line: MouthLine, profiles: SkinProfiles, frame: MouthFrame, marks: Mapping[str, Floats]
) -> MouthLine:
    """The line found on the skin, ending at the corners of the mouth marked by landmarks."""
    ends = [float(line.across[0]), float(line.across[-1])]
    for number, name in enumerate(LIP_LANDMARKS[:2]):
        if name in marks and _distance(line, frame, marks[name]) <= TRUSTED:
            ends[number] = float(frame.into(marks[name][None])[0, 0])
    low, high = profiles.across[[0, -1]]
    return line.between(max(ends[0], float(low)), min(ends[1], float(high)), profiles)


def _distance(line: MouthLine, frame: MouthFrame, place: Floats) -> float:
    points = np.stack([line.across, line.ahead, line.heights], axis=1)
    return float(np.linalg.norm(points - frame.into(place[None]), axis=1).min())


def _from_landmarks(
    line: MouthLine, frame: MouthFrame, marks: Mapping[str, Floats]
) -> dict[str, float]:
    """Distances of cheilions from the line, and in height of what is half-way between the lips."""
    found = {n: _distance(line, frame, marks[n]) for n in LIP_LANDMARKS[:2] if n in marks}
    if all(name in marks for name in LIP_LANDMARKS[2:]):
        ends = frame.into(np.array([marks[name] for name in LIP_LANDMARKS[2:]]))
        middle = ends.mean(axis=0)
        height = float(np.interp(middle[0], line.across, line.heights))
        found["stomion"] = abs(height - float(middle[2]))
    return found


def _far(distances: Mapping[str, float]) -> list[Finding]:
    return [
        Finding(
            "lip-seam-doubtful",
            f"skin landmark {name} lies {away:.1f} mm from the seam between the lips that the skin "
            f"shows ({TRUSTED:g} mm at most are expected)",
            where="lips",
            why="one of the two is wrong, so the mouth may be cut in the wrong place",
        )
        for name, away in distances.items()
        if away > TRUSTED and name != "stomion"
    ]


def _outside(line: MouthLine, frame: MouthFrame, marks: Mapping[str, Floats]) -> list[Finding]:
    """A finding where the seam does not run between the borders of the lips."""
    if not all(name in marks for name in LIP_LANDMARKS[2:]):
        return []
    upper, lower = frame.into(np.array([marks[name] for name in LIP_LANDMARKS[2:]]))
    at = np.interp([upper[0], lower[0]], line.across, line.heights)
    if lower[2] < at[1] and at[0] < upper[2]:
        return []
    return [
        Finding(
            "lip-seam-doubtful",
            f"the seam between the lips is at a height of {at.mean():.1f} mm over the middle of "
            f"the arches, the landmarks labiale_superius at {upper[2]:.1f} and labiale_inferius at "
            f"{lower[2]:.1f} mm: it should lie between them",
            where="lips",
            why="another fold of the skin may have been taken for the mouth",
            fix='check the landmarks, or set seam = "landmarks" in [lips]',
        )
    ]


def _told(source: str, way: str) -> list[Finding]:
    """A finding where landmarks alone placed the seam without having been asked for."""
    if source != "landmarks" or way == "landmarks":
        return []
    return [
        Finding(
            "lip-seam-doubtful",
            "the skin shows no gap or crease between the lips: the seam was placed from the skin "
            "landmarks of the mouth",
            where="lips",
            why="its position is accurate only to some millimetres",
        )
    ]


def _not_found(why: str) -> LipSeam:
    finding = Finding("lip-seam-not-found", f"the lips were not separated: {why}", where="lips")
    return LipSeam(None, "none", {"source": "none"}, (finding,))
