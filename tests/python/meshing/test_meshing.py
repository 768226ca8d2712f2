"""From labels, levels and surfaces to tets: against volumes that are known, and bad input."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cmfsim
import head_case
from cmfsim import _core
from cmfsim.meshing.levels import TissueRegion, near_skin, tissue_level

LEAST = 10.0


def ball(radius=10.0, spacing=(1.0, 1.0, 1.0), centre=(0.0, 0.0, 0.0)):
    """The level image of a ball, on a grid that leaves room about it."""
    spacing, centre = np.asarray(spacing), np.asarray(centre)
    low = centre - radius - 3.0 * spacing
    shape = np.ceil(2.0 * (radius + 3.0 * spacing) / spacing).astype(int) + 1
    grid = cmfsim.ImageData(np.zeros(shape, np.float32), spacing, low)
    x, y, z = grid.axes()
    r = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2)
    return grid.with_values((radius - r).astype(np.float32))


def least_angle(mesh):
    return float(mesh.quality().min_dihedral.min())


def bodies(mesh):
    """The number of parts that hang together."""
    graph = pytest.importorskip("scipy.sparse")
    tets = np.asarray(mesh.tets).astype(int)
    rows, columns = np.repeat(tets[:, 0], 3), tets[:, 1:].ravel()
    near = graph.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(mesh.n_nodes,) * 2)
    return graph.csgraph.connected_components(near, directed=False)[0]


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.7, 1.0, 1.9)])
def test_a_ball_has_its_volume_and_its_surface(spacing):
    """4/3 π r³; nodes of the boundary a radius from the centre, wherever the grid lies."""
    centre = np.array([-20.0, 300.0, 1500.0])
    made = cmfsim.mesh_from_level(ball(10.0, spacing, centre), cmfsim.MeshOptions(3.0))
    volume = float(np.sum(made.mesh.volumes))
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 1000.0, rel=0.04)
    nodes = np.asarray(made.mesh.nodes)[np.unique(made.mesh.boundary_triangles())]
    off = np.abs(np.linalg.norm(nodes - centre, axis=1) - 10.0)
    assert off.mean() < 0.1
    assert off.max() < 0.5
    assert np.asarray(made.mesh.volumes).min() > 0.0
    assert made.report.min_dihedral >= LEAST
    assert made.report.boundary_error_mean <= 3.0 / 4.0


def test_a_box_of_labels_lies_where_the_image_says():
    """Labels are voxels about their centres: faces half a spacing beyond the outermost ones."""
    labels = np.zeros((20, 24, 16), dtype=np.uint8)
    labels[4:16, 5:19, 4:12] = 3
    spacing, origin = np.array([1.5, 1.0, 2.0]), np.array([10.0, -50.0, 7.0])
    mesh = cmfsim.mesh_from_labels(labels, spacing, 3.0, origin)
    low, high = np.asarray(mesh.nodes).min(axis=0), np.asarray(mesh.nodes).max(axis=0)
    np.testing.assert_allclose(low, origin + spacing * ([4, 5, 4] - np.array(0.5)), atol=0.5)
    np.testing.assert_allclose(high, origin + spacing * ([15, 18, 11] + np.array(0.5)), atol=0.5)
    assert float(np.sum(mesh.volumes)) == pytest.approx(12 * 14 * 8 * 3.0, rel=0.08)
    assert least_angle(mesh) >= LEAST


def test_two_bodies_stay_two_and_both_are_there():
    """Far apart, as forearm and head are in one image; small ones go where this is asked."""
    labels = np.zeros((40, 20, 20), dtype=bool)
    labels[2:14, 4:16, 4:16] = True
    labels[26:34, 6:14, 6:14] = True
    mesh = cmfsim.mesh_from_labels(labels, 1.0)
    assert bodies(mesh) == 2
    assert float(np.sum(mesh.volumes)) == pytest.approx(12**3 + 8**3, rel=0.08)
    level = cmfsim.ImageData(np.where(labels, 1.0, -1.0).astype(np.float32), (1, 1, 1))
    made = cmfsim.mesh_from_level(level, cmfsim.MeshOptions(least_body=900.0))
    assert bodies(made.mesh) == 1
    assert made.report.dropped_parts == 1
    assert 250.0 < made.report.dropped_volume < 600.0
    assert [f.code for f in made.findings] == ["tissue-not-held"]
    assert "removed       1 parts" in made.report.as_text()


def test_a_sheet_thinner_than_the_edge_is_kept_by_refinement():
    """2.5 mm of cheek at an edge of 4 mm."""
    grid = cmfsim.ImageData(np.zeros((31, 31, 21), np.float32), (1, 1, 1), (-15, -15, -10))
    x, y, z = grid.axes()
    level = np.minimum(1.25 - np.abs(z - 0.3), 12.0 - np.maximum(np.abs(x), np.abs(y)))
    sheet = grid.with_values(level.astype(np.float32))
    whole = 2.5 * 24.0**2
    made = cmfsim.mesh_from_level(sheet, cmfsim.MeshOptions(4.0, refinements=2))
    assert made.report.volume == pytest.approx(whole, rel=0.1)
    assert bodies(made.mesh) == 1
    assert made.report.min_dihedral >= LEAST
    # Unrefined it holds no tet at all, nor where refinement is not allowed.
    nowhere = np.zeros(level.shape, dtype=bool)
    for options, allowed in ((cmfsim.MeshOptions(4.0, 0), None), (None, nowhere)):
        with pytest.raises(cmfsim.MeshError, match="thickness of the tissue, or more refinements"):
            cmfsim.mesh_from_level(sheet, options or cmfsim.MeshOptions(4.0, 2), allowed=allowed)


def test_tets_are_small_where_it_is_needed_and_nothing_is_thin():
    level = ball()
    upper = np.broadcast_to(level.axes()[2] > 2.0, level.values.shape)
    options = cmfsim.MeshOptions(4.0, refinements=1)
    made = cmfsim.mesh_from_level(level, options, needed=upper.astype(np.uint8))
    lengths, heights = edges_and_heights(made.mesh)
    whole, _ = edges_and_heights(cmfsim.mesh_from_level(level, options).mesh)
    assert lengths[heights > 6.0].mean() == pytest.approx(0.5 * whole.mean(), rel=0.1)
    assert lengths[heights < -4.0].mean() == pytest.approx(whole.mean(), rel=0.1)
    assert made.report.min_dihedral >= LEAST


def edges_and_heights(mesh):
    """The mean edge of each tet, and the height of its centroid."""
    corners = np.asarray(mesh.nodes)[np.asarray(mesh.tets)]
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    edges = [np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a, b in pairs]
    return np.mean(edges, axis=0), corners[:, :, 2].mean(axis=1)


def test_lips_with_a_gap_between_them_are_two_bodies():
    """A gap of 1.5 mm at an edge of 4 mm; closed, they are one."""
    grid = cmfsim.ImageData(np.zeros((49, 37, 49), np.float32), (0.5,) * 3, (-12, -9, -12))
    x, y, z = grid.axes()
    outer = 10.0 - np.sqrt(x**2 + (1.3 * y) ** 2 + z**2)
    parted = grid.with_values(np.minimum(outer, np.abs(z - 0.2) - 0.75).astype(np.float32))
    made = cmfsim.mesh_from_level(parted, cmfsim.MeshOptions(4.0, refinements=2))
    assert bodies(made.mesh) == 2
    assert made.report.min_dihedral >= LEAST
    closed = grid.with_values(outer.astype(np.float32))
    assert bodies(cmfsim.mesh_from_level(closed, cmfsim.MeshOptions(4.0)).mesh) == 1


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    edge=st.floats(2.0, 6.0),
    refinements=st.integers(0, 2),
    spacing=st.tuples(*[st.floats(0.6, 1.6)] * 3),
)
def test_no_tet_is_flatter_than_ten_degrees(seed, edge, refinements, spacing):
    """Of any smooth blob; the boundary within a quarter edge of where it should be on average.

    A blob's bumps are as wide as the knots of its noise, four voxels. An edge that spans more
    cannot follow them: its error is measured against how many bumps it spans.
    """
    ndimage = pytest.importorskip("scipy.ndimage")
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, (4, 5, 4))
    values = np.pad(ndimage.zoom(noise, 4, order=3), 3, constant_values=-1.0).astype(np.float32)
    grid = cmfsim.ImageData(values, spacing)
    core = np.argwhere(np.ones_like(values)).reshape(*values.shape, 3)
    # A core that makes sure of some tissue.
    distance = np.linalg.norm((core - np.array(values.shape) / 2) * spacing, axis=3)
    level = np.maximum(values, np.clip(5.0 - distance, -1.0, 1.0)).astype(np.float32)
    made = cmfsim.mesh_from_level(grid.with_values(level), cmfsim.MeshOptions(edge, refinements))
    assert made.report.min_dihedral >= LEAST
    bumps_spanned = max(1.0, edge / (4.0 * min(spacing)))
    assert made.report.boundary_error_mean <= bumps_spanned * edge / 4.0
    assert np.asarray(made.mesh.volumes).min() > 0.0


@pytest.mark.parametrize(
    "dtype", [bool, np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, "u8"]
)
def test_labels_of_any_whole_type_and_memory_order_mesh_alike(dtype):
    labels = np.zeros((14, 12, 10), dtype=np.uint8)
    labels[3:11, 3:9, 2:8] = 1
    expected = cmfsim.mesh_from_labels(labels, 1.0)
    twice = np.repeat(np.repeat(labels, 2, axis=0), 3, axis=2).astype(dtype)
    for same in (
        labels.astype(dtype),
        np.asfortranarray(labels.astype(dtype)),
        twice[::2, :, ::3],
        twice[1::2, :, 2::3],
        np.ascontiguousarray(labels.astype(dtype)[::-1])[::-1],
    ):
        mesh = cmfsim.mesh_from_labels(same, 1.0)
        assert np.array_equal(mesh.nodes, expected.nodes)
        assert np.array_equal(mesh.tets, expected.tets)


def test_negative_labels_and_values_above_one_are_tissue():
    """Non-zero, whatever the number: the labels of other programs begin anywhere."""
    labels = np.zeros((12, 12, 12), dtype=np.int16)
    labels[3:9, 3:9, 3:9] = -7
    expected = cmfsim.mesh_from_labels(labels != 0, 1.0)
    for value in (-32768, -7, 255, 256, 32767):
        mesh = cmfsim.mesh_from_labels(np.where(labels, value, 0).astype(np.int16), 1.0)
        assert np.array_equal(mesh.nodes, expected.nodes)


MESHING = """
import hashlib, numpy as np, cmfsim
x, y, z = np.mgrid[-20:21, -20:21, -20:21] * 1.0
level = 9 * np.sin(0.3 * x) * np.cos(0.2 * y) + 12 - np.sqrt(x**2 + y**2 + z**2)
made = cmfsim.mesh_from_level(cmfsim.ImageData(level.astype(np.float32), (1, 1, 1)))
print(hashlib.sha256(made.mesh.nodes.tobytes() + made.mesh.tets.tobytes()).hexdigest())
print(made.report)
"""


def test_the_number_of_threads_changes_no_bit():
    """Mesh and report."""
    said = {
        subprocess.run(
            [sys.executable, "-c", MESHING],
            env={**os.environ, "RAYON_NUM_THREADS": threads},
            capture_output=True,
            check=True,
        ).stdout
        for threads in ("1", "2", "5")
    }
    assert len(said) == 1


BOX = np.ones((6, 6, 6), dtype=np.uint8)


@pytest.mark.parametrize(
    ("labels", "options", "said"),
    [
        (np.ones((2, 2, 2, 2), np.uint8), {}, r"shape \(2, 2, 2, 2\) where"),
        (np.ones((4, 4), np.uint8), {}, r"shape \(4, 4\) where"),
        (np.ones((4, 4, 4)), {}, "dtype float64"),
        (np.array([["a"]]), {}, "dtype"),
        (np.zeros((0, 4, 4), np.uint8), {}, "empty|no voxel|no tissue|shape"),
        (np.zeros((4, 4, 4), np.uint8), {}, "no tissue|no label|positive|tissue"),
        (BOX, {"spacing": 0.0}, "spacing"),
        (BOX, {"spacing": -1.0}, "spacing"),
        (BOX, {"spacing": np.nan}, "spacing"),
        (BOX, {"spacing": (1.0, 1.0)}, "spacing"),
        (BOX, {"spacing": (1.0, np.inf, 1.0)}, "spacing"),
        (BOX, {"edge_length": 0.0}, "edge_length"),
        (BOX, {"edge_length": -3.0}, "edge_length"),
        (BOX, {"edge_length": np.nan}, "edge_length"),
        (BOX, {"edge_length": 1e9}, "edge_length"),
        (BOX, {"edge_length": 1e-9}, "edge_length"),
        (BOX, {"edge_length": "3"}, "edge_length"),
        (BOX, {"origin": (0.0, np.nan, 0.0)}, "origin"),
        (BOX, {"origin": (0.0, 0.0)}, "origin"),
        (BOX, {"refinements": -1}, "refinements"),
        (BOX, {"refinements": 4}, "refinements"),
        (BOX, {"refinements": 1.0}, "refinements"),
        (BOX, {"refinements": True}, "refinements"),
    ],
)
def test_faulty_labels_and_options_are_named(labels, options, said):
    """By a cmfsim error that is a ValueError too."""
    with pytest.raises(cmfsim.CmfsimError, match=said) as caught:
        cmfsim.mesh_from_labels(labels, **{"spacing": 1.0, **options})
    assert isinstance(caught.value, ValueError)


def test_a_level_that_is_not_finite_or_holds_nothing_is_named():
    for value in (np.nan, np.inf, -np.inf):
        values = np.array(ball().values)
        values[4, 5, 6] = value
        with pytest.raises(ValueError, match=r"finite|NaN"):
            cmfsim.mesh_from_level(ball().with_values(values))
    with pytest.raises(cmfsim.MeshError):
        cmfsim.mesh_from_level(ball().with_values(np.full_like(ball().values, -1.0)))
    with pytest.raises(ValueError, match="allowed"):
        cmfsim.mesh_from_level(ball(), allowed=np.ones((2, 2, 2), dtype=bool))
    with pytest.raises(ValueError, match="needed"):
        cmfsim.mesh_from_level(ball(), needed=np.ones((2, 2, 2), dtype=bool))
    twice = np.full(ball().values.shape, 2)
    with pytest.raises(cmfsim.MeshError, match=r"needed refinements\[0\] is 2: .*allow more"):
        cmfsim.mesh_from_level(ball(), cmfsim.MeshOptions(refinements=1), needed=twice)
    with pytest.raises(cmfsim.MeshError, match="needed has real numbers"):
        cmfsim.mesh_from_level(ball(), needed=np.full(twice.shape, 0.5))
    with pytest.raises(ValueError, match="least_body"):
        cmfsim.MeshOptions(least_body=-1.0)


def test_a_report_goes_through_json_and_prints_its_figures():
    report = cmfsim.mesh_from_level(ball()).report
    told = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    again = cmfsim.MeshReport(
        **{**told, "histogram": tuple(told["histogram"]), "worst": tuple(told["worst"])}
    )
    assert again == report
    assert sum(report.histogram) == report.n_tets
    assert len(report.worst) == 10
    angles = [tet["min_dihedral"] for tet in report.worst]
    assert angles == sorted(angles)
    assert angles[0] == report.min_dihedral
    text = report.as_text()
    assert f"{report.n_nodes} nodes, {report.n_tets} tets" in text
    assert f"{report.volume / 1000.0:.1f} cm³" in text
    for tet in report.worst:
        assert str(tet["tet"]) in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_mesh_of_few_tets_has_a_report():
    """One regular tet: 70.5° all round, and no figures of a making that nobody saw."""
    corners = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
    report = cmfsim.mesh_report(cmfsim.TetMesh(corners, [[0, 2, 1, 3]]))
    assert report.min_dihedral == pytest.approx(np.degrees(np.arccos(1 / 3)))
    assert report.volume == pytest.approx(8.0 / 3.0)
    assert report.boundary_error_mean is None
    assert "boundary" not in report.as_text()


def test_a_mesh_is_parted_along_a_sheet():
    """Right across: two bodies, no tet lost. Half across: one, with a crack."""
    mesh = cmfsim.mesh_from_labels(np.ones((12, 12, 12), np.uint8), 1.0)
    corners = np.array([[-9, -9, 5.6], [20, -9, 5.6], [20, 20, 5.6], [-9, 20, 5.6]])
    across = cmfsim.part_mesh(mesh, cmfsim.SurfaceData(corners, [[0, 1, 2], [0, 2, 3]]))
    assert bodies(across) == 2
    # Tets that the sheet runs through are cut, so that the crack lies on it.
    assert across.n_tets > mesh.n_tets
    assert np.asarray(across.volumes).sum() == pytest.approx(
        np.asarray(mesh.volumes).sum(), rel=1e-4
    )
    new = np.asarray(across.nodes)[mesh.n_nodes :]
    assert np.abs(new[:, 2] - 5.6).max() < 1e-12
    half = cmfsim.SurfaceData(np.minimum(corners, [6, 20, 20]), [[0, 1, 2], [0, 2, 3]])
    cracked = cmfsim.part_mesh(mesh, half)
    assert bodies(cracked) == 1
    assert mesh.n_nodes < cracked.n_nodes < across.n_nodes
    with pytest.raises(cmfsim.MeshError):
        cmfsim.part_mesh(mesh, cmfsim.SurfaceData(corners + [0, 0, 99], [[0, 1, 2], [0, 2, 3]]))


def test_the_level_of_a_surface_is_the_distance_from_it():
    """In units of two voxels, positive inside, clipped to one."""
    vertices, triangles = head_case.icosphere(4)
    grid = cmfsim.ImageData(np.zeros((29, 29, 29), np.float32), (1, 1, 1), (-14, -14, -14))
    surface = cmfsim.SurfaceData(10.0 * vertices, triangles)
    level = cmfsim.signed_level(surface, grid).values
    x, y, z = grid.axes()
    wanted = np.clip((10.0 - np.sqrt(x**2 + y**2 + z**2)) / 2.0, -1.0, 1.0)
    assert level.dtype == np.float32
    # An icosphere of this fineness is within 0.03 mm of the ball.
    np.testing.assert_allclose(level, wanted, atol=0.03)


def head(**changed):
    """Skin and bones of the head of ellipsoids, some of them replaced."""
    surfaces = {**head_case.surfaces(3), **changed}
    return surfaces.pop("skin"), surfaces


def test_the_levels_of_a_head_from_surfaces_hold_its_volumes():
    skin, bones = head()
    anatomy = cmfsim.anatomy_from_surfaces(skin, bones, spacing=3.0)
    levels = {"skin": anatomy.skin, **anatomy.bones}
    for name, (_, axes) in head_case.ELLIPSOIDS.items():
        voxels = np.count_nonzero(levels[name].values > 0.0) * 27.0
        assert voxels == pytest.approx(4.0 / 3.0 * np.pi * np.prod(axes), rel=0.03), name
    assert anatomy.findings == ()
    assert set(anatomy.surfaces) == {"skin", "cranium", "mandible"}


def test_bone_outside_the_skin_is_a_finding_with_its_place():
    jaw = head_case.ellipsoid("mandible")
    out = cmfsim.SurfaceData(np.asarray(jaw.vertices) + [0.0, -60.0, 0.0], jaw.triangles)
    skin, bones = head(mandible=out)
    (finding,) = cmfsim.anatomy_from_surfaces(skin, bones, spacing=3.0).findings
    assert (finding.severity, finding.code) == ("warning", "bone-outside-skin")
    assert "'mandible'" in finding.what


def test_wrong_units_frames_and_sides_are_named():
    skin, bones = head()
    huge = cmfsim.SurfaceData(np.asarray(skin.vertices) * 1000.0, skin.triangles)
    with pytest.raises(cmfsim.MeshError, match="check that the surfaces are in mm"):
        cmfsim.anatomy_from_surfaces(huge, bones)
    tiny = cmfsim.SurfaceData(np.asarray(skin.vertices) / 1000.0, skin.triangles)
    with pytest.raises(cmfsim.MeshError):
        cmfsim.anatomy_from_surfaces(tiny, bones)
    inward = cmfsim.SurfaceData(skin.vertices, np.asarray(skin.triangles)[:, ::-1])
    with pytest.raises(cmfsim.MeshError, match="skin encloses no volume"):
        cmfsim.anatomy_from_surfaces(inward, bones, spacing=4.0)
    jaw = bones["mandible"]
    far = cmfsim.SurfaceData(np.asarray(jaw.vertices) * [-1, -1, 1], jaw.triangles[:, ::-1])
    with pytest.raises(cmfsim.MeshError, match="bone 'mandible' encloses no voxel"):
        cmfsim.anatomy_from_surfaces(skin, {**bones, "mandible": far}, spacing=4.0)
    with pytest.raises(cmfsim.MeshError, match="no bone"):
        cmfsim.anatomy_from_surfaces(skin, {})
    for spacing in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="spacing"):
            cmfsim.anatomy_from_surfaces(skin, bones, spacing=spacing)


def shells(hole=4.0, spacing=2.0):
    """A head of balls: skin 60 mm, a skull of 40 to 50 mm with a hole of a radius in front."""
    grid = cmfsim.ImageData(np.zeros((67, 67, 67), np.float32), (spacing,) * 3, (-66,) * 3)
    x, y, z = grid.axes()
    r = np.sqrt(x**2 + y**2 + z**2)
    bone = np.minimum(50.0 - r, r - 40.0)
    bone = np.where(y < 0.0, np.minimum(bone, np.hypot(x, z) - hole), bone)
    scale = 2.0 * spacing

    def level(values):
        return grid.with_values(np.clip(values / scale, -1.0, 1.0).astype(np.float32))

    return cmfsim.Anatomy(level(60.0 - r), {"skull": level(bone)})


def test_tissue_ends_on_the_posterior_plane_and_leaves_the_cranial_cavity_out():
    """Between skin and skull alone, in front of y = 10, the hole's own canal aside."""
    region = TissueRegion(point=(0.0, 10.0, 0.0))
    level, (finding,) = tissue_level(shells(), region)
    x, y, z = level.axes()
    r = np.sqrt(x**2 + y**2 + z**2)
    inside = level.values > 0.0
    assert not (inside & (y > 10.0)).any()
    assert not (inside & (r < 38.0)).any()
    # A cap of a ball of radius R up to height h above its middle holds π(2R³/3 + R²h − h³/3).
    whole = np.pi * sum(
        s * (2 * R**3 / 3 + R**2 * 10.0 - 10.0**3 / 3) for s, R in ((1, 60.0), (-1, 50.0))
    )
    assert np.count_nonzero(inside) * 8.0 == pytest.approx(whole, rel=0.02)
    assert (finding.severity, finding.code) == ("note", "hollow-left-out")


