"""The mandible told from the rest of the skull, though teeth and joints touch it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import LandmarkError
from cmfsim.imaging.bones.bone import Bone
from cmfsim.imaging.bones.model_seeds import bite_sites, fitted_to, model_box, model_seeds
from cmfsim.imaging.morphology import (
    Block,
    Mask,
    Volume,
    box_of,
    depth,
    grown,
    largest,
    reached,
    shrunk,
    smoothed,
    watershed,
)
from cmfsim.imaging.skins.skin import Skin
from cmfsim.imaging.working_grid import Working
from cmfsim.registration.proposed.shape_model.fitted_head import FittedHead
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding

# Landmarks (Phillips & Smuts 1996) that lie on each bone.
ON_MANDIBLE = (
    "infradentale",
    "menton",
    "pogonion",
    "supramentale",
    "gonion_L",
    "gonion_R",
    "sub_m2_L",
    "sub_m2_R",
)
ON_CRANIUM = (
    "supraglabella",
    "glabella",
    "nasion",
    "rhinion",
    "mid_philtrum",
    "supradentale",
    "frontal_eminence_L",
    "frontal_eminence_R",
    "supraorbital_L",
    "supraorbital_R",
    "suborbital_L",
    "suborbital_R",
    "inferior_malar_L",
    "inferior_malar_R",
    "lateral_orbit_L",
    "lateral_orbit_R",
    "zygomatic_arch_L",
    "zygomatic_arch_R",
    "supraglenoid_L",
    "supraglenoid_R",
    "supra_m2_L",
    "supra_m2_R",
)
# A landmark farther than this from bone is not used, mm; a seed is a ball of the second radius.
FARTHEST_SEED = 6.0
SEED_RADIUS = 3.0
# All bone higher than this above the arches' roots is the cranium's, mm.
ABOVE_JOINT = 20.0
# Crowns and alveolar bone between these distances from the occlusal plane are seeds, mm.
CROWN = (2.0, 16.0)
# The same from the occlusal plane of the fitted model, whose sites are 3 to 5 mm off.
MODEL_CROWN = (5.0, 16.0)
# The occlusal plane lies this far from the sites of one row at incisors and molars, mm: 9 to 13 and
# 11 to 20 in two skulls.
TO_EDGES, TO_CUSPS = 10.0, 16.0
# Where only one row's sites are known, bone farther beyond its edges than this is the other jaw's,
# however far the mouth is open, mm: crowns and their necks end before.
OTHER_JAW = (22.0, 60.0)
# All three are those of an arch this wide at its second molars, and a child's are smaller; mm, and
# parts of it.
ARCH_WIDTH, LEAST_ARCH = 68.0, 0.6
# Nothing of the mandible lies between its rami and above the teeth within this of the midline, nor
# farther behind the second molars than this, mm: condyles end 10 mm before in an average head.
BETWEEN_RAMI, BEHIND_JOINTS = 25.0, 55.0
# Bone of a lower jaw that is shown reaches farther than this into the range, mm.
INTO_OTHER_JAW = 5.0
# The mandible's front edge of the ramus ends the tooth row, mm in front of the occlusal landmark.
BEFORE_RAMUS = 5.0
# The middle of the condyle from the supraglenoid landmark: towards the midline, back, up, mm;
# within 2 mm in the four joints of two skulls in which it was measured.
CONDYLE = (15.0, 0.5, -12.0)
CONDYLES = ("condyle_L", "condyle_R")
# This near its middle along each axis, a condyle is what bone deeper than a core
# connects to the mandible below an end, a height above its middle, and to no bone of the skull.
# Cores and ends are tried in order; all in mm.
JOINT_BOX, CORES, CONDYLE_ENDS = 20.0, (1.5, 2.0), (3.0, 0.0, -3.0)
# Depth in bone that counts as much as FLOOD_HU, mm.
FLOOD_DEPTH = 3.0
# A joint space is dark before it is open, HU.
FLOOD_HU = 700.0
# A Gaussian of one voxel ends within this many voxels.
SMOOTH_REACH = 6
# Mandibles have volumes (with marrow, mm³) and widths (mm) in these ranges, children's included.
VOLUMES = (8_000.0, 250_000.0)
WIDTHS = (45.0, 150.0)


@dataclass(frozen=True, eq=False)
class Jaws:
    """The mandible in the bone.

    Attributes
    ----------
    side : (nx, ny, nz) float32 or None
        Positive towards the mandible, negative towards the rest; None if it was not found.
    mandible : (nx, ny, nz) bool or None
    occlusal_height : float or None
        z of the occlusal plane at the incisors, mm.
    findings : tuple of Finding
    """

    side: Volume | None
    mandible: Mask | None
    occlusal_height: float | None
    findings: tuple[Finding, ...]


def part_jaws(
    work: Working, bone: Bone, skin: Skin, landmarks: Mapping[str, Floats] | None
) -> Jaws:
    """The mandible by a flood from seeds, which stops where bones touch most narrowly.

    Landmarks give the seeds where they show a tooth row; else the model of shape, fitted to bone
    and skin and to the landmarks there are.
    """
    findings: list[Finding] = []
    given = dict(landmarks or {})
    head: FittedHead | None = None
    if _occlusal_points(given) is None:
        if _one_row(given) is None:
            fitted = _fitted(work, bone, skin, given)
            if isinstance(fitted, str):
                return Jaws(None, None, None, (_not_parted(fitted),))
            head = fitted
        findings.append(Finding("jaws-parted-by-shape", where="bone"))
    box = _box(work, bone, given) if head is None else model_box(work, head)
    domain = np.asfortranarray(bone.mask[box])
    part = work.part(box)
    dense = np.clip(smoothed(bone.hu[box], 0.7, work.spacing) / np.float32(FLOOD_HU), 0.0, 2.0)
    dense[~domain] = 0.0
    if head is None:
        seeds = _seeds(part, bone, given, box)
        rows = _occlusal_points(given) or _one_row(given)
    else:
        sites, is_seen = bite_sites(part, dense, head, BEFORE_RAMUS)
        rows = _occlusal_points(sites)
        crown = CROWN if is_seen else MODEL_CROWN
        seeds = model_seeds(part, domain, head)
        if bone.cavity is not None:
            seeds[bone.cavity[box]] = 2
        _tooth_rows(seeds, sites, *_axes(part, domain), crown=crown)
        _joint_seeds(seeds, domain, part, head)
        _placed(seeds, domain, part, given)
    height = None if rows is None else float(rows[0][2])
    if not ((seeds == 1).any() and (seeds == 2).any()):
        if (on_other := _on_other_jaw(work, given)) is not None:
            return Jaws(None, None, None, (on_other,))
        return Jaws(None, None, None, (_not_parted("the landmarks are far from bone"),))
    deep = depth(domain, work.spacing) / np.float32(FLOOD_DEPTH)
    # What lies among seeds of its own kind is known, and floods nothing.
    inner = shrunk(seeds == 2)
    basins = watershed(-(deep + dense), seeds, domain & ~inner)
    mandible = np.zeros(bone.mask.shape, dtype=bool, order="F")
    mandible[box] = basins == 1
    # Scraps that the flood cut off elsewhere are not the mandible.
    seeded = np.zeros_like(mandible)
    seeded[box] = seeds == 1
    mandible = reached(mandible, seeded)
    reason = _implausible(mandible, work)
    if reason:
        return Jaws(None, None, None, (_not_parted(reason),))
    # Pieces that the flood left to the skull, but that only the mandible holds, are the mandible's.
    rest = bone.mask[box] & ~mandible[box]
    if rest.any():
        mandible[box] |= reached(rest & ~largest(rest), grown(mandible[box]))
    return Jaws(_side(mandible, bone.mask), mandible, height, tuple(findings))


def _fitted(work: Working, bone: Bone, skin: Skin, given: Mapping[str, Floats]) -> FittedHead | str:
    """The model of shape on this head, or why the jaws cannot be separated by it."""
    try:
        head = fitted_to(work, bone, skin, given)
    except LandmarkError as error:
        return str(error)
    against = _against({n: p for (kind, n), p in head.sites.items() if kind == "skull"}, given)
    if against:
        return f"the image seems to show the tooth rows elsewhere than {', '.join(against)}"
    return head


def _side(mandible: Mask, bone: Mask) -> Volume:
    """1 in the mandible and −1 elsewhere, smooth where they meet."""
    side = np.full(mandible.shape, np.float32(-1.0), order="F")
    box = box_of(mandible, SMOOTH_REACH)
    part = np.asfortranarray(mandible[box])
    rest = bone[box] & ~part
    # Threefold, so that smoothing leaves thin parts their size.
    side[box] = np.clip(3.0 * (smoothed(part, 1.0) - smoothed(rest, 1.0)), -1.0, 1.0)
    return side


def _not_parted(reason: str) -> Finding:
    return Finding(
        "jaws-not-parted",
        f"the mandible could not be separated from the skull: {reason}",
        where="bone",
    )


def _on_other_jaw(work: Working, given: Mapping[str, Floats]) -> Finding | None:
    """An error where the image goes on far below the upper row that was placed, without any bone.

    A lower jaw has bone there, however worn it is: the row is the lower one.
    """
    row = _one_row(given)
    if row is None or "supradentale" not in given or _occlusal_points(given) is not None:
        return None
    size = _arch_size(row[1], row[2])
    room = float(row[0][2] - work.origin[2])
    if room < size * OTHER_JAW[0] + INTO_OTHER_JAW:
        return None
    return Finding(
        "sites-on-other-jaw",
        f"no bone lies more than {size * (OTHER_JAW[0] + TO_EDGES):.0f} mm below the landmarks "
        f"supradentale and supra_m2, although the image goes on for {room:.0f} mm below the "
        "upper teeth",
        where="landmarks.skull",
    )


def _implausible(mandible: Mask, work: Working) -> str | None:
    volume = np.count_nonzero(mandible) * float(np.prod(work.spacing))
    if not VOLUMES[0] <= volume <= VOLUMES[1]:
        return (
            f"what was found has {volume / 1000.0:.0f} cm³ ({VOLUMES[0] / 1000.0:.0f} to "
            f"{VOLUMES[1] / 1000.0:.0f} expected)"
        )
    across = np.flatnonzero(mandible.any(axis=(1, 2)))
    width = float(across[-1] - across[0] + 1) * float(work.spacing[0])
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        return (
            f"what was found is {width:.0f} mm wide ({WIDTHS[0]:.0f} to {WIDTHS[1]:.0f} expected)"
        )
    return None


def _box(work: Working, bone: Bone, landmarks: Mapping[str, Floats]) -> Block:
    """The bone from below the chin to above the joints."""
    top = _joint_height(landmarks) + ABOVE_JOINT + 10.0
    end = int((top - work.origin[2]) / work.spacing[2])
    layers = slice(0, min(max(end, 2), work.hu.shape[2]))
    x, y, _ = box_of(bone.mask[:, :, layers], SMOOTH_REACH)
    return x, y, layers


def _joint_height(landmarks: Mapping[str, Floats]) -> float:
    names = [n for n in ("supraglenoid_L", "supraglenoid_R") if n in landmarks]
    names = names or [n for n in ("zygomatic_arch_L", "zygomatic_arch_R") if n in landmarks]
    if names:
        return float(np.mean([landmarks[n][2] for n in names]))
    # The joints lie some 30 mm above the upper incisors' necks, and 50 above the lower ones'.
    if "supradentale" in landmarks:
        return float(landmarks["supradentale"][2]) + 30.0
    return float(landmarks["infradentale"][2]) + 50.0


def _seeds(
    work: Working, bone: Bone, landmarks: dict[str, Floats], box: Block
) -> NDArray[np.int32]:
    """1 mandible, 2 the rest, 0 to be flooded."""
    domain = bone.mask[box]
    seeds = np.zeros(domain.shape, dtype=np.int32, order="F")
    x, y, z = _axes(work, domain)
    seeds[:, :, (z > _joint_height(landmarks) + ABOVE_JOINT).ravel()] = 2
    if bone.cavity is not None:
        seeds[bone.cavity[box]] = 2
    _tooth_rows(seeds, landmarks, x, y, z)
    _placed(seeds, domain, work, landmarks | _condyles(landmarks))
    return seeds


def _placed(
    seeds: NDArray[np.int32], domain: Mask, work: Working, landmarks: Mapping[str, Floats]
) -> None:
    """Adds balls at landmarks, last: they are what a person said."""
    _balls(seeds, domain, work, landmarks, names=ON_CRANIUM, value=2)
    _balls(seeds, domain, work, landmarks, names=(*ON_MANDIBLE, *CONDYLES), value=1)
    seeds[~domain] = 0


def _joint_seeds(seeds: NDArray[np.int32], domain: Mask, work: Working, head: FittedHead) -> None:
    """Adds a ball of the mandible in each condyle of the model, unless the mouth is open.

    One that touches its fossa would be cut off at its neck, which is narrower. Bone connects a
    condyle to the mandible below the joints, unlike what lies behind it, before the ear. That of an
    open mouth has left its fossa.
    """
    if (head.jaw != np.eye(4)).any():
        return
    own = {name: head.state.into(p[None])[0] for (_, name), p in head.sites.items()}
    joints = {name: head.state.out(p[None])[0] for name, p in _condyles(own).items()}
    up = head.state.linear[2] / head.state.scale
    for name, place in joints.items():
        low, high = ((place - work.origin + d) / work.spacing for d in (-JOINT_BOX, JOINT_BOX))
        ends = zip(low, high, domain.shape, strict=True)
        box = tuple(slice(max(int(a), 0), max(min(int(b), n), 0)) for a, b, n in ends)
        part, near = seeds[box], work.part(box)
        bone = np.asfortranarray(domain[box])
        if not bone.any():
            continue
        height = sum(a * u for a, u in zip(_axes(near, bone), up, strict=True)) - float(place @ up)
        deep = depth(bone, work.spacing)
        for core, end in product(CORES, CONDYLE_ENDS):
            held = reached((deep > core) & (height < end), part == 1)
            if not (part[held] == 2).any():
                _balls(part, held, near, joints, names=(name,), value=1)
                break


def _axes(work: Working, domain: Mask) -> tuple[Any, Any, Any]:
    """The coordinates of a block along each axis, to be broadcast, mm."""
    x, y, z = (
        (o + s * np.arange(n)).reshape([-1 if a == b else 1 for b in range(3)])
        for a, (o, s, n) in enumerate(zip(work.origin, work.spacing, domain.shape, strict=True))
    )
    return x, y, z


def _condyles(landmarks: Mapping[str, Floats]) -> dict[str, Floats]:
    """The middles of the condyles, where the joints' landmarks are given."""
    names = [f"supraglenoid_{side}" for side in ("L", "R")]
    if not set(names) <= set(landmarks):
        return {}
    middle = 0.5 * (landmarks[names[0]] + landmarks[names[1]])
    inwards, back, up = CONDYLE
    return {
        f"condyle_{name[-1]}": landmarks[name]
        + np.array([inwards * np.sign(middle[0] - landmarks[name][0]), back, up])
        for name in names
    }


