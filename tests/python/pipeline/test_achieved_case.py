"""`plan = "achieved"`: a case takes its plan from the bones after the operation."""

import re

import numpy as np
import pytest

import cmfsim
from cmfsim.bones.achieved import motion_by_vertices
from cmfsim.pipeline.building.case_checks import plan_sizes
from cmfsim.pipeline.building.surgery.motions import PlannedBones, planned_bones
from cmfsim.pipeline.building.surgery.postoperative import read_postoperative
from cmfsim.report.case import motion_blocks
from head_case import HeadCase, ellipsoid, icosphere
from pebbles import slid

pytest.importorskip("meshio")
pytest.importorskip("scipy")

JAW = cmfsim.rigid_motion((1.0, -5.0, 1.0), 4.0, (1, 0.3, 0), (3, -128, 1445))
BONES = """[postoperative.bones]
mandible = "mandible_after.ply"
cranium = "cranium_after.ply"
"""
FRAME = cmfsim.rigid_motion((12.0, -6.0, 6.0), 8.0, (1, 2, 3), (3, -100, 1500))


def carried(surface, matrix):
    vertices = np.asarray(surface.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    return cmfsim.SurfaceData(vertices, surface.triangles)


def knobbly(surface, centre):
    """A surface with bumps, so that it has no symmetry that would leave its place open."""
    vertices = np.asarray(surface.vertices)
    offset = vertices - centre
    away = np.linalg.norm(offset, axis=1, keepdims=True)
    wave = np.sin(offset @ [0.17, 0.05, 0.11]) + np.cos(offset @ [-0.06, 0.13, 0.21])
    return cmfsim.SurfaceData(vertices + 1.5 * wave[:, None] * offset / away, surface.triangles)


def operated(frame=None, rounds=4, *, aligned=True):
    """The head with all of it after the operation: the jaw moved, the cranium left alone."""
    head = HeadCase(rounds=3)
    after = {"mandible": ellipsoid("mandible", rounds), "cranium": ellipsoid("cranium", rounds)}
    for name, centre in (("mandible", (3, -128, 1445)), ("cranium", (3, -95, 1530))):
        head.surfaces[name] = knobbly(head.surfaces[name], np.array(centre))
        after[name] = knobbly(after[name], np.array(centre))
    after["mandible"] = carried(after["mandible"], JAW)
    after["face"] = head.surfaces["skin"]
    back = np.eye(4) if frame is None else np.linalg.inv(frame)
    for name, surface in after.items():
        head.surfaces[f"{name}_after"] = carried(surface, back)
    plan = head.toml[head.toml.index("[plan.mandible]") : head.toml.index("[tissue]")]
    head.replace(plan, "")
    head.replace("version = 1\n", 'version = 1\nplan = "achieved"\n')
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 14.0")
    head.toml += f'\n[postoperative]\nskin = "face_after.ply"\naligned = {str(aligned).lower()}\n'
    head.toml += BONES
    return head


def off(found, true):
    rest = cmfsim.decompose_motion(np.asarray(found) @ np.linalg.inv(true), (3, -128, 1445))
    return float(np.linalg.norm(rest.translation)), rest.angle


def test_bones_of_other_triangles_tell_the_plan(tmp_path):
    """Coarser before than after; the grid of a coarse mesh knows bone to half a millimetre."""
    case = cmfsim.Case.load(operated().write(tmp_path))
    assert case.achieved
    model = cmfsim.build_model(case, check=False)
    assert off(model.scene.plan["mandible"], JAW)[0] < 0.3
    assert off(model.scene.plan["mandible"], JAW)[1] < 0.5
    np.testing.assert_array_equal(model.scene.plan["cranium"], np.eye(4))
    prediction = cmfsim.predict_patient(model, "H")
    text = "\n".join(block.text for block in motion_blocks(prediction.summary))
    assert re.search(r"mandible +[01]\.\d\d +-[45]\.\d\d", text)
    moved = prediction.skin_displacements
    assert 2.0 < np.linalg.norm(moved, axis=1).max() < 8.0


def test_bones_of_the_same_triangles_tell_it_vertex_by_vertex(tmp_path):
    case = cmfsim.Case.load(operated(rounds=3).write(tmp_path))
    model = cmfsim.build_model(case, check=False)
    assert isinstance(model.scene.plan["mandible"], cmfsim.MovedSurface)
    found = model.summary["achieved"]["segments"]
    assert {name: entry["method"] for name, entry in found.items()} == {
        "cranium": "vertices",
        "mandible": "vertices",
    }
    assert found["mandible"]["angle_degrees"] == pytest.approx(4.0, abs=1e-3)
    prediction = cmfsim.predict_patient(model, "H")
    assert "Moved vertex by vertex" in motion_blocks(prediction.summary)[1].text
    result = prediction.result
    joined = np.asarray(model.scene.segments["mandible"].joined)
    nodes = np.asarray(model.scene.nodes)[joined]
    went = nodes @ JAW[:3, :3].T + JAW[:3, 3]
    np.testing.assert_allclose(nodes + np.asarray(result.displacements)[joined], went, atol=1e-9)


def achieved_bones(head, folder):
    """What the achieved plan makes of a head's bones, without a mesh."""
    case = cmfsim.Case.load(head.write(folder))
    # Levels part a torn bone; these hang together.
    level = cmfsim.ImageData(np.ones((2, 2, 2)), (1.0, 1.0, 1.0))
    names = ("cranium", "mandible")
    segments = tuple(cmfsim.BoneSegment(name, level, head.surfaces[name]) for name in names)
    return planned_bones(case, segments)


@pytest.mark.parametrize("ratio", [0.955, 0.966, 1.034, 1.046])
def test_another_size_of_paired_bones_is_reported_with_its_figure(ratio, tmp_path):
    """A few per cent about the bone's own middle would else count as motion, silently."""
    head = operated(rounds=3)
    assert not achieved_bones(head, tmp_path).findings
    after = head.surfaces["mandible_after"]
    vertices = np.asarray(after.vertices)
    middle = vertices.mean(axis=0)
    head.surfaces["mandible_after"] = cmfsim.SurfaceData(
        middle + ratio * (vertices - middle), after.triangles
    )
    (found,) = [f for f in achieved_bones(head, tmp_path).findings if f.code == "moved-scaled"]
    assert found.severity == "warning"
    assert f"mandible is {ratio:.3g} times as large" in found.what
    assert f"{abs(ratio - 1.0):.1%}" in found.why
    assert found.where.startswith("case.toml:")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda v: v / 10.0,
            "0.1 times as large after the operation as before (median of its edges): that is",
        ),
        (
            lambda v: np.random.default_rng(0).permutation(v),
            "the edges of mandible have other directions",
        ),
        (
            lambda v: v * [-1.0, 1.0, 1.0],
            "mandible is mirrored after the operation relative to before",
        ),
    ],
)
def test_paired_bones_that_are_not_one_bone_are_refused(change, words, tmp_path):
    head = operated(rounds=3)
    after = head.surfaces["mandible_after"]
    head.surfaces["mandible_after"] = cmfsim.SurfaceData(
        change(np.asarray(after.vertices)), after.triangles
    )
    with pytest.raises(cmfsim.CaseError, match=re.escape(words)):
        achieved_bones(head, tmp_path)


