"""How the landmarks of a head follow one another: a normal distribution of where they truly are.

The shape is that of the model of shape, a Gaussian process about the average head; the pose and
size of the head and the posture of its jaw are uncertain; known sites are measurements of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.closest import robust_similarity
from cmfsim.registration.proposed.shape_model.model import (
    HEAD,
    JAW,
    MIRROR,
    SITES,
    TISSUE,
    jaw_shares,
)
from cmfsim.registration.proposed.shape_model.state import N_JAW, moved_with_jaw
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import REFERENCE_PLACES, site_part
from cmfsim.values.proposed_landmarks import ProposedLandmarks, ProposedSite

# How far a person's own point lies from the site, along each axis, mm: two persons differ by 1 to
# 2 mm at most sites (docs/landmarks.md).
PLACED_STD = 1.0
# What each site has on its own, alike on both sides: relief, and what an operator takes it to be.
# The likeliest of two real heads together (`benches/accuracy/placed_sites.py`).
OWN_STD = 1.5
# Uncertainty of the pose before any site is seen: shift in mm, turn in radians, relative size.
SHIFT_STD, TURN_STD, SIZE_STD = 15.0, 0.2, 0.08
# Errors of proposed sites are alike on a part, because a wrong pose or a wrong cut between the jaws
# is wrong for all of them: the share of the variance that they have in common, and its reach, mm,
# the length of a jaw. Of an expected error of 10 mm, 3 mm are then each site's own.
ALIKE_SHARE, ALIKE_LENGTH = 0.9, 100.0
# The distance at which a proposed site counts half when the average head is brought onto them, mm.
HALF_DISTANCE, LEAST_SITES = 6.0, 3

# Share of the vertices of the bones that are its front, per cent.
FOREMOST = 10.0

# Kind ("skull" or "skin") and label.
SiteKey = tuple[str, str]


@dataclass(frozen=True, eq=False)
class SiteDistribution:
    """Where the landmarks of a head are expected, and how their errors depend on one another.

    names: Kind and label.
    mean: (n, 3), mm. The proposed points; of a missing site where the others place it.
    covariance: (3 n, 3 n), mm², of the errors of `mean`, by site and axis.
    """

    names: tuple[SiteKey, ...]
    mean: Floats
    covariance: Floats

    def given(
        self, points: Mapping[SiteKey, Floats], stds: Mapping[SiteKey, float] | None = None
    ) -> "SiteDistribution":
        """The distribution once some sites are known: the conditional mean and covariance.

        points: mapping of (kind, label) to (3,), mm.
        stds: mm. How far a point may be off along each axis; `PLACED_STD` for those that it lacks.
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

    proposal: Sites with their expected errors. If there are fewer than three, the pose is a guess
        from the extent of the bone, and uncertain.
    bone: (n, 3), mm. Vertices of the bones.

    Notes
    -----
    A normal distribution of shapes with smooth deviations (Lüthi, Gerig, Jud & Vetter 2018,
    Gaussian process morphable models), conditioned on the proposed sites.
    """
    sites = {
        **{("skull", name): site for name, site in proposal.skull.items()},
        **{("skin", name): site for name, site in proposal.skin.items()},
    }
    prior = _aligned_prior(sites, bone)
    known = [i for i, key in enumerate(SITES) if key in sites]
    if not known:
        return prior
    found = np.array([sites[SITES[i]].point for i in known])
    stds = np.array([sites[SITES[i]].error for i in known]) / np.sqrt(3.0)
    rows = (3 * np.array(known)[:, None] + np.arange(3)).ravel()
    away = (found - prior.mean[known]).ravel()
    shift, left = _conditional(prior.covariance, rows, away, _measured(found, known, stds))
    places = prior.mean + shift.reshape(-1, 3)
    places[known] = found
    return SiteDistribution(SITES, places, left)


def likeliest_places(sites: Mapping[SiteKey, ProposedSite]) -> dict[SiteKey, tuple[Floats, float]]:
    """Where each site is likeliest, as it was found and as the others place it, and its error, mm.

    What the errors of found sites have in common looks like shape, and stays: each one's own share
    of the variance is weighed.
    """
    own = float(np.sqrt((1.0 - ALIKE_SHARE) / 3.0))
    points = {key: site.point for key, site in sites.items()}
    stds = {key: own * site.error for key, site in sites.items()}
    prior = _aligned_prior(sites, np.array([*points.values()]).reshape(-1, 3))
    after = prior.given(points, stds)
    return dict(zip(SITES, zip(after.mean, after.errors.tolist(), strict=True), strict=True))


def left_out_gaps(sites: Mapping[SiteKey, ProposedSite]) -> dict[SiteKey, tuple[float, float]]:
    """How far each site lies from where all others place it: in mm, and in expected deviations.

    Notes
    -----
    Residuals of a normal distribution with one measurement left out after the other, from one
    inverse (Rasmussen & Williams 2006, Gaussian processes for machine learning, eq. 5.12).
    """
    known = [i for i, key in enumerate(SITES) if key in sites]
    found = np.array([sites[SITES[i]].point for i in known]).reshape(-1, 3)
    stds = np.array([sites[SITES[i]].error for i in known]) / np.sqrt(3.0)
    prior = _aligned_prior(sites, found)
    rows = (3 * np.array(known, dtype=np.intp)[:, None] + np.arange(3)).ravel()
    total = prior.covariance[np.ix_(rows, rows)] + _measured(found, known, stds)
    precision = np.linalg.inv(total)
    weighted = (precision @ (found - prior.mean[known]).ravel()).reshape(-1, 3)
    gaps = {}
    for k, i in enumerate(known):
        away = np.linalg.solve(precision[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], weighted[k])
        deviations = np.sqrt(max(float(away @ weighted[k]), 0.0) / 3.0)
        gaps[SITES[i]] = float(np.linalg.norm(away)), float(deviations)
    return gaps


def outliers(sites: Mapping[SiteKey, ProposedSite], limit: float) -> dict[SiteKey, float]:
    """How far off the sites are, mm, that all others place elsewhere: the worst leaves first.

    limit: The expected deviations from which a site leaves the others.
    """
    rest, found = dict(sites), dict[SiteKey, float]()
    while len(rest) > LEAST_SITES:
        gaps = left_out_gaps(rest)
        worst = max(gaps, key=lambda key: gaps[key][1])
        if gaps[worst][1] <= limit:
            break
        found[worst] = gaps[worst][0]
        del rest[worst]
    return found


def _aligned_prior(sites: Mapping[SiteKey, ProposedSite], bone: Floats) -> SiteDistribution:
    """The average head's sites brought onto those of a head, before any is a measurement."""
    known = [i for i, key in enumerate(SITES) if key in sites]
    mean, covariance = average_sites(), _spread()
    if len(known) < LEAST_SITES:
        return SiteDistribution(SITES, mean + _guessed_shift(mean, bone), covariance)
    found = np.array([sites[SITES[i]].point for i in known])
    errors = np.array([sites[SITES[i]].error for i in known])
    linear, offset, _ = robust_similarity(mean[known], found, 3.0 / errors**2, HALF_DISTANCE)
    turn = np.kron(np.eye(len(mean)), linear)
    return SiteDistribution(SITES, mean @ linear.T + offset, turn @ covariance @ turn.T)


