"""Splints against VTK's measurements: closed, thick enough, and teeth seat in them."""

import functools
import importlib
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tooth_row_heads import HINGE, closed_rows, rows_of

import cmfsim
import real_heads
from cmfsim.planning.occlusion.splint import largest_piece

pv = pytest.importorskip("pyvista")
stencil = pytest.importorskip("vtkmodules.vtkImagingStencil")
ndimage = pytest.importorskip("scipy.ndimage")
spatial = pytest.importorskip("scipy.spatial")
module = importlib.import_module("cmfsim.planning.occlusion.splint")
modeling = pytest.importorskip("vtkmodules.vtkFiltersModeling")


def shape_of(surface):
    return pv.PolyData.from_regular_faces(np.asarray(surface.vertices), surface.triangles)


def distance(points, surface):
    """Signed distance of points from a closed surface by VTK, negative inside."""
    cloud, shape = pv.PolyData(np.asarray(points)), shape_of(surface)
    size = np.abs(cloud.compute_implicit_distance(shape)["implicit_distance"])
    # The signs of that filter are wrong at some vertices: rays tell what lies inside.
    enclosed = modeling.vtkSelectEnclosedPoints()
    enclosed.SetInputData(cloud)
    enclosed.SetSurfaceData(shape)
    enclosed.Update()
    inside = np.asarray(pv.wrap(enclosed.GetOutput())["SelectedPoints"], dtype=bool)
    return np.where(inside, -size, size)


def opened_as_advised():
    """The splint of the closed bite of the synthetic head, opened as its refusal advises."""
    upper, lower = closed_rows()
    with pytest.raises(cmfsim.CaseError, match="splint-bite-closed") as refused:
        cmfsim.splint_between(upper, lower, HINGE)
    degrees = float(str(refused.value).split("--open ")[1].rstrip(")"))
    assert 0.1 <= degrees < 3.0
    return cmfsim.splint_between(upper, lower, HINGE, opening=degrees)


@pytest.fixture(scope="module")
def final():
    return opened_as_advised()


@functools.cache
def coarse_splint():
    return cmfsim.splint_between(*closed_rows(), HINGE, opening=3.0)


@pytest.fixture
def coarse(monkeypatch):
    """Voxels of 0.5 mm, and a splint of them: for what does not depend on their size."""
    monkeypatch.setattr(module, "SPACING", 0.5)
    return coarse_splint()


@pytest.fixture(scope="module")
def atlas():
    """The splint of a real skull whose upper jaw is moved by 4 mm, in its own coordinates."""
    names = {"upper": "cranium", "lower": "mandible"}
    bones = {name: real_heads.read_ply("atlas_head", name) for name in names.values()}
    sites = real_heads.landmarks("atlas_head")
    level = cmfsim.ImageData(np.zeros((2, 2, 2), dtype=np.float32), (1, 1, 1))
    anatomy = cmfsim.Anatomy(level, dict.fromkeys(names.values(), level), surfaces=bones)
    segments = [cmfsim.BoneSegment(name, level, bone) for name, bone in bones.items()]
    upper, lower = cmfsim.tooth_rows(anatomy, segments, sites)
    moved = upper.moved(cmfsim.rigid_motion((0.0, -4.0, 1.0), 2.0, (1, 0, 0), upper.arch.tip))
    heads = ((40.2, -100.4, 1513.2), (-39.6, -100.3, 1513.2))
    return cmfsim.splint_between(moved, lower, heads, thickness=1.5, opening=3.0)


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """The splint of a real CT, whose bones are voxels of 1 x 1 x 2 mm."""
    folder = tmp_path_factory.mktemp("phantom")
    shutil.copy(real_heads.data_folder() / "ct_phantom/ct.nii.gz", folder)
    moves = {"maxilla": {"forwards": 4.0, "up": 1.0}, "mandible_body": {"forwards": -2.5}}
    cmfsim.init_case(folder, cuts=("le_fort_1", "bsso"), moves=moves)
    return cmfsim.make_splint(folder, opening=3.1)


# The synthetic head's is the atlas's twin with smoother teeth; coarser voxels have it in every run.
@pytest.fixture(
    params=["atlas", *(pytest.param(n, marks=pytest.mark.slow) for n in ("final", "phantom"))]
)
def splint(request):
    return request.getfixturevalue(request.param)


def crowns_of(splint):
    return np.concatenate([r.surface.vertices[r.crowns] for r in (splint.upper, splint.lower)])


def solid_of(surface, spacing):
    """Voxels inside a closed surface by VTK, a few of them beyond its box."""
    to_stencil, paint = stencil.vtkPolyDataToImageStencil(), stencil.vtkImageStencilToImage()
    low = surface.vertices.min(axis=0) - 3.0 * spacing
    size = np.ceil((surface.vertices.max(axis=0) - low) / spacing).astype(int) + 4
    to_stencil.SetInputData(shape_of(surface))
    to_stencil.SetOutputSpacing([spacing] * 3)
    to_stencil.SetOutputOrigin(low.tolist())
    to_stencil.SetOutputWholeExtent([v for n in size.tolist() for v in (0, n - 1)])
    paint.SetInputConnection(to_stencil.GetOutputPort())
    paint.SetInsideValue(1)
    paint.SetOutsideValue(0)
    paint.SetOutputScalarTypeToUnsignedChar()
    paint.Update()
    inside = np.asarray(pv.wrap(paint.GetOutput()).active_scalars)
    return inside.reshape(size, order="F") > 0


