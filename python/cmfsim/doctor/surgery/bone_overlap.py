"""Whether the plan moves bones of one jaw through those of the other, or out of the joint."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmfsim.doctor.evidence import place_text
from cmfsim.surfaces.depth import distances
from cmfsim.values.anatomy import LOWER_BEARERS, UPPER_BEARERS
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.motion import carried
from cmfsim.values.surface_data import MovedSurface, SurfaceData

# How much deeper than before bone of one jaw may lie within that of the other, mm: planned bites
# overlap by some tenths, for scans blur teeth.
OVERLAPS = 1.0
# How far a joint head may be moved before a split of the jaw seems to be missing, mm, and how near
# to the skull it lies, mm: the joint space is 2 to 4 mm wide.
LEAVES_JOINT, IN_JOINT = 5.0, 8.0
# Bone around a joint head is judged by how far the head moves alone, mm: it is 20 mm wide.
AROUND_JOINT = 20.0
# How far the lower alveolar process may lie in front of the upper one at the front teeth, mm, under
# a plan that brings it there; and how far behind it lies at most under one that moves it back. On
# the average head it lies 3.4 mm behind. Less than the last, the plan does not decide on the bite.
REVERSED, FAR_BEHIND, GOOD_BITE, DECIDES = 2.0, 9.4, (0.4, 6.4), 3.0
# Share of a bone's points, deeper than this in mm, from which on it lies within the other.
WITHIN, TOUCHES = 0.05, 0.5
# Matrices whose entries differ by less, mm, are one motion.
SAME_MOTION = 1e-9
# Points of a bone that are looked up.
MOST_POINTS = 6000
# Words in the names of bones of the two jaws; of the lower one first, for it has no midface.
LOWER_WORDS = ("mandib", "lower", "ramus", "chin", "condyl", "unterkiefer")
UPPER_WORDS = ("maxill", "upper", "midface", "crani", "skull", "oberkiefer")


def jaw_of(name: str) -> str | None:
    """The jaw that a bone belongs to by its name, "lower" or "upper"; None if it shows neither."""
    for jaw, words in (("lower", LOWER_WORDS), ("upper", UPPER_WORDS)):
        if any(word in name.lower() for word in words):
            return jaw
    return None


@dataclass(frozen=True, eq=False)
class BonePart:
    """A bone or segment of the "lower" or "upper" jaw with its motion, (4, 4) mm or MovedSurface.

    surface: Closed; of a segment that of its bone.
    owns: Which of (n, 3) points within its bone are its own.
    """

    name: str
    jaw: str
    where: str
    surface: SurfaceData
    motion: Floats | MovedSurface
    owns: Callable[[Floats], NDArray[np.bool_]] = lambda points: np.ones(len(points), dtype=bool)

    @property
    def is_still(self) -> bool:
        """Whether it is not moved."""
        if isinstance(self.motion, MovedSurface):
            return False
        return np.array_equal(self.motion, np.eye(4))

    @cached_property
    def points(self) -> tuple[Floats, Floats]:
        """Its own vertices and triangle centres before, and after the motion, (k, 3) mm each."""
        motion = self.motion
        surface = motion.surface if isinstance(motion, MovedSurface) else self.surface
        before = _sampled(surface.vertices, surface.triangles)
        own = self.owns(before)
        if isinstance(motion, MovedSurface):
            return before[own], _sampled(motion.moved_vertices, surface.triangles)[own]
        return before[own], carried(motion, before[own])

    def depth(self, places: Floats, motion: Floats | MovedSurface | None = None) -> Floats:
        """How deep places lie inside it, mm: 0 outside; before the operation without a motion."""
        surface = self.surface
        if isinstance(motion, MovedSurface):
            surface = SurfaceData(motion.moved_vertices, motion.surface.triangles)
        elif motion is not None:
            places = (places - motion[:3, 3]) @ motion[:3, :3]
        found = np.zeros(len(places))
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        inside = np.flatnonzero(((places > low) & (places < high)).all(axis=1))
        if not len(inside):
            return found
        searched = surface.searched
        inside = inside[searched.winding_number(places[inside]) > 0.5]
        inside = inside[self.owns(places[inside])]
        found[inside] = distances(places[inside], searched)
        return found


def _sampled(vertices: Floats, triangles: NDArray[np.uint32]) -> Floats:
    points = np.concatenate([vertices, vertices[triangles].mean(axis=1)])
    return points[:: -(-len(points) // MOST_POINTS)]


def check_jaws(parts: Sequence[BonePart], landmarks: Mapping[str, Floats]) -> tuple[Finding, ...]:
    """Findings about jaws that a plan moves through each other, apart, or out of the joint."""
    joints = _joints(parts)
    return (
        *_check_overlap(parts, [joint.before for joint in joints]),
        *_check_bite(parts, landmarks),
        *_check_joints(joints),
    )


def _check_overlap(parts: Sequence[BonePart], joints: Sequence[Floats]) -> Iterator[Finding]:
    """Findings about bones of the lower jaw that a plan moves into those of the upper one.

    Points of the lower jaw are looked up in the upper one, and may lie deeper than before by a
    millimetre: surfaces that touched or overlapped before are no finding.
    """
    worst: tuple[float, Floats, BonePart, BonePart] | None = None
    for lower, upper in _pairs(parts):
        gain, place = _deeper(lower, upper, joints)
        if gain > (OVERLAPS if worst is None else worst[0]):
            worst = gain, place, lower, upper
    if worst is None:
        return
    gain, place, lower, upper = worst
    moving = upper if lower.is_still else lower
    yield Finding(
        "plan-through-bone",
        f"{lower.name} lies {gain:.1f} mm deeper within {upper.name} than before, at "
        f"{place_text(place)}",
        where=moving.where,
        fix=_remedy(lower, upper, gain, joints),
    )


def _pairs(parts: Sequence[BonePart]) -> Iterator[tuple[BonePart, BonePart]]:
    """The lower and upper bones that move against each other."""
    lower, upper = ([part for part in parts if part.jaw == jaw] for jaw in ("lower", "upper"))
    for pair in itertools.product(lower, upper):
        matrices = [part.motion for part in pair if not isinstance(part.motion, MovedSurface)]
        if len(matrices) < 2 or np.abs(matrices[0] - matrices[1]).max() > SAME_MOTION:
            yield pair


def _deeper(lower: BonePart, upper: BonePart, joints: Sequence[Floats]) -> tuple[float, Floats]:
    """How much deeper than before the lower bone lies in the upper one at most, mm, and where."""
    before, after = lower.points
    for joint in joints:
        away = np.linalg.norm(before - joint, axis=1) > AROUND_JOINT
        before, after = before[away], after[away]
    was, depth = upper.depth(before), upper.depth(after, upper.motion)
    # A bone that lies within another is given twice, which is reported where surfaces are checked.
    if not depth.any() or float((was > TOUCHES).mean()) > WITHIN:
        return 0.0, np.zeros(3)
    worst = int(np.argmax(depth - was))
    return float(depth[worst] - was[worst]), after[worst]


def _remedy(lower: BonePart, upper: BonePart, gain: float, joints: Sequence[Floats]) -> str:
    """What to check: whether the motions of the jaws are exchanged is tried out."""
    remedy = "check the signs (LPS: forwards is −P, up is +S) and the units of both jaws' motions"
    if lower.is_still or upper.is_still:
        still = lower.name if lower.is_still else upper.name
        return f"{remedy}; {still} is not moved: is its motion missing?"
    if isinstance(lower.motion, MovedSurface) or isinstance(upper.motion, MovedSurface):
        return remedy
    one, other = replace(lower, motion=upper.motion), replace(upper, motion=lower.motion)
    exchanged = _deeper(one, other, joints)[0]
    if exchanged < 0.5 * gain:
        return (
            f"the tables of {lower.name} and {upper.name} seem to be exchanged: the other way "
            f"round, the bones lie {exchanged:.1f} mm deeper than before"
        )
    return remedy


def _check_bite(parts: Sequence[BonePart], landmarks: Mapping[str, Floats]) -> Iterator[Finding]:
    """A finding about front teeth that a plan moves apart, where another reading joins them."""
    upper, lower = _bearer(parts, UPPER_BEARERS), _bearer(parts, LOWER_BEARERS)
    if upper is None or lower is None or not {"supradentale", "infradentale"} <= set(landmarks):
        return
    one, other = upper.motion, lower.motion
    if isinstance(one, MovedSurface) or isinstance(other, MovedSurface):
        return
    teeth = landmarks["supradentale"], landmarks["infradentale"]
    before, after = _behind(teeth, np.eye(4), np.eye(4)), _behind(teeth, one, other)
    reverse = _behind(teeth, _inverse(one), _inverse(other))
    read = {"the signs are reversed (LPS: forwards is −P, so 5 mm forwards is −5)": reverse}
    if not (upper.is_still or lower.is_still):
        exchanged = f"the tables of {upper.name} and {lower.name} are exchanged"
        read[exchanged] = _behind(teeth, other, one)
    low, high = GOOD_BITE
    if after < -REVERSED and after < before - DECIDES:
        better = [text for text, bite in read.items() if bite > 0.0]
    elif after > FAR_BEHIND and after > before + DECIDES:
        better = [text for text, bite in read.items() if low < bite < high]
    else:
        return
    if not better:
        return
    moving = lower if upper.is_still else upper
    words = "in front of" if after < 0.0 else "behind"
    was = "in front of" if before < 0.0 else "behind"
    yield Finding(
        "bite-odd",
        f"the plan takes the bone at the lower front teeth from {abs(before):.0f} mm {was} that at "
        f"the upper ones to {abs(after):.0f} mm {words} it (infradentale, supradentale)",
        where=moving.where,
        facts={"better": ", or ".join(better)},
    )


def _behind(teeth: tuple[Floats, Floats], up: Floats, low: Floats) -> float:
    """How far the lower front teeth lie behind the upper ones after motions of both jaws, mm."""
    above, below = (m[:3, :3] @ p + m[:3, 3] for m, p in zip((up, low), teeth, strict=True))
    return float(below[1] - above[1])


def _inverse(motion: Floats) -> Floats:
    """The motion back, (4, 4) mm."""
    turn = motion[:3, :3].T
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = turn, -turn @ motion[:3, 3]
    return back


def _bearer(parts: Sequence[BonePart], names: Sequence[str]) -> BonePart | None:
    by_name = {part.name: part for part in parts}
    return next((by_name[name] for name in names if name in by_name), None)


@dataclass(frozen=True, eq=False)
class _Joint:
    """A joint head: its place before, how far it is moved, mm, and the bone that it is part of."""

    before: Floats
    far: float
    part: BonePart


def _joints(parts: Sequence[BonePart]) -> list[_Joint]:
    """The heads of the lower jaw that lie at the skull."""
    skull = [part for part in parts if part.jaw == "upper"]
    lower = [part for part in parts if part.jaw == "lower"]
    if not skull or not lower:
        return []
    places = [part.points for part in lower]
    before, after = (np.concatenate(points) for points in zip(*places, strict=True))
    owner = np.repeat(np.arange(len(lower)), [len(points) for points, _ in places])
    far = np.linalg.norm(after - before, axis=1)
    return [
        _Joint(before[head], float(far[head]), lower[owner[head]])
        for head in joint_heads(before)
        if _in_joint(before[head], skull)
    ]


def _check_joints(joints: Sequence[_Joint]) -> Iterator[Finding]:
    """A finding about the joint head that the plan moves furthest out of its joint."""
    worst = max(joints, key=lambda joint: joint.far, default=None)
    if worst is None or worst.far < LEAVES_JOINT:
        return
    yield Finding(
        "joint-left",
        f"the joint head of {worst.part.name} at {place_text(worst.before)} leaves its joint by "
        f"{worst.far:.1f} mm",
        where=worst.part.where,
    )


def joint_heads(points: Floats) -> Iterator[int]:
    """The point furthest up and back on each side, LPS: that of the joint head of a whole jaw."""
    middle = 0.5 * (points[:, 0].min() + points[:, 0].max())
    height = points[:, 1] + points[:, 2]
    for side in (points[:, 0] < middle, points[:, 0] >= middle):
        own = np.flatnonzero(side)
        if len(own):
            yield int(own[np.argmax(height[own])])


def _in_joint(head: Floats, skull: Sequence[BonePart]) -> bool:
    """Whether a joint head lies at the skull."""
    nearest = [part.surface.searched.closest(head[None])[0][0] for part in skull]
    return min(float(np.linalg.norm(place - head)) for place in nearest) < IN_JOINT
