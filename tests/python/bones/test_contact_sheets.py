"""The contact sheet of a dental arch, on a jaw made by code whose teeth stand apart."""

import dataclasses

import numpy as np
import pytest

import arch_head
import cmfsim
from benches.scenes import meshes
from cmfsim.bones import contact_sheets
from cmfsim.bones.contact_sheets import sheet_departure
from cmfsim.pipeline.building.tissue.contacts import CaseContacts, arch_sheets
from cmfsim.surfaces.levels import surface_of_level
from head_case import HeadCase

ARCHES = cmfsim.DentalArches(
    {"upper": arch_head.arch()}, {"upper": frozenset({0}), "lower": frozenset()}
)
OPTIONS = cmfsim.KindOptions(contact_surface="sheet")


@pytest.fixture(scope="module")
def jaw():
    return arch_head.jaw()


@pytest.fixture(scope="module")
def sheet(jaw):
    pytest.importorskip("skimage")
    anatomy, _ = jaw
    return cmfsim.contact_sheet("maxilla", anatomy.bones["maxilla"], arch_head.arch())


@pytest.fixture(scope="module")
def tissue():
    return arch_head.tissue()


def labial(points):
    """Which points lie in front of the row of teeth, away from its ends."""
    return (points[:, 1] < -5.0) & (np.hypot(points[:, 0] / 24, points[:, 1] / 32) > 1.0)


