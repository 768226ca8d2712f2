"""Regions of the face, placed from the landmarks of the skin, and the partners of its vertices."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, ThinPlateSpline
from cmfsim.errors import LandmarkInputError
from cmfsim.surfaces.depth import barycentric
from cmfsim.surfaces.topology import edges_of
from cmfsim.values.checks import Floats, as_floats, as_rows
from cmfsim.values.landmark_sites import SKIN_LANDMARKS
from cmfsim.values.surface_data import SurfaceData, used_nodes, vertex_areas

# Left and up in the view from the front, mm.
Place = tuple[float, float]

PAIRS = ("exocanthion", "endocanthion", "alare", "cheilion")
REGIONS: Mapping[str, str] = MappingProxyType(
    {
        "face": "from the brow to below the chin, slightly wider than the eyes",
        "lower face": "the part of the face below the lower eyelids: what the jaws move, "
        "without the eyes",
        "nose": "from nasion to subnasale, with the wings",
        "upper lip": "from subnasale to the line of the mouth, between its corners",
        "lower lip": "from the line of the mouth half way down to pogonion",
        "chin": "from there to below pogonion",
        "left cheek": "from below the eye to the height of the lower lip, beside nose and mouth",
        "right cheek": "its mirror image",
    }
)
# Proportions, each a factor on a distance between landmarks (no unit). They put the borders into
# folds of the two heads that they were looked at on: an adult male and a phantom.
NOSE_WIDTH = 1.2  # of the wings, on the distance of alare from the midline
NOSE_ROOT = 0.7  # of the root, on the same
LID = 0.35  # of the way down from the eyes to subnasale the cheek begins
FOLD = 0.5  # of the way down from labiale inferius to pogonion the chin begins
CHIN = 0.75  # the chin ends this far below pogonion, on labiale inferius to pogonion
CHIN_WIDTH = 0.9  # on the distance of cheilion from the midline
SIDE = 1.15  # the face ends at the side, on the distance of exocanthion from the midline
BROW = 0.5  # the face begins this far above the eyes, on eyes to subnasale
FOREHEAD = (0.75, 1.4)  # its lower and upper end above the eyes, on eyes to subnasale
TEMPLE = (0.1, 1.1)  # the same of the temples
TEMPLE_WIDTH = 1.7  # they end at the side, on the distance of exocanthion from the midline
DEPTH = 1.0  # and reaches this far behind cheilion, on exocanthion from the midline


def skin_regions(
    points: ArrayLike, landmarks: Mapping[str, ArrayLike]
) -> dict[str, NDArray[np.bool_]]:
    """Which points of a skin lie in each region of the face.

    Parameters
    ----------
    points : (n, 3) float64, mm
        Vertices of a skin, in any frame.
    landmarks : mapping of str to (3,) float64, mm
        The fourteen of `SKIN_LANDMARKS` on the same skin; others are ignored.

    Returns
    -------
    dict of str to (n,) bool
        "face", "lower face", "nose", "upper lip", "lower lip", "chin", "left cheek", "right cheek".
        All but the first two are disjoint.

    Raises
    ------
    LandmarkError
        (also `ValueError`) A landmark is missing, or they do not look like a face: left and right
        exchanged, eyes below the mouth, no width.

    Notes
    -----
    Regions are outlines in the view from the front along the head's own axes: left from the mean of
    right to left landmarks, up from mouth to eyes at a right angle to it.

    Examples
    --------
    >>> import cmfsim
    >>> regions = cmfsim.skin_regions(skin.vertices, skin_landmarks)
    >>> bool(regions["chin"].any())
    True
    """
    return _regions(points, landmarks, _outlines)


def unmoved_regions(
    points: ArrayLike, landmarks: Mapping[str, ArrayLike]
) -> dict[str, NDArray[np.bool_]]:
    """The points of a skin in regions that operations on the jaws do not move.

    Parameters
    ----------
    points : (n, 3) float64, mm
    landmarks : mapping of str to (3,) float64, mm
        As `skin_regions` takes them.

    Returns
    -------
    dict of str to (n,) bool
        "forehead", "left temple", "right temple", disjoint from each other and from the face.

    Raises
    ------
    LandmarkError
        (also `ValueError`) As `skin_regions`.

    Examples
    --------
    >>> import cmfsim
    >>> regions = cmfsim.unmoved_regions(skin.vertices, skin_landmarks)
    """
    return _regions(points, landmarks, _unmoved_outlines)


def _regions(
    points: ArrayLike,
    landmarks: Mapping[str, ArrayLike],
    outlines: Callable[[Mapping[str, Floats]], dict[str, list[Place]]],
) -> dict[str, NDArray[np.bool_]]:
    """The points within each outline in the view from the front."""
    missing = [name for name in SKIN_LANDMARKS if name not in landmarks]
    if missing:
        raise LandmarkInputError(
            f"landmarks lack {', '.join(missing)}: regions of the face are placed from "
            f"{', '.join(SKIN_LANDMARKS)}"
        )
    named = {name: as_floats(f"landmark {name}", landmarks[name]) for name in SKIN_LANDMARKS}
    for name, place in named.items():
        if place.shape != (3,):
            raise LandmarkInputError(f"landmark {name} has shape {place.shape}: (3,) is needed")
    origin, axes = _face_frame(named)
    at = {name: axes @ (place - origin) for name, place in named.items()}
    _check_face(at)
    left, up, front = axes @ (as_rows("points", points, 3) - origin).T
    view = np.stack([left, up], axis=1)
    reach = DEPTH * 0.5 * (at["exocanthion_L"][0] - at["exocanthion_R"][0])
    near = front > 0.5 * (at["cheilion_L"][2] + at["cheilion_R"][2]) - reach
    return {name: near & _inside(view, np.array(outline)) for name, outline in outlines(at).items()}


def _face_frame(named: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """The middle of the face, and the unit axes to its left, up and to the front as rows."""
    across = np.mean([named[f"{pair}_L"] - named[f"{pair}_R"] for pair in PAIRS], axis=0)
    middle = {p: 0.5 * (named[f"{p}_L"] + named[f"{p}_R"]) for p in PAIRS}
    rise = 0.5 * (middle["exocanthion"] + middle["endocanthion"]) - middle["cheilion"]
    width = float(np.linalg.norm(across))
    left = across / width if width > 0.0 else across
    rise = rise - (rise @ left) * left
    height = float(np.linalg.norm(rise))
    if width == 0.0 or height == 0.0:
        raise LandmarkInputError(
            f"the landmarks have a mean width of {width:g} mm and a height of {height:g} mm from "
            "mouth to eyes: they do not outline a face"
        )
    up = rise / height
    # The midline passes between all pairs.
    return np.mean(list(middle.values()), axis=0), np.array([left, up, np.cross(left, up)])


def _check_face(at: Mapping[str, Floats]) -> None:
    """Refuses landmarks whose order is no face's."""
    for pair in PAIRS:
        if at[f"{pair}_L"][0] <= at[f"{pair}_R"][0]:
            raise LandmarkInputError(
                f"{pair}_L lies to the right of {pair}_R: swap their names (left is the "
                "patient's left)"
            )
    order = ("nasion", "subnasale", "labiale_superius", "labiale_inferius", "pogonion")
    for above, below in itertools.pairwise(order):
        if at[above][1] <= at[below][1]:
            raise LandmarkInputError(
                f"{above} lies below {below}: check that the landmarks are in the frame of the "
                "skin, and that no names are swapped"
            )
    if at["pronasale"][2] <= 0.5 * (at["exocanthion_L"][2] + at["exocanthion_R"][2]):
        raise LandmarkInputError(
            "pronasale lies behind the eyes: left and right are swapped, or the frame is mirrored"
        )


