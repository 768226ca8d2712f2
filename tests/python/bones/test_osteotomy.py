"""Osteotomies: exact pieces of boxes, and real skulls cut as a surgeon would."""

import itertools
import re

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes.angles import angle_between
from cmfsim.bones.cuts import procedures
from cmfsim.bones.cuts.procedures import PROCEDURES
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level

pytest.importorskip("skimage")
pytest.importorskip("scipy")

SPACING = 1.0
UNDECIMATED = SurfaceOptions(max_triangles=10**6, smoothing=0)
# BodyParts3D file numbers of the teeth, one side after the other.
UPPER_TEETH = (55680, 55681, 55682, 55683, *range(55688, 55692), *range(55697, 55701), 55798, 55799)
LOWER_TEETH = (57140, 57141, 57142, 57143, *range(55692, 55696), *range(55703, 55707), 55686, 55687)


def box_level(low, high, *, size=40, spacing=SPACING, limit=2.0):
    """The level of a box: distance to its nearest face, clipped."""
    image = cmfsim.ImageData(np.zeros((size,) * 3), [spacing] * 3)
    inside = [
        np.minimum(axis - a, b - axis) for axis, a, b in zip(image.axes(), low, high, strict=True)
    ]
    level = np.minimum(np.minimum(inside[0], inside[1]), inside[2])
    return image.with_values(np.clip(level, -limit, limit).astype(np.float32))


def volume(segment):
    """Volume of a segment's surface, which must be closed and point outwards, mm³."""
    surface = cmfsim.Surface(segment.surface.vertices, segment.surface.triangles)
    assert surface.is_closed
    return surface.volume


@pytest.fixture(scope="module")
def box():
    return box_level((5.5, 5.5, 5.5), (30.5, 25.5, 20.5))


@pytest.mark.parametrize("normal", [(0, 0, -1), (1, 0, 0), (1, 1, 1), (-2, 0.5, 1)])
def test_pieces_part_a_bone_without_loss_along_the_plane(box, normal):
    """Half-spaces through the middle of a box halve it; the piece lies on the normal's side."""
    plane = cmfsim.CuttingPlane((18, 15.5, 13), normal)
    cut = cmfsim.free_cut("mandible", "chin", (plane,), rest="mandible_body")
    found = cmfsim.cut_bones({"mandible": box}, [cut])
    chin, body = found["chin"], found["mandible_body"]
    either = np.maximum(chin.level.values, body.level.values)
    both = np.minimum(chin.level.values, body.level.values)
    assert (both <= 0.0).all()
    # Voxels that lie on the plane itself belong to neither by their sign, and to both by zero.
    away = np.abs(sum(plane.distance_along(box)))
    assert ((either > 0.0) == (box.values > 0.0))[away > 1e-4].all()
    for segment, side in ((chin, 1.0), (body, -1.0)):
        assert volume(segment) == pytest.approx(25 * 20 * 15 / 2, rel=0.03)
        vertices = np.asarray(segment.surface.vertices)
        assert (side * plane.distance(vertices)).min() > -0.35 * SPACING
        on_plane = np.abs(plane.distance(vertices)) < 0.1
        assert on_plane.sum() > 100


def test_the_cut_lies_on_the_plane_between_voxels(box):
    """Unsmoothed, vertices of the cut face lie on an oblique plane; levels are clipped tightly."""
    tight = box.with_values(np.clip(box.values, -0.3, 0.3))
    plane = cmfsim.CuttingPlane((18.3, 15.2, 13.1), (0.3, 0.2, 1.0))
    surface = SurfaceOptions(smoothing=0)
    cut = cmfsim.free_cut("mandible", "chin", (plane,))
    found = cmfsim.cut_bones({"mandible": tight}, [cut], surface=surface)
    vertices = np.asarray(found["chin"].surface.vertices)
    middle = (np.abs(vertices[:, 0] - 18) < 10) & (np.abs(vertices[:, 1] - 15.5) < 8)
    face = vertices[middle & (vertices[:, 2] < 19)]
    assert len(face) > 200
    assert np.abs(plane.distance(face)).max() < 1e-4


