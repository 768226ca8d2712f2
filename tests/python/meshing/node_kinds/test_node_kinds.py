"""Node kinds against exact counts on spheres, and on real heads with a mesh of voxels."""

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes import meshes
from cmfsim.pipeline.building.tissue.contacts import arch_sheets

BONE, SKIN, LEVEL, LAYERS = 20.0, 32.0, 3, 4
CUT = -4.0


def ball_level(image, radius):
    x, y, z = image.axes()
    return image.with_values(np.clip(radius - np.sqrt(x * x + y * y + z * z), -2, 2))


@pytest.fixture(scope="module")
def head():
    """A spherical head: bone of radius 20 in skin of radius 32, and tissue between them.

    The bone below z = −4 is the maxilla. Contact surfaces are finer spheres than the mesh's, with
    the nodes of the mesh on them.
    """
    nodes, tets, inner, outer = meshes.spherical_shell(LEVEL, LAYERS, BONE, SKIN)
    image = cmfsim.ImageData(np.zeros((36, 36, 36)), (2, 2, 2), (-35, -35, -35))
    bone = ball_level(image, BONE)
    _, _, z = image.axes()
    anatomy = cmfsim.Anatomy(ball_level(image, SKIN), {"cranium": bone})
    vertices, triangles = meshes.icosphere(LEVEL + 1, BONE)
    low = vertices[triangles][:, :, 2].mean(axis=1) < CUT
    segments = []
    for name, mine, level in (
        ("cranium", ~low, np.minimum(bone.values, z - CUT)),
        ("maxilla", low, np.minimum(bone.values, CUT - z)),
    ):
        surface = cmfsim.SurfaceData(vertices, triangles[mine])
        segments.append(cmfsim.BoneSegment(name, bone.with_values(level), surface))
    mesh = cmfsim.TetMesh(nodes, tets)
    return nodes, mesh.boundary_triangles(), anatomy, tuple(segments), inner, outer


def clear_of_the_cut(nodes, inner):
    """Inner nodes whose bone is beyond doubt: further from the cut than an edge of the bone."""
    return inner[np.abs(nodes[inner, 2] - CUT) > 3.0]


def test_bone_that_moves_joins_and_bone_that_stays_fixes(head):
    nodes, triangles, anatomy, segments, inner, outer = head
    options = cmfsim.KindOptions(sliding=False)
    found = cmfsim.classify_nodes(
        nodes, triangles, anatomy, segments, moved=["maxilla"], options=options
    )
    kinds = found.kinds
    held = np.concatenate([kinds.nodes("fixed"), kinds.nodes("joined")])
    assert np.array_equal(np.sort(held), np.sort(inner))
    assert not kinds.kind[outer].any()
    sure = clear_of_the_cut(nodes, inner)
    below = sure[nodes[sure, 2] < CUT]
    above = sure[nodes[sure, 2] > CUT]
    assert set(below) <= set(kinds.nodes("joined", "maxilla"))
    assert set(above) <= set(kinds.nodes("fixed"))
    assert found.counts["joined"] + found.counts["fixed"] == len(inner)
    assert found.counts["free"] == len(nodes) - len(inner)
    assert found.counts["fixed on bone"] == found.counts["fixed"]
    assert found.findings == ()
    stays = cmfsim.classify_nodes(nodes, triangles, anatomy, segments, moved=[], options=options)
    assert stays.counts["fixed"] == len(inner)


