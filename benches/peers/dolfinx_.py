"""DOLFINx 0.5 (Debian) with PETSc: MUMPS, or conjugate gradients with GAMG and rigid modes.

The form is compiled to C on first use and then found in a cache in the home folder: that time is
"compile", outside the total. For GAMG, "factor" is the set-up of the hierarchy.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from case import Case, Clock, NotInstalled, Result

RESIDUAL = 1e-10
"""Relative residual at which conjugate gradients stop."""
OPTIONS: dict[str, dict[str, object]] = {
    "mumps": {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"},
    "gamg": {
        "ksp_type": "cg",
        "ksp_norm_type": "unpreconditioned",
        "ksp_rtol": RESIDUAL,
        "ksp_max_it": 5000,
        "pc_type": "gamg",
        "pc_gamg_threshold": 0.0,  # faster here than the default and than 0.02 and 0.05
        "mg_levels_ksp_type": "chebyshev",
        "mg_levels_pc_type": "jacobi",
        "mg_levels_esteig_ksp_type": "cg",
    },
}


def rigid_modes(nodes: np.ndarray) -> np.ndarray:
    """Orthonormal translations and rotations, (3n, 6), unknown 3*node + axis."""
    x = (nodes - nodes.mean(axis=0)) / np.ptp(nodes)
    modes = np.zeros((len(x), 3, 6))
    modes[:, :, :3] = np.eye(3)
    for axis in range(3):
        modes[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x)
    return np.linalg.qr(modes.reshape(-1, 6))[0]


def solve(case: Case, clock: Clock, method: str, threads: int, scratch: Path) -> Result:
    """`method` is a key of `OPTIONS`."""
    try:
        with clock("import"):
            import dolfinx
            import ufl
            from dolfinx import fem, mesh
            from dolfinx.fem import petsc
            from mpi4py import MPI
            from petsc4py import PETSc
    except ImportError as absent:
        raise NotInstalled("apt package python3-dolfinx") from absent

    with clock("set-up"):
        element = ufl.Mesh(ufl.VectorElement("Lagrange", "tetrahedron", 1))
        domain = mesh.create_mesh(MPI.COMM_SELF, case.tets.astype(np.int64), case.nodes, element)
        space = fem.VectorFunctionSpace(domain, ("Lagrange", 1))
        # DOLFINx renumbers: find the block of unknowns of each of our nodes through the cells
        geometry = domain.geometry.dofmap.array
        node_of_block = np.empty(case.n_nodes, np.int64)
        nodes = np.asarray(domain.geometry.input_global_indices)
        node_of_block[space.dofmap.list.array] = nodes[geometry]
        block = np.empty(case.n_nodes, np.int32)
        block[node_of_block] = np.arange(case.n_nodes)

        constants = fem.FunctionSpace(domain, ("DG", 0))
        lambda_, mu = fem.Function(constants), fem.Function(constants)
        original = np.asarray(domain.topology.original_cell_index)
        for function, values in zip((lambda_, mu), case.lame, strict=True):
            function.x.array[constants.dofmap.list.array] = values[original]
        u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
        strain, virtual = ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))
        integrand = lambda_ * ufl.div(u) * ufl.div(v) + 2 * mu * ufl.inner(strain, virtual)
        bound, given = block[case.prescribed], fem.Function(space)
        conditions = [fem.dirichletbc(given, np.sort(bound))]
    with clock("compile"):
        form = fem.form(integrand * ufl.dx)
    with clock("assembly"):
        matrix = petsc.assemble_matrix(form, conditions)
        matrix.assemble()
        solution, load = matrix.createVecs()
    with clock("factor"):
        options = PETSc.Options()
        for key, value in OPTIONS[method].items():
            options[key] = value
        if method == "mumps":
            options["mat_mumps_icntl_16"] = threads
        else:
            modes = []
            for mode in rigid_modes(case.nodes[node_of_block]).T:
                modes.append(solution.duplicate())
                modes[-1].array[:] = mode
            matrix.setNearNullSpace(PETSc.NullSpace().create(vectors=modes))
        solver = PETSc.KSP().create(MPI.COMM_SELF)
        solver.setFromOptions()
        solver.setOperators(matrix)
        solver.setUp()

    def displacements(motion: np.ndarray) -> np.ndarray:
        given.x.array.reshape(-1, 3)[bound] = case.prescribed_displacements(motion)
        load.set(0.0)
        petsc.apply_lifting(load, [form], [conditions])
        petsc.set_bc(load, conditions)
        solver.solve(load, solution)
        if solver.getConvergedReason() < 0:
            raise RuntimeError(f"PETSc gave up, reason {solver.getConvergedReason()}")
        return solution.array.reshape(-1, 3)[block]

    with clock("solve"):
        first = displacements(case.motion)
    notes = {"iterations": solver.getIterationNumber()}
    with clock("next plan"):
        second = displacements(case.next_motion)
    petsc_version = ".".join(map(str, PETSc.Sys.getVersion()))
    return Result(first, f"{dolfinx.__version__}, PETSc {petsc_version}", second, notes)