def _outlines(at: Mapping[str, Floats]) -> dict[str, list[Place]]:
    """Each region's outline in the view from the front: (left, up), mm."""
    base_height, eyes = at["subnasale"][1], _eyes(at)
    lip, pogonion = at["labiale_inferius"][1], at["pogonion"][1]
    wings = 0.5 * (at["alare_L"][1] + at["alare_R"][1])
    fold = float(lip + FOLD * (pogonion - lip))
    bottom = float(pogonion + CHIN * (pogonion - lip))
    lid = float(eyes + LID * (base_height - eyes))
    brow = float(eyes - BROW * (base_height - eyes))
    root = _pair(at, "alare", NOSE_ROOT, float(at["nasion"][1]))
    wing = _pair(at, "alare", NOSE_WIDTH, float(wings + 0.4 * (wings - base_height)))
    base = _pair(at, "alare", NOSE_WIDTH, float(at["subnasale"][1]))
    cheilion = [at[f"cheilion_{side}"] for side in "LR"]
    corner = [(float(place[0]), float(place[1])) for place in cheilion]
    crease = _pair(at, "cheilion", CHIN_WIDTH, fold)
    chin = _pair(at, "cheilion", CHIN_WIDTH, bottom)
    left, right = (place[0] for place in _pair(at, "exocanthion", SIDE, 0.0))
    mouth = 0.5 * (at["labiale_superius"][:2] + at["labiale_inferius"][:2])
    line = (float(mouth[0]), float(mouth[1]))
    cheeks = [
        [_beside(root[k], wing[k], lid), wing[k], base[k], corner[k], crease[k]]
        + [(outer, fold), (outer, lid)]
        for k, outer in enumerate((left, right))
    ]
    return {
        "face": [(left, brow), (left, bottom), (right, bottom), (right, brow)],
        "lower face": [(left, lid), (left, bottom), (right, bottom), (right, lid)],
        "nose": [root[0], wing[0], base[0], base[1], wing[1], root[1]],
        "upper lip": [base[0], corner[0], line, corner[1], base[1]],
        "lower lip": [corner[0], crease[0], crease[1], corner[1], line],
        "chin": [crease[0], *chin, crease[1]],
        "left cheek": cheeks[0],
        "right cheek": cheeks[1],
    }


