"""The tooth rows of both jaws: the bone that bears each, where its cusps are, and its crowns.

Crowns are found on the bone by its shape about the arch, tooth by tooth's width: a scan does not
show where a tooth ends and bone begins.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import rigid_fit
from cmfsim.errors import CaseInputError
from cmfsim.meshing.node_kinds.arches import dental_arches
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.values.anatomy import (
    JAWS,
    LOWER_BEARERS,
    UPPER_BEARERS,
    Anatomy,
    BoneSegment,
    DentalArch,
)
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.surface_data import MovedSurface, SurfaceData

BEARERS: Mapping[str, tuple[str, ...]] = {"upper": UPPER_BEARERS, "lower": LOWER_BEARERS}
# A row reaches this far beyond the landmarks of its arch, mm: to the side, in front of the front
# teeth, and behind the middle of the second molars, which are 10 mm long.
SIDE, AHEAD, BEHIND = 7.0, 12.0, 6.0
# Width of the sectors about the arch in which cusps are found, degrees, and where they end.
SECTOR, LAST_SECTOR = 10.0, 100.0
# Within these, degrees to either side, there is no ramus; how much wider the row may be behind, mm.
FRONT_SECTORS, WIDER = 70.0, 5.0
# Sectors of the central incisors, of all incisors, and of the molars, degrees to either side.
BITE_SECTORS = {"1": (0.0, 10.0), "-front": (0.0, 20.0), "-back": (60.0, 90.0)}
# Cusps of a row that differ by more from its median, mm, are gum or the ramus; fewer sectors with
# a cusp are no row.
UNEVEN, LEAST_SECTORS = 5.0, 8
# How far crowns reach to either side of the line through the cusps, mm.
HALF_TOOTH = 8.0
# Height of crowns, mm: that of a molar is 6 to 7 mm, of an upper incisor 9 to 10 mm.
CROWN = 6.0
# How much higher than the cusp found in a sector another one may be, mm: more is the ramus.
HIGHER = 1.5
# Length of the front teeth beyond the edge of the bone below which there are none, mm.
LEAST_CROWN = 3.0
# Surfaces of levels are not made coarser than this.
MOST_TRIANGLES = 1_000_000
# Of a bone that is an image, what lies within this of the arch is looked at, mm.
AROUND = 25.0


@dataclass(frozen=True, eq=False)
class ToothRow:
    """The teeth of one jaw on the bone that bears them.

    Attributes
    ----------
    segment : str
        The segment with which they move.
    surface : SurfaceData
        Closed, mm: the bone with its teeth, or the part of it about the arch.
    arch : DentalArch
    """

    segment: str
    surface: SurfaceData
    arch: DentalArch

    def moved(self, motion: ArrayLike) -> "ToothRow":
        """The row after a rigid motion, (4, 4) mm."""
        matrix = np.asarray(motion, dtype=np.float64)
        ends = np.stack([self.arch.tip, self.arch.left, self.arch.right])
        tip, left, right = carried(matrix, ends)
        arch = replace(
            self.arch, tip=tip, left=left, right=right, out=matrix[:3, :3] @ self.arch.out
        )
        vertices = carried(matrix, self.surface.vertices)
        return ToothRow(self.segment, SurfaceData(vertices, self.surface.triangles), arch)

    @cached_property
    def _sectors(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, NDArray[np.intp]]:
        """Vertices about the arch, those of them that are no ramus, and of each vertex two numbers.

        These are how far it lies towards the bite, mm, and its sector.
        """
        arch, axes = self.arch, self.arch.axes()
        across, ahead, out = ((self.surface.vertices - arch.middle) @ axes.T).T
        front = float((arch.tip - arch.middle) @ axes[1])
        turn = np.degrees(np.arctan2(across, ahead))
        near = (
            (np.abs(across) <= arch.half_width + SIDE)
            & (ahead >= -BEHIND)
            & (ahead <= front + AHEAD)
            & (np.abs(turn) < LAST_SECTOR)
        )
        sector = ((turn + LAST_SECTOR) // SECTOR).astype(np.intp)
        # The ramus rises beside the last molars, further to the side than teeth ahead of them.
        before_molars = np.flatnonzero(near & (np.abs(turn) < FRONT_SECTORS))
        inner = near
        if len(before_molars):
            tops = _tops(before_molars, -out, sector)
            inner = near & (np.abs(across) <= np.abs(across[[*tops.values()]]).max() + WIDER)
        return np.flatnonzero(near), np.flatnonzero(inner), -out, sector

    @cached_property
    def cusps(self) -> Mapping[int, int]:
        """The vertex furthest towards the bite in each sector that has teeth.

        Raises
        ------
        CaseError
            (also `ValueError`) The bone has no teeth there.
        """
        _, inner, height, sector = self._sectors
        tops = _tops(inner, height, sector)
        usual = float(np.median(height[[*tops.values()]])) if tops else 0.0
        found = {n: i for n, i in tops.items() if abs(height[i] - usual) <= UNEVEN}
        tip = float((self.arch.tip - self.arch.middle) @ -self.arch.axes()[2])
        middle = LAST_SECTOR / SECTOR
        front = [float(height[i]) - tip for n, i in found.items() if abs(n + 0.5 - middle) < 2.0]
        longest = max(front, default=0.0)
        if len(found) < LEAST_SECTORS or longest < LEAST_CROWN:
            raise CaseInputError(
                f"the {self.arch.jaw} jaw shows no tooth row (splint-no-teeth): {self.segment} "
                f"reaches {longest:.1f} mm beyond the edge of the bone at the front teeth, at "
                f"least {LEAST_CROWN:g} mm are needed; the teeth must be in the surface or image "
                "of the bone, and supradentale and infradentale at their necks"
            )
        return found

    @cached_property
    def crowns(self) -> NDArray[np.bool_]:
        """Which vertices lie on crowns, (v,)."""
        near, _, height, sector = self._sectors
        edge = np.full(int(2 * LAST_SECTOR / SECTOR) + 1, np.inf)
        for number, vertex in self.cusps.items():
            edge[number] = height[vertex]
        # The flank of the ramus beside a molar counts up to the molar's height, its front does not.
        above = height[near] - edge[sector[near]]
        high = near[(above >= -CROWN) & (above <= HIGHER)]
        across = (self.surface.vertices - self.arch.middle) @ self.arch.axes()[:2].T
        crowns = np.zeros(len(across), dtype=bool)
        line = across[[*self.cusps.values()]]
        crowns[high[line_distance(across[high], line) <= HALF_TOOTH]] = True
        return crowns


def _tops(near: NDArray[np.intp], height: Floats, sector: NDArray[np.intp]) -> dict[int, int]:
    """Of some vertices, the highest one of each sector."""
    order = near[np.argsort(height[near], kind="stable")]
    # Of equal keys, the last one stays.
    highest = dict(zip(sector[order].tolist(), order.tolist(), strict=True))
    return dict(sorted(highest.items()))


def line_distance(points: Floats, line: Floats) -> Floats:
    """Distance of points (n, 2) from the polyline through corners (k, 2), in order."""
    found = np.full(len(points), np.inf)
    for a, b in itertools.pairwise(line):
        share = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0.0, 1.0)
        found = np.minimum(found, np.linalg.norm(points - a - share[:, None] * (b - a), axis=1))
    return found


def bite_sites(*rows: ToothRow) -> dict[str, tuple[Floats, str]]:
    """Places on the cusps of rows, (3,) mm, with their segments: edges of incisors and the bite.

    "U1" and "L1" are the edges of the central incisors; "U-front" and "L-front", "U-back" and
    "L-back" the middles of the cusps of incisors and molars, between which the occlusal plane runs.
    """
    found = {}
    for row in rows:
        letter = "U" if row.arch.jaw == "upper" else "L"
        turn = {n: abs((n + 0.5) * SECTOR - LAST_SECTOR) for n in row.cusps}
        for name, (low, high) in BITE_SECTORS.items():
            inside = [row.cusps[n] for n in turn if low <= turn[n] < high]
            if inside:
                place = row.surface.vertices[inside].mean(axis=0)
                found[f"{letter}{name}"] = (place, row.segment)
    return found


def tooth_rows(
    anatomy: Anatomy,
    segments: Sequence[BoneSegment],
    landmarks: Mapping[str, ArrayLike] | None = None,
    findings: Iterable[Finding] = (),
) -> tuple[ToothRow, ToothRow]:
    """The upper and the lower tooth row of a head, before the operation.

    Bones that were given as surfaces are taken as given; others are made from the image. `findings`
    are those of the head: where its jaws were separated doubtfully, bone would pass for crowns.

    Raises
    ------
    CaseError
        (also `ValueError`) No landmarks or teeth locate the rows, no segment bears them, or the
        jaws are doubtful.

    Examples
    --------
    >>> import cmfsim
    >>> upper, lower = cmfsim.tooth_rows(anatomy, segments, landmarks, findings)
    >>> upper.segment, lower.segment
    ('maxilla', 'mandible_body')
    """
    doubt = next((f for f in findings if f.code == "jaw-doubtful"), None)
    if doubt is not None:
        raise CaseInputError(
            f"the tooth rows are doubtful (splint-rows-doubtful), because {doubt.what}; {doubt.fix}"
        )
    if not segments:
        raise CaseInputError("no tooth rows: the case has no bone segments")
    arches = dental_arches(anatomy, segments, landmarks)
    if not arches.by_jaw:
        raise CaseInputError(
            "no tooth rows: neither skull landmarks (supradentale, infradentale, supra_m2_L/R, "
            "sub_m2_L/R) nor the image locate the teeth"
        )
    upper, lower = (
        ToothRow(_bearer(segments, arch), _bone(anatomy, arch), arch)
        for arch in (arches.by_jaw[jaw] for jaw in JAWS)
    )
    return upper, lower


# The rows of patients that are in use: figures, measures of the face and contacts need them.
_ROWS: WeakKeyDictionary[PatientModel, tuple[ToothRow, ToothRow]] = WeakKeyDictionary()


def patient_rows(patient: PatientModel) -> tuple[ToothRow, ToothRow]:
    """The `tooth_rows` of a patient's model, made once; the same errors."""
    if patient not in _ROWS:
        sites = patient.landmarks.get("skull")
        _ROWS[patient] = tooth_rows(patient.anatomy, patient.segments, sites, patient.findings)
    return _ROWS[patient]


