"""Enters another program into the benchmark: voxels of soft tissue, solved by scikit-fem and SciPy.

    python -m benches.accuracy.voxel_entry FOLDER [--voxel 5] [--part test]

This entry shares neither mesh, elements, assembly nor solver with cmfsim: trilinear hexahedra on a
grid, one isotropic tissue, bone that moves its nodes (as Mollemans et al. 2007 compare finite
elements with mass tensors). From cmfsim it takes only the cut bones and the plan. The predictions
are put into FOLDER/predictions/scikit-fem.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import scipy.spatial
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

import cmfsim

METHOD = "scikit-fem"
# As the homogeneous model's fat, MPa and 1.
YOUNG, POISSON = 0.003, 0.46
# Skin follows the grid's nodes this near, in voxels; farther away it stays.
NEAR = 1.5
NEIGHBOURS = 8
TOLERANCE = 1e-6


def predicted(folder: Path, voxel: float) -> cmfsim.SkinPrediction:
    """The skin of one patient."""
    patient = cmfsim.build_case(folder / "case.toml")
    skin = cmfsim.read_surface(folder / "skin.ply")
    vertices = np.asarray(skin.vertices)
    nodes, cells = _grid(patient, cmfsim.Surface(skin.vertices, skin.triangles), voxel)
    motion, at = _held(patient, nodes, voxel)
    u = _solved(nodes, cells, motion, at)
    found = scipy.spatial.cKDTree(nodes).query(vertices, k=NEIGHBOURS)
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    weights = 1.0 / np.maximum(distance, 1e-6) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    share = np.clip(2.0 * (1.0 - distance[:, 0] / (NEAR * voxel)), 0.0, 1.0)
    moved = share[:, None] * np.einsum("vk,vki->vi", weights, u[nearest])
    return cmfsim.SkinPrediction(vertices, moved)


def _grid(
    patient: cmfsim.PatientModel, skin: cmfsim.Surface, voxel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and hexahedra of the voxels that are soft tissue or touch it."""
    mesh = np.asarray(patient.scene.nodes)
    low, high = mesh.min(axis=0) - voxel, mesh.max(axis=0) + voxel
    axes = [np.arange(a, b, voxel) for a, b in zip(low, high, strict=True)]
    grid = skfem.MeshHex.init_tensor(*axes)
    middles = grid.p[:, grid.t].mean(axis=1).T
    inside = skin.winding_number(middles) > 0.5
    for segment in patient.segments:
        surface = cmfsim.Surface(segment.surface.vertices, segment.surface.triangles)
        # A voxel in bone, all of whose corners are in bone as well, holds no tissue.
        inside[inside] &= _depth(surface, middles[inside]) < 0.9 * voxel
    used, cells = np.unique(grid.t[:, inside], return_inverse=True)
    return grid.p[:, used].T, cells.reshape(8, -1)


def _depth(surface: cmfsim.Surface, points: np.ndarray) -> np.ndarray:
    """How deep points lie in bone, mm; negative outside."""
    closest, _, _ = surface.closest(points)
    away = np.linalg.norm(points - closest, axis=1)
    depth: np.ndarray = np.where(surface.winding_number(points) > 0.5, away, -away)
    return depth


def _held(
    patient: cmfsim.PatientModel, nodes: np.ndarray, voxel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in or at bone, and where the grid is cut at its back and below, with their motions."""
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    cut = (nodes[:, 1] > high[1] - 0.1 * voxel) | (nodes[:, 2] < low[2] + 0.1 * voxel)
    motion = np.zeros_like(nodes)
    nearest = np.where(cut, np.inf, -np.inf)
    for segment in patient.segments:
        surface = cmfsim.Surface(segment.surface.vertices, segment.surface.triangles)
        depth = _depth(surface, nodes)
        closer = (depth > -0.25 * voxel) & (depth > nearest)
        matrix = np.asarray(patient.scene.plan.get(segment.name, np.eye(4)))
        motion[closer] = nodes[closer] @ matrix[:3, :3].T + matrix[:3, 3] - nodes[closer]
        nearest[closer] = depth[closer]
    held = np.flatnonzero(np.isfinite(nearest) | cut)
    return motion[held], held


def _solved(
    nodes: np.ndarray, cells: np.ndarray, moved: np.ndarray, held: np.ndarray
) -> np.ndarray:
    """Displacements of the nodes, (n, 3) mm, by conjugate gradients with a diagonal."""
    mesh = skfem.MeshHex(nodes.T.copy(), cells)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex1()), intorder=2)
    matrix = linear_elasticity(*lame_parameters(YOUNG, POISSON)).assemble(basis).tocsr()
    dofs = basis.nodal_dofs
    u = np.zeros(matrix.shape[0])
    u[dofs[:, held]] = moved.T
    free = np.setdiff1d(np.arange(len(u)), dofs[:, held].ravel())
    reduced = matrix[free][:, free]
    scale = scipy.sparse.diags_array(1.0 / reduced.diagonal())
    right = -(matrix[free] @ u)
    u[free], failed = scipy.sparse.linalg.cg(reduced, right, rtol=TOLERANCE, maxiter=5000, M=scale)
    if failed:
        raise RuntimeError(f"conjugate gradients have not converged after {failed} iterations")
    displacements: np.ndarray = u[dofs].T
    return displacements


def main() -> None:
    """Predicts every patient of a part who is not predicted yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--voxel", type=float, default=5.0, help="mm (default 5)")
    parser.add_argument("--part", default="test")
    options = parser.parse_args()
    place = options.folder / "predictions" / METHOD
    for name in cmfsim.Population.load(options.folder).named("made", options.part):
        file = place / f"{name}.npz"
        if file.exists():
            continue
        begun = time.perf_counter()
        cmfsim.write_skin_prediction(file, predicted(options.folder / name, options.voxel))
        seconds = time.perf_counter() - begun
        file.with_suffix(".seconds").write_text(f"{seconds:.3f}\n", encoding="utf-8")
        print(f"{name}: {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