def test_a_wide_opening_keeps_what_lies_behind_it():
    """As the piriform aperture: tissue of the nose is tissue."""
    level, findings = tissue_level(shells(hole=14.0), TissueRegion(point=(0.0, 10.0, 0.0)))
    x, y, z = level.axes()
    core = np.sqrt(x**2 + y**2 + z**2) < 20.0
    assert (level.values[core & (y < 8.0)] > 0.0).all()
    assert findings == ()


def test_regions_are_checked_and_bound_the_tissue():
    region = TissueRegion((0, 10, 0), (0, 2, 0), lower=-30.0, upper=30.0)
    level, _ = tissue_level(shells(), region)
    _, _, z = level.axes()
    assert not ((level.values > 0.0) & (np.abs(z) > 30.0)).any()
    with pytest.raises(cmfsim.MeshError, match="no soft tissue"):
        tissue_level(shells(), TissueRegion((0, -90, 0)))
    with pytest.raises(cmfsim.MeshError, match="normal"):
        TissueRegion((0, 0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match="foramen_radius"):
        TissueRegion((0, 0, 0), foramen_radius=0.0)
    for value in (np.nan, "low"):
        with pytest.raises(ValueError, match="lower"):
            TissueRegion((0, 0, 0), lower=value)


def test_near_skin_is_a_shell():
    x, y, z = shells().skin.axes()
    r = np.sqrt(x**2 + y**2 + z**2)
    near = near_skin(shells(), 12.0)
    assert near[r > 60.0].all()
    assert near[(r < 60.0) & (r > 52.0)].all()
    assert not near[r < 46.0].any()


def test_distances_up_to_a_bound_are_those_of_scipy_and_the_others_infinite():
    ndimage = pytest.importorskip("scipy.ndimage")
    rng = np.random.default_rng(4)
    targets = ndimage.binary_opening(rng.random((31, 24, 40)) < 0.7) | (
        rng.random((31, 24, 40)) < 1e-3
    )
    spacing = (1.0, 0.7, 1.3)
    exact = ndimage.distance_transform_edt(~targets, sampling=spacing)
    for within in (0.0, 1.5, 4.0, np.inf):
        found = _core.distance_image(targets, spacing, within=within)
        near = exact <= within
        np.testing.assert_allclose(found[near], exact[near], rtol=1e-6)
        assert np.isinf(found[exact > within * (1.0 + 1e-5)]).all()
