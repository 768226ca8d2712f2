"""The roughness of skin that a bench measures, and how smooth muscles leave it."""

import functools

import numpy as np
import pytest

import cmfsim
from benches.accuracy import skin_roughness
from benches.scenes import meshes
from cmfsim.muscles.blurring import blurred

RADIUS = 8.0


def sheet(height, size=60.0, cells=60):
    """A surface z = height(x, y) over a square, and which of its vertices are off the border."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(0.0, size, cells + 1)] * 2))
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    quads = np.stack([corner, corner + 1, corner + cells + 2, corner + cells + 1], axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = np.column_stack([x, y, height(x, y)])
    inside = np.all((vertices[:, :2] > RADIUS) & (vertices[:, :2] < size - RADIUS), axis=1)
    return cmfsim.SurfaceData(vertices, triangles), inside


def test_a_quadric_is_smooth():
    skin, inside = sheet(lambda x, y: 0.002 * x * x - 0.001 * x * y + 0.1 * y + 3.0)
    # The fit is over the tangent plane of a vertex, in which a quadric of the plane z = 0 is one
    # up to third order.
    assert skin_roughness.roughness(skin, inside, RADIUS) < 2e-3


@pytest.mark.parametrize("depth", [0.1, 0.2])
def test_furrows_have_the_roughness_of_their_depth(depth):
    """Quadrics over 16 mm hardly follow z = a sin 2πx/5, whose rms is a/√2."""
    skin, inside = sheet(lambda x, _: depth * np.sin(2.0 * np.pi * x / 5.0))
    found = skin_roughness.roughness(skin, inside, RADIUS)
    assert found == pytest.approx(depth / np.sqrt(2.0), rel=0.1)


def test_a_vertex_without_neighbours_has_no_roughness():
    skin, inside = sheet(lambda x, _: 0.0 * x, size=60.0, cells=6)
    assert np.isnan(skin_roughness.heights(skin, inside, RADIUS)).all()


@functools.cache
def cheek():
    """Fat 20 mm thick, a strap of muscle ending in it, and its skin off the borders."""
    mesh = cmfsim.TetMesh(*meshes.box((20, 20, 7), (60.0, 60.0, 20.0), jitter=0.2, seed=2))
    nodes = np.asarray(mesh.nodes)
    corners = np.array([[x, y, z] for x in (-5, 40) for y in (22, 38) for z in (10, 16)], float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    strap = cmfsim.SurfaceData(corners, [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])])
    top = mesh.boundary_triangles().astype(np.int64)
    top = top[np.all(nodes[top, 2] == 20.0, axis=1)]
    used, triangles = np.unique(top, return_inverse=True)
    inside = np.all((nodes[used, :2] > RADIUS) & (nodes[used, :2] < 60.0 - RADIUS), axis=1)
    return mesh, strap, used, triangles.reshape(-1, 3), inside


def skin_with(given):
    """The skin once the right half of the bone below has moved 4 mm to the left."""
    mesh, strap, used, triangles, inside = cheek()
    nodes = np.asarray(mesh.nodes)
    mixture = cmfsim.equivalent_material(mesh, [strap], preset=given.preset)
    tissue = blurred(mesh, mixture.fraction, mixture.fibre, mixture.tissue_data, given.blur)[2]
    below = nodes[:, 2] == 0.0
    scene = cmfsim.Scene(
        nodes=nodes,
        tets=mesh.tets,
        tissue=tissue,
        fixed=np.flatnonzero(below & (nodes[:, 0] < 30.0)),
        segments={"bone": cmfsim.SegmentData(joined=np.flatnonzero(below & (nodes[:, 0] > 30.0)))},
        plan={"bone": cmfsim.rigid_motion(translation=(-4.0, 0.0, 0.0))},
    )
    moved = nodes + cmfsim.solve_scene(scene).displacements
    return cmfsim.SurfaceData(moved[used], triangles), inside


def test_default_muscles_crease_the_skin_less_than_sharp_or_stiff_ones():
    settings = {
        "default": cmfsim.CaseMuscles(),
        "sharp": cmfsim.CaseMuscles(blur=0.0),
        "stiff": cmfsim.CaseMuscles(blur=0.0, preset="kim2010"),
    }
    found = {
        name: skin_roughness.roughness(*skin_with(given), RADIUS)
        for name, given in settings.items()
    }
    assert found["default"] < 0.8 * found["sharp"]
    assert found["sharp"] < 0.5 * found["stiff"]
