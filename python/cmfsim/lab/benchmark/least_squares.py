"""The entry that learns: partial least squares from the planned motion to the motion of the skin.

It knows the patients of the training part with their true faces, and no mechanics.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import ThinPlateSpline
from cmfsim.errors import CaseInputError, third_party
from cmfsim.evaluation import SKIN_LANDMARKS
from cmfsim.lab.benchmark.patients import BenchmarkPatient
from cmfsim.values.checks import Floats

# Fewer patients than this teach nothing: one is left out at a time to choose the components.
LEAST_TRAINED = 4
MOST_COMPONENTS = 8
# Points of the skin that are compared from person to person: of the vertices within a distance of
# the face, mm, about one for each so many mm².
AROUND, AREA = 30.0, 30.0
# A vertex follows so many of these points; from one distance off them on it fades, and beyond the
# other it stays, mm.
NEAREST, FOLLOWS, FADED = 4, 6.0, 20.0
# The plan in numbers: the motions of these landmarks of the skull, by what may carry them.
BODY = ("mandible_body", "mandible")
FEATURES = {
    "supradentale": ("maxilla",), "supra_m2_L": ("maxilla",), "supra_m2_R": ("maxilla",),
    "infradentale": BODY, "sub_m2_L": BODY, "sub_m2_R": BODY, "pogonion": ("chin", *BODY),
    "menton": ("chin", *BODY),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class PartialLeastSquares:
    """A linear map by partial least squares (SIMPLS, de Jong 1993).

    mean_x, mean_y: (p,) and (q,).
    coefficients: (p, q).
    """

    mean_x: Floats
    mean_y: Floats
    coefficients: Floats

    @classmethod
    def fit(cls, x: Floats, y: Floats, components: int) -> "PartialLeastSquares":
        """The map that leads from the rows of x (n, p) to those of y (n, q).

        Columns are centred and not scaled. With as many components as x has rank it is that of
        ordinary least squares.
        """
        mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
        centred = x - mean_x
        covariance = centred.T @ (y - mean_y)
        least = np.finfo(np.float64).eps * float(np.abs(covariance).max(initial=0.0))
        weights, loads, basis = [], [], np.zeros((x.shape[1], 0))
        for _ in range(components):
            weight = np.linalg.svd(covariance, full_matrices=False)[0][:, 0]
            values = centred @ weight
            size = float(np.linalg.norm(values))
            if size <= least or float(np.abs(covariance).max()) <= least:
                break
            weight, values = weight / size, values / size
            load = centred.T @ values
            direction = load - basis @ (basis.T @ load)
            direction /= np.linalg.norm(direction)
            basis = np.column_stack([basis, direction])
            covariance = covariance - basis @ (basis.T @ covariance)
            weights.append(weight)
            loads.append((y - mean_y).T @ values)
        if not weights:
            return cls(mean_x, mean_y, np.zeros((x.shape[1], y.shape[1])))
        return cls(mean_x, mean_y, np.column_stack(weights) @ np.column_stack(loads).T)

    def __call__(self, x: Floats) -> Floats:
        """The image of each row of x, (n, q)."""
        return self.mean_y + (x - self.mean_x) @ self.coefficients


@dataclass(frozen=True, eq=False)
class LearnedFace:
    """The model learned from the training part.

    landmarks: (14, 3), mm, of the skin of the person whose points are compared.
    points: (k, 3), mm, on that skin.
    map: From the plan in numbers to the displacements of the points.
    components: Chosen within the training part, each patient left out once.
    """

    landmarks: Floats
    points: Floats
    map: PartialLeastSquares
    components: int

    def predict(self, patient: BenchmarkPatient) -> Floats:
        """The displacement of each vertex of a patient's skin, (v, 3) mm."""
        places = patient.skin[_partners(patient, self.landmarks, self.points)]
        moves = self.map(_features(patient)[None]).reshape(-1, 3)
        away, near = _tree(places).query(patient.skin, k=NEAREST)
        weights = 1.0 / np.maximum(away, 1e-3)
        weights /= weights.sum(axis=1, keepdims=True)
        share = np.clip((FADED - away[:, 0]) / (FADED - FOLLOWS), 0.0, 1.0)
        moved: Floats = share[:, None] * np.einsum("vk,vki->vi", weights, moves[near])
        return moved


def learn_face(patients: Sequence[BenchmarkPatient]) -> LearnedFace:
    """The training data of the patients of a part.

    Raises `CaseError`: Fewer than four patients; scipy is not installed.
    """
    if len(patients) < LEAST_TRAINED:
        raise CaseInputError(
            f"the training part has {len(patients)} patients with a truth: {LEAST_TRAINED} are "
            "needed to learn from"
        )
    first = patients[0]
    landmarks, skin = _landmarks(first), first.skin
    near = _tree(skin[first.regions["face"]]).query(skin)[0] < AROUND
    each = max(1, round(AREA * len(skin) / first.surface.area))
    points = skin[near][::each]
    x = np.array([_features(patient) for patient in patients])
    y = np.array([p.truth[_partners(p, landmarks, points)].ravel() for p in patients])
    components = _components(x, y)
    return LearnedFace(landmarks, points, PartialLeastSquares.fit(x, y, components), components)


def _components(x: Floats, y: Floats) -> int:
    """The number with the least error on patients who are left out one at a time."""
    most = min(MOST_COMPONENTS, len(x) - 2)
    errors = np.zeros(most)
    for out in range(len(x)):
        rest = np.arange(len(x)) != out
        for count in range(1, most + 1):
            found = PartialLeastSquares.fit(x[rest], y[rest], count)(x[out : out + 1])
            errors[count - 1] += float(((found - y[out]) ** 2).sum())
    return int(errors.argmin()) + 1


def _features(patient: BenchmarkPatient) -> Floats:
    """The plan in numbers, mm."""
    moves = []
    for name, segments in FEATURES.items():
        place = patient.skull_landmarks[name]
        matrix = patient.planned_motion(*segments)
        moves.append(matrix[:3, :3] @ place + matrix[:3, 3] - place)
    return np.concatenate(moves)


def _landmarks(patient: BenchmarkPatient) -> Floats:
    return np.array([patient.landmarks[name] for name in SKIN_LANDMARKS])


def _partners(patient: BenchmarkPatient, landmarks: Floats, points: Floats) -> NDArray[np.intp]:
    """The vertex of a patient's skin that answers to each point of another's."""
    spline = ThinPlateSpline(landmarks, _landmarks(patient))
    nearest: NDArray[np.intp] = _tree(patient.skin).query(spline(points))[1]
    return nearest


def _tree(points: Floats):  # type: ignore[no-untyped-def]
    spatial = third_party("scipy.spatial", "faces are learned", "study")
    return spatial.cKDTree(points)