def test_planes_fix_what_lies_on_them_and_win_over_bone(head):
    nodes, triangles, anatomy, segments, inner, outer = head
    rear = nodes[:, 1].max()
    boundary = np.concatenate([inner, outer])
    reach = 6.0
    # Of a node's edge length: make the reach reckoned here and there the same by its own figure.
    length = np.linalg.norm(nodes[triangles[:, 0]] - nodes[triangles[:, 1]], axis=1)
    options = cmfsim.KindOptions(sliding=False, plane_distance=reach / length.mean())
    found = cmfsim.classify_nodes(
        nodes,
        triangles,
        anatomy,
        segments,
        moved=["cranium", "maxilla"],
        fixed_planes={"posterior": ((0, rear, 0), (0, 3, 0)), "neck": ((0, 0, -SKIN), (0, 0, -1))},
        options=options,
    )
    fixed = found.kinds.nodes("fixed")
    depth = np.minimum(np.abs(nodes[:, 1] - rear), np.abs(nodes[:, 2] + SKIN))
    assert set(boundary[depth[boundary] < 0.5 * reach]) <= set(fixed)
    assert (depth[fixed] < 2.0 * reach).all()
    assert found.counts["fixed on planes"] == found.counts["fixed"] == len(fixed) > 20
    through = {"middle": ((0, 0, 0), (1, 0, 0))}
    over = cmfsim.classify_nodes(
        nodes, triangles, anatomy, segments, moved=["maxilla"], fixed_planes=through,
        options=options,
    )  # fmt: skip
    on = inner[(np.abs(nodes[inner, 0]) < 1e-9) & (nodes[inner, 2] < -10)]
    assert len(on)
    assert set(on) <= set(over.kinds.nodes("fixed"))
    assert over.counts["overruled"] > 0


def test_borders_of_the_image_fix_where_asked(head):
    nodes, triangles, _, segments, inner, outer = head
    image = cmfsim.ImageData(np.zeros((36, 36, 30)), (2, 2, 2), (-35, -35, -SKIN + 0.5))
    anatomy = cmfsim.Anatomy(ball_level(image, SKIN), {})
    free = cmfsim.classify_nodes(nodes, triangles, anatomy, segments, moved=[])
    asked = cmfsim.KindOptions(fixed_borders=("inferior",))
    held = cmfsim.classify_nodes(nodes, triangles, anatomy, segments, moved=[], options=asked)
    more = np.setdiff1d(held.kinds.nodes("fixed"), free.kinds.nodes("fixed"))
    assert len(more) > 3
    assert set(more) <= set(outer)
    assert nodes[more, 2].max() < -SKIN + 4.0
    assert len(inner) == free.counts["fixed"]


def test_given_regions_slide_and_everything_else_of_the_bone_is_joined(head):
    nodes, triangles, anatomy, segments, inner, _ = head
    ball = cmfsim.SlidingSphere("maxilla", (0, -BONE, -8), 7.0)
    box = cmfsim.SlidingBox("cranium", (-6, -30, 2), (6, 0, 9))
    options = cmfsim.KindOptions(regions=(ball, box))
    found = cmfsim.classify_nodes(
        nodes, triangles, anatomy, segments, moved=["maxilla"], options=options
    )
    kinds = found.kinds
    sure = clear_of_the_cut(nodes, inner)
    in_ball = np.linalg.norm(nodes - [0, -BONE, -8], axis=1) <= 7.0
    in_box = ((nodes >= [-6, -30, 2]) & (nodes <= [6, 0, 9])).all(axis=1)
    below, above = nodes[:, 2] < CUT, nodes[:, 2] > CUT
    wanted = {
        ("sliding", "maxilla"): sure[(in_ball & below)[sure]],
        ("joined", "maxilla"): sure[(~in_ball & below)[sure]],
        ("sliding", "cranium"): sure[(in_box & above)[sure]],
    }
    for (kind, name), ids in wanted.items():
        mine = kinds.nodes(kind, name)
        assert np.array_equal(mine[np.isin(mine, sure)], np.sort(ids)), (kind, name)
        assert len(ids) > 3
    data = cmfsim.segment_data(kinds, segments)
    assert list(data) == ["cranium", "maxilla"]
    assert data["maxilla"].gap == "rest"
    assert data["maxilla"].contact is segments[1].surface
    assert np.array_equal(data["maxilla"].joined, kinds.nodes("joined", "maxilla"))
    assert len(data["cranium"].joined) == 0
    other = segments[0].surface
    assert (
        cmfsim.segment_data(kinds, segments, contacts={"maxilla": other})["maxilla"].contact
        is other
    )
    with pytest.raises(cmfsim.CaseError, match="contact of 'chin'"):
        cmfsim.segment_data(kinds, segments, contacts={"chin": other})