@pytest.mark.parametrize("ratio", [0.95, 1.04])
def test_bones_of_other_triangles_take_no_motion_from_their_size(ratio, tmp_path):
    """It is a warning with its interval, and the terminal states it; the motion is the jaw's."""
    head = operated(rounds=4)
    after = head.surfaces["mandible_after"]
    vertices = np.asarray(after.vertices)
    middle = vertices.mean(axis=0)
    grown = cmfsim.SurfaceData(middle + ratio * (vertices - middle), after.triangles)
    head.surfaces["mandible_after"] = grown
    found = achieved_bones(head, tmp_path)
    shift, turn = off(found.motions["mandible"], JAW)
    assert shift < 0.2
    assert turn < 0.3
    (finding,) = [f for f in found.findings if f.code == "moved-scaled"]
    assert finding.severity == "warning"
    assert re.search(r"95 % interval \d\.\d{3} to \d\.\d{3}, by its shape", finding.what)
    assert "the skull" not in finding.why
    shape = found.achieved.motions["mandible"].fit
    assert shape.scale_interval[0] < ratio < shape.scale_interval[1]
    text = motion_blocks({"plan": {}, "achieved": found.achieved.as_dict()})[1].text
    size = re.search(r"mandible .* (\d\.\d{3}) \(", text)
    assert float(size[1]) == pytest.approx(ratio, abs=0.01)


def test_a_scan_that_is_larger_as_a_whole_moves_the_jaw_and_says_by_how_much(tmp_path):
    """4 % about the skull's middle carry the jaw by millimetres that are no motion of it."""
    head = operated(rounds=4)
    middle = np.array([3.0, -95.0, 1530.0])
    for name in ("mandible_after", "cranium_after"):
        surface = head.surfaces[name]
        vertices = middle + 1.04 * (np.asarray(surface.vertices) - middle)
        head.surfaces[name] = cmfsim.SurfaceData(vertices, surface.triangles)
    found = achieved_bones(head, tmp_path)
    excess = off(found.motions["mandible"], JAW)[0]
    assert excess > 1.0
    (finding,) = [
        f for f in found.findings if f.code == "moved-scaled" and f.what.startswith("mandible")
    ]
    shift = re.search(r"the skull is 1\.\d+ times .* \((.*)\) mm of the motion", finding.why)
    stated = np.array([float(x) for x in shift[1].split(",")])
    assert np.linalg.norm(stated) == pytest.approx(excess, rel=0.25)


