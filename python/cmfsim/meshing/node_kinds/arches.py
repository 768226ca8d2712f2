"""The dental arches, from skull landmarks or from teeth in the image, and what slides on them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.meshing.node_kinds.options import KindOptions
from cmfsim.surfaces.depth import distances
from cmfsim.values.anatomy import SHEET_DEPTH, Anatomy, BoneSegment, DentalArch
from cmfsim.values.checks import Floats, as_point
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData

# Bone landmarks of the two dental arches: front, left and right.
UPPER_ARCH = ("supradentale", "supra_m2_L", "supra_m2_R")
LOWER_ARCH = ("infradentale", "sub_m2_L", "sub_m2_R")
# Least volume of enamel that makes an arch, mm³: some three teeth.
LEAST_ENAMEL = 300.0
# How far the landmarks lie from the cervical end of the enamel, towards the roots, mm: supradentale
# and infradentale; supra-M2; sub-M2, at mid-height of the body.
FRONT_RISE, UPPER_MOLAR_RISE, LOWER_MOLAR_RISE = 2.0, 8.0, 10.0
# Length of the front and of the hindmost part of a row of teeth that are looked at, mm.
FRONT_PART, MOLAR_PART = 6.0, 8.0
# Half the length of a second molar, mm: behind it the row ends, or a third molar stands.
HALF_MOLAR = 5.0
# Share of the nodes at an arch that lie on its sheet at least: half or more on three heads, and the
# others on lingual faces and the palate. Fewer nodes than this on a segment are not conclusive.
LEAST_SHARE, MANY = 0.25, 50
# How far past half-way to the other arch tissue slides behind the teeth, mm: on the ramus above it
# temporalis ends.
PAST_BITE = 4.0


@dataclass(frozen=True)
class DentalArches:
    """The dental arches of a head, and the segments that carry them.

    Attributes
    ----------
    by_jaw : mapping of str to DentalArch
        "upper" and "lower"; empty if neither landmarks nor teeth locate them.
    bearers : mapping of str to frozenset of int
        Of each jaw, the numbers of the segments that tissue slides on.
    findings : tuple of Finding
    """

    by_jaw: Mapping[str, DentalArch] = field(default_factory=dict)
    bearers: Mapping[str, frozenset[int]] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


def dental_arches(
    anatomy: Anatomy,
    segments: Sequence[BoneSegment],
    landmarks: Mapping[str, ArrayLike] | None = None,
) -> DentalArches:
    """The dental arches of a head: from its landmarks, else from its teeth, else none.

    Parameters
    ----------
    anatomy : Anatomy
    segments : sequence of BoneSegment
    landmarks : mapping of str to (3,) float64, mm, optional
        Skull landmarks, LPS: `supradentale`, `infradentale`, `supra_m2_L/R` and `sub_m2_L/R`.

    Raises
    ------
    CaseError
        (also `ValueError`) Landmarks that do not span an arch.

    Examples
    --------
    >>> import cmfsim
    >>> arches = cmfsim.dental_arches(anatomy, segments, landmarks)
    """
    landmarks = landmarks or {}
    missing = [n for n in (*UPPER_ARCH, *LOWER_ARCH) if n not in landmarks]
    findings: tuple[Finding, ...] = ()
    if missing:
        places = _places_of_teeth(anatomy)
        if places is None:
            nothing = Finding(
                "sliding-landmarks",
                f"no sliding region at the teeth: landmarks {', '.join(missing)} are missing, and "
                "the image does not show teeth apart from bone",
                severity="warning",
                where="landmarks",
                fix="place them, define regions, or set sliding = false",
            )
            return DentalArches(findings=(nothing,))
        from_teeth = Finding(
            "sliding-landmarks",
            f"landmarks {', '.join(missing)} are missing: the sliding regions were placed from the "
            "teeth that the image shows",
            severity="note",
            where="landmarks",
            why="the depth of the vestibule is accurate only to about 3 mm",
        )
        findings = (from_teeth,)
    else:
        places = {n: as_point(f"landmark {n!r}", landmarks[n])
                  for n in (*UPPER_ARCH, *LOWER_ARCH)}  # fmt: skip
    up = _above(places)
    arches = {}
    for jaw, mine, other, out in (
        ("upper", UPPER_ARCH, LOWER_ARCH, up),
        ("lower", LOWER_ARCH, UPPER_ARCH, -up),
    ):
        tip, left, right = (places[n] for n in mine)
        tip_2, left_2, right_2 = (places[n] for n in other)
        molars = 0.5 * (left + right - left_2 - right_2)
        arches[jaw] = DentalArch(
            jaw, tip, left, right, out, float((tip - tip_2) @ out), float(molars @ out)
        )
    return DentalArches(arches, _bearers(anatomy, segments, arches), findings)


def _above(places: Mapping[str, Floats]) -> Floats:
    """The unit vector from the lower arch to the upper, at right angles to left and front."""
    upper, lower = UPPER_ARCH, LOWER_ARCH
    middle = [np.mean([places[n] for n in names], axis=0) for names in (lower, upper)]
    left = places[upper[1]] - places[upper[2]] + places[lower[1]] - places[lower[2]]
    left = left / np.linalg.norm(left)
    front = np.zeros(3)
    for tip, one, other in (upper, lower):
        front = front + places[tip] - 0.5 * (places[one] + places[other])
    front = front - (front @ left) * left
    front = front / np.linalg.norm(front)
    up = middle[1] - middle[0]
    up = up - (up @ left) * left - (up @ front) * front
    length = float(np.linalg.norm(up))
    if not np.isfinite(length) or length < 1.0:
        raise CaseInputError(
            f"landmarks of the upper and lower arch lie {length:.2g} mm apart in height: misplaced"
        )
    unit: Floats = up / length
    return unit


def _bearers(
    anatomy: Anatomy, segments: Sequence[BoneSegment], arches: Mapping[str, DentalArch]
) -> dict[str, frozenset[int]]:
    """The segments nearest to the landmarks of an arch, and all others of the lower jaw's bone.

    Behind its teeth the lower jaw goes on as ramus, which a sagittal split makes a segment of its
    own; what lies behind the upper teeth are the pterygoid processes, from which muscles arise.
    """
    places = np.array([p for arch in arches.values() for p in (arch.tip, arch.left, arch.right)])
    away = [distances(places, segment.surface.searched) for segment in segments]
    nearest = np.argmin(away, axis=0).reshape(len(arches), 3)
    bearers = {jaw: set(near.tolist()) for jaw, near in zip(arches, nearest, strict=True)}
    bones = {name: bone.values > 0.0 for name, bone in anatomy.bones.items()}
    owners = [_bone_of(bones, segment) for segment in segments]
    mine = {owners[i] for i in bearers["lower"]} - {None}
    theirs = {owners[i] for i in bearers["upper"]}
    for number, owner in enumerate(owners):
        if owner in mine - theirs:
            bearers["lower"].add(number)
    return {jaw: frozenset(numbers) for jaw, numbers in bearers.items()}


def _bone_of(bones: Mapping[str, NDArray[np.bool_]], segment: BoneSegment) -> str | None:
    """The bone that a segment is a piece of, of those whose inside is given."""
    inside = segment.level.values > 0.0
    shared = {
        name: int(np.count_nonzero(inside & bone))
        for name, bone in bones.items()
        if bone.shape == inside.shape
    }
    name = max(shared, key=shared.__getitem__, default=None)
    return name if name is not None and shared[name] else None


def _places_of_teeth(anatomy: Anatomy) -> dict[str, Floats] | None:
    """About where the landmarks of both arches lie, from enamel; None where it shows no rows."""
    rows = _rows_of_teeth(anatomy)
    if rows is None:
        return None
    upper, lower = rows
    # The rows of both jaws are thin across the plane that they meet in.
    together = np.concatenate([upper - upper.mean(axis=0), lower - lower.mean(axis=0)])
    up = np.linalg.svd(together[:: max(1, len(together) // 5000)], full_matrices=False)[2][2]
    up = up * np.sign(up[2] or 1.0)
    left = np.array([1.0, 0.0, 0.0]) - up[0] * up
    left = left / np.linalg.norm(left)
    axes = np.stack([left, np.cross(left, -up), up])
    # LPS: ahead is −y.
    axes[1] *= -np.sign(axes[1, 1] or 1.0)
    places: dict[str, Floats] = {}
    for names, row, sign, rise in (
        (UPPER_ARCH, upper, 1.0, UPPER_MOLAR_RISE),
        (LOWER_ARCH, lower, -1.0, LOWER_MOLAR_RISE),
    ):
        s, a, v = (row @ axes.T).T
        front = a > a.max() - FRONT_PART
        middle = float(np.median(s[front]))
        tip = (middle, np.percentile(a[front], 98.0), _root_end(v[front], sign, FRONT_RISE))
        places[names[0]] = tip @ axes
        for name, side in ((names[1], s > middle), (names[2], s < middle)):
            if np.count_nonzero(side) < 3:
                return None
            end = float(np.percentile(a[side], 2.0))
            back = side & (a < end + MOLAR_PART)
            outer = np.percentile(s[back] - middle, 95.0 if name == names[1] else 5.0) + middle
            molar = (outer, end + HALF_MOLAR, _root_end(v[back], sign, rise))
            places[name] = molar @ axes
    return places


def _root_end(heights: Floats, sign: float, rise: float) -> float:
    """The height a rise beyond the cervical end of enamel."""
    return sign * (float(np.percentile(sign * heights, 95.0)) + rise)


def _rows_of_teeth(anatomy: Anatomy) -> tuple[Floats, Floats] | None:
    """The voxels of the upper and the lower teeth, (n, 3) mm each."""
    if anatomy.teeth is None:
        return None
    teeth = anatomy.teeth.values > 0.0
    spacing = anatomy.teeth.spacing
    least = LEAST_ENAMEL / float(np.prod(spacing))

    def places(mask: NDArray[np.bool_]) -> Floats:
        return anatomy.skin.lowest + np.argwhere(mask) * spacing

    of_bones = [places(teeth & (b.values > 0.0)) for b in anatomy.bones.values()]
    rows = sorted((r for r in of_bones if len(r) >= least), key=lambda row: row[:, 2].mean())
    if len(rows) == 1:
        # One bone bears both: they meet where enamel is scarcest.
        row = rows[0]
        counts, ends = np.histogram(row[:, 2], bins=max(3, round(np.ptp(row[:, 2]) / spacing[2])))
        n = len(counts)
        inner = slice(n // 4, n - n // 4)
        cut = float(ends[inner][int(np.argmin(counts[inner]))] + 0.5 * (ends[1] - ends[0]))
        rows = [row[row[:, 2] < cut], row[row[:, 2] >= cut]]
    if len(rows) != 2 or any(len(row) < least for row in rows):
        return None
    return rows[1], rows[0]


def sliding_nodes(
    points: Floats,
    nearest: NDArray[np.intp],
    anatomy: Anatomy,
    segments: Sequence[BoneSegment],
    *,
    arches: DentalArches,
    contacts: Mapping[str, SurfaceData],
    options: KindOptions,
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Which points lie on a bone (its number in `nearest`, or −1) within its sliding region.

    Where a segment has a contact sheet in `contacts`, those that lie on the sheet; with a finding
    where few do, for then the sheet is not that of the bone.
    """
    findings: list[Finding] = []
    slides = np.zeros(len(points), dtype=bool)
    given = {region.segment for region in options.regions}
    for region in options.regions:
        number = next(i for i, s in enumerate(segments) if s.name == region.segment)
        slides |= (nearest == number) & region.holds(points)
    if not arches.by_jaw:
        return slides, findings
    near_teeth = _near_teeth(points, anatomy, options)
    for number, segment in enumerate(segments):
        jaws = [jaw for jaw, bearers in arches.bearers.items() if number in bearers]
        if segment.name in given or not jaws:
            continue
        alone = len(jaws) == 1
        inside = [_in_arch(points, arches.by_jaw[jaw], options, alone=alone) for jaw in jaws]
        mine = np.flatnonzero(np.logical_and.reduce([nearest == number, near_teeth, *inside]))
        if segment.name in contacts and len(mine):
            away = distances(points[mine], contacts[segment.name].searched)
            there = mine[away <= SHEET_DEPTH]
            if len(mine) >= MANY and len(there) < LEAST_SHARE * len(mine):
                far = Finding(
                    "contact-sheet",
                    f"of {len(mine)} nodes on {segment.name!r} at the arch only {len(there)} lie "
                    f"within {SHEET_DEPTH:g} mm of its contact sheet; the others are joined",
                    severity="warning",
                    where=f"segment {segment.name}",
                    why="lips and cheeks would be attached to the teeth there",
                )
                findings.append(far)
            mine = there
        slides[mine] = True
    return slides, findings


