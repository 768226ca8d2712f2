"""Surfaces are read, written, checked and repaired; each defect is counted, placed and undone."""

import os
import time
from pathlib import Path

import meshio
import numpy as np
import pytest

import cmfsim
from cmfsim.surfaces.crossings import crossing_pairs
from cmfsim.surfaces.repair import cap_loop
from cmfsim.surfaces.topology import connected_labels
from head_case import icosphere

DATA = Path(os.environ.get("CMFSIM_DATA") or Path(__file__).parents[4] / "shared/data")
NO_DATA = pytest.mark.skipif(not DATA.is_dir(), reason=f"no real data at {DATA}")
RADIUS = 50.0


def sphere(rounds=3, radius=RADIUS, centre=(10.0, -200.0, 1500.0)):
    vertices, triangles = icosphere(rounds)
    return vertices * radius + centre, triangles


def check(vertices, triangles):
    return cmfsim.check_surface(cmfsim.SurfaceData(vertices, triangles))


def repair(vertices, triangles, **options):
    surface = cmfsim.SurfaceData(vertices, triangles)
    repaired, findings = cmfsim.repair_surface(surface, "it", cmfsim.RepairOptions(**options))
    return repaired, [f.code for f in findings]


# Reading and writing.


@pytest.mark.parametrize("ending", [".ply", ".stl", ".obj", ".vtp"])
def test_a_surface_survives_a_round_trip(ending, tmp_path):
    """Exact but for STL, which has single precision and gets its vertices welded again."""
    vertices, triangles = sphere(2)
    path = tmp_path / f"sphere{ending}"
    path.write_bytes(b"old")
    cmfsim.write_surface(path, cmfsim.SurfaceData(vertices, triangles))
    found = cmfsim.read_surface(path)
    # STL stores corners by triangle, so that the order of vertices is that of their first use.
    corners = found.vertices[found.triangles]
    wanted = vertices[triangles]
    if ending == ".stl":
        wanted = wanted.astype(np.float32).astype(float)
    else:
        assert np.array_equal(found.triangles, triangles)
    assert np.array_equal(corners, wanted)
    assert len(found.vertices) == len(vertices)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_units_and_frame_of_a_file_are_converted(tmp_path):
    """Inches in RAS: scaled and turned about the long axis, outward as before."""
    vertices, triangles = sphere(2)
    path = tmp_path / "sphere.ply"
    cmfsim.write_surface(path, cmfsim.SurfaceData(vertices * [-1, -1, 1] / 25.4, triangles))
    found = cmfsim.read_surface(path, units="inch", frame="RAS")
    assert np.abs(found.vertices - vertices).max() < 1e-12 * 1500
    assert cmfsim.check_surface(found).volume > 0
    with pytest.raises(cmfsim.CaseError, match="units is 'parsec'"):
        cmfsim.read_surface(path, units="parsec")


def test_unknown_endings_are_not_written(tmp_path):
    """Named, with those that are known."""
    with pytest.raises(cmfsim.CaseError, match=r"\.ply, \.stl, \.obj, \.vtp"):
        cmfsim.write_surface(tmp_path / "x.3mf", cmfsim.SurfaceData(*sphere(1)))
    assert list(tmp_path.iterdir()) == []


HEADER = """ply
format {format} 1.0
comment of no weight
element vertex 4
property {real} x
property {real} y
property {real} z{more}
element face 2
property list uchar {whole} {name}
end_header
"""


def ply(tmp_path, order="<", real="float", whole="int", name="vertex_indices", rows=None, more=""):
    """A file of two triangles on four points, written byte by byte."""
    places = np.arange(12.0).reshape(4, 3) ** 1.5
    kinds = {"float": "f4", "double": "f8", "int": "i4", "uint": "u4"}
    format_ = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = HEADER.format(format=format_, real=real, whole=whole, name=name, more=more)
    extra = b"\7" if "red" in more else b""
    data = b"".join(row.tobytes() + extra for row in places.astype(order + kinds[real]))
    for row in rows or [[0, 1, 2], [2, 1, 3]]:
        data += bytes([len(row)]) + np.array(row, order + kinds[whole]).tobytes()
    path = tmp_path / "file.ply"
    path.write_bytes(head.encode() + data)
    return path


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("real", "whole"), [("float", "int"), ("double", "uint")])
@pytest.mark.parametrize("more", ["", "\nproperty uchar red"])
def test_ply_is_read_as_meshio_reads_it(order, real, whole, more, tmp_path):
    path = ply(tmp_path, order, real, whole, more=more)
    known = meshio.read(path)
    surface = cmfsim.read_surface(path)
    np.testing.assert_array_equal(surface.vertices, known.points)
    np.testing.assert_array_equal(surface.triangles, known.cells_dict["triangle"])


