"""Isosurface stuffing of labels and levels (Labelle & Shewchuk 2007), and quality of meshes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim import _core
from cmfsim._core import Surface, TetMesh
from cmfsim.errors import MeshInputError
from cmfsim.values.checks import Indices, as_number, as_point, as_positive, as_whole
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.mesh_report import BINS, MeshReport
from cmfsim.values.surface_data import SurfaceData

# Smallest dihedral angle that a tet of a good mesh has, degrees; below, the stiffness matrix loses
# digits and the deformation of the tet its meaning.
LEAST_DIHEDRAL = 10.0
# Tets that the report names.
N_WORST = 10
MAX_REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class SeparatedMesh:
    """A mesh that was separated: nodes keep their numbers, and new ones follow.

    parents: (k, 2) uint32, of each new node, the ends of the edge that was cut there, or twice the
        node that it is a copy of.
    """

    mesh: TetMesh
    parents: Indices


def separated_mesh(mesh: TetMesh, surface: SurfaceData) -> SeparatedMesh:
    """The mesh separated along an open surface, as by `part_mesh`, and its nodes' origin."""
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
    corners = [nodes[tets[:, corner]].T.copy() for corner in range(4)]
    edges = [np.sqrt(((corners[a] - corners[b]) ** 2).sum(axis=0)).mean() for a, b in pairs]
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
    names = (
        "volume_error", "boundary_error_mean", "boundary_error_max", "dropped_parts",
        "dropped_volume", "dropped_tets",
    )  # fmt: skip
    return replace(mesh_report(part), **{name: getattr(whole, name) for name in names})


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


@dataclass(frozen=True)
class MeshOptions:
    """Options of filling tissue with tets.

    Attributes
    ----------
    edge_length : float, mm
        Edge of the lattice's cubes, the longest edge inside; the mean edge is about 0.9 of it.
    refinements : int
        How often the edge may be halved where tissue, or a gap in it, is thinner than an edge.
    least_body : float, mm³
        Bodies below this volume, except the largest, are specks and are removed.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.MeshOptions(edge_length=2.5).refinements
    1
    """

    edge_length: float = 3.0
    refinements: int = 1
    least_body: float = 0.0

    def __post_init__(self) -> None:
        as_positive("edge_length", self.edge_length)
        if as_number("least_body", self.least_body) < 0.0:
            raise MeshInputError(f"least_body is {self.least_body} mm³: 0 or more is needed")
        as_whole("refinements", self.refinements, 0, MAX_REFINEMENTS, MeshInputError)


@dataclass(frozen=True, eq=False)
class TissueMesh:
    """A mesh, the report of its quality, and findings."""

    mesh: TetMesh
    report: MeshReport
    findings: tuple[Finding, ...] = ()


def mesh_from_labels(
    labels: ArrayLike,
    spacing: ArrayLike,
    edge_length: float = 3.0,
    origin: ArrayLike = (0.0, 0.0, 0.0),
    *,
    refinements: int = 1,
) -> TetMesh:
    """The tets of the tissue marked in a label image, with dihedral angles of at least 10°.

    Parameters
    ----------
    labels : (nx, ny, nz) array of bool or whole numbers
        Non-zero is tissue; labels[i, j, k] lies at origin + (i, j, k)·spacing.
    spacing : (3,) float64 or one number, mm
    edge_length : float, mm
        Edge of the lattice's cubes; the mean edge is about 0.9 of it.
    origin : (3,) float64, mm
        Centre of voxel (0, 0, 0).
    refinements : int
        How often the edge may be halved where tissue, or a gap in it, is thinner than an edge.

    Returns
    -------
    TetMesh
        Disconnected bodies are all kept; nodes lie on the boundary between labels, with the steps
        between voxels rounded. The same bits for any number of threads.

    Raises
    ------
    MeshError
        (also `ValueError`) Not three axes, real numbers, spacing or edge length not positive, no
        tissue, tissue too thin for any tet.

    Notes
    -----
    Isosurface stuffing on a body-centred cubic lattice, Labelle & Shewchuk (2007), graded by an
    octree where tissue is thin.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> mesh = cmfsim.mesh_from_labels(np.ones((12, 10, 8)) > 0, spacing=1.0, edge_length=3.0)
    >>> float(mesh.volumes.sum()) > 0.9 * 12 * 10 * 8  # the edges of the box are rounded
    True
    >>> bool(mesh.quality().min_dihedral.min() >= 10.0)
    True
    """
    array = np.asarray(labels)
    if array.dtype.kind not in "biu":
        raise MeshInputError(
            f"labels have dtype {array.dtype}: bool or whole numbers are needed; "
            "a level image goes to mesh_from_level"
        )
    options = MeshOptions(edge_length=edge_length, refinements=refinements)
    return _stuffed(array, spacing, origin, options)[0]


def mesh_from_level(
    level: ImageData,
    options: MeshOptions | None = None,
    *,
    allowed: ArrayLike | None = None,
    needed: ArrayLike | None = None,
) -> TissueMesh:
    """The tets inside a level image, with the report of their quality.

    Parameters
    ----------
    level : ImageData
        Positive in the tissue, zero on its surface.
    options : MeshOptions, optional
    allowed : (nx, ny, nz) array of whole numbers, optional
        How often the edge may be halved for thin tissue at each voxel; default: as in the options.
    needed : (nx, ny, nz) array of whole numbers, optional
        How often it is at least halved, thin or not, in the cube that contains each voxel's centre:
        no more often than in the options.

    Raises
    ------
    MeshError
        (also `ValueError`) No tissue, NaN or infinity, tissue too thin for any tet, more halvings
        needed than the options allow.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> x, y, z = np.mgrid[-12:13, -12:13, -12:13].astype(float)
    >>> ball = cmfsim.ImageData(10.0 - np.sqrt(x**2 + y**2 + z**2), spacing=(1, 1, 1))
    >>> report = cmfsim.mesh_from_level(ball).report
    >>> abs(report.volume_error) < 0.02, report.boundary_error_mean < 0.1
    (True, True)
    """
    options = options or MeshOptions()
    values = level.single
    mesh, making = _stuffed(
        values, level.spacing, level.origin, options, allowed=allowed, needed=needed
    )
    report = mesh_report(mesh, making)
    return TissueMesh(mesh, report, mesh_findings(report))


def _stuffed(
    values: ArrayLike,
    spacing: ArrayLike,
    origin: ArrayLike,
    options: MeshOptions,
    *,
    allowed: ArrayLike | None = None,
    needed: ArrayLike | None = None,
) -> tuple[TetMesh, dict[str, float]]:
    steps = np.asarray(spacing, dtype=np.float64)
    steps = np.full(3, steps) if steps.ndim == 0 else steps
    x, y, z = as_point("spacing", steps)
    o = as_point("origin", origin)
    return _core.stuff_image(
        values,
        (float(x), float(y), float(z)),
        options.edge_length,
        (float(o[0]), float(o[1]), float(o[2])),
        refinements=options.refinements,
        least_body=options.least_body,
        allowed=allowed,
        needed=needed,
    )
