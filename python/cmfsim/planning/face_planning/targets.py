"""Targets for a face: positions of points, values of measures, a whole surface."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, SurfaceMotion
from cmfsim.errors import CaseInputError
from cmfsim.planning.face_measures.definitions import MEASURES, measure_sites
from cmfsim.planning.face_measures.sites import FaceSites, face_sites
from cmfsim.planning.replanning.model import Motions, PlanningModel
from cmfsim.surfaces.topology import edges_of
from cmfsim.values.checks import Floats, as_positive, as_rows, keep
from cmfsim.values.skin_motion import attachment
from cmfsim.values.surface_data import SurfaceData, used_nodes

# A point of the face further from the desired surface than this, mm, has no partner on it.
MOST_APART = 25.0
# A point whose closest point is within this distance of the surface's border, mm, has no partner.
BORDER = 1.0
# A node that a segment's movement of 1 mm moves by less than this, mm, is unaffected by plans.
MOVES = 0.1


@dataclass(frozen=True, eq=False)
class PointTarget:
    """Points of the face with their desired positions.

    Attributes
    ----------
    points : (n, 3) float64, mm
        On the skin, before the operation.
    goals : (n, 3) float64, mm
        Where they should be.
    std : float, mm
        Tolerance of a point along each axis.
    directions : (n, 3) float64 or None
        If given, only distances along these unit vectors count: (0, 1, 0) and (0, 0, 1) for
        points of a profile photograph.

    Raises
    ------
    CaseError
        (also `ValueError`) No point, a wrong number of goals or directions, NaN, a zero direction.

    Examples
    --------
    >>> import cmfsim
    >>> chin = cmfsim.PointTarget([[0, -100, -80]], [[0, -96, -80]], std=0.3)
    >>> chin.goals.tolist()
    [[0.0, -96.0, -80.0]]
    """

    points: Floats
    goals: Floats
    std: float
    directions: Floats | None

    def __init__(
        self,
        points: ArrayLike,
        goals: ArrayLike,
        std: float = 0.5,
        directions: ArrayLike | None = None,
    ) -> None:
        places = as_rows("target points", points, 3)
        wished = as_rows("target goals", goals, 3)
        if len(places) != len(wished) or not len(places):
            raise CaseInputError(
                f"{len(places)} target points and {len(wished)} goals: one goal for each point"
            )
        as_positive("target std", std)
        ways: Floats | None = None
        if directions is not None:
            ways = as_rows("target directions", directions, 3)
            sizes = np.linalg.norm(ways, axis=1, keepdims=True)
            if len(ways) != len(places) or not (sizes > 0.0).all():
                raise CaseInputError(
                    "target directions must be given for each point and must not be zero"
                )
            ways = ways / sizes
        keep(self, points=places, goals=wished, std=std, directions=ways)


@dataclass(frozen=True)
class MeasureTarget:
    """A measure of the face with its desired value.

    Attributes
    ----------
    key : str
        As in `MEASURES`, such as "nasolabial_angle".
    value : float, mm or degrees
    std : float, mm or degrees
        Tolerance of the value.

    Raises
    ------
    CaseError
        (also `ValueError`) An unknown measure; a value that is not finite.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.MeasureTarget("nasolabial_angle", 105.0, std=2.0).key
    'nasolabial_angle'
    """

    key: str
    value: float
    std: float = 0.5

    def __post_init__(self) -> None:
        known = [measure.key for measure in MEASURES]
        if self.key not in known:
            raise CaseInputError(f"measure is {self.key!r}: one of {', '.join(known)} is needed")
        if not np.isfinite(self.value):
            raise CaseInputError(f"target of {self.key} is {self.value}: must be finite")
        as_positive("target std", self.std)


@dataclass(frozen=True, eq=False)
class SurfaceTarget:
    """A desired surface of the face.

    Points of the face are drawn evenly over its vertices; each counts by its distance from the
    nearest point of the surface along the surface's normal there, so that it may slide on it.

    Attributes
    ----------
    surface : SurfaceData
        The desired face, in the frame of the case, with outward normals.
    std : float, mm
    points : int
        Number of points of the face to use.

    Examples
    --------
    >>> import cmfsim
    >>> wish = cmfsim.SurfaceTarget(cmfsim.read_surface("wished.stl"))  # doctest: +SKIP
    """

    surface: SurfaceData
    std: float = 0.5
    points: int = 400

    def __post_init__(self) -> None:
        as_positive("target std", self.std)
        as_positive("target points", self.points)


Target: TypeAlias = PointTarget | MeasureTarget | SurfaceTarget


@dataclass(frozen=True, eq=False)
class Wish:
    """A target ready for the search, with the points of the face before that it needs, if any.

    rows: Of their places (n, 3), mm, and the plan: the residuals in standard deviations.
    """

    points: Floats
    rows: Callable[[Floats, Motions], Floats]


def wish_of(planning: PlanningModel, target: Target) -> Wish:
    """A target with the points of a patient's face on which it depends.

    Raises `CaseError`: Sites of a measure, or tissue or partners at its points, are missing.
    """
    if isinstance(target, PointTarget):
        return _points_wish(planning, target)
    if isinstance(target, MeasureTarget):
        return _measure_wish(planning, target)
    return _surface_wish(planning, target)


class CarriedPoints:
    """As `PlanningModel.carried`, for a few points: costs no more than these need."""

    def __init__(self, planning: PlanningModel, points: Floats) -> None:
        before = planning.skin_before
        found = attachment(before.searched, points)
        self.share = found.share
        nodes, corners = used_nodes(before.triangles[np.unique(found.triangles)])
        self._points = found.places
        self._places = before.vertices[nodes]
        self._surface = Surface(self._places, corners)
        columns = planning.columns
        self._columns = columns
        self._matrix = columns.matrix[nodes].reshape(3 * len(nodes), -1)
        self._offset = columns.offset[nodes].ravel()
        self._correction = None if planning.correction is None else planning.correction.at(nodes)

    def displacements(self, plan: Motions) -> Floats:
        """Displacements of the points, (n, 3) mm."""
        moved = self._offset + self._matrix @ self._columns.numbers(plan)
        if self._correction is not None:
            moved = moved + self._correction.displacements(plan).ravel()
        motion = SurfaceMotion(self._surface, self._places + moved.reshape(-1, 3))
        return self.share[:, None] * motion.displacement(self._points)


def _points_wish(planning: PlanningModel, target: PointTarget) -> Wish:
    points, goals = target.points, target.goals
    share = CarriedPoints(planning, points).share
    if not (share > 0.0).all():
        place = points[int(np.argmin(share))].round(1).tolist()
        raise CaseInputError(
            f"target point {place} mm is outside the tissue of the model, so no plan moves it"
        )

    def rows(places: Floats, _: Motions) -> Floats:
        off = places - goals
        if target.directions is not None:
            off = (off * target.directions).sum(axis=1)
        return off.ravel() / target.std

    return Wish(points, rows)


def _measure_wish(planning: PlanningModel, target: MeasureTarget) -> Wish:
    sites = face_sites(planning.patient)
    measure = next(measure for measure in MEASURES if measure.key == target.key)
    why = sites.why_absent(measure.sites)
    if why:
        raise CaseInputError(f"{target.key} cannot be a target: {why}")
    names = [name for name in measure.sites if name in sites.skin]

    def rows(places: Floats, plan: Motions) -> Floats:
        found = {**dict(zip(names, places, strict=True)), **_bone_places(sites, plan)}
        value = measure_sites({name: found[name] for name in measure.sites})[target.key]
        # All sites are known, so the value is a number.
        return np.array([(float(value or 0.0) - target.value) / target.std])

    return Wish(np.array([sites.skin[name] for name in names]).reshape(-1, 3), rows)


def _bone_places(sites: FaceSites, plan: Motions) -> dict[str, Floats]:
    found = {}
    for name, site in sites.bone.items():
        motion = np.asarray(plan.get(site.segment, np.eye(4)), dtype=np.float64)
        found[name] = motion[:3, :3] @ site.place + motion[:3, 3]
    return found


def _surface_wish(planning: PlanningModel, target: SurfaceTarget) -> Wish:
    before = planning.skin_before.vertices
    chosen = np.flatnonzero(np.abs(planning.columns.matrix).max(axis=(1, 2)) > MOVES)
    points = before[chosen[:: max(1, len(chosen) // int(target.points))]]
    surface = target.surface.searched
    # Where a face was cut off.
    border = np.unique(edges_of(target.surface.triangles.astype(np.int64)).border)
    kept = points[_has_partner(surface, target.surface.vertices[border], points)]
    if not len(kept):
        raise CaseInputError(
            f"the desired surface is more than {MOST_APART:g} mm from the face: both must be in "
            "the frame of the case"
        )

    def rows(places: Floats, _: Motions) -> Floats:
        closest, normals, _triangles = surface.closest(places)
        rows: Floats = ((places - closest) * normals).sum(axis=1) / target.std
        return rows

    return Wish(kept, rows)


def _has_partner(surface: Surface, rim: Floats, points: Floats) -> NDArray[np.bool_]:
    closest, _, _ = surface.closest(points)
    near: NDArray[np.bool_] = np.linalg.norm(closest - points, axis=1) <= MOST_APART
    if len(rim):
        from_rim = [float(np.linalg.norm(rim - place, axis=1).min()) for place in closest]
        near &= np.array(from_rim) > BORDER
    return near
