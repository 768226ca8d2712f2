"""A head of ellipsoids as a case on disk: clean, so that a test can put one defect into it."""

import dataclasses
import functools
from pathlib import Path

import numpy as np

import cmfsim

# Centre and half axes of each surface, mm, LPS: the face looks along −P.
ELLIPSOIDS = {
    "skin": ((3.0, -100.0, 1500.0), (80.0, 100.0, 125.0)),
    "cranium": ((3.0, -95.0, 1530.0), (62.0, 76.0, 60.0)),
    "mandible": ((3.0, -128.0, 1445.0), (38.0, 30.0, 18.0)),
}
# The bone that each skull landmark lies on, and a place near it (left side of pairs).
SKULL = {
    "supraglabella": ("cranium", (0, -180, 1555)),
    "glabella": ("cranium", (0, -182, 1545)),
    "nasion": ("cranium", (0, -184, 1535)),
    "supradentale": ("cranium", (0, -160, 1480)),
    "infradentale": ("mandible", (0, -162, 1456)),
    "pogonion": ("mandible", (0, -164, 1444)),
    "menton": ("mandible", (0, -150, 1425)),
}
SKULL_PAIRS = {
    "suborbital": ("cranium", (28, -170, 1510)),
    "supraorbital": ("cranium", (28, -174, 1550)),
    "supraglenoid": ("cranium", (65, -95, 1520)),
    "zygomatic_arch": ("cranium", (62, -120, 1515)),
    "supra_m2": ("cranium", (30, -145, 1480)),
    "gonion": ("mandible", (40, -112, 1440)),
    "occlusal_line": ("mandible", (38, -115, 1455)),
    "sub_m2": ("mandible", (34, -142, 1450)),
}
SKIN = {
    "nasion": (0, -198, 1530),
    "pronasale": (0, -210, 1500),
    "subnasale": (0, -200, 1488),
    "labiale_superius": (0, -197, 1474),
    "labiale_inferius": (0, -192, 1458),
    "pogonion": (0, -175, 1430),
}
SKIN_PAIRS = {
    "endocanthion": (16, -194, 1526),
    "exocanthion": (43, -175, 1525),
    "alare": (17, -197, 1493),
    "cheilion": (24, -185, 1465),
}

TOML = """format = "cmfsim-case"
version = 1
name = "ellipsoids"

[surfaces]
skin = "skin.ply"
units = "mm"
frame = "LPS"

[surfaces.bones]
cranium = "cranium.ply"
mandible = "mandible.ply"

[landmarks]
skull = "skull.mrk.json"
skin = "skin.mrk.json"

[mesh]
edge_length = 4.0

[plan.mandible]
translation = [0, -4, 1]
angle = 2
axis = [1, 0, 0]
centre = [3, -100, 1450]

[tissue]
preset = "kim2010"
"""


def icosphere(rounds=3):
    """The vertices and triangles of a unit sphere, outward: 20·4^rounds triangles."""
    golden = (1 + 5**0.5) / 2
    points = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    points += [(z, x, y) for x, y, z in points] + [(y, z, x) for x, y, z in points]
    vertices = np.array(points, dtype=float)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    # The hull of twelve points: each triple at the edge length from one another.
    near = np.linalg.norm(vertices[:, None] - vertices, axis=2) < 1.1
    triangles = np.array(
        [
            (a, b, c)
            for a in range(12)
            for b in range(a + 1, 12)
            for c in range(b + 1, 12)
            if near[a, b] and near[b, c] and near[a, c]
        ]
    )
    corners = vertices[triangles]
    inward = np.linalg.det(corners) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    for _ in range(rounds):
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, back = np.unique(edges, axis=0, return_inverse=True)
        middle = vertices[unique].mean(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        ab, bc, ca = (back.reshape(-1, 3) + len(vertices)).T
        a, b, c = triangles.T
        vertices = np.concatenate([vertices, middle])
        triangles = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return vertices, triangles


def ellipsoid(name, rounds=3):
    """The surface of one body of the head."""
    centre, axes = ELLIPSOIDS[name]
    vertices, triangles = icosphere(rounds)
    return cmfsim.SurfaceData(vertices * axes + centre, triangles)


def surfaces(rounds=3):
    """The surfaces of the head by name."""
    return {name: ellipsoid(name, rounds) for name in ELLIPSOIDS}


def landmarks(bodies):
    """The skull and skin landmarks, on their surfaces."""
    index = {n: cmfsim.Surface(s.vertices, s.triangles) for n, s in bodies.items()}

    def on(body, place):
        return index[body].closest([np.add(place, (ELLIPSOIDS["skin"][0][0], 0, 0))])[0][0]

    def both(label, body, place):
        mirrored = np.multiply(place, (-1, 1, 1))
        return {f"{label}_L": on(body, place), f"{label}_R": on(body, mirrored)}

    skull = {label: on(body, place) for label, (body, place) in SKULL.items()}
    for label, (body, place) in SKULL_PAIRS.items():
        skull |= both(label, body, place)
    skin = {label: on("skin", place) for label, place in SKIN.items()}
    for label, place in SKIN_PAIRS.items():
        skin |= both(label, "skin", place)
    return skull, skin


@functools.cache
def _parts(rounds):
    """What every head begins with, made once."""
    bodies = surfaces(rounds)
    return bodies, *landmarks(bodies)


class HeadCase:
    """The files of the case in memory; `write` puts them on disk."""

    def __init__(self, rounds=3):
        bodies, skull, skin = _parts(rounds)
        self.surfaces = dict(bodies)
        self.skull, self.skin = ({n: p.copy() for n, p in kind.items()} for kind in (skull, skin))
        self.toml = TOML

    def change(self, name, vertices=None, triangles=None):
        """Replaces vertices or triangles of a surface; functions are given the old ones."""
        surface = self.surfaces[name]
        old = np.array(surface.vertices), np.array(surface.triangles).astype(np.int64)
        self.surfaces[name] = dataclasses.replace(
            surface,
            vertices=old[0] if vertices is None else vertices(old[0]),
            triangles=old[1] if triangles is None else triangles(old[1]),
        )

    def replace(self, old, new):
        """Changes the text of the case file."""
        assert old in self.toml
        self.toml = self.toml.replace(old, new)

    def without_mouth(self):
        """The case without the landmarks of the lips, which many cases lack."""
        self.skin = {n: p for n, p in self.skin.items() if not n.startswith(("labiale", "cheil"))}
        return self

    def write_parts(self, folder: Path):
        """The surfaces and landmarks, without a case file."""
        for name, surface in self.surfaces.items():
            cmfsim.write_surface(folder / f"{name}.ply", surface)
        cmfsim.write_landmarks(folder / "skull.mrk.json", self.skull)
        cmfsim.write_landmarks(folder / "skin.mrk.json", self.skin)

    def write(self, folder: Path):
        """The path of the case file, with everything beside it."""
        self.write_parts(folder)
        path = folder / "case.toml"
        path.write_text(self.toml, encoding="utf-8")
        return path
