"""Cost and error of elements and kinematics: error on the outer surface against run time.

    python -m benches.stability.elements [--level 2] [--layers 3] [--json FILE]
        [--markdown docs/benchmarks.md]

A shell of soft tissue (12 mm over a bone of 40 mm) is fixed over one half of the bone and joined to
a segment over the other half, which advances by 5 mm and rotates by 8°. It is solved with every
element and kinematics. The reference is hyperelastic on quadratic tets of half the edge length. The
error is the distance of the nodes on the outer surface from the reference, which has every node of
the coarse mesh. The time is the processor seconds of set-up and solve, the best of three, relative
to linear tets in linear kinematics.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import cmfsim
from benches.scenes import meshes
from benches.scenes.marked import replace_marked

BONE, SKIN = 40.0, 52.0  # radii, mm
YOUNG, POISSON = 0.003, 0.46  # fat (Kim et al. 2010, table 1)
SHIFT, TURN = (0.0, -5.0, 0.0), 8.0  # mm, degrees
REPEATS = 3

Floats = NDArray[np.float64]


def shell(level: int, layers: int) -> tuple[cmfsim.TetMesh, cmfsim.Boundary, NDArray[np.uint32]]:
    """Mesh, boundary and the nodes on the outer surface."""
    nodes, tets, inner, outer = meshes.spherical_shell(level, layers, BONE, SKIN)
    front = nodes[inner, 1] < -0.1 * BONE
    boundary = cmfsim.Boundary(fixed=inner[~front], joined={"jaw": inner[front]})
    return cmfsim.TetMesh(nodes, tets), boundary, outer


def solved(
    mesh: cmfsim.TetMesh, boundary: cmfsim.Boundary, element: str, kinematics: str, poisson: float
) -> cmfsim.Solution:
    """The displacements under the plan of the bench."""
    tissue = cmfsim.Tissue.isotropic(YOUNG, poisson)
    tensors = cmfsim.MassTensors(mesh, tissue, element=element)
    solver = cmfsim.StaticSolver(tensors, boundary, "cholesky", kinematics=kinematics)
    return solver.solve({"jaw": cmfsim.rigid_motion(SHIFT, TURN, (1, 0, 0))})


def reference(level: int, layers: int, outer: Floats, poisson: float) -> Floats:
    """Displacements of the points `outer` by hyperelastic quadratic tets of half the edge."""
    mesh, boundary, _ = shell(level + 1, 2 * layers)
    solution = solved(mesh, boundary, "p2", "hyperelastic", poisson)
    distance, at = cKDTree(mesh.nodes).query(outer)
    if np.max(distance) > 1e-9:
        raise SystemExit("the fine mesh lacks nodes of the coarse one")
    return solution.displacements[at]


def rows(
    level: int, layers: int, poisson: float, *, quiet: bool = True
) -> list[dict[str, float | str | int]]:
    """Error and time of each choice; a line of progress for each unless `quiet`."""
    mesh, boundary, outer = shell(level, layers)
    exact = reference(level, layers, mesh.nodes[outer], poisson)
    out: list[dict[str, float | str | int]] = []
    for element in cmfsim.ELEMENTS:
        for kinematics in cmfsim.KINEMATICS:
            seconds = []
            for _ in range(REPEATS):
                begun = time.process_time()
                solution = solved(mesh, boundary, element, kinematics, poisson)
                seconds.append(time.process_time() - begun)
            error = np.linalg.norm(solution.displacements[outer] - exact, axis=1)
            if not quiet:
                said = f"{poisson} {element} {kinematics} {min(seconds):.2f} s"
                print(said, file=sys.stderr, flush=True)
            out.append(
                {
                    "poisson": poisson,
                    "element": element,
                    "kinematics": kinematics,
                    "n_tets": mesh.n_tets,
                    "mean": float(error.mean()),
                    "p95": float(np.percentile(error, 95)),
                    "largest": float(error.max()),
                    "seconds": min(seconds),
                    "iterations": solution.iterations,
                }
            )
    return out


def table(found: list[dict[str, float | str | int]]) -> str:
    """The rows as Markdown, with the times over those of linear tets in linear kinematics."""
    lines = [
        "| ν | element | kinematics | mean, mm | P95, mm | largest, mm | time |",
        "|---:|---|---|---:|---:|---:|---:|",
    ]
    for row in found:
        first = next(r for r in found if r["poisson"] == row["poisson"])
        ratio = float(row["seconds"]) / float(first["seconds"])
        lines.append(
            f"| {row['poisson']} | {row['element']} | {row['kinematics']} | {row['mean']:.3f} | "
            f"{row['p95']:.3f} | {row['largest']:.3f} | {ratio:.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Prints the table; writes it as JSON and into a page where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--level", type=int, default=2, help="splits of the icosphere")
    parser.add_argument("--layers", type=int, default=3, help="layers through the tissue")
    parser.add_argument("--poisson", type=float, nargs="+", default=[POISSON, 0.499])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path, help="page whose table of elements is replaced")
    parser.add_argument("-q", "--quiet", action="store_true", help="no line per choice")
    options = parser.parse_args()
    found = [
        row
        for nu in options.poisson
        for row in rows(options.level, options.layers, nu, quiet=options.quiet)
    ]
    text = f"{found[0]['n_tets']} tets.\n\n{table(found)}"
    print(text)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if options.markdown:
        replace_marked(options.markdown, "benches/stability/elements.py", text)


if __name__ == "__main__":
    main()