@pytest.mark.parametrize("ending", [".ply", ".stl", ".obj", ".vtp"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.6, 0.97])
def test_a_file_cut_short_is_refused_in_time(ending, share, tmp_path):
    """Never a hang, a crash, a shorter surface, or another error than CaseError."""
    path = tmp_path / f"cut{ending}"
    cmfsim.write_surface(path, cmfsim.SurfaceData(*sphere(2)))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    started = time.perf_counter()
    with pytest.raises(cmfsim.CaseError, match="cut"):
        cmfsim.read_surface(path)
    assert time.perf_counter() - started < 10.0


# Checks.


@pytest.mark.parametrize("far", [1e100, -1e300])
def test_coordinates_that_overflow_are_refused(far):
    """Areas and volumes were inf and NaN, and repairing failed in numpy's words."""
    vertices, triangles = sphere(1)
    vertices[5, 2] = far
    for call in (check, repair):
        with pytest.raises(cmfsim.CaseError, match=r"surface vertex 5 has the coordinate .*e\+"):
            call(vertices, triangles)


def test_a_sphere_is_sound():
    """Closed, outward, one piece; area and volume of the inscribed polyhedron."""
    vertices, triangles = sphere(4)
    report = check(vertices, triangles)
    assert report.is_closed
    assert report.orientable
    assert (report.inconsistent, len(report.components), len(report.non_manifold)) == (0, 1, 0)
    assert len(report.crossings) == len(report.slivers) == len(report.degenerate) == 0
    # The inscribed polyhedron lacks O(h²): 0.2 % and 0.4 % at 5120 triangles.
    assert report.area == pytest.approx(4 * np.pi * RADIUS**2, rel=5e-3)
    assert report.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=5e-3)
    assert report.lowest == pytest.approx([-40, -250, 1450], abs=0.5)


def test_a_border_is_found_with_its_length_and_centre():
    """A sphere cut at a height: one loop in that plane, as long as its circle."""
    vertices, triangles = sphere(5, centre=(0, 0, 0))
    upper = triangles[(vertices[triangles][:, :, 2] > 0.5 * RADIUS).all(axis=1)]
    (loop,) = check(vertices, upper).borders
    assert loop.centre == pytest.approx([0, 0, 0.5 * RADIUS], abs=2.0)
    # The border zigzags by a triangle, so it is longer than the circle, up to its 2/√3.
    circle = 2 * np.pi * RADIUS * np.sqrt(0.75)
    assert circle < loop.length < 1.3 * circle


def test_two_holes_that_touch_at_a_vertex_are_two_borders():
    """Two triangles gone at opposite sides of a vertex."""
    vertices, triangles = sphere(2)
    fan = np.flatnonzero((triangles == 0).any(axis=1))
    first = fan[0]
    apart = next(t for t in fan if len(set(triangles[t]) & set(triangles[first])) == 1)
    report = check(vertices, np.delete(triangles, [first, apart], axis=0))
    assert [len(loop.vertices) for loop in report.borders] == [3, 3]


def test_turned_triangles_are_counted_by_their_edges():
    """One triangle turned round disagrees with its three neighbours."""
    vertices, triangles = sphere()
    triangles[17] = triangles[17][::-1]
    assert check(vertices, triangles).inconsistent == 3


