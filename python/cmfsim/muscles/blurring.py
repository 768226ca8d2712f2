"""Shares of muscle that fade into fat, instead of changing from tet to tet."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import TetMesh
from cmfsim.errors import third_party
from cmfsim.values.checks import Floats
from cmfsim.values.tissue_data import TissueData

# Rounds are not repeated beyond: a blur this wide in edges would be of no muscle that is left.
MOST_ROUNDS = 64
# Number of parts of the tets whose directions are found concurrently.
HALVES = 2


class Blur:
    """Averages of values of tets over their neighbours, repeated until they are `width` wide.

    One round gives each node the mean of its tets, weighted by volume, and each tet the mean of its
    nodes. It keeps constants, bounds and Σ V p, is the same for every order of the tets, and does
    not cross the gap between lips, where nodes are separate. k rounds widen k times the variance of
    one, which is measured on the mesh where `weights`, (m,), the share of muscle, has any. The
    width, mm, is a standard deviation along each axis, rounded to a whole number of rounds.
    """

    def __init__(self, mesh: TetMesh, weights: Floats, width: float) -> None:
        sparse = third_party("scipy.sparse", "muscles are blurred", "imaging")
        corners = np.asarray(mesh.tets).astype(np.int32)
        each = np.ones(corners.size), corners.ravel(), np.arange(0, corners.size + 1, 4)
        # Sums over the corners of each tet; its transpose, over the tets of each node.
        self._corners = sparse.csr_matrix(each, shape=(len(corners), mesh.n_nodes))
        volumes = np.abs(mesh.volumes)
        self._volumes = volumes[:, None]
        self._of_nodes = np.maximum(self._corners.T @ self._volumes, np.finfo(float).tiny)
        centres = np.asarray(mesh.nodes)[corners].mean(axis=1)
        # Σ w (S |c|² − 2 c · S c + |c|²) / 3: how far a round spreads a tet's value along an axis.
        squares = np.einsum("ij,ij->i", centres, centres)
        mean = self._round(np.column_stack([centres, squares]))
        spread = mean[:, 3] - 2.0 * np.einsum("ij,ij->i", centres, mean[:, :3]) + squares
        share = weights * volumes
        self.round_width = float(np.sqrt(np.sum(share * spread) / (3.0 * np.sum(share))))
        self.rounds = min(round((width / self.round_width) ** 2), MOST_ROUNDS)

    def __call__(self, values: Floats) -> Floats:
        """The blurred values, (m, c) float64."""
        for _ in range(self.rounds):
            values = self._round(values)
        return values

    def _round(self, values: Floats) -> Floats:
        nodes = self._corners.T @ (self._volumes * values)
        nodes /= self._of_nodes
        tets: Floats = self._corners @ nodes
        tets /= 4.0
        return tets


def blurred(
    mesh: TetMesh, fraction: Floats, fibre: Floats, tissue: TissueData, width: float
) -> tuple[Floats, Floats, TissueData]:
    """The muscle fraction (m,), fibres (m, 3) and tissue of each tet, blurred by a width.

    Muscles are placed with an error of some millimetres: the expected share of muscle at a place is
    the share blurred by that error. Constants mix linearly in the shares, so they are blurred
    alike. The fibre is the principal direction of the blurred Σ p a aᵀ, zero without muscle.
    width: mm. Standard deviation of the blur along each axis; 0 for none.
    """
    if width == 0.0 or not fraction.any():
        return fraction, fibre, tissue
    blur = Blur(mesh, fraction, width)
    i, j = np.triu_indices(3)
    columns = [fraction[:, np.newaxis], fraction[:, np.newaxis] * fibre[:, i] * fibre[:, j]]
    found = blur(np.concatenate(columns, axis=1))
    fraction, fibre = found[:, 0], _principal(found[:, 1:], found[:, 0] > 0.0)
    if tissue.kind == "preset":
        made = TissueData("preset", preset=tissue.preset, fraction=fraction, fibre=fibre)
        return fraction, fibre, made
    if tissue.kind == "stiffness":
        stiffness = blur(tissue.arrays()["stiffness"].reshape(-1, 36)).reshape(-1, 6, 6)
        return fraction, fibre, TissueData("stiffness", stiffness=stiffness)
    names = ("young_along", "young_across", "poisson")
    constants = blur(np.column_stack([tissue.arrays()[name] for name in names]))
    # Fat has no direction; any unit vector serves.
    direction = np.where(fraction[:, np.newaxis] > 0.0, fibre, [1.0, 0.0, 0.0])
    arrays = dict(zip(names, constants.T, strict=True))
    return fraction, fibre, TissueData("transversely_isotropic", fibre=direction, **arrays)


def _principal(sums: Floats, is_muscle: NDArray[np.bool_]) -> Floats:
    """Unit vectors along which Σ p a aᵀ is largest, their largest component positive; else zero."""
    matrices = np.empty((int(is_muscle.sum()), 3, 3))
    i, j = np.triu_indices(3)
    matrices[:, i, j] = matrices[:, j, i] = sums[is_muscle]
    with ThreadPoolExecutor(HALVES) as pool:
        halves = pool.map(np.linalg.eigh, np.array_split(matrices, HALVES))
        vectors = np.concatenate([found[1][:, :, 2] for found in halves])
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, np.newaxis], axis=1)
    fibre = np.zeros((len(sums), 3))
    fibre[is_muscle] = vectors * np.where(largest < 0.0, -1.0, 1.0)
    return fibre
