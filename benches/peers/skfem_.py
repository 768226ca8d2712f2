"""scikit-fem assembles; CHOLMOD (scikit-sparse) or MKL PARDISO (pypardiso) solves."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np

from case import Case, Clock, NotInstalled, Result

SPD = 2
"""PARDISO's matrix type "real, symmetric positive definite"."""


def cholmod(matrix: object) -> Callable[[np.ndarray], np.ndarray]:
    """Back-substitution with CHOLMOD's supernodal factor in its own choice of ordering."""
    from sksparse.cholmod import cholesky

    return cholesky(matrix.tocsc(), mode="supernodal", ordering_method="default")


def pardiso(matrix: object) -> Callable[[np.ndarray], np.ndarray]:
    """Back-substitution with PARDISO's Cholesky factor."""
    import scipy.sparse as sp
    from pypardiso import PyPardisoSolver

    upper = sp.triu(matrix, format="csr")
    upper.sort_indices()
    solver = PyPardisoSolver(mtype=SPD)
    solver.factorize(upper)
    return lambda b: solver.solve(upper, b).ravel()


FACTORS = {"cholmod": (cholmod, "scikit-sparse"), "pardiso": (pardiso, "pypardiso")}


def solve(case: Case, clock: Clock, method: str, threads: int, scratch: Path) -> Result:
    """`method` is "cholmod" or "pardiso"."""
    factorise, package = FACTORS[method]
    try:
        with clock("import"):
            import skfem
            from skfem.helpers import ddot, sym_grad, trace

            __import__({"cholmod": "sksparse.cholmod"}.get(method, package))
    except ImportError as absent:
        raise NotInstalled(f"pip packages scikit-fem {package}") from absent

    @skfem.BilinearForm
    def stiffness(u: object, v: object, w: object) -> np.ndarray:
        strain, virtual = sym_grad(u), sym_grad(v)
        return w.lambda_ * trace(strain) * trace(virtual) + 2 * w.mu * ddot(strain, virtual)

    with clock("set-up"):
        points, corners = case.nodes.T.copy(), case.tets.T.astype(np.int64, order="C")
        mesh = skfem.MeshTet(points, corners, sort_t=False)
        basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP1()), intorder=1)
        bound = basis.nodal_dofs[:, case.prescribed].T.ravel()
        free = np.setdiff1d(np.arange(basis.N), bound)
    with clock("assembly"):
        lambda_, mu = (
            skfem.element.DiscreteField(np.repeat(values[:, None], basis.X.shape[-1], axis=1))
            for values in case.lame
        )
        rows = stiffness.assemble(basis, lambda_=lambda_, mu=mu).tocsr()[free]
        matrix, coupling = rows[:, free], rows[:, bound]
    with clock("factor"):
        back_substitute = factorise(matrix)

    def displacements(motion: np.ndarray) -> np.ndarray:
        u = np.empty(basis.N)
        u[bound] = case.prescribed_displacements(motion).ravel()
        u[free] = back_substitute(-(coupling @ u[bound]))
        return u[basis.nodal_dofs.T]

    with clock("solve"):
        first = displacements(case.motion)
    with clock("next plan"):
        second = displacements(case.next_motion)
    return Result(first, f"{version('scikit-fem')} + {package} {version(package)}", second)
