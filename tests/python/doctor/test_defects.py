"""Each defect of a case is found and said alone."""

import numpy as np
import pytest
from diagnosed_heads import HALF_TURN, diagnosis, scaled, serious

from cmfsim.surfaces.topology import edges_of
from head_case import HeadCase


def normalised(head):
    for name in ("skin", "cranium", "mandible"):
        head.change(name, vertices=lambda v: (v - [3, -100, 1500]) / 125.0)


def turned(head):
    for name in ("skin", "cranium", "mandible"):
        head.change(name, vertices=lambda v: v * HALF_TURN)


def swapped(labels, names=None):
    new = dict(labels)
    for name in names or [n[:-2] for n in labels if n.endswith("_L")]:
        new[f"{name}_L"], new[f"{name}_R"] = labels[f"{name}_R"], labels[f"{name}_L"]
    return new


def all_turned(head):
    turned(head)
    head.skull = {n: p * HALF_TURN for n, p in head.skull.items()}
    head.skin = {n: p * HALF_TURN for n, p in head.skin.items()}


def mirrored(head):
    for name in ("skin", "cranium", "mandible"):
        head.change(name, vertices=lambda v: v * [-1, 1, 1], triangles=lambda t: t[:, ::-1])
    head.skull = {n: p * [-1, 1, 1] for n, p in head.skull.items()}
    head.skin = {n: p * [-1, 1, 1] for n, p in head.skin.items()}


def inconsistent(triangles):
    triangles[:40] = triangles[:40, ::-1]
    return triangles


def folded(head):
    """Two neighbours on the skin that have changed places."""
    a, b = head.surfaces["skin"].triangles[0, :2]

    def swap(vertices):
        vertices[[a, b]] = vertices[[b, a]]
        return vertices

    head.change("skin", vertices=swap)


def with_debris(head, name):
    """A piece of its own in the free space under the cranium, with a fifth of a bone's size."""
    old = head.surfaces[name]
    centre = np.asarray(old.vertices).mean(axis=0)
    extra = (np.asarray(old.vertices) - centre) * 0.2 + [3, -60, 1440]
    head.change(
        name,
        vertices=lambda v: np.concatenate([v, extra]),
        triangles=lambda t: np.concatenate([t, t + len(extra)]),
    )


def with_inner_wall(head, *, inwards=True, joined=False):
    """A skin saved as a shell some 6 mm thick, whose walls may be joined round the neck."""
    outer, faces = head.surfaces["skin"].vertices, head.surfaces["skin"].triangles
    inner = (outer - [3, -100, 1500]) * 0.95 + [3, -100, 1500]
    faces = faces.astype(int)
    ring = np.zeros((0, 3), dtype=int)
    if joined:
        faces = faces[outer[faces][:, :, 2].min(axis=1) > np.asarray(outer)[:, 2].min() + 20.0]
        (a, b), n = edges_of(faces).border.T, len(outer)
        ring = np.concatenate([np.stack([b, a, a + n], 1), np.stack([b, a + n, b + n], 1)])
    wall = faces[:, ::-1] if inwards else faces
    head.change(
        "skin",
        vertices=lambda v: np.concatenate([v, inner]),
        triangles=lambda _: np.concatenate([faces, wall + len(outer), ring]),
    )


def with_fork(head):
    """A tet that hangs on an edge of the cranium, within it."""
    vertices, triangles = head.surfaces["cranium"].vertices, head.surfaces["cranium"].triangles
    a, b = triangles[0, :2]
    c, d = len(vertices), len(vertices) + 1
    tips = vertices.mean(axis=0) + [[10.0, 0, 0], [0, 10.0, 5.0]]
    tet = [[a, b, c], [b, a, d], [a, c, d], [c, b, d]]
    head.change(
        "cranium",
        vertices=lambda v: np.concatenate([v, tips]),
        triangles=lambda t: np.concatenate([t, tet]),
    )


def with_slivers(head):
    """Triangles of the mandible without common vertices, each pressed almost flat."""
    triangles = head.surfaces["mandible"].triangles

    def push(vertices):
        used = set()
        for a, b, c in triangles:
            if used & {a, b, c}:
                continue
            used |= {a, b, c}
            vertices[a] = 0.002 * vertices[a] + 0.499 * (vertices[b] + vertices[c])
        return vertices

    head.change("mandible", vertices=push)