def test_the_scan_before_given_as_the_one_after_is_a_warning(tmp_path):
    """Registration never gives the identity, so what moved is compared with a millimetre."""
    case = cmfsim.Case.load(operated().write(tmp_path))
    level = cmfsim.ImageData(np.zeros((2, 2, 2)), (1, 1, 1))
    jaw = cmfsim.BoneSegment("mandible", level, ellipsoid("mandible"))
    for far, codes in ((0.02, ["plan-still"]), (3.0, [])):
        planned = PlannedBones((jaw,), {"mandible": cmfsim.rigid_motion((0, far, 0))})
        found = plan_sizes(case, planned, [])
        assert [f.code for f in found] == codes
        assert all("0.02 mm between the two scans" in f.what for f in found)


def test_slip_of_a_fitted_mesh_is_taken_off_and_said(tmp_path):
    """Two millimetres of slip: by vertices the jaw would go elsewhere."""
    head = operated(rounds=4)
    before = HeadCase(rounds=3).surfaces["mandible"]
    before = knobbly(before, np.array((3, -128, 1445)))
    after = carried(slid(before, 2.0, seed=4), JAW)
    head.surfaces["mandible_after"] = after
    by_vertices = motion_by_vertices(before, after)
    assert max(off(by_vertices.matrix, JAW)) > 0.5
    found = achieved_bones(head, tmp_path)
    assert isinstance(found.motions["mandible"], np.ndarray)
    assert off(found.motions["mandible"], JAW)[0] < 0.2
    (finding,) = [f for f in found.findings if f.code == "motion-slip"]
    assert finding.severity == "note"
    assert re.search(r"mandible slid along its surface by [12]\.\d mm", finding.what)


def test_resected_bone_of_a_fitted_mesh_is_no_segment_of_its_own(tmp_path):
    """A template squeezes the resected end on to the stump, which looks torn off and moved."""
    head = operated(rounds=3)
    before = head.surfaces["mandible"]
    vertices = np.array(before.vertices)
    stump = np.quantile(vertices[:, 0], 0.85)
    vertices[:, 0] = np.minimum(vertices[:, 0], stump)
    head.surfaces["mandible_after"] = carried(cmfsim.SurfaceData(vertices, before.triangles), JAW)
    found = achieved_bones(head, tmp_path)
    assert [segment.name for segment in found.segments] == ["cranium", "mandible"]
    assert max(off(found.motions["mandible"], JAW)) < 0.3
    (finding,) = [f for f in found.findings if f.code == "bone-removed"]
    assert finding.severity == "warning"


def test_a_chin_that_is_no_segment_bends_the_jaw_and_is_a_warning(tmp_path):
    head = operated(rounds=3)
    after = head.surfaces["mandible_after"]
    vertices = np.array(after.vertices)
    front = 1.0 / (1.0 + np.exp(vertices[:, 1] - np.quantile(vertices[:, 1], 0.15)))
    vertices[:, 1] -= 5.0 * front
    head.surfaces["mandible_after"] = cmfsim.SurfaceData(vertices, after.triangles)
    found = achieved_bones(head, tmp_path)
    assert isinstance(found.motions["mandible"], cmfsim.MovedSurface)
    (finding,) = [f for f in found.findings if f.code == "motion-bent"]
    assert finding.severity == "warning"
    assert "[[osteotomies]]" in finding.fix


def test_paired_bones_of_sizes_that_are_no_bone_s_are_followed_and_named(tmp_path):
    """0.7 times as large: no shape is compared; both warnings say that vertices are followed."""
    head = operated(rounds=3)
    after = head.surfaces["mandible_after"]
    vertices = np.asarray(after.vertices)
    middle = vertices.mean(axis=0)
    small = cmfsim.SurfaceData(middle + 0.7 * (vertices - middle), after.triangles)
    head.surfaces["mandible_after"] = small
    found = achieved_bones(head, tmp_path)
    assert isinstance(found.motions["mandible"], cmfsim.MovedSurface)
    codes = [f.code for f in found.findings if f.severity == "warning"]
    assert sorted(codes) == ["motion-bent", "moved-scaled"]


