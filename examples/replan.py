"""Re-planning: one set-up, then the exact skin of every other plan by one small product.

Twelve solved columns per bone segment give the displacements for any rigid motion of the bones, as
long as contact does not change. Run it with `python examples/replan.py`.
"""

import time

import numpy as np

import cmfsim
from first_solve import block


def main() -> float:
    nodes, tets = block((16, 10, 8), (40.0, 25.0, 20.0))
    tensors = cmfsim.MassTensors(cmfsim.TetMesh(nodes, tets), cmfsim.Tissue.isotropic(0.003, 0.46))
    x, y, z = nodes.T
    boundary = cmfsim.Boundary(
        fixed=np.flatnonzero(z == 0.0),
        joined={
            "maxilla": np.flatnonzero((x == 40.0) & (y > 13.0) & (z > 0.0)),
            "mandible": np.flatnonzero((x == 40.0) & (y < 12.0) & (z > 0.0)),
        },
    )
    solver = cmfsim.StaticSolver(tensors, boundary, "cholesky")
    skin = np.flatnonzero(z == 20.0)

    started = time.perf_counter()
    operator = solver.plan_operator(skin)
    print(f"operator for {len(skin)} skin nodes  {1e3 * (time.perf_counter() - started):.1f} ms")

    largest = 0.0
    for advance in (1.0, 3.0, 5.0):
        plan = {
            "maxilla": cmfsim.rigid_motion((advance, 0, 0), 4 * advance, (0, 1, 0), (40, 20, 10)),
            "mandible": cmfsim.rigid_motion((-advance / 2, 0, 0)),
        }
        started = time.perf_counter()
        quick = operator(plan)
        seconds = time.perf_counter() - started
        difference = np.abs(quick - solver.solve(plan).displacements[skin]).max()
        largest = max(largest, float(difference))
        print(
            f"advance {advance} mm: {1e3 * seconds:.3f} ms, {difference:.1e} mm from a whole solve"
        )
    return largest


if __name__ == "__main__":
    main()
