"""The sites of one head by their definitions, and what templates say of the definitions' bias."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cmfsim._core import Surface
from cmfsim.registration.proposed.definitions.depth_maps import depth_map
from cmfsim.registration.proposed.definitions.skin_sites import find_skin_sites
from cmfsim.registration.proposed.definitions.skull_sites import (
    FRONT_REACH,
    find_skull_sites,
    skull_views,
)
from cmfsim.registration.proposed.pose import Pose, surface_samples
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import JAW_SITES
from cmfsim.values.surface_data import SurfaceData

# Points on a surface per mm² for depth maps: some four in a cell.
DENSITY = 6.0
MOST_POINTS = 1_000_000


@dataclass(frozen=True, eq=False)
class Detected:
    """Sites of a head, (3,) each, in the frame and size of the average head.

    Names of the skull that begin with "_" are no landmarks, but what others are found from.
    """

    skull: Mapping[str, Floats]
    skin: Mapping[str, Floats]


@dataclass(frozen=True, eq=False)
class HeadSurfaces:
    """The surfaces of a head, with points that lie densely on each, (n, 3) mm, made once.

    upper: The bones without the mandible.
    """

    upper: SurfaceData
    lower: SurfaceData | None
    skin: SurfaceData | None = None

    @cached_property
    def upper_points(self) -> Floats:
        """Points on the upper bones."""
        return _points(self.upper)

    @cached_property
    def lower_points(self) -> Floats:
        """Points on the mandible; none without one."""
        return np.zeros((0, 3)) if self.lower is None else _points(self.lower)

    @cached_property
    def skin_points(self) -> Floats:
        """Points on the skin; none without it."""
        return np.zeros((0, 3)) if self.skin is None else _points(self.skin)

    def draw(self) -> None:
        """Draws the points of all surfaces, which are kept."""
        for points in (self.upper_points, self.lower_points, self.skin_points):
            points.setflags(write=False)


@dataclass(frozen=True, eq=False)
class HeadBuild:
    """How a head differs from the average one beyond its pose and size.

    jaw: (4, 4). The motion that opens the jaw of the average head as the patient's is.
    breadth: Of the face, as a factor on the average head, size included.
    """

    jaw: Floats
    breadth: float


def detect(head: HeadSurfaces, pose: Pose, build: HeadBuild, *, skin: bool = True) -> Detected:
    """The sites of a head that lies in a known pose: of cranium, mandible and, if asked, skin.

    Sites of bone are looked for with the mouth closed, and all in a face of average breadth.
    """
    broad = np.array([build.breadth / pose.size, 1.0, 1.0])

    def placed(points: Floats) -> Floats:
        return pose.into(points) / (pose.size * broad)

    turn, shift = build.jaw[:3, :3], build.jaw[:3, 3]
    lower = (placed(head.lower_points) - shift) @ turn
    skull = find_skull_sites(skull_views(placed(head.upper_points), lower))
    for name in skull:
        if name.startswith((*JAW_SITES, "_lower_edge")):
            skull[name] = turn @ skull[name] + shift
    of_skin = {}
    if head.skin is not None and skin:
        front = depth_map(placed(head.skin_points), (0, 2, 1), 1.0, FRONT_REACH)
        of_skin = find_skin_sites(front, skull)
    # What a definition looks up where a cut or holed surface has nothing is not known.
    wide = (
        {n: broad * place for n, place in sites.items() if np.isfinite(place).all()}
        for sites in (skull, of_skin)
    )
    return Detected(*wide)


def is_lower(name: str) -> bool:
    """Whether a bone of this name moves with the lower jaw."""
    words = name.casefold()
    return any(word in words for word in ("mandible", "lower", "ramus", "chin"))


def _points(surface: SurfaceData) -> Floats:
    area = Surface(surface.vertices, surface.triangles).area
    count = min(MOST_POINTS, int(DENSITY * float(area)))
    return surface_samples(surface, max(count, 1000))[0]
