"""Splints between two tooth rows: a horseshoe with the imprints of both, as a closed surface.

The splint is a level on a grid in the frame of the bite: a slab about the crowns, from which both
rows are taken away together with all that they pass when the splint is put on along the axis of
insertion, so that no undercut holds it. Its walls lie at right angles to the bite.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import signed_distance_image
from cmfsim.errors import CaseInputError, third_party
from cmfsim.meshing.levels import signed_level
from cmfsim.planning.occlusion.contacts import contact_map, signed_gaps
from cmfsim.planning.occlusion.rows import HALF_TOOTH, ToothRow, line_distance
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level
from cmfsim.values.checks import Floats, as_number
from cmfsim.values.image_data import ImageData
from cmfsim.values.motion import carried, rigid_motion
from cmfsim.values.surface_data import SurfaceData

# Walls, mm: printed resin breaks below the least; more than the most is no splint.
THICKNESS, LEAST_THICKNESS, MOST_THICKNESS = 2.0, 1.5, 6.0
# How far a splint reaches behind the hindmost cusp, mm: over the end of its tooth, with a wall.
BEHIND_CUSP = 6.0
# How far crowns reach into the splint, mm.
IMPRINT = 2.5
# Voxels, mm: cusps of 1 mm radius are then met to 0.02 mm.
SPACING = 0.3
# Overlap of planned rows above which the plan is wrong and no opening is proposed, mm.
MOST_OVERLAP = 3.0
# How far the lower jaw may be opened, degrees: beyond, the joint heads leave their sockets.
MOST_OPENING, OPENING_STEP = 15.0, 0.1
# Play of the imprints, and how deep teeth may lie inside the splint, mm.
PLAY, SEAT = 0.04, 0.1
# Radius of the ball that fits everywhere, mm: half the thinnest wall, and what a surface of voxels
# cuts off a ball.
BALL = 0.5 * LEAST_THICKNESS + 0.04
# Share of the largest piece below which another one is a crumb between teeth.
CRUMB = 0.01
NOTHING_LEFT = "nothing is left of the splint (splint-broken): the rows fill it"
# Letters of a label, mm: their size, how far they stand out, and the widest label.
LETTER, RAISED, WIDEST_LABEL = 6.0, 0.6, 28.0
MOST_TRIANGLES = 2_000_000
# Least size of a level, mm: vertices that are nearer to a voxel would coincide in single precision.
LEAST_LEVEL = 0.006


@dataclass(frozen=True, eq=False)
class Splint:
    """A splint, with what was measured of it.

    Attributes
    ----------
    surface : SurfaceData
        Closed, mm, where the upper row is planned.
    upper, lower : ToothRow
        The rows between which it lies.
    axis : (3,) float64
        Unit vector along which it is put on the upper teeth: from the bite to the upper roots.
    thickness : float, mm
        The least distance between the imprints of both rows.
    seat : float, mm
        How deep a crown lies inside the splint at most: teeth seat to this.
    opening : float, degrees
        By which the lower jaw is opened about its joint heads.
    first : str or None
        The jaw that is as planned while the other is as before the operation, "maxilla" or
        "mandible", of an intermediate splint of a case.
    plan_digits : str
        The digits of the plan that `predict` prints; of a splint of a case.
    """

    surface: SurfaceData
    upper: ToothRow
    lower: ToothRow
    axis: Floats
    thickness: float
    seat: float
    opening: float
    first: str | None = None
    plan_digits: str = ""


def splint_between(
    upper: ToothRow,
    lower: ToothRow,
    hinge: tuple[ArrayLike, ArrayLike],
    *,
    thickness: float = THICKNESS,
    opening: float = 0.0,
    label: str = "",
) -> Splint:
    """The splint that holds the rows of both jaws where they are.

    Parameters
    ----------
    upper, lower : ToothRow
        Moved as the splint is to hold them.
    hinge : ((3,), (3,)) float64, mm
        The joint heads, left and right, about which the lower jaw opens.
    thickness : float, mm
        Of every wall at least, from 1.5 to 6.
    opening : float, degrees
        By which the lower jaw is opened first, from 0 to 15.
    label : str
        Raised letters on the front.

    Raises
    ------
    CaseError
        (also `ValueError`) A jaw has no teeth; a label that is too long; rows that overlap, or that
        are so close that the splint would be thinner: with the opening that makes room.

    Examples
    --------
    >>> import cmfsim
    >>> upper, lower = cmfsim.tooth_rows(anatomy, segments, landmarks)
    >>> heads = (49.0, -11.0, -3.0), (-49.0, -11.0, -3.0)
    >>> splint = cmfsim.splint_between(upper, lower, heads, opening=6.0)  # doctest: +SKIP
    >>> splint.surface, splint.thickness  # doctest: +SKIP
    """
    _check_range("thickness", thickness, "mm", LEAST_THICKNESS, MOST_THICKNESS)
    _check_range("opening", opening, "°", 0.0, MOST_OPENING)
    outline = _outline(label) if label else None
    lower = lower.moved(_opened(hinge, opening))
    overlap = contact_map(upper, lower).greatest_overlap
    if overlap > MOST_OVERLAP:
        raise CaseInputError(
            f"the tooth rows overlap by {overlap:.1f} mm (splint-rows-overlap), {MOST_OVERLAP:g} "
            "mm are allowed: check the plan of both jaws (cmfsim doctor), or open the lower jaw"
        )
    frame = _bite_frame(upper, lower)
    grid, ends = _grid(upper, lower, frame, thickness)
    taken = _taken(upper, frame, grid, up=True), _taken(lower, frame, grid, up=False)
    lines = [carried(frame, row)[:, :2] for row in _cusps(upper, lower)]
    slab = _slab(grid, taken, lines, ends, thickness)
    upper_face, points = (_surface(grid.with_values(level)) for level in taken)
    near = points.vertices[grid.with_values(slab).sample(points.vertices) > 0.0]
    between = float(signed_gaps(near, upper_face).min(initial=MOST_THICKNESS))
    # The ball has to fit where it is looked for: in the middle of voxels.
    room = max(thickness + SPACING, LEAST_THICKNESS + 2.0 * SPACING)
    if between < room:
        axis = carried(frame, np.asarray(hinge, dtype=np.float64).reshape(2, 3))
        raise CaseInputError(
            f"the tooth rows leave {max(between, 0.0):.2f} mm between their biting faces "
            f"(splint-bite-closed), a splint of {thickness:g} mm needs {room:g} mm: "
            f"{_advice(near, upper_face, (axis[0], axis[1]), room, opening)}"
        )
    teeth = np.maximum(*taken)
    level = _without_thin(grid, np.minimum(slab, -teeth))
    if outline is not None:
        level = np.maximum(level, np.minimum(_letters(outline, grid, slab, ends), -teeth))
    made = _surface(grid.with_values(largest_piece(level)))
    back = np.asarray(np.linalg.inv(frame), dtype=np.float64)
    surface = SurfaceData(carried(back, made.vertices), made.triangles)
    seat = max(_depth(upper, surface), _depth(lower, surface))
    if seat > SEAT:
        raise CaseInputError(
            f"teeth would lie {seat:.2f} mm inside the splint (splint-seat), {SEAT:g} mm are "
            "allowed: check the surfaces of the bones for folds and holes at the teeth"
        )
    return Splint(surface, upper, lower, frame[2, :3].copy(), between, seat, opening)


def _check_range(name: str, value: float, unit: str, least: float, most: float) -> None:
    if not least <= as_number(name, value) <= most:
        raise CaseInputError(
            f"{name} is {value:g} {unit} (splint-{name}): {least:g} to {most:g} {unit} are allowed"
        )


def _opened(hinge: tuple[ArrayLike, ArrayLike], degrees: float) -> Floats:
    """The motion that opens the lower jaw about the axis through its joint heads."""
    left, right = (np.asarray(head, dtype=np.float64) for head in hinge)
    return rigid_motion(angle=degrees, axis=left - right, centre=0.5 * (left + right))


def _advice(
    near: Floats, upper: SurfaceData, hinge: tuple[Floats, Floats], thickness: float, opening: float
) -> str:
    """By how much the lower jaw has to be opened for points of its row to leave room."""
    # Points a few millimetres apart do not come closer.
    near = near[signed_gaps(near, upper) < thickness + 2.0]
    degrees = OPENING_STEP
    while opening + degrees <= MOST_OPENING:
        # A step more: undercuts change as the jaw turns.
        if signed_gaps(carried(_opened(hinge, degrees), near), upper).min() >= thickness:
            wide = opening + degrees + OPENING_STEP
            return f"open the lower jaw by {wide:.1f}° or more (--open {wide:.1f})"
        degrees += OPENING_STEP
    return f"no opening up to {MOST_OPENING:g}° makes room: check the plan of both jaws"


def _bite_frame(upper: ToothRow, lower: ToothRow) -> Floats:
    """The motion into the frame of the bite, (4, 4): left, back, and up to the upper roots.

    Up is normal to the plane through the cusps of both rows.
    """
    cusps = _cusps(upper, lower)
    places = np.concatenate(cusps)
    middle = places.mean(axis=0)
    # About each row's own middle: rows that are apart do not tilt the plane.
    flat = np.concatenate([row - row.mean(axis=0) for row in cusps])
    up = np.linalg.svd(flat, full_matrices=False)[2][2]
    up = up * np.sign(up @ (upper.arch.out - lower.arch.out))
    across = upper.arch.axes()[0] + lower.arch.axes()[0]
    left = across - (across @ up) * up
    left = left / np.linalg.norm(left)
    turn = np.stack([left, np.cross(up, left), up])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = turn, -turn @ middle
    return frame


def _cusps(upper: ToothRow, lower: ToothRow) -> tuple[Floats, Floats]:
    one, other = (row.surface.vertices[[*row.cusps.values()]] for row in (upper, lower))
    return one, other


def _grid(
    upper: ToothRow, lower: ToothRow, frame: Floats, thickness: float
) -> tuple[ImageData, tuple[float, float]]:
    """A grid about the splint, with the heights of its ends, mm."""
    top, bottom = (carried(frame, row) for row in _cusps(upper, lower))
    wall = thickness + 2.0 * SPACING
    high = max(top[:, 2].max() + IMPRINT, bottom[:, 2].max() + wall)
    low = min(bottom[:, 2].min() - IMPRINT, top[:, 2].min() - wall)
    crowns = np.concatenate([carried(frame, r.surface.vertices[r.crowns]) for r in (upper, lower)])
    rim = wall + 3.0 * SPACING
    lowest = np.array([*(crowns[:, :2].min(axis=0) - rim), low - 3.0 * SPACING])
    behind = max(top[:, 1].max(), bottom[:, 1].max()) + HALF_TOOTH
    highest = np.array([crowns[:, 0].max() + rim, behind + rim, high + 3.0 * SPACING])
    shape = np.ceil((highest - lowest) / SPACING).astype(int) + 1
    values = np.broadcast_to(np.float32(0.0), tuple(shape.tolist()))
    return ImageData(values, (SPACING,) * 3, lowest), (float(low), float(high))


def _taken(row: ToothRow, frame: Floats, grid: ImageData, *, up: bool) -> NDArray[np.float32]:
    """The level of a row and of all beyond it along the axis of insertion, mm near its surface."""
    surface = SurfaceData(carried(frame, row.surface.vertices), row.surface.triangles)
    values = 2.0 * SPACING * signed_level(surface, grid).single
    _hold(values, grid, surface.vertices[row.crowns])
    values += np.float32(PLAY)
    if up:
        return np.maximum.accumulate(values, axis=2)
    return np.ascontiguousarray(np.maximum.accumulate(values[:, :, ::-1], axis=2)[:, :, ::-1])


def _hold(values: NDArray[np.float32], grid: ImageData, points: Floats) -> None:
    """Raises a level at the corners of voxels that hold points outside it: narrow cusps."""
    missing = -grid.with_values(values).sample(points)
    narrow = missing > 0.0
    first = np.floor((points[narrow] - grid.lowest) / SPACING).astype(np.intp)
    raised = np.zeros_like(values)
    for corner in np.ndindex(2, 2, 2):
        at = first + corner
        inside = ((at >= 0) & (at < values.shape)).all(axis=1)
        x, y, z = at[inside].T
        np.maximum.at(raised, (x, y, z), np.float32(missing[narrow][inside]))
    values += raised


def _slab(
    grid: ImageData,
    taken: tuple[NDArray[np.float32], NDArray[np.float32]],
    lines: list[Floats],
    ends: tuple[float, float],
    thickness: float,
) -> NDArray[np.float32]:
    """The level of the horseshoe about the crowns, mm, before the teeth are taken away."""
    ndimage = third_party("scipy.ndimage", "splints are made", "imaging")
    low, high = ends
    _, y, z = grid.axes()
    top = int(np.searchsorted(z.ravel(), high))
    bottom = int(np.searchsorted(z.ravel(), low))
    slices = taken[0][:, :, top], taken[1][:, :, bottom]
    feet = [_feet(grid, level, line) for level, line in zip(slices, lines, strict=True)]
    wall = thickness + 2.0 * SPACING
    # From the middles of voxels inside: the crown's edge may lie a voxel further out.
    around = wall - ndimage.distance_transform_edt(~(feet[0] | feet[1]), sampling=SPACING)
    # Rows that are far apart leave no hole between them.
    holes = ndimage.binary_fill_holes(around > 0.0) & (around <= 0.0)
    # With their edges, which would be grooves.
    holes = ndimage.binary_dilation(holes, iterations=2)
    around[holes] = np.maximum(around[holes], SPACING)
    behind = max(line[:, 1].max() for line in lines) + BEHIND_CUSP
    round_crowns = np.minimum(around, behind - y[:, :, 0])[:, :, None]
    level = np.minimum(round_crowns, np.minimum(high - z, z - low))
    return np.asarray(level, dtype=np.float32)


def _feet(grid: ImageData, level: NDArray[np.float32], line: Floats) -> NDArray[np.bool_]:
    """Where the crowns of a row stand in an end of the splint, (nx, ny)."""
    x, y, _ = grid.axes()
    places = np.stack(np.broadcast_arrays(x[:, :, 0], y[:, :, 0]), axis=-1).reshape(-1, 2)
    beside: NDArray[np.bool_] = line_distance(places, line).reshape(level.shape) <= HALF_TOOTH
    return beside & (level > 0.0)


def _outline(text: str) -> Any:
    """The outline of letters, mm about their middle: a `matplotlib.path.Path`."""
    paths = third_party("matplotlib.textpath", "labels are drawn", "report")
    fonts = third_party("matplotlib.font_manager", "labels are drawn", "report")
    outlines = third_party("matplotlib.path", "labels are drawn", "report")
    font = fonts.FontProperties(weight="bold", size=LETTER)
    known = fonts.get_font(fonts.findfont(font)).get_charmap()
    if unknown := [letter for letter in text if ord(letter) not in known]:
        raise CaseInputError(
            f"label {text!r} has {unknown[0]!r} (splint-label), which would be an empty box: use "
            "letters and digits"
        )
    points, codes = paths.text_to_path.get_text_path(font, text, ismath=False)
    places = np.asarray(points, dtype=np.float64) * LETTER / paths.text_to_path.FONT_SCALE
    width = float(np.ptp(places[:, 0])) if len(places) else 0.0
    if not 0.0 < width <= WIDEST_LABEL:
        raise CaseInputError(
            f"label {text!r} is {width:.0f} mm wide (splint-label): up to {WIDEST_LABEL:g} mm fit "
            "the front; use fewer letters"
        )
    return outlines.Path(places - 0.5 * (places.min(axis=0) + places.max(axis=0)), codes)


def _letters(
    outline: Any, grid: ImageData, slab: NDArray[np.float32], ends: tuple[float, float]
) -> NDArray[np.float32]:
    """The level of letters that stand on the front of a slab, read from the patient's front."""
    ndimage = third_party("scipy.ndimage", "splints are made", "imaging")
    x, y, z = grid.axes()
    flat = np.stack(np.broadcast_arrays(x[:, 0, :], z[0] - 0.5 * sum(ends)), axis=-1)
    inside = outline.contains_points(flat.reshape(-1, 2))
    inside = inside.reshape(flat.shape[:2])
    stroke = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
    # The front of each column of voxels is the first that the slab has at mid-height.
    middle = slab[:, :, int(np.argmin(np.abs(z.ravel() - 0.5 * sum(ends))))]
    first = y.ravel()[np.argmax(middle > 0.0, axis=1)][:, None, None]
    raised = np.minimum(RAISED - np.abs(y - first), SPACING * stroke[:, None, :])
    raised = np.minimum(raised, np.minimum(ends[1] - z, z - ends[0]))
    return np.asarray(
        np.where(np.asarray((middle > 0.0).any(axis=1))[:, None, None], raised, -1.0), np.float32
    )


