"""The plan that an operation achieved, from the bones before and after (paper 3, Figure 5).

The scans are first aligned by the part of the skull that was not operated on (`register_volumes`).
Each bone segment is then registered to the post-operative bone, which gives its motion, as in Table
2 of the paper. Surfaces with the same triangles before and after need no search: their vertices
give the motion, and their shape shows how much of it is slip along the surface.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import Surface, rigid_fit
from cmfsim.bones.motion import RemovedBone, missing_patches
from cmfsim.bones.pairs.coherent_motion import MatchOptions, RigidPiece, coherent_motion, lay_on
from cmfsim.bones.pairs.paired_surfaces import StrayPatch, paired_shape, stray_patches
from cmfsim.bones.pairs.shape_fit import ShapeFit
from cmfsim.errors import RegistrationError, RegistrationInputError
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import (
    Floats,
    Frozen,
    as_floats,
    as_text,
    check_instance,
    check_one_of,
    frozen,
    plain,
)
from cmfsim.values.motion import RigidMotion, carried, decompose_motion, rigid_matrix
from cmfsim.values.surface_data import MovedSurface, SurfaceData
from cmfsim.values.table import Table

_LOG = logging.getLogger(__name__)

# A motion counts as rigid if it reproduces the place of every vertex to this, mm: a tenth of the
# accuracy of a segmented bone, and far above the rounding of a surface file.
RIGID_TOLERANCE = 0.1
# A bone did not move as one if it, or a piece of it, lies this far off the bone after on average
# over neighbours, mm rms, with its change of size removed.
BENT = 0.15
Segments: TypeAlias = Mapping[str, SurfaceData | BoneSegment]


@dataclass(frozen=True, eq=False)
class AchievedMotion(Frozen):
    """The motion of one bone segment.

    Attributes
    ----------
    matrix : (4, 4) float64, mm
        The rigid motion, from before to after; the nearest one if it is not rigid.
    motion : RigidMotion
        The same as translation and rotation.
    method : str
        "vertices" (same triangles before and after), "shape" (the same, vertices slid along the
        bone) or "icp".
    is_rigid : bool
        Whether the rigid motion is the whole motion; always for "shape" and "icp".
    rms, worst : float, mm
        Residual of the rigid motion: distance of the vertices from their places after the operation
        ("vertices"), or of the kept vertices from the post-operative bone, with the change of size
        removed ("shape", "icp").
    median, p95 : float, mm
        The same distances of all vertices, kept or not: median and 95th percentile.
    share : float
        Share of the vertices that were kept.
    moved : MovedSurface or None
        The motion vertex by vertex, where the triangles are the same; that of `measure_pair` is
        without slip, noise and removed bone.
    removed : tuple of RemovedBone
        Patches of the segment that are missing after the operation. They do not count in the
        motion.
    stray : tuple of StrayPatch
        Patches of 1 cm² and more that lie off the post-operative bone: they moved differently from
        the segment, or were removed.
    fit : ShapeFit or None
        The fit by shape to the post-operative bone: the change of size with an interval, and the
        directions that the shape does not determine. None where the vertices determine everything.
    slip : float, mm
        How far vertices with the same triangles slid along the surface: the median for "shape",
        the rms of what was subtracted for "vertices", 0 for "icp".
    noise : float, mm
        The rms of the noise of vertices that was averaged out.
    pieces : tuple of RigidPiece
        The parts that moved differently within the segment, the largest first; empty if it moved
        as one.
    """

    matrix: Floats
    motion: RigidMotion
    method: str
    is_rigid: bool
    rms: float
    worst: float
    median: float
    p95: float
    share: float
    moved: MovedSurface | None
    removed: tuple[RemovedBone, ...] = ()
    stray: tuple[StrayPatch, ...] = ()
    fit: ShapeFit | None = None
    slip: float = 0.0
    noise: float = 0.0
    pieces: tuple[RigidPiece, ...] = ()

    @property
    def plan(self) -> Floats | MovedSurface:
        """The motion as a plan takes it: the matrix, or the moved surface if it is not rigid."""
        return self.matrix if self.is_rigid or self.moved is None else self.moved

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them."""
        return {
            "method": self.method,
            "is_rigid": self.is_rigid,
            "translation_mm": self.motion.translation.tolist(),
            "angle_degrees": self.motion.angle,
            "axis": self.motion.axis.tolist(),
            "centre_mm": self.motion.centre.tolist(),
            "matrix": self.matrix.tolist(),
            "rms_mm": self.rms,
            "worst_mm": self.worst,
            "median_mm": self.median,
            "p95_mm": self.p95,
            "share": self.share,
            "removed": plain(self.removed),
            "stray": plain(self.stray),
            **({"pieces": plain(self.pieces)} if self.pieces else {}),
            **({} if self.fit is None else {"shape": self.fit.as_dict(), "slip_mm": self.slip}),
        }