def placed_distribution(points: Mapping[str, Floats]) -> SiteDistribution:
    """The distribution of the landmarks of a head of which a person placed three or more.

    Parameters
    ----------
    points : mapping of str to (3,) float64, mm
        Of the skull, by label.
    """
    error = PLACED_STD * float(np.sqrt(3.0))
    sites = {name: ProposedSite(place, error) for name, place in points.items()}
    return site_covariance(ProposedLandmarks(sites, {}), np.zeros((0, 3)))


@lru_cache(maxsize=1)
def average_sites() -> Floats:
    """The sites of the average head, (46, 3) mm."""
    return np.array([REFERENCE_PLACES[kind][name] for kind, name in SITES])


@lru_cache(maxsize=1)
def _spread() -> Floats:
    return prior_covariance(OWN_STD, 1.0)


def prior_covariance(own_std: float, share: float) -> Floats:
    """The covariance of an average head's sites before any is seen, (138, 138) mm².

    Parameters
    ----------
    own_std : float, mm
        What each site has on its own.
    share : float
        Of the standard deviations of the model of shape.
    """
    mean = average_sites()
    parts = np.array([site_part(*site) for site in SITES])
    follows = jaw_shares(mean, parts == "mandible", parts == "skin")
    on_skin = (parts == "skin").astype(np.float64)
    total = HEAD.sides_covariance(mean)
    for kernel, weight in ((JAW, follows), (TISSUE, on_skin)):
        total += np.repeat(np.repeat(np.outer(weight, weight), 3, axis=0), 3, axis=1) * (
            kernel.sides_covariance(mean)
        )
    partners = np.array([[_is_partner(a, b) for b in SITES] for a in SITES], dtype=np.float64)
    alike = (1.0 - HEAD.asymmetry**2) / (1.0 + HEAD.asymmetry**2)
    own = np.eye(total.shape[0]) + alike * np.kron(partners, np.diag(MIRROR))
    jaw = moved_with_jaw(mean, follows, np.zeros(N_JAW))[1].reshape(len(total), N_JAW)
    total = share**2 * total + own_std**2 * own + jaw @ jaw.T
    for motion, std in _motions(mean):
        total += std**2 * np.outer(motion, motion)
    return total


def _is_partner(a: SiteKey, b: SiteKey) -> bool:
    return a[0] == b[0] and a[1][:-2] == b[1][:-2] and {a[1][-2:], b[1][-2:]} == {"_L", "_R"}


def _guessed_shift(mean: Floats, bone: Floats) -> Floats:
    """What brings an average head to where the bone is foremost, in its middle, mm."""
    if not len(bone):
        return np.zeros(3)
    front = bone[bone[:, 1] <= np.percentile(bone[:, 1], FOREMOST)]
    ahead = mean[mean[:, 1] <= np.percentile(mean[:, 1], 50.0)]
    shift: Floats = front.mean(axis=0) - ahead.mean(axis=0)
    return shift


def _motions(mean: Floats) -> list[tuple[Floats, float]]:
    """The ways of all sites under a unit of each motion, (3 n,), and its standard deviation."""
    middle = mean.mean(axis=0)
    axes = np.eye(3)
    found = [(np.tile(axis, len(mean)), SHIFT_STD) for axis in axes]
    found += [(np.cross(axis, mean - middle).ravel(), TURN_STD) for axis in axes]
    found.append(((mean - middle).ravel(), SIZE_STD))
    return found


def _measured(found: Floats, known: list[int], stds: Floats) -> Floats:
    """The covariance of the errors of proposed sites, mm²: close ones on a part are alike."""
    parts = np.array([site_part(*SITES[i]) for i in known])
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