def bends(surface):
    """The curvature along each edge, 1/mm: the turn of the normal over the edge's length."""
    core = cmfsim.Surface(surface.vertices, surface.triangles)
    triangles = np.asarray(surface.triangles)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    ends = np.asarray(surface.vertices)[edges]
    normals = core.vertex_normals[edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    turn = np.linalg.norm(normals[:, 1] - normals[:, 0], axis=1)
    # Short edges hold the rounding of marching cubes.
    long = length > 0.7
    return ends.mean(axis=1)[long], (turn / length)[long]


def test_the_curvature_of_a_sheet_is_bounded(sheet, jaw):
    """2 mm and more where tissue slides, though crowns of radius 3.2 mm meet in slits of 1 mm."""
    assert 2.0 <= sheet.radius < 20.0

    def largest(surface):
        places, bend = bends(surface)
        zone = labial(places) & (np.abs(places[:, 2] - 4.0) < 8.0)
        assert np.count_nonzero(zone) > 1000
        return bend[zone].max()

    # A chord's turn over its length is no more than the curvature, up to the normals' own error.
    assert largest(sheet.surface) < 1.2 / sheet.radius
    assert largest(jaw[1].surface) > 1.0


def test_a_wider_bound_is_kept_by_a_smoother_sheet(jaw, sheet):
    options = cmfsim.SheetOptions(radius=3.0)
    made = cmfsim.contact_sheet("m", jaw[0].bones["maxilla"], arch_head.arch(), options)
    assert made.radius >= 3.0 > sheet.radius
    assert made.relief > sheet.relief


def test_teeth_are_bridged_and_gums_kept(sheet):
    """Gaps of 1 mm between crowns vanish; the alveolar bone stays where it is to 0.3 mm."""
    row, along = arch_head.centre_line()
    core = cmfsim.Surface(sheet.surface.vertices, sheet.surface.triangles)
    near = np.abs(along - 0.5 * along[-1]) < 35.0
    normal = np.column_stack([np.gradient(row[:, 1]), -np.gradient(row[:, 0])])[near]
    normal *= np.sign((normal * row[near]).sum(axis=1, keepdims=True))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def outward(height, out):
        points = np.column_stack([row[near] + out * normal, np.full(near.sum(), height)])
        closest, normals, _ = core.closest(points)
        return np.einsum("na,na->n", points - closest, normals)

    gums = outward(13.0, arch_head.BONE)
    assert np.abs(gums).max() < 0.4
    # The crowns reach 3.2 mm out, and between them there is nothing within 1.9 mm.
    crowns = outward(-1.0, arch_head.CROWN)
    assert np.abs(crowns).max() < 1.0
    assert np.ptp(crowns) < 0.8


def test_a_sheet_goes_on_past_the_edge(sheet, jaw):
    """A ray from the lips inwards below the teeth enters the sheet and meets no lingual turn."""

    def inside(surface, heights):
        core = cmfsim.Surface(surface.vertices, surface.triangles)
        # Backwards through the front teeth, from 4 mm in front of them to 16 mm behind.
        y = np.arange(-arch_head.LENGTH - 8.0, -arch_head.LENGTH + 16.0, 0.5)
        points = [[[2.0, v, h] for v in y] for h in heights]
        return core.winding_number(np.reshape(points, (-1, 3))).reshape(len(heights), -1) > 0.5

    # Where it ends, 10 mm below the teeth, the Gaussian that rounds it takes the last 3 mm.
    past = inside(sheet.surface, arch_head.EDGE - np.array([1.0, 2.0, 4.0, 6.0, 7.0]))
    changes = np.count_nonzero(np.diff(past.astype(int), axis=1), axis=1)
    assert (changes == 1).all()
    assert not past[:, 0].any()
    assert past[:, -1].all()
    # It enters within 2 mm of where the crowns' face is, and goes on straight.
    entry = np.argmax(past, axis=1) * 0.5 - 8.0
    assert np.abs(entry + arch_head.CROWN).max() < 2.0
    assert np.ptp(entry) <= 1.0
    # The bone itself turns round: of its crowns nothing is left below the edge.
    assert not inside(jaw[1].surface, [arch_head.EDGE - 1.0]).any()
    crown = inside(jaw[1].surface, [arch_head.EDGE + 2.0])[0]
    assert np.count_nonzero(np.diff(crown.astype(int))) >= 2


def test_no_voxel_depends_on_the_last_digits_of_a_processor(sheet, jaw, monkeypatch):
    """A plane through the teeth that is turned by rounding makes the same sheet.

    The jaw's faces lie on grid points, and another processor's least squares differ by as much.
    """
    plane, rng = contact_sheets._plane, np.random.default_rng(4)
    monkeypatch.setattr(
        contact_sheets, "_plane", lambda points: plane(points) + 1e-14 * rng.normal(size=3)
    )
    for _ in range(3):
        made = cmfsim.contact_sheet("maxilla", jaw[0].bones["maxilla"], arch_head.arch())
        assert (made.surface.triangles == sheet.surface.triangles).all()
        assert np.abs(made.surface.vertices - sheet.surface.vertices).max() < 1e-9


def test_a_sheet_goes_on_behind_the_last_tooth(sheet):
    """Where the row ends at y = 14 the buccal face goes on, narrowing gently."""
    core = cmfsim.Surface(sheet.surface.vertices, sheet.surface.triangles)
    y = np.arange(5.0, 24.0)
    for side in (-1.0, 1.0):
        points = np.column_stack([np.full(len(y), side * 40.0), y, np.full(len(y), 2.0)])
        starts = np.linspace(40.0, 5.0, 351)
        width = []
        for point in points:
            ray = np.column_stack([side * starts, np.full(351, point[1]), np.full(351, 2.0)])
            width.append(starts[np.argmax(core.winding_number(ray) > 0.5)])
        width = np.array(width)
        assert width.min() > 15.0
        assert np.abs(np.diff(width)).max() < 0.8


def test_departure_is_measured_from_the_bone_under_the_nodes():
    """A plate raised by 0.5 mm over another, and a sphere that is 2 mm too large."""
    flat, faces = meshes.box((4, 4, 1), (20.0, 20.0, 1.0))
    triangles = cmfsim.TetMesh(flat, faces).boundary_triangles()
    bone = cmfsim.SurfaceData(flat, triangles)
    raised = cmfsim.SurfaceData(flat + [0, 0, 1.5], triangles)
    nodes = np.array([[8.0, 9.0, 1.2], [10.0, 11.0, 0.9]])
    assert sheet_departure(raised, bone, nodes) == pytest.approx((0.5, 0.5, 0.5))
    ball = cmfsim.SurfaceData(*meshes.icosphere(4, 10.0))
    larger = cmfsim.SurfaceData(*meshes.icosphere(4, 12.0))
    away = np.array([[13.0, 0, 0], [0, 0, -14.0], [0, 11.0, 0]])
    mean, p95, largest = sheet_departure(larger, ball, away)
    assert mean == pytest.approx(2.0, abs=0.02)
    assert mean <= p95 <= largest == pytest.approx(2.0, abs=0.02)
    assert sheet_departure(raised, bone, np.zeros((0, 3))) == (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def classified(jaw, tissue, sheet):
    anatomy, segment = jaw
    nodes = np.asarray(tissue.nodes)
    return cmfsim.classify_nodes(
        nodes,
        tissue.boundary_triangles(),
        dataclasses.replace(anatomy, teeth=None),
        [segment],
        moved=["maxilla"],
        fixed_planes={"top": ((0, 0, nodes[:, 2].max()), (0, 0, 1))},
        options=OPTIONS,
        arches=ARCHES,
        contacts={"maxilla": sheet.surface},
    )


def test_vestibule_and_tuberosity_slide_and_what_is_above_is_joined(classified, tissue):
    nodes, kinds = np.asarray(tissue.nodes), classified.kinds
    sliding, joined = nodes[kinds.nodes("sliding")], nodes[kinds.nodes("joined")]
    vestibule = arch_head.CREST + 1 + OPTIONS.upper_front
    out = arch_head.WIDTH + arch_head.BONE
    front = labial(nodes) & (np.asarray(kinds.segment) >= 0)
    below = front & (nodes[:, 2] < vestibule - 2) & (nodes[:, 2] > arch_head.EDGE + 1)
    assert np.count_nonzero(below) > 100
    assert np.mean(kinds.kind[below] == 3) > 0.98
    above = front & (nodes[:, 2] > vestibule + 3)
    assert np.count_nonzero(above) > 20
    assert (kinds.kind[above] == 2).all()
    # The tuberosity, behind the second molars at y = 2, on both sides.
    for side in (-1.0, 1.0):
        rear = (sliding[:, 1] > 4.0) & (np.abs(sliding[:, 0] - side * out) < 4.0)
        assert np.count_nonzero(rear) >= 3
    # The palate and the lingual faces of the crowns: inside the row.
    inner = np.hypot(joined[:, 0] / 24, joined[:, 1] / 32) < 0.95
    assert np.count_nonzero(inner & (joined[:, 1] < -5.0)) > 50
    inner = np.hypot(sliding[:, 0] / 24, sliding[:, 1] / 32) < 0.9
    assert not (inner & (sliding[:, 1] < -5.0)).any()


def test_a_sheet_that_is_not_the_bones_is_reported(jaw, tissue, sheet, classified):
    """Shifted by 60 mm: no node lies on it, and without a word lips would stick."""
    shifted = dataclasses.replace(
        sheet.surface, vertices=np.asarray(sheet.surface.vertices) + [0, 0, 60]
    )
    found = cmfsim.classify_nodes(
        tissue.nodes,
        tissue.boundary_triangles(),
        jaw[0],
        [jaw[1]],
        moved=["maxilla"],
        arches=ARCHES,
        contacts={"maxilla": shifted},
    )
    assert "contact-sheet" in {f.code for f in found.findings}
    assert "contact-sheet" not in {f.code for f in classified.findings}


def test_nothing_moves_when_nothing_moves(classified, tissue, jaw, sheet):
    data = cmfsim.segment_data(classified.kinds, [jaw[1]], contacts={"maxilla": sheet.surface})
    assert len(data["maxilla"].sliding) > 150
    scene = cmfsim.Scene(
        tissue.nodes,
        tissue.tets,
        cmfsim.TissueData("isotropic", young=0.003, poisson=0.45),
        data,
        {"maxilla": np.eye(4)},
        classified.kinds.nodes("fixed"),
    )
    solver = cmfsim.scene_solver(scene)
    assert np.abs(solver.solve({"maxilla": np.eye(4)}).displacements).max() < 1e-9
    forwards = solver.solve({"maxilla": cmfsim.rigid_motion((0, -3, 0))})
    moved = forwards.displacements[data["maxilla"].sliding]
    assert -3.5 < np.median(moved[:, 1]) < -1.0


def test_tissue_slides_on_the_bone_and_on_a_sheet_where_asked(jaw, classified):
    """The blurred bone of `contact_surface` by default, bit for bit."""
    anatomy, segment = jaw
    bone = cmfsim.KindOptions()
    assert bone.contact_surface == "bone"
    assert arch_sheets(anatomy, [segment], ARCHES, bone, 4.0).sheets == {}
    joined = cmfsim.KindOptions(sliding=False)
    assert arch_sheets(anatomy, [segment], ARCHES, joined, 4.0).sheets == {}
    slid = CaseContacts().of_scene([segment], classified.kinds)["maxilla"]
    before = cmfsim.contact_surface(segment)
    assert np.array_equal(slid.vertices, before.vertices)
    assert np.array_equal(slid.triangles, before.triangles)
    made = arch_sheets(anatomy, [segment], ARCHES, OPTIONS, 4.0)
    assert list(made.sheets) == ["maxilla"]
    assert made.findings == ()
    slid = made.of_scene([segment], classified.kinds)
    stated = made.summary([segment], classified.kinds, np.asarray(arch_head.tissue().nodes), slid)
    assert stated["maxilla"]["surface"] == "sheet"
    assert 0.0 < stated["maxilla"]["departure_mean"] < 1.5
    assert stated["maxilla"]["departure_max"] < 4.0
    ball = cmfsim.SlidingSphere("maxilla", (0, -36, 10), 8.0)
    own = dataclasses.replace(OPTIONS, regions=(ball,))
    assert arch_sheets(anatomy, [segment], ARCHES, own, 4.0).sheets == {}


def test_a_cut_leaves_no_end_on_a_sheet(jaw, sheet):
    """Halves of a jaw carry one sheet: that of the whole bone."""
    anatomy, segment = jaw
    x = segment.level.axes()[0]
    halves = []
    for name, sign in (("left", 1.0), ("right", -1.0)):
        level = np.minimum(np.asarray(segment.level.values), sign * x - 0.5).astype(np.float32)
        halves.append(cmfsim.BoneSegment(name, segment.level.with_values(level), segment.surface))
    both = cmfsim.DentalArches(ARCHES.by_jaw, {"upper": frozenset({0, 1}), "lower": frozenset()})
    made = arch_sheets(anatomy, halves, both, OPTIONS, 4.0)
    assert list(made.sheets) == ["left", "right"]
    assert made.sheets["left"] is made.sheets["right"]
    across = cmfsim.Surface(sheet.surface.vertices, sheet.surface.triangles)
    closest, _, _ = across.closest(made.sheets["left"].surface.vertices)
    near = labial(closest) & (np.abs(closest[:, 2] - 4.0) < 8.0)
    apart = np.linalg.norm(closest - made.sheets["left"].surface.vertices, axis=1)
    assert apart[near].max() < 0.1


def test_too_sharp_a_sheet_is_reported(jaw):
    """No relief makes crowns as flat as tets of 60 mm need."""
    made = arch_sheets(jaw[0], [jaw[1]], ARCHES, OPTIONS, 60.0)
    assert [f.code for f in made.findings] == ["contact-sheet"]
    assert "30 mm" in made.findings[0].what


def two_jaws(jaw):
    """The jaw and its mirror image below, as the teeth and bones of one head."""
    anatomy, _ = jaw
    upper = anatomy.bones["maxilla"]
    # The edges of the teeth meet at z = −5: the mirror image of z is −10 − z.
    n = upper.values.shape[2]
    shift = 30
    tall = np.full((*upper.values.shape[:2], n + shift), -2.0, dtype=np.float32)
    teeth, low_teeth, low = tall.copy(), tall.copy(), tall.copy()
    up = tall.copy()
    up[:, :, shift:] = upper.values
    teeth[:, :, shift:] = anatomy.teeth.values
    origin = np.asarray(upper.origin) - [0, 0, shift]
    z = origin[2] + np.arange(n + shift)
    mirrored = np.rint(-10.0 - z - origin[2]).astype(int)
    held = (mirrored >= 0) & (mirrored < n + shift)
    low[:, :, held] = up[:, :, mirrored[held]]
    low_teeth[:, :, held] = teeth[:, :, mirrored[held]]
    image = cmfsim.ImageData(up, (1, 1, 1), origin)
    return cmfsim.Anatomy(
        image.with_values(np.full(up.shape, 2.0, dtype=np.float32)),
        {"cranium": image, "mandible": image.with_values(low)},
        teeth=image.with_values(np.maximum(teeth, low_teeth)),
    )


def test_arches_are_placed_from_the_teeth_that_the_image_shows(jaw):
    anatomy = two_jaws(jaw)
    names = ("cranium", "mandible")
    segments = [
        cmfsim.BoneSegment(n, anatomy.bones[n], surface_of_level(n, anatomy.bones[n]))
        for n in names
    ]
    found = cmfsim.dental_arches(anatomy, segments)
    assert [f.code for f in found.findings] == ["sliding-landmarks"]
    wanted = arch_head.arch()
    upper, lower = found.by_jaw["upper"], found.by_jaw["lower"]
    assert np.linalg.norm(np.asarray(upper.tip) - wanted.tip) < 6.0
    # Crowns reach less far out than the bone, and the last stands behind the second molar.
    assert np.abs(np.asarray(upper.left) - wanted.left).max() < 10.0
    assert np.asarray(upper.out)[2] > 0.99
    assert np.asarray(lower.out)[2] < -0.99
    assert np.allclose(np.asarray(upper.tip)[:2], np.asarray(lower.tip)[:2], atol=1.0)
    assert found.bearers == {"upper": {0}, "lower": {1}}
    # One bone that bears both rows has the same arches, and slides on the bone.
    whole = anatomy.bones["cranium"].with_values(
        np.maximum(*(np.asarray(b.values) for b in anatomy.bones.values()))
    )
    skull = cmfsim.Anatomy(anatomy.skin, {"skull": whole}, teeth=anatomy.teeth)
    one = [cmfsim.BoneSegment("skull", whole, segments[0].surface)]
    same = cmfsim.dental_arches(skull, one)
    assert np.linalg.norm(np.asarray(same.by_jaw["upper"].tip) - upper.tip) < 1.5
    made = arch_sheets(skull, one, same, OPTIONS, 4.0)
    assert made.sheets == {}
    assert [f.code for f in made.findings] == ["contact-sheet"]
    # Without teeth and landmarks nothing slides, which is reported.
    bare = dataclasses.replace(anatomy, teeth=None)
    nothing = cmfsim.dental_arches(bare, segments)
    assert [f.code for f in nothing.findings] == ["sliding-landmarks"]
    assert nothing.by_jaw == {}


def test_options_come_from_plain_values():
    made = cmfsim.kind_options(
        {
            "contact_surface": "bone",
            "fixed_borders": ["inferior"],
            "behind": 3,
            "regions": [
                {"segment": "maxilla", "low": [0, 0, 0], "high": [1, 2, 3]},
                {"segment": "chin", "centre": [0, 0, 0], "radius": 4},
            ],
        }
    )
    assert made.fixed_borders == ("inferior",)
    assert [type(r).__name__ for r in made.regions] == ["SlidingBox", "SlidingSphere"]
    for table, complaint in (
        ({"contact": "bone"}, "no option 'contact'; did you mean 'contact_surface'"),
        ({"contact_surface": "gum"}, "contact_surface is 'gum'|'gum'"),
        ({"sliding": "no"}, "sliding is 'no': true or false"),
        ({"fixed_borders": "inferior"}, "a list of borders"),
        ({"regions": [{"segment": "maxilla"}]}, "segment with low and high"),
        ({"regions": ["teeth"]}, "SlidingBox or SlidingSphere"),
        ({"behind": "far"}, "behind is 'far'"),
    ):
        with pytest.raises(cmfsim.CaseError, match=complaint):
            cmfsim.kind_options(table)


def test_a_case_states_its_options_and_errors_name_their_line(tmp_path):
    case = HeadCase()
    case.toml += """
[node_kinds]
contact_surface = "bone"
regions = [{segment = "mandible", centre = [0, -160, 1450], radius = 9}]
"""
    options = cmfsim.Case.load(case.write(tmp_path)).node_kinds
    made = cmfsim.kind_options(options)
    assert made.contact_surface == "bone"
    assert made.regions[0].radius == 9.0
    case.replace('contact_surface = "bone"', 'contact_surfaces = "bone"')
    line = 1 + case.toml.splitlines().index('contact_surfaces = "bone"')
    where = f"case.toml:{line} node_kinds.contact_surfaces: there is no option"
    with pytest.raises(cmfsim.CaseError, match=where):
        cmfsim.build_model(case.write(tmp_path), check=False)
    case.replace("regions = [{", "regions = [3, {")
    with pytest.raises(cmfsim.CaseError, match="regions is not a list of tables"):
        cmfsim.Case.load(case.write(tmp_path))


def test_landmarks_that_span_no_arch_are_refused(jaw):
    arch = arch_head.arch()
    with pytest.raises(cmfsim.CaseError, match="do not span an arch"):
        dataclasses.replace(arch, tip=arch.left)
    with pytest.raises(cmfsim.CaseError, match="no bone within"):
        cmfsim.contact_sheet(
            "maxilla",
            jaw[0].bones["maxilla"],
            dataclasses.replace(
                arch,
                tip=np.asarray(arch.tip) + 200,
                left=np.asarray(arch.left) + 200,
                right=np.asarray(arch.right) + 200,
            ),
        )
