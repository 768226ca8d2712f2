"""Evidence on whether the part taken for the lower jaw can be the lower jaw.

A mandible that was told from the skull by shape alone may hold a part of the maxilla, or be the
maxilla. Its sites are then found where they are not, each with its usual error: what gives this
away is looked for here.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim.registration.proposed.definitions.groups import FAR_JAW, jaw_distance
from cmfsim.registration.proposed.definitions.side_sites import HIDDEN_RAMUS
from cmfsim.registration.proposed.definitions.skull_sites import LOWER_CROWN
from cmfsim.registration.proposed.pose import Pose
from cmfsim.values.checks import Floats, Indices
from cmfsim.values.proposed_landmarks import ProposedSite
from cmfsim.values.surface_data import SurfaceData

# How far the plane of the tooth rows rises to the back against the Frankfort plane, degrees: Downs
# (1948) measured 1.5 to 14 with a mean of 9.3; synthetic heads have −2.5, the two real ones 6 to 9.
# A row of which the back belongs to the other jaw has 14 and more.
RISE = (-5.0, 13.5)
# The rise that is expected where the rows show none that can be trusted, degrees.
USUAL_RISE = 7.0
# Incisors of an open mouth are so far apart that the molars tell little of each other, and no
# mouth opens farther; lower ones stand above the edge of upper ones by this much in a deep bite at
# most, average-head mm.
WIDE, WIDEST, DEEPEST_BITE = 12.0, 50.0, 9.0
# Volumes of mandibles, filled, cm³ of the average head: those of two real heads and synthetic ones
# are 53 to 82, that of one cut off at the chin 38. Outside the first range it is doubtful, outside
# the second it is none.
VOLUMES, POSSIBLE_VOLUMES = (33.0, 100.0), (15.0, 140.0)
# The share of its volume that the smaller side of a mandible has at least: below it, half of that
# side is missing. With the chin 6 mm aside it is 0.43, in 21 other shapes of a head 0.48 and more.
LEAST_SIDE = 1.0 / 3.0
# Error that sites are expected to have on such a jaw, mm of the average head: those of the molars
# and the ramus were off by up to 10 mm, the others by up to 4.
WEAK_ERROR, WEAK_FRONT_ERROR = 10.0, 5.0
MOLAR_SITES = ("sub_m2", "supra_m2", "occlusal_line")
BACK_SITES = (*MOLAR_SITES, "gonion")
FRONT_SITES = ("infradentale", "supradentale", "mid_philtrum", "supramentale", "pogonion", "menton")
MOUTH_SITES = ("labiale_inferius", "cheilion")
# Sites of the average head that separate jaws whose own sites are not known.
USUAL_SITES = ("supradentale", "infradentale", "occlusal_line_L", "occlusal_line_R", "menton")
# The end of the tooth rows beside and behind the incisors, average-head mm.
ROW_SIDE, ROW_BACK = 50.0, 52.0


@dataclass(frozen=True)
class JawEvidence:
    """Evidence against the jaw of a head.

    impossible: Why it cannot be a lower jaw; empty where it can.
    doubts: Why its sites, and those of the upper tooth row, may be wrong.
    hidden: The sides, "L" and "R", on which the front of its ramus is hidden.
    is_open: Whether the rows are too far apart to tell of each other.
    """

    impossible: str
    doubts: tuple[str, ...]
    is_open: bool = False
    hidden: tuple[str, ...] = ()

    @property
    def is_only_open(self) -> bool:
        """Whether nothing but an open mouth speaks against it: rows apart are easy to separate."""
        return self.is_open and not self.impossible and len(self.doubts) == 1

    @property
    def reason(self) -> str:
        """All that speaks against it; empty where nothing does."""
        return "; ".join(filter(None, (self.impossible, *self.doubts)))


def jaw_evidence(
    sites: Mapping[str, Floats], lower: SurfaceData, pose: Pose, left_out: Mapping[str, float]
) -> JawEvidence:
    """Evidence against a jaw.

    sites: mapping of str to (3,), of the skull, in the frame and size of the average head, with the
        edges of the incisors as "_upper_edge" and "_lower_edge", and `HIDDEN_RAMUS`.
    lower: The mandible, mm.
    left_out: Sites of the jaw that do not fit the others, with how far they are off, average-head
        mm.
    """
    sides = _volumes(pose.into(lower.vertices) / pose.size, lower.triangles)
    impossible = "; ".join(_impossible(sites, sum(sides), pose.size))
    doubts = tuple(_doubts(sites, sides, pose.size, left_out))
    hidden = tuple(side for side in "LR" if f"{HIDDEN_RAMUS}{side}" in sites)
    return JawEvidence(impossible, doubts, _opening(sites) > WIDE, hidden)


def _impossible(sites: Mapping[str, Floats], volume: float, size: float) -> Iterator[str]:
    distance = jaw_distance({n: p for n, p in sites.items() if not n.startswith("_")})
    if distance > FAR_JAW:
        yield (
            f"its sites are {size * distance:.0f} mm from those of a jaw that opens (up to "
            f"{size * FAR_JAW:.0f} mm expected)"
        )
    opening = _opening(sites)
    if opening < -DEEPEST_BITE:
        yield f"its incisors are {-size * opening:.0f} mm above the edge of the upper ones"
    elif opening > WIDEST:
        yield f"its incisors are {size * opening:.0f} mm below the upper ones"
    low, high = POSSIBLE_VOLUMES
    if not low <= volume <= high:
        yield (
            f"it has {size**3 * volume:.0f} cm³ ({size**3 * low:.0f} to {size**3 * high:.0f} cm³ "
            "in a cranium of this size)"
        )


def _doubts(
    sites: Mapping[str, Floats],
    sides: tuple[float, float],
    size: float,
    left_out: Mapping[str, float],
) -> Iterator[str]:
    opening, volume = _opening(sites), sum(sides)
    # The rows of an open mouth have a plane each.
    rise = None if opening > WIDE else _rise(sites)
    if rise is not None and not RISE[0] <= rise <= RISE[1]:
        yield (
            f"the tooth rows rise by {rise:.0f}° to the back against the Frankfort plane "
            f"({RISE[0]:g}° to {RISE[1]:g}° expected)"
        )
    if opening > LOWER_CROWN:
        # As much as a crown: the sites of the lower jaw are found from teeth that it has lost.
        lost = "" if opening > WIDE else ": the lower ones are missing, or the mouth is open"
        yield f"the tooth rows are {size * opening:.0f} mm apart at the incisors{lost}"
    low, high = VOLUMES
    if not low <= volume <= high:
        yield (
            f"the mandible has {size**3 * volume:.0f} cm³ ({size**3 * low:.0f} to "
            f"{size**3 * high:.0f} cm³ expected with a cranium of this size)"
        )
    if min(sides) < LEAST_SIDE * volume:
        share, side = min(sides) / volume, "left" if sides[0] < sides[1] else "right"
        yield f"only {share:.0%} of the mandible lie on the {side} side of the head"
    if left_out:
        worst = max(left_out, key=lambda name: left_out[name])
        yield (f"sites of the jaw are inconsistent ({worst} by {size * left_out[worst]:.0f} mm)")


def _opening(sites: Mapping[str, Floats]) -> float:
    """How far the lower incisors stand below the upper ones; 0 where one of them is unknown."""
    upper, lower = sites.get("_upper_edge"), sites.get("_lower_edge")
    return 0.0 if upper is None or lower is None else float(upper[2] - lower[2])


def _rise(sites: Mapping[str, Floats]) -> float | None:
    """The angle of the tooth rows to the horizontal of a levelled head, degrees.

    The average head lies in its Frankfort plane to within 1°.
    """
    ends = [sites[n] for n in ("occlusal_line_L", "occlusal_line_R") if n in sites]
    if not ends or not {"supradentale", "infradentale"} <= sites.keys():
        return None
    along = np.mean(ends, axis=0) - 0.5 * (sites["supradentale"] + sites["infradentale"])
    return float(np.degrees(np.arctan2(along[2], along[1])))


def _volumes(points: Floats, triangles: Indices) -> tuple[float, float]:
    """The volumes that a surface encloses on the left and the right of a head, cm³.

    points: (n, 3), mm, in the frame of the average head, whose midsagittal plane is x = 0.
    """
    # Seen from a point of the plane, what lies behind a triangle is on the triangle's side.
    seen = points - points.mean(axis=0) * [0.0, 1.0, 1.0]
    corners = seen[triangles.astype(np.int64)]
    sixfold = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    is_left = corners[:, :, 0].mean(axis=1) > 0.0
    return abs(float(sixfold[is_left].sum())) / 6000.0, abs(float(sixfold[~is_left].sum())) / 6000.0


def weakened(
    sites: Mapping[str, ProposedSite], evidence: JawEvidence, size: float, kind: str = "skull"
) -> dict[str, ProposedSite]:
    """The sites, doubtful and with a large error where they rest on weak evidence.

    Those of the skin rest on the jaw where the mouth is open: its corners and the lower lip are
    looked for where a closed one has them.
    """
    result = dict(sites)
    for name in (f"{site}_{side}" for site in MOLAR_SITES for side in evidence.hidden):
        if kind == "skull" and name in sites:
            reason = "crowns of metal or streaks hide the front of the ramus"
            result[name] = sites[name].doubted(reason, size * WEAK_ERROR)
    if not evidence.reason or (kind == "skin" and not evidence.is_open):
        return result
    weak = (*BACK_SITES, *FRONT_SITES) if kind == "skull" else MOUTH_SITES
    for name, site in result.items():
        least = WEAK_ERROR if name.startswith(BACK_SITES) else WEAK_FRONT_ERROR
        if name.startswith(weak):
            result[name] = site.doubted(f"its jaw: {evidence.reason}", size * least)
    return result


def separation_points(
    sites: Mapping[str, ProposedSite], pose: Pose, average: Mapping[str, Floats]
) -> dict[str, Floats]:
    """What jaws can be separated by again: sites that do not rest on how they were the first time.

    Sites of cranium, incisors and chin, and the ends of the tooth rows where the cranium's pose and
    the incisors put them. Where the incisors are not known, nothing of the jaws is trusted: teeth
    and chin are then those of the average head in the cranium's pose, which is rough.

    sites: Of the skull.
    average: mapping of str to (3,). Sites of the average head, in its frame.
    """
    points = {n: s.point for n, s in sites.items() if not n.startswith(BACK_SITES)}
    if not {"supradentale", "infradentale"} <= points.keys():
        points = {n: p for n, p in points.items() if not n.startswith(FRONT_SITES)}
        usual = {name: average[name] for name in USUAL_SITES}
        placed = pose.out(pose.size * np.array([*usual.values()]))
        return points | dict(zip(usual, placed, strict=True))
    middle = 0.5 * (points["supradentale"] + points["infradentale"])
    across, back, height = pose.into(middle[None])[0] / pose.size
    rise = ROW_BACK * float(np.tan(np.radians(USUAL_RISE)))
    for letter, side in (("L", 1.0), ("R", -1.0)):
        end = np.array([across + side * ROW_SIDE, back + ROW_BACK, height + rise])
        points[f"occlusal_line_{letter}"] = pose.out(pose.size * end[None])[0]
    return points
