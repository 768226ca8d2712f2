"""A head as a model of shape: cranium, mandible and skin with all they vary by, and their sites.

It varies by smooth random deformations: a Gaussian process of low rank.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from cmfsim.registration.proposed.template_head import average_head
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import JAW_SITES, SKIN_LANDMARKS, SKULL_LANDMARKS
from cmfsim.values.surface_data import SurfaceData

MIRROR = np.array([-1.0, 1.0, 1.0])
# Eigenvalues below this share of the largest are rounding.
ROUNDING = 1e-7


@dataclass(frozen=True)
class Kernel:
    """A sum of Gaussian covariances of a displacement.

    Attributes
    ----------
    parts : tuple of (float, float), mm
        Length and standard deviation of each.
    asymmetry : float
        Standard deviation of what differs between the sides, as a share of what they have in
        common.
    modes : int
        How many functions, even and odd each, stand for it.
    """

    parts: tuple[tuple[float, float], ...]
    asymmetry: float
    modes: int

    def covariance(self, a: Floats, b: Floats) -> Floats:
        """Of one component of the displacement at points a and b, (n, k) mm²."""
        squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
        total: Floats = np.zeros_like(squares)
        part = np.empty_like(squares)
        for length, deviation in self.parts:
            np.exp(np.divide(squares, -(length**2), out=part), out=part)
            part *= deviation**2
            total += part
        return total

    def sides_covariance(self, points: Floats) -> Floats:
        """Of the displacements of points that are alike on both sides, (3 n, 3 n) mm².

        Across, what is odd about x = 0 is alike; what differs is the reverse, and smaller.
        """
        even, odd = _folded(self, points, points)
        share = self.asymmetry**2
        blocks = np.zeros((len(points), 3, len(points), 3))
        blocks[:, 0, :, 0] = odd + share * even
        blocks[:, 1, :, 1] = blocks[:, 2, :, 2] = even + share * odd
        return blocks.reshape(3 * len(points), -1)


@dataclass(frozen=True, eq=False)
class SmoothModes:
    """Modes of displacement over space (Lüthi et al. 2018), even and odd about x = 0.

    Attributes
    ----------
    kernel : Kernel
    places : (k, 3) float64, mm
        With x ≥ 0: the modes are the leading eigenvectors of the covariance among them.
    even, odd : (k, r) float64
        What covariances with the places are multiplied by.
    """

    kernel: Kernel
    places: Floats
    even: Floats
    odd: Floats

    @classmethod
    def of(cls, kernel: Kernel, places: Floats) -> "SmoothModes":
        """The modes of a kernel by the covariance among places (Nyström)."""
        halves = []
        for covariance in _folded(kernel, places, places):
            values, vectors = np.linalg.eigh(covariance)
            order = np.argsort(-values)[: kernel.modes]
            order = order[values[order] > ROUNDING * values.max()]
            halves.append(vectors[:, order] / np.sqrt(values[order]))
        return cls(kernel, places, halves[0], halves[1])

    def at(self, points: Floats) -> Floats:
        """The displacements at points by unit coefficients, (n, 3, modes) mm."""
        of_even, of_odd = _folded(self.kernel, points, self.places)
        even, odd = of_even @ self.even, of_odd @ self.odd
        blocks = []
        # Even: across odd, back and up even. What differs between the sides is the reverse.
        for across, along, share in ((odd, even, 1.0), (even, odd, self.kernel.asymmetry)):
            for axis, functions in ((0, across), (1, along), (2, along)):
                block = np.zeros((len(points), 3, functions.shape[1]))
                block[:, axis] = share * functions
                blocks.append(block)
        return np.concatenate(blocks, axis=2)


def _folded(kernel: Kernel, a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """The covariances of displacements that are even and odd about x = 0."""
    same, mirrored = kernel.covariance(a, b), kernel.covariance(a, b * MIRROR)
    return same + mirrored, same - mirrored


CRANIUM, MANDIBLE, SKIN = 0, 1, 2
# Sites of the model in the order of its rows: kind and label.
SITES = tuple(("skull", name) for name in SKULL_LANDMARKS) + tuple(
    ("skin", name) for name in SKIN_LANDMARKS
)
# What skulls of one size differ by: measures over the whole skull have standard deviations of 4 to
# 7 mm within a population, 3 to 5 mm of them beyond size, and those over 30 mm some 2 mm (Howells
# 1973, Farkas 1994). Sides differ by a third of that. Of two real heads, one makes these deviations
# the likeliest and the other 0.7 times as much (`benches/accuracy/placed_sites.py`).
HEAD = Kernel(((120.0, 3.5), (60.0, 2.2), (30.0, 1.0)), 0.35, 30)
# The mandible against the cranium: classes II and III, width, height of the rami.
JAW = Kernel(((70.0, 2.5), (35.0, 1.0)), 0.35, 8)
# The soft tissue over bone varies by 2 to 5 mm.
TISSUE = Kernel(((60.0, 2.5), (30.0, 1.5)), 0.25, 16)
# Axis through the condyles: y and z, mm.
HINGE = np.array([0.0, -13.0, -5.0])
# Points of the model are this far apart in the face and elsewhere, mm.
FACE_STEP, VAULT_STEP = 6.0, 12.0
# Places among which covariances are taken are this far apart, mm.
PLACE_STEP = 16.0


@dataclass(frozen=True, eq=False)
class HeadModel:
    """Points of an average head in its frame, and how they move by coefficients of variance 1.

    Attributes
    ----------
    points, normals : (n, 3) float64
        Of cranium, mandible and skin.
    parts : (n,) int
        CRANIUM, MANDIBLE or SKIN.
    areas : (n,) float64, mm²
        Of the surface about each point.
    jaw_share : (n,) float64
        How far each point follows the jaw: 0 or 1 on bone, between on skin.
    modes : (n, 3, r) float64, mm
    sites : (46, 3) float64, mm
    site_modes : (46, 3, r) float64, mm
    site_share : (46,) float64
    """

    points: Floats
    normals: Floats
    parts: NDArray[np.int64]
    areas: Floats
    jaw_share: Floats
    modes: Floats
    sites: Floats
    site_modes: Floats
    site_share: Floats

    @cached_property
    def mode_order(self) -> NDArray[np.int64]:
        """The modes, those that move most first."""
        size = np.einsum("n,nij,nij->j", self.areas, self.modes, self.modes)
        return np.argsort(-size)

    @cached_property
    def ordered_modes(self) -> NDArray[np.float32]:
        """The modes in their order, for derivatives, (n, 3, r) mm."""
        return self.modes[:, :, self.mode_order].astype(np.float32)

    def weight_of(self, rows: NDArray[np.int64]) -> Floats:
        """The area of points over the usual one of the face."""
        return np.minimum(self.areas[rows] / FACE_STEP**2, 9.0)

    @cached_property
    def coarse(self) -> "HeadModel":
        """The model with every third point."""
        few = slice(None, None, 3)
        return replace(
            self,
            points=self.points[few],
            normals=self.normals[few],
            parts=self.parts[few],
            areas=3.0 * self.areas[few],
            jaw_share=self.jaw_share[few],
            modes=np.ascontiguousarray(self.modes[few]),
        )

    @property
    def n_modes(self) -> int:
        """Coefficients of shape."""
        return int(self.modes.shape[2])


@lru_cache(maxsize=1)
def head_model() -> HeadModel:
    """The model about the average head that comes with the package."""
    head = average_head()
    if head.skin is None:
        raise AssertionError(head.name)
    surfaces = (head.bones["cranium"], head.bones["mandible"], head.skin)
    taken = [_thinned(surface) for surface in surfaces]
    points = np.concatenate([t[0] for t in taken])
    parts = np.repeat([CRANIUM, MANDIBLE, SKIN], [len(t[0]) for t in taken])
    sites = np.array(
        [(head.skull if kind == "skull" else head.skin_landmarks)[name] for kind, name in SITES]
    )
    site_parts = np.array(
        [
            SKIN if kind == "skin" else MANDIBLE if name.startswith(JAW_SITES) else CRANIUM
            for kind, name in SITES
        ]
    )
    everything, every_part = np.concatenate([points, sites]), np.concatenate([parts, site_parts])
    share = jaw_shares(everything, every_part == MANDIBLE, every_part == SKIN)
    modes = _modes(everything, every_part, share)
    n = len(points)
    return HeadModel(
        points,
        np.concatenate([t[1] for t in taken]),
        parts,
        np.concatenate([t[2] for t in taken]),
        share[:n],
        modes[:n],
        sites,
        modes[n:],
        share[n:],
    )


def _modes(points: Floats, parts: NDArray[np.int64], share: Floats) -> Floats:
    """All modes at points: of the head, of the jaw against it, of soft tissue."""
    whole = SmoothModes.of(HEAD, _places(points)).at(points)
    of_jaw = SmoothModes.of(JAW, _places(points[parts == MANDIBLE])).at(points)
    tissue = SmoothModes.of(TISSUE, _places(points[parts == SKIN])).at(points)
    of_jaw *= share[:, None, None]
    tissue *= (parts == SKIN)[:, None, None]
    return np.concatenate([whole, of_jaw, tissue], axis=2)


def _places(points: Floats) -> Floats:
    """Some of the points, folded to x ≥ 0, about `PLACE_STEP` apart."""
    folded = np.abs(points[:, :1]), points[:, 1:]
    half = np.concatenate(folded, axis=1)
    return half[_first_of_cells(half, PLACE_STEP)]


def _first_of_cells(points: Floats, step: float) -> NDArray[np.int64]:
    cells = np.floor(points / step).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.sort(first)


def _thinned(surface: SurfaceData) -> tuple[Floats, Floats, Floats]:
    """Vertices spread over a surface, denser in the face: points, unit normals, areas."""
    vertices, triangles = surface.vertices, surface.triangles.astype(np.int64)
    corners = vertices[triangles]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    areas = np.zeros(len(vertices))
    for k in range(3):
        np.add.at(normals, triangles[:, k], doubled)
        np.add.at(areas, triangles[:, k], np.linalg.norm(doubled, axis=1) / 6.0)
    units = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    face = (vertices[:, 1] < 0.0) & (vertices[:, 2] < 60.0)
    step = np.where(face, FACE_STEP, VAULT_STEP)[:, None]
    cells = np.column_stack([np.floor(vertices / step), units > 0.0, face])
    _, index, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    share = np.bincount(inverse.ravel(), weights=areas, minlength=len(index)).astype(np.float64)
    return vertices[index], units[index], share


def jaw_shares(points: Floats, on_jaw: NDArray[np.bool_], on_skin: NDArray[np.bool_]) -> Floats:
    """How far points follow the jaw: skin from the mouth's corners down, in front of the ears."""
    _, y, z = points.T
    skin = _step(z, -38.0, -54.0) * _step(y, 25.0, -15.0) * _step(z, -118.0, -88.0)
    share: Floats = np.where(on_skin, skin, on_jaw.astype(np.float64))
    return share


def _step(t: Floats, start: Floats | float, end: Floats | float) -> Floats:
    s = np.clip((t - start) / (np.asarray(end) - start), 0.0, 1.0)
    result: Floats = s * s * (3.0 - 2.0 * s)
    return result
