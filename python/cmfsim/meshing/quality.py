"""The quality of a mesh: shapes, volume and boundary, in figures that a report can print."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cmfsim._core import TetMesh
from cmfsim.values.finding import Finding

__all__ = ["LEAST_DIHEDRAL", "MeshReport", "mesh_findings", "mesh_report", "report_of_part"]

# Smallest dihedral angle that a tet of a good mesh has, degrees; below, the stiffness matrix loses
# digits and the deformation of the tet its meaning.
LEAST_DIHEDRAL = 10.0
# Bins of the histogram of smallest dihedral angles, degrees; a regular tet has 70.5.
BINS = tuple(float(angle) for angle in range(0, 80, 5))
# Tets that the report names.
N_WORST = 10


@dataclass(frozen=True)
class MeshReport:
    """The quality of a mesh.

    Attributes
    ----------
    n_nodes, n_tets : int
    volume : float, mm³
    volume_error : float or None
        Relative to the volume of the level image that was meshed.
    boundary_error_mean, boundary_error_max : float or None, mm
        Distance of the boundary triangles' centroids from the surface that was meshed.
    min_dihedral, max_dihedral : float, degrees
    edge_ratio : float
        Longest over shortest edge of the worst tet.
    mean_edge : float, mm
    histogram : tuple of int
        Tets by smallest dihedral angle, in bins of 5° from 0.
    worst : tuple of mapping
        The ten tets of smallest dihedral angle: `tet`, `min_dihedral` (degrees), `centroid` (mm).
    dropped_parts : int
        Bodies that were removed because they were too small; `dropped_volume` (mm³) is their
        volume.
    dropped_volume : float, mm³
    dropped_tets : int
        Poor tets at the surface that were removed.
    """

    n_nodes: int
    n_tets: int
    volume: float
    volume_error: float | None
    boundary_error_mean: float | None
    boundary_error_max: float | None
    min_dihedral: float
    max_dihedral: float
    edge_ratio: float
    mean_edge: float
    histogram: tuple[int, ...]
    worst: tuple[Mapping[str, Any], ...]
    dropped_parts: int = 0
    dropped_volume: float = 0.0
    dropped_tets: int = 0

    def as_dict(self) -> dict[str, Any]:
        """The report as plain values, ready for JSON."""
        return asdict(self)

    def as_text(self) -> str:
        """The report as lines for a terminal."""
        lines = [
            f"mesh          {self.n_nodes} nodes, {self.n_tets} tets",
            f"edge          {self.mean_edge:.2f} mm on average",
            f"volume        {self.volume / 1000.0:.1f} cm³" + _percent(self.volume_error),
        ]
        if self.boundary_error_mean is not None:
            lines.append(
                f"boundary      {self.boundary_error_mean:.3f} mm from the surface on average, "
                f"{self.boundary_error_max:.2f} mm at most"
            )
        lines.append(
            f"dihedral      {self.min_dihedral:.1f}° to {self.max_dihedral:.1f}°, "
            f"edge ratio {self.edge_ratio:.1f}"
        )
        most = max(self.histogram)
        for low, count in zip(BINS, self.histogram, strict=True):
            if count:
                bar = "█" * max(1, round(30 * count / most))
                lines.append(f"  {low:3.0f}–{low + 5:2.0f}°  {count:9d} {bar}")
        lines.append("worst tets    smallest dihedral angle, and where")
        for tet in self.worst:
            x, y, z = tet["centroid"]
            lines.append(
                f"  {tet['min_dihedral']:5.1f}°  {tet['tet']:9d} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
            )
        if self.dropped_parts:
            lines.append(
                f"removed       {self.dropped_parts} parts of {self.dropped_volume:.1f} mm³ in all"
            )
        return "\n".join(lines)


def mesh_report(mesh: TetMesh, making: Mapping[str, Any] | None = None) -> MeshReport:
    """The quality of a mesh, with the figures of its creation if they are known.

    Parameters
    ----------
    mesh : TetMesh
    making : mapping, optional
        The values that `_core.stuff_image` returns together with the mesh.

    Returns
    -------
    MeshReport

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
            Finding.warning(
                "mesh-poor-tet",
                f"tet {worst['tet']} has a dihedral angle of {report.min_dihedral:.1f}°",
                where=f"mesh, at ({x:.1f}, {y:.1f}, {z:.1f}) mm",
                why="its deformation is inaccurate, and it worsens the conditioning of the system",
                fix="change edge_length slightly, or set refinements = 0",
            )
        )
    if report.dropped_parts:
        findings.append(
            Finding.note(
                "mesh-specks-dropped",
                f"{report.dropped_parts} specks of tissue with {report.dropped_volume:.1f} mm³ in "
                "all were removed",
                where="mesh",
                why="they are not attached to anything",
                fix="nothing to do; check the thresholds if a part of the face is missing",
            )
        )
    return tuple(findings)


def _percent(error: float | None) -> str:
    return "" if error is None else f", {100.0 * error:+.2f} % against the image"