def test_a_crumb_stays_with_the_bone_that_it_hangs_on(monkeypatch):
    """A plane through a U leaves two prongs above: the small one joins the rest, and is said."""
    u = np.maximum.reduce(
        [
            box_level((5.5, 5.5, 5.5), (34.5, 15.5, 15.5)).values,
            box_level((5.5, 5.5, 5.5), (15.5, 15.5, 30.5)).values,
            box_level((28.5, 5.5, 5.5), (34.5, 15.5, 25.5)).values,
        ]
    )
    level = box_level((0, 0, 0), (1, 1, 1)).with_values(u)
    plane = cmfsim.CuttingPlane((0, 0, 20), (0, 0, 1))
    cut = cmfsim.free_cut("mandible", "top", (plane,))
    found = cmfsim.cut_bones({"mandible": level}, [cut])
    assert [f.code for f in found.findings] == ["osteotomy-parts"]
    assert "separated from 'top': 1, 300 mm³" in found.findings[0].what
    assert np.asarray(found["top"].surface.vertices)[:, 0].max() < 17
    assert volume(found["top"]) == pytest.approx(10 * 10 * 10.5, rel=0.05)
    assert volume(found["mandible"]) == pytest.approx(29 * 100 + 10 * 45 + 6 * 100, rel=0.05)
    monkeypatch.setattr("cmfsim.bones.cuts.cutting.CRUMB_VOLUME", 0.0)
    kept = cmfsim.cut_bones({"mandible": level}, [cut])
    assert [f.code for f in kept.findings] == ["osteotomy-parts"]
    assert np.asarray(kept["top"].surface.vertices)[:, 0].max() > 33


def test_a_level_that_reaches_the_border_has_a_closed_surface():
    level = box_level((-5, -5, -5), (20, 20, 20), size=30)
    segment = cmfsim.BoneSegment("cranium", level, surface_of_level("cranium", level))
    # From half a voxel or less outside the first voxel's centre.
    assert volume(segment) == pytest.approx(20.5**3, rel=0.05)


def test_a_contact_surface_bridges_the_gaps_between_teeth(box):
    """Slots of 2 mm between ridges of 4 mm: the blurred surface stays near the ridges' tops."""
    x, _, z = box.axes()
    slots = np.where((x % 6.0) < 2.0, 14.5 - z, 100.0)
    combed = box.with_values(np.minimum(box.values, slots).astype(np.float32))
    bone = cmfsim.BoneSegment("maxilla", combed, surface_of_level("maxilla", combed))
    contact = cmfsim.contact_surface(bone, relief=2.0)
    surface = cmfsim.Surface(contact.vertices, contact.triangles)
    assert surface.is_closed
    inner = np.abs(np.asarray(contact.vertices) - [18, 15.5, 20])
    top = np.asarray(contact.vertices)[(inner < [8, 5, 9]).all(axis=1)][:, 2]
    tops = np.asarray(bone.surface.vertices)
    own = tops[(np.abs(tops - [18, 15.5, 20]) < [8, 5, 9]).all(axis=1)][:, 2]
    assert np.ptp(own) > 5.0
    assert np.ptp(top) < 2.0
    assert 16.0 < top.mean() < 20.5
    # A flat face far from edges stays where it is.
    low = np.asarray(contact.vertices)
    floor = low[(np.abs(low - [18, 15.5, 5.5]) < [4, 3, 3]).all(axis=1)][:, 2]
    assert np.abs(floor - 5.5).max() < 0.6
    with pytest.raises(cmfsim.CaseError, match="relief is 0"):
        cmfsim.contact_surface(bone, relief=0)


def test_ready_surfaces_are_segments_as_they_are(box):
    ready = surface_of_level("maxilla", box)
    other = box_level((5.5, 5.5, 22.5), (30.5, 25.5, 35.5))
    segments = cmfsim.segments_from_surfaces(
        {"maxilla": box, "cranium": other}, {"maxilla": ready, "skin": ready}
    )
    assert [s.name for s in segments] == ["maxilla", "cranium"]
    assert segments[0].surface is ready
    with pytest.raises(cmfsim.CaseError, match="'chin' has no level"):
        cmfsim.segments_from_surfaces({"maxilla": box}, {"chin": ready})