def _bearer(segments: Sequence[BoneSegment], arch: DentalArch) -> str:
    """The segment at the front teeth; an error where molars lie on a piece of their own."""
    places = np.stack([arch.tip, arch.left, arch.right])
    away = [distances(places, segment.surface.searched) for segment in segments]
    nearest = np.argmin(away, axis=0)
    names = [segments[int(number)].name for number in nearest]
    front, molars = names[0], names[1:]
    # A landmark above the molars may lie just beyond the cut.
    others = sorted({name for name in molars if name not in (front, *BEARERS[arch.jaw])})
    if others:
        raise CaseInputError(
            f"the {arch.jaw} teeth lie on several segments (splint-pieces): {front} at the front, "
            f"{' and '.join(others)} at the molars; rows and splints need one that bears them all"
        )
    return front


def _bone(anatomy: Anatomy, arch: DentalArch) -> SurfaceData:
    """The bone with the teeth of a jaw, uncut, in the detail of its source."""
    jaw = arch.jaw
    for name in BEARERS[jaw]:
        if name in anatomy.surfaces:
            return anatomy.surfaces[name]
        if name in anatomy.bones:
            level = anatomy.bones[name]
            low, high = (
                np.clip((end - level.lowest) / level.spacing, 0, np.array(level.values.shape) - 1)
                for end in _box(arch)
            )
            first, past = np.floor(low).astype(int), np.ceil(high).astype(int) + 1
            part = level.values[tuple(slice(a, b) for a, b in zip(first, past, strict=True))]
            near = ImageData(part, level.spacing, level.lowest + first * level.spacing)
            options = SurfaceOptions(max_triangles=MOST_TRIANGLES, smoothing=0)
            return surface_of_level(name, near, options)
    raise CaseInputError(f"the case gives no bone with the {jaw} teeth: {', '.join(BEARERS[jaw])}")


def _box(arch: DentalArch) -> tuple[Floats, Floats]:
    ends = np.stack([arch.tip, arch.left, arch.right])
    return ends.min(axis=0) - AROUND, ends.max(axis=0) + AROUND


def rigid_of(motion: ArrayLike | MovedSurface | None) -> Floats:
    """The rigid motion of a segment, (4, 4) mm: the nearest one where it bends; none, it stays."""
    if motion is None:
        return np.eye(4)
    if isinstance(motion, MovedSurface):
        fitted: Floats = rigid_fit(motion.surface.vertices, motion.moved_vertices).matrix
        return fitted
    return np.asarray(motion, dtype=np.float64)
