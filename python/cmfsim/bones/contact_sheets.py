"""The labial and buccal sheet of a dental arch: a wall for the lips, or what tissue slides on.

Soft tissue bridges the gaps between teeth and their incisal edges. The sheet follows gums and
crowns, bridges the gaps, is smooth at the scale of the tissue's tets, and is extended past the edge
in the direction of the labial face, so that no node slides around it.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim import _core
from cmfsim.errors import CaseInputError, third_party
from cmfsim.surfaces.levels import SurfaceOptions, block_of, surface_of_level
from cmfsim.values.anatomy import SHEET_DEPTH, DentalArch
from cmfsim.values.checks import Floats, as_positive, as_rows
from cmfsim.values.image_data import ImageData
from cmfsim.values.surface_data import SurfaceData

Mask = NDArray[np.bool_]

# Grid that the sheet is made on, mm.
SPACING = 1.0
# Decimals of coordinates, mm, on which voxels may depend: later ones are rounding, which differs
# from one processor to the next, and a surface on grid points would move with it by a voxel.
DECIMALS = 6
# Half the width of the gaps between teeth that are bridged, and of those of lost teeth, mm.
BRIDGE = 3.0
LOST_TOOTH = 6.0
# Height of the crowns over which lost teeth are bridged, mm.
CROWN = 6.0
# How far above the edges the face of the crowns is continued from: below, they round off; mm.
ROUNDED = 2.5
# How far the sheet goes on past the edges, mm, and over which length its slope dies away.
BEYOND = 10.0
SLOPE_LENGTH = 4.0
# Height over which the slope of the labial face is measured, mm, and the largest that is continued:
# 20°.
SLOPE_BASE = 3.0
MOST_SLOPE = 0.36
# How much the sheet narrows backwards at most, mm per mm: behind the teeth by 20°, and from so far
# above their edges by 45°, where the bone draws in behind the zygomatic process; mm.
TAPER, STEEP_TAPER = 0.36, 1.0
TAPERED, STEEP = 8.0, 14.0
# Half the length of a second molar, and room, mm: further back a lower jaw rises.
BEHIND_TEETH = 8.0
# The grid beyond the arch and its vestibule, mm: to the roots, and in front and at the sides.
ROOM = 14.0
# The edges of the teeth lie at most at this share of the distance from the arch to the other one.
MOST_EDGE = 0.65
# Sectors of the arch in which the edge of the teeth is searched for.
SECTORS = 16
# Largest turn of the occlusal direction against the landmarks', cosine: 20°.
LEAST_AGREEMENT = 0.94
# Standard deviations of the Gaussian that rounds the sheet, mm: the first that keeps the bound.
RELIEFS = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)


@dataclass(frozen=True)
class SheetOptions:
    """Options of a contact sheet.

    Attributes
    ----------
    radius : float, mm
        Least radius of curvature where tissue slides: half an edge of its tets.
    above : float, mm
        How far above the arch, towards the roots, tissue slides on it.
    behind : float, mm
        How far behind the second molars.
    beside : float, mm
        How far lateral to them.
    """

    radius: float = 2.0
    above: float = 8.0
    behind: float = 15.0
    beside: float = 8.0

    def __post_init__(self) -> None:
        as_positive("radius of a contact sheet", self.radius)


@dataclass(frozen=True, eq=False)
class ContactSheet:
    """The contact sheet of an arch.

    Attributes
    ----------
    surface : SurfaceData
        Closed: the labial sheet, and behind it a back on which nothing slides. Outward normals, mm.
    relief : float, mm
        Standard deviation of the Gaussian that rounds it.
    radius : float, mm
        Smallest radius of curvature where tissue slides: of the sheet, and where it is convex of
        the surface parallel to it and `SHEET_DEPTH` behind it, where nodes may lie that keep their
        gap. 0 where these would meet.
    """

    surface: SurfaceData
    relief: float
    radius: float


def contact_sheet(
    name: str, bone: ImageData, arch: DentalArch, options: SheetOptions | None = None
) -> ContactSheet:
    """The labial and buccal sheet of gums and crowns of an arch, continued past their edges.

    Parameters
    ----------
    name : str
        Of the bone, for messages.
    bone : ImageData
        Level of the bone that bears the arch, before it is cut, so that cuts leave no edges on the
        sheet; positive inside.
    arch : DentalArch
    options : SheetOptions, optional

    Raises
    ------
    CaseError
        (also `ValueError`) No bone at the arch; scipy or scikit-image is missing.

    Examples
    --------
    >>> import cmfsim
    >>> arches = cmfsim.dental_arches(anatomy, segments, landmarks)
    >>> sheet = cmfsim.contact_sheet(
    ...     "maxilla", anatomy.bones["cranium"], arches.by_jaw["upper"]
    ... )
    """
    options = options or SheetOptions()
    grid = _Grid(name, bone, arch, options)
    solid = _extended(grid, _filled(grid, _bridged(grid.inside, BRIDGE)))
    depth = _depth(np.pad(solid, grid.margin), np.pad(grid.near(), grid.margin, mode="edge"))
    smoothing = _ndimage()
    for relief in RELIEFS:
        level = smoothing.gaussian_filter(depth, relief / SPACING, mode="nearest", truncate=4.0)
        radius = _smallest_radius(level, grid.zone())
        if radius >= options.radius:
            break
    image = ImageData(level.astype(np.float32), (SPACING,) * 3, grid.low - grid.margin * SPACING)
    made = surface_of_level(
        f"contact of {name}", image, SurfaceOptions(max_triangles=200_000, smoothing=0)
    )
    points = grid.origin + made.vertices @ grid.axes
    triangles = made.triangles
    if np.linalg.det(grid.axes) < 0.0:
        triangles = triangles[:, ::-1]
    return ContactSheet(SurfaceData(points, triangles), relief, radius)


def sheet_departure(
    sheet: SurfaceData, bone: SurfaceData, nodes: ArrayLike
) -> tuple[float, float, float]:
    """How far a sheet lies from the bone where nodes slide: mean, 95th percentile and largest, mm.

    At the bone's points closest to the nodes, (n, 3) mm; all 0 where no node is given.
    """
    points = as_rows("nodes", nodes, 3)
    if not len(points):
        return 0.0, 0.0, 0.0
    on_bone, _, _ = bone.searched.closest(points)
    on_sheet, _, _ = sheet.searched.closest(on_bone)
    away = np.linalg.norm(on_sheet - on_bone, axis=1)
    return float(away.mean()), float(np.percentile(away, 95.0)), float(away.max())


class _Grid:
    """A grid along an arch: to the left, ahead, and from roots to bite, 0 at the edges of teeth."""

    def __init__(self, name: str, bone: ImageData, arch: DentalArch, options: SheetOptions) -> None:
        across, forwards, out = arch.axes()
        self.name, self.arch, self.options = name, arch, options
        self.axes: Floats = _frame(across, forwards, -out)
        self.origin: Floats = arch.middle
        tip = self._place(arch.tip)
        side = arch.half_width + options.beside + ROOM
        self.low = np.array([-side, -options.behind - ROOM, -options.above - ROOM + min(tip[2], 0)])
        self.high = np.array([side, tip[1] + ROOM, max(arch.depth_front, arch.depth_molars) + 5.0])
        self._sample(bone)
        edge, normal = self._edges(tip)
        # Again along the teeth themselves.
        self.axes = _frame(across, forwards, normal)
        shift = float(self.axes[2] @ (edge - self.origin))
        self.origin = self.origin + shift * self.axes[2]
        self.tip: Floats = self._place(arch.tip)
        self.low[2] = np.round(-shift - options.above - ROOM + min(tip[2], 0), DECIMALS)
        self.high[2] = BEYOND
        self._sample(bone)
        self.margin = 3

    def _place(self, point: Floats) -> Floats:
        """The coordinates on the grid of a point in space."""
        return np.round(self.axes @ (point - self.origin), DECIMALS)

    def _sample(self, bone: ImageData) -> None:
        self.lines = [
            low + SPACING * np.arange(int(np.ceil((high - low) / SPACING)) + 1)
            for low, high in zip(self.low, self.high, strict=True)
        ]
        self.shape = tuple(len(line) for line in self.lines)
        world = np.empty((*self.shape, 3))
        held = np.ones(self.shape, dtype=bool)
        for axis, coordinate in enumerate(np.moveaxis(world, 3, 0)):
            s, a, v = (
                line * part for line, part in zip(self.lines, self.axes[:, axis], strict=True)
            )
            columns = self.origin[axis] + s[:, None] + a
            np.round(columns[:, :, None] + v, DECIMALS, out=coordinate)
            # What the image does not hold is no bone, however its border is coloured.
            held &= (coordinate >= bone.lowest[axis]) & (coordinate <= bone.highest[axis])
        self.level = bone.sample(world.reshape(-1, 3)).reshape(self.shape)
        self.inside: Mask = (self.level > 0.0) & held

    def near(self) -> Floats:
        """Distance from the surface of the bone, mm, where it is known better than by voxels."""
        slope = np.sqrt(sum(np.square(g) for g in np.gradient(self.level, SPACING)))
        # Away from the surface the level is clipped and has no slope.
        near: Floats = self.level / np.maximum(slope, 1e-3)
        return near

    def _edges(self, tip: Floats) -> tuple[Floats, Floats]:
        """A point on the plane of the teeth's edges and the unit normal past them, in space."""
        s, a, v = np.meshgrid(*self.lines, indexing="ij", sparse=True)
        # Where the arch's own line lies at each depth ahead, and how far on the teeth may end.
        share = np.clip(a / max(float(tip[1]), 1.0), 0.0, 1.0)
        line = share * tip[2]
        reach = MOST_EDGE * (
            self.arch.depth_molars + share * (self.arch.depth_front - self.arch.depth_molars)
        )
        near = (v > line - 3.0) & (v <= line + reach) & (a >= -5.0) & (a <= tip[1] + 8.0)
        near = near & (np.abs(s) <= self.arch.half_width + self.options.beside)
        place = np.argwhere(self.inside & near)
        if len(place) < 10:
            raise CaseInputError(
                f"{self.name!r}: no bone within {self.options.beside:g} mm of the {self.arch.jaw} "
                "arch: check its landmarks; or, without contact of the lips, set contact_surface = "
                '"bone" in [node_kinds]'
            )
        points = self.low + SPACING * place
        angle = np.arctan2(points[:, 1] + 5.0, points[:, 0])
        sector = np.clip((angle / np.pi * SECTORS).astype(int), 0, SECTORS - 1)
        ends = []
        for number in range(SECTORS):
            mine = points[sector == number]
            if len(mine) < 5:
                continue
            # Not the very last voxels: they may be noise.
            order = np.argsort(mine[:, 2], kind="stable")[-5:]
            ends.append(mine[order].mean(axis=0))
        found = np.array(ends)
        plane = _plane(found) if len(found) >= 4 else None
        if plane is None:
            plane = np.array([0.0, 0.0, float(np.median(found[:, 2]))])
        normal = np.array([-plane[0], -plane[1], 1.0])
        normal /= np.linalg.norm(normal)
        if normal[2] < LEAST_AGREEMENT:
            normal = np.array([0.0, 0.0, 1.0])
            plane = np.array([0.0, 0.0, float(np.median(found[:, 2]))])
        centre = found.mean(axis=0)
        centre[2] = plane[:2] @ centre[:2] + plane[2]
        return self.origin + centre @ self.axes, (normal @ self.axes)

    def at(self, axis: int, value: float) -> int:
        """The index of the grid line nearest to a coordinate."""
        index = round((value - float(self.low[axis])) / SPACING)
        return int(np.clip(index, 0, self.shape[axis] - 1))

    def beside(self, across: Floats) -> Mask:
        """Whether lateral coordinates lie at the arch and not on the zygoma."""
        return np.abs(across) <= self.arch.half_width + self.options.beside

    def zone(self) -> Mask:
        """Where tissue slides, on the grid with its margin."""
        s, a, v = np.meshgrid(*self.lines, indexing="ij", sparse=True)
        side = self.arch.half_width + self.options.beside
        roots = min(float(self.tip[2]), 0.0) - self.options.above
        zone = (np.abs(s) <= side) & (a >= -self.options.behind) & (v >= roots) & (v <= 4.0)
        return np.pad(np.broadcast_to(zone, self.shape), self.margin)


