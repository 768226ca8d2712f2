"""Distances and regions that decide the kinds of nodes."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import (
    Floats,
    as_number,
    as_point,
    as_positive,
    as_rows,
    as_text,
    check_one_of,
    keep,
    nearest,
)

CONTACT_SURFACES = ("bone", "sheet")
BORDERS = ("left", "right", "anterior", "posterior", "inferior", "superior")


@dataclass(frozen=True, eq=False)
class SlidingBox:
    """A box in which nodes on a segment slide.

    Attributes
    ----------
    segment : str
    low, high : (3,) float64, mm
        Opposite corners, LPS.
    """

    segment: str
    low: Floats
    high: Floats

    def __init__(self, segment: str, low: ArrayLike, high: ArrayLike) -> None:
        as_text("segment of a sliding box", segment)
        where = f"sliding box on {segment!r}"
        corners = as_rows(where, [np.asarray(low), np.asarray(high)], 3)
        if (corners[0] >= corners[1]).any():
            raise CaseInputError(f"{where}: low {corners[0]} must lie below high {corners[1]}")
        keep(self, segment=segment, low=corners[0], high=corners[1])

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Which of the points (n, 3) lie in the box."""
        inside = (points >= self.low) & (points <= self.high)
        return cast("NDArray[np.bool_]", inside.all(axis=1))


