"""Isosurface stuffing of labels and levels (Labelle & Shewchuk 2007)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmfsim import _core
from cmfsim._core import TetMesh
from cmfsim.errors import MeshInputError
from cmfsim.meshing.quality import mesh_findings, mesh_report
from cmfsim.values.checks import as_number, as_point, as_positive
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.mesh_report import MeshReport

MAX_REFINEMENTS = 3


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
        whole = isinstance(self.refinements, int) and not isinstance(self.refinements, bool)
        if not whole or not 0 <= self.refinements <= MAX_REFINEMENTS:
            raise MeshInputError(
                f"refinements is {self.refinements!r}: a whole number from 0 to {MAX_REFINEMENTS}"
            )


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
