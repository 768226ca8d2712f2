"""Two sets of landmarks matched by name and side, with every fault stated before a warp."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import ThinPlateSpline, rigid_fit
from cmfsim.errors import LandmarkInputError, RegistrationError
from cmfsim.values.checks import Floats, frozen
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import label_key

# A landmark closer to the middle than this does not distinguish left from right, mm.
SIDE_MARGIN = 3.0
# Distance to the partner of the other side over that to the own one below which sides are swapped.
SWAPPED_SHARE = 0.5

# Landmarks that a spline needs.
LEAST_LANDMARKS = 4
# Landmarks nearer than this to one another are one that was named twice, mm.
LEAST_DISTANCE = 0.01
# Thickness of a set over its longest extent below which it lies in a plane.
PLANAR_THICKNESS = 1e-3
# A mirrored set fits at least this much better after mirroring: share of the rms distance.
MIRRORED_SHARE = 0.5
# Number of names that a message lists before it states how many more there are.
LISTED = 6


@dataclass(frozen=True, eq=False)
class LandmarkMatch:
    """Landmarks that two sets share, in one order.

    Attributes
    ----------
    names : tuple of str
        As the source spells them, in its order.
    source, target : (n, 3) float64, mm
    findings : tuple of Finding
        Landmarks that were ignored, labels that are spelled differently.
    """

    names: tuple[str, ...]
    source: Floats
    target: Floats
    findings: tuple[Finding, ...] = ()

    def spline(self, smoothing: float = 0.0) -> ThinPlateSpline:
        """The thin-plate spline from source to target; `smoothing` in mm."""
        return ThinPlateSpline(self.source, self.target, smoothing)


def match_landmarks(
    source: Mapping[str, ArrayLike],
    target: Mapping[str, ArrayLike],
    *,
    required: Iterable[str] | None = None,
    strict: bool = False,
) -> LandmarkMatch:
    """The landmarks that both sets have, in the order of the source.

    Labels match if they differ only in capitals, spaces, hyphens and underscores. Sides are
    compared in any position of the sets: a pair `…_L`, `…_R` that is swapped in one of them is an
    error.

    Parameters
    ----------
    source, target : mapping of str to (3,) array_like, mm
        Landmarks by label, such as those of a template and of a patient.
    required : iterable of str, optional
        Labels that both sets must have; without it, all of the source.
    strict : bool
        Whether a landmark that only one set has is an error rather than a finding.

    Raises
    ------
    LandmarkError
        (also `ValueError`) Landmarks missing (which, of which set), two labels that differ in
        spelling alone, fewer than four, two at one place, all in one plane, pairs with swapped
        sides (which), a mirrored set, coordinates that are not three finite numbers.

    Examples
    --------
    >>> import cmfsim
    >>> template = {"nasion": (0, -90, 40), "pogonion": (0, -85, -70), "menton": (0, -75, -78),
    ...             "gonion_L": (48, -10, -50), "gonion_R": (-48, -10, -50)}
    >>> patient = {name: (1.1 * x, y, z + 1500) for name, (x, y, z) in template.items()}
    >>> matched = cmfsim.match_landmarks(template, patient)
    >>> matched.names[-1], matched.spline()([[0, -90, 40]]).round(9).tolist()
    ('gonion_R', [[0.0, -90.0, 1540.0]])
    """
    sets = {"source": _points("source", source), "target": _points("target", target)}
    keys = {name: _keys(name, points) for name, points in sets.items()}
    wanted = [label_key(n) for n in required] if required is not None else list(keys["source"])
    asked = dict(zip(wanted, required, strict=True)) if required is not None else keys["source"]
    for name in ("source", "target"):
        missing = [asked[key] for key in wanted if key not in keys[name]]
        if missing:
            has = ", ".join(sorted(sets[name])[:LISTED]) or "nothing"
            raise LandmarkInputError(
                f"the {name} lacks {len(missing)} of {len(wanted)} landmarks: {_listed(missing)} "
                f"(it has {len(sets[name])}: {has}, …)"
            )
    shared = [key for key in keys["source"] if key in keys["target"]]
    findings = [*_spelling(keys, shared), *_extra(keys, strict=strict)]
    names = tuple(keys["source"][key] for key in shared)
    if len(names) < LEAST_LANDMARKS:
        raise LandmarkInputError(
            f"{len(names)} landmarks are shared ({_listed(names) or 'none'}): {LEAST_LANDMARKS} "
            "that do not lie in one plane are needed"
        )
    from_, to = (
        np.stack([sets[name][keys[name][key]] for key in shared]) for name in ("source", "target")
    )
    for name, points in (("source", from_), ("target", to)):
        _check_apart(name, names, points)
        _check_spread(name, points)
    _check_sides(names, from_, to)
    return LandmarkMatch(names, frozen(from_), frozen(to), tuple(findings))


def _points(name: str, landmarks: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    if not isinstance(landmarks, Mapping):
        raise LandmarkInputError(
            f"{name} is of type {type(landmarks).__name__}: a mapping of label to point is needed"
        )
    points: dict[str, Floats] = {}
    for label, value in landmarks.items():
        if not isinstance(label, str) or not label.strip():
            raise LandmarkInputError(f"the {name} has the label {label!r}: a text is needed")
        try:
            point = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            point = np.full(0, np.nan)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise LandmarkInputError(
                f"{label} of the {name} is at {value!r}: three finite numbers are needed"
            )
        points[label] = point
    return points


def _keys(name: str, points: Mapping[str, Floats]) -> dict[str, str]:
    found: dict[str, str] = {}
    for label in points:
        key = label_key(label)
        if key in found:
            raise LandmarkInputError(
                f"the {name} has {found[key]!r} and {label!r}, which differ only in spelling: "
                "remove or rename one"
            )
        found[key] = label
    return found


def _spelling(keys: Mapping[str, Mapping[str, str]], shared: Iterable[str]) -> list[Finding]:
    different = [
        f"{keys['source'][key]!r} and {keys['target'][key]!r}"
        for key in shared
        if keys["source"][key] != keys["target"][key]
    ]
    if not different:
        return []
    return [
        Finding(
            "landmark-spelling",
            f"{len(different)} labels are spelled differently: {_listed(different)}",
            where="landmarks",
        )
    ]


def _extra(keys: Mapping[str, Mapping[str, str]], *, strict: bool) -> list[Finding]:
    findings = []
    for name, other in (("source", "target"), ("target", "source")):
        extra = [label for key, label in keys[name].items() if key not in keys[other]]
        if not extra:
            continue
        what = f"{len(extra)} landmarks are only in the {name}: {_listed(extra)}"
        if strict:
            raise LandmarkInputError(f"{what}; add them to the {other} or remove them")
        findings.append(
            Finding(
                "landmark-extra",
                what,
                severity="note",
                where=f"landmarks of the {name}",
                fix=f"to use them, place them in the {other} as well",
            )
        )
    return findings


def _check_apart(name: str, names: tuple[str, ...], points: Floats) -> None:
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    distances[np.tril_indices(len(points))] = np.inf
    i, j = np.unravel_index(np.argmin(distances), distances.shape)
    if distances[i, j] < LEAST_DISTANCE:
        raise LandmarkInputError(
            f"{names[i]} and {names[j]} of the {name} lie in the same place ({distances[i, j]:.2g} "
            "mm apart): place one of them again"
        )


def _check_spread(name: str, points: Floats) -> None:
    about = points - points.mean(axis=0)
    axes = np.linalg.svd(about, full_matrices=False)[2]
    extents = np.ptp(about @ axes.T, axis=0)
    if extents[2] <= PLANAR_THICKNESS * extents[0]:
        shape = "line" if extents[1] <= PLANAR_THICKNESS * extents[0] else "plane"
        raise LandmarkInputError(
            f"all {len(points)} landmarks of the {name} lie in one {shape}, {extents[2]:.2g} mm "
            f"thick for {extents[0]:.4g} mm: add some on both sides of it"
        )


def _check_sides(names: tuple[str, ...], source: Floats, target: Floats) -> None:
    swapped = swapped_pairs(names, source, target)
    if swapped:
        wrong = {
            name: set(wrong_sides(dict(zip(names, points, strict=True))))
            for name, points in (("source", source), ("target", target))
        }
        # In LPS one set has its left on the left: the other is the one to correct.
        guilty = [name for name, pairs in wrong.items() if set(swapped) <= pairs]
        where = f"in the {guilty[0]}" if len(guilty) == 1 else "in one of the two sets"
        n_pairs = sum(name.endswith("_L") for name in names)
        every = len(swapped) == n_pairs and n_pairs > 1
        raise LandmarkInputError(
            f"left and right are swapped {where} in {_listed(swapped)}: swap the labels _L and _R"
            + ("; if the whole head is mirrored, export it again" if every else " of these")
        )
    mirror = np.array([-1.0, 1.0, 1.0])
    try:
        kept = rigid_fit(source, target, scale=True).rms
        mirrored = rigid_fit(source, target * mirror, scale=True).rms
    except RegistrationError:
        # One of the two fits has no single answer: then nothing speaks for a mirror image.
        return
    if mirrored < MIRRORED_SHARE * kept:
        raise LandmarkInputError(
            f"one set is the mirror image of the other: they fit to {kept:.1f} mm as they are and "
            f"to {mirrored:.1f} mm mirrored; check its frame, or export it again"
        )


def _listed(names: Iterable[str]) -> str:
    names = list(names)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more


def side_pairs(names: Mapping[str, object] | tuple[str, ...]) -> dict[str, tuple[str, str]]:
    """The left and the right name of each pair, by the name without its side."""
    return {
        name[:-2]: (name, f"{name[:-2]}_R")
        for name in names
        if name.endswith("_L") and f"{name[:-2]}_R" in names
    }


def side_vectors(landmarks: Mapping[str, Floats]) -> dict[str, Floats]:
    """The vector from the right to the left landmark of each pair, mm."""
    return {
        pair: landmarks[left] - landmarks[right]
        for pair, (left, right) in side_pairs(landmarks).items()
    }


def wrong_sides(landmarks: Mapping[str, Floats]) -> list[str]:
    """The pairs whose left landmark lies on the right; LPS, the head upright."""
    vectors = side_vectors(landmarks)
    return [pair for pair, vector in vectors.items() if vector[0] < -SIDE_MARGIN]


def swapped_pairs(names: tuple[str, ...], source: Floats, target: Floats) -> list[str] | None:
    """The pairs whose sides differ between two sets of the same landmarks, wherever those lie.

    The sets are brought together by what a swap does not move, landmarks without a side and the
    middles of pairs; then a pair is swapped if its two landmarks lie nearer to one another's
    partners, by half at least. None where those points do not tell.
    """
    index = {name: i for i, name in enumerate(names)}
    pairs = {p: (index[left], index[right]) for p, (left, right) in side_pairs(names).items()}
    sided = {i for pair in pairs.values() for i in pair}
    groups = [(i,) for i in range(len(names)) if i not in sided] + list(pairs.values())
    still, goal = (
        np.stack([points[list(group)].mean(axis=0) for group in groups])
        for points in (source, target)
    )
    try:
        fit = rigid_fit(still, goal, scale=True)
    except RegistrationError:
        return None
    moved = source @ fit.matrix[:3, :3].T + fit.matrix[:3, 3]
    swapped = []
    for pair, (left, right) in pairs.items():
        ends = target[[left, right]]
        kept = float(np.square(moved[[left, right]] - ends).sum())
        exchanged = float(np.square(moved[[right, left]] - ends).sum())
        if exchanged < SWAPPED_SHARE**2 * kept:
            swapped.append(pair)
    return swapped
