"""Whether bones given before and after can be one bone that moved."""

from collections.abc import Iterator

import numpy as np

from cmfsim._core import rigid_fit
from cmfsim.doctor.evidence import Evidence, place_text
from cmfsim.doctor.surgery.operation import check_against_skin
from cmfsim.doctor.surgery.plan import FAR, TOO_FAR, check_tiny, check_turn
from cmfsim.errors import CmfsimError, RegistrationError
from cmfsim.surfaces.topology import edges_of
from cmfsim.values.checks import Floats
from cmfsim.values.clinical_motion import clinical_motion
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.surface_data import MovedSurface

# A bone whose vertices all move less than this was not moved, mm: rounding in a surface file.
STILL = 1e-4
# A motion that leaves less than this of its vertices' own, mm RMS, was computed, not measured.
COMPUTED = 1e-3
# A bone that is scaled by more than this was not measured alike: segmentation alone changes 1 %.
SCALED = 0.03
# Ratios of units that files are exchanged in: what is read as mm, and what it was.
UNIT_RATIOS = tuple(
    (one, other, ratio)
    for low, high, factor in (
        ("mm", "cm", 10.0), ("mm", "m", 1000.0), ("cm", "m", 100.0), ("mm", "inch", 25.4),
        ("cm", "inch", 2.54), ("mm", "um", 0.001),
    )
    for one, other, ratio in ((low, high, factor), (high, low, 1.0 / factor))
)  # fmt: skip
# How near a scale must be to such a ratio, and the scale below which nothing is left of a bone.
UNIT_TOLERANCE, LEAST_SCALE = 0.02, 0.01
# Cosine between an edge before and after the bone's own turn, on average: 1 of a rigid bone, above
# 0.9 with noise, 0 where vertices have nothing to do with one another.
ALONG = 0.5
# Where no vertex of any bone stays this near, mm, the scans may lie in two frames.
STAYS = 3.0
# Share of the vertices that rest where part of a bone does.
FEW = 0.05
# What is left of a motion if the bone is mirrored first, as a share of what is left if it is not.
MIRRORED = 0.1
# What is left where vertices cannot be followed.
BY_SHAPE = (
    "or give the post-operative bone with its own triangles, as segmented or remeshed: it is "
    "then registered by its shape (it moves rigidly, and a change of size is reported with its "
    "interval)"
)
# Vertices that a fit is made of.
SAMPLES = 5000


def check_moved(evidence: Evidence) -> Iterator[Finding]:
    """Findings about motions given by surfaces, vertex by vertex."""
    case = evidence.case
    least: dict[str, float] = {}
    for name in evidence.moved:
        yield from findings_at(case.where(f"plan.{name}"), _check_bone(evidence, name, least))
    others = set(evidence.bones) - set(case.plan) if case.surfaces is not None else {""}
    if least and not others and not case.osteotomies and min(least.values()) > STAYS:
        yield Finding(
            "moved-all",
            f"every bone moves: {', '.join(least)}, by {min(least.values()):.1f} mm at least",
            where=case.where("plan"),
        )


def _check_bone(evidence: Evidence, name: str, least: dict[str, float]) -> Iterator[Finding]:
    """Findings about one bone; how far nearly all of it moves, mm, is entered in `least`."""
    moved = evidence.moved[name]
    if isinstance(moved, CmfsimError):
        why = f"the motion of each vertex of {name} is unknown"
        yield Finding("moved-not-paired", str(moved), why=why)
        return
    if not isinstance(moved, MovedSurface):
        before, after = moved
        # The build finds its motion by its shape.
        yield Finding(
            "moved-remeshed",
            f"{name} has {len(after.triangles)} triangles after and {len(before.triangles)} "
            "before, or numbers them differently, so its rigid motion is found by its shape",
        )
        return
    here, there = moved.surface.vertices, moved.moved_vertices
    wrong = list(check_pairs(name, moved))
    # A bone of another size goes on, and must not go far.
    if all(finding.code == "moved-scaled" and finding.severity != "error" for finding in wrong):
        wrong += _check_distance(name, moved)
    yield from wrong
    if not any(finding.severity == "error" for finding in wrong):
        least[name] = float(np.quantile(np.linalg.norm(there - here, axis=1), FEW))
        yield from check_against_skin(evidence, name, here, there)


