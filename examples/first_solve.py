"""A first solve: a block of soft tissue between two bones, joined to one and sliding on the other.

The upper bone moves 2 mm forwards and rotates by 5°; the lower one, with a flat contact surface,
does not move. Run it with `python examples/first_solve.py`.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

import cmfsim


def block(
    cells: tuple[int, int, int], size: tuple[float, float, float]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nodes (mm) and tets of a box, each cell cut into six."""
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1)
    nodes = grid.reshape(-1, 3) * np.array(size) / np.array(cells)
    step = np.array([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    corner = (grid[:-1, :-1, :-1].reshape(-1, 3) @ step)[:, None]
    tets = []
    for order in itertools.permutations(range(3)):
        path = np.cumsum([0, *step[list(order)]])
        odd = np.linalg.det(np.eye(3)[list(order)]) < 0
        tets.append(corner + (path[[0, 2, 1, 3]] if odd else path))
    return nodes, np.concatenate(tets)


def main() -> cmfsim.Solution:
    nodes, tets = block((12, 8, 8), (30.0, 20.0, 15.0))
    mesh = cmfsim.TetMesh(nodes, tets)

    # Fat, with a band of muscle along x in the middle.
    middle = nodes[tets].mean(axis=1)
    fraction = np.where(np.abs(middle[:, 2] - 7.5) < 3.0, 0.8, 0.0)
    tissue = cmfsim.Tissue.preset("kim2010", fraction, np.tile([1.0, 0.0, 0.0], (len(tets), 1)))
    tensors = cmfsim.MassTensors(mesh, tissue)

    # Upwards out of the lower bone, wide enough for every place that a node may slide to.
    corners = [[-20, -20, 0], [50, -20, 0], [50, 40, 0], [-20, 40, 0]]
    lower = cmfsim.Surface(np.array(corners, dtype=float), [[0, 1, 2], [0, 2, 3]])
    x, z = nodes[:, 0], nodes[:, 2]
    boundary = cmfsim.Boundary(
        fixed=np.flatnonzero(x == 0.0),
        joined={"maxilla": np.flatnonzero((z == 15.0) & (x > 0.0))},
        sliding={"mandible": np.flatnonzero((z == 0.0) & (x > 0.0))},
        contact={"mandible": lower},
    )
    solver = cmfsim.StaticSolver(tensors, boundary)
    result = solver.solve(
        {
            "maxilla": cmfsim.rigid_motion((2, 0, 0), angle=5, axis=(0, 1, 0), centre=(0, 10, 15)),
            "mandible": np.eye(4),
        }
    )

    size = np.linalg.norm(result.displacements, axis=1)
    print(f"{mesh.n_tets} tets, {solver.n_unknowns} unknowns, method {solver.method}")
    print(f"largest displacement    {size.max():.3f} mm")
    print(f"residual                {result.residual:.1e}")
    print(f"largest contact gap     {result.contact_gap:.1e} mm")
    print(f"force on the mandible   {result.contact_forces.sum():.4f} N")
    print(f"seconds                 {sum(result.timings.values()):.3f}")
    return result


if __name__ == "__main__":
    main()
