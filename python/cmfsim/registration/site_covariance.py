"""How the landmarks of a head follow one another: a normal distribution of where they truly are.

The shapes of a family of synthetic heads, smooth deviations that it lacks, the pose and size of the
head and the posture of its jaw are uncertain; the proposed sites are measurements of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.similarity import robust_similarity
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS, site_part
from cmfsim.values.proposed_landmarks import ProposedLandmarks

FILE = "site_family.npz"
# Share of the family's variance that its stored modes have.
KEPT_VARIANCE = 0.999
# How far a person's own point lies from the site, along each axis, mm: two persons differ by 1 to
# 2 mm at most sites (docs/landmarks.md).
PLACED_STD = 1.0
# Shapes that the family of synthetic heads lacks: smooth deviations with their length, as Lüthi et
# al. (2018) add them to models of few heads, and each site's own; mm of the average head. Together
# 3.4 mm along each axis, which is rather too much than too little: expected errors must not be
# smaller than errors (docs/landmarks.md).
SMOOTH_STD, SMOOTH_LENGTH, OWN_STD = 3.0, 40.0, 1.5
# Uncertainty of the pose before any site is seen: shift in mm, turn in radians, relative size.
SHIFT_STD, TURN_STD, SIZE_STD = 15.0, 0.2, 0.08
# Of the lower jaw against the cranium: it opens about the axis through its joints, radians, and
# glides, mm.
OPENING_STD, GLIDE_STD = 0.12, 3.0
# Errors of proposed sites are alike on a part, because a wrong pose or a wrong cut between the jaws
# is wrong for all of them: the share of the variance that they have in common, and its reach, mm.
ALIKE_SHARE, ALIKE_LENGTH = 0.8, 60.0
# The distance at which a proposed site counts half when the average head is brought onto them, mm.
HALF_DISTANCE, ROUNDS, LEAST_SITES = 6.0, 30, 3

# Share of the vertices of the bones that are its front, per cent.
FOREMOST = 10.0

# Kind ("skull" or "skin") and label.
SiteKey = tuple[str, str]
KEYS: tuple[SiteKey, ...] = (
    *(("skull", name) for name in SKULL_LANDMARKS),
    *(("skin", name) for name in SKIN_LANDMARKS),
)


@dataclass(frozen=True, eq=False)
class SiteDistribution:
    """Where the landmarks of a head are expected, and how their errors depend on one another.

    Attributes
    ----------
    names : tuple of (str, str)
        Kind and label.
    mean : (n, 3) float64, mm
        The proposed points; of a missing site where the others place it.
    covariance : (3 n, 3 n) float64, mm²
        Of the errors of `mean`, by site and axis.
    """

    names: tuple[SiteKey, ...]
    mean: Floats
    covariance: Floats

    def given(
        self, points: Mapping[SiteKey, Floats], stds: Mapping[SiteKey, float] | None = None
    ) -> "SiteDistribution":
        """The distribution once some sites are known: the conditional mean and covariance.

        Parameters
        ----------
        points : mapping of (kind, label) to (3,) float64, mm
        stds : mapping of (kind, label) to float, mm
            How far a point may be off along each axis; `PLACED_STD` for those that it lacks.
        """
        stds = stds or {}
        known = [i for i, name in enumerate(self.names) if name in points]
        if not known:
            return self
        rows = (3 * np.array(known)[:, None] + np.arange(3)).ravel()
        away = np.array([points[self.names[i]] - self.mean[i] for i in known]).ravel()
        noise = np.repeat([stds.get(self.names[i], PLACED_STD) ** 2 for i in known], 3)
        mean, covariance = _conditional(self.covariance, rows, away, np.diag(noise))
        return SiteDistribution(self.names, self.mean + mean.reshape(-1, 3), covariance)

    @property
    def errors(self) -> Floats:
        """The expected (root mean square) error of each site, (n,) mm."""
        variances = np.maximum(np.diag(self.covariance), 0.0)
        found: Floats = np.sqrt(variances.reshape(-1, 3).sum(axis=1))
        return found


def site_covariance(proposal: ProposedLandmarks, bone: Floats) -> SiteDistribution:
    """The distribution of the landmarks of a head for which some were proposed.

    Parameters
    ----------
    proposal : ProposedLandmarks
        Sites with their expected errors. If there are fewer than three, the pose is a guess from
        the extent of the bone, and uncertain.
    bone : (n, 3) float64, mm
        Vertices of the bones.

    Notes
    -----
    A normal distribution of shapes with smooth deviations (Lüthi, Gerig, Jud & Vetter 2018,
    Gaussian process morphable models), conditioned on the proposed sites.
    """
    sites = {
        **{("skull", name): site for name, site in proposal.skull.items()},
        **{("skin", name): site for name, site in proposal.skin.items()},
    }
    known = [i for i, key in enumerate(KEYS) if key in sites]
    found = np.array([sites[KEYS[i]].point for i in known]).reshape(-1, 3)
    stds = np.array([sites[KEYS[i]].error for i in known]) / np.sqrt(3.0)
    mean, covariance = _family()[0], _spread()
    if len(known) < LEAST_SITES:
        mean = mean + _guessed_shift(mean, bone)
    else:
        linear, offset, _ = robust_similarity(mean[known], found, 1.0 / stds**2, HALF_DISTANCE)
        turn = np.kron(np.eye(len(mean)), linear)
        mean, covariance = mean @ linear.T + offset, turn @ covariance @ turn.T
    if not known:
        return SiteDistribution(KEYS, mean, covariance)
    rows = (3 * np.array(known)[:, None] + np.arange(3)).ravel()
    shift, left = _conditional(
        covariance, rows, (found - mean[known]).ravel(), _measured(found, known, stds)
    )
    places = mean + shift.reshape(-1, 3)
    places[known] = found
    return SiteDistribution(KEYS, places, left)


def write_family(path: Path, places: Floats) -> None:
    """Writes the mean and the modes of a family's landmarks, (heads, sites, 3) mm."""
    mean = places[0]
    for _ in range(ROUNDS):
        aligned = np.stack([_aligned(head, mean) for head in places])
        mean = aligned.mean(axis=0)
    away = (aligned - mean).reshape(len(places), -1) / np.sqrt(len(places) - 1.0)
    _, sizes, modes = np.linalg.svd(away, full_matrices=False)
    share = np.cumsum(sizes**2) / np.sum(sizes**2)
    kept = int(np.searchsorted(share, KEPT_VARIANCE)) + 1
    np.savez_compressed(
        path,
        mean=mean.astype(np.float32),
        modes=(sizes[:kept, None] * modes[:kept]).astype(np.float32),
        allow_pickle=False,
    )