def test_nothing_is_thinner_than_a_ball_of_one_and_a_half_millimetres(splint):
    """By VTK's voxels and SciPy's distances: balls that fit inside reach all of the splint."""
    # Upright, so that the box about it is small.
    upright = np.linalg.qr(np.column_stack([splint.axis, [1, 0, 0], [0, 1, 0]]))[0]
    turned = cmfsim.SurfaceData(splint.surface.vertices @ upright, splint.surface.triangles)
    spacing, radius = 0.2, 0.75
    solid = solid_of(turned, spacing)
    # To the middles of voxels outside: on a face, half a voxel beyond it.
    depth = ndimage.distance_transform_edt(solid, sampling=spacing)
    core = depth >= radius + 0.5 * spacing
    away = ndimage.distance_transform_edt(~core, sampling=spacing)
    beyond = solid & (away > radius + 1.5 * spacing)
    assert beyond.sum() * spacing**3 < 0.3
    assert away[solid].max() < radius + 2.0 * spacing
    # All in one piece, also where it is as thick as that.
    assert ndimage.label(core)[1] == 1


def test_a_splint_is_one_closed_surface_also_as_stl(splint, tmp_path):
    """Checked on the file, whose numbers have single precision, by VTK as well."""
    cmfsim.write_surface(tmp_path / "splint.stl", splint.surface)
    shape = pv.read(tmp_path / "splint.stl").clean(tolerance=0.0)
    assert shape.n_open_edges == 0
    assert shape.is_manifold
    assert len(np.unique(np.asarray(shape.connectivity()["RegionId"]))) == 1
    assert shape.volume > 5000.0


def test_teeth_seat_within_a_tenth_of_a_millimetre(splint):
    """No crown lies deeper in the splint, and cusps touch the ground of their imprints."""
    for row in (splint.upper, splint.lower):
        crowns = row.surface.vertices[row.crowns]
        assert -distance(crowns, splint.surface).min() <= 0.1
        cusps = row.surface.vertices[[*row.cusps.values()]]
        inside = np.abs(distance(cusps, splint.surface))
        assert np.median(inside) < 0.1
        assert (inside < 0.1).mean() > 0.8


def test_no_undercut_holds_a_splint(splint):
    """Pulled off either row along its axis, the splint never meets a crown more deeply."""
    for row, way in ((splint.upper, -1.0), (splint.lower, 1.0)):
        # An undercut is wider than the millimetre between every fourth of these points.
        crowns = row.surface.vertices[row.crowns][::4]
        for far in (0.3, 1.0, 2.0):
            # The row moves the other way.
            found = distance(crowns - way * far * splint.axis, splint.surface)
            assert -found.min() <= 0.15


def test_walls_are_as_thick_as_asked_for(splint):
    """By VTK: between the imprints, and from either imprint to the outside of the splint."""
    least = 1.5
    assert splint.thickness >= least
    # Triangles are 0.3 mm wide: these points are less than a millimetre apart.
    centres = splint.surface.vertices[splint.surface.triangles[::9]].mean(axis=1)
    centres = centres[spatial.cKDTree(crowns_of(splint)).query(centres)[0] < 2.0]
    up = np.abs(distance(centres, splint.upper.surface))
    low = np.abs(distance(centres, splint.lower.surface))
    in_upper, in_lower = centres[up < 0.1], centres[low < 0.1]
    assert min(len(in_upper), len(in_lower)) > 300
    # The points of one imprint from the other row.
    assert distance(in_upper, splint.lower.surface).min() >= least - 0.1
    assert distance(in_lower, splint.upper.surface).min() >= least - 0.1


@pytest.mark.usefixtures("coarse")
def test_a_closed_bite_that_is_opened_as_advised_has_a_splint():
    made = opened_as_advised()
    assert made.thickness >= 1.5
    assert shape_of(made.surface).is_manifold


def test_cusps_that_are_narrower_than_voxels_are_held(coarse):
    """Tips of a tenth of a millimetre, as those of surfaces of a CT, lie in no voxel's corner."""
    lower = coarse.lower.surface
    vertices = lower.vertices.copy()
    tips = [*coarse.lower.cusps.values()][3:15:3]
    vertices[tips] += 0.9 * coarse.axis
    spiky = cmfsim.SurfaceData(vertices, lower.triangles)
    row = replace(coarse.lower, surface=spiky)
    made = cmfsim.splint_between(coarse.upper, row, HINGE, opening=1.0)
    tips = made.lower.surface.vertices[tips]
    assert -distance(tips, made.surface).min() <= 0.1


