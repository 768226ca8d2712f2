"""Where a head lies, how its jaw stands and what shape it has, and how points move with that."""

from dataclasses import dataclass

import numpy as np

from cmfsim.registration.proposed.shape_model.model import HINGE, HeadModel
from cmfsim.values.checks import Floats

# Standard deviations of the jaw: opening, lean and turn, rad, and shift across, back and up, mm. A
# condyle slides forwards by some 10 mm as the mouth opens by 25°.
JAW_DEVIATIONS = np.array([0.20, 0.04, 0.04, 1.5, 5.0, 3.0])
N_POSE, N_JAW = 7, 6
# Scale and turns act over some 80 mm: in those units all seven steps of a pose are lengths.
POSE_UNITS = np.array([80.0, 80.0, 80.0, 80.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class State:
    """A head of the model: its points are linear · (patient) + offset.

    linear: (3, 3), from the patient's frame to the model's: a rotation times a scale.
    offset: (3,), mm.
    jaw: (6,). Rigid motion of the mandible, in standard deviations.
    shape: (r,). Coefficients of the modes, in standard deviations.
    """

    linear: Floats
    offset: Floats
    jaw: Floats
    shape: Floats

    @property
    def scale(self) -> float:
        """Size of the model over that of the patient."""
        return float(np.cbrt(np.linalg.det(self.linear)))

    def into(self, points: Floats) -> Floats:
        """Points of the patient in the model's frame and size."""
        moved: Floats = points @ self.linear.T + self.offset
        return moved

    def out(self, points: Floats) -> Floats:
        """Points of the model in the patient's frame."""
        moved = np.linalg.solve(self.linear, (points - self.offset).T).T
        return np.ascontiguousarray(moved, dtype=np.float64)

    def points(self, model: HeadModel) -> Floats:
        """The points of the model with this shape and jaw, in its own frame."""
        own = model.points + model.modes @ self.shape
        return moved_with_jaw(own, model.jaw_share, self.jaw)[0]

    def sites(self, model: HeadModel) -> tuple[Floats, Floats]:
        """The sites in the model's frame, (46, 3), and their derivatives by all coefficients.

        Of jaw and shape, (46, 3, 6 + r).
        """
        own = model.sites + model.site_modes @ self.shape
        moved, by_jaw = moved_with_jaw(own, model.site_share, self.jaw)
        return moved, np.concatenate([by_jaw, model.site_modes], axis=2)

    def normals(self, model: HeadModel) -> Floats:
        """The normals of the model turned with the jaw."""
        turned = model.normals @ jaw_rotation(self.jaw).T
        mixed = model.normals + model.jaw_share[:, None] * (turned - model.normals)
        units: Floats = mixed / np.linalg.norm(mixed, axis=1)[:, None]
        return units


def jaw_rotation(jaw: Floats) -> Floats:
    """The rotation of the jaw by its coefficients."""
    return rotation_of((jaw * JAW_DEVIATIONS)[:3])


def moved_with_jaw(points: Floats, share: Floats, jaw: Floats) -> tuple[Floats, Floats]:
    """Points moved with the jaw, (n, 3), and their derivatives by its coefficients, (n, 3, 6).

    points: (n, 3), mm.
    share: (n,). How far each follows.
    jaw: (6,).
    """
    about = points - HINGE
    turned = about @ jaw_rotation(jaw).T
    shift = (jaw * JAW_DEVIATIONS)[3:]
    moved = points + share[:, None] * (turned + shift - about)
    columns = np.zeros((len(points), 3, N_JAW))
    for k in range(3):
        axis = np.zeros(3)
        axis[k] = 1.0
        columns[:, :, k] = np.cross(axis, turned)
        columns[:, k, 3 + k] = 1.0
    return moved, columns * share[:, None, None] * JAW_DEVIATIONS


def rotation_of(vector: Floats) -> Floats:
    """The rotation by a vector of its axis and angle (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Floats = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return rotation


def similarity_step(step: Floats) -> tuple[Floats, Floats]:
    """The linear part and the shift of a small similarity: log scale, turns, shifts."""
    return np.exp(np.clip(step[0], -0.2, 0.2)) * rotation_of(step[1:4]), step[4:]
