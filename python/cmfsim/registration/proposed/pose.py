"""The pose of a head of unknown place: its plane of symmetry, and the frame of an average head."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim._core import IcpFit, Surface, icp
from cmfsim.errors import LandmarkInputError, RegistrationError
from cmfsim.values.checks import Floats
from cmfsim.values.motion import rigid_motion
from cmfsim.values.surface_data import SurfaceData

__all__ = ["Pose", "distance_from", "find_pose", "levelled", "surface_samples"]

# Points of a surface that poses are fitted with.
SAMPLES = 4000
# Share of the worst pairs that fits leave out: spine, couch and what the other head lacks.
MIRROR_TRIM, POSE_TRIM = 0.3, 0.35
# A head is even enough where the kept pairs lie nearer than this, mm: real ones 0.6 mm, in planes
# that are none 1.6 mm and more. Else its mirror image is turned first, degrees about an axis: twice
# as far as the head may lean to a side or look to it.
EVEN = 1.0
UPWARDS, BACKWARDS = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
TURNS = ((0.0, UPWARDS), *((turn, axis) for axis in (BACKWARDS, UPWARDS) for turn in (35.0, -35.0)))
# Heads are offered to the fit nodding this far either way, degrees, and in these sizes.
PITCHES = (-20.0, 0.0, 20.0)
SIZES = (0.72, 0.86, 1.0, 1.14)
# Rounds of pairs and similarity fits of a candidate, and of the best.
FIRST_ROUNDS, ROUGH_ROUNDS, FINE_ROUNDS = 4, 15, 40
# Starts that are followed up.
MOST_STARTS = 10
# How much of the vertex may be missing, mm.
VERTEX_CUT = (0.0, 30.0, 60.0)
# Damping of a step, as a share of the pairs.
DAMPING = 1e-3
# Cosine between the normals of a pair at least; farthest distance that counts, mm; fewest pairs.
LEAST_AGREEMENT, MOST_GAP, LEAST_PAIRS = 0.5, 30.0, 50
# A pose whose kept points lie farther from the average head than this is none, mm.
WORST_FIT = 6.0


# Points of a surface and their outward unit normals, (n, 3) each.
Samples = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Pose:
    """How a head lies: p' = axes (p − origin), in mm, with x' to the left, y' back, z' up.

    Attributes
    ----------
    origin : (3,) float64, mm
        Where the middle between the ear canals would lie.
    axes : (3, 3) float64
        Its rows are the directions left, back and up.
    size : float
        Of the head, as a factor on the average head.
    residual : float, mm
        Root of the mean square distance of the kept points from the average head.
    """

    origin: Floats
    axes: Floats
    size: float
    residual: float

    def into(self, points: Floats) -> Floats:
        """Points of the patient, (n, 3) mm, in the head's own frame."""
        return (points - self.origin) @ self.axes.T

    def out(self, points: Floats) -> Floats:
        """Points of the head's own frame, (n, 3) mm, in the patient's."""
        return points @ self.axes + self.origin