def arches():
    """Landmarks of two dental arches on the front of the spherical head, −y; bite at z = −8."""
    return {
        "supradentale": np.array([0, -19.5, -4.0]),
        "supra_m2_L": np.array([12, -15.5, -4.0]),
        "supra_m2_R": np.array([-12, -15.5, -4.0]),
        "infradentale": np.array([0, -15.5, -12.0]),
        "sub_m2_L": np.array([9, -13.0, -12.0]),
        "sub_m2_R": np.array([-9, -13.0, -12.0]),
    }


def test_tissue_slides_between_the_vestibules_of_both_arches(head):
    """One bone that bears both arches: the band from 3 mm above the upper to 2 below the lower."""
    nodes, triangles, anatomy, _, inner, _ = head
    vertices, faces = meshes.icosphere(LEVEL + 1, BONE)
    whole = cmfsim.BoneSegment(
        "skull", anatomy.bones["cranium"], cmfsim.SurfaceData(vertices, faces)
    )
    options = cmfsim.KindOptions(
        upper_front=3, upper_molars=3, lower_front=2, lower_molars=2, behind=4, beside=3,
        teeth_distance=12,
    )  # fmt: skip

    def classify(options, anatomy=anatomy, landmarks=None):
        return cmfsim.classify_nodes(
            nodes, triangles, anatomy, [whole], moved=["skull"], landmarks=landmarks or arches(),
            options=options,
        )  # fmt: skip

    found = classify(options)
    x, y, z = nodes[inner].T
    band = (z <= -1.0 + 1e-9) & (z >= -14.0 - 1e-9)
    upper = (y <= -15.5 + 4) & (np.abs(x) <= 15)
    lower = (y <= -13.0 + 4) & (np.abs(x) <= 12)
    wanted = np.sort(inner[band & upper & lower])
    assert np.array_equal(found.kinds.nodes("sliding", "skull"), wanted)
    assert len(wanted) > 20
    assert found.counts["joined"] == len(inner) - len(wanted)
    none = classify(cmfsim.KindOptions(sliding=False))
    assert none.counts["sliding"] == 0
    # Teeth known apart from bone, on the left alone: nothing slides far from them.
    image = anatomy.skin
    tooth = image.with_values(
        np.clip(
            4.0
            - np.sqrt(sum((a - c) ** 2 for a, c in zip(image.axes(), (14, -13, -7), strict=True))),
            -1,
            1,
        )
    )
    partly = classify(options, cmfsim.Anatomy(image, anatomy.bones, teeth=tooth))
    sliding = partly.kinds.nodes("sliding")
    assert 0 < len(sliding) < len(wanted)
    assert set(sliding) <= set(wanted)
    assert np.linalg.norm(nodes[sliding] - [14, -13, -7], axis=1).max() < 4 + 12 + 2
    far = {k: v for k, v in arches().items() if k != "sub_m2_L"}
    without = classify(options, landmarks=far)
    assert without.counts["sliding"] == 0
    assert [f.code for f in without.findings] == ["sliding-landmarks"]
    assert "sub_m2_L" in without.findings[0].what


def test_skin_near_bone_is_no_interface():
    """Tissue 1 mm thick under edges of 3 mm: nearness alone would fix the skin."""
    nodes, tets, inner, outer = meshes.spherical_shell(LEVEL, 1, BONE, BONE + 1.0)
    triangles = cmfsim.TetMesh(nodes, tets).boundary_triangles()
    image = cmfsim.ImageData(np.zeros((30, 30, 30)), (2, 2, 2), (-29, -29, -29))
    level = ball_level(image, BONE)
    bone = cmfsim.BoneSegment(
        "cranium", level, cmfsim.SurfaceData(*meshes.icosphere(LEVEL + 1, BONE))
    )
    anatomy = cmfsim.Anatomy(ball_level(image, BONE + 1), {"cranium": level})

    def fixed(**options):
        options = cmfsim.KindOptions(sliding=False, **options)
        found = cmfsim.classify_nodes(nodes, triangles, anatomy, [bone], moved=[], options=options)
        return found.kinds.nodes("fixed")

    assert np.array_equal(fixed(bone_distance=1.0), np.sort(inner))
    assert len(fixed(bone_distance=1.0, facing=0.0)) == len(inner) + len(outer)


