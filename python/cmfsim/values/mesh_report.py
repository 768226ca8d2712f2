"""The quality of a mesh: shapes, volume and boundary, as plain values and as lines of text."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cmfsim.values.checks import Plain

# Bins of the histogram of smallest dihedral angles, degrees; a regular tet has 70.5.
BINS = tuple(float(angle) for angle in range(0, 80, 5))


@dataclass(frozen=True)
class MeshReport(Plain):
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

    def as_text(self) -> str:
        """The report as lines for a terminal."""
        error = self.volume_error
        against = "" if error is None else f", {100.0 * error:+.2f} % against the image"
        lines = [
            f"mesh          {self.n_nodes} nodes, {self.n_tets} tets",
            f"edge          {self.mean_edge:.2f} mm on average",
            f"volume        {self.volume / 1000.0:.1f} cm³{against}",
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