def test_cuts_that_cannot_be_made_are_named(box):
    above = cmfsim.CuttingPlane((0, 0, 35), (0, 0, 1), "too high")
    miss = cmfsim.free_cut("mandible", "chin", (above,))
    with pytest.raises(cmfsim.CaseError, match=r"'chin' from 'mandible' misses .*too high"):
        cmfsim.cut_bones({"mandible": box}, [miss])
    below = cmfsim.CuttingPlane((0, 0, 35), (0, 0, -1), "too low")
    whole = cmfsim.free_cut("mandible", "chin", (below,))
    with pytest.raises(cmfsim.CaseError, match=r"takes the whole bone .*too low"):
        cmfsim.cut_bones({"mandible": box}, [whole])
    half = cmfsim.free_cut("mandible", "chin", (cmfsim.CuttingPlane((0, 0, 13), (0, 0, 1)),))
    with pytest.raises(cmfsim.CaseError, match="free cuts 'mandible', but the bones are 'skull'"):
        cmfsim.cut_bones({"skull": box}, [half])
    with pytest.raises(cmfsim.CaseError, match="'chin', but a segment of this name already exists"):
        cmfsim.cut_bones({"mandible": box}, [half, half])
    with pytest.raises(cmfsim.CaseError, match="no bone"):
        cmfsim.cut_bones({}, [half])
    other = box_level((5, 5, 5), (9, 9, 9), size=20)
    with pytest.raises(cmfsim.CaseError, match="not on the same grid"):
        cmfsim.cut_bones({"mandible": box, "cranium": other}, [half])
    with pytest.raises(cmfsim.CaseError, match="'nose'; segments are: 'mandible', 'chin'"):
        cmfsim.cut_bones({"mandible": box}, [half])["nose"]


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (
            lambda: cmfsim.CuttingPlane((0, 0, 0), (0, 0, 0), "flat"),
            r"'flat' normal is \(0, 0, 0\)",
        ),
        (lambda: cmfsim.CuttingPlane((0, 0, np.nan), (0, 0, 1)), "point.* must be finite"),
        (lambda: cmfsim.CuttingPlane((0, 0), (0, 0, 1)), "shape"),
        (lambda: cmfsim.free_cut("mandible", "chin", ()), "without planes"),
        (lambda: SurfaceOptions(max_triangles=10), "max_triangles is 10"),
        (lambda: SurfaceOptions(smoothing=-1), "smoothing is -1"),
        (lambda: cmfsim.procedure_options("le_fort_2"), "use one of le_fort_1"),
    ],
)
def test_values_that_cannot_be_meant_are_refused(make, complaint):
    with pytest.raises(cmfsim.CaseError, match=complaint):
        make()


def ideal_landmarks(*, mirror=1.0):
    """A symmetric skull in round numbers, mm: x left (times `mirror`), y back, z up."""
    middle = {
        "nasion": (-85, 60),
        "supradentale": (-90, 0),
        "infradentale": (-86, -19),
        "menton": (-80, -50),
    }
    pairs = {
        "supra_m2": (30, -50, 5),
        "supraorbital": (28, -78, 70),
        "suborbital": (28, -70, 30),
        "lateral_orbit": (48, -62, 35),
        "zygomatic_arch": (62, -30, 35),
        "sub_m2": (34, -46, -25),
        "occlusal_line": (38, -42, -9),
        "gonion": (42, -14, -25),
    }
    points = {n: np.array([0.0, y, z]) for n, (y, z) in middle.items()}
    for (name, (x, y, z)), side in itertools.product(pairs.items(), "LR"):
        points[f"{name}_{side}"] = np.array([(1 if side == "L" else -1) * mirror * x, y, z])
    return points


@pytest.mark.parametrize("kind", PROCEDURES)
def test_at_most_three_landmarks_are_asked_for_and_suffice(kind):
    points = ideal_landmarks()
    with pytest.raises(cmfsim.LandmarkError, match=f"^{kind} needs the landmark") as refused:
        cmfsim.place_procedure(kind, {"pogonion": [0, -80, -40], "rhinion": [0, -90, 40]})
    asked = [name for name in points if re.search(rf"\b{name}\b", str(refused.value))]
    assert 1 <= len(asked) <= 3
    placed = cmfsim.place_procedure(kind, {name: points[name] for name in asked})
    whole = cmfsim.place_procedure(kind, points)
    for cut, other in zip(placed.cuts, whole.cuts, strict=True):
        assert cut.segment == other.segment
    estimated = [f for f in placed.findings if f.code == "cut-site-estimated"]
    assert len(estimated) == (kind != "le_fort_1")
    if kind == "le_fort_1":
        ours, theirs = (p.cuts[0].groups[0][0] for p in (placed, whole))
        assert np.allclose([ours.point, ours.normal], [theirs.point, theirs.normal])


