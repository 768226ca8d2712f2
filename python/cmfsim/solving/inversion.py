"""Tets that a large deformation has turned inside out, and what to say of them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import MassTensors
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding


def least_volume_ratios(tensors: MassTensors, displacements: ArrayLike) -> Floats:
    """The smallest volume of each tet over that at rest, (m,): zero or less where it is inverted.

    det F, which is one number for a linear tet. In a quadratic one it varies: the least of its
    middle and its corners is taken, so that what inverts between these alone is not seen.
    displacements: (n, 3), mm, of every node of `tensors.nodes`: `Solution.all_displacements`.
    Raises `MeshError`: Displacements of another number of nodes, or not finite.
    """
    u = np.asarray(displacements, dtype=np.float64)
    ratios: Floats = 1.0 + tensors.volume_change(u)
    if len(tensors.mid_edges) == 0:
        return ratios
    tets = tensors.mesh.tets.astype(np.int64)
    rest = 6.0 * tensors.mesh.volumes
    # Of each corner the other three, in the order that keeps the tet's orientation: (m, 4, 3).
    all_others = tets[:, [(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)]]
    all_middles = _middles(tensors, tets[:, :, None], all_others)
    places = tensors.nodes
    for corner in range(4):
        here, others = tets[:, corner], all_others[:, corner]
        # The quadratic through both ends and the middle of an edge starts with this slope.
        slopes = -3.0 * u[here][:, None] + 4.0 * u[all_middles[:, corner]] - u[others]
        edges = places[others] - places[here][:, None] + slopes
        ratios = np.minimum(ratios, np.linalg.det(edges) / rest)
    return ratios


def _middles(
    tensors: MassTensors, starts: NDArray[np.int64], ends: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The nodes in the middle of the edges between corners."""
    n = tensors.mesh.n_nodes
    pairs = np.sort(tensors.mid_edges.astype(np.int64), axis=1)
    keys = pairs[:, 0] * n + pairs[:, 1]
    order = np.argsort(keys)
    asked = np.minimum(starts, ends) * n + np.maximum(starts, ends)
    found: NDArray[np.int64] = n + order[np.searchsorted(keys, asked, sorter=order)]
    return found


def inversion_finding(tensors: MassTensors, displacements: ArrayLike) -> tuple[int, Finding | None]:
    """The number of tets inverted at equilibrium, and a warning, "inverted-tets", if there are any.

    Linear kinematics has no use for it: its tets keep their strain however they turn, and a
    negative volume is an error of the linear model rather than of the solution. Arguments and
    errors are those of `least_volume_ratios`.
    """
    ratios = least_volume_ratios(tensors, displacements)
    count = int(np.count_nonzero(ratios <= 0.0))
    if count == 0:
        return 0, None
    worst = int(np.argmin(ratios))
    x, y, z = tensors.mesh.nodes[tensors.mesh.tets[worst]].mean(axis=0)
    return count, Finding(
        "inverted-tets",
        f"{count} of {len(ratios)} tets are inverted at equilibrium; the worst is tet {worst}, at "
        f"{ratios[worst]:.2g} of its volume",
        where=f"({x:.1f}, {y:.1f}, {z:.1f}) mm before the operation",
    )