def shifted(head, name, offset):
    """A bone moved with its landmarks left out, which would tell the same."""
    head.change(name, vertices=lambda v: v + offset)
    head.replace('skull = "skull.mrk.json"\n', "")


def far_landmark(head, distance):
    head.skull = head.skull | {"nasion": head.skull["nasion"] + [0, -distance, 0]}


# Each defect: what is done to a clean case, and the one serious finding it gives.
DEFECTS = {
    "metres": (lambda h: scaled(h, 0.001), "error", "surface-units"),
    "micrometres": (lambda h: scaled(h, 1000.0), "error", "surface-units"),
    "inches": (lambda h: scaled(h, 1 / 25.4), "error", "surface-units"),
    "centimetres": (lambda h: scaled(h, 0.1), "error", "surface-units"),
    "normalised": (normalised, "error", "surface-units"),
    "bone in metres": (lambda h: scaled(h, 0.001, ["mandible"]), "error", "surface-units"),
    "ten times too large": (lambda h: scaled(h, 4.0), "error", "surface-units"),
    "landmarks in metres": (
        lambda h: setattr(h, "skull", {n: p / 1000 for n, p in h.skull.items()}),
        "error",
        "landmark-frame",
    ),
    "landmarks in RAS": (
        lambda h: setattr(h, "skull", {n: p * HALF_TURN for n, p in h.skull.items()}),
        "error",
        "landmark-frame",
    ),
    "landmarks of another patient": (
        lambda h: setattr(h, "skin", {n: p + [60, 90, 80] for n, p in h.skin.items()}),
        "error",
        "landmark-frame",
    ),
    "labels swapped": (
        lambda h: setattr(h, "skin", swapped(h.skin)),
        "error",
        "left-right-swapped",
    ),
    "one pair swapped": (
        lambda h: setattr(h, "skull", swapped(h.skull, ["gonion"])),
        "error",
        "left-right-swapped",
    ),
    "landmark 8 mm off": (lambda h: far_landmark(h, 8.0), "warning", "landmark-far"),
    "landmark 30 mm off": (lambda h: far_landmark(h, 30.0), "error", "landmark-far"),
    "skin turned inside out in part": (
        lambda h: h.change("skin", triangles=inconsistent),
        "warning",
        "surface-normals",
    ),
    "bone inside out": (
        lambda h: h.change("mandible", triangles=lambda t: t[:, ::-1]),
        "warning",
        "surface-normals",
    ),
    "bone open": (
        lambda h: h.change("mandible", triangles=lambda t: t[30:]),
        "warning",
        "surface-open",
    ),
    "face mask": (
        lambda h: h.change(
            "skin", triangles=lambda t: t[(h.surfaces["skin"].vertices[t][:, :, 1] < -40).all(1)]
        ),
        "warning",
        "surface-open",
    ),
    "skin crosses itself": (folded, "warning", "surface-crossing"),
    "skin with an inner wall": (with_inner_wall, "warning", "surface-inner-wall"),
    "skin with an inner wall that faces outwards": (
        lambda h: with_inner_wall(h, inwards=False),
        "warning",
        "surface-inner-wall",
    ),
    "skin with walls that are joined": (
        lambda h: with_inner_wall(h, joined=True),
        "error",
        "surface-inner-wall",
    ),
    "skin with an island": (lambda h: with_debris(h, "skin"), "warning", "surface-islands"),
    "fork": (with_fork, "warning", "surface-non-manifold"),
    "slivers": (with_slivers, "warning", "surface-degenerate"),
    "bone through skin": (
        lambda h: shifted(h, "cranium", [0, -30.0, 0]),
        "warning",
        "bone-outside-skin",
    ),
    "bone elsewhere": (
        lambda h: h.change("mandible", vertices=lambda v: v + [400.0, 0, 0]),
        "error",
        "surface-frame",
    ),
    "bone in RAS": (
        lambda h: h.change("mandible", vertices=lambda v: v * HALF_TURN),
        "error",
        "surface-frame",
    ),
    "the same bone twice": (
        lambda h: shifted(h, "mandible", [0, 10.0, 35.0]),
        "warning",
        "bone-overlap",
    ),
    "tissue too thin": (
        lambda h: h.replace("edge_length = 4.0", "edge_length = 20\nrefine = false"),
        "warning",
        "edge-length-coarse",
    ),
    "plan 30 mm": (lambda h: h.replace("[0, -4, 1]", "[0, 30, 0]"), "warning", "plan-far"),
    "plan 400 mm": (lambda h: h.replace("[0, -4, 1]", "[0, -400, 0]"), "error", "plan-far"),
    "turn about the origin": (
        lambda h: h.replace("angle = 2\naxis = [1, 0, 0]\ncentre = [3, -100, 1450]", "angle = 3"),
        "error",
        "plan-far",
    ),
    "turn by radians' worth": (
        lambda h: (
            h.replace("angle = 2", "angle = -28"),
            h.replace("[3, -100, 1450]", "[3, -128, 1445]"),
        ),
        "warning",
        "plan-turned",
    ),
    "bone moved through the skin": (
        lambda h: (shifted(h, "mandible", [0, -22.0, 0]), h.replace("[0, -4, 1]", "[0, -15, 0]")),
        "warning",
        "plan-through-skin",
    ),
    "no tissue": (
        lambda h: h.replace("[tissue]", "[region]\nlower = 1480\n\n[tissue]"),
        "error",
        "segment-no-tissue",
    ),
    "unknown segment": (
        lambda h: h.replace("[plan.mandible]", "[plan.maxila]"),
        "error",
        "unknown-name",
    ),
    "unknown bone": (
        lambda h: h.replace(
            "[tissue]",
            '[[osteotomies]]\nplane = {point = [0, 0, 0], normal = [0, 0, 1]}\nbone = "jaw"\n'
            'name = "chin"\n\n[tissue]',
        ),
        "error",
        "unknown-name",
    ),
    "depth behind landmarks that are missing": (
        lambda h: (
            h.skull.pop("supraglenoid_L"),
            h.replace("[tissue]", "[region]\nposterior_depth = 5\n\n[tissue]"),
        ),
        "error",
        "landmark-missing",
    ),
    "unknown preset": (lambda h: h.replace("kim2010", "kim2011"), "error", "unknown-name"),
    "missing skin": (lambda h: h.replace("skin.ply", "face.ply"), "error", "file-missing"),
    "missing landmarks": (lambda h: h.replace("skull.mrk", "no.mrk"), "error", "file-missing"),
    "output is a file": (
        lambda h: h.replace("[tissue]", '[output]\nfolder = "skin.ply"\n\n[tissue]'),
        "error",
        "output-not-writable",
    ),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_said_and_said_alone(name, tmp_path):
    """One defect in a clean case gives one serious finding, with its reason and its fix."""
    spoil, severity, code = DEFECTS[name]
    head = HeadCase()
    spoil(head)
    findings = [f for f in diagnosis(tmp_path, head) if f.severity != "note"]
    assert [(f.severity, f.code) for f in findings] == [(severity, code)]
    (finding,) = findings
    assert finding.what
    assert finding.why
    assert finding.fix
    assert "case.toml" in finding.where


def test_a_turned_or_mirrored_head_is_said_for_both_sets_of_landmarks(tmp_path):
    """All data in RAS, or all mirrored: skull and skin landmarks say so."""
    for spoil, code in ((all_turned, "frame-turned"), (mirrored, "left-right-swapped")):
        head = HeadCase()
        spoil(head)
        assert serious(tmp_path, head) == [("error", code)] * 2


def test_a_turned_head_without_landmarks_is_known_by_its_jaw(tmp_path):
    """The mandible lies in front of the cranium's middle in LPS."""
    head = HeadCase()
    turned(head)
    head.replace('skull = "skull.mrk.json"\nskin = "skin.mrk.json"\n', "")
    head.replace("centre = [3, -100, 1450]", "centre = [-3, 100, 1450]")
    assert serious(tmp_path, head) == [("error", "surface-frame")]


def test_units_and_frame_of_the_case_file_are_used(tmp_path):
    """Surfaces in metres and RAS that say so are as good as in mm and LPS."""
    head = HeadCase()
    turned(head)
    scaled(head, 0.001)
    head.replace('units = "mm"\nframe = "LPS"', 'units = "m"\nframe = "RAS"')
    # The plan's own frame must be stated beside surfaces in RAS.
    head.replace("[plan.mandible]", '[plan.mandible]\nframe = "LPS"')
    assert serious(tmp_path, head) == []