def check_pairs(name: str, moved: MovedSurface) -> Iterator[Finding]:
    """Whether both are one bone: of one size, with vertices that belong together, not mirrored.

    An achieved plan is asked the same where it follows a bone vertex by vertex.
    """
    here, there = moved.surface.vertices, moved.moved_vertices
    if _is_mirrored(here, there):
        yield Finding(
            "moved-not-paired",
            f"{name} is mirrored after the operation relative to before",
            why="no motion mirrors a bone: in one of the files, left and right or another axis "
            "are swapped",
            fix="export both in one frame (LPS or RAS)",
        )
        return
    scale, along = _edges(moved)
    if along < ALONG:
        yield Finding(
            "moved-not-paired",
            f"the edges of {name} have other directions after the operation (cosine {along:.2f} "
            "on average, not 1)",
            why="both files have the same number of vertices, but in a different order",
            fix=f"export the moved mesh without remeshing or sorting its vertices; {BY_SHAPE}",
        )
    elif abs(scale - 1.0) > SCALED:
        yield _scaled(name, scale)


def _scaled(name: str, scale: float) -> Finding:
    """An error where the size can only be another unit's, else a warning with the evidence."""
    unit = next(
        (
            (one, other)
            for one, other, ratio in UNIT_RATIOS
            if abs(scale / ratio - 1.0) < UNIT_TOLERANCE
        ),
        None,
    )
    what = (
        f"{name} is {scale:.3g} times as large after the operation as before (median of its edges)"
    )
    if unit is not None or scale < LEAST_SCALE:
        between = f": that is {unit[0]} read as {unit[1]}" if unit is not None else ""
        return Finding(
            "moved-scaled",
            f"{what}{between}",
            severity="error",
            why="bone does not grow during an operation: the files have different units, or one "
            "was scaled",
            fix="export both in the unit that the case states",
        )
    return Finding(
        "moved-scaled",
        f"{what}: not close to the ratio of any two units (2.54, 10, 25.4, 100, 1000)",
        severity="warning",
        why="bone does not grow during an operation, so the calibration or segmentation of the "
        f"scans differs by {abs(scale - 1.0):.1%}; where the shape differs as well, each vertex is "
        "followed, and the difference counts as motion",
        fix="check the voxel sizes of both scans and the thresholds of both segmentations, and "
        f"measure again; {BY_SHAPE}",
    )


def _edges(moved: MovedSurface) -> tuple[float, float]:
    """How much longer edges are after, and the cosine between before and after, less the turn."""
    here, there = moved.surface.vertices, moved.moved_vertices
    ends = edges_of(moved.surface.triangles.astype(np.int64)).ends
    try:
        turn = rigid_fit(here, there).matrix[:3, :3]
    except RegistrationError:
        # All in one place after: as small as can be.
        return 0.0, 1.0
    before = (here[ends[:, 1]] - here[ends[:, 0]]) @ turn.T
    after = there[ends[:, 1]] - there[ends[:, 0]]
    one, other = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    some = (one > 0.0) & (other > 0.0)
    if not some.any():
        return 0.0, 1.0
    cosine = (before[some] * after[some]).sum(axis=1) / (one[some] * other[some])
    return float(np.median(other[some] / one[some])), float(cosine.mean())


def _is_mirrored(here: Floats, there: Floats) -> bool:
    step = -(-len(here) // SAMPLES)
    here, there = here[::step], there[::step]
    try:
        kept = float(rigid_fit(here, there).rms)
        mirrored = float(rigid_fit(here * [-1.0, 1.0, 1.0], there).rms)
    except RegistrationError:
        return False
    return kept > STAYS and mirrored < MIRRORED * kept


def _check_distance(name: str, motion: MovedSurface) -> Iterator[Finding]:
    """Whether the bone moves as far, and turns as far, as bone is moved."""
    surface, there = motion.surface, motion.moved_vertices
    here = surface.vertices
    moved = np.linalg.norm(there - here, axis=1)
    worst = int(np.argmax(moved))
    if moved[worst] < STILL:
        yield Finding(
            "plan-still",
            f"{name} moves by {moved[worst]:.2g} mm at most",
            why="the plan does not move this segment",
            fix="check that the file is the bone after the operation; otherwise remove it",
        )
        return
    if moved[worst] > FAR:
        turned = np.linalg.norm(here * [-1.0, -1.0, 1.0] - there, axis=1).max() < moved[worst]
        yield Finding(
            "plan-far",
            f"{name} moves by up to {moved[worst]:.1f} mm, at {place_text(here[worst])}",
            severity="error" if moved[worst] > TOO_FAR else "warning",
            fix="one file is in LPS and the other in RAS: export both in one frame"
            if turned
            else "register the post-operative scan to the pre-operative one on the skull, and "
            "check that both files number their vertices in the same order",
            facts={"most": FAR},
        )
        # What flies off may turn as well: one reason is enough.
        return
    fit = clinical_motion(name, MovedSurface(surface, there))
    angle = float(np.linalg.norm([fit.pitch, fit.yaw, fit.roll]))
    yield from check_turn(name, angle)
    # A measured turn may be as small as it likes.
    computed = fit.residual is not None and fit.residual < COMPUTED
    yield from check_tiny(name, float(moved[worst]), angle if computed else 0.0)