def _tooth_rows(
    seeds: NDArray[np.int32],
    landmarks: Mapping[str, Floats],
    x: Any,
    y: Any,
    z: Any,
    *,
    crown: tuple[float, float] = CROWN,
) -> None:
    """Seeds above and below the occlusal plane, in front of the rami."""
    plane = _occlusal_points(landmarks) or _one_row(landmarks)
    if plane is None:
        return
    incisal, left, right = plane
    normal = np.cross(left - incisal, right - incisal)
    normal *= np.sign(normal[2]) / np.linalg.norm(normal)
    behind = 0.5 * (left[1] + right[1]) - BEFORE_RAMUS
    # Laterally the row ends where the rami begin.
    low, high = sorted((left[0], right[0]))
    across = (x > low - BEFORE_RAMUS) & (x < high + BEFORE_RAMUS)
    # Heights only where the row is: both lines ascend, so that it is a block.
    row = box_of(across & (y < behind))[:2]
    whole = x, y, z
    x, y, part = x[row[0]], y[:, row[1]], seeds[row]
    height = normal[0] * (x - incisal[0]) + normal[1] * (y - incisal[1])
    height = height + normal[2] * (z - incisal[2])
    upper = lower = crown
    if _occlusal_points(landmarks) is None:
        # The row whose sites are known, and the other wherever the mouth's opening has it.
        is_upper = "supradentale" in landmarks
        size = _arch_size(left, right)
        other = (size * OTHER_JAW[0], OTHER_JAW[1])
        upper, lower = (CROWN, other) if is_upper else (other, CROWN)
        _behind_row(seeds, (left, right), whole, incisal=float(incisal[2]), is_upper=is_upper)
    part[(height > upper[0]) & (height < upper[1])] = 2
    part[(height < -lower[0]) & (height > -lower[1])] = 1


