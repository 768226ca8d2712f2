"""Bone motions in a surgeon's words: millimetres at the teeth, and turns in degrees.

A wrong sign, unit, frame or direction of a plan gives a plausible face; it is seen at once where
the plan reads "5.0 mm backwards". So the motion of each segment is stated before it is applied.

Axes are the patient's (LPS). Translations are those of one point of the segment, which is named:
forwards is −P, up +S, left +L. Turns are the three components of the rotation vector (axis times
angle), in degrees, independent of their order: pitch is positive with the front up, yaw with the
front to the left, roll with the left side up. The inverse motion has the opposite turns.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import rigid_fit
from cmfsim.errors import BoundaryInputError, RegistrationError
from cmfsim.values.checks import Floats
from cmfsim.values.language import translated
from cmfsim.values.motion import decompose_motion, rigid_motion
from cmfsim.values.surface_data import MovedSurface

# Below this, mm and degrees, a motion is rounding of none.
NOTHING = 1e-6
# What prints as 0.0, mm and degrees, is left out beside larger parts.
PRINTED = 0.05
# A turn below this is not printed even alone, degrees: rounding of coordinates in single precision.
LEAST_TURN = 1e-3
# A landmark within this of a segment's vertices lies on the segment, mm.
ON_SEGMENT = 3.0
# Where surgeons measure a segment: landmarks (`cmfsim.SKULL_LANDMARKS`), with what lies there.
INCISORS = ("supradentale", "upper incisors")
LOWER_INCISORS = ("infradentale", "lower incisors")
POGONION = ("pogonion", "chin point")
SITES: Mapping[str, tuple[tuple[str, str], ...]] = MappingProxyType({
    "maxilla": (INCISORS,), "midface": (INCISORS,), "mandible": (LOWER_INCISORS, POGONION),
    "mandible_body": (LOWER_INCISORS, POGONION),
    "chin": (POGONION, ("menton", "lowest point of the chin")),
    "ramus_left": (("gonion_L", "left angle of the mandible"),),
    "ramus_right": (("gonion_R", "right angle of the mandible"),),
})  # fmt: skip
# A piece of a bone that was separated has the bone's name with a number.
NUMBERED = re.compile(r"_\d+$")


@dataclass(frozen=True, eq=False)
class ClinicalMotion:
    """The motion of one segment in clinical terms.

    Attributes
    ----------
    segment : str
    forwards, up, left : float, mm
        Of the point; negative backwards, down and to the patient's right.
    pitch, yaw, roll : float, degrees
        Positive: front up, front to the left, left side up.
    point : (3,) float64, mm, LPS, or None
        The point before the motion; None if a motion without rotation has the same numbers
        everywhere.
    place : str
        Name of the point, such as "upper incisors (supradentale)".
    residual : float or None, mm
        For a motion given vertex by vertex: its deviation from the nearest rigid motion, which the
        numbers describe (RMS over the vertices). None for a rigid motion.
    source : str
        Where the motion comes from and how it was understood; may be empty.
    """

    segment: str
    forwards: float
    up: float
    left: float
    pitch: float
    yaw: float
    roll: float
    point: Floats | None = None
    place: str = ""
    residual: float | None = None
    source: str = ""
    # Whether the motion is exactly none, as far as doubles tell.
    stays: bool = field(default=False)

    @property
    def text(self) -> str:
        """The motion in words, such as "5.0 mm forwards, 0.5 mm up at the upper incisors …"."""
        if self.stays:
            return "stays"
        # Of a measured motion tiny parts are noise; of a computed one they may be metres.
        is_exact = self.residual is None or self.residual < PRINTED
        shifts = _parts(
            (
                (self.forwards, "mm forwards", "mm backwards"),
                (self.up, "mm up", "mm down"),
                (self.left, "mm to the left", "mm to the right"),
            ),
            NOTHING if is_exact else PRINTED,
        )
        moved = ", ".join(f"{size} {words}" for _, size, words in shifts) or "0.0 mm"
        at = f" at the {self.place}" if self.place else ""
        turns = _parts(
            (
                (self.pitch, "pitch|front up", "pitch|front down"),
                (self.yaw, "yaw|front to the left", "yaw|front to the right"),
                (self.roll, "roll|left side up", "roll|left side down"),
            ),
            LEAST_TURN if is_exact else PRINTED,
        )
        turned = [
            f"{words.split('|')[0]} {sign}{size}° ({words.split('|')[1]})"
            for sign, size, words in turns
        ]
        parts = [moved + at, ", ".join(turned)]
        if self.residual is not None and self.residual >= PRINTED:
            parts.append(
                "given vertex by vertex: this is the nearest rigid motion, from which the "
                f"vertices deviate by {self.residual:.1f} mm RMS"
            )
        return "; ".join(part for part in parts if part)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "text": self.text,
            **{f"{name}_mm": getattr(self, name) for name in ("forwards", "up", "left")},
            **{f"{name}_deg": getattr(self, name) for name in ("pitch", "yaw", "roll")},
            "place": self.place,
            "point": None if self.point is None else self.point.tolist(),
            "residual_mm": self.residual,
            "source": self.source,
        }


def clinical_motion(
    segment: str,
    motion: ArrayLike | MovedSurface,
    *,
    landmarks: Mapping[str, ArrayLike] | None = None,
    vertices: ArrayLike | None = None,
    centre: ArrayLike | None = None,
    source: str = "",
) -> ClinicalMotion:
    """The motion of a segment in clinical terms, measured at its teeth if these are known.

    The point is that of the segment's landmark (maxilla and midface: supradentale; mandible and
    mandible_body: infradentale, else pogonion; chin: pogonion, else menton; rami: gonion); without
    it, the front lower end of the segment's extent (rami: the rear lower one); the middle of its
    extent for other segments, unless one of these landmarks lies on it; else the centre of the
    turn.

    Parameters
    ----------
    segment : str
        Its name.
    motion : (4, 4) float64, mm, or MovedSurface, or (v, 3) float64, mm
        In LPS; the last are displacements of the vertices.
    landmarks : mapping of str to (3,) float64, mm, optional
        Skull landmarks.
    vertices : (v, 3) float64, mm, optional
        Of the segment's surface, before the motion; default: those of a MovedSurface.
    centre : (3,) float64, mm, optional
        Of the turn, where neither landmark nor surface is known.
    source : str
        Where the motion comes from, in words.

    Raises
    ------
    BoundaryError
        (also `ValueError`) Not a rigid motion.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.rigid_motion((0, -5, 0.5), angle=-2, axis=(1, 0, 0), centre=(0, -90, 20))
    >>> teeth = {"supradentale": (0, -90, 20)}
    >>> cmfsim.clinical_motion("maxilla", motion, landmarks=teeth).text
    '5.0 mm forwards, 0.5 mm up at the upper incisors (supradentale); pitch +2.0° (front up)'
    """
    residual: float | None = None
    points = None if vertices is None else np.asarray(vertices, dtype=np.float64)
    pairs = _pairs(motion, points)
    if pairs is None:
        matrix = np.asarray(motion, dtype=np.float64)
    else:
        matrix, residual = _nearest_rigid(*pairs)
        points = pairs[0] if points is None else points
    turn = decompose_motion(matrix)
    wx, wy, wz = (turn.angle * turn.axis).tolist()
    point, place = _reference(segment, landmarks or {}, points)
    if point is None and centre is not None:
        point, place = np.asarray(centre, dtype=np.float64), "centre of rotation"
    if point is None and turn.angle > NOTHING:
        point, place = np.zeros(3), "origin of the coordinates (no landmark or surface is known)"
    at = np.zeros(3) if point is None else point
    shift = matrix[:3, :3] @ at + matrix[:3, 3] - at
    if pairs is None:
        exact = turn.angle <= NOTHING and bool(np.abs(shift).max() <= NOTHING)
    else:
        exact = bool(np.abs(pairs[1] - pairs[0]).max(initial=0.0) <= NOTHING)
    # Zero without a sign.
    forwards, up, left = (float(part) + 0.0 for part in (-shift[1], shift[2], shift[0]))
    pitch, yaw, roll = (part + 0.0 for part in (-wx, wz, -wy))
    shifts, turns = (forwards, up, left), (pitch, yaw, roll)
    return ClinicalMotion(segment, *shifts, *turns, point, place, residual, source, stays=exact)


def planned_motion(
    point: ArrayLike, *, shift: ArrayLike = (0.0, 0.0, 0.0), turn: ArrayLike = (0.0, 0.0, 0.0)
) -> Floats:
    """The rigid motion with given clinical numbers at a point: the inverse of `clinical_motion`.

    Parameters
    ----------
    point : (3,) float64, mm, LPS
        Where the shift is measured, before the motion.
    shift : (3,) float64, mm
        Of the point: forwards, up, to the patient's left.
    turn : (3,) float64, degrees
        Pitch (front up), yaw (front to the left), roll (left side up): the components of the
        rotation vector, as `ClinicalMotion` states them.

    Returns
    -------
    (4, 4) float64, mm

    Raises
    ------
    BoundaryError
        (also `ValueError`) Not three finite numbers.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.planned_motion((0, -90, 20), shift=(5, 0.5, 0), turn=(2, 0, 0))
    >>> cmfsim.clinical_motion("maxilla", motion, landmarks={"supradentale": (0, -90, 20)}).text
    '5.0 mm forwards, 0.5 mm up at the upper incisors (supradentale); pitch +2.0° (front up)'
    """
    rows = (np.asarray(shift, dtype=np.float64), np.asarray(turn, dtype=np.float64))
    for name, row in zip(("shift", "turn"), rows, strict=True):
        if row.shape != (3,) or not np.isfinite(row).all():
            raise BoundaryInputError(f"{name} is {row.tolist()}: three finite numbers are needed")
    (forwards, up, left), (pitch, yaw, roll) = rows
    vector = np.array([-pitch, -roll, yaw])
    angle = float(np.linalg.norm(vector))
    axis = vector if angle else (1.0, 0.0, 0.0)
    return rigid_motion((left, -forwards, up), angle, axis, point)


def plan_lines(plan: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The lines that state a plan of `ClinicalMotion.as_dict()`: what moves, then what stays."""
    lines = []
    for name, motion in plan.items():
        if motion["text"] != "stays":
            source = f" [{motion['source']}]" if motion["source"] else ""
            moved, at, rest = motion["text"].partition(" at the ")
            at = f" {translated(f'{at}{rest}'.strip())}" if at else ""
            lines.append(f"{name}: {translated(moved)}{at}{source}")
    still = [name for name, motion in plan.items() if motion["text"] == "stays"]
    if still:
        lines.append(f"{', '.join(still)}: {translated('stays' if len(still) == 1 else 'stay')}")
    return lines