def test_the_nearest_of_two_bones_has_a_node_between_them():
    """A slab of tissue between two plates: the lower moves, the upper stays; both are in reach."""
    nodes, tets = meshes.box((6, 6, 1), (12.0, 12.0, 2.0))
    triangles = cmfsim.TetMesh(nodes, tets).boundary_triangles()
    image = cmfsim.ImageData(np.zeros((8, 8, 8)), (2, 2, 2))
    plate, cells = meshes.box((1, 1, 1), (40.0, 40.0, 4.0))
    faces = cmfsim.TetMesh(plate, cells).boundary_triangles()
    vertices = plate - [14.0, 14.0, 4.0]
    top = vertices + [0, 0, 6.0]
    segments = [
        cmfsim.BoneSegment("upper", image, cmfsim.SurfaceData(top, faces)),
        cmfsim.BoneSegment("lower", image, cmfsim.SurfaceData(vertices, faces)),
    ]
    found = cmfsim.classify_nodes(
        nodes,
        triangles,
        cmfsim.Anatomy(image, {}),
        segments,
        moved=["lower"],
        options=cmfsim.KindOptions(bone_distance=2.0, facing=0.0, sliding=False),
    )
    assert np.array_equal(found.kinds.nodes("joined", "lower"), np.flatnonzero(nodes[:, 2] == 0))
    assert np.array_equal(found.kinds.nodes("fixed"), np.flatnonzero(nodes[:, 2] == 2))
    assert found.counts["contested"] == len(nodes)


def test_what_holds_nothing_is_said(head):
    nodes, triangles, anatomy, segments, _, _ = head
    tiny = cmfsim.KindOptions(bone_distance=1e-9, sliding=False)
    away = tuple(
        cmfsim.BoneSegment(
            s.name,
            s.level,
            cmfsim.SurfaceData(np.asarray(s.surface.vertices) * 0.5, s.surface.triangles),
        )
        for s in segments
    )
    found = cmfsim.classify_nodes(nodes, triangles, anatomy, away, moved=["maxilla"], options=tiny)
    assert [(f.severity, f.code) for f in found.findings] == [
        ("warning", "segment-no-tissue"),
        ("error", "tissue-not-held"),
    ]
    assert cmfsim.segment_data(found.kinds, segments) == {}


def test_what_cannot_be_meant_is_named(head):
    nodes, triangles, anatomy, segments, _, _ = head

    def classify(segments=segments, moved=(), options=None, triangles=triangles, **more):
        return cmfsim.classify_nodes(
            nodes, triangles, anatomy, segments, moved=moved, options=options, **more
        )

    cases = [
        ({"segments": ()}, "no bone segment"),
        ({"segments": (segments[0], segments[0])}, "two segments have one name"),
        ({"moved": ["chin"]}, "moves 'chin'; segments are: 'cranium', 'maxilla'"),
        ({"moved": "maxilla"}, "a list of segment names"),
        ({"triangles": np.zeros((0, 3), int)}, "no boundary triangles"),
        ({"triangles": [[0, 1, 10**6]]}, r"boundary triangles\[0, 2\] is 1000000"),
        ({"fixed_planes": {"rear": ((0, 0, 0), (0, 0, 0))}}, "fixed plane 'rear' is"),
        (
            {"options": cmfsim.KindOptions(regions=(cmfsim.SlidingSphere("chin", (0, 0, 0), 1),))},
            "region on 'chin'",
        ),
    ]
    for arguments, complaint in cases:
        with pytest.raises(cmfsim.CaseError, match=complaint):
            classify(**arguments)
    made = [
        (lambda: cmfsim.KindOptions(bone_distance=0), "bone_distance is 0"),
        (lambda: cmfsim.KindOptions(facing=2), "facing is 2: 0 to 1"),
        (lambda: cmfsim.KindOptions(fixed_borders=("front",)), "use one of left"),
        (lambda: cmfsim.KindOptions(regions=("teeth",)), "SlidingBox or SlidingSphere"),
        (lambda: cmfsim.SlidingBox("a", (0, 0, 0), (1, 0, 1)), "must lie below"),
        (lambda: cmfsim.SlidingSphere("a", (0, 0, 0), 0), "radius is 0"),
    ]
    for make, complaint in made:
        with pytest.raises(cmfsim.CaseError, match=complaint):
            make()


