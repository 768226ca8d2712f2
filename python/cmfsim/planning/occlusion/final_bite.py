"""The final bite: two intraoral scans in occlusion, and where the lower jaw lies by them.

Both scans are in one frame of their own. Each is registered to the crowns of its row; so the motion
that brings the lower row into the bite of the scans follows, whatever the frame of the scans is.
"""

import contextlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import IcpFit, icp
from cmfsim.errors import CaseInputError, RegistrationError
from cmfsim.planning.occlusion.contacts import contact_map
from cmfsim.planning.occlusion.rows import ToothRow
from cmfsim.values.checks import Floats, Plain, in_files
from cmfsim.values.finding import Finding
from cmfsim.values.motion import carried, rigid_motion
from cmfsim.values.surface_data import SurfaceData

# A scan fits a row if such a share of its crowns lie on it, to this far, mm: the crowns of a CT are
# blurred by some tenths; scans of the other jaw fit to 0.48 mm on the synthetic head, 0.64 mm on a
# real skull. Pairs that are trimmed do not count in the share.
MOST_ERROR, LEAST_SHARE = 0.35, 0.65
# Crowns farther from the scan are no partners, mm, and the share left out: braces, and gaps.
FAR, TRIM = 2.0, 0.2
# How much better the best position is than another one, as a ratio of errors.
CLEARER = 1.5
# Positions farther apart than this are others, mm.
OTHER = 3.0
# Crowns that are compared, and the sizes of a scan against its row that are plausible.
MOST_POINTS, SIZES = 3000, (0.6, 1.7)
STEPS = 100
# Overlap and gap of the rows in the final bite beyond which they are in no bite, mm.
MOST_OVERLAP, MOST_GAP = 3.0, 2.0
# Middles of both scans nearer than this are those of one scan, mm, or m.
SAME_PLACE = 1e-6
# Turns of a scan about the axis of the bite from which its position is sought, degrees.
TURNS = (0.0, 90.0, 180.0, 270.0)


@dataclass(frozen=True, eq=False)
class FinalBite(Plain):
    """The final bite of two scans, on the rows of a head.

    Attributes
    ----------
    motion : (4, 4) float64, mm
        Of the lower jaw into the bite, where the upper jaw stays.
    upper_error, lower_error : float, mm
        Root mean square distance of the crowns from their scan.
    overlap, gap : float, mm
        How deep the rows lie in one another then, and their least distance.
    mirrored : tuple of str
        The jaws whose teeth fit the mirror image of their scan as well: if it was mirrored on its
        way, nothing else shows it, and the bite would be mirrored too.
    """

    motion: Floats
    upper_error: float = field(metadata=in_files("upper_error_mm"))
    lower_error: float = field(metadata=in_files("lower_error_mm"))
    overlap: float = field(metadata=in_files("overlap_mm"))
    gap: float = field(metadata=in_files("gap_mm"))
    mirrored: tuple[str, ...] = field(default=(), metadata=in_files("fits_mirrored"))

    def following(self, upper: ArrayLike) -> Floats:
        """The motion of the lower jaw if the upper one moves by `upper`, (4, 4) mm."""
        return np.asarray(np.asarray(upper, dtype=np.float64) @ self.motion)

    @property
    def findings(self) -> list[Finding]:
        """What a person should check before trusting it."""
        what = f"the mirror image of the {' and '.join(self.mirrored)} scan fits the teeth as well"
        return [Finding("bite-scan-symmetric", what)] if self.mirrored else []


def final_bite(
    upper: ToothRow, lower: ToothRow, upper_scan: SurfaceData, lower_scan: SurfaceData
) -> FinalBite:
    """The final bite that two intraoral scans show.

    Parameters
    ----------
    upper, lower : ToothRow
        Before the operation.
    upper_scan, lower_scan : SurfaceData
        Of the teeth, mm, in occlusion in one frame: any. They may be open.

    Raises
    ------
    CaseError
        (also `ValueError`) A scan that does not fit its row, or fits in several ways, or better
        when it is mirrored; scans that are in no occlusion.

    Examples
    --------
    >>> import cmfsim
    >>> upper, lower = cmfsim.tooth_rows(anatomy, segments, landmarks)  # doctest: +SKIP
    >>> scans = [cmfsim.read_surface(f"{jaw}.stl") for jaw in ("upper", "lower")]  # doctest: +SKIP
    >>> bite = cmfsim.final_bite(upper, lower, *scans)  # doctest: +SKIP
    >>> plan["mandible_body"] = bite.following(plan["maxilla"])  # doctest: +SKIP
    """
    towards = upper_scan.vertices.mean(axis=0) - lower_scan.vertices.mean(axis=0)
    if np.linalg.norm(towards) < SAME_PLACE:
        raise CaseInputError(
            "both scans lie in one place (bite-not-closed): was one file given for both jaws?"
        )
    upper_fit, upper_mirrored = fitted_scan(upper, upper_scan, towards)
    lower_fit, lower_mirrored = fitted_scan(lower, lower_scan, -towards)
    if upper.segment == lower.segment:
        raise CaseInputError(
            f"both rows are on {upper.segment} (bite-one-segment): separate the jaws"
        )
    motion = np.asarray(np.linalg.inv(upper_fit.matrix) @ lower_fit.matrix, dtype=np.float64)
    contacts = contact_map(upper, lower.moved(motion))
    overlap, gap = contacts.greatest_overlap, max(0.0, contacts.least_gap)
    if overlap > MOST_OVERLAP or gap > MOST_GAP:
        raise CaseInputError(
            f"the scans are in no bite (bite-not-closed): the rows would overlap by {overlap:.1f} "
            f"mm and lie {gap:.1f} mm apart, {MOST_OVERLAP:g} and {MOST_GAP:g} mm are allowed; "
            "export both scans in occlusion, in one frame"
        )
    mirrored = (("upper", upper_mirrored), ("lower", lower_mirrored))
    jaws = tuple(jaw for jaw, as_well in mirrored if as_well)
    return FinalBite(motion, upper_fit.rms, lower_fit.rms, overlap, gap, jaws)


