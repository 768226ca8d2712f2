"""The standard osteotomies, placed from skull landmarks by rules with named distances.

The rules follow the usual surgical descriptions (Bell 1975 for Le Fort I, Tessier 1971 for Le Fort
III, Trauner and Obwegeser 1957 with Dal Pont 1961 for the sagittal split, Trauner and Obwegeser
1957 for the chin); the distances below stand in for what a surgeon sees in the image, and each can
be changed. Left and right follow the names of the landmarks, never the sign of a coordinate.

A missing site is estimated where the other sites of its jaw put it in an average head; where its
partner on the other side is known, it departs from there as the partner does.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.bones.cuts.planes import Cut, CuttingPlane, Procedure, free_cut
from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.registration.closest import robust_similarity
from cmfsim.registration.proposed.shape_model.site_covariance import placed_distribution
from cmfsim.values.case_parts import CaseOsteotomy
from cmfsim.values.checks import Floats, as_number, check_one_of
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import REFERENCE_PLACES, SKULL_LANDMARKS, is_lower_site

# Of each procedure: the sites that it needs (nasion is not among those of Le Fort I: it would only
# state which side of the plane of the upper teeth is up); three with which all others can be
# estimated; and of each option the default, the lowest and the highest value, and what it states.
# Distances mm, angles degrees. Bone farther to the side than `width` stays: the lower edge of the
# zygoma is not shaved. A positive `tilt` of the chin's cut is right for roots that lean backwards.
_TABLE: Mapping[str, Any] = json.loads(
    files("cmfsim.bones.cuts").joinpath("procedures.json").read_text(encoding="utf-8")
)
PROCEDURES = tuple(_TABLE)
NEEDED: Mapping[str, tuple[str, ...]] = {kind: tuple(_TABLE[kind]["needed"]) for kind in _TABLE}
# Known sites spread at least this far across their longest direction, mm: a line of sites does not
# show how the head is turned about it.
LEAST_SPREAD = 8.0
# Heads smaller than this against the average adult's are a child's (adults: 0.87 to 1.11 in forty
# synthetic heads, 0.94 and 1.05 in two real ones); how many sites show the size, and the distance
# at which one counts half, mm.
SMALL_HEAD, LEAST_SITES, HALF_DISTANCE = 0.86, 6, 6.0
# How far roots reach beyond the bone landmark of their arch, mm, after Wheeler's mean root lengths
# (Nelson, Dental Anatomy): upper canine 17 with its neck 1 above that of the incisors, upper second
# molar 11 above the alveolar bone point, lower canine 16 with its neck 1 below and 1 for its lean.
UPPER_CANINE_REACH = 18.0
UPPER_MOLAR_REACH = 11.0
LOWER_CANINE_REACH = 18.0
# The edges of the upper incisors and the cusps of the second molars below the landmarks of their
# arch, mm: 12 to 13 and 11 to 20 in two skulls.
UPPER_INCISOR_EDGE = 13.0
UPPER_MOLAR_CUSP = 16.0
# Crown of a lower central incisor, mm (Wheeler): infradentale lies this much under the bite.
LOWER_INCISOR_CROWN = 9.0
# A chin piece lower than this is hard to fix with a plate, mm; where the symphysis is short, the
# clearance under the roots is reduced first, down to the least clearance.
CHIN_HEIGHT = 8.0
CHIN_LEAST_CLEARANCE = 1.0
# The frontozygomatic suture lies this part of the way from the lower to the upper orbital rim.
FRONTOZYGOMATIC_PART = 0.65
_JAW = ("mandible_body", "mandible")
_UPPER = ("midface", "cranium", "skull")
# The cuts of a procedure, and what is noticed as they are placed.
Placed: TypeAlias = tuple[tuple[Cut, ...], tuple[Finding, ...]]


def with_missing_sites(
    kind: str, landmarks: Mapping[str, Floats]
) -> tuple[dict[str, Floats], tuple[Finding, ...]]:
    """The sites of a procedure, missing ones estimated, and a warning that lists those.

    Raises `LandmarkError`: Too few are known; it names at most three to place, which do.
    """
    points = {name: landmarks[name] for name in NEEDED[kind] if name in landmarks}
    missing = [name for name in NEEDED[kind] if name not in points]
    if not missing:
        return points, ()
    is_lower = is_lower_site(NEEDED[kind][0])
    known = {n: p for n, p in landmarks.items() if n in REFERENCE_PLACES["skull"]}
    own = [name for name in known if is_lower_site(name) == is_lower]
    if not _spread([known[name] for name in own]):
        asked = [name for name in _TABLE[kind]["placing"] if name not in landmarks]
        raise LandmarkInputError(
            f"{kind} needs the landmark {asked[0]!r}"
            + (f" and {len(asked) - 1} more ({', '.join(asked[1:])})" if asked[1:] else "")
            + ": place it, or give the planes of the cut"
        )
    expected = placed_distribution(known)
    places = dict(zip(expected.names, expected.mean, strict=True))
    errors = dict(zip(expected.names, expected.errors, strict=True))
    points |= {name: places["skull", name] for name in missing}
    worst = max(errors["skull", name] for name in missing)
    estimated = Finding(
        "cut-site-estimated",
        f"{kind} is placed with {', '.join(missing)} estimated from {len(known)} other landmarks "
        f"and an average head; they may be {worst:.0f} mm off",
        where=kind,
    )
    return points, (estimated,)


def _spread(points: Sequence[Floats]) -> bool:
    """Whether points are three and more, and no line."""
    if len(points) < 3:
        return False
    offsets = np.array(points) - np.mean(points, axis=0)
    return bool(np.linalg.svd(offsets, compute_uv=False)[1] >= LEAST_SPREAD)


@dataclass(frozen=True)
class _Frame:
    """Directions of a jaw: to the patient's left, to the front, and from chin to brow."""

    left: Floats
    front: Floats
    up: Floats


