"""The pose of a head: its plane of symmetry, and the frame of an average head."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cmfsim._core import IcpFit, Surface, icp
from cmfsim.errors import LandmarkInputError, RegistrationError
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# Points of a surface that poses are fitted with.
SAMPLES = 4000
# Share of the worst pairs that fits leave out: spine, couch and what the other head lacks.
MIRROR_TRIM, POSE_TRIM = 0.3, 0.35
# A plane of symmetry is one where the kept pairs lie nearer than this, mm: real heads 0.6 mm, in
# planes that are none 1.6 mm and more.
EVEN = 1.0
# A pose may be refined by so much: degrees, mm, share of the size. More is another one.
MOST_TURN, MOST_SHIFT, MOST_SCALE = 15.0, 20.0, 0.12
# Rounds of pairs and similarity fits.
FINE_ROUNDS = 40
# Damping of a step, as a share of the pairs.
DAMPING = 1e-3
# Cosine between the normals of a pair at least; farthest distance that counts, mm; fewest pairs.
LEAST_AGREEMENT, MOST_GAP, LEAST_PAIRS = 0.5, 30.0, 50


# Points of a surface and their outward unit normals, (n, 3) each.
Samples = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Pose:
    """How a head lies: p' = axes (p − origin), in mm, with x' to the left, y' back, z' up.

    origin: (3,), mm, where the middle between the ear canals would lie.
    axes: (3, 3). Its rows are the directions left, back and up.
    size: Of the head, as a factor on the average head.
    residual: mm. Root of the mean square distance of the kept points from the average head.
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


def refined_pose(start: Pose, bones: SurfaceData, average: SurfaceData) -> Pose:
    """A pose with the plane of symmetry of the bones, and the fit of an average cranium in it.

    What the bones do not show, such as a plane of symmetry of half a head, stays as it is.

    start: Of the model of shape, right to some degrees.
    bones: Cranium of the patient; parts may be missing.
    average: Cranium of a whole head in its own frame: x = 0 its plane of symmetry.
    """
    points, normals = surface_samples(bones, SAMPLES)
    pose = _even(start, bones, (points, normals))
    placed = pose.into(points), normals @ pose.axes.T
    fine = _similarity(placed, Surface(average.vertices, average.triangles), start.size)
    if fine.is_lost:
        return pose
    scale = float(np.cbrt(np.linalg.det(fine.linear)))
    middle: Floats = -np.linalg.solve(fine.linear, fine.offset).astype(np.float64)
    origin = pose.out(middle[None])[0]
    found = Pose(origin, fine.linear / scale @ pose.axes, 1.0 / scale, fine.distance)
    return found if _is_near(found, pose) else pose


def _is_near(found: Pose, start: Pose) -> bool:
    """Whether a pose is another one than that of the start."""
    turn = np.degrees(np.arccos(np.clip((found.axes @ start.axes.T).trace() / 2.0 - 0.5, -1, 1)))
    shift = float(np.linalg.norm(found.origin - start.origin)) / start.size
    scale = abs(found.size / start.size - 1.0)
    return bool(turn < MOST_TURN and shift < MOST_SHIFT and scale < MOST_SCALE)


def _even(start: Pose, bones: SurfaceData, samples: Samples) -> Pose:
    """The pose with the plane of symmetry that is near its own, if there is one."""
    points, normals = start.into(samples[0]), samples[1] @ start.axes.T
    surface = Surface(start.into(bones.vertices), bones.triangles)
    flip = np.array([-1.0, 1.0, 1.0])
    try:
        fit = _mirror_fit((points * flip, normals * flip), surface)
    except RegistrationError:
        return start
    # p → R S p + t is nearly a reflection; its axis is the eigenvector of −1.
    rotation = fit.matrix[:3, :3] @ np.diag(flip)
    values, vectors = np.linalg.eigh(0.5 * (rotation + rotation.T))
    left = vectors[:, int(np.argmin(values))]
    left = left if left[0] > 0.0 else -left
    # Midpoints of points and their images lie in the plane.
    middle = 0.5 * (points @ rotation.T + fit.matrix[:3, 3] + points)
    up = np.array([0.0, 0.0, 1.0]) - left * left[2]
    up /= np.linalg.norm(up)
    axes = np.stack([left, np.cross(up, left), up]) @ start.axes
    origin = start.out((left * float(np.median(middle @ left)))[None])[0]
    found = Pose(origin, axes, start.size, start.residual)
    return found if fit.rms <= EVEN and _is_near(found, start) else start


def _mirror_fit(mirrored: Samples, surface: Surface) -> IcpFit:
    """The rigid motion that brings mirrored points back to the surface."""
    return icp(
        mirrored[0], surface, initial=None, max_distance=None, keep_border=False, trim=MIRROR_TRIM,
        method="plane", max_iterations=300, tolerance=1e-5, max_angle=np.radians(45.0),
        normals=mirrored[1],
    )  # fmt: skip


# Sites of the cranium that show how it nods, and the distance at which one counts half, mm.
LEVEL_SITES = (
    "nasion", "glabella", "rhinion", "mid_philtrum", "supradentale", "supraorbital_L",
    "supraorbital_R", "suborbital_L", "suborbital_R", "zygomatic_arch_L", "zygomatic_arch_R",
    "supraglenoid_L", "supraglenoid_R",
)  # fmt: skip
LEVEL_DISTANCE, LEVEL_ROUNDS, LEAST_LEVEL_SITES = 5.0, 20, 6
# A levelling that turns the head by more, degrees, or moves or scales it by more (mm, share) rests
# on sites that were found wrongly.
MOST_LEVEL_TURN, MOST_LEVEL_SHIFT, MOST_LEVEL_SCALE = 12.0, 12.0, 0.12


def levelled(pose: Pose, found: Mapping[str, Floats], average: Mapping[str, Floats]) -> Pose:
    """The pose with nod, size and place by sites of the cranium instead of its whole surface.

    Skulls differ more in the vault than in how the face lies below it. The plane of symmetry stays.

    found, average: mapping of str to (3,). Sites as found in that pose, average-head mm, and those
        of the average head.
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
    return _similarity((points, normals), Surface(template.vertices, template.triangles)).distance


@dataclass
class _Similarity:
    """A similarity in the plane x = 0 as it is fitted.

    linear: (3, 3).
    offset: (3,), mm.
    distance: mm, of the points from the surface in the last round, in the patient's size; infinite
        where too few pairs are left.
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


def _similarity(samples: Samples, surface: Surface, size: float = 1.0) -> _Similarity:
    """The similarity in the plane x = 0 that fits a head of some size best."""
    fit = _Similarity(np.eye(3) / size, np.zeros(3))
    face_normals = _face_normals(surface)
    for _ in range(FINE_ROUNDS):
        near, _, hit = surface.closest(samples[0] @ fit.linear.T + fit.offset)
        fit.step(samples, near, face_normals[hit])
        if fit.is_lost:
            break
    return fit


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
