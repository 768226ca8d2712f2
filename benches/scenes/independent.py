"""Stiffness and forces of every element by scikit-fem and numpy, independent of cmfsim.

Only the mesh and the numbering of its mid-edge nodes come from cmfsim.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import skfem

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    import cmfsim

    Floats = NDArray[np.float64]
    Stress = Callable[[Floats, Any, Any], Floats]


def lame(young: Any, poisson: Any) -> tuple[Any, Any]:
    """λ and μ, MPa."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def space_of(
    mesh: cmfsim.TetMesh, element: str, tensors: cmfsim.MassTensors
) -> tuple[skfem.Basis, NDArray[np.int64]]:
    """scikit-fem's space on the mesh, and its unknown for each node and axis of ours."""
    kind = {"p1": skfem.ElementTetP1, "p2": skfem.ElementTetP2}[element]
    space = skfem.MeshTet(mesh.nodes.T.copy(), mesh.tets.T.astype(np.int64))
    basis = skfem.Basis(space, skfem.ElementVector(kind()), intorder=2)
    order = basis.nodal_dofs.T
    if element == "p2":
        edges = [tuple(edge) for edge in np.sort(space.edges.T, axis=1).tolist()]
        at = {edge: row for row, edge in enumerate(edges)}
        rows = [at[tuple(edge)] for edge in tensors.mid_edges.tolist()]
        order = np.concatenate([order, basis.edge_dofs.T[rows]])
    return basis, order


def stiffness(
    mesh: cmfsim.TetMesh, tensors: cmfsim.MassTensors, young: Floats, poisson: Floats
) -> sp.csr_matrix:
    """Stiffness of isotropic tissue in the element of `tensors`, N/mm, in our numbering.

    Parameters
    ----------
    young, poisson : (m,) float64
        One value per tet; tets of different Young's modulus share no nodal pressure.
    """
    first, second = lame(young, poisson)
    if tensors.element != "anp":
        basis, order = space_of(mesh, tensors.element, tensors)
        points = basis.dx.shape[1]
        constants = [np.repeat(v[:, None], points, axis=1) for v in (first, second)]
        matrix = skfem.asm(_elasticity, basis, first=constants[0], second=constants[1])
        flat = order.ravel()
        return sp.csr_matrix(matrix[flat][:, flat])
    # ½ Σ V 2μ ε:ε + ½ Σ w_a θ_a², θ_a the mean of tr ε round corner a (Bonet & Burton 1998).
    basis, order = space_of(mesh, "p1", tensors)
    points = basis.dx.shape[1]
    zero, shear = (np.repeat(v[:, None], points, axis=1) for v in (0 * first, second))
    flat = order.ravel()
    local = sp.csr_matrix(skfem.asm(_elasticity, basis, first=zero, second=shear)[flat][:, flat])
    x = mesh.nodes[mesh.tets]
    gradients = np.linalg.inv(np.concatenate([np.ones((len(x), 4, 1)), x], axis=2))[:, 1:]
    volumes = np.asarray(mesh.volumes)
    _, material = np.unique(young, return_inverse=True)
    corner = mesh.tets.astype(np.int64) + len(mesh.nodes) * material.ravel()[:, None]
    groups, group = np.unique(corner, return_inverse=True)
    rows = np.repeat(group.reshape(-1, 4), 12, axis=1).ravel()
    columns = np.tile(
        (3 * mesh.tets[:, :, None].astype(np.int64) + np.arange(3)).reshape(-1, 12), 4
    )
    values = np.tile((volumes[:, None, None] * gradients.swapaxes(1, 2)).reshape(-1, 12), 4).ravel()
    total = np.bincount(group.ravel(), np.repeat(volumes, 4), len(groups))
    weight = np.bincount(group.ravel(), np.repeat(0.25 * volumes * first, 4), len(groups))
    shape = (len(groups), 3 * len(mesh.nodes))
    mean = sp.diags(1.0 / total) @ sp.csr_matrix((values, (rows, columns.ravel())), shape=shape)
    return sp.csr_matrix(local + mean.T @ sp.diags(weight) @ mean)


@skfem.BilinearForm
def _elasticity(u: Any, v: Any, w: Any) -> Any:
    strain = 0.5 * (u.grad + np.swapaxes(u.grad, 0, 1))
    trace, other = np.einsum("ii...", u.grad), np.einsum("ii...", v.grad)
    return w.first * trace * other + 2 * w.second * np.einsum("ij...,ij...", strain, v.grad)


def neo_hookean_stress(f: Floats, first: Any, second: Any) -> Floats:
    """P of the stable neo-Hookean law (Smith et al. 2018, eq. 14) as it is printed."""
    lam, mu = first + 5 / 6 * second, 4 / 3 * second
    alpha = 1 + mu / lam - mu / (4 * lam)
    j = np.linalg.det(f)[..., None, None]
    size = np.einsum("...ij,...ij->...", f, f)[..., None, None]
    cofactor = j * np.linalg.inv(f).swapaxes(-1, -2)
    stress: Floats = mu * (1 - 1 / (size + 1)) * f + lam * (j - alpha) * cofactor
    return stress


def corotational_stress(f: Floats, first: Any, second: Any) -> Floats:
    """R (λ tr(S) + 2 μ S) with S = U − I, R U = F and R a rotation even where F inverts."""
    left, sizes, right = np.linalg.svd(f)
    mirrored = np.linalg.det(left @ right) < 0.0
    left[mirrored, :, 2] *= -1.0
    sizes[mirrored, 2] *= -1.0
    r = left @ right
    s = np.einsum("...ki,...k,...kj->...ij", right, sizes - 1.0, right)
    trace = np.einsum("...ii->...", s)[..., None, None]
    stress: Floats = r @ (first * trace * np.eye(3) + 2 * second * s)
    return stress


STRESSES: dict[str, Stress] = {
    "corotational": corotational_stress,
    "hyperelastic": neo_hookean_stress,
}


def internal_forces(
    mesh: cmfsim.TetMesh,
    tensors: cmfsim.MassTensors,
    u: Floats,
    stress: Stress,
    young: Any,
    poisson: Any,
) -> Floats:
    """Forces of a displacement field of linear or quadratic tets, N, in our numbering.

    Parameters
    ----------
    u : (n, 3) float64, mm
        On `tensors.nodes`.
    young, poisson : float or (m,) float64
    """
    basis, order = space_of(mesh, tensors.element, tensors)
    field = np.zeros(basis.N)
    field[order] = u
    constants = [np.asarray(v)[..., None, None, None] for v in lame(young, poisson)]

    @skfem.LinearForm
    def internal(v: Any, w: Any) -> Any:
        # Gradients are (component, axis, tet, point).
        f = np.moveaxis(w["u"].grad, (0, 1), (-2, -1)) + np.eye(3)
        p = np.moveaxis(stress(f, *constants), (-2, -1), (0, 1))
        return np.einsum("ij...,ij...", p, v.grad)

    forces: Floats = internal.assemble(basis, u=basis.interpolate(field))[order]
    return forces