def procedure_options(kind: str) -> dict[str, float]:
    """The options of a procedure with their defaults: distances in mm, angles in degrees.

    Parameters
    ----------
    kind : str
        "le_fort_1", "le_fort_3", "bsso" or "genioplasty".

    Raises
    ------
    CaseError
        (also `ValueError`) An unknown procedure.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.procedure_options("le_fort_1")["height"]
    5.0
    """
    check_one_of("procedure", kind, PROCEDURES)
    return {name: default for name, (default, *_) in _TABLE[kind]["options"].items()}


def option_ranges(kind: str) -> dict[str, tuple[float, float, float]]:
    """The default, lowest and highest value of each option of a procedure, mm or degrees."""
    return {name: tuple(option[:3]) for name, option in _TABLE[kind]["options"].items()}


def option_words(kind: str) -> dict[str, str]:
    """What each option of a procedure states: no motion, but where and how it cuts."""
    return {name: option[3] for name, option in _TABLE[kind]["options"].items()}


def place_procedure(
    kind: str, landmarks: Mapping[str, ArrayLike], options: Mapping[str, float] | None = None
) -> Procedure:
    """The procedure with its planes placed from skull landmarks.

    Le Fort I: a plane above the upper roots (height) through the piriform aperture, ending at a
    coronal plane at the pterygomaxillary junction (posterior). Le Fort III: a plane from the
    nasofrontal suture down to the pterygomaxillary junction, the lateral orbital walls below the
    frontozygomatic sutures, and the arches. BSSO: on each side the ramus behind an oblique plane
    that runs from the outer face behind the second molar to the inner face before the angle, and
    above a level over the lingula. Genioplasty: a plane below the lower front roots, falling
    backwards from the bite, ending below the second molars.

    Parameters
    ----------
    kind : str
        "le_fort_1", "le_fort_3", "bsso" or "genioplasty".
    landmarks : mapping of str to (3,) float64, mm
        Skull landmarks, LPS; left and right as labelled.
    options : mapping of str to float, optional
        Distances (mm) and angles (degrees) other than the defaults of `procedure_options`.

    Raises
    ------
    CaseError
        (also `ValueError`) An unknown procedure or option, a value out of its range.
    LandmarkError
        (also `ValueError`) Landmarks missing or misplaced; names the procedure and at most three
        landmarks that suffice. Single missing ones are estimated, with a finding.

    Examples
    --------
    >>> import cmfsim
    >>> placed = cmfsim.place_procedure("le_fort_1", landmarks, {"height": 4.0})
    >>> [cut.segment for cut in placed.cuts]
    ['maxilla']
    """
    chosen = _chosen_options(kind, options or {})
    given = {}
    for name, place in landmarks.items():
        if name not in SKULL_LANDMARKS:
            continue
        given[name] = point = np.asarray(place, dtype=np.float64)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise LandmarkInputError(
                f"landmark {name!r} of {kind} is {place!r}: three numbers needed"
            )
    points, estimated = with_missing_sites(kind, given)
    makers = (_le_fort_1, _le_fort_3, _bsso, _genioplasty)
    cuts, findings = dict(zip(PROCEDURES, makers, strict=True))[kind](points, chosen)
    if kind == "le_fort_1" and "height" not in (options or {}):
        findings = (*findings, *_small_head(given, chosen["height"]))
    return Procedure(kind, cuts, chosen, (*estimated, *findings))


