"""Meshes: their quality with findings on it, and their separation along an open surface."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cmfsim import _core
from cmfsim._core import Surface, TetMesh
from cmfsim.values.checks import Indices
from cmfsim.values.finding import Finding
from cmfsim.values.mesh_report import BINS, MeshReport
from cmfsim.values.surface_data import SurfaceData

# Smallest dihedral angle that a tet of a good mesh has, degrees; below, the stiffness matrix loses
# digits and the deformation of the tet its meaning.
LEAST_DIHEDRAL = 10.0
# Tets that the report names.
N_WORST = 10


@dataclass(frozen=True, eq=False)
class SeparatedMesh:
    """A mesh that was separated, and where its new nodes come from.

    mesh: Nodes keep their numbers; new ones follow.
    parents: (k, 2) uint32, of each new node, the ends of the edge that was cut there, or twice the
        node that it is a copy of.
    """

    mesh: TetMesh
    parents: Indices


def separated_mesh(mesh: TetMesh, surface: SurfaceData) -> SeparatedMesh:
    """The mesh separated along an open surface, as `part_mesh`, with the origin of its new nodes.

    Raises `MeshError`: The surface runs through no tissue.
    """
    return SeparatedMesh(*_core.part_mesh(mesh, Surface(surface.vertices, surface.triangles)))


def part_mesh(mesh: TetMesh, surface: SurfaceData) -> TetMesh:
    """The mesh separated along an open surface, such as lips that an image shows as one piece.

    Nodes close to the surface move onto it, and edges that still cross it are cut, so that both
    sides of the crack are as smooth as the surface.

    Parameters
    ----------
    mesh : TetMesh
    surface : SurfaceData
        Open; the crack ends at its rim, and at the boundary of the mesh where it reaches beyond.

    Returns
    -------
    TetMesh
        Its nodes keep their numbers; new ones on the crack follow them.

    Raises
    ------
    MeshError
        (also `ValueError`) The surface runs through no tissue.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> mesh = cmfsim.mesh_from_labels(np.ones((12, 12, 12)) > 0, spacing=1.0)
    >>> corners = [[-9, -9, 5.6], [6, -9, 5.6], [6, 20, 5.6], [-9, 20, 5.6]]
    >>> sheet = cmfsim.SurfaceData(corners, [[0, 1, 2], [0, 2, 3]])
    >>> cmfsim.part_mesh(mesh, sheet).n_nodes > mesh.n_nodes
    True
    """
    return separated_mesh(mesh, surface).mesh


def mesh_report(mesh: TetMesh, making: Mapping[str, Any] | None = None) -> MeshReport:
    """The quality of a mesh, with the figures of its creation if they are known.

    Parameters
    ----------
    mesh : TetMesh
    making : mapping, optional
        The values that `_core.stuff_image` returns together with the mesh.

    Examples
    --------
    >>> import cmfsim
    >>> mesh = cmfsim.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    >>> round(cmfsim.mesh_report(mesh).min_dihedral, 1)
    54.7
    """
    making = making or {}
    quality = mesh.quality()
    least = quality.min_dihedral
    order = np.argsort(least, kind="stable")[:N_WORST]
    tets = mesh.tets
    nodes = mesh.nodes
    counts, _ = np.histogram(np.minimum(least, BINS[-1]), bins=(*BINS, BINS[-1] + 5.0))
    volume = float(np.sum(mesh.volumes))
    wanted = making.get("level_volume")
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    edges = [np.linalg.norm(nodes[tets[:, a]] - nodes[tets[:, b]], axis=1).mean() for a, b in pairs]
    return MeshReport(
        n_nodes=mesh.n_nodes,
        n_tets=mesh.n_tets,
        volume=volume,
        volume_error=(volume - wanted) / wanted if wanted else None,
        boundary_error_mean=making.get("boundary_error_mean"),
        boundary_error_max=making.get("boundary_error_max"),
        min_dihedral=float(least.min()),
        max_dihedral=float(np.max(quality.max_dihedral)),
        edge_ratio=float(np.max(quality.edge_ratio)),
        mean_edge=float(np.mean(edges)),
        histogram=tuple(int(n) for n in counts),
        worst=tuple(
            {
                "tet": int(tet),
                "min_dihedral": float(least[tet]),
                "centroid": [float(x) for x in nodes[tets[tet]].mean(axis=0)],
            }
            for tet in order
        ),
        dropped_parts=int(making.get("dropped_parts", 0)),
        dropped_volume=float(making.get("dropped_volume", 0.0)),
        dropped_tets=int(making.get("dropped_tets", 0)),
    )


def report_of_part(part: TetMesh, whole: MeshReport) -> MeshReport:
    """The quality of a mesh of which tets were left out, with what the making of the whole said."""
    return replace(
        mesh_report(part),
        volume_error=whole.volume_error,
        boundary_error_mean=whole.boundary_error_mean,
        boundary_error_max=whole.boundary_error_max,
        dropped_parts=whole.dropped_parts,
        dropped_volume=whole.dropped_volume,
        dropped_tets=whole.dropped_tets,
    )


def mesh_findings(report: MeshReport) -> tuple[Finding, ...]:
    """Findings on a mesh: poor tets, and specks that were removed."""
    findings = []
    if report.min_dihedral < LEAST_DIHEDRAL:
        worst = report.worst[0]
        x, y, z = worst["centroid"]
        findings.append(
            Finding(
                "mesh-poor-tet",
                f"tet {worst['tet']} has a dihedral angle of {report.min_dihedral:.1f}°",
                where=f"mesh, at ({x:.1f}, {y:.1f}, {z:.1f}) mm",
            )
        )
    if report.dropped_parts:
        findings.append(
            Finding(
                "tissue-not-held",
                f"{report.dropped_parts} specks of tissue with {report.dropped_volume:.1f} mm³ in "
                "all were removed",
                severity="note",
                where="mesh",
            )
        )
    return tuple(findings)
