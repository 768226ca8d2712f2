"""Splines against scipy, and known motions recovered."""

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scanner_points import OFFSET, gap, moved, random_landmarks

import cmfsim
from benches.scenes.angles import angle_of_rotation

TESTS = Path(__file__).parents[1]
PATHS = [
    str(TESTS),
    str(Path(__file__).parent),
    str(TESTS.parents[1]),
    str(Path(cmfsim.__file__).parents[1]),
]


def bone(n=30):
    """Half of an egg with bumps, open below, about 60 mm wide: no rotation leaves it alike."""
    theta, phi = np.meshgrid(np.linspace(0.2, 1.8, n), np.linspace(0, 5.0, n), indexing="ij")
    r = 30 + 4 * np.sin(2 * theta) * np.cos(3 * phi) + 3 * np.sin(phi)
    points = np.stack(
        [r * np.sin(theta) * np.cos(phi), 0.8 * r * np.sin(theta) * np.sin(phi), r * np.cos(theta)],
        axis=-1,
    ).reshape(-1, 3)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return cmfsim.Surface(points + OFFSET, np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]))


def start(shift=20.0, angle=10.0):
    """A motion about the middle of the bone."""
    direction = np.array([0.6, -0.48, 0.64])
    return cmfsim.rigid_motion(shift * direction, angle, (1, 2, -1), OFFSET + [0, 0, 10])


@pytest.mark.parametrize("smoothing", [0.0, 1.0, 50.0])
def test_spline_agrees_with_scipy(smoothing):
    """RBFInterpolator with kernel −r and an affine part solves the same equations."""
    interpolate = pytest.importorskip("scipy.interpolate")
    source, target = random_landmarks()
    points = np.random.default_rng(1).uniform(-150, 150, (500, 3)) + OFFSET
    theirs = interpolate.RBFInterpolator(
        source, target, kernel="linear", degree=1, smoothing=smoothing
    )
    warp = cmfsim.ThinPlateSpline(source, target, smoothing)
    assert gap(warp(points), theirs(points)) < 1e-9
    assert gap(warp(source), theirs(source)) < 1e-9
    if smoothing == 0.0:
        assert gap(warp(source), target) < 1e-9
        assert warp.residuals.max() < 1e-9
    else:
        assert warp.residuals.max() > 0.1


def test_spline_tells_its_parts():
    """f(x) = A x + b + Σ w |x − s|, with weights that no affine map has."""
    source, target = random_landmarks(12)
    warp = cmfsim.ThinPlateSpline(source, target)
    points = np.random.default_rng(2).uniform(-90, 90, (40, 3)) + OFFSET
    r = np.linalg.norm(points[:, None] - source, axis=2)
    assert gap(moved(warp.affine, points) + r @ warp.weights, warp(points)) < 1e-9
    assert np.abs(warp.weights.sum(axis=0)).max() < 1e-12 * np.abs(warp.weights).max()
    assert np.abs(warp.weights.T @ (source - OFFSET)).max() < 1e-11
    for array in (warp.source, warp.target, warp.affine, warp.weights, warp.residuals):
        assert not array.flags.writeable


def test_bending_energy_is_the_integral_of_squared_second_derivatives():
    """Sampled over all space, by the closed form of the second derivatives."""
    source = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]])
    target = source.copy()
    target[4] += [0.3, 0, 0]
    warp = cmfsim.ThinPlateSpline(source, target)
    # Samples gather at the landmarks, where the squares grow as r^-2, and reach out to infinity,
    # where they fall as r^-6.
    rng = np.random.default_rng(0)
    n = 400_000
    t = rng.uniform(0, 1, n)
    radius = t / (1 - t)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    centre = source[rng.integers(0, 5, n)]
    x = centre + radius[:, None] * direction
    distance = np.linalg.norm(x[:, None] - source, axis=2)
    density = ((1 / (1 + distance) ** 2) / (4 * math.pi * distance**2)).mean(axis=1)
    # Hessian of |x − s| is (I − e eᵀ)/r.
    e = (x[:, None] - source) / distance[..., None]
    hessians = (np.eye(3) - e[..., None] * e[..., None, :]) / distance[..., None, None]
    second = np.einsum("jk,njab->nkab", warp.weights, hessians)
    values = np.square(second).sum(axis=(1, 2, 3)) / density
    error = values.std() / math.sqrt(n)
    assert abs(values.mean() - warp.bending_energy) < 4 * error
    assert error < 0.01 * warp.bending_energy