def _frame(across: Floats, forwards: Floats, past: Floats) -> Floats:
    """Rows: to the left, ahead, and `past`, at right angles; a mirrored frame in a lower jaw."""
    past = past / np.linalg.norm(past)
    left = across - (across @ past) * past
    left = left / np.linalg.norm(left)
    across_both = np.cross(past, left)
    return np.stack([left, across_both * np.sign(across_both @ forwards), past])


def _plane(points: Floats) -> Floats | None:
    """Slopes and height of v = p s + q a + r with the least sum of absolute distances."""
    rows = np.column_stack([points[:, :2], np.ones(len(points))])
    if np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)[1] < 10.0:
        return None
    weight = np.ones(len(points))
    for _ in range(20):
        root = np.sqrt(weight)
        plane = np.linalg.lstsq(rows * root[:, None], points[:, 2] * root, rcond=None)[0]
        weight = 1.0 / np.maximum(np.abs(points[:, 2] - rows @ plane), 0.5)
    return cast("Floats", plane)


def _bridged(solid: Mask, radius: float) -> Mask:
    """The closing of a solid by a ball."""
    rim = int(np.ceil(radius / SPACING)) + 2
    wide = np.pad(solid, rim, mode="edge")
    grown = _core.distance_image(wide, (SPACING,) * 3) <= radius
    kept = _core.distance_image(~grown, (SPACING,) * 3) > radius
    inner = tuple(slice(rim, -rim) for _ in range(3))
    return kept[inner] | solid