def _eyes(at: Mapping[str, Floats]) -> float:
    """The mean height of the corners of both eyes, mm."""
    corners = [at[f"{p}_{s}"][1] for p in ("exocanthion", "endocanthion") for s in "LR"]
    return float(np.mean(corners))


def _pair(at: Mapping[str, Floats], name: str, factor: float, height: float) -> list[Place]:
    """Left and right landmark of a name at a height, their distance from the midline scaled."""
    middle = at["subnasale"][0]
    return [(float(middle + factor * (at[f"{name}_{side}"][0] - middle)), height) for side in "LR"]


def _beside(root: Place, wing: Place, height: float) -> Place:
    """Where the side of the nose, from its root to its wing, has a height."""
    part = (height - wing[1]) / (root[1] - wing[1])
    return wing[0] + part * (root[0] - wing[0]), height


def _unmoved_outlines(at: Mapping[str, Floats]) -> dict[str, list[Place]]:
    """The outlines of forehead and temples in the view from the front: (left, up), mm.

    No operation on the jaws moves anything there: what differs has another cause.
    """
    middle, base = at["subnasale"][0], at["subnasale"][1]
    eyes = _eyes(at)
    left, right = (float(at[f"exocanthion_{side}"][0] - middle) for side in "LR")

    def box(inner: float, outer: float, heights: tuple[float, float]) -> list[Place]:
        low, high = (eyes + share * (eyes - base) for share in heights)
        near, far = middle + inner, middle + outer
        return [(near, low), (near, high), (far, high), (far, low)]

    return {
        "forehead": box(left, right, FOREHEAD),
        "left temple": box(SIDE * left, TEMPLE_WIDTH * left, TEMPLE),
        "right temple": box(SIDE * right, TEMPLE_WIDTH * right, TEMPLE),
    }


