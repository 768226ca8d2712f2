"""Whether each landmark is where its name puts it: on its surface, mirrored, among the others.

The doctor compares with the surfaces of the case, or with the bone and skin of its CT by their
thresholds; a build compares again with the bones that it has segmented.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module

import numpy as np

from cmfsim._core import Surface
from cmfsim.doctor.evidence import Evidence, direction_text, place_text, shift_text
from cmfsim.errors import LandmarkError, RegistrationError
from cmfsim.registration import common_shift, leave_one_out, mirror_agreement, swapped_names
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.image_data import ImageData
from cmfsim.values.landmark_sites import REFERENCE_PLACES

# The closest points on a surface of (n, 3) points, mm.
Nearest = Callable[[Floats], Floats]

# Distance of a landmark from its surface that is worth a warning, mm: operators' own points lie 0.9
# mm from the bone (median), 3.2 mm at most. From the second on it lies on something else.
FAR, TOO_FAR = 3.5, 10.0
# Median distance of a whole set above which it belongs to something else, mm.
ANOTHER = 5.0
# Share of a set that lies too far off, from which on it is the set that is wrong.
MANY = 0.25
# Least shift of a whole set that is reported, mm, and the share of the mean distance that it must
# leave at most: points with 1 mm of noise are never shifted by 1.5 mm on so good a ground.
LEAST_SHIFT, SHIFT_LEAVES = 2.0, 0.5
# Shift that no cut survives, mm.
SHIFT_ERROR = 10.0
# Distance of a landmark from its place by the mirror image of the set, mm, with the score that it
# must have. Correct sets of two real heads: 2.3; of synthetic ones that are crooked by 5 mm: 3.6.
ASYMMETRIC, ASYMMETRIC_SCORE = 6.0, 3.5
# Errors of neighbours are let be below this share of the worst.
CLEARLY = 0.7
# How far around a landmark the surface of an image is looked for, mm.
REACH = 18.0
# Every finding that this module makes, so that a build can replace those of the doctor.
LANDMARK_CODES = frozenset({
    "landmark-far", "landmarks-shifted", "landmarks-off", "landmark-asymmetric",
    "landmark-disagrees", "landmarks-swapped",
})  # fmt: skip
PLACED_FROM = {
    "skull": "cuts, muscles and the region are placed from it",
    "skin": "distances and the regions of the face depend on it",
}
AGAIN = "check it in 3D Slicer, and place it again or correct its label"


def nearest_of_surfaces(surfaces: Sequence[Surface]) -> Nearest:
    """Closest points on any of several surfaces."""

    def nearest(points: Floats) -> Floats:
        best, size = np.zeros_like(points), np.full(len(points), np.inf)
        for surface in surfaces:
            closest = surface.closest(points)[0]
            distance = np.linalg.norm(closest - points, axis=1)
            nearer = distance < size
            best[nearer], size[nearer] = closest[nearer], distance[nearer]
        return best

    return nearest


def nearest_of_level(
    image: ImageData, level: float, landmarks: Mapping[str, Floats]
) -> Nearest | None:
    """Closest points where an image passes a level, near landmarks.

    Points with none within about 18 mm of a landmark get one at infinity. None without scipy, and
    for an image that passes the level nowhere: that it shows no head is found by segmenting it.
    """
    try:
        spatial = import_module("scipy.spatial")
    except ModuleNotFoundError:
        return None
    spacing = image.spacing
    values = image.values
    if not float(values.min()) <= level < float(values.max()):
        return None
    found = []
    for point in landmarks.values():
        low = np.floor((point - REACH - image.lowest) / spacing).astype(int).clip(0)
        high = np.ceil((point + REACH - image.lowest) / spacing).astype(int) + 1
        box = tuple(slice(a, max(b, a)) for a, b in zip(low, high, strict=True))
        block = values[box].astype(np.float64) - level
        for axis in range(3):
            ahead = np.moveaxis(block, axis, 0)
            one, other = ahead[:-1], ahead[1:]
            index = np.argwhere((one > 0.0) != (other > 0.0))
            if not len(index):
                continue
            a, b = one[tuple(index.T)], other[tuple(index.T)]
            places = index.astype(np.float64)
            places[:, 0] += a / (a - b)
            # The moved axis goes back to its place.
            places = np.insert(places[:, 1:], axis, places[:, 0], axis=1)
            found.append(image.lowest + (low + places) * spacing)
    if not found:
        return lambda points: np.full_like(points, np.inf)
    crossings = np.concatenate(found)
    tree = spatial.cKDTree(crossings)
    # What the tree gives for a point that has none within reach.
    crossings = np.concatenate([crossings, np.full((1, 3), np.inf)])

    def nearest(points: Floats) -> Floats:
        index = tree.query(points, distance_upper_bound=REACH)[1]
        closest: Floats = crossings[index]
        return closest

    return nearest


def check_landmarks(
    key: str, landmarks: Mapping[str, Floats], where: str, nearest: Nearest | None
) -> list[Finding]:
    """Findings about the landmarks of one kind; each landmark is named once.

    where: The line of the case that names their file.
    nearest: Closest points on the bones or the skin; without it distances are not checked.
    """
    if not landmarks:
        return []
    findings: list[Finding] = []
    named: set[str] = set()
    if nearest is not None:
        findings += _off_surface(key, landmarks, nearest, named)
    swapped = swapped_names(landmarks, REFERENCE_PLACES[key])
    if swapped is not None and not named & set(swapped):
        findings.append(_swapped(landmarks, swapped))
        named |= set(swapped)
    sound = {name: place for name, place in landmarks.items() if name not in named}
    findings += _asymmetric(key, sound, named)
    sound = {name: place for name, place in landmarks.items() if name not in named}
    findings += _disagreeing(key, sound)
    return [*findings_at(where, findings)]


def _off_surface(
    key: str, landmarks: Mapping[str, Floats], nearest: Nearest, named: set[str]
) -> Iterator[Finding]:
    points = np.stack(list(landmarks.values()))
    offsets = points - nearest(points)
    found = np.linalg.norm(offsets, axis=1)
    surface = "bone" if key == "skull" else "skin"
    n = len(points)

    def distances(places: Floats) -> Floats:
        size: Floats = np.linalg.norm(places - nearest(places), axis=1)
        return size

    far = found > FAR
    median = float(np.median(found))
    shift = common_shift(points, distances, found) if np.isfinite(found).all() else None
    if (
        shift is not None
        and shift.size >= LEAST_SHIFT
        and shift.after <= SHIFT_LEAVES * shift.before
    ):
        yield Finding(
            "landmarks-shifted",
            f"all {n} landmarks of the {key} lie {shift_text(shift.offset)}: moved back, "
            "they lie "
            f"{shift.after:.1f} mm from the {surface} on average, now {shift.before:.1f} mm",
            severity="error" if shift.size > SHIFT_ERROR else "warning",
        )
    elif far.mean() >= MANY and far.sum() > 1:
        yield Finding(
            "landmarks-off",
            f"{int(far.sum())} of {n} landmarks of the {key} lie more than {FAR:g} mm from "
            f"the {surface}, and half of them by more than {median:.1f} mm",
            severity="error" if median > ANOTHER else "warning",
            why="errors of placement do not explain so many: the landmarks belong to another "
            f"patient, scan or frame, or the {surface} is not this patient's",
        )
    for (name, point), offset, distance in zip(landmarks.items(), offsets, found, strict=True):
        if distance <= FAR:
            continue
        named.add(name)
        if np.isfinite(distance):
            lies = f"lies {distance:.1f} mm {direction_text(offset)} the {surface}"
        else:
            lies = f"lies more than {REACH:g} mm from any {surface}"
        yield Finding(
            "landmark-far",
            f"{name} {lies}, at {place_text(point)}",
            severity="error" if distance > TOO_FAR else "warning",
            fix=AGAIN,
            facts={"placed": PLACED_FROM[key], "most": FAR},
        )


def _swapped(landmarks: Mapping[str, Floats], pair: tuple[str, str]) -> Finding:
    one, other = pair
    apart = float(np.linalg.norm(landmarks[one] - landmarks[other]))
    return Finding(
        "landmarks-swapped",
        f"{one} at {place_text(landmarks[one])} and {other} at {place_text(landmarks[other])} "
        f"seem to be swapped: when exchanged, they fit all the others ({apart:.0f} mm apart)",
    )


def _asymmetric(key: str, landmarks: Mapping[str, Floats], named: set[str]) -> Iterator[Finding]:
    """Landmarks that are not the mirror image of their partner, or not in the midline."""
    agreement = mirror_agreement(landmarks)
    if agreement is None:
        return
    rows = {
        n: (d, s)
        for n, d, s in zip(agreement.names, agreement.distances, agreement.scores, strict=True)
    }
    worst = float(agreement.distances.max())
    told: set[str] = set()
    for name in agreement.ranking:
        distance, score = rows[name]
        base = name[:-2] if name.endswith(("_L", "_R")) else name
        if base in told or score < ASYMMETRIC_SCORE:
            continue
        if distance < ASYMMETRIC or distance < CLEARLY * worst:
            continue
        told.add(base)
        named |= {name} if base == name else {f"{base}_L", f"{base}_R"}
        what = (
            f"{name} lies {0.5 * distance:.1f} mm off the midline of the other landmarks"
            if base == name
            else f"{base}_L and {base}_R deviate from mirror symmetry by {distance:.1f} mm, "
            "judged by the other landmarks"
        )
        yield Finding("landmark-asymmetric", what, facts={"placed": PLACED_FROM[key]})


def _disagreeing(key: str, landmarks: Mapping[str, Floats]) -> Iterator[Finding]:
    """Landmarks that the others, carried from an average head, put elsewhere."""
    reference = REFERENCE_PLACES[key]
    names = [name for name in reference if name in landmarks]
    try:
        agreement = leave_one_out(
            [reference[name] for name in names], [landmarks[name] for name in names], names
        )
    except (LandmarkError, RegistrationError):
        return
    distances = dict(zip(agreement.names, agreement.distances, strict=True))
    for name in agreement.misplaced:
        if distances[name] < CLEARLY * distances[agreement.misplaced[0]]:
            continue
        offset = landmarks[name] - agreement.predicted[agreement.names.index(name)]
        yield Finding(
            "landmark-disagrees",
            f"{name} lies {distances[name]:.1f} mm {direction_text(offset)} where the other "
            "landmarks put it in an average head",
            why=f"{PLACED_FROM[key]}; heads differ by up to 10 mm there",
            fix=AGAIN,
        )


def check_automatic(evidence: Evidence) -> Iterator[Finding]:
    """A note for a case without landmarks, with the checks that are left to the build."""
    case = evidence.case
    count = len(evidence.skull_landmarks)
    if not (case.landmarks.proposed or case.landmarks.is_completed(count)):
        return
    left = [
        *(f"the cut {cut.procedure}" for cut in case.osteotomies if cut.procedure),
        *(["the muscles"] if case.muscles is not None else []),
        "the region that is meshed",
    ]
    yield Finding(
        "landmarks-automatic",
        "the build will find the landmarks that the case does not give; the doctor does not check "
        + ", ".join(left),
        where=case.where("landmarks"),
    )