@lru_cache(maxsize=1)
def _family() -> tuple[Floats, Floats]:
    """The mean landmarks (sites, 3), and the modes (k, 3 sites) with their sizes, mm."""
    with np.load(Path(__file__).with_name(FILE), allow_pickle=False) as stored:
        return stored["mean"].astype(np.float64), stored["modes"].astype(np.float64)


def _spread() -> Floats:
    """The covariance of an average head's sites before any is seen, (3 n, 3 n) mm²."""
    mean, modes = _family()
    covariance = modes.T @ modes + _smooth(mean)
    for motion, std in _motions(mean):
        covariance += std**2 * np.outer(motion, motion)
    return covariance


def _guessed_shift(mean: Floats, bone: Floats) -> Floats:
    """What brings an average head to where the bone is foremost, in its middle, mm."""
    front = bone[bone[:, 1] <= np.percentile(bone[:, 1], FOREMOST)]
    ahead = mean[mean[:, 1] <= np.percentile(mean[:, 1], 50.0)]
    shift: Floats = front.mean(axis=0) - ahead.mean(axis=0)
    return shift


def _smooth(mean: Floats) -> Floats:
    """The covariance of smooth deviations of the sites, and of each site's own, mm²."""
    apart = np.linalg.norm(mean[:, None] - mean, axis=2)
    kernel = SMOOTH_STD**2 * np.exp(-0.5 * (apart / SMOOTH_LENGTH) ** 2)
    return np.kron(kernel + OWN_STD**2 * np.eye(len(mean)), np.eye(3))


def _motions(mean: Floats) -> list[tuple[Floats, float]]:
    """The ways of all sites under a unit of each motion, (3 n,), and its standard deviation."""
    middle = mean.mean(axis=0)
    axes = np.eye(3)
    found = [(np.tile(axis, len(mean)), SHIFT_STD) for axis in axes]
    found += [(np.cross(axis, mean - middle).ravel(), TURN_STD) for axis in axes]
    found.append(((mean - middle).ravel(), SIZE_STD))
    in_jaw = np.array([[site_part(*key) == "mandible"] for key in KEYS], dtype=np.float64)
    joints = np.mean([mean[KEYS.index(("skull", f"supraglenoid_{s}"))] for s in "LR"], axis=0)
    opening = np.cross(axes[0], mean - joints) * in_jaw
    found.append((opening.ravel(), OPENING_STD))
    found += [((axis * in_jaw).ravel(), GLIDE_STD) for axis in axes]
    return found


def _measured(found: Floats, known: list[int], stds: Floats) -> Floats:
    """The covariance of the errors of proposed sites, mm²: close ones on a part are alike."""
    parts = np.array([site_part(*KEYS[i]) for i in known])
    apart = np.linalg.norm(found[:, None] - found, axis=2)
    alike = np.exp(-0.5 * (apart / ALIKE_LENGTH) ** 2) * (parts[:, None] == parts)
    shared = ALIKE_SHARE * alike + (1.0 - ALIKE_SHARE) * np.eye(len(known))
    return np.kron(shared * np.outer(stds, stds), np.eye(3))


def _conditional(
    covariance: Floats, rows: NDArray[np.intp], away: Floats, noise: Floats
) -> tuple[Floats, Floats]:
    """Shift of the mean, and covariance, if `rows` were measured to be `away` with this noise."""
    across = covariance[:, rows]
    gain = np.linalg.solve(across[rows] + noise, across.T).T
    left = covariance - gain @ across.T
    return gain @ away, 0.5 * (left + left.T)


def _aligned(points: Floats, onto: Floats) -> Floats:
    linear, offset, _ = robust_similarity(points, onto, np.ones(len(points)), HALF_DISTANCE)
    return points @ linear.T + offset