def _parts(entries: Iterable[tuple[float, str, str]], least: float) -> list[tuple[str, str, str]]:
    """Sign, size and words of the parts that are not zero; digits follow where all are tiny."""
    entries = list(entries)
    tiny = max(abs(value) for value, _, _ in entries) < PRINTED
    return [
        ("+" if value > 0.0 else "−", f"{abs(value):.2g}" if tiny else f"{abs(value):.1f}", word)
        for value, above, below in entries
        if abs(value) >= (least if tiny else PRINTED)
        for word in (above if value > 0.0 else below,)
    ]


def _pairs(motion: ArrayLike | MovedSurface, points: Floats | None) -> tuple[Floats, Floats] | None:
    """Places before and after, where a motion is given vertex by vertex."""
    if isinstance(motion, MovedSurface):
        return (motion.surface.vertices, motion.moved_vertices)
    shifts = np.asarray(motion, dtype=np.float64)
    return (
        (points, points + shifts) if points is not None and shifts.shape == points.shape else None
    )


def _nearest_rigid(here: Floats, there: Floats) -> tuple[Floats, float]:
    """The rigid motion nearest to a motion of vertices, and what it leaves, mm RMS."""
    try:
        fit = rigid_fit(here, there)
    except RegistrationError:
        # Vertices on a line, or all in one place: no turn can be told.
        matrix = np.eye(4)
        matrix[:3, 3] = (there - here).mean(axis=0)
        rest = there - here - matrix[:3, 3]
        return matrix, float(np.sqrt((rest**2).sum(axis=1).mean()))
    return fit.matrix, float(fit.rms)