def _occlusal_points(landmarks: Mapping[str, Floats]) -> tuple[Floats, Floats, Floats] | None:
    """The occlusal plane at the incisors, left and right."""
    if not {"supradentale", "infradentale"} <= set(landmarks):
        return None
    points = [0.5 * (landmarks["supradentale"] + landmarks["infradentale"])]
    for side in ("L", "R"):
        if f"occlusal_line_{side}" in landmarks:
            points.append(landmarks[f"occlusal_line_{side}"])
        elif {f"supra_m2_{side}", f"sub_m2_{side}"} <= set(landmarks):
            points.append(
                0.5 * (landmarks[f"supra_m2_{side}"] + landmarks[f"sub_m2_{side}"])
                + np.array([0.0, BEFORE_RAMUS, 0.0])
            )
        else:
            return None
    return points[0], points[1], points[2]


def _behind_row(
    seeds: NDArray[np.int32],
    ends: tuple[Floats, Floats],
    axes: tuple[Any, Any, Any],
    *,
    incisal: float,
    is_upper: bool,
) -> None:
    """Seeds of spine and skull base, which an image without the vault would give the mandible."""
    x, y, z = axes
    left, right = ends
    size = _arch_size(left, right)
    middle, back = 0.5 * (left[0] + right[0]), 0.5 * (left[1] + right[1])
    above = incisal + (CROWN[0] if is_upper else OTHER_JAW[0])
    base = (np.abs(x - middle) < BETWEEN_RAMI * size) & (y > back) & (z > above)
    seeds[base | (y > back + BEHIND_JOINTS * size)] = 2