def test_a_splint_that_falls_into_pieces_is_refused():
    """Never the largest piece alone, without the teeth of the others."""
    level = np.full((30, 10, 10), -0.3, dtype=np.float32)
    level[2:12, 2:8, 2:8] = level[16:28, 2:8, 2:8] = 0.3
    with pytest.raises(cmfsim.CaseError, match=r"2 pieces.*splint-broken.*1\.5 mm.*--open"):
        largest_piece(level)
    level[16:28] = -0.3
    level[20, 5, 5] = 0.3
    assert largest_piece(level)[20, 5, 5] < 0.0


def test_what_cannot_be_made_is_refused_with_its_remedy():
    upper, lower = closed_rows()
    for thickness in (1.4, 6.5):
        with pytest.raises(cmfsim.CaseError, match=r"splint-thickness.*1\.5 to 6 mm"):
            cmfsim.splint_between(upper, lower, HINGE, thickness=thickness)
    with pytest.raises(cmfsim.CaseError, match=r"splint-opening.*0 to 15"):
        cmfsim.splint_between(upper, lower, HINGE, opening=-1.0)
    deep = lower.moved(cmfsim.rigid_motion((0.0, 0.0, 7.0)))
    with pytest.raises(cmfsim.CaseError, match="splint-rows-overlap"):
        cmfsim.splint_between(upper, deep, HINGE)


def test_a_label_stands_out_of_the_front_alone(coarse):
    matplotlib = pytest.importorskip("matplotlib")
    assert matplotlib
    made = cmfsim.splint_between(coarse.upper, coarse.lower, HINGE, label="AB$1")
    vertices = made.surface.vertices
    # Of all other vertices, which are those of the splint without a label, VTK need not say it.
    new = spatial.cKDTree(coarse.surface.vertices).query(vertices)[0] > 1e-6
    away = distance(vertices[new], coarse.surface)
    raised = vertices[new][away > 0.1]
    # In front of the arch, about the midline, and by the height of the letters.
    assert len(raised) > 200
    assert away.max() < 0.7
    assert raised[:, 1].max() < coarse.upper.arch.tip[1] + 8.0
    assert np.abs(raised[:, 0]).max() < 14.0
    assert shape_of(made.surface).is_manifold
    with pytest.raises(cmfsim.CaseError, match="splint-label"):
        cmfsim.splint_between(coarse.upper, coarse.lower, HINGE, label="a name that is too long")
    with pytest.raises(cmfsim.CaseError, match=r"label 'Nr\. 漢' has '漢' \(splint-label\)"):
        cmfsim.splint_between(coarse.upper, coarse.lower, HINGE, label="Nr. 漢")


def test_a_jaw_without_teeth_has_no_row():
    head = cmfsim.make_head()
    upper, _ = rows_of(head, upper=("cranium",))
    with pytest.raises(cmfsim.CaseError, match=r"upper jaw shows no tooth row \(splint-no-teeth\)"):
        cmfsim.splint_between(upper, closed_rows()[1], HINGE)
    empty = cmfsim.Anatomy(cmfsim.ImageData(np.zeros((2, 2, 2), dtype=np.float32), (1, 1, 1)), {})
    with pytest.raises(cmfsim.CaseError, match="no tooth rows"):
        cmfsim.tooth_rows(empty, [], {})


def test_a_splint_follows_the_pose_of_the_head(coarse):
    """The grid is that of the bite: a turned head has the same splint, but for rounding."""
    motion = cmfsim.rigid_motion((50, -20, 1500), 20, (1, 1, 0))
    rows = [row.moved(motion) for row in (coarse.upper, coarse.lower)]
    hinge = np.asarray(HINGE) @ motion[:3, :3].T + motion[:3, 3]
    turned = cmfsim.splint_between(*rows, (hinge[0], hinge[1]))
    assert turned.thickness == pytest.approx(coarse.thickness, abs=1e-3)
    np.testing.assert_allclose(turned.axis, motion[:3, :3] @ coarse.axis, atol=1e-6)
    back = coarse.surface.vertices @ motion[:3, :3].T + motion[:3, 3]
    assert np.abs(distance(back[::50], turned.surface)).max() < 0.05


def test_teeth_on_two_pieces_are_refused():
    """A split upper jaw has no one motion: its splint would hold teeth where they are not."""
    upper, _ = closed_rows()
    level = cmfsim.ImageData(np.zeros((2, 2, 2), dtype=np.float32), (1, 1, 1))
    box = pv.Cube(
        center=upper.arch.left + [2, 0, 0], x_length=4, y_length=4, z_length=4
    ).triangulate()
    piece = cmfsim.SurfaceData(np.asarray(box.points), box.regular_faces)
    bones = {"cranium": upper.surface, "mandible": closed_rows()[1].surface}
    anatomy = cmfsim.Anatomy(level, dict.fromkeys(bones, level), surfaces=bones)
    segments = [cmfsim.BoneSegment(name, level, bone) for name, bone in bones.items()]
    segments.append(cmfsim.BoneSegment("piece_left", level, piece))
    with pytest.raises(cmfsim.CaseError, match=r"several segments \(splint-pieces\).*piece_left"):
        cmfsim.tooth_rows(anatomy, segments, cmfsim.make_head().skull_landmarks)