def _reference(
    segment: str, landmarks: Mapping[str, ArrayLike], points: Floats | None
) -> tuple[Floats | None, str]:
    """The point at which a segment's motion is stated, and what lies there."""
    base = NUMBERED.sub("", segment)
    sites = SITES.get(base, ())
    for name, words in sites:
        if name in landmarks:
            return np.asarray(landmarks[name], dtype=np.float64), f"{words} ({name})"
    if points is None or not len(points):
        return None, ""
    if sites:
        return _end(base, points)
    for name, words in dict.fromkeys(site for known in SITES.values() for site in known):
        if name in landmarks:
            place = np.asarray(landmarks[name], dtype=np.float64)
            if np.linalg.norm(points - place, axis=1).min() <= ON_SEGMENT:
                return place, f"{words} ({name})"
    return _end(base, points)


def _end(base: str, points: Floats) -> tuple[Floats, str]:
    """A point at the ends of a segment, where no landmark names one, and in words with its place.

    Ends hardly depend on how fine a surface is, so every command states the same point; a vertex
    that is chosen, or a mean of vertices, would be another on each surface.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    point = 0.5 * (low + high)
    words = "middle of its extent"
    if base.startswith("ramus"):
        point[1:] = high[1], low[2]
        words = "rear lower end of its extent, near the angle"
    elif base in SITES:
        point[1:] = low[1], low[2]
        near = "incisors" if base in {"maxilla", "midface"} else "chin"
        words = f"front lower end of its extent, near the {near}"
    return point, f"{words}, at ({', '.join(f'{x:.1f}' for x in point)})"
