"""The model fitted to a head: pose, jaw, all sites with a covariance, and how well it fits."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cmfsim.errors import LandmarkInputError
from cmfsim.registration.closest import robust_similarity
from cmfsim.registration.proposed.pose import Pose
from cmfsim.registration.proposed.shape_model.fitting import (
    MOST_GAP,
    SEEN_MARGIN,
    Evidence,
    Known,
    refined,
)
from cmfsim.registration.proposed.shape_model.model import (
    CRANIUM,
    HINGE,
    MANDIBLE,
    SITES,
    SKIN,
    HeadModel,
    head_model,
)
from cmfsim.registration.proposed.shape_model.samples import HeadSamples
from cmfsim.registration.proposed.shape_model.search import STAGES, Start, found_poses
from cmfsim.registration.proposed.shape_model.state import (
    JAW_DEVIATIONS,
    POSE_UNITS,
    State,
    jaw_rotation,
    rotation_of,
)
from cmfsim.values.checks import Floats

# Rounds in the first place, of all rough poses, and of the best: noise in mm and modes.
FIRST = ((8.0, 0), (6.0, 0), (5.0, 20), (4.0, 20))
OPENED = ((5.0, 20), (4.0, 40), (3.0, 40), (3.0, 80))
LATER = ((2.5, 80), (2.0, 80), (2.0, 160), (1.5, 160), (1.5, 400), (1.0, 400))
LAST = ((1.0, 400), (0.7, 400))
OPENINGS = tuple(np.radians((0.0, 8.0, 16.0, 25.0)))
# A jaw that is fitted as turned by less is closed, radians: the fit is good to some 3°.
OPEN = np.radians(6.0)
COARSE_POINTS = 1200
# Number of starts and openings that are tried concurrently.
TRIED_AT_ONCE = 2
AGAIN = ((1.0, 400), (0.7, 400))
# A point of the model fits where the patient's surface is nearer than this, mm of the average head.
FITS = 4.0
# Share of the visible face that must fit: heads have 0.7 to 0.8, a crude
# one of a few ellipsoids 0.54, balls and tubes 0.4.
LEAST_FIT, FACE_BACK, FACE_TOP = 0.48, 0.0, 60.0
# Of a head that lies otherwise up to 0.47 fits, and 0.79 once the search has turned it by 50 to 90
# degrees into a pose beside the right one: below this fit, or beyond this turn, it is compared with
# such heads.
SURE_FIT, SURE_TURN = 0.6, np.radians(50.0)
# Heads have 0.58 to 0.94 before shape takes part in detail, balls and tubes 0.25 at most: below
# this, nothing is refined. How many ways to lie are compared with more than a first look.
HOPELESS_FIT, LIKELY_WAYS = 0.32, 3
QUARTER = 0.5 * np.pi
# A part of the face and the skull's base that the head's own frame is taken from, mm: back, up.
FRAME_BACK, FRAME_TOP, FRAME_DISTANCE, FRAME_ROUNDS = 20.0, 70.0, 4.0, 10
# Surfaces say little of where along them a site lies: relief finer than the modes, mm.
ALONG_SURFACE = 4.5
# Pairs of the cranium whose distances tell how broad a head is.
BROAD_PAIRS = ("zygomatic_arch", "supraglenoid", "lateral_orbit")
# How a head may lie in an image whose axes are wrong, with what brings it upright. One axis that is
# reversed looks like two, because a head is its own mirror image.
AXES = np.eye(3)
LYING = {
    "upside down": AXES * [-1.0, 1.0, -1.0],
    "with its face to the back": AXES * [-1.0, -1.0, 1.0],
    "upside down and with its face to the back": AXES * [1.0, -1.0, -1.0],
    "with its face to the left": rotation_of(-QUARTER * AXES[2]),
    "with its face to the right": rotation_of(QUARTER * AXES[2]),
    "with its vertex to the left": rotation_of(-QUARTER * AXES[1]),
    "with its vertex to the right": rotation_of(QUARTER * AXES[1]),
    "with its vertex to the front": rotation_of(-QUARTER * AXES[0]),
    "with its vertex to the back": rotation_of(QUARTER * AXES[0]),
}


@dataclass(frozen=True, eq=False)
class FittedHead:
    """The model in the shape and pose of a patient.

    Attributes
    ----------
    model : HeadModel
    samples : HeadSamples
    evidence : Evidence
    known : mapping
        Sites that were given.
    """

    model: HeadModel
    samples: HeadSamples
    evidence: Evidence
    known: Known

    @property
    def state(self) -> State:
        """Pose, jaw and shape."""
        return self.evidence.state

    @cached_property
    def points(self) -> Floats:
        """The model's points in the patient's frame, (n, 3) mm."""
        return self.state.out(self.state.points(self.model))

    @cached_property
    def sites(self) -> Mapping[tuple[str, str], Floats]:
        """All 46 sites in the patient's frame, by kind and label, seen or not."""
        places = self.state.out(self.state.sites(self.model)[0])
        return dict(zip(SITES, places, strict=True))

    @cached_property
    def covariance(self) -> Floats:
        """Of all coordinates of the sites in the patient's frame, (138, 138) mm².

        That of the process after the fit, with what surfaces do not say along themselves.
        """
        places, derivatives = self.state.sites(self.model)
        taken = np.concatenate([np.arange(6), 6 + self.evidence.modes])
        # A step of the pose moves the patient: seen from there the model moves back.
        turn = np.array([[[0, z, -y], [-z, 0, x], [y, -x, 0]] for x, y, z in places])
        pose = np.concatenate(
            [places[:, :, None], turn, np.tile(np.eye(3), (len(places), 1, 1))], axis=2
        )
        columns = np.concatenate([-pose / POSE_UNITS, derivatives[:, :, taken]], axis=2)
        columns = np.linalg.solve(self.state.linear, columns)
        flat = columns.reshape(-1, columns.shape[2])
        covariance: Floats = flat @ np.linalg.solve(self.evidence.precision, flat.T)
        along = (ALONG_SURFACE / self.state.scale) ** 2
        for row in range(len(places)):
            own = slice(3 * row, 3 * row + 3)
            if row not in self.known:
                covariance[own, own] += along / 2.0 * np.eye(3)
        return covariance

    @cached_property
    def errors(self) -> Mapping[tuple[str, str], float]:
        """Expected distance of each site from the true one, mm."""
        variances = np.maximum(np.diag(self.covariance), 0.0).reshape(-1, 3).sum(axis=1)
        return dict(zip(SITES, np.sqrt(variances).tolist(), strict=True))

    @cached_property
    def breadth(self) -> float:
        """Of the fitted cranium, as a factor on the average head, sizes included."""
        ratios = []
        for pair in BROAD_PAIRS:
            rows = [SITES.index(("skull", f"{pair}_{letter}")) for letter in "LR"]
            own = [self.sites["skull", f"{pair}_{letter}"] for letter in "LR"]
            usual = self.model.sites[rows]
            ratios.append(np.linalg.norm(own[0] - own[1]) / np.linalg.norm(usual[0] - usual[1]))
        return float(np.mean(ratios))

    def deviation(self, sites: Sequence[tuple[str, str]], direction: Floats) -> float:
        """Standard deviation of the mean of some sites along a unit vector, mm."""
        weights = np.zeros((len(SITES), 3))
        weights[[SITES.index(site) for site in sites]] = direction / len(sites)
        return float(np.sqrt(weights.ravel() @ self.covariance @ weights.ravel()))

    def shows(self, point: Floats) -> bool:
        """Whether the image shows a place of the patient's frame."""
        return bool(self.samples.shows(point[None], SEEN_MARGIN)[0])

    @cached_property
    def fits(self) -> float:
        """Share of the visible face and jaw, by area, where the patient's bone lies near them.

        Within 4 mm in the model's size, and looking the same way.
        """
        own = self.model.points
        face = (self.model.parts != SKIN) & (own[:, 1] < FACE_BACK) & (own[:, 2] < FACE_TOP)
        face &= self.evidence.seen
        near = self.evidence.gaps[face] < FITS
        areas = self.model.areas[face]
        return float(areas[near].sum() / areas.sum()) if face.any() else 0.0

    @cached_property
    def gap(self) -> float:
        """Mean distance of the visible model from the patient's surfaces, capped, patient's mm."""
        seen = self.evidence.seen
        if not seen.any():
            return np.inf
        gaps = np.minimum(self.evidence.gaps[seen], MOST_GAP)
        return float(np.average(gaps, weights=self.model.areas[seen])) / self.state.scale

    @cached_property
    def pose(self) -> Pose:
        """The frame of the average head by the fitted face and base of the skull."""
        own = self.model.points
        used = (self.model.parts == CRANIUM) & (own[:, 1] < FRAME_BACK) & (own[:, 2] < FRAME_TOP)
        still = State(self.state.linear, self.state.offset, np.zeros(6), self.state.shape)
        fitted = still.out(still.points(self.model))[used]
        goal, area = own[used], self.model.areas[used]
        linear, offset, scale = robust_similarity(fitted, goal, area, FRAME_DISTANCE, FRAME_ROUNDS)
        origin: Floats = -np.linalg.solve(linear, offset).astype(np.float64)
        return Pose(origin, linear / scale, 1.0 / scale, self.gap)

    @property
    def turn(self) -> float:
        """The angle by which the patient is turned against an upright head, radians."""
        cosine = 0.5 * (np.trace(self.state.linear) / self.state.scale - 1.0)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))

    @property
    def jaw(self) -> Floats:
        """The motion that opens the average head's jaw as the patient's is, (4, 4), mm.

        The identity where the mouth may as well be closed.
        """
        motion = np.eye(4)
        turn = jaw_rotation(self.state.jaw)
        if np.trace(turn) < 1.0 + 2.0 * np.cos(OPEN):
            shift = (self.state.jaw * JAW_DEVIATIONS)[3:]
            motion[:3, :3], motion[:3, 3] = turn, HINGE + shift - turn @ HINGE
        return motion

    def conditioned(self, points: Mapping[tuple[str, str], Floats], error: float) -> "FittedHead":
        """The fit with some sites known: they are kept, and the others follow.

        Parameters
        ----------
        points : mapping of (kind, label) to (3,) float64, mm
            In the patient's frame.
        error : float, mm
            Of each.
        """
        rows = {site: row for row, site in enumerate(SITES)}
        known = {rows[site]: (place, error) for site, place in points.items()}
        evidence = refined(self.model, self.samples, self.state, AGAIN, known)
        return FittedHead(self.model, self.samples, evidence, known)