def test_a_moebius_strip_has_one_side():
    """A strip closed with half a turn cannot be oriented."""
    n = 12
    low, high = np.arange(n), np.arange(n) + n
    after_low, after_high = np.append(low[1:], high[0]), np.append(high[1:], low[0])
    triangles = np.concatenate(
        [np.stack(t, axis=1) for t in ((low, after_low, high), (after_low, after_high, high))]
    )
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    tilt = np.stack([np.cos(angle) * np.cos(angle / 2), np.sin(angle) * np.cos(angle / 2)], axis=1)
    tilt = np.column_stack([tilt, np.sin(angle / 2)])
    vertices = np.concatenate([ring - 0.3 * tilt, ring + 0.3 * tilt])
    report = check(vertices, triangles)
    assert not report.orientable
    assert not report.is_closed


def test_degenerate_duplicate_and_sliver_triangles_are_told_apart():
    """Each is counted once, by its number."""
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [1, 0.001, 0]]
    triangles = [[0, 1, 2], [0, 1, 3], [1, 1, 2], [2, 0, 1], [1, 0, 2], [0, 3, 4]]
    report = check(vertices, triangles)
    assert report.degenerate.tolist() == [1, 2]
    assert report.duplicate.tolist() == [3, 4]
    assert report.slivers.tolist() == [5]