@pytest.mark.parametrize("kind", PROCEDURES)
@pytest.mark.parametrize("head", real_heads.HEADS)
def test_a_missing_landmark_is_estimated_from_the_others_and_reported(kind, head):
    """Within 7.6 mm of where a person placed it, where the other side shows its partner 5 mm."""
    points = real_heads.landmarks(head)
    for name in procedures.NEEDED[kind]:
        less = {n: p for n, p in points.items() if n != name}
        found, (finding,) = procedures.with_missing_sites(kind, less)
        assert finding.code == "cut-site-estimated"
        assert f"with {name} estimated" in finding.what
        partner = name[:-1] + {"L": "R", "R": "L"}.get(name[-1], "")
        limit = 5.0 if partner != name and partner in points else 7.6
        assert np.linalg.norm(found[name] - points[name]) < limit, name
        assert finding in cmfsim.place_procedure(kind, less).findings


@pytest.mark.parametrize("kind", PROCEDURES)
def test_options_are_checked_by_name_and_range(kind):
    points = ideal_landmarks()
    for name, default in cmfsim.procedure_options(kind).items():
        placed = cmfsim.place_procedure(kind, points, {name: default})
        assert placed.options == cmfsim.procedure_options(kind)
        with pytest.raises(cmfsim.CaseError, match=f"^{kind} {name} is 500: .* is allowed"):
            cmfsim.place_procedure(kind, points, {name: 500})
        with pytest.raises(cmfsim.CaseError, match="a number is needed"):
            cmfsim.place_procedure(kind, points, {name: "high"})
    with pytest.raises(cmfsim.CaseError, match=f"{kind} has no option 'depth': use "):
        cmfsim.place_procedure(kind, points, {"depth": 1.0})


def test_landmarks_in_one_place_are_refused():
    points = ideal_landmarks()
    points["supra_m2_R"] = points["supra_m2_L"]
    with pytest.raises(cmfsim.LandmarkError, match="coincide"):
        cmfsim.place_procedure("le_fort_1", points)
    points["supra_m2_R"] = np.array([np.nan, 0, 0])
    with pytest.raises(cmfsim.LandmarkError, match="'supra_m2_R' of le_fort_1"):
        cmfsim.place_procedure("le_fort_1", points)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("turned", [None, ((1, 2, 3), 70.0)])
def test_left_is_where_the_landmarks_say_in_any_position(mirror, turned):
    """Placing moved landmarks gives the moved planes; L stays L in a mirrored image."""
    points = ideal_landmarks(mirror=mirror)
    motion = np.eye(4)
    if turned:
        motion = cmfsim.rigid_motion((5, -3, 2), turned[1], turned[0], (10, 20, 30))
    moved = {n: motion[:3, :3] @ p + motion[:3, 3] for n, p in points.items()}
    samples = np.random.default_rng(0).uniform(-100, 100, (200, 3))
    there = samples @ motion[:3, :3].T + motion[:3, 3]
    for kind in PROCEDURES:
        for one, other in zip(
            cmfsim.place_procedure(kind, points).cuts,
            cmfsim.place_procedure(kind, moved).cuts,
            strict=True,
        ):
            assert one.segment == other.segment
            for p, q in zip(
                itertools.chain(*one.groups), itertools.chain(*other.groups), strict=True
            ):
                np.testing.assert_allclose(p.distance(samples), q.distance(there), atol=1e-9)
    left = cmfsim.place_procedure("bsso", points).cuts[0]
    assert left.segment == "ramus_left"
    at = points["gonion_L"]
    assert all(p.distance([at])[0] > 0 for p in left.groups[0])
    assert left.groups[0][0].distance([points["gonion_R"]])[0] < 0


def test_options_move_the_planes_by_what_they_say():
    """Heights in mm along the jaw's own axis, angles in degrees, signs as documented."""
    points = ideal_landmarks()

    def plane(kind, cut=0, group=0, number=0, **options):
        placed = cmfsim.place_procedure(kind, points, options)
        return placed.cuts[cut].groups[group][number]

    def angle(p, q):
        return angle_between(p.normal, q.normal)

    base, higher = plane("le_fort_1"), plane("le_fort_1", height=9.0)
    assert angle(base, higher) < 1e-6
    up = points["nasion"] - points["supradentale"]
    assert higher.distance([base.point])[0] == pytest.approx(4.0, rel=0.02)
    tip = points["supradentale"]
    raised = plane("le_fort_1", tilt=5.0)
    assert angle(base, raised) == pytest.approx(5.0)
    assert raised.distance([tip])[0] > base.distance([tip])[0]
    canted = plane("le_fort_1", cant=5.0)
    left = points["supra_m2_L"]
    assert canted.distance([left])[0] > base.distance([left])[0]
    chin, steep = plane("genioplasty"), plane("genioplasty", tilt=10.0)
    assert angle(chin, steep) == pytest.approx(5.0)
    back = points["sub_m2_L"]
    assert steep.distance([back])[0] < chin.distance([back])[0]
    split, straight = plane("bsso", number=1), plane("bsso", number=1, angle=0.0)
    assert angle(split, straight) == pytest.approx(50.0)
    gonion = points["gonion_L"]
    later = plane("bsso", number=1, angle=0.0, setback=10.0)
    assert straight.distance([gonion])[0] - later.distance([gonion])[0] == pytest.approx(5, rel=0.1)
    assert up[2] > 0