def test_jacobian_and_folds():
    """Determinants are those of the Jacobian; a landmark pushed through the others folds."""
    source, target = random_landmarks(10)
    warp = cmfsim.ThinPlateSpline(source, target)
    points = np.random.default_rng(3).uniform(-80, 80, (200, 3)) + OFFSET
    jacobian = warp.jacobian(points)
    h = 1e-3
    for axis in range(3):
        step = h * np.eye(3)[axis]
        slope = (warp(points + step) - warp(points - step)) / (2 * h)
        assert np.abs(slope - jacobian[:, :, axis]).max() < 1e-7
    assert np.allclose(warp.folds(points).determinants, np.linalg.det(jacobian), atol=1e-12)
    still = cmfsim.ThinPlateSpline(source, source)
    for quiet in (still.folds(points), still.landmark_folds()):
        assert quiet.count == 0
        assert quiet.smallest == pytest.approx(1.0)
    target = source.copy()
    target[3] -= 250.0 * (source[3] - source.mean(0)) / np.linalg.norm(source[3] - source.mean(0))
    warp = cmfsim.ThinPlateSpline(source, target)
    near = np.concatenate([points, source[[3]] + 0.01])
    folds, determinants = warp.folds(near), np.linalg.det(warp.jacobian(near))
    assert folds.count == np.count_nonzero(determinants <= 0) > 0
    assert folds.smallest == pytest.approx(determinants.min())
    assert folds.worst == np.argmin(determinants)
    assert warp.landmark_folds().determinants[3] <= 0.0
    assert warp.folds(np.zeros((0, 3))).smallest is None


def thread_digest():
    """Bits of a warp and of an iteration."""
    source, target = random_landmarks()
    warp = cmfsim.ThinPlateSpline(source, target)
    surface = bone(20)
    digest = hashlib.sha256(warp(np.tile(surface.vertices, (5, 1))).tobytes())
    fit = cmfsim.icp(moved(start(3, 3), surface.vertices), surface, trim=0.1)
    digest.update(fit.matrix.tobytes() + fit.rms_history.tobytes())
    return digest.hexdigest()


def test_one_and_two_threads_give_the_same_bits():
    script = f"import sys; sys.path[:0] = {PATHS!r}; import test_registration as t; "
    script += "print(t.thread_digest())"
    digests = {
        subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "RAYON_NUM_THREADS": str(threads)},
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
        for threads in (1, 2, 3)
    }
    assert len(digests) == 1
    assert len(digests.pop()) == 64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, t: (s[:3], t[:3]), "needs at least 4 landmarks"),
        (lambda s, t: (s, t[:-1]), "target landmarks has 31 entries where 32"),
        (lambda s, t: (s * [1, 1, 0], t), "lie in one plane"),
        (lambda s, t: (s * [1, 0, 0], t), "lie in one line"),
        (lambda s, t: (s[[0, 1, 2, 3, 1]], t[:5]), "landmarks 1 and 4 coincide"),
        (lambda s, t: (s * np.nan, t), "must be finite"),
        (lambda s, t: (s, t.T), "shape"),
        (lambda s, t: (s * 1e4, t), "check the units"),
        (lambda s, t: (s, t, -1.0), "smoothing"),
        (lambda s, t: (s, t, math.nan), "smoothing"),
        (lambda s, t: (s[:0], t[:0]), "there are 0"),
    ],
)
def test_unusable_landmarks_are_refused(change, message):
    with pytest.raises(cmfsim.RegistrationError, match=message) as caught:
        cmfsim.ThinPlateSpline(*change(*random_landmarks()))
    assert isinstance(caught.value, ValueError)


