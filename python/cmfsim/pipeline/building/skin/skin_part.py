"""The skin of a case: its part of the mesh's boundary, its face over the skull, its 3D photo."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, rigid_fit
from cmfsim.errors import CaseInputError, RegistrationError
from cmfsim.io import read_landmark_file
from cmfsim.io.meshes.photos import read_photo
from cmfsim.pipeline.building.case_checks import Head
from cmfsim.surfaces.barycentric import barycentric
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.surfaces.topology import connected_labels, edges_of
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.case_parts import UNITS
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

# Skin farther from the photo than this, mm, has no colour of it, but this grey.
REACH, GREY = 5.0, 170
# A photo whose vertices are farther than this from the skin, mm, half of them, is not on it.
MOST_AWAY = 2.5
# From here on, mm, it may be another person's: two scans of one face leave less than 1 mm.
DOUBTFUL = 1.2
# Share of a photo that has no part in its registration (hair, neck, lips), and of its vertices as
# many as decide it.
TRIM, VERTICES, STEPS = 0.3, 4000, 300
# Landmarks that determine a rigid motion, and how far the worst may lie from its partner, mm.
LANDMARKS, MOST_OFF = 3, 15.0
# Triangles of the skin of an image, which has the colours at its vertices.
TRIANGLES = 120_000


def with_photo(head: Head) -> tuple[SurfaceData, NDArray[np.uint8], Finding]:
    """The skin of a head in full detail, the colours of its vertices, and how they came there.

    Raises `CaseError`: A photo that cannot be read, has no colours, or does not lie on the skin;
        landmarks that are missing or do not fit.
    """
    given, where = head.case.photo, head.case.where("photo")
    if given is None:  # called for cases with a photo
        raise AssertionError(head.case.name)
    skin = head.anatomy.surfaces.get("skin") or surface_of_level(
        "skin", head.anatomy.skin, SurfaceOptions(max_triangles=TRIANGLES)
    )
    photo = read_photo(given.file)
    scale = UNITS[given.units]
    matrix = np.eye(4)
    if given.landmarks is not None:
        found = read_landmark_file(given.landmarks).points
        points = {name: scale * np.asarray(point) for name, point in found.items()}
        ours = head.landmarks.get("skin", {})
        matrix = _registered(scale * photo.vertices, points, ours, skin, where)
    vertices = scale * photo.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    closest, _, _ = skin.searched.closest(vertices)
    away = float(np.median(np.linalg.norm(closest - vertices, axis=1)))
    if away > MOST_AWAY:
        raise CaseInputError(
            f"{where}: half of the 3D photo lies {away:.1f} mm from the skin or more (at most "
            f"{MOST_AWAY:g} mm): check that it is this patient's, its units, and "
            + ("its landmarks" if given.landmarks else "its frame, or give landmarks")
        )
    surface = Surface(vertices, photo.triangles)
    nearest, _, triangles = surface.closest(skin.vertices)
    near = np.linalg.norm(nearest - skin.vertices, axis=1) <= REACH
    shares = barycentric(vertices[photo.triangles[triangles[near]]], nearest[near])
    colours = np.full((len(near), 3), GREY, dtype=np.uint8)
    corners = photo.colours[photo.triangles[triangles[near]]].astype(np.float64)
    # A triangle without area has the colour of its middle.
    shares = np.nan_to_num(shares, nan=1.0 / 3.0)
    colours[near] = np.einsum("kc,kca->ka", shares, corners).round().clip(0, 255)
    what = (
        f"the 3D photo lies {away:.1f} mm from the skin (median); {near.mean():.0%} of the skin "
        "has its colours, the rest is grey"
    )
    severity = "warning" if away > DOUBTFUL else "note"
    return skin, colours, Finding("photo-placed", what, severity=severity, where=where)


def _registered(
    vertices: Floats,
    points: Mapping[str, Floats],
    ours: Mapping[str, Floats],
    skin: SurfaceData,
    where: str,
) -> Floats:
    """The motion of a photo to the skin: by landmarks, then by their surfaces."""
    names = [name for name in points if name in ours]
    if len(names) < LANDMARKS:
        raise CaseInputError(
            f"{where}: {len(names)} skin landmarks of the photo are known on the head "
            f"({', '.join(names) or 'none'}): {LANDMARKS} are needed, with names as "
            f"{', '.join(ours) or 'those of [landmarks] skin, which the case lacks'}"
        )
    there = np.array([points[name] for name in names])
    here = np.array([ours[name] for name in names])
    start = rigid_fit(there, here).matrix
    off = np.linalg.norm(there @ start[:3, :3].T + start[:3, 3] - here, axis=1)
    if off.max() > MOST_OFF:
        raise CaseInputError(
            f"{where}: landmark {names[int(off.argmax())]} of the photo stays {off.max():.0f} mm "
            f"from that of the head (at most {MOST_OFF:g} mm): check names, sides and units"
        )
    from cmfsim.registration import icp  # noqa: PLC0415

    some = vertices[:: max(1, len(vertices) // VERTICES)]
    try:
        return icp(some, skin, initial=start, trim=TRIM, max_iterations=STEPS).matrix
    except RegistrationError as error:
        raise CaseInputError(f"{where}: the 3D photo cannot be registered: {error}") from error


# Sites of the skull that skin covers whatever the lips do.
COVERED = ("nasion", "mid_philtrum", "pogonion", "suborbital_L", "suborbital_R")
# Skin alone is 1.5 mm thick: less of all tissue in front of bone is none, mm.
LEAST_TISSUE = 1.2
# The nose stands out by more than this from the line from rhinion to mid-philtrum, mm, where nasion
# and mid-philtrum are 59 mm apart as in an average head; 26 to 28 in two real heads.
LEAST_NOSE, NOSE_HEIGHT = 9.0, 59.0
# How far in front of bone skin is looked for, in steps, mm.
FARTHEST, STEP = 50.0, 0.5
# What a triangle's centroid may lie further from the skin than from the tissue's surface, mm.
SLACK = 0.25
# Smaller patches, mm², belong to what surrounds them: where tissue is hardly thicker than a tet, a
# triangle of the skin can lie nearer to the bone below.
LEAST_PATCH = 100.0


def check_skin(anatomy: Anatomy, skull: Mapping[str, Floats]) -> Iterator[Finding]:
    """Warnings where nose or tissue is missing in front of the skull."""
    front = _front(skull)
    if front is None:
        return
    bare = {
        name: depth
        for name in COVERED
        if name in skull and (depth := _tissue(anatomy, skull[name], front)) < LEAST_TISSUE
    }
    if bare:
        yield _missing(
            "tissue in front of bone is missing at "
            + ", ".join(f"{name} ({depth:.1f} mm)" for name, depth in bare.items())
        )
    if not {"rhinion", "mid_philtrum", "nasion"} <= skull.keys():
        return
    top, bottom = skull["rhinion"], skull["mid_philtrum"]
    size = float(np.linalg.norm(skull["nasion"] - bottom)) / NOSE_HEIGHT
    line = [top + share * (bottom - top) for share in np.linspace(0.2, 0.9, 8)]
    nose = max(_tissue(anatomy, point, front, last=True) for point in line)
    if nose < LEAST_NOSE * size:
        yield _missing(
            f"the skin has no nose: it stands out by {nose:.1f} mm between rhinion and upper lip "
            f"({LEAST_NOSE * size:.0f} mm at least are expected)"
        )


def _front(skull: Mapping[str, Floats]) -> Floats | None:
    """The direction in which the face looks, from pairs of sites and the midline."""
    pairs = [n[:-2] for n in skull if n.endswith("_L") and f"{n[:-2]}_R" in skull]
    if not pairs or not {"nasion", "supradentale"} <= skull.keys():
        return None
    left = np.sum([skull[f"{n}_L"] - skull[f"{n}_R"] for n in pairs], axis=0)
    front: Floats = np.cross(left, skull["nasion"] - skull["supradentale"])
    length = float(np.linalg.norm(front))
    return front / length if length > 0.0 else None


def _tissue(anatomy: Anatomy, point: Floats, front: Floats, *, last: bool = False) -> float:
    """How far the head reaches in front of a point, to the first or the last end of it, mm."""
    steps = np.arange(0.0, FARTHEST, STEP)
    inside = np.asarray(anatomy.skin.sample(point + steps[:, None] * front)) > 0.0
    if last:
        return float(steps[np.flatnonzero(inside)[-1]]) if inside.any() else 0.0
    return FARTHEST if inside.all() else float(steps[int(np.argmin(inside))])


def _missing(what: str) -> Finding:
    return Finding("skin-implausible", what, where="skin")


def on_skin(
    nodes: Floats, triangles: NDArray[np.uint32], anatomy: Anatomy, level: ImageData
) -> NDArray[np.bool_]:
    """Which boundary triangles are skin: their centroids lie nearer to it than to anything else.

    nodes: (n, 3), mm.
    triangles: (t, 3) uint32. The boundary of the mesh.
    level: Of the tissue that was meshed.
    """
    centroids = nodes[triangles].mean(axis=1)
    others = [*anatomy.bones.values(), *([] if anatomy.air is None else [anatomy.air])]
    from_skin = np.abs(anatomy.skin.sample(centroids))
    near = np.ones(len(centroids), dtype=bool)
    for other in others:
        near &= from_skin < np.abs(other.sample(centroids))
    # On a plane that bounds the region, the level is zero well inside the skin.
    near &= from_skin <= np.abs(level.sample(centroids)) + SLACK
    return _without_specks(nodes, triangles, near)


def _without_specks(
    nodes: Floats, triangles: NDArray[np.uint32], chosen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The choice with its small patches, and the small gaps in it, turned over."""
    edges = edges_of(triangles.astype(np.int64))
    # Patches hang together by edges between triangles of one choice.
    alike = chosen[edges.pairs[:, 0]] == chosen[edges.pairs[:, 1]]
    patch = connected_labels(edges.pairs[alike], len(triangles))
    a, b, c = (nodes[triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    small = np.bincount(patch, weights=area) < LEAST_PATCH
    # A closed surface of its own, round a small cavity, is surrounded by nothing.
    bordered = np.zeros(len(small), dtype=bool)
    bordered[patch[edges.pairs[~alike]]] = True
    return chosen ^ (small & bordered)[patch]