@dataclass(frozen=True, eq=False)
class AchievedPlan(Frozen):
    """The motions of all bone segments in an operation.

    Attributes
    ----------
    motions : mapping of str to AchievedMotion
    alignment : (4, 4) float64, mm
        Maps the post-operative frame to the pre-operative one, including the correction by the
        reference segment.
    correction : RigidMotion or None
        Correction of the given alignment by the reference segment; None without a reference.
    """

    motions: Mapping[str, AchievedMotion]
    alignment: Floats
    correction: RigidMotion | None

    @property
    def plan(self) -> dict[str, Floats | MovedSurface]:
        """The motion of each segment, as scenes and plans take it."""
        return {name: motion.plan for name, motion in self.motions.items()}

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them."""
        correction = None
        if self.correction is not None:
            correction = {
                "translation_mm": self.correction.translation.tolist(),
                "angle_degrees": self.correction.angle,
            }
        return {
            "segments": plain(self.motions),
            "alignment": self.alignment.tolist(),
            "correction": correction,
        }

    def text(self) -> str:
        """Translation and rotation of each segment, in the form of Table 2 of Kim et al. (2010)."""
        rows = []
        for name, found in self.motions.items():
            shift, axis = found.motion.translation, found.motion.axis
            rows.append(
                [
                    name,
                    *(f"{c:+.2f} mm" for c in shift),
                    f"{found.motion.angle:.2f}°",
                    "(" + ", ".join(f"{c:+.2f}" for c in axis) + ")",
                    f"{found.rms:.2f} mm" + ("" if found.is_rigid else ", not rigid"),
                    f"{found.share:.0%}",
                ]
            )
        columns = ("segment", "left", "back", "up", "turn", "about axis", "rms", "kept")
        return Table(columns, rows, numeric=False).text


def motion_by_vertices(
    before: SurfaceData, after: SurfaceData, *, centre: ArrayLike | None = None
) -> AchievedMotion:
    """The motion between surfaces with the same vertices and triangles in order, vertex by vertex.

    centre: (3,), mm, about which the turn is written. Default: the middle of the vertices before.
    Raises `RegistrationError`: Other triangles; vertices that lie on one line.
    """
    if not before.has_triangles_of(after):
        raise RegistrationInputError(
            f"the surfaces have different triangles: {len(before.triangles)} on "
            f"{len(before.vertices)} vertices before, "
            f"{len(after.triangles)} on {len(after.vertices)} after; a motion by vertices needs "
            "the same triangles in the same order; use achieved_plan, which registers the surfaces"
        )
    here, there = before.vertices, after.vertices
    fit = rigid_fit(here, there)
    worst = float(fit.residuals.max())
    return AchievedMotion(
        matrix=frozen(fit.matrix),
        motion=decompose_motion(fit.matrix, _centre(centre, here)),
        method="vertices",
        is_rigid=worst <= RIGID_TOLERANCE,
        rms=float(fit.rms),
        worst=worst,
        median=float(np.median(fit.residuals)),
        p95=float(np.quantile(fit.residuals, 0.95)),
        share=1.0,
        moved=MovedSurface(before, there),
    )


def measure_pair(
    before: SurfaceData,
    after: SurfaceData,
    *,
    centre: ArrayLike | None = None,
    is_still: bool = False,
) -> AchievedMotion:
    """The motion between two surfaces with the same triangles, without slip of the vertices.

    If the bone has the same shape before and after, neither cut nor bent, the motion is the rigid
    one that aligns the two, however the vertices slid along the surface; a bone that was not
    operated on keeps its change along the normals. Otherwise the vertices are followed in rigid
    pieces (`coherent_motion`). `fit` is None if the shapes cannot be compared.

    centre: As in `motion_by_vertices`, which raises the same.
    is_still: Whether the bone was not operated on: changes on it are then no motion of the bone.
    """
    found = motion_by_vertices(before, after, centre=centre)
    if found.is_rigid:
        return found
    coherent = coherent_motion(MovedSurface(before, after.vertices))
    by_vertex = replace(
        found,
        moved=coherent.motion,
        removed=coherent.removed,
        slip=coherent.slip,
        noise=coherent.noise,
        pieces=coherent.pieces if len(coherent.pieces) > 1 else (),
    )
    try:
        shape = paired_shape(before, after)
    except RegistrationError as error:
        _LOG.warning("using the vertices, because the shapes cannot be compared: %s", error)
        return by_vertex
    # Whether the bone, or a piece of it, lies off where the rigid motion of the whole takes it.
    parts = [shape.bent, *(shape.bent[piece.vertices] for piece in coherent.pieces)]
    is_bent = any(float(np.sqrt((part**2).mean())) > BENT for part in parts)
    if not shape.is_rigid or is_bent:
        return replace(by_vertex, fit=shape.fit, stray=shape.stray)
    known = {"removed": shape.removed, "stray": shape.stray, "slip": shape.slip}
    if is_still:
        moved = MovedSurface(before, shape.slid_free)
        return _by_shape("shape", before, shape.fit, centre, is_rigid=False, moved=moved, **known)
    return _by_shape("shape", before, shape.fit, centre, moved=found.moved, **known)


def achieved_plan(
    segments: Segments,
    postoperative: SurfaceData | Mapping[str, SurfaceData],
    *,
    alignment: ArrayLike | None = None,
    reference: str | None = None,
    centres: Mapping[str, ArrayLike] | None = None,
    options: MatchOptions | None = None,
    beside: Sequence[SurfaceData] = (),
) -> AchievedPlan:
    """The motion of each bone segment, from the bone before and after the operation.

    Parameters
    ----------
    segments : mapping of str to SurfaceData or BoneSegment
        Cut as the surgeon cut them, in their positions before the operation.
    postoperative : SurfaceData, or mapping of str to SurfaceData
        The whole bone after the operation, or a surface for each segment. One with the triangles of
        its segment gives the motion by vertices; otherwise the segment is registered to it.
    alignment : (4, 4) float64, mm, optional
        Maps the post-operative frame to the pre-operative one: `register_volumes(after, before)`.
        Default: both are in one frame.
    reference : str, optional
        A segment that was not operated on, such as the cranium. Its residual motion corrects the
        alignment, and is thus subtracted from every other motion.
    centres : mapping of str to (3,) float64, mm, optional
        Centres of the rotations. Default: the middle of each segment's vertices.
    options : MatchOptions, optional
    beside : sequence of SurfaceData
        Further segments before the operation, whose motion is not needed. A cut face towards one
        of them is not visible in a scan, so it is not reported as off the bone; those in `segments`
        are known already.

    Raises
    ------
    RegistrationError
        A segment that does not fit, or of which too little fits; ICP does not converge; also
        `ValueError`: no segment, an unknown name, an alignment that is not rigid.
    MeshError
        (also `ValueError`) A surface with degenerate triangles.

    Notes
    -----
    Trimmed iterative closest points (Besl & McKay 1992; Chetverikov et al. 2002) start from the
    segment's position before the operation and from 6 mm to each side, and continue from the best.
    A robust fit to tangent planes follows, in which the size may change. A change of size is about
    the segment's centre and is not part of its motion.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.achieved_plan(
    ...     {"cranium": cranium, "maxilla": maxilla}, bone_after,
    ...     alignment=volumes.matrix, reference="cranium",
    ... )  # doctest: +SKIP
    >>> print(found.text())  # doctest: +SKIP
    """
    options = MatchOptions() if options is None else options
    parts = _surfaces(segments)
    into = np.eye(4) if alignment is None else rigid_matrix(alignment, "alignment")
    if reference is not None:
        check_one_of("reference", reference, tuple(parts))
    for name in centres or {}:
        check_one_of("centre", name, tuple(parts))
    targets = _targets(postoperative, parts)

    def measure(name: str, frame: Floats) -> AchievedMotion:
        there = targets[name]
        after = SurfaceData(carried(frame, there.vertices), there.triangles, there.crease_angle)
        centre = (centres or {}).get(name)
        if parts[name].has_triangles_of(after):
            return measure_pair(parts[name], after, centre=centre, is_still=name == reference)
        others = (*beside, *(part for other, part in parts.items() if other != name))
        bone = Surface(after.vertices, after.triangles, crease_angle=after.crease_angle)
        fit = lay_on(name, parts[name], bone, options)
        stray, _ = stray_patches(parts[name], bone, fit.similarity, fit.rms, others)
        removed = missing_patches(parts[name], bone, fit.carried(parts[name].vertices))
        return _by_shape("icp", parts[name], fit, centre, removed=removed, stray=stray)

    correction = None
    if reference is not None:
        still = measure(reference, into)
        into = np.linalg.inv(still.matrix) @ into
        correction = decompose_motion(np.linalg.inv(still.matrix), still.motion.centre)
        _LOG.info(
            "alignment corrected by %s: %.3f mm, %.3f°",
            reference,
            float(np.linalg.norm(correction.translation)),
            correction.angle,
        )
    motions = {name: measure(name, into) for name in parts}
    return AchievedPlan(MappingProxyType(motions), frozen(into), correction)


def _by_shape(
    method: str, segment: SurfaceData, fit: ShapeFit, centre: ArrayLike | None, **known: Any
) -> AchievedMotion:
    """The motion of a segment by its shape, with everything else known about it."""
    return AchievedMotion(
        **{
            "matrix": fit.matrix,
            "motion": decompose_motion(fit.matrix, _centre(centre, segment.vertices)),
            "method": method,
            "is_rigid": True,
            "rms": fit.rms,
            "worst": float(fit.off[fit.kept].max()),
            "median": float(np.median(fit.off)),
            "p95": float(np.quantile(fit.off, 0.95)),
            "share": float(fit.kept.mean()),
            "moved": None,
            "fit": fit,
            **known,
        }
    )


def _surfaces(segments: Segments) -> dict[str, SurfaceData]:
    if not segments:
        raise RegistrationInputError("segments is empty: give at least one")
    found: dict[str, SurfaceData] = {}
    for name, segment in segments.items():
        surface = segment.surface if isinstance(segment, BoneSegment) else segment
        check_instance(f"segment {as_text('segment name', name)!r}", surface, SurfaceData)
        found[name] = surface
    return found


def _targets(
    postoperative: SurfaceData | Mapping[str, SurfaceData], parts: Mapping[str, SurfaceData]
) -> Mapping[str, SurfaceData]:
    """The post-operative surface to which each segment is registered."""
    if isinstance(postoperative, SurfaceData):
        return dict.fromkeys(parts, postoperative)
    missing = [name for name in parts if name not in postoperative]
    if missing:
        raise RegistrationInputError(
            f"these segments have no post-operative surface: {', '.join(missing)}; give one for "
            f"each of {', '.join(parts)}, or one surface of the whole bone"
        )
    for name in parts:
        check_instance(f"post-operative surface of {name!r}", postoperative[name], SurfaceData)
    return postoperative


def _centre(centre: ArrayLike | None, vertices: Floats) -> Floats:
    return vertices.mean(axis=0) if centre is None else as_floats("centre", centre)