def test_rigid_fit_agrees_with_scipy_and_meets_the_noise_bound():
    """The rotation is scipy's; with noise σ in each coordinate, rms² is σ²(3 − 6/n) on average."""
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    rng = np.random.default_rng(5)
    sigma, n = 0.5, 200
    squares = []
    for _ in range(20):
        moving = rng.uniform(-60, 60, (n, 3)) + OFFSET
        motion = cmfsim.rigid_motion(rng.normal(0, 30, 3), rng.uniform(0, 180), rng.normal(size=3))
        weights = rng.uniform(0.2, 2.0, n)
        exact = moved(motion, moving)
        fit = cmfsim.rigid_fit(moving, exact, weights=weights)
        assert gap(moved(fit.matrix, moving), exact) < 1e-9
        noisy = exact + rng.normal(0, sigma, (n, 3))
        fit = cmfsim.rigid_fit(moving, noisy)
        squares.append(fit.rms**2)
        a, b = moving - moving.mean(0), noisy - noisy.mean(0)
        theirs = rotation.align_vectors(b, a)[0].as_matrix()
        assert np.abs(fit.matrix[:3, :3] - theirs).max() < 1e-9
        # The middle is known to σ/√n in each axis; five times that is never passed by chance.
        middle = moved(fit.matrix, moving.mean(0)[None]) - exact.mean(0)
        assert np.abs(middle).max() < 5 * sigma / math.sqrt(n)
        turned = fit.matrix[:3, :3] @ motion[:3, :3].T
        angle = math.radians(angle_of_rotation(turned))
        assert angle < 6 * sigma / math.sqrt(n) / 60 * math.sqrt(3)
    assert np.mean(squares) == pytest.approx(sigma**2 * (3 - 6 / n), rel=0.05)


def test_icp_recovers_a_known_motion_from_20_mm_and_10_degrees():
    surface = bone()
    motion = start()
    points = moved(np.linalg.inv(motion), surface.vertices)
    fit = cmfsim.icp(points, surface, keep_border=True)
    assert fit.converged
    assert gap(moved(fit.matrix, points), surface.vertices) < 1e-9
    assert fit.rms < 1e-9
    assert fit.kept_fraction == 1.0
    assert len(fit.rms_history) == fit.iterations + 1
    assert fit.iterations < 60
    data = cmfsim.SurfaceData(surface.vertices, surface.triangles)
    again = cmfsim.icp(surface.moved(points), data, keep_border=True)
    assert np.array_equal(again.matrix, fit.matrix)


def test_icp_of_points_is_exact_and_follows_its_start():
    rng = np.random.default_rng(6)
    fixed = rng.uniform(-50, 50, (400, 3)) + OFFSET
    moving = moved(np.linalg.inv(start(2, 2)), fixed)
    fit = cmfsim.icp(moving, fixed)
    assert gap(moved(fit.matrix, moving), fixed) < 1e-9
    far = moved(np.linalg.inv(start(40, 90)), fixed)
    fit = cmfsim.icp(far, fixed, initial=start(41, 89))
    assert gap(moved(fit.matrix, far), fixed) < 1e-9


def test_icp_meets_the_noise_bound():
    """Noise σ along the normals: the six numbers of the motion have the covariance σ² (AᵀA)⁻¹."""
    rng = np.random.default_rng(7)
    surface, sigma = bone(40), 0.3
    inner = surface.vertices.reshape(40, 40, 3)[4:-4, 4:-4].reshape(-1, 3)
    points = moved(np.linalg.inv(start()), inner + rng.normal(0, sigma, inner.shape))
    fit = cmfsim.icp(points, surface)
    reached = moved(fit.matrix @ np.linalg.inv(start()), inner)
    # Rows of A: what turns about the middle and shifts do to the distance of a point.
    normals = surface.vertex_normals.reshape(40, 40, 3)[4:-4, 4:-4].reshape(-1, 3)
    arms = inner - inner.mean(axis=0)
    rows = np.column_stack([np.cross(arms, normals), normals])
    covariance = sigma**2 * np.linalg.inv(rows.T @ rows)
    # What the six numbers do to a point.
    cross = np.cross(np.eye(3)[None], arms[:, None]).transpose(0, 2, 1)
    motions = np.concatenate([cross, np.tile(np.eye(3), (len(arms), 1, 1))], axis=2)
    variance = np.einsum("nij,jk,nik->n", motions, covariance, motions)
    assert gap(reached, inner) < 2.5 * math.sqrt(variance.max())
    assert fit.rms < 1.1 * sigma