def teeth(numbers):
    """Vertices of the real teeth of the atlas head, (n, 3) mm."""
    folder = real_heads.data_folder() / "bodyparts3d"
    found = []
    for number in numbers:
        (path,) = folder.rglob(f"FMA{number}.obj")
        text = path.read_text(encoding="utf-8")
        found += re.findall(r"^v (\S+) (\S+) (\S+)", text, re.MULTILINE)
    return np.array(found, dtype=float)


def test_cuts_pass_above_upper_and_below_lower_roots_of_a_real_head():
    """Against the real tooth roots of the head that the landmarks were placed on."""
    points = real_heads.landmarks("atlas_head")
    upper, lower = teeth(UPPER_TEETH), teeth(LOWER_TEETH)
    le_fort = cmfsim.place_procedure("le_fort_1", points).cuts[0].groups[0][0]
    clearance = le_fort.distance(upper).min()
    assert 3.0 < clearance < 8.0
    for side in "LR":
        # Below the orbital rim, above the nasal floor.
        assert le_fort.distance([points[f"suborbital_{side}"]])[0] < -5.0
    assert le_fort.distance([points["mid_philtrum"]])[0] > 5.0
    placed = cmfsim.place_procedure("genioplasty", points)
    chin = placed.cuts[0].groups[0][0]
    # This chin is 22 mm high: no room for the usual clearance, which is said.
    assert chin.distance(lower).max() < 0.0
    assert chin.distance([points["menton"]])[0] > 3.0
    assert [f.code for f in placed.findings] == ["chin-short"]
    for cut in cmfsim.place_procedure("bsso", points).cuts:
        depth = np.max(
            [np.min([p.distance(lower) for p in group], axis=0) for group in cut.groups], axis=0
        )
        assert depth.max() < -0.5, cut.segment


@pytest.fixture(scope="module", params=real_heads.HEADS)
def cut_head(request):
    pytest.importorskip("pyvista")
    anatomy = real_heads.anatomy(request.param)
    points = real_heads.landmarks(request.param)
    return request.param, anatomy, points, real_heads.cut(request.param)


def test_le_fort_bsso_and_genioplasty_together_cut_a_real_head(cut_head):
    head, anatomy, points, found = cut_head
    names = ("cranium", "mandible_body", "maxilla", "ramus_left", "ramus_right", "chin")
    assert tuple(s.name for s in found.segments) == names
    assert [p.kind for p in found.procedures] == ["le_fort_1", "bsso", "genioplasty"]
    volumes = {s.name: volume(s) for s in found.segments}
    # Nothing lost: pieces of a jaw add up to the jaw, within the smoothing of thin edges.
    for bone, parts in {
        "cranium": ("cranium", "maxilla"),
        "mandible": ("mandible_body", "ramus_left", "ramus_right", "chin"),
    }.items():
        whole = (anatomy.bones[bone].values > 0).sum() * 8.0
        assert sum(volumes[p] for p in parts) == pytest.approx(whole, rel=0.03), bone
        voxels = sum((found[p].level.values > 0).sum() for p in parts) * 8.0
        assert voxels == pytest.approx(whole, rel=1e-3)
    assert volumes["ramus_left"] == pytest.approx(volumes["ramus_right"], rel=0.15)
    assert all(len(s.surface.triangles) <= 30_300 for s in found.segments)

    def owner(label):
        """The segment whose surface a landmark lies nearest to."""
        at = points[label][np.newaxis]
        distance = {}
        for s in found.segments:
            surface = cmfsim.Surface(s.surface.vertices, s.surface.triangles)
            distance[s.name] = np.linalg.norm(surface.closest(at)[0] - at)
        return min(distance, key=distance.get)

    wanted = {"nasion": "cranium", "suborbital_L": "cranium", "zygomatic_arch_R": "cranium"}
    wanted |= dict.fromkeys(("supradentale", "mid_philtrum", "supra_m2_L", "supra_m2_R"), "maxilla")
    wanted |= dict.fromkeys(("infradentale", "sub_m2_L", "sub_m2_R"), "mandible_body")
    wanted |= {"gonion_L": "ramus_left", "gonion_R": "ramus_right", "menton": "chin"}
    assert {label: owner(label) for label in wanted} == wanted, head