def _inside(view: Floats, outline: Floats | Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Which points lie in a polygon: an odd number of its edges runs to their left."""
    corners = np.asarray(outline, dtype=np.float64)
    odd = np.zeros(len(view), dtype=bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        # Half-open in height, so that neighbours share no point and lose none.
        spans = (view[:, 1] >= min(ay, by)) & (view[:, 1] < max(ay, by))
        if ay != by:
            odd ^= spans & (view[:, 0] < ax + (view[:, 1] - ay) * (bx - ax) / (by - ay))
    return odd


# A partner lies on the border if its distance from the border's edge, as a share of the height of
# its triangle, is below this: more than the rounding of a closest point at 1000 mm.
ON_EDGE = 1e-7
# Places in front of a vertex, mm, at which other skin covers it: the skin of closed lips touches or
# is a voxel apart, and no wall of tissue is thinner than a step.
IN_FRONT = (0.25, 1.0, 2.0, 3.0)


class Skin:
    """A surface ready to be searched, with the border that it may have."""

    def __init__(self, surface: SurfaceData | Surface) -> None:
        self.core = surface if isinstance(surface, Surface) else surface.searched
        self.vertices: Floats = self.core.vertices
        self.triangles: NDArray[np.int64] = self.core.triangles.astype(np.int64)
        border = np.sort(edges_of(self.triangles).border, axis=1)
        self._border_edges = np.sort(border @ np.array([len(self.vertices), 1]))
        self._on_border = np.zeros(len(self.vertices), dtype=bool)
        self._on_border[border] = True

    def vertex_areas(self) -> Floats:
        """A third of the area of the triangles round each vertex, (v,) mm²."""
        return vertex_areas(self.vertices, self.triangles)

    def covered(self) -> NDArray[np.bool_]:
        """Which vertices have other skin within 3 mm in front of them, such as between lips, (v,).

        No camera sees them, and the two surfaces of a scan are fused there.
        """
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        weighted = np.cross(b - a, c - a)
        normals = np.zeros_like(self.vertices)
        for axis in range(3):
            normals[:, axis] = np.bincount(
                self.triangles.ravel(),
                weights=np.repeat(weighted[:, axis], 3),
                minlength=len(self.vertices),
            )
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
        # Where the vertex itself is nearest to the farthest place, nothing stands between them.
        farthest = IN_FRONT[-1]
        places = self.vertices + farthest * normals
        nearest, outward, _ = self.core.closest(places)
        covered: NDArray[np.bool_] = ((places - nearest) * outward).sum(axis=1) < 0.0
        apart = np.linalg.norm(places - nearest, axis=1)
        doubtful = ~covered & (apart < (1.0 - ON_EDGE) * farthest)
        for distance in IN_FRONT[:-1]:
            asked = np.flatnonzero(doubtful & ~covered)
            places = self.vertices[asked] + distance * normals[asked]
            nearest, outward, _ = self.core.closest(places)
            covered[asked] = ((places - nearest) * outward).sum(axis=1) < 0.0
        return covered

    def part(self, chosen: NDArray[np.bool_]) -> "Skin | None":
        """The triangles all of whose vertices are chosen; None if there is none."""
        kept = self.triangles[chosen[self.triangles].all(axis=1)]
        if not len(kept):
            return None
        used, triangles = used_nodes(kept)
        return Skin(SurfaceData(self.vertices[used], triangles))

    def at_border(self, points: Floats, triangles: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Which points, each on the triangle named, lie on the border."""
        corners = self.triangles[triangles]
        near = np.zeros(len(points), dtype=bool)
        candidates = np.flatnonzero(self._on_border[corners].any(axis=1))
        if not len(candidates):
            return near
        corner = corners[candidates]
        weights = barycentric(self.vertices[corner], points[candidates])
        off = weights <= ON_EDGE
        single = off.sum(axis=1) >= 2
        at_vertex = single & self._on_border[corner[np.arange(len(corner)), weights.argmax(axis=1)]]
        on_edge = np.zeros(len(corner), dtype=bool)
        for opposite in range(3):
            ends = np.sort(np.delete(corner, opposite, axis=1), axis=1)
            key = ends @ np.array([len(self.vertices), 1])
            on_edge |= off[:, opposite] & np.isin(key, self._border_edges)
        near[candidates] = at_vertex | on_edge
        return near


@dataclass(frozen=True, eq=False)
class Matches:
    """Vertices of one skin, (k,), that were kept, with their partners (k, 3), mm, on another.

    signed: (k,), mm. Distance to the partner; negative where the vertex lies behind the other skin.
    n_border: Left out because the partner lies on the other skin's border.
    """

    vertices: NDArray[np.int64]
    partners: Floats
    signed: Floats
    n_border: int


def match_skins(
    skin: Skin, chosen: NDArray[np.bool_], other: Skin, *, warp: ThinPlateSpline | None
) -> Matches:
    """The partners of the chosen vertices on another skin.

    With a warp the partner is the point of the other skin closest to the warped vertex, else to the
    vertex itself. The distance is that of the unwarped vertex; its sign is the side of the other
    skin on which the vertex lies, seen from the place nearest to it: a partner further off may lie
    round a bend.
    """
    vertices = np.flatnonzero(chosen)
    places = skin.vertices[vertices]
    nearest, normals, triangles = other.core.closest(places)
    behind = ((places - nearest) * normals).sum(axis=1) < 0.0
    partners = nearest
    if warp is not None:
        partners, _, triangles = other.core.closest(warp(places))
    apart = np.linalg.norm(places - partners, axis=1)
    border = other.at_border(partners, triangles)
    signed = np.where(behind, -apart, apart)
    return Matches(vertices[~border], partners[~border], signed[~border], int(border.sum()))