def test_icp_with_40_percent_overlap():
    """Points that reach past the surface find its border, and are left out."""
    surface = bone(40)
    grid = surface.vertices.reshape(40, 40, 3)
    triangles = surface.triangles
    keep = np.zeros((40, 40), dtype=bool)
    keep[:, :22] = True
    half = cmfsim.Surface(surface.vertices, triangles[keep.ravel()[triangles].all(axis=1)])
    # 2/5 of the moving points lie over it.
    moving = grid[:, 12:37].reshape(-1, 3)
    points = moved(np.linalg.inv(start(5, 4)), moving)
    fit = cmfsim.icp(points, half)
    assert gap(moved(fit.matrix, points), moving) < 1e-9
    assert 0.3 < fit.kept_fraction < 0.45


def test_icp_trims_30_percent_of_outliers():
    rng = np.random.default_rng(8)
    surface = bone(40)
    points = surface.vertices.reshape(40, 40, 3)[2:-2, 2:-2].reshape(-1, 3).copy()
    wrong = rng.permutation(len(points))[: int(0.3 * len(points))]
    clean = points.copy()
    points[wrong] += rng.uniform(-25, 25, (len(wrong), 3))
    moving = moved(np.linalg.inv(start(8, 5)), points)
    trimmed = cmfsim.icp(moving, surface, trim=0.35)
    right = moved(trimmed.matrix @ np.linalg.inv(start(8, 5)), clean)
    assert gap(right, clean) < 1e-9
    plain = cmfsim.icp(moving, surface)
    assert gap(moved(plain.matrix @ np.linalg.inv(start(8, 5)), clean), clean) > 0.1


def test_icp_leaves_out_pairs_that_face_away():
    """The far wall of a thin plate is nearer than the right one, and its normal tells."""
    surface = bone(30)
    behind = surface.vertices - 1.0 * surface.vertex_normals
    both = cmfsim.Surface(
        np.concatenate([surface.vertices, behind]),
        np.concatenate([surface.triangles, surface.triangles[:, ::-1] + len(behind)]),
    )
    inner = surface.moved(moved(np.linalg.inv(start(1.2, 1)), surface.vertices))
    fit = cmfsim.icp(inner, both, max_angle=60.0, keep_border=True)
    assert gap(moved(fit.matrix, inner.vertices), surface.vertices) < 1e-9
    with pytest.raises(cmfsim.RegistrationError, match="max_angle"):
        cmfsim.icp(inner.vertices, both, max_angle=60.0)


def test_icp_says_what_stops_it():
    surface = bone(15)
    points = moved(start(3, 3), surface.vertices)
    with pytest.raises(cmfsim.RegistrationError, match="did not converge: in step 2") as caught:
        cmfsim.icp(points, surface, max_iterations=2)
    assert len(caught.value.rms_history) == 3
    assert not isinstance(caught.value, ValueError)
    fit = cmfsim.icp(points, surface, max_iterations=2, tolerance=0.0)
    assert fit.iterations == 2
    assert not fit.converged
    for wrong, message in (
        ({"trim": 1.0}, "trim"),
        ({"trim": math.nan}, "trim"),
        ({"max_distance": -1.0}, "max_distance"),
        ({"max_distance": 1e-9}, "not determined"),
        ({"max_angle": 200.0}, "max_angle"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"method": "best"}, "method"),
        ({"initial": np.eye(3)}, "initial"),
        ({"initial": np.diag([1, 1, -1, 1])}, "reflection"),
    ):
        with pytest.raises(cmfsim.RegistrationError, match=message):
            cmfsim.icp(points, surface, **wrong)
    with pytest.raises(cmfsim.RegistrationError, match="point"):
        cmfsim.icp(points, surface.vertices, method="plane")
    with pytest.raises(cmfsim.RegistrationError, match="line"):
        cmfsim.icp(np.outer(np.arange(9.0), [1, 2, 3]), surface)