def test_le_fort_3_takes_nose_and_zygomas_and_leaves_the_brow(cut_head):
    head, anatomy, points, _ = cut_head
    bones = {"cranium": anatomy.bones["cranium"]}
    found = cmfsim.cut_bones(bones, {"le_fort_3": {}}, landmarks=points, surface=UNDECIMATED)
    assert [s.name for s in found.segments] == ["cranium", "midface"]
    volume(found["midface"])
    surfaces = {
        s.name: cmfsim.Surface(s.surface.vertices, s.surface.triangles) for s in found.segments
    }

    def is_midface(label):
        at = points[label][np.newaxis]
        far = {n: np.linalg.norm(s.closest(at)[0] - at) for n, s in surfaces.items()}
        return far["midface"] < far["cranium"]

    ours = ("rhinion", "supradentale", "suborbital_L", "suborbital_R", "lateral_orbit_L",
            "lateral_orbit_R", "inferior_malar_L", "supra_m2_R")  # fmt: skip
    theirs = ("glabella", "supraorbital_L", "supraorbital_R", "supraglenoid_L", "supraglenoid_R",
              "frontal_eminence_L")  # fmt: skip
    assert [is_midface(n) for n in ours] == [True] * len(ours), head
    assert [is_midface(n) for n in theirs] == [False] * len(theirs), head


def test_le_fort_1_inside_le_fort_3_makes_three_pieces():
    anatomy, points = real_heads.anatomy("ct_phantom"), real_heads.landmarks("ct_phantom")
    bones = {"cranium": anatomy.bones["cranium"]}
    plan = {"le_fort_1": {}, "le_fort_3": {}}
    found = cmfsim.cut_bones(bones, plan, landmarks=points, surface=UNDECIMATED)
    assert [s.name for s in found.segments] == ["cranium", "midface", "maxilla"]


@pytest.mark.parametrize("kind", ["bsso", "genioplasty"])
def test_jaws_that_were_not_parted_are_refused_where_the_lower_one_is_cut(box, kind):
    with pytest.raises(
        cmfsim.CaseError, match=f"{kind} cuts .*'skull': separate the jaws .*landmarks"
    ):
        cmfsim.cut_bones({"skull": box}, {kind: {}}, landmarks=ideal_landmarks())


@pytest.mark.parametrize("head", real_heads.HEADS)
def test_the_lower_jaw_stays_where_the_maxilla_is_cut_from_joined_jaws(head):
    anatomy, points = real_heads.anatomy(head), real_heads.landmarks(head)
    cranium, mandible = anatomy.bones["cranium"], anatomy.bones["mandible"]
    joined = cranium.with_values(np.maximum(cranium.values, mandible.values))
    found, parted = (
        cmfsim.cut_bones(bones, {"le_fort_1": {}}, landmarks=points, surface=UNDECIMATED)
        for bones in ({"skull": joined}, {"cranium": cranium})
    )
    assert "cut-of-joined-jaws" in {finding.code for finding in found.findings}
    assert "cut-of-joined-jaws" not in {finding.code for finding in parted.findings}
    piece, whole = (cut["maxilla"].level.values > 0.0 for cut in (found, parted))
    lower = mandible.values > 0.0
    # The front of the rami, beside the tuberosities of the atlas head, is within the cut.
    limit = {"ct_phantom": 0.03, "atlas_head": 0.1}[head]
    assert np.count_nonzero(piece & lower) < limit * np.count_nonzero(lower)
    assert np.count_nonzero(piece & whole) > 0.9 * np.count_nonzero(whole)


def test_the_same_head_is_cut_to_the_same_bits(cut_head):
    head, anatomy, points, found = cut_head
    bones = {"mandible": anatomy.bones["mandible"]}
    again = cmfsim.cut_bones(bones, {"bsso": {}, "genioplasty": {}}, landmarks=points)
    for name in ("mandible_body", "ramus_left", "chin"):
        one, other = found[name].surface, again[name].surface
        assert np.array_equal(one.vertices, other.vertices), (head, name)
        assert np.array_equal(one.triangles, other.triangles)