def placed_cut(cut: CaseOsteotomy, landmarks: Mapping[str, ArrayLike]) -> Procedure:
    """A cut of a case: its procedure placed from skull landmarks, or its plane."""
    if cut.procedure is not None:
        return place_procedure(cut.procedure, landmarks, cut.options)
    plane = cut.plane
    if plane is None or cut.bone is None or cut.name is None:  # checked by `CaseOsteotomy`
        raise AssertionError(cut)
    return free_cut(cut.bone, cut.name, (CuttingPlane(plane.point, plane.normal),))


def _small_head(points: Mapping[str, Floats], height: float) -> Iterator[Finding]:
    """A warning where roots of an adult's length place the cut in a head of a child's size."""
    average = REFERENCE_PLACES["skull"]
    names = [name for name in points if not is_lower_site(name)]
    if len(names) < LEAST_SITES:
        return
    source, target = (np.array([places[n] for n in names]) for places in (average, points))
    size = robust_similarity(source, target, np.ones(len(names)), HALF_DISTANCE)[2]
    if size < SMALL_HEAD:
        yield Finding(
            "cut-small-head",
            f"the head has {size:.2f} times the size of an average adult's, and le_fort_1 runs "
            f"{height:g} mm above roots of an adult's length",
            where="le_fort_1",
        )


def _chosen_options(kind: str, options: Mapping[str, float]) -> dict[str, float]:
    chosen = procedure_options(kind)
    for name, value in options.items():
        if name not in chosen:
            raise CaseInputError(f"{kind} has no option {name!r}: use {', '.join(chosen)}")
        number = as_number(f"{kind} {name}", value)
        _, low, high, _ = _TABLE[kind]["options"][name]
        if not low <= number <= high:
            raise CaseInputError(f"{kind} {name} is {number:g}: {low:g} to {high:g} is allowed")
        chosen[name] = number
    return chosen


def _middle(points: Mapping[str, Floats], name: str) -> Floats:
    return 0.5 * (points[f"{name}_L"] + points[f"{name}_R"])