def fit_head(samples: HeadSamples) -> FittedHead:
    """The model fitted to a head of any pose within about 40°, from several starts.

    Raises
    ------
    LandmarkError
        (also `ValueError`) Nothing like a head, or one that lies otherwise.
    """
    model = head_model()
    coarse, few = model.coarse, samples.fewer(COARSE_POINTS)
    best = _best(model, samples, found_poses(coarse, few))
    if best.fits >= SURE_FIT and best.turn <= SURE_TURN:
        return best
    rough = {how: found_poses(coarse, few, way, STAGES[:1])[0].score for how, way in LYING.items()}
    likely = sorted(LYING, key=lambda name: rough[name])[:LIKELY_WAYS]
    starts = {how: found_poses(coarse, few, LYING[how]) for how in likely}
    how = min(likely, key=lambda name: starts[name][0].score)
    other = _best(model, samples, starts[how])
    if other.fits >= max(LEAST_FIT, best.fits):
        raise LandmarkInputError(
            f"the head lies {how} in LPS coordinates, so left and right cannot be trusted "
            "either: export the image again with its orientation, or correct the axes"
        )
    if best.fits >= LEAST_FIT:
        return best
    raise LandmarkInputError(
        f"{100.0 * best.fits:.0f} % of an average face lie within {FITS:g} mm of these bones "
        f"in the best pose ({100.0 * LEAST_FIT:.0f} % needed): they are not a head, or show "
        "too little of one; place the landmarks by hand"
    )