@dataclass(frozen=True, eq=False)
class SlidingSphere:
    """A ball in which nodes on a segment slide.

    Attributes
    ----------
    segment : str
    centre : (3,) float64, mm
        LPS.
    radius : float, mm
    """

    segment: str
    centre: Floats
    radius: float

    def __init__(self, segment: str, centre: ArrayLike, radius: float) -> None:
        as_text("segment of a sliding sphere", segment)
        where = f"sliding sphere on {segment!r}"
        radius = as_positive(f"{where} radius", radius)
        keep(self, segment=segment, centre=as_point(f"{where} centre", centre), radius=radius)

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Which of the points (n, 3) lie in the ball."""
        distance = np.linalg.norm(points - self.centre, axis=1)
        return cast("NDArray[np.bool_]", distance <= self.radius)


# The rim of the orbit lies some 25 mm above the cut.
MOST_LIFTED = 25.0


@dataclass(frozen=True)
class KindOptions:
    """Distances and regions that decide the kinds.

    Attributes
    ----------
    bone_distance : float
        Largest distance at which a node counts as on the bone's surface, as a fraction of the mean
        length of the boundary edges at the node.
    facing : float
        Least fraction of a node's boundary area that faces the bone, from 0 to 1.
    plane_distance : float
        As `bone_distance`, for the distance from a fixing plane.
    fixed_borders : tuple of str
        Borders of the image on which nodes are fixed: "left", "right", "anterior", "posterior",
        "inferior", "superior"; the neck of most CTs ends on "inferior".
    sliding : bool
        False: nodes that would slide are joined or fixed with their bone.
    upper_front, upper_molars : float, mm
        How far above supradentale, and above supra-M2, tissue slides on the upper jaw: the depth
        of the vestibule. Above, muscles arise and tissue is attached: nodes are joined.
    lower_front, lower_molars : float, mm
        How far below infradentale, and below sub-M2, it slides on the lower jaw. Sub-M2 lies at
        mid-height of the body, as deep as the vestibule is there.
    behind : float, mm
        How far behind the second molars' landmarks: over the tuberosity of the upper jaw, and to
        the front edge of the ramus of the lower, where masseter and temporalis begin.
    beside : float, mm
        How far lateral to them.
    teeth_distance : float, mm
        Largest distance from the teeth, if these are known separately from bone.
    lifted : float, mm
        How far above the cut of a Le Fort I osteotomy tissue is lifted off the skull, as the
        surgeon lifts the periosteum between the piriform aperture and the infraorbital foramen:
        within this distance of what was cut off, nodes that a plan does not press against the bone
        are free. 0: none.
    septum : bool
        Whether the nasal septum stays with the skull if the floor of the nose is cut off it, as by
        a Le Fort I osteotomy: it holds the tip of the nose.
    contact_surface : str
        The surface on which nodes slide at the arches: "bone", the blurred bone
        (`contact_surface`), which ends at the edges of the teeth and on which nodes also lie on
        palate and biting faces, or "sheet", the labial and buccal face of gums and crowns, bridged
        between teeth and continued past their edges (`contact_sheet`).
    regions : tuple of SlidingBox or SlidingSphere
        Regions in which nodes slide on the named segments, instead of the above; there they slide
        on the blurred bone.
    """

    bone_distance: float = 0.5
    facing: float = 0.2
    plane_distance: float = 0.25
    fixed_borders: tuple[str, ...] = ()
    sliding: bool = True
    upper_front: float = 10.0
    upper_molars: float = 5.0
    lower_front: float = 8.0
    lower_molars: float = 0.0
    behind: float = 12.0
    beside: float = 8.0
    teeth_distance: float = 15.0
    lifted: float = 10.0
    septum: bool = True
    contact_surface: str = "bone"
    regions: tuple[SlidingBox | SlidingSphere, ...] = ()

    def __post_init__(self) -> None:
        for name in ("bone_distance", "plane_distance", "teeth_distance"):
            as_positive(name, getattr(self, name))
        fronts = ("upper_front", "upper_molars", "lower_front", "lower_molars")
        for name in (*fronts, "behind", "beside"):
            as_number(name, getattr(self, name))
        if not 0.0 <= as_number("lifted", self.lifted) <= MOST_LIFTED:
            raise CaseInputError(
                f"lifted is {self.lifted:g} mm: 0 (none) to {MOST_LIFTED:g} is allowed, because "
                "the orbits are above"
            )
        if not 0.0 <= as_number("facing", self.facing) <= 1.0:
            raise CaseInputError(f"facing is {self.facing:g}: 0 to 1 is allowed")
        check_one_of("contact_surface", self.contact_surface, CONTACT_SURFACES)
        for border in self.fixed_borders:
            check_one_of("fixed border", border, BORDERS)
        for region in self.regions:
            if not isinstance(region, SlidingBox | SlidingSphere):
                raise CaseInputError(f"region is {region!r}: a SlidingBox or SlidingSphere needed")


def kind_options(table: Mapping[str, Any]) -> KindOptions:
    """The options that a table of plain values states, as `[node_kinds]` in a case file.

    Parameters
    ----------
    table : mapping of str to plain values
        Names of `KindOptions`. `regions` holds tables: `segment` with `low` and `high`, or with
        `centre` and `radius`.

    Raises
    ------
    CaseError
        (also `ValueError`) Another name, or a value of another kind or out of range.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.kind_options({"contact_surface": "sheet"}).contact_surface
    'sheet'
    """
    known = [field.name for field in fields(KindOptions)]
    for name in table:
        if name not in known:
            raise CaseInputError(
                f"there is no option {name!r}{nearest(name, known)}; options are: "
                f"{', '.join(known)}"
            )
    values = dict(table)
    for name in ("sliding", "septum"):
        if not isinstance(values.get(name, True), bool):
            raise CaseInputError(f"{name} is {values[name]!r}: true or false is needed")
    for name, of in (("fixed_borders", "borders"), ("regions", "tables")):
        if name in values:
            if not isinstance(values[name], list | tuple):
                raise CaseInputError(f"{name} is {values[name]!r}: a list of {of} is needed")
            values[name] = tuple(values[name])
    if "regions" in values:
        values["regions"] = tuple(_region(entry) for entry in values["regions"])
    return KindOptions(**values)


def _region(entry: object) -> SlidingBox | SlidingSphere:
    """A region from its table; what is no table is left for `KindOptions` to refuse."""
    if not isinstance(entry, Mapping):
        return cast("SlidingBox", entry)
    for kind, keys in (
        (SlidingBox, {"segment", "low", "high"}),
        (SlidingSphere, {"segment", "centre", "radius"}),
    ):
        if set(entry) == keys:
            return kind(**entry)
    raise CaseInputError(
        f"a region has {', '.join(map(str, sorted(entry)))}: segment with low and high, or segment "
        "with centre and radius, are needed"
    )
