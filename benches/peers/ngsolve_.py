"""NGSolve: P1 displacements, piecewise constant Lamé fields, its own sparse Cholesky."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from case import Case, Clock, NotInstalled, Result


def solve(case: Case, clock: Clock, method: str, threads: int, scratch: Path) -> Result:
    """`method` is the name of an NGSolve direct solver, "sparsecholesky"."""
    try:
        with clock("import"):
            import ngsolve as ng
            from netgen.meshing import Mesh
    except ImportError as absent:
        raise NotInstalled("pip package ngsolve") from absent
    ng.SetNumThreads(threads)
    with ng.TaskManager():
        with clock("set-up"):
            grid = Mesh(dim=3)
            grid.AddPoints(np.ascontiguousarray(case.nodes))
            grid.AddElements(dim=3, index=1, data=case.tets, base=0)
            mesh = ng.Mesh(grid)
            space = ng.VectorH1(mesh, order=1)
            constants = ng.L2(mesh, order=0)
            lambda_, mu = ng.GridFunction(constants), ng.GridFunction(constants)
            for function, values in zip((lambda_, mu), case.lame, strict=True):
                function.vec.FV().NumPy()[:] = values
            u, v = space.TnT()
            strain, virtual = ng.Sym(ng.Grad(u)), ng.Sym(ng.Grad(v))
            form = ng.BilinearForm(space, symmetric=True)
            form += (
                lambda_ * ng.Trace(strain) * ng.Trace(virtual)
                + 2 * mu * ng.InnerProduct(strain, virtual)
            ) * ng.dx
            # VectorH1 numbers all x components first, then y, then z
            bound = (case.prescribed + case.n_nodes * np.arange(3)[:, None]).ravel()
            free = ng.BitArray(space.ndof)
            free.Set()
            for dof in bound.tolist():
                free.Clear(dof)
            solution, load = ng.GridFunction(space), ng.GridFunction(space).vec.CreateVector()
        with clock("assembly"):
            form.Assemble()
        with clock("factor"):
            inverse = form.mat.Inverse(free, inverse=method)

        def displacements(motion: np.ndarray) -> np.ndarray:
            values = solution.vec.FV().NumPy()
            values[:] = 0.0
            values[bound] = case.prescribed_displacements(motion).T.ravel()
            load.data = -form.mat * solution.vec
            solution.vec.data += inverse * load
            return values.reshape(3, -1).T.copy()

        with clock("solve"):
            first = displacements(case.motion)
        with clock("next plan"):
            second = displacements(case.next_motion)
    return Result(first, ng.__version__, second)