def test_a_smooth_bone_leaves_a_turn_open_and_is_a_warning(tmp_path):
    """An ellipsoid of almost equal axes, remeshed: its turn cannot be seen."""
    head = operated(rounds=4)
    ball = icosphere(3)
    for name, (vertices, triangles) in (("mandible", ball), ("mandible_after", icosphere(4))):
        head.surfaces[name] = cmfsim.SurfaceData(20.0 * vertices + [3.0, -128.0, 1445.0], triangles)
    found = achieved_bones(head, tmp_path)
    opened = [f for f in found.findings if f.code == "motion-open"]
    assert len(opened) == 3
    assert all(f.severity == "warning" for f in opened)
    assert "this part of the motion may be wrong" in opened[0].why
    text = motion_blocks({"plan": {}, "achieved": found.achieved.as_dict()})[1].text
    assert "3 of 6 open" in text


@pytest.mark.parametrize("rounds", [3, 4])
def test_surfaces_in_another_frame_are_laid_on_by_the_skull(rounds, tmp_path):
    """15 mm and 8° away; skin and landmarks come along."""
    case = cmfsim.Case.load(operated(FRAME, rounds, aligned=False).write(tmp_path))
    found = read_postoperative(case)
    assert off(found.alignment, FRAME)[0] < 0.3
    assert off(found.alignment, FRAME)[1] < 0.3
    before = np.asarray(HeadCase(rounds=3).surfaces["skin"].vertices)
    apart = np.linalg.norm(np.asarray(found.skin.vertices) - before, axis=1)
    assert apart.max() < 0.6


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"achieved"', '"achived"', "case.toml:3: plan is 'achived': tables [plan.SEGMENT]"),
        ('"achieved"', "3", "case.toml:3: plan is 3"),
        (BONES, "", 'case.toml:3: plan is "achieved", but the case has no'),
        ('skin = "face_after.ply"', 'image = "ct.nrrd"', "is given together with image"),
    ],
)
def test_an_achieved_plan_is_checked_where_the_case_is_read(old, new, words, tmp_path):
    head = operated()
    head.replace(old, new)
    with pytest.raises(cmfsim.CaseError, match=re.escape(words)):
        cmfsim.Case.load(head.write(tmp_path))


def test_what_cannot_be_read_off_is_named(tmp_path):
    head = operated(aligned=False)
    head.replace('cranium = "cranium_after.ply"\n', "")
    with pytest.raises(cmfsim.CaseError, match="aligned on the skull"):
        read_postoperative(cmfsim.Case.load(head.write(tmp_path)))
    head = operated()
    head.replace('mandible = "mandible_after.ply"', 'jaw = "mandible_after.ply"')
    with pytest.raises(cmfsim.CaseError, match="no bone or segment 'jaw'"):
        cmfsim.build_model(cmfsim.Case.load(head.write(tmp_path)), check=False)
    head.replace('skin = "face_after.ply"\n', "")
    with pytest.raises(cmfsim.CaseError, match="no face to compare with"):
        cmfsim.evaluate(cmfsim.Case.load(head.write(tmp_path)), ["H"])
    head.replace('"mandible_after.ply"', '"gone.ply"')
    findings = cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path)))
    assert "postoperative.bones.jaw" in findings[0].where


@pytest.mark.parametrize("is_there", [True, False])
def test_a_piece_that_moved_otherwise_or_was_removed_is_a_warning_of_the_build(is_there, tmp_path):
    """A chin that was advanced and is no segment; an end of the jaw that was resected."""
    head = operated(rounds=4)
    after = head.surfaces["mandible_after"]
    vertices = np.array(after.vertices)
    chin = vertices[:, 1] < np.quantile(vertices[:, 1], 0.12)
    if is_there:
        vertices[chin] += [0.0, -6.0, 0.0]
    else:
        # The left end of the jaw, to a flat stump.
        stump = np.quantile(vertices[:, 0], 0.7)
        vertices[:, 0] = np.minimum(vertices[:, 0], stump)
    head.surfaces["mandible_after"] = cmfsim.SurfaceData(vertices, after.triangles)
    model = cmfsim.build_model(cmfsim.Case.load(head.write(tmp_path)), check=False)
    (found,) = [f for f in model.findings if f.code == "achieved-piece-off"]
    assert found.severity == "warning"
    assert found.where.startswith("case.toml:")
    assert re.search(r"\d\.\d cm² of mandible about \(.*\) mm", found.what)
    assert ("this piece moved differently from the segment" in found.what) == is_there
    assert ("removed, outside the scan" in found.what) != is_there
    assert "[[osteotomies]]" in found.fix
    assert "achieved-piece-off" in [f["code"] for f in model.summary["findings"]]
    (patch,) = model.summary["achieved"]["segments"]["mandible"]["stray"]
    assert patch["area_mm2"] > 100.0
    assert patch["has_bone"] == is_there
    assert not model.summary["achieved"]["segments"]["cranium"]["stray"]