def fitted_scan(row: ToothRow, scan: SurfaceData, out: Floats) -> tuple[IcpFit, bool]:
    """The motion of a row onto its scan, and whether the row's mirror image fits it as well.

    out: Roughly from the bite to the roots of the scan.
    """
    jaw = row.arch.jaw
    points = row.surface.vertices[row.crowns]
    points = points[:: -(-len(points) // MOST_POINTS)]
    size = _spread(scan.vertices) / _spread(points)
    if not SIZES[0] <= size <= SIZES[1]:
        raise CaseInputError(
            f"the {jaw} scan is {size:.2g} times as large as the {jaw} tooth row (bite-scan-size), "
            f"{SIZES[0]:g} to {SIZES[1]:g} times is allowed: check its units (mm) and its file"
        )
    turned = _frame(scan.vertices, out)
    roots = row.arch.out
    across = row.arch.axes()[0]
    across = across - (across @ roots) * roots
    across = across / np.linalg.norm(across)
    ours = np.stack([across, np.cross(roots, across), roots])
    centre, target = points.mean(axis=0), scan.vertices.mean(axis=0)
    fits = []
    for degrees in TURNS:
        start = np.eye(4)
        start[:3, :3] = rigid_motion(angle=degrees, axis=turned[2])[:3, :3] @ turned.T @ ours
        start[:3, 3] = target - start[:3, :3] @ centre
        # Elsewhere, too few crowns lie near the scan.
        with contextlib.suppress(RegistrationError):
            near = _registered(points, scan, start, far=None)
            fits.append(_registered(points, scan, near.matrix, far=FAR))
    if not fits:
        raise CaseInputError(f"the {jaw} scan fits the {jaw} teeth nowhere (bite-scan-poor)")
    fits.sort(key=_quality)
    best = fits[0]
    is_symmetric = _is_symmetric(row, points, scan, best, across)
    if best.rms > MOST_ERROR or best.kept_fraction < LEAST_SHARE:
        raise CaseInputError(
            f"the {jaw} scan does not fit the {jaw} teeth (bite-scan-poor): "
            f"{best.kept_fraction:.0%} of the crowns lie on it, to {best.rms:.2f} mm; "
            f"{LEAST_SHARE:.0%} and {MOST_ERROR:g} mm are needed; check that upper and lower scan "
            "are not exchanged, and that the teeth are those of the CT"
        )
    places = carried(best.matrix, points)
    for other in fits[1:]:
        apart = np.linalg.norm(carried(other.matrix, points) - places, axis=1).max()
        if apart > OTHER and _quality(other) < CLEARER * _quality(best):
            raise CaseInputError(
                f"the {jaw} scan fits the {jaw} teeth in two ways (bite-scan-ambiguous), to "
                f"{best.rms:.2f} and {other.rms:.2f} mm: give scans of the whole row"
            )
    return best, is_symmetric


def _is_symmetric(
    row: ToothRow, points: Floats, scan: SurfaceData, best: IcpFit, across: Floats
) -> bool:
    """Whether mirrored crowns fit a scan about as well; an error where they fit clearly better.

    A file that a program has mirrored without turning its triangles has its inside outwards.
    """
    own = row.surface.searched.closest(points)[1] @ best.matrix[:3, :3].T
    facing = (scan.searched.closest(carried(best.matrix, points))[1] * own).sum(axis=1)
    is_inside_out = float(np.median(facing)) < 0.0
    mirror = points - 2.0 * ((points - row.arch.middle) @ across)[:, None] * across
    quality = np.inf
    with contextlib.suppress(RegistrationError):
        near = _registered(mirror, scan, best.matrix, far=None)
        quality = _quality(_registered(mirror, scan, near.matrix, far=FAR))
    if is_inside_out or CLEARER * quality < _quality(best):
        why = "its triangles face inwards" if is_inside_out else "its mirror image fits better"
        raise CaseInputError(
            f"the {row.arch.jaw} scan seems to be mirrored (bite-scan-mirrored): {why}, and left "
            "would be right in the bite; export it again, without any mirroring or change of axes"
        )
    return quality < CLEARER * _quality(best)


def _registered(points: Floats, scan: SurfaceData, initial: Floats, far: float | None) -> IcpFit:
    """The motion of points onto a scan; pairs on its border count only where none are too far."""
    return icp(
        points,
        scan.searched,
        initial=initial,
        trim=TRIM,
        method="plane",
        max_iterations=STEPS,
        tolerance=1e-9,
        max_distance=far,
        max_angle=None,
        keep_border=far is None,
        normals=None,
    )


def _quality(fit: IcpFit) -> float:
    """The error of a fit, mm, larger where fewer crowns lie on the scan."""
    return fit.rms / max(fit.kept_fraction, 1e-3) ** 2


def _spread(points: Floats) -> float:
    return float(np.linalg.norm(points.std(axis=0)))


def _frame(points: Floats, out: Floats) -> Floats:
    """Unit vectors of a horseshoe of points, as rows: two in its plane, and one along `out`."""
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    normal = along[2] * np.sign(along[2] @ out)
    return np.stack([along[0], np.cross(normal, along[0]), normal])
