"""Heads of other shapes: a real head's surfaces under deformations that carry its landmarks along.

What is stated in mm or as a factor is that of the head itself: its occlusal plane, its own midline.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cmfsim import SurfaceData, _core
from cmfsim.values.landmark_sites import is_lower_site

Points = Mapping[str, np.ndarray]
Move = Callable[[np.ndarray], np.ndarray]
# Depth of the band in which what is below the bite begins to move, reach of a random bump, and size
# of all bumps together along an axis, mm.
BAND, BUMP_REACH, BUMPS = 6.0, 40.0, 3.0
# From the top of a joint down to the neck of the mandible, mm.
CONDYLE = 8.0
# The mandible as a whole against the upper jaw, from its joints on, mm.
JAW_SHIFTS = {
    "retrognathic, 10 mm": (0.0, 10.0, 0.0),
    "prognathic, 10 mm": (0.0, -10.0, 0.0),
    "mandible 10 mm aside": (10.0, 0.0, 0.0),
}


@dataclass(frozen=True, eq=False)
class KnownHead:
    """Surfaces of a head and its landmarks: `truth` of skull and skin."""

    bones: Mapping[str, SurfaceData]
    skin: SurfaceData
    truth: tuple[Points, Points]

    def moved(self, move: Move) -> "KnownHead":
        """The head with a motion of points applied to surfaces and landmarks alike."""
        skull, skin = ({n: move(p[None])[0] for n, p in sites.items()} for sites in self.truth)
        return replace(self.mapped(lambda s: replace(s, vertices=move(s.vertices))),
                       truth=(skull, skin))  # fmt: skip

    def mapped(self, change: Callable[[SurfaceData], SurfaceData]) -> "KnownHead":
        """The head with surfaces changed that its landmarks do not follow."""
        bones = {name: change(bone) for name, bone in self.bones.items()}
        return replace(self, bones=bones, skin=change(self.skin))


def warped(head: KnownHead) -> Iterator[tuple[str, KnownHead]]:
    """Heads of other shapes, sizes, poses and surfaces, by name."""
    skull = head.truth[0]
    bite = 0.5 * (skull["supradentale"] + skull["infradentale"])
    middle, brow = float(skull["nasion"][0]), float(skull["nasion"][2])

    def below(p: np.ndarray) -> np.ndarray:
        # Zero at the brow, and one at the bite.
        return np.asarray(np.clip((brow - p[:, 2:]) / (brow - bite[2]), 0.0, None))

    chin = bite[2] - float(skull["menton"][2])

    def side(p: np.ndarray) -> np.ndarray:
        return np.asarray(6.0 * np.clip((bite[2] + chin - p[:, 2:]) / (2.0 * chin), 0.0, 1.2))

    moves: dict[str, Move] = {
        "long face": lambda p: p + below(p) * [0.0, 0.0, -8.0],
        "short face": lambda p: p + below(p) * [0.0, 0.0, 7.0],
        "wide": lambda p: p + (p - [middle, 0.0, 0.0]) * [0.12, 0.0, 0.0],
        "narrow": lambda p: p + (p - [middle, 0.0, 0.0]) * [-0.12, 0.0, 0.0],
        "asymmetric, chin 6 mm aside": lambda p: p + side(p) * [1.0, 0.0, 0.0],
        "long skull": lambda p: p + (p - bite) * [-0.05, 0.10, 0.0],
        **{f"bumps, seed {s}": bumps(head, s) for s in (1, 2, 3)},
        **{
            f"size {size:g}, turned by {axis}": _turned(size, angles)
            for size, axis, angles in (
                (0.75, "30° to one side", (0.0, 0.0, 30.0)),
                (1.15, "30° forwards", (30.0, 0.0, 0.0)),
                (1.0, "25° backwards", (-25.0, 0.0, 0.0)),
            )
        },
    }
    for name, move in moves.items():
        yield name, head.moved(move)
    for name, shift in JAW_SHIFTS.items():
        yield name, with_jaw_shifted(head, shift)
    yield "bone 1 mm thicker", _thicker(head, 1.0)
    yield "bone 1 mm thinner", _thicker(head, -1.0)
    yield "rough by 0.7 mm", head.mapped(_rough)
    yield "3000 triangles each", head.mapped(lambda s: fewer(s, 3000))
    yield "10000 triangles each", head.mapped(lambda s: fewer(s, 10_000))
    behind = float(skull["supraglenoid_L"][1]) + 15.0
    yield "front half", head.mapped(lambda s: where(s, lambda p: p[:, 1] < behind))
    spine = float(skull["gonion_L"][1]) + 12.0
    yield (
        "no spine",
        head.mapped(lambda s: where(s, lambda p: (p[:, 2] > bite[2] + 15.0) | (p[:, 1] < spine))),
    )
    yield "holes", head.mapped(holed)


def with_jaw_shifted(head: KnownHead, shift: tuple[float, float, float]) -> KnownHead:
    """The head with its mandible displaced: teeth and body in whole, the joints where they are."""
    skull = head.truth[0]
    bite = 0.5 * (skull["supradentale"] + skull["infradentale"])
    joints = 0.5 * (skull["supraglenoid_L"] + skull["supraglenoid_R"])[2] - CONDYLE

    def bone(p: np.ndarray) -> np.ndarray:
        part = np.clip((joints - p[:, 2:]) / (joints - bite[2] - CONDYLE), 0.0, 1.0)
        return np.asarray(p + part**2 * (3.0 - 2.0 * part) * shift)

    def soft(p: np.ndarray) -> np.ndarray:
        return np.asarray(p + 1.0 / (1.0 + np.exp((p[:, 2:] - bite[2]) / BAND)) * shift)

    jaw, face = head.moved(bone), head.moved(soft)
    sites = {n: jaw.truth[0][n] if is_lower_site(n) else p for n, p in skull.items()}
    bones = {**head.bones, "mandible": jaw.bones["mandible"]}
    return KnownHead(bones, face.skin, (sites, face.truth[1]))


def _turned(size: float, angles: tuple[float, float, float]) -> Move:
    turn = size * Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return lambda p: np.asarray(p @ turn.T)


def bumps(head: KnownHead, seed: int) -> Move:
    """A smooth random deformation, at the skin of a given size along each axis."""
    rng = np.random.default_rng(seed)
    skin = head.skin.vertices
    centres, weights = skin[rng.integers(0, len(skin), 40)], rng.normal(0.0, 1.0, (40, 3))

    def shifts(points: np.ndarray) -> np.ndarray:
        total = np.zeros_like(points)
        for centre, weight in zip(centres, weights, strict=True):
            away = ((points - centre) ** 2).sum(axis=1) / (2.0 * BUMP_REACH**2)
            total += np.exp(-away)[:, None] * weight
        return total

    factor = BUMPS / np.sqrt((shifts(skin) ** 2).mean())
    return lambda points: np.asarray(points + factor * shifts(points))


def _normals(surface: SurfaceData) -> np.ndarray:
    corners = surface.vertices[surface.triangles.astype(np.int64)]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.zeros_like(surface.vertices)
    for corner in range(3):
        np.add.at(sums, surface.triangles[:, corner].astype(np.int64), flat)
    return np.asarray(sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12))


def _thicker(head: KnownHead, by: float) -> KnownHead:
    bones = {n: replace(b, vertices=b.vertices + by * _normals(b)) for n, b in head.bones.items()}
    return replace(head, bones=bones)


def _rough(surface: SurfaceData) -> SurfaceData:
    noise = np.random.default_rng(0).normal(0.0, 0.7, len(surface.vertices))
    return replace(surface, vertices=surface.vertices + noise[:, None] * _normals(surface))


def fewer(surface: SurfaceData, count: int) -> SurfaceData:
    """The surface with about so many triangles."""
    return SurfaceData(*_core.decimated(surface.vertices, surface.triangles, count))


def holed(surface: SurfaceData) -> SurfaceData:
    """The surface with 25 holes, 6 mm wide from the middle."""
    rng = np.random.default_rng(0)
    places = surface.vertices[rng.integers(0, len(surface.vertices), 25)]
    return where(surface, lambda p: (np.linalg.norm(p[:, None] - places, axis=2) > 6.0).all(axis=1))


def where(surface: SurfaceData, kept: Callable[[np.ndarray], np.ndarray]) -> SurfaceData:
    """The triangles all of whose vertices are kept."""
    inside = np.concatenate([kept(part) for part in np.array_split(surface.vertices, 8)])
    triangles = surface.triangles[inside[surface.triangles.astype(np.int64)].all(axis=1)]
    used, corners = np.unique(triangles, return_inverse=True)
    return SurfaceData(surface.vertices[used], corners.reshape(-1, 3).astype(np.uint32))