def _best(model: HeadModel, samples: HeadSamples, starts: Sequence[Start]) -> FittedHead:
    """The best fit of some starts; that of few points and shapes, if it is one of no head."""
    coarse, few = model.coarse, samples.fewer(COARSE_POINTS)

    def first(start: Start) -> Evidence:
        return refined(coarse, few, start.state(coarse), FIRST, still_jaw=True)

    def opened(angle: float) -> Evidence:
        return refined(coarse, few, _opened(best.state, angle), OPENED, still_jaw=True)

    with ThreadPoolExecutor(TRIED_AT_ONCE) as pool:
        best = min(pool.map(first, starts), key=lambda evidence: evidence.score)
        # A closed jaw lies too far from an open one for its pairs.
        best = min(pool.map(opened, OPENINGS), key=lambda evidence: _jaw_gap(coarse, evidence))
    rough = FittedHead(coarse, few, best, {})
    if rough.fits < HOPELESS_FIT:
        return rough
    evidence = refined(coarse, few, best.state, LATER)
    return FittedHead(model, samples, refined(model, samples, evidence.state, LAST), {})


def _jaw_gap(model: HeadModel, evidence: Evidence) -> float:
    """How far the mandible lies from the patient's surfaces, patient's mm.

    What would lie outside the image counts half of the largest distance: a chin does not get there
    for free.
    """
    jaw = model.parts == MANDIBLE
    gaps = np.where(evidence.seen, np.minimum(evidence.gaps, MOST_GAP), 0.5 * MOST_GAP)[jaw]
    return float(gaps.mean()) / evidence.state.scale


def _opened(state: State, angle: float) -> State:
    jaw = np.array([angle / JAW_DEVIATIONS[0], 0.0, 0.0, 0.0, 0.0, 0.0])
    return State(state.linear, state.offset, jaw, np.zeros_like(state.shape))
