"""The pose of a head of unknown place: its plane of symmetry, and the frame of an average head."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim._core import Surface, icp, rigid_fit
from cmfsim.checks import Floats
from cmfsim.errors import LandmarkInputError, RegistrationError
from cmfsim.values.surface_data import SurfaceData

__all__ = ["Pose", "find_pose", "surface_samples"]

# Points of a surface that poses are fitted with.
SAMPLES = 4000
# Share of the worst pairs that fits leave out: spine, couch and what the other head lacks.
MIRROR_TRIM, POSE_TRIM = 0.3, 0.35
# Heads are offered to the fit nodding this far either way, degrees, and in these sizes.
PITCHES = (-24.0, -12.0, 0.0, 12.0, 24.0)
SIZES = (0.72, 0.82, 0.92, 1.02, 1.12)
# Rounds of pairs and similarity fits of a candidate, and of the best.
ROUGH_ROUNDS, FINE_ROUNDS = 12, 40
# A pose whose kept points lie farther from the average head than this is none, mm.
WORST_FIT = 6.0


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
        return np.asarray((points - self.origin) @ self.axes.T)

    def out(self, points: Floats) -> Floats:
        """Points of the head's own frame, (n, 3) mm, in the patient's."""
        return np.asarray(points @ self.axes + self.origin)


def surface_samples(surface: SurfaceData, count: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Points spread evenly over a surface and their outward unit normals, (n, 3) each.

    The same for the same seed; triangles count by their area.
    """
    vertices = np.asarray(surface.vertices)
    corners = vertices[np.asarray(surface.triangles).astype(np.int64)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    total = np.cumsum(doubled)
    if not total[-1] > 0.0:
        raise LandmarkInputError("a surface has no area: no landmark can be found on it")
    generator = np.random.default_rng(seed)
    # One throw in each of as many equal shares of the area: evener than free throws.
    throws = (np.arange(count) + generator.random(count)) / count * total[-1]
    chosen = np.minimum(np.searchsorted(total, throws, side="right"), len(total) - 1)
    u, v = generator.random((2, count))
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
    a, b, c = corners[chosen].transpose(1, 0, 2)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return points, normals[chosen] / doubled[chosen][:, None]


def find_pose(
    bones: Mapping[str, SurfaceData], average: SurfaceData, average_size: float = 1.0
) -> Pose:
    """The pose of a head by its bones: the plane of symmetry, then the fit of an average cranium.

    Parameters
    ----------
    bones : mapping of str to SurfaceData
        Of the patient, roughly upright in LPS (within about 30°); parts may be missing.
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
    fixed_bones = [s for n, s in bones.items() if n != "mandible"] or list(bones.values())
    joined = _joined(fixed_bones)
    points, normals = surface_samples(joined, SAMPLES)
    symmetry, centre = _symmetry(joined, points, normals)
    return _fitted(points, normals, symmetry, centre, average, average_size)


def _joined(surfaces: list[SurfaceData]) -> SurfaceData:
    counts = np.cumsum([0, *(len(np.asarray(s.vertices)) for s in surfaces)])
    return SurfaceData(
        np.concatenate([np.asarray(s.vertices) for s in surfaces]),
        np.concatenate(
            [np.asarray(s.triangles).astype(np.int64) + n for s, n in zip(surfaces, counts)]  # noqa: B905
        ),
    )


def _symmetry(whole: SurfaceData, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """The unit normal of the plane of symmetry, towards the left, and a point of it."""
    surface = Surface(np.asarray(whole.vertices), np.asarray(whole.triangles))
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    flip = np.array([-1.0, 1.0, 1.0])
    mirrored = (points - centre) * flip + centre
    try:
        fit = icp(
            mirrored,
            surface,
            initial=None,
            max_distance=None,
            keep_border=False,
            trim=MIRROR_TRIM,
            method="plane",
            max_iterations=80,
            tolerance=1e-5,
            max_angle=np.radians(45.0),
            normals=normals * flip,
        )
        matrix = np.asarray(fit.matrix)
    except RegistrationError as error:
        raise LandmarkInputError(
            f"the bones have no plane of symmetry that can be found ({error}): place the landmarks "
            "by hand"
        ) from error
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


def _fitted(
    points: Floats,
    normals: Floats,
    left: Floats,
    centre: Floats,
    average: SurfaceData,
    average_size: float,
) -> Pose:
    surface = Surface(np.asarray(average.vertices), np.asarray(average.triangles))
    up = np.array([0.0, 0.0, 1.0]) - left * left[2]
    up /= np.linalg.norm(up)
    upright = np.stack([left, np.cross(up, left), up])
    # The tips of the head are in front and above in any scan of a face; ends behind may be cut.
    target = np.asarray(average.vertices)
    begin = (points - centre) @ upright.T
    start_from = np.array([0.0, *begin[:, 1:].mean(axis=0)])
    best: tuple[float, Floats, Floats, float] | None = None
    few = slice(None, None, 4)
    for pitch in np.radians(PITCHES):
        c, s = np.cos(pitch), np.sin(pitch)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        for size in SIZES:
            scale = average_size / size
            moved = scale * (begin - start_from) @ turn.T
            # Foreheads and faces together: the front of the points on the front of the head.
            shift = np.array(
                [
                    0.0,
                    np.quantile(target[:, 1], 0.02) - np.quantile(moved[:, 1], 0.02),
                    np.quantile(target[:, 2], 0.98) - np.quantile(moved[:, 2], 0.98),
                ]
            )
            result = _similarity(
                begin[few], normals[few] @ upright.T, surface, scale * turn,
                shift - scale * turn @ start_from, ROUGH_ROUNDS,
            )
            if best is None or result[0] < best[0]:
                best = result
    if best is None:
        raise AssertionError("no pose was tried")
    rms, linear, offset, _ = _similarity(
        begin, normals @ upright.T, surface, best[1], best[2], FINE_ROUNDS
    )
    scale = float(np.cbrt(np.linalg.det(linear)))
    residual = rms
    if residual > WORST_FIT:
        raise LandmarkInputError(
            f"the bones lie {residual:.1f} mm from an average skull wherever it is placed (at most "
            f"{WORST_FIT:g} mm allowed): they show no head, or one turned by more than 30°; place "
            "the landmarks by hand"
        )
    axes = linear / scale @ upright
    origin = centre - upright.T @ (np.linalg.solve(linear, offset))
    return Pose(origin, axes, average_size / scale, residual)


def _similarity(
    points: Floats,
    normals: Floats,
    surface: Surface,
    linear: Floats,
    offset: Floats,
    rounds: int,
) -> tuple[float, Floats, Floats, float]:
    """Distance in the patient's mm, and the similarity in the plane x = 0 that fits best."""
    kept_rms = np.inf
    share = 1.0
    for _ in range(rounds):
        scale = float(np.cbrt(np.linalg.det(linear)))
        moved = points @ linear.T + offset
        near, _, triangles = surface.closest(moved)
        gaps = np.linalg.norm(near - moved, axis=1)
        turned = normals @ linear.T / scale
        agree = (turned * _face_normals(surface)[triangles]).sum(axis=1) > 0.5
        limit = np.quantile(gaps, 1.0 - POSE_TRIM)
        kept = (gaps <= limit) & agree
        share = float(kept.mean())
        kept_rms = float(np.sqrt((np.minimum(gaps, 30.0)[gaps <= limit] ** 2).mean())) / scale
        if kept.sum() < 50:
            return np.inf, linear, offset, share
        linear, offset = _planar_fit(points[kept], near[kept])
    return kept_rms / max(share, 0.1), linear, offset, share


_NORMALS: dict[int, Floats] = {}


def _face_normals(surface: Surface) -> Floats:
    key = id(surface)
    if key not in _NORMALS:
        corners = np.asarray(surface.vertices)[np.asarray(surface.triangles).astype(np.int64)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        _NORMALS[key] = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    return _NORMALS[key]


def _planar_fit(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """The similarity that keeps x = 0 in its place: scale, pitch and shift along y and z."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    a[0] = b[0] = 0.0
    p, q = source - a, target - b
    dot = float((p[:, 1:] * q[:, 1:]).sum())
    cross = float((p[:, 1] * q[:, 2] - p[:, 2] * q[:, 1]).sum())
    angle = np.arctan2(cross, dot)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    scale = float((q * (p @ turn.T)).sum() / (p**2).sum())
    linear = scale * turn
    return linear, b - linear @ a