def _one_row(landmarks: Mapping[str, Floats]) -> tuple[Floats, Floats, Floats] | None:
    """The edges of one jaw's teeth at the incisors, left and right, from the sites of its row."""
    for front, molar, sign in (("supradentale", "supra_m2", -1.0), ("infradentale", "sub_m2", 1.0)):
        names = (front, f"{molar}_L", f"{molar}_R")
        if not set(names) <= set(landmarks):
            continue
        tip, left, right = (landmarks[name] for name in names)
        normal = np.cross(left - tip, right - tip)
        up = normal * (np.sign(normal[2]) / np.linalg.norm(normal))
        ahead = np.array([0.0, BEFORE_RAMUS, 0.0])
        away = sign * _arch_size(left, right) * up
        behind = TO_CUSPS * away + ahead
        return tip + TO_EDGES * away, left + behind, right + behind
    return None


def _arch_size(left: Floats, right: Floats) -> float:
    """The width of an arch in parts of that of an adult."""
    return float(np.clip(np.linalg.norm(left - right) / ARCH_WIDTH, LEAST_ARCH, 1.0))


def _against(guess: Mapping[str, Floats], given: Mapping[str, Floats]) -> list[str]:
    """The given sites that a guess of the tooth rows puts on the other jaw."""
    plane = _occlusal_points(guess)
    if plane is None:
        return []
    incisal, left, right = plane
    behind = 0.5 * float(left[1] + right[1])
    found = []
    for names, sign in ((ON_CRANIUM, 1.0), (ON_MANDIBLE, -1.0)):
        for name in names:
            # Behind the rows the mandible rises beside the cranium.
            if name in given and given[name][1] < behind:
                height = sign * float(given[name][2] - incisal[2])
                found += [name] if height < -CROWN[0] else []
    return found


def _balls(
    seeds: NDArray[np.int32],
    domain: Mask,
    work: Working,
    landmarks: Mapping[str, Floats],
    *,
    names: Iterable[str],
    value: int,
) -> None:
    """A ball of bone at each landmark, moved to the bone nearest to it."""
    reach = FARTHEST_SEED + SEED_RADIUS
    for name in names:
        if name not in landmarks:
            continue
        place = (landmarks[name] - work.origin) / work.spacing
        low = np.maximum(np.floor(place - reach / work.spacing).astype(int), 0)
        high = np.minimum(np.ceil(place + reach / work.spacing).astype(int) + 1, domain.shape)
        if (high <= low).any():
            continue
        part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        index = np.argwhere(domain[part])
        if not len(index):
            continue
        offsets = (index + low - place) * work.spacing
        distance = np.linalg.norm(offsets, axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] > FARTHEST_SEED:
            continue
        ball = np.linalg.norm(offsets - offsets[nearest], axis=1) < SEED_RADIUS
        seeds[part][tuple(index[ball].T)] = value