def _unit(kind: str, what: str, vector: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    # Landmarks of a jaw lie centimetres apart; under a millimetre two of them are the same point.
    if length < 1.0:
        raise LandmarkInputError(f"{kind}: {what} lie {length:.2g} mm apart: landmarks coincide")
    return vector / length


def _frame(
    kind: str,
    points: Mapping[str, Floats],
    pairs: Sequence[str],
    *,
    tip: Floats,
    back: Floats,
    above: Floats,
) -> _Frame:
    """Left from the pairs, front from `back` to `tip`, up towards `above`; each at right angles."""
    sides = sum((points[f"{n}_L"] - points[f"{n}_R"] for n in pairs), np.zeros(3))
    left = _unit(kind, f"left and right {pairs[0]}", sides)
    front = tip - back
    front = _unit(kind, "front and back of the arch", front - (front @ left) * left)
    up = above - (above @ left) * left
    up = _unit(kind, "arch and the point above it", up - (up @ front) * front)
    return _Frame(left, front, up)


def _upper_frame(kind: str, points: Mapping[str, Floats]) -> _Frame:
    left, right, tip = points["supra_m2_L"], points["supra_m2_R"], points["supradentale"]
    # Towards the vertex, however the head nods: LPS is upright within 90°.
    above = np.cross(left - tip, right - tip)
    above = above * (np.sign(above[2]) or 1.0)
    return _frame(
        kind, points, ("supra_m2",), tip=tip, back=_middle(points, "supra_m2"), above=above
    )


def _lower_frame(kind: str, points: Mapping[str, Floats]) -> _Frame:
    """Along the bite: from the rami at its height to the edges of the lower incisors."""
    back, above = _middle(points, "occlusal_line"), points["infradentale"] - points["menton"]
    names = ("occlusal_line", "sub_m2")
    first = _frame(kind, points, names, tip=points["infradentale"], back=back, above=above)
    tip = points["infradentale"] + LOWER_INCISOR_CROWN * first.up
    return _frame(kind, points, names, tip=tip, back=back, above=above)


def _turned(vector: Floats, towards: Floats, degrees: float) -> Floats:
    """A unit vector turned towards another one at right angles to it."""
    angle = math.radians(degrees)
    return math.cos(angle) * vector + math.sin(angle) * towards


def _le_fort_1(points: Mapping[str, Floats], options: Mapping[str, float]) -> Placed:
    frame = _upper_frame("le_fort_1", points)
    molars = _middle(points, "supra_m2")
    tip = points["supradentale"] + (UPPER_CANINE_REACH + options["height"]) * frame.up
    back = molars + (UPPER_MOLAR_REACH + options["height"]) * frame.up
    ahead = tip - back
    ahead = _unit(
        "le_fort_1", "front and back of the plane", ahead - (ahead @ frame.left) * frame.left
    )
    down = np.cross(frame.left, ahead)
    down = -down * np.sign(down @ frame.up)
    # Raising the front turns the downward normal forwards; raising the left turns it leftwards.
    down = _turned(down, ahead, options["tilt"])
    down = _turned(down, frame.left, options["cant"])
    planes = (
        CuttingPlane(back, down, "Le Fort I"),
        _junction(points, frame, options["posterior"]),
        *(
            CuttingPlane(
                points[f"supra_m2_{side}"] + options["width"] * out, -out, f"zygoma {side}"
            )
            for side, out in (("L", frame.left), ("R", -frame.left))
        ),
    )
    return (Cut("maxilla", (planes,), _UPPER, joined=_bite(points, frame)),), ()


def _bite(points: Mapping[str, Floats], frame: _Frame) -> CuttingPlane:
    """The plane through the edges of the upper teeth; what lies above it is of the upper jaw."""
    tip = points["supradentale"] - UPPER_INCISOR_EDGE * frame.up
    back = _middle(points, "supra_m2") - UPPER_MOLAR_CUSP * frame.up
    normal = np.cross(frame.left, tip - back)
    return CuttingPlane(tip, normal * np.sign(normal @ frame.up), "bite")


def _junction(points: Mapping[str, Floats], frame: _Frame, posterior: float) -> CuttingPlane:
    """The coronal plane at the pterygomaxillary junction; what lies before it moves."""
    place = _middle(points, "supra_m2") - posterior * frame.front
    return CuttingPlane(place, frame.front, "pterygomaxillary junction")


def _le_fort_3(points: Mapping[str, Floats], options: Mapping[str, float]) -> Placed:
    frame = _upper_frame("le_fort_3", points)
    junction = _junction(points, frame, options["posterior"])
    top = points["nasion"] + options["height"] * frame.up
    bottom = junction.point + options["junction"] * frame.up
    along = top - bottom
    along = _unit("le_fort_3", "nasion and the junction", along - (along @ frame.left) * frame.left)
    down = np.cross(frame.left, along)
    # Into the face: forwards and down.
    down = down * np.sign(down @ (frame.front - frame.up))
    groups: list[tuple[CuttingPlane, ...]] = [(CuttingPlane(top, down, "nasofrontal"), junction)]
    for side, outward in (("L", frame.left), ("R", -frame.left)):
        upper, lower = points[f"supraorbital_{side}"], points[f"suborbital_{side}"]
        rim, arch = points[f"lateral_orbit_{side}"], points[f"zygomatic_arch_{side}"]
        suture = lower + FRONTOZYGOMATIC_PART * (upper - lower)
        wall = rim - options["wall"] * frame.front
        below = CuttingPlane(suture, -frame.up, f"frontozygomatic {side}")
        beside = CuttingPlane(0.5 * (lower + rim), outward, f"orbit {side}")
        groups.append((below, beside, CuttingPlane(wall, frame.front, f"lateral wall {side}")))
        cut = rim + options["arch"] * (arch - rim)
        lateral = CuttingPlane(rim, outward, f"beside the orbit {side}")
        groups.append((below, lateral, CuttingPlane(cut, frame.front, f"arch {side}")))
    bite = _bite(points, frame)
    return (Cut("midface", tuple(groups), ("cranium", "skull"), joined=bite),), ()


def _bsso(points: Mapping[str, Floats], options: Mapping[str, float]) -> Placed:
    frame = _lower_frame("bsso", points)
    middle = 0.5 * (points["infradentale"] + points["menton"])
    cuts = []
    for side, name, outward in (("L", "ramus_left", frame.left), ("R", "ramus_right", -frame.left)):
        molar, angle = points[f"sub_m2_{side}"], points[f"gonion_{side}"]
        outer = molar + options["setback"] * _unit("bsso", f"sub_m2_{side}, gonion", angle - molar)
        behind = _turned(-frame.front, outward, options["angle"])
        bite = points[f"occlusal_line_{side}"] + options["lingula"] * frame.up
        half = CuttingPlane(middle, outward, f"half {side}")
        groups = (
            (half, CuttingPlane(outer, behind, f"sagittal split {side}")),
            (half, CuttingPlane(bite, frame.up, f"above the lingula {side}")),
        )
        cuts.append(Cut(name, groups, _JAW, "mandible_body"))
    return tuple(cuts), ()


def _genioplasty(points: Mapping[str, Floats], options: Mapping[str, float]) -> Placed:
    frame = _lower_frame("genioplasty", points)
    tip, menton = points["infradentale"], points["menton"]
    symphysis = float((tip - menton) @ frame.up)
    room = symphysis - LOWER_CANINE_REACH - CHIN_HEIGHT
    wanted = options["clearance"]
    clearance = min(wanted, max(room, CHIN_LEAST_CLEARANCE))
    findings: tuple[Finding, ...] = ()
    if clearance < wanted:
        findings = (
            Finding(
                "chin-short",
                f"the chin is {symphysis:.1f} mm high, so the cut passes {clearance:.1f} mm below "
                f"the estimated roots instead of {wanted:.1f} mm",
                where="genioplasty",
            ),
        )
    front = tip - (LOWER_CANINE_REACH + clearance) * frame.up
    below = _turned(-frame.up, frame.front, options["tilt"])
    end = _middle(points, "sub_m2") - options["posterior"] * frame.front
    planes = (
        CuttingPlane(front, below, "genioplasty"),
        CuttingPlane(end, frame.front, "behind the chin"),
    )
    return (Cut("chin", (planes,), _JAW),), findings