def _filled(grid: _Grid, solid: Mask) -> Mask:
    """The solid with what lies between it and the middle of the arch, and behind it.

    Backwards it narrows gently, so that the sheet goes on behind the last tooth and turns round the
    tuberosity without a crease before the pterygoid process.
    """
    s, ahead, height = grid.lines
    taper = np.interp(-height, (TAPERED, STEEP), (TAPER, STEEP_TAPER)) * ahead[:, None]
    near = solid & grid.beside(s)[:, None, None]
    filled = solid.copy()
    for side, distance in ((s >= 0.0, s), (s <= 0.0, -s)):
        # Of each row, the outermost bone; of all rows ahead, what they leave of it.
        outer = np.where(near[side], distance[side][:, None, None], -np.inf).max(axis=0)
        leaning = outer - taper
        width = np.maximum.accumulate(leaning[::-1], axis=0)[::-1] + taper
        filled[side] |= distance[side][:, None, None] <= width
    return filled


def _extended(grid: _Grid, solid: Mask) -> Mask:
    """The solid continued past the edges, from its outline above them, along its own slope."""
    ndimage = _ndimage()
    last, base = grid.at(2, -ROUNDED), round(SLOPE_BASE / SPACING)
    inner = grid.beside(grid.lines[0])
    solid = solid.copy()
    # Lost teeth are bridged in each slice of the crowns, as far as the arch is wide.
    for k in range(grid.at(2, -ROUNDED - CROWN), last + 1):
        solid[inner, :, k] |= _closed_slice(solid[inner, :, k], LOST_TOOTH)
    here, above = _signed_slice(solid[:, :, last]), _signed_slice(solid[:, :, last - base])
    slope = ndimage.gaussian_filter((here - above) / SLOPE_BASE, SLOPE_BASE / SPACING)
    slope = np.clip(slope, -MOST_SLOPE, MOST_SLOPE)
    # Behind the teeth of a lower jaw its ramus goes on.
    rows = grid.lines[1] >= (-BEHIND_TEETH if grid.arch.jaw == "lower" else -np.inf)
    extended = solid.copy()
    for k in range(last + 1, solid.shape[2]):
        past = SLOPE_LENGTH * (1.0 - np.exp((last - k) * SPACING / SLOPE_LENGTH))
        extended[:, rows, k] = (here + slope * past < 0.0)[:, rows]
    return extended