def surface_samples(surface: SurfaceData, count: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Points spread evenly over a surface and their outward unit normals, (n, 3) each.

    The same for the same seed; triangles count by their area.
    """
    vertices = surface.vertices
    corners = vertices[surface.triangles.astype(np.int64)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    total = np.cumsum(doubled)
    if not total[-1] > 0.0:
        raise LandmarkInputError("a surface has no area, so no landmark can be found on it")
    generator = np.random.default_rng(seed)
    # One throw in each of as many equal shares of the area: evener than free throws.
    throws = (np.arange(count) + generator.random(count)) / count * total[-1]
    # Throws ascend: fewer places of triangles among them are looked up than the reverse.
    ends = np.searchsorted(throws, total[:-1])
    chosen = np.repeat(np.arange(len(total)), np.diff(ends, prepend=0, append=count))
    u, v = generator.random((2, count))
    over = u + v > 1.0
    np.subtract(1.0, u, out=u, where=over)
    np.subtract(1.0, v, out=v, where=over)
    a, b, c = corners.transpose(1, 0, 2)
    points = a[chosen]
    points += u[:, None] * (b - a)[chosen]
    points += v[:, None] * (c - a)[chosen]
    units = normals / np.where(doubled > 0.0, doubled, 1.0)[:, None]
    return points, units[chosen]


def find_pose(bones: SurfaceData, average: SurfaceData, average_size: float = 1.0) -> Pose:
    """The pose of a head by its bones: the plane of symmetry, then the fit of an average cranium.

    Parameters
    ----------
    bones : SurfaceData
        Cranium of the patient, roughly upright in LPS (within about 30°); parts may be missing.
    average : SurfaceData
        Cranium of a whole head in its own frame: x = 0 its plane of symmetry.
    average_size : float
        Its size.

    Returns
    -------
    Pose

    Raises
    ------
    LandmarkError
        (also `ValueError`) The bones look like no head.
    """
    points, normals = surface_samples(bones, SAMPLES)
    symmetry, centre = _symmetry(bones, points, normals)
    return _fitted((points, normals), (symmetry, centre), average, average_size)


def _symmetry(whole: SurfaceData, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """The unit normal of the plane of symmetry, towards the left, and a point of it."""
    surface = Surface(whole.vertices, whole.triangles)
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    flip = np.array([-1.0, 1.0, 1.0])
    mirrored = (points - centre) * flip + centre
    fits: list[IcpFit] = []
    reason: RegistrationError | None = None
    for angle, axis in TURNS:
        turn = rigid_motion(angle=angle, axis=axis, centre=centre) if angle else None
        try:
            fit = _mirror_fit((mirrored, normals * flip), surface, turn)
        except RegistrationError as error:
            reason = error
            continue
        fits.append(fit)
        if fit.rms <= EVEN:
            break
    if not fits:
        raise LandmarkInputError(
            f"the bones have no recognisable plane of symmetry ({reason}): place the landmarks "
            "by hand"
        ) from reason
    matrix = min(fits, key=lambda fit: fit.rms).matrix
    # p → R (S (p − c) + c) + t is nearly a reflection; its axis is the eigenvector of −1.
    rotation = matrix[:3, :3] @ np.diag(flip)
    values, vectors = np.linalg.eigh(0.5 * (rotation + rotation.T))
    normal = vectors[:, int(np.argmin(values))]
    normal = normal if normal[0] > 0.0 else -normal
    image = matrix[:3, :3] @ ((points - centre) * flip + centre).T + matrix[:3, 3:]
    middle = 0.5 * (image.T + points)
    # Midpoints of points and their images lie in the plane.
    return normal, normal * float(np.median(middle @ normal)) + (
        centre - normal * float(centre @ normal)
    )


def _mirror_fit(mirrored: Samples, surface: Surface, turn: Floats | None) -> IcpFit:
    """The rigid motion that brings mirrored points back to the surface, from a first turn."""
    return icp(
        mirrored[0],
        surface,
        initial=turn,
        max_distance=None,
        keep_border=False,
        trim=MIRROR_TRIM,
        method="plane",
        max_iterations=300,
        tolerance=1e-5,
        max_angle=np.radians(45.0),
        normals=mirrored[1],
    )


def _fitted(
    samples: Samples, plane: tuple[Floats, Floats], average: SurfaceData, average_size: float
) -> Pose:
    """The pose of points whose plane of symmetry is known by its normal and a point."""
    (points, normals), (left, centre) = samples, plane
    surface = Surface(average.vertices, average.triangles)
    up = np.array([0.0, 0.0, 1.0]) - left * left[2]
    up /= np.linalg.norm(up)
    upright = np.stack([left, np.cross(up, left), up])
    begin, turned = (points - centre) @ upright.T, normals @ upright.T
    starts = _starts(begin, average.vertices, average_size)
    few = begin[::6], turned[::6]
    tried = _similarities(few, surface, starts, FIRST_ROUNDS)
    tried.sort(key=lambda fit: fit.distance)
    followed = [(fit.linear, fit.offset) for fit in tried[:MOST_STARTS]]
    rough = _similarities(few, surface, followed, ROUGH_ROUNDS)
    best = min(rough, key=lambda fit: fit.distance)
    (fine,) = _similarities((begin, turned), surface, [(best.linear, best.offset)], FINE_ROUNDS)
    rms, linear, offset = fine.distance, fine.linear, fine.offset
    scale = float(np.cbrt(np.linalg.det(linear)))
    residual = rms
    if residual > WORST_FIT:
        raise LandmarkInputError(
            f"the bones lie {residual:.1f} mm from an average skull in the best pose (at most "
            f"{WORST_FIT:g} mm allowed): they are not a head, or a head rotated by more than "
            "30°; place the landmarks by hand"
        )
    axes = linear / scale @ upright
    origin = centre - upright.T @ (np.linalg.solve(linear, offset))
    return Pose(origin, axes, average_size / scale, residual)


# Sites of the cranium that show how it nods, and the distance at which one counts half, mm.
LEVEL_SITES = (
    "nasion",
    "glabella",
    "rhinion",
    "mid_philtrum",
    "supradentale",
    *(
        f"{pair}_{letter}"
        for pair in ("supraorbital", "suborbital", "zygomatic_arch", "supraglenoid")
        for letter in "LR"
    ),
)
LEVEL_DISTANCE, LEVEL_ROUNDS, LEAST_LEVEL_SITES = 5.0, 20, 6
# A levelling that turns the head by more, degrees, or moves or scales it by more (mm, share) rests
# on sites that were found wrongly.
MOST_LEVEL_TURN, MOST_LEVEL_SHIFT, MOST_LEVEL_SCALE = 12.0, 12.0, 0.12


def levelled(pose: Pose, found: Mapping[str, Floats], average: Mapping[str, Floats]) -> Pose:
    """The pose with nod, size and place by sites of the cranium instead of its whole surface.

    Skulls differ more in the vault than in how the face lies below it. The plane of symmetry stays.

    Parameters
    ----------
    pose : Pose
    found, average : mapping of str to (3,) float64
        Sites as found in that pose, average-head mm, and those of the average head.
    """
    names = [name for name in LEVEL_SITES if name in found and name in average]
    if len(names) < LEAST_LEVEL_SITES:
        return pose
    source = np.array([found[name] for name in names])
    target = np.array([average[name] for name in names])
    linear, offset = np.eye(3), np.zeros(3)
    for _ in range(LEVEL_ROUNDS):
        gap = np.linalg.norm((source @ linear.T + offset - target)[:, 1:], axis=1)
        weight = 1.0 / (1.0 + (gap / LEVEL_DISTANCE) ** 2)
        linear, offset = _planar_fit(source, target, weight)
    scale = float(np.cbrt(np.linalg.det(linear)))
    turn = np.degrees(np.arccos(np.clip(linear[1, 1] / scale, -1.0, 1.0)))
    moved = float(np.linalg.norm((source @ linear.T + offset - source).mean(axis=0)))
    if turn > MOST_LEVEL_TURN or moved > MOST_LEVEL_SHIFT or abs(scale - 1.0) > MOST_LEVEL_SCALE:
        # Sites that were found wrongly would turn the whole head over.
        return pose
    # The point that goes to the origin of the average head.
    start = np.asarray(-np.linalg.solve(linear, offset) * pose.size, dtype=np.float64)
    origin = pose.out(start[None])[0]
    return Pose(origin, linear / scale @ pose.axes, pose.size / scale, pose.residual)


def _planar_fit(source: Floats, target: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """The similarity along y and z alone that brings points to others: scale, nod and shift."""
    share = weight / weight.sum()
    a, b = share @ source, share @ target
    a[0] = b[0] = 0.0
    p, q = (source - a)[:, 1:], (target - b)[:, 1:]
    dot = float(share @ (p * q).sum(axis=1))
    cross = float(share @ (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))
    angle = np.arctan2(cross, dot)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    scale = float(np.hypot(dot, cross) / (share @ (p**2).sum(axis=1)))
    linear = scale * turn
    return linear, b - linear @ a


def distance_from(points: Floats, normals: Floats, template: SurfaceData) -> float:
    """How far points of a head lie from a template's bone after the best small similarity, mm."""
    surface = Surface(template.vertices, template.triangles)
    start = np.eye(3), np.zeros(3)
    (fit,) = _similarities((points, normals), surface, [start], FINE_ROUNDS)
    return fit.distance


def _starts(points: Floats, target: Floats, average_size: float) -> Iterator[tuple[Floats, Floats]]:
    """Similarities to begin with: nods, sizes, and heads whose vertex is cut off."""
    middle = np.array([0.0, *points[:, 1:].mean(axis=0)])
    for pitch in np.radians(PITCHES):
        c, s = np.cos(pitch), np.sin(pitch)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        for size in SIZES:
            linear = average_size / size * turn
            moved = (points - middle) @ linear.T
            for cut in VERTEX_CUT:
                # The front of the bones on the front of the head, their top on its top.
                shift = np.array(
                    [
                        0.0,
                        np.quantile(target[:, 1], 0.02) - np.quantile(moved[:, 1], 0.02),
                        np.quantile(target[:, 2], 0.98) - cut - np.quantile(moved[:, 2], 0.98),
                    ]
                )
                yield linear, shift - linear @ middle


@dataclass
class _Similarity:
    """A similarity in the plane x = 0 as it is fitted.

    Attributes
    ----------
    linear : (3, 3) float64
    offset : (3,) float64, mm
    distance : float, mm
        Of the points from the surface in the last round, in the patient's size; infinite where
        too few pairs are left.
    """

    linear: Floats
    offset: Floats
    distance: float = np.inf
    is_lost: bool = False

    def step(self, samples: Samples, near: Floats, faces: Floats) -> None:
        """Fits once more to the surface's points nearest to the moved ones and their normals."""
        points, normals = samples
        scale = float(np.cbrt(np.linalg.det(self.linear)))
        moved = points @ self.linear.T + self.offset
        gaps = np.linalg.norm(near - moved, axis=1)
        turned = normals @ self.linear.T / scale
        agree = (turned * faces).sum(axis=1) > LEAST_AGREEMENT
        close = gaps <= np.quantile(gaps, 1.0 - POSE_TRIM)
        kept = close & agree
        if kept.sum() < LEAST_PAIRS:
            self.distance, self.is_lost = np.inf, True
            return
        share = float(kept.sum() / close.sum())
        rms = float(np.sqrt((np.minimum(gaps, MOST_GAP)[close] ** 2).mean())) / scale
        self.distance = rms / max(share, 0.1)
        step, move = _step_to_planes(moved[kept], near[kept], faces[kept])
        self.linear, self.offset = step @ self.linear, step @ self.offset + move


def _similarities(
    samples: Samples,
    surface: Surface,
    starts: Iterable[tuple[Floats, Floats]],
    rounds: int,
) -> list[_Similarity]:
    """The similarities in the plane x = 0 that fit best, from each of several starts.

    In each round the points of all of them are looked up at once.
    """
    fits = [_Similarity(linear, offset) for linear, offset in starts]
    face_normals = _face_normals(surface)
    points = samples[0]
    for _ in range(rounds):
        going = [fit for fit in fits if not fit.is_lost]
        if not going:
            break
        moved = [points @ fit.linear.T + fit.offset for fit in going]
        near, _, triangles = surface.closest(np.concatenate(moved))
        for fit, places, hit in zip(
            going, np.split(near, len(going)), np.split(triangles, len(going)), strict=True
        ):
            fit.step(samples, places, face_normals[hit])
    return fits


def _face_normals(surface: Surface) -> Floats:
    corners = surface.vertices[surface.triangles.astype(np.int64)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    units: Floats = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    return units


def _step_to_planes(points: Floats, near: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """The small similarity that keeps x = 0 in its place and brings points to tangent planes.

    Minimises the sum of (n·(p + a p + b e_x × p + t − q))² over scale a, nod b and t = (0, t_y,
    t_z), after Chen & Medioni (1992).
    """
    middle = np.array([0.0, *points[:, 1:].mean(axis=0)])
    p = points - middle
    turned = np.column_stack([np.zeros(len(p)), -p[:, 2], p[:, 1]])
    columns = np.column_stack(
        [(normals * p).sum(axis=1), (normals * turned).sum(axis=1), normals[:, 1], normals[:, 2]]
    )
    gap = (normals * (near - points)).sum(axis=1)
    # Scale and nod act over some 100 mm: in those units all four are lengths.
    units = np.array([100.0, 100.0, 1.0, 1.0])
    scaled = columns / units
    normal_matrix = scaled.T @ scaled + DAMPING * len(p) * np.eye(4)
    grow, nod, t_y, t_z = np.linalg.solve(normal_matrix, scaled.T @ gap) / units
    c, s = np.cos(nod), np.sin(nod)
    step = np.exp(grow) * np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return step, middle + [0.0, t_y, t_z] - step @ middle
