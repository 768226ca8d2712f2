"""The colours of a 3D photo on the skin of a head."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, rigid_fit
from cmfsim.errors import CaseInputError, RegistrationError
from cmfsim.io import read_landmark_file
from cmfsim.io.meshes.photos import read_photo
from cmfsim.pipeline.building.parts import Head
from cmfsim.surfaces.barycentric import barycentric
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.values.case_parts import UNITS
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
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