def _closed_slice(mask: Mask, radius: float) -> Mask:
    ndimage = _ndimage()
    rim = int(np.ceil(radius / SPACING)) + 2
    wide = np.pad(mask, rim)
    grown = ndimage.distance_transform_edt(~wide) * SPACING <= radius
    kept = ndimage.distance_transform_edt(grown) * SPACING > radius
    filled: Mask = kept[rim:-rim, rim:-rim] | mask
    return filled


def _signed_slice(mask: Mask) -> Floats:
    """Signed distance of a slice, mm, positive outside."""
    ndimage = _ndimage()
    if not mask.any() or mask.all():
        return np.full(mask.shape, -99.0 if mask.any() else 99.0)
    outside = ndimage.distance_transform_edt(~mask)
    inside = ndimage.distance_transform_edt(mask)
    half = 0.5
    level: Floats = np.where(mask, half - inside, outside - half) * SPACING
    return level


def _depth(solid: Mask, near: Floats) -> NDArray[np.float32]:
    """Signed distance from the surface of a solid, mm, positive inside.

    From the nearest voxel of the other side, and from there, by half a voxel, or as far as it lies
    from the bone's own surface (`near`, positive inside) where that surface is the solid's.
    """
    ndimage = _ndimage()
    depth = np.empty(solid.shape, dtype=np.float32)
    for side, sign in ((solid, 1.0), (~solid, -1.0)):
        distance, other = ndimage.distance_transform_edt(side, return_indices=True)
        beyond = -sign * near[tuple(along[side] for along in other)]
        rest = np.where((beyond >= 0.0) & (beyond <= SPACING), beyond, 0.5 * SPACING)
        depth[side] = sign * np.maximum(distance[side] * SPACING - rest, 0.0)
    return depth


