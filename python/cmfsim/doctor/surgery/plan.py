"""The plan of a case in a surgeon's words, and whether each motion has the size of a bone's."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim.bones.motion import sound_motion, torn_pieces
from cmfsim.doctor.evidence import Evidence
from cmfsim.errors import CmfsimError
from cmfsim.values.checks import Floats
from cmfsim.values.clinical_motion import ClinicalMotion, clinical_motion
from cmfsim.values.finding import Finding
from cmfsim.values.motion import decompose_motion
from cmfsim.values.surface_data import MovedSurface

# Motions of bone above which a plan is unusual, and above which it is implausible; mm and degrees.
# The largest relocation in Table 2 of the paper is 12.6 mm; distraction reaches 30 mm.
FAR, TOO_FAR = 20.0, 60.0
TURNED, TOO_TURNED = 20.0, 60.0
# A motion that no face shows, mm: a tenth of a voxel of a CT. 20 mm written in metres is 0.02.
TINY = 0.05
# Motions of less than this, mm and degrees, are more likely in centimetres, and those further to a
# side than this, mm, if that is most of the motion, in another order.
SMALL, SIDEWAYS = 1.0, 3.0
# Turns that nobody plans, degrees: 0.2 rad are 11°. Below the first, rounding of a typed matrix.
TINY_TURN = (1e-3, 0.2)
# No segment is turned about a point further from it than this, mm: a head is 250 mm high.
FAR_CENTRE = 150.0
# Bones that jaw surgery leaves where they are, by the names that segmentation and cases give them.
HELD = ("cranium", "skull")
# Less than this is rounding of no motion, mm and degrees.
NOTHING = 1e-6
# Where no surface of the segment is known, how far it reaches from the point that is, mm.
REACH = 60.0
# A bone whose vertices deviate by less than this from a rigid motion, mm RMS, was not cut.
BENT = 0.5


@dataclass(frozen=True, eq=False)
class SizedMotion:
    """A rigid motion of a segment, (4, 4) mm, with what its size is judged by.

    points: (k, 3), mm, or None, on the segment's surface, where one is known.
    point: (3,), mm, or None. One point of the segment, where no surface is known.
    typed: Whether it was given by translation, angle, axis and, perhaps, centre.
    """

    name: str
    matrix: Floats
    points: Floats | None = None
    point: Floats | None = None
    typed: bool = False
    centre: Floats | None = None


def check_motion_size(motion: SizedMotion) -> Iterator[Finding]:
    """Findings about a motion that is too large, too small, or turns too far or too little."""
    points = motion.points
    if points is None:
        points = (np.zeros(3) if motion.point is None else motion.point)[None]
    rotation, shift = motion.matrix[:3, :3], motion.matrix[:3, 3]
    far = float(np.linalg.norm(points @ rotation.T + shift - points, axis=1).max())
    angle = decompose_motion(motion.matrix).angle
    if far > FAR:
        remedy = "check translation (mm), sign and frame (LPS: forwards is −P)"
        if angle > 0.0 and motion.typed and motion.centre is None:
            remedy = (
                "give the centre of the rotation: without one, the segment rotates about the "
                "origin of the coordinates"
            )
        elif not motion.typed:
            remedy = "check the unit (mm), frame (LPS or RAS) and direction of the transform"
        yield Finding(
            "plan-far",
            f"{motion.name} moves by up to {far:.1f} mm",
            severity="error" if far > TOO_FAR else "warning",
            fix=remedy,
            facts={"most": FAR},
        )
    elif far > SMALL and motion.name in HELD:
        yield Finding("plan-cranium", f"{motion.name} moves by up to {far:.1f} mm")
    elif angle > TINY_TURN[0] and motion.typed and motion.centre is None:
        yield Finding(
            "plan-no-centre",
            f"{motion.name} turns by {angle:.1f}° about the origin of the coordinates, for no "
            f"centre is given: the turn moves it by up to {far:.1f} mm",
        )
    # The origin is where other programs turn about, with a translation that makes up for it.
    turns = motion.points is not None and angle > TINY_TURN[0]
    if turns and motion.centre is not None and motion.centre.any():
        away = float(np.linalg.norm(points - motion.centre, axis=1).min())
        if away > FAR_CENTRE:
            yield Finding(
                "plan-centre-far",
                f"{motion.name} turns about a point {away:.0f} mm away from it, and moves by up to "
                f"{far:.1f} mm",
            )
    yield from check_turn(motion.name, angle)
    reach = 0.0 if motion.points is not None else REACH * math.radians(angle)
    yield from check_tiny(motion.name, far + reach, angle)


def check_typed(motion: ClinicalMotion) -> Iterator[Finding]:
    """Findings about the numbers of a typed motion: in centimetres, or in another order."""
    size = math.hypot(motion.forwards, motion.up, motion.left)
    turn = math.hypot(motion.pitch, motion.yaw, motion.roll)
    if TINY <= size < SMALL and turn < SMALL:
        yield Finding(
            "plan-tiny",
            f"{motion.segment} moves by {size:.2g} mm",
            facts={"size": size, "unit": "cm", "larger": 10.0 * size},
        )
    if abs(motion.left) > SIDEWAYS and size < math.sqrt(2.0) * abs(motion.left):
        side = "left" if motion.left > 0.0 else "right"
        yield Finding(
            "plan-sideways",
            f"{motion.segment} moves {abs(motion.left):.1f} mm to the {side}, which is most of its "
            "motion",
        )


def nothing_moves(where: str, measured: float | None = None) -> Finding:
    """The warning about a plan that moves no segment; `measured`: how far at most, mm."""
    if measured is None:
        return Finding("plan-still", "no segment moves", where=where)
    what = f"no segment moved by more than {measured:.2g} mm between the two scans"
    fix = "check that the scan in [postoperative] is the one after the operation"
    return Finding("plan-still", what, where=where, fix=fix)


def check_turn(name: str, angle: float) -> Iterator[Finding]:
    """A finding about a turn, in degrees, of more than bone is turned."""
    if angle > TURNED:
        yield Finding(
            "plan-turned",
            f"{name} turns by {angle:.1f}°",
            severity="error" if angle > TOO_TURNED else "warning",
            facts={"most": TURNED},
        )


def check_tiny(name: str, far: float, angle: float) -> Iterator[Finding]:
    """Findings about a motion of `far` mm at most and a turn, in degrees, that nobody plans."""
    if NOTHING < far < TINY:
        yield Finding(
            "plan-tiny",
            f"{name} moves by {far:.2g} mm at most",
            why="this is too small to be visible: the prediction equals the face before the "
            "operation",
            facts={"size": far, "unit": "m", "larger": 1000.0 * far},
        )
    least, most = TINY_TURN
    if least <= angle < most:
        yield Finding(
            "plan-tiny-angle",
            f"{name} turns by {angle:.2g}°",
            facts={"angle": angle, "degrees": math.degrees(angle)},
        )


def state_plan(
    evidence: Evidence, vertices: Mapping[str, Floats | None]
) -> dict[str, ClinicalMotion]:
    """The motion of each segment that the plan names and that can be read, by name.

    An achieved plan is empty here: it is read off the bones when the case is built.
    vertices: Of the surface of each segment, (k, 3), mm, where known.
    """
    found: dict[str, ClinicalMotion] = {}
    for name, given in evidence.case.plan.items():
        if name not in evidence.motions:
            moved = evidence.moved.get(name)
            if isinstance(moved, MovedSurface):
                found |= _of_surface(evidence, name, moved, given.source())
            continue
        read = evidence.transforms.get(name)
        found[name] = clinical_motion(
            name,
            evidence.motions[name],
            landmarks=evidence.skull_landmarks,
            vertices=vertices.get(name),
            centre=given.centre,
            source=given.source("" if read is None else read.text),
        )
    return found


def _of_surface(
    evidence: Evidence, name: str, moved: MovedSurface, source: str
) -> dict[str, ClinicalMotion]:
    """A bone's motion, or that of each piece of a bone that was cut, as `build` names them."""
    marks = evidence.skull_landmarks
    whole = clinical_motion(name, moved, landmarks=marks, source=source)
    if whole.residual is None or whole.residual < BENT:
        return {name: whole}
    try:
        pieces = torn_pieces(sound_motion(moved))
    except CmfsimError:
        # Reported where bones before and after are compared.
        return {name: whole}
    if len(pieces) == 1:
        return {name: whole}
    named = {name if n == 0 else f"{name}_{n + 1}": piece for n, piece in enumerate(pieces)}
    return {
        part: clinical_motion(part, piece, landmarks=marks, source=source)
        for part, piece in named.items()
    }
