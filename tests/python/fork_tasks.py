"""A solve in this process and then in forked ones, run by test_processes.py on its own.

Prints one JSON line: digests of what the parent and its children found, and the threads of a child.
"""

import hashlib
import json
import multiprocessing
import os
import sys
import warnings
from pathlib import Path

import numpy as np

import cmfsim
from benches.scenes import meshes

NODES, TETS = meshes.box((12, 10, 8), seed=3)
LEFT, RIGHT = (np.flatnonzero(NODES[:, 0] == x) for x in (NODES[:, 0].min(), NODES[:, 0].max()))
PLAN = {"bone": cmfsim.rigid_motion((0.0, 0.05, 0.02), 3.0, (1, 0, 0))}
OPENING = cmfsim.Surface(*meshes.icosphere(3, 0.3))


def everything() -> str:
    """A digest of what each parallel part of the core answers."""
    mesh = cmfsim.TetMesh(NODES, TETS)
    tissue = cmfsim.Tissue.isotropic(np.full(len(TETS), 0.01), 0.4)
    found = [mesh.boundary_triangles(), mesh.boundary_nodes(), mesh.quality().edge_ratio]
    boundary = cmfsim.Boundary(fixed=LEFT, joined={"bone": RIGHT})
    for element in ("p1", "anp"):
        tensors = cmfsim.MassTensors(mesh, tissue, element=element)
        found += [tensors.vertex, tensors.force(NODES), tensors.strain(NODES)]
    for method, kinematics in (("cholesky", "linear"), ("pcg", "linear"), ("pcg", "hyperelastic")):
        solver = cmfsim.StaticSolver(
            cmfsim.MassTensors(mesh, tissue), boundary, method, kinematics=kinematics
        )
        found.append(solver.solve(PLAN).displacements)
        if kinematics == "linear":
            found.append(solver.plan_operator()(PLAN))
    # `found` of the sphere that its parent made: its tree may be made here or there.
    found += [OPENING.winding_number(NODES), *OPENING.closest(NODES), mesh.surface().vertices]
    found.append(OPENING.transformed(PLAN["bone"]).vertices)
    found.append(cmfsim.SurfaceMotion(OPENING, OPENING.vertices * 1.1).displacement(NODES))
    found.append(cmfsim.MuscleFibres(OPENING).directions(NODES))
    warp = cmfsim.ThinPlateSpline(NODES[::40], 1.1 * NODES[::40])
    found += [warp(NODES), warp.folds(NODES).determinants, warp.landmark_folds().determinants]
    found.append(cmfsim.icp(NODES, OPENING, tolerance=0, max_iterations=2).matrix)
    balls = np.linalg.norm(np.indices((20, 20, 20)) - 10.0, axis=0)
    found.append(cmfsim.mesh_from_labels(balls < 7, (1, 1, 1), edge_length=3.0).nodes)
    digest = hashlib.sha256()
    for array in found:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def threads() -> int:
    """Threads of this process; 0 where the system does not list them."""
    tasks = Path("/proc/self/task")
    return len(list(tasks.iterdir())) if tasks.is_dir() else 0


def child(_: int) -> tuple[int, str, int]:
    return os.getpid(), everything(), threads()


def child_and_grandchild(_: int) -> tuple[int, str, int]:
    answer = child(0)
    read, write = os.pipe()
    if (pid := os.fork()) == 0:
        os.write(write, everything().encode())
        os._exit(0)
    os.waitpid(pid, 0)
    assert os.read(read, 100).decode() == answer[1]
    return answer


def main() -> None:
    # From Python 3.12 on: "this process is multi-threaded, use of fork() may lead to deadlocks".
    warnings.simplefilter("ignore", DeprecationWarning)
    parent = everything()
    context = multiprocessing.get_context("fork")
    with context.Pool(2) as pool:
        children = pool.map(child, range(4), chunksize=1)
    worker = context.Process(target=child_and_grandchild, args=(0,))
    worker.start()
    worker.join()
    again = everything()
    json.dump(
        {
            "parent": [parent, again],
            "children": sorted({digest for _, digest, _ in children}),
            "threads": max(count for _, _, count in children),
            "grandchild": worker.exitcode,
        },
        sys.stdout,
    )


if __name__ == "__main__":
    main()