def _smallest_radius(level: NDArray[Any], zone: Mask) -> float:
    """The smallest radius of curvature of the zero surface within a zone, mm.

    Where it is convex, of the surface `SHEET_DEPTH` behind it. Goldman (2005), "Curvature formulas
    for implicit curves and surfaces".
    """
    # Where neighbours differ in sign.
    sign = level > 0.0
    near = np.zeros(level.shape, dtype=bool)
    for axis in range(3):
        change = np.diff(sign, axis=axis)
        for part in (slice(None, -1), slice(1, None)):
            index = [slice(None)] * 3
            index[axis] = part
            near[tuple(index)] |= change
    near &= zone
    low, high = block_of(near)
    if not (high > low).all():
        return np.inf
    # Both derivatives reach two voxels.
    low, high = np.maximum(low - 2, 0), np.minimum(high + 2, near.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    level, near = level[box], near[box]
    first: list[Floats] = list(np.gradient(np.asarray(level, dtype=np.float64), SPACING))
    second: list[list[Floats]] = [list(np.gradient(g, SPACING)) for g in first]
    g = np.stack([d[near] for d in first], axis=-1)
    h = np.stack([np.stack([d[near] for d in row], axis=-1) for row in second], axis=-2)
    size = np.maximum(np.linalg.norm(g, axis=1), 1e-6)
    n = g / size[:, None]
    # The Hessian in the tangential plane, over the size of the gradient.
    tangential = np.eye(3) - n[:, :, None] * n[:, None, :]
    shape = tangential @ (h / size[:, None, None]) @ tangential
    shape = 0.5 * (shape + np.swapaxes(shape, 1, 2))
    bends = np.linalg.eigvalsh(shape)
    # The level falls off on all sides of what is convex.
    convex = 1.0 / max(float(-bends.min()), 1e-9) - SHEET_DEPTH
    concave = 1.0 / max(float(bends.max()), 1e-9)
    return max(min(convex, concave), 0.0)


def _ndimage() -> Any:
    return third_party("scipy.ndimage", "contact sheets are made", "imaging")
