"""Contacts of tooth rows against closed forms and VTK's distances."""

import numpy as np
import pytest
from tooth_row_heads import closed_rows, rows_of

import cmfsim
from cmfsim.planning.occlusion.contacts import signed_gaps
from cmfsim.planning.occlusion.rows import rigid_of

pv = pytest.importorskip("pyvista")


def ball(centre, radius):
    made = pv.Icosphere(radius=radius, center=centre, nsub=5)
    return cmfsim.SurfaceData(np.asarray(made.points), made.regular_faces)


@pytest.mark.parametrize("apart", [11.0, 10.0, 9.2])
def test_two_balls_are_as_far_apart_as_their_middles_less_their_radii(apart):
    """Positive across a gap, negative where they overlap: |c − d| − r − s."""
    one, other = ball((0, 0, 0), 6.0), ball((0, 0, apart), 4.0)
    for this, that in ((one, other), (other, one)):
        gaps = signed_gaps(this.vertices, that)
        assert gaps.min() == pytest.approx(apart - 10.0, abs=0.02)
    exact = np.linalg.norm(one.vertices - [0, 0, apart], axis=1) - 4.0
    np.testing.assert_allclose(signed_gaps(one.vertices, other), exact, atol=0.02)


def test_boxes_overlap_by_what_they_share():
    one = pv.Box((0, 4, 0, 4, 0, 4)).triangulate()
    box = cmfsim.SurfaceData(np.asarray(one.points), one.regular_faces)
    found = signed_gaps([[2, 2, 3.3], [2, 2, 5.5], [2, 2, 4.0], [7, 8, 2]], box)
    np.testing.assert_allclose(found, [-0.7, 1.5, 0.0, 5.0], atol=1e-9)


@pytest.fixture(scope="module")
def rows():
    return closed_rows()


def test_distances_are_those_of_vtk(rows):
    upper, lower = rows
    lower = lower.moved(cmfsim.rigid_motion((0.5, 0.0, 2.0)))
    found = cmfsim.contact_map(upper, lower)
    surface = pv.PolyData.from_regular_faces(lower.surface.vertices, lower.surface.triangles)
    shown = ~np.ma.getmaskarray(found.upper_gaps)
    points = pv.PolyData(upper.surface.vertices[shown])
    vtk = points.compute_implicit_distance(surface)["implicit_distance"]
    np.testing.assert_allclose(found.upper_gaps[shown], vtk, atol=1e-6)
    assert found.greatest_overlap == pytest.approx(-found.least_gap)
    assert found.greatest_overlap > 0.5
    assert found.n_contacts >= 2


def test_rows_that_are_apart_touch_nowhere(rows):
    found = cmfsim.contact_map(*rows)
    # The teeth of the synthetic head are 1 mm apart at the incisors.
    assert 0.5 < found.least_gap < 1.6
    assert (found.n_contacts, found.greatest_overlap) == (0, 0.0)
    up = cmfsim.rigid_motion((0.0, 0.0, 1.0))
    nearer = cmfsim.contact_map(rows[0], rows[1].moved(up))
    assert nearer.least_gap == pytest.approx(found.least_gap - 1.0, abs=0.3)


def test_contacts_move_with_both_jaws(rows):
    motion = cmfsim.rigid_motion((3, -2, 9), 7, (1, 2, 3))
    together = cmfsim.contact_map(*(row.moved(motion) for row in rows))
    assert together.as_dict() == pytest.approx(cmfsim.contact_map(*rows).as_dict(), abs=1e-6)


def test_a_motion_by_vertices_is_taken_as_the_nearest_rigid_one():
    motion = cmfsim.rigid_motion((3, -2, 9), 7, (1, 2, 3))
    one = ball((0, 0, 0), 6.0)
    moved = cmfsim.MovedSurface(one, one.vertices @ motion[:3, :3].T + motion[:3, 3])
    np.testing.assert_allclose(rigid_of(moved), motion, atol=1e-9)
    np.testing.assert_array_equal(rigid_of(None), np.eye(4))


def test_crowns_are_teeth_and_neither_palate_nor_ramus(rows):
    head = cmfsim.make_head()
    for row, name in zip(rows, ("upper_teeth", "lower_teeth"), strict=True):
        places = row.surface.vertices[row.crowns]
        on_teeth = np.abs(head.bone_level(name, places)) < 0.5
        assert on_teeth.mean() > 0.9
        assert len(row.cusps) >= 16


def test_crowns_of_molars_are_whole(rows):
    """They are 10 mm wide and lie one behind the other in a row that widens by another 4 mm."""
    for row in rows:
        places = (row.surface.vertices[row.crowns] - row.arch.middle) @ row.arch.axes().T
        turn = np.degrees(np.arctan2(places[:, 0], places[:, 1]))
        for side in (-1.0, 1.0):
            molars = places[(side * turn > 65.0) & (side * turn < 95.0), 0]
            assert 10.0 < np.ptp(molars) < 14.5


def test_rows_of_doubtful_jaws_are_refused():
    """On a jaw without teeth, bone would pass for crowns."""
    metal = cmfsim.Finding("metal", "1 piece", severity="warning")
    doubt = cmfsim.Finding("jaw-doubtful", "the rows rise by -23°")
    assert len(rows_of(cmfsim.make_head(), findings=[metal])) == 2
    with pytest.raises(cmfsim.CaseError, match=r"splint-rows-doubtful.*rows rise.*by hand"):
        rows_of(cmfsim.make_head(), findings=[metal, doubt])