def test_a_fork_is_found():
    """Three triangles at one edge."""
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]
    report = check(vertices, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert report.non_manifold.tolist() == [[0, 1]]


def brute_crossings(vertices, triangles):
    """Pairs of which an edge of one passes through the inside of the other, one pair at a time."""

    def volume(a, b, c, d):
        return np.linalg.det([b - a, c - a, d - a])

    def passes(p, q, a, b, c):
        if volume(a, b, c, p) * volume(a, b, c, q) >= 0:
            return False
        signs = [np.sign(volume(p, q, *pair)) for pair in ((a, b), (b, c), (c, a))]
        return abs(sum(signs)) == 3

    found = []
    for i in range(len(triangles)):
        for j in range(i + 1, len(triangles)):
            hit = False
            for one, other in ((i, j), (j, i)):
                for k in range(3):
                    ends = triangles[one][[k, (k + 1) % 3]]
                    if not set(ends) & set(triangles[other]):
                        hit |= passes(*vertices[ends], *vertices[triangles[other]])
            if hit:
                found.append([i, j])
    return np.array(found).reshape(-1, 2)


@pytest.mark.parametrize("seed", range(4))
def test_crossings_are_those_of_brute_force(seed):
    """Random triangles of very different sizes, some with common vertices."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(60, 3)) * rng.choice([0.1, 1.0], size=(60, 1))
    triangles = np.array([rng.choice(60, 3, replace=False) for _ in range(70)])
    found = crossing_pairs(vertices, triangles)
    assert len(found) > 20
    assert np.array_equal(found, brute_crossings(vertices, triangles))


def test_two_spheres_cross_along_their_circle():
    """The places of the crossings lie on both spheres."""
    one, triangles = sphere(4, centre=(0, 0, 0))
    other = one + [60.0, 0, 0]
    report = check(np.concatenate([one, other]), np.concatenate([triangles, triangles + len(one)]))
    assert len(report.crossings) > 50
    assert (report.crossings[:, 0] < len(triangles)).all()
    assert (report.crossings[:, 1] >= len(triangles)).all()
    assert report.crossing_points[:, 0] == pytest.approx(30.0, abs=4.0)


def test_touching_neighbours_and_flat_sheets_do_not_cross():
    """A grid of squares, each cut in two, with its coplanar neighbours."""
    n = 12
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), [0], indexing="ij"), -1)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate(
        [
            np.stack(t, 1)
            for t in ((corner, corner + n, corner + 1), (corner + 1, corner + n, corner + n + 1))
        ]
    )
    assert len(crossing_pairs(grid.reshape(-1, 3).astype(float), triangles)) == 0


def test_labels_are_those_of_the_connected_pieces():
    """A long chain in random order, a ring, and what is alone."""
    rng = np.random.default_rng(1)
    chain = rng.permutation(1000)
    pairs = np.concatenate([np.stack([chain[:-1], chain[1:]], 1), [[1001, 1002], [1002, 1003]]])
    labels = connected_labels(rng.permutation(pairs), 1005)
    assert (labels[:1000] == 0).all()
    assert labels[1000:].tolist() == [1, 2, 2, 2, 3]


# Repairs.


def test_a_sound_surface_is_left_as_it_is():
    """Same numbers, no findings."""
    vertices, triangles = sphere()
    repaired, codes = repair(vertices, triangles)
    assert codes == []
    assert np.array_equal(repaired.vertices, vertices)
    assert np.array_equal(repaired.triangles, triangles)


def test_nearly_equal_vertices_are_welded(monkeypatch):
    """Every triangle with corners of its own, a little apart, becomes a closed sphere."""
    vertices, triangles = sphere()
    rng = np.random.default_rng(3)
    loose = vertices[triangles].reshape(-1, 3) + rng.uniform(-1e-6, 1e-6, (3 * len(triangles), 3))
    monkeypatch.setattr("cmfsim.surfaces.repair.WELD_DISTANCE", 1e-6)
    repaired, codes = repair(loose, np.arange(len(loose)).reshape(-1, 3))
    assert codes == ["surface-repaired"]
    assert len(repaired.vertices) == len(vertices)
    assert cmfsim.check_surface(repaired).is_closed


@pytest.mark.parametrize("turned", [slice(None), slice(0, 300), slice(0, None, 2)])
def test_a_surface_is_turned_outward(turned):
    """All, some or every other triangle inside out: the same volume as before."""
    vertices, triangles = sphere()
    volume = check(vertices, triangles).volume
    triangles[turned] = triangles[turned][:, ::-1]
    repaired, codes = repair(vertices, triangles)
    report = cmfsim.check_surface(repaired)
    assert codes == ["surface-repaired"]
    assert report.inconsistent == 0
    assert report.volume == pytest.approx(volume, rel=1e-12)


def test_hollows_stay_hollow_and_neighbours_are_turned():
    """An inner wall that encloses a negative volume stays; beside the body it is turned."""
    outer, triangles = sphere(centre=(0, 0, 0))
    hollow = triangles[:, ::-1]
    both = np.concatenate([triangles, hollow + len(outer)])
    size = check(outer, triangles).volume
    for shift, volume, expected in ((0.0, 0.875, []), (100.0, 1.125, ["surface-repaired"])):
        repaired, codes = repair(np.concatenate([outer, 0.5 * outer + [shift, 0, 0]]), both)
        assert codes == expected
        assert cmfsim.check_surface(repaired).volume == pytest.approx(volume * size, rel=1e-9)
    # Inside out as a whole, the hollow stays a hollow.
    repaired, codes = repair(np.concatenate([outer, 0.5 * outer]), both[:, ::-1])
    assert codes == ["surface-repaired"]
    assert cmfsim.check_surface(repaired).volume == pytest.approx(0.875 * size, rel=1e-9)


def test_debris_is_dropped_by_its_share():
    """A quarter of a hundredth of the area goes; a hundredth and a half stays."""
    vertices, triangles = sphere()
    both = np.concatenate([vertices, vertices * 0.05 + [200, 0, 0]])
    pieces = np.concatenate([triangles, triangles + len(vertices)])
    repaired, codes = repair(both, pieces)
    assert codes == ["surface-repaired"]
    assert len(repaired.triangles) == len(triangles)
    both[len(vertices) :] = vertices * 0.12 + [200, 0, 0]
    assert len(repair(both, pieces)[0].triangles) == len(pieces)


@pytest.mark.parametrize("height", [-0.9, -0.3, 0.6])
def test_an_open_sphere_is_closed_by_a_cap(height):
    """Closed and consistent, with the volume of the cut sphere."""
    vertices, triangles = sphere(5, centre=(0, 0, 0))
    upper = triangles[(vertices[triangles][:, :, 2] > height * RADIUS).all(axis=1)]
    repaired, codes = repair(vertices, upper)
    report = cmfsim.check_surface(repaired)
    assert codes == ["surface-open"]
    assert report.is_closed
    assert report.inconsistent == 0
    assert len(report.crossings) == 0
    # V = π h² (3 r − h) / 3 of a spherical cap of height h, with the circle of radius a under it;
    # the border lies above the plane by an edge of the icosphere at most, 1.09 r / 2⁵.
    h = RADIUS * (1 - height)
    circle = np.pi * RADIUS**2 * (1 - height**2)
    lost = np.pi * h**2 * (3 * RADIUS - h) / 3 - report.volume
    assert -1e-9 < lost < circle * 1.09 * RADIUS / 2**5 + 0.005 * report.volume


def test_a_cap_fills_a_polygon_with_reflex_corners():
    """The cap of a flat comb has the comb's area, whichever way round and however it lies."""
    comb = [[0, 0], [9, 0], [9, 5], [7, 5], [7, 1], [5, 1], [5, 6], [4, 6], [4, 1], [2, 1], [2, 4]]
    flat = np.array([*comb, [0, 4]], dtype=float)
    x, y = flat.T
    area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    rotation = cmfsim.rigid_motion(angle=37, axis=(1, 2, 3))[:3, :3]
    points = np.column_stack([flat, np.zeros(len(flat))]) @ rotation.T + [5, 6, 7]
    for loop in (np.arange(len(points)), np.arange(len(points))[::-1]):
        cap, bulge = cap_loop(points, loop)
        a, b, c = (points[cap[:, i]] for i in range(3))
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        assert len(cap) == len(points) - 2
        assert areas.sum() == pytest.approx(area)
        assert bulge < 1e-12 * 10
        # Each border edge is run through against the direction of the loop.
        runs = {(int(p), int(q)) for t in cap for p, q in zip(t, np.roll(t, -1), strict=True)}
        assert {(int(q), int(p)) for p, q in zip(loop, np.roll(loop, -1), strict=True)} <= runs


def test_a_flat_triangle_is_removed_without_a_slit(monkeypatch):
    """A needle is drawn together; a corner on an edge cuts the triangle across in two."""
    vertices, triangles = sphere(2)
    a, b, c = triangles[0]
    point = vertices.copy()
    point[a] = point[b] + 1e-13 * (point[a] - point[b])
    edge = vertices.copy()
    edge[a] = 0.4 * edge[b] + 0.6 * edge[c]
    monkeypatch.setattr("cmfsim.surfaces.repair.WELD_DISTANCE", 0.0)
    for spoilt in (point, edge):
        assert len(check(spoilt, triangles).degenerate) > 0
        repaired, codes = repair(spoilt, triangles)
        report = cmfsim.check_surface(repaired)
        assert codes == ["surface-repaired"]
        assert report.is_closed
        assert len(report.degenerate) == 0
        assert cmfsim.Surface(repaired.vertices, repaired.triangles).is_closed


def test_nothing_left_is_an_error():
    """Triangles without area alone."""
    with pytest.raises(cmfsim.CaseError, match="it: no triangle with an area"):
        repair([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])


# Real anatomy.


@NO_DATA
def test_real_open_parts_are_mended():
    """Parts of BodyParts3D that are open, forked, doubled or with debris become closed."""
    folder = DATA / "bodyparts3d/v3_obj99"
    for part in ("FMA46763", "FMA46782", "FMA46826", "FMA49012", "FMA52748", "FMA53649"):
        repaired, _ = cmfsim.repair_surface(cmfsim.read_surface(folder / f"{part}.obj"), part)
        report = cmfsim.check_surface(repaired)
        assert report.is_closed, part
        assert report.volume > 0.0, part
        assert report.inconsistent == 0, part


@NO_DATA
def test_the_open_skin_closes_to_the_closed_one():
    """Same volume as the skin with its flat neck cap."""
    folder = DATA / "atlas_head"
    repaired, findings = cmfsim.repair_surface(
        cmfsim.read_surface(folder / "skin_open.ply"), "skin"
    )
    closed = cmfsim.check_surface(cmfsim.read_surface(folder / "skin.ply"))
    report = cmfsim.check_surface(repaired)
    assert [f.code for f in findings] == ["surface-open"]
    assert report.is_closed
    assert report.volume == pytest.approx(closed.volume, rel=1e-6)
    assert len(report.crossings) == 0