def _without_thin(grid: ImageData, level: NDArray[np.float32]) -> NDArray[np.float32]:
    """The level opened by a ball as thick as the thinnest wall: what such balls reach inside it.

    So edges are blunt, and no sheet is left where bone behind the molars grazes the splint.
    Distances are those from surfaces: from voxels they would be wrong by half a voxel.
    """
    core = _distances(grid, level) - np.float32(BALL)
    if not (core > 0.0).any():
        raise CaseInputError(NOTHING_LEFT)
    reach = _distances(grid, core) + np.float32(BALL)
    return np.asarray(np.minimum(level, reach), dtype=np.float32)


def _distances(grid: ImageData, level: NDArray[np.float32]) -> NDArray[np.float32]:
    """The distance from the zero surface of a level, mm, positive inside: up to twice a ball."""
    nx, ny, nz = grid.values.shape
    x, y, z = grid.lowest.tolist()
    return signed_distance_image(
        _surface(grid.with_values(level)).searched,
        (nx, ny, nz),
        (SPACING,) * 3,
        (x, y, z),
        band=2.0 * BALL,
    )


def largest_piece(level: NDArray[np.float32]) -> NDArray[np.float32]:
    """The level of the largest connected piece: crumbs between teeth are no part of a splint."""
    ndimage = third_party("scipy.ndimage", "splints are made", "imaging")
    labels, count = ndimage.label(level > 0.0)
    if not count:
        raise CaseInputError(NOTHING_LEFT)
    sizes = np.bincount(labels.ravel())[1:]
    largest = 1 + int(np.argmax(sizes))
    if (pieces := int((sizes > CRUMB * sizes.max()).sum())) > 1:
        raise CaseInputError(
            f"the splint falls into {pieces} pieces (splint-broken), because walls thinner than "
            f"{LEAST_THICKNESS:g} mm are removed: open the lower jaw further (--open), or give "
            "surfaces of the jaws with scanned teeth"
        )
    outside = np.float32(-SPACING)
    kept: NDArray[np.float32] = np.where((labels == largest) | (labels == 0), level, outside)
    least = np.where(kept > 0.0, np.float32(LEAST_LEVEL), -np.float32(LEAST_LEVEL))
    return np.where(np.abs(kept) < LEAST_LEVEL, least, kept)


def _surface(level: ImageData) -> SurfaceData:
    options = SurfaceOptions(max_triangles=MOST_TRIANGLES, smoothing=0)
    return surface_of_level("splint", level, options)


def _depth(row: ToothRow, splint: SurfaceData) -> float:
    """How deep crowns lie inside the splint at most, mm."""
    return max(0.0, -float(signed_gaps(row.surface.vertices[row.crowns], splint).min()))