@pytest.mark.parametrize("head_name", real_heads.HEADS)
def test_a_real_head_gets_kinds_that_hold_it_and_solve(head_name):
    """Le Fort I, BSSO and genioplasty; advanced jaws pull lips and chin along."""
    pytest.importorskip("pyvista")
    pytest.importorskip("skimage")
    anatomy = real_heads.anatomy(head_name)
    points = real_heads.landmarks(head_name)
    rear = points["gonion_L"][1] + 15.0
    nodes, tets = real_heads.tissue_mesh(head_name, 6.0, posterior=rear)
    mesh = cmfsim.TetMesh(nodes, tets)
    bones = real_heads.cut(head_name)
    back = nodes[:, 1].max()
    arches = cmfsim.dental_arches(anatomy, bones.segments, points)
    made = arch_sheets(anatomy, bones.segments, arches, cmfsim.KindOptions(), 4.0)
    found = cmfsim.classify_nodes(
        nodes,
        mesh.boundary_triangles(),
        anatomy,
        bones.segments,
        moved=["maxilla", "mandible_body", "chin"],
        landmarks=points,
        fixed_planes={"posterior": ((0, back, 0), (0, 1, 0))},
        contacts={name: sheet.surface for name, sheet in made.sheets.items()},
    )
    kinds, counts = found.kinds, found.counts
    assert found.findings == ()
    # At 6 mm a few hundred nodes lie on jaws, and none slides far behind the teeth.
    for name in ("maxilla", "mandible_body"):
        assert counts[f"joined on {name}"] > 30
        assert counts[f"sliding on {name}"] > 50
    assert counts["joined on chin"] > 15
    assert counts["sliding on cranium"] == 0
    for side in ("left", "right"):
        assert 0 < counts[f"sliding on ramus_{side}"] < 30
    assert set(np.flatnonzero(nodes[:, 1] == back)) <= set(kinds.nodes("fixed"))
    sliding = nodes[kinds.nodes("sliding")]
    bite = 0.5 * (points["supradentale"] + points["infradentale"])
    assert np.abs(sliding[:, 2] - bite[2]).max() < 35
    molars = max(points[n][1] for n in ("supra_m2_L", "supra_m2_R", "sub_m2_L", "sub_m2_R"))
    assert molars + 6.0 < sliding[:, 1].max() < molars + cmfsim.KindOptions().behind + 1.0
    contacts = made.of_scene(bones.segments, kinds)
    segments = cmfsim.segment_data(kinds, bones.segments, contacts=contacts)
    names = ["chin", "mandible_body", "maxilla", "ramus_left", "ramus_right"]
    assert sorted(segments) == names
    scene = cmfsim.Scene(
        nodes,
        tets,
        cmfsim.TissueData("isotropic", young=0.003, poisson=0.45),
        segments,
        {name: cmfsim.rigid_motion((2, -4, 3)) for name in segments},
        kinds.nodes("fixed"),
    )
    result = cmfsim.solve_scene(scene)
    moved = result.displacements
    joined = kinds.nodes("joined")
    np.testing.assert_allclose(moved[joined], np.tile([2, -4, 3], (len(joined), 1)), atol=1e-9)
    skin = np.flatnonzero(kinds.kind == 0)
    lip = skin[np.argmin(np.linalg.norm(nodes[skin] - (bite + [0, -10, 0]), axis=1))]
    brow = skin[np.argmin(np.linalg.norm(nodes[skin] - points["glabella"], axis=1))]
    assert -4.5 < moved[lip, 1] < -1.0
    assert abs(moved[brow, 1]) < 0.2
    assert np.abs(moved).max() < 12.0