def _in_arch(
    points: Floats, arch: DentalArch, options: KindOptions, *, alone: bool
) -> NDArray[np.bool_]:
    """Which points lie between the vestibule of an arch and the bite, and not behind or beside it.

    alone: The bone bears this arch and not the other: behind the teeth it ends at the bite.
    """
    upper = arch.jaw == "upper"
    front_depth = options.upper_front if upper else options.lower_front
    molar_depth = options.upper_molars if upper else options.lower_molars
    across, forwards, out = arch.axes()
    tip, left, right = arch.tip, arch.left, arch.right
    a = tip + front_depth * out
    b, c = left + molar_depth * out, right + molar_depth * out
    normal = np.cross(b - a, c - a)
    normal = normal * np.sign(normal @ out)
    offset = points - arch.middle
    ahead = offset @ forwards
    region: NDArray[np.bool_] = (
        ((points - a) @ normal <= 0.0)
        & (ahead >= -options.behind)
        & (np.abs(offset @ across) <= arch.half_width + options.beside)
    )
    if alone:
        bite = 0.5 * arch.depth_molars + PAST_BITE
        region &= (ahead >= 0.0) | (-(offset @ out) <= bite)
    return region


def _near_teeth(points: Floats, anatomy: Anatomy, options: KindOptions) -> NDArray[np.bool_]:
    """Which points lie near the teeth; all, where the teeth are not known apart from bone."""
    if anatomy.teeth is None or not (anatomy.teeth.values > 0.0).any():
        return np.ones(len(points), dtype=bool)
    ndimage = third_party("scipy.ndimage", "distances from the teeth are found", "imaging")
    distance = ndimage.distance_transform_edt(
        ~(anatomy.teeth.values > 0.0), sampling=anatomy.teeth.spacing.tolist()
    )
    return anatomy.teeth.with_values(distance).sample(points) <= options.teeth_distance
