"""Registering a bone segment to the post-operative bone.

Trimmed iterative closest points find the pose; a robust fit, in which the size may change, refines
it, because trimming a fixed share also discards sound bone, its noisier part.
"""

import logging
from dataclasses import dataclass

import numpy as np

from cmfsim._core import IcpFit, Surface
from cmfsim.bones.pairs.shape_fit import ShapeFit, fit_shape
from cmfsim.errors import RegistrationError, RegistrationInputError
from cmfsim.registration import icp
from cmfsim.values.checks import Floats, as_number, as_positive
from cmfsim.values.surface_data import SurfaceData

_LOG = logging.getLogger(__name__)

# Points of the quick search for a start, and its steps from each candidate.
QUICK_POINTS = 400
QUICK_STEPS = 20
# Points of the quick fits in which the size may change.
SIZED_POINTS = 1500
# The search has converged when a step moves no point by more than this share of the segment's size,
# some micrometres: below it, a bone of another size only swaps partners, and a robust fit follows.
REST = 1e-4
MOST_STEPS = 300


@dataclass(frozen=True)
class MatchOptions:
    """Options of the registration of a bone segment to the post-operative bone.

    Attributes
    ----------
    trim : float
        Share of the segment's vertices, those furthest from the bone, that are ignored in the
        search: cut faces, plates, bone that was ground away. 0 to below 1.
    reach : float, mm
        The search also starts this far to each side along each axis, for segments that moved far
        enough to be matched to neighbouring bone; 0: only from the place before the operation.
    max_angle : float, degrees
        Largest angle between normals of partners: prevents matching the inner to the outer side of
        a bone.
    max_rms : float, mm
        RMS distance of the partners at the end; a worse fit is an error.
    least_share : float
        Share of the vertices that must have a partner at the end.

    Raises
    ------
    RegistrationError, CaseError
        (also `ValueError`) A value out of its range; not a number.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.MatchOptions(trim=0.4).reach
    6.0
    """

    trim: float = 0.3
    reach: float = 6.0
    max_angle: float = 60.0
    max_rms: float = 1.0
    least_share: float = 0.3

    def __post_init__(self) -> None:
        for name in ("max_angle", "max_rms"):
            as_positive(name, getattr(self, name))
        if as_number("reach", self.reach) < 0.0:
            raise RegistrationInputError(f"reach is {self.reach:g} mm: must not be below 0")
        if not 0.0 <= as_number("trim", self.trim) < 1.0:
            raise RegistrationInputError(f"trim is {self.trim:g}: must be from 0 to below 1")
        if not 0.0 < as_number("least_share", self.least_share) <= 1.0:
            raise RegistrationInputError(
                f"least_share is {self.least_share:g}: must be above 0, to 1"
            )


def lay_on(name: str, segment: SurfaceData, bone: Surface, options: MatchOptions) -> ShapeFit:
    """The fit of a segment, known by its name, to the post-operative bone.

    Raises `RegistrationError`: It does not fit, or too little of it does; the search does not
        converge.
    """
    try:
        moving = Surface(segment.vertices, segment.triangles, crease_angle=segment.crease_angle)
        found = icp(
            moving,
            bone,
            initial=_start(segment.vertices, bone, options),
            trim=options.trim,
            max_angle=options.max_angle,
            max_iterations=MOST_STEPS,
            tolerance=REST,
        )
        found_matrix = found.matrix
        fit = fit_shape(
            segment,
            bone,
            _sized_start(segment, bone, found_matrix, options),
            max_angle=options.max_angle,
        )
    except RegistrationError as error:
        raise RegistrationError(
            f"segment {name!r} cannot be registered to the post-operative bone: {error}"
        ) from error
    share = float(fit.kept.mean())
    if fit.rms > options.max_rms or share < options.least_share:
        raise RegistrationError(
            f"segment {name!r} does not fit the post-operative bone: {fit.rms:.2f} mm rms over "
            f"{share:.0%} of its vertices, at the best size (allowed {options.max_rms:g} mm, at "
            f"least {options.least_share:.0%}); check that the scans are aligned, that the "
            "segment is cut as it was in the operation, and that the scan shows the whole bone; "
            "a larger trim ignores plates and new bone"
        )
    _LOG.info("segment %s: %.3f mm rms, %.0f %% kept", name, fit.rms, 100 * share)
    return fit


def _sized_start(
    segment: SurfaceData, bone: Surface, matrix: Floats, options: MatchOptions
) -> Floats:
    """The best start of a fit in which the size may change.

    A bone of another size may be closest when it is rotated by some degrees, so the pose found at
    the same size competes with those that a quick fit finds from the place before the operation.
    """
    starts = [matrix, *(_shifted(shift) for shift in _shifts(options))]
    best, least = matrix, np.inf
    for start in starts:
        try:
            fit = fit_shape(
                segment, bone, start, max_angle=options.max_angle, most_points=SIZED_POINTS
            )
        except RegistrationError:
            # From there the fit shrinks to a part of the bone, or finds none.
            continue
        nearest = np.sort(fit.off)[: max(int((1.0 - options.trim) * len(fit.off)), 1)]
        if float(nearest.mean()) < least:
            best, least = fit.matrix, float(nearest.mean())
    return best


def _shifts(options: MatchOptions) -> list[Floats]:
    """Starting positions of a search: at the segment's position, and to each side of it."""
    shifts = [np.zeros(3)]
    if options.reach > 0.0:
        shifts += [sign * options.reach * axis for axis in np.eye(3) for sign in (-1.0, 1.0)]
    return shifts


def _shifted(shift: Floats) -> Floats:
    found = np.eye(4)
    found[:3, 3] = shift
    return found


def _start(vertices: Floats, bone: Surface, options: MatchOptions) -> Floats:
    """The best of several short searches, from where the segment was and from either side."""
    # Points from all over the segment, in whatever order the file has the vertices.
    order = np.random.default_rng(0).permutation(len(vertices))[:QUICK_POINTS]
    points = vertices[order]
    best: IcpFit | None = None
    for shift in _shifts(options):
        fit = icp(
            points,
            bone,
            initial=_shifted(shift),
            trim=options.trim,
            max_iterations=QUICK_STEPS,
            # Reaching the step limit is expected: the search continues from the best.
            tolerance=0.0,
        )
        if best is None or fit.rms < best.rms:
            best = fit
    return np.eye(4) if best is None else best.matrix
