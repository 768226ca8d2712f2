"""A plan is stated in a surgeon's words before it is applied, so that its errors are seen."""

import contextlib
import io
import json
from html import unescape

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cmfsim
from cmfsim.cli import main
from cmfsim.pipeline.building.case_checks import plan_sizes
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from head_case import HeadCase

TYPED = "translation = [0, -4, 1]\nangle = 2\naxis = [1, 0, 0]\ncentre = [3, -100, 1450]"
TEETH = np.array([0.0, -90.0, 20.0])
AT = "at the upper incisors (supradentale)"


def words(matrix):
    return cmfsim.clinical_motion("maxilla", matrix, landmarks={"supradentale": TEETH}).text


def about(angle, axis, translation=(0, 0, 0)):
    return cmfsim.rigid_motion(translation, angle, axis, TEETH)


@pytest.mark.parametrize(
    ("matrix", "text"),
    [
        (about(0, (1, 0, 0), (0, -5, 0)), f"5.0 mm forwards {AT}"),
        (about(0, (1, 0, 0), (0, 5, 0)), f"5.0 mm backwards {AT}"),
        (about(0, (1, 0, 0), (1, -5, 0.5)), f"5.0 mm forwards, 0.5 mm up, 1.0 mm to the left {AT}"),
        (about(0, (1, 0, 0), (-1, 0, -0.5)), f"0.5 mm down, 1.0 mm to the right {AT}"),
        (about(-2, (1, 0, 0)), f"0.0 mm {AT}; pitch +2.0° (front up)"),
        (about(2, (1, 0, 0)), f"0.0 mm {AT}; pitch −2.0° (front down)"),
        (about(3, (0, 0, 1)), f"0.0 mm {AT}; yaw +3.0° (front to the left)"),
        (about(-3, (0, 0, 1)), f"0.0 mm {AT}; yaw −3.0° (front to the right)"),
        (about(-4, (0, 1, 0)), f"0.0 mm {AT}; roll +4.0° (left side up)"),
        (about(4, (0, 1, 0)), f"0.0 mm {AT}; roll −4.0° (left side down)"),
        (about(0, (1, 0, 0), (0, -0.005, 0)), f"0.005 mm forwards {AT}"),
        (about(0.035, (1, 0, 0), (0, -5, 0)), f"5.0 mm forwards {AT}; pitch −0.035° (front down)"),
        (np.eye(4), "stays"),
    ],
)
def test_a_motion_reads_as_a_surgeon_says_it(matrix, text):
    assert words(matrix) == text


@settings(max_examples=50)
@given(
    axis=st.tuples(*3 * [st.floats(-1, 1)]).filter(lambda v: np.linalg.norm(v) > 0.1),
    angle=st.floats(0.5, 60),
    shift=st.tuples(*3 * [st.floats(-20, 20)]),
)
def test_the_numbers_are_where_points_go(axis, angle, shift):
    """Signs against the motion of points in front, beside and at the teeth; sizes against θ."""
    matrix = about(angle, axis, shift)
    found = cmfsim.clinical_motion("maxilla", matrix, landmarks={"supradentale": TEETH})
    assert (found.left, -found.forwards, found.up) == pytest.approx(shift, abs=1e-9)
    turn = np.array([found.pitch, found.yaw, found.roll])
    assert np.linalg.norm(turn) == pytest.approx(angle, abs=1e-7)
    # One degree of each part moves a point of the unit sphere as its words say, to first order.
    rotation = matrix[:3, :3]
    front, left = np.array([0, -1.0, 0]), np.array([1.0, 0, 0])
    half = 0.5 * (rotation - rotation.T)
    scale = np.radians(angle) / np.sin(np.radians(angle))
    assert np.degrees(scale * (half @ front)[2]) == pytest.approx(found.pitch, abs=1e-6)
    assert np.degrees(scale * (half @ front)[0]) == pytest.approx(found.yaw, abs=1e-6)
    assert np.degrees(scale * (half @ left)[2]) == pytest.approx(found.roll, abs=1e-6)


def test_the_inverse_turns_the_other_way():
    matrix = about(12, (1, -2, 0.5))
    one = cmfsim.clinical_motion("x", matrix)
    other = cmfsim.clinical_motion("x", np.linalg.inv(matrix))
    assert (one.pitch, one.yaw, one.roll) == pytest.approx(
        (-other.pitch, -other.yaw, -other.roll), abs=1e-9
    )


def test_each_segment_is_measured_where_surgeons_measure_it():
    shape = np.random.default_rng(0).uniform(-30, 30, (500, 3))
    marks = {name: np.full(3, float(n)) for n, name in enumerate(cmfsim.SKULL_LANDMARKS)}
    named = {
        "maxilla": "supradentale",
        "midface": "supradentale",
        "mandible": "infradentale",
        "mandible_body": "infradentale",
        "mandible_body_2": "infradentale",
        "chin": "pogonion",
        "ramus_left": "gonion_L",
        "ramus_right": "gonion_R",
    }
    for segment, mark in named.items():
        found = cmfsim.clinical_motion(segment, np.eye(4), landmarks=marks, vertices=shape)
        assert found.place.endswith(f"({mark})"), segment
        assert found.point.tolist() == marks[mark].tolist()
    # Another name: a landmark that lies on it, else its middle.
    for place, words_of_it in ((shape[7] + 1.0, "upper incisors"), ([0, 0, 99], "middle")):
        found = cmfsim.clinical_motion(
            "Oberkiefer", np.eye(4), landmarks={"supradentale": place}, vertices=shape
        )
        assert found.place.startswith(words_of_it)


def test_without_landmarks_a_motion_is_stated_at_an_end_of_the_segment():
    """Front and below for jaws, behind and below for rami: the same on any triangulation."""
    x, y, z = np.meshgrid(np.arange(-30, 31, 3.0), np.arange(-60, 1, 3.0), np.arange(0, 31, 3.0))
    box = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    upper = cmfsim.clinical_motion("maxilla", np.eye(4), vertices=box)
    assert upper.point.tolist() == [0.0, -60.0, 0.0]
    assert "near the incisors, at (0.0, -60.0, 0.0)" in upper.place
    lower = cmfsim.clinical_motion("mandible", np.eye(4), vertices=box)
    assert (lower.point.tolist(), "near the chin" in lower.place) == ([0.0, -60.0, 0.0], True)
    ramus = cmfsim.clinical_motion("ramus_left", np.eye(4), vertices=box)
    assert ramus.point.tolist() == [0.0, 0.0, 0.0]
    # Four times as many points on the left: the mean of the vertices would be another.
    left = box[box[:, 0] > 0.0]
    dense = np.concatenate([box, left + [0.0, 0.1, 0.0], left + [0.0, 0.2, 0.0]])[:, :3]
    dense = dense[dense[:, 1] <= 0.0]
    for name in ("maxilla", "piece"):
        found = [cmfsim.clinical_motion(name, np.eye(4), vertices=v).point for v in (box, dense)]
        assert np.array_equal(*found)


def test_a_motion_of_vertices_is_its_nearest_rigid_one_with_what_that_leaves():
    rng = np.random.default_rng(1)
    shape = cmfsim.SurfaceData(rng.uniform(-20, 20, (400, 3)), [[0, 1, 2]])
    here = np.asarray(shape.vertices)
    middle = 0.5 * (here.min(axis=0) + here.max(axis=0))
    matrix = cmfsim.rigid_motion((0, -5, 0), 3, (0, 0, 1), middle)
    there = here @ matrix[:3, :3].T + matrix[:3, 3]
    rigid = cmfsim.clinical_motion("piece", cmfsim.MovedSurface(shape, there))
    assert "5.0 mm forwards at the middle of its extent, at (" in rigid.text
    noisy = there + rng.normal(0, 0.5, there.shape)
    found = cmfsim.clinical_motion("piece", cmfsim.MovedSurface(shape, noisy))
    assert found.residual == pytest.approx(0.5 * 3**0.5, rel=0.1)
    assert "nearest rigid motion, from which the vertices deviate by 0.9 mm RMS" in found.text
    assert cmfsim.clinical_motion("piece", cmfsim.MovedSurface(shape, here)).text == "stays"
    # All to one place: no turn can be told, and nothing fails.
    point = cmfsim.MovedSurface(shape, np.zeros_like(here))
    assert "deviate by" in cmfsim.clinical_motion("piece", point).text
    json.dumps(found.as_dict(), allow_nan=False)


def slicer_export(path, motion):
    """The file that 3D Slicer saves for a transform that moves an object by `motion` (LPS)."""
    sitk = pytest.importorskip("SimpleITK")
    inverse = np.linalg.inv(motion)
    transform = sitk.AffineTransform(3)
    transform.SetMatrix(inverse[:3, :3].ravel())
    transform.SetTranslation(inverse[:3, 3])
    sitk.WriteTransform(transform, str(path))


@pytest.mark.parametrize("ending", [".tfm", ".h5"])
def test_a_slicer_export_reads_forwards_and_reversed_backwards(ending, tmp_path, capsys):
    """From case.toml to what `cmfsim doctor` prints; a bare path ends with what to write."""
    teeth = HeadCase().skull["infradentale"]
    motion = cmfsim.rigid_motion((0, -5, 1), -2, (1, 0, 0), teeth)
    slicer_export(tmp_path / f"jaw{ending}", motion)
    lines = {}
    for direction in ("from-parent", "to-parent"):
        head = HeadCase()
        head.replace(TYPED, f'transform = {{file = "jaw{ending}", direction = "{direction}"}}')
        assert main(["doctor", str(head.write(tmp_path)), "-q"]) == 0
        lines[direction] = capsys.readouterr().out.splitlines()[0]
    at = "at the lower incisors (infradentale)"
    assert lines["from-parent"] == (
        f"plan: mandible: 5.0 mm forwards, 1.0 mm up {at}; "
        f"pitch +2.0° (front up) [jaw{ending}: from-parent, LPS]"
    )
    assert lines["to-parent"].startswith("plan: mandible: 5.0 mm backwards, 0.8 mm down")
    assert "pitch −2.0° (front down)" in lines["to-parent"]
    head = HeadCase()
    head.replace(TYPED, f'transform = "jaw{ending}"')
    assert main(["doctor", str(head.write(tmp_path)), "-q"]) == 2
    assert 'direction = "from-parent" if' in capsys.readouterr().err


def test_a_sign_a_frame_and_a_forgotten_centre_are_seen_in_the_words(tmp_path):
    def text(motion):
        head = HeadCase()
        head.replace(TYPED, motion)
        found = cmfsim.examine(cmfsim.Case.load(head.write(tmp_path)))
        return found.plan["mandible"].text, found.plan["mandible"].source

    assert text("translation = [0, 5, 0]")[0].startswith("5.0 mm backwards at the lower incisors")
    rows = "matrix = [[1, 0, 0, 2], [0, 1, 0, 5], [0, 0, 1, 0], [0, 0, 0, 1]]"
    assert text(rows) == (
        "5.0 mm backwards, 2.0 mm to the left at the lower incisors (infradentale)",
        "matrix: LPS (frame assumed)",
    )
    assert text(f'{rows}\nframe = "RAS"') == (
        "5.0 mm forwards, 2.0 mm to the right at the lower incisors (infradentale)",
        "matrix: RAS",
    )
    words_of_it, source = text("angle = 1\naxis = [1, 0, 0]")
    # 25 mm of a degree about the origin, 1450 mm below the jaw.
    _, y, z = HeadCase().skull["infradentale"]
    forwards = np.sin(np.radians(1)) * z + (1 - np.cos(np.radians(1))) * y
    assert words_of_it.startswith(f"{forwards:.1f} mm forwards")
    assert forwards > 25
    assert source == "rotated about the origin of the coordinates, because no centre is given"


def test_a_plan_without_a_frame_beside_surfaces_in_ras_is_said(tmp_path):
    """Whoever exports bone in RAS reads the plan off in RAS, where it would be taken as LPS."""
    cmfsim.write_transform(tmp_path / "jaw.txt", cmfsim.rigid_motion((0, -5, 0)))
    text = (tmp_path / "jaw.txt").read_text(encoding="utf-8").partition("\n")[2]
    (tmp_path / "jaw.txt").write_text(text, encoding="utf-8")
    rows = "matrix = [[1, 0, 0, 2], [0, 1, 0, 5], [0, 0, 1, 0], [0, 0, 0, 1]]"
    for entry, is_said in (
        ("translation = [0, -5, 0]", True),
        (rows, True),
        ('transform = "jaw.txt"', True),
        ('translation = [0, -5, 0]\nframe = "LPS"', False),
        (f'{rows}\nframe = "RAS"', False),
        ('transform = {file = "jaw.txt", frame = "RAS"}', False),
        # Up is up in both.
        ("translation = [0, 0, 2]", False),
    ):
        head = HeadCase()
        head.replace('frame = "LPS"', 'frame = "RAS"')
        for name in head.surfaces:
            head.change(name, lambda v: v * [-1, -1, 1])
        head.replace(TYPED, entry)
        found, _ = codes(tmp_path, head)
        assert ("plan-frame" in found) == is_said, entry


def codes(tmp_path, head):
    found = cmfsim.examine(cmfsim.Case.load(head.write(tmp_path)))
    return [f.code for f in found.findings if f.code.startswith(("plan", "moved"))], found


def moved_jaw(head, motion):
    jaw = head.surfaces["mandible"]
    there = np.asarray(jaw.vertices) @ motion[:3, :3].T + motion[:3, 3]
    return cmfsim.SurfaceData(there, jaw.triangles)


TINY = cmfsim.rigid_motion((0, -0.005, 0.001))
TINY_TURN = cmfsim.rigid_motion((0, -5, 1), 0.035, (1, 0, 0), (3, -128, 1445))


@pytest.mark.parametrize("how", ["typed", "matrix", "text", "tfm", "surface"])
@pytest.mark.parametrize(("motion", "code"), [(TINY, "plan-tiny"), (TINY_TURN, "plan-tiny-angle")])
def test_metres_and_radians_are_noticed_however_the_motion_is_given(how, motion, code, tmp_path):
    head = HeadCase()
    if how == "typed":
        parts = cmfsim.decompose_motion(motion, (3, -128, 1445))
        entry = f"translation = {parts.translation.tolist()}\nangle = {parts.angle}\n"
        entry += f"axis = {parts.axis.tolist()}\ncentre = [3, -128, 1445]"
    elif how == "matrix":
        entry = f"matrix = {motion.tolist()}"
    elif how == "text":
        cmfsim.write_transform(tmp_path / "jaw.txt", motion)
        entry = 'transform = "jaw.txt"'
    elif how == "tfm":
        cmfsim.write_transform(tmp_path / "jaw.tfm", motion, direction="to-parent")
        entry = 'transform = {file = "jaw.tfm", direction = "to-parent"}'
    else:
        head.surfaces["after"] = moved_jaw(head, motion)
        entry = 'moved = "after.ply"'
    head.replace(TYPED, entry)
    found, examined = codes(tmp_path, head)
    assert found == [code]
    (finding,) = (f for f in examined.findings if f.code == code)
    assert finding.severity == "warning"
    wanted = "0.0051 m would be 5.1 mm" if code == "plan-tiny" else "radians would be 2.0°"
    assert wanted in finding.fix + finding.why


def test_no_motion_and_ordinary_motions_are_no_tiny_ones(tmp_path):
    small = "translation = [0, -1, 0]\nangle = 0.5\ncentre = [3, -128, 1445]"
    for entry in ("translation = [0, 0, 0]", TYPED, small):
        head = HeadCase()
        head.replace(TYPED, entry)
        found, examined = codes(tmp_path, head)
        assert found == (["plan-still"] if "[0, 0, 0]" in entry else [])
        assert (examined.plan["mandible"].text == "stays") == (entry == "translation = [0, 0, 0]")


def test_a_moved_bone_that_turns_too_far_is_said(tmp_path):
    head = HeadCase()
    motion = cmfsim.rigid_motion((0, 0, 0), 25, (1, 0, 0), (3, -128, 1445))
    head.surfaces["after"] = moved_jaw(head, motion)
    head.replace(TYPED, 'moved = "after.ply"')
    found, examined = codes(tmp_path, head)
    assert "plan-turned" in found
    assert "pitch −25.0° (front down)" in examined.plan["mandible"].text


def test_the_pieces_of_a_bone_that_was_cut_are_stated_one_by_one(tmp_path):
    """The front of the jaw advanced by 6 mm, the rest where it was: no average of both."""
    head = HeadCase(rounds=4)
    jaw = head.surfaces["mandible"]
    vertices = np.asarray(jaw.vertices)
    front = vertices[:, 1] < -135.0
    shift = np.where(front[:, None], [0.0, -6.0, 0.0], 0.0)
    head.surfaces["after"] = cmfsim.SurfaceData(vertices + shift, jaw.triangles)
    head.replace(TYPED, 'moved = "after.ply"')
    plan = cmfsim.examine(cmfsim.Case.load(head.write(tmp_path))).plan
    texts = sorted(motion.text for motion in plan.values())
    assert list(plan) == ["mandible", "mandible_2"]
    assert texts == ["6.0 mm forwards at the lower incisors (infradentale)", "stays"]


def test_the_doctor_gives_machines_the_plan_in_numbers(tmp_path, capsys):
    head = HeadCase()
    assert main(["doctor", str(head.write(tmp_path)), "--json", "-q"]) == 0
    plan = json.loads(capsys.readouterr().out)["plan"]["mandible"]
    assert plan["pitch_deg"] == pytest.approx(-2.0)
    assert plan["point"] == pytest.approx(np.asarray(head.skull["infradentale"]).tolist())
    assert plan["forwards_mm"] == pytest.approx(4.0, abs=0.1)
    assert plan["text"].startswith("4.0 mm forwards")


@pytest.fixture(scope="module")
def predicted(tmp_path_factory):
    """The folder of a coarse prediction with a plan from a file, and what was printed."""
    folder = tmp_path_factory.mktemp("predicted")
    head = HeadCase()
    teeth = head.skull["infradentale"]
    motion = cmfsim.rigid_motion((1, -5, 1), -2, (1, 0, 0), teeth)
    cmfsim.write_transform(folder / "jaw.tfm", motion, direction="from-parent")
    head.replace(TYPED, 'transform = {file = "jaw.tfm", direction = "from-parent"}')
    head.replace("edge_length = 4.0", "edge_length = 14.0")
    path = head.write(folder)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert main(["predict", str(path), "--model", "H"]) == 0
    return folder / "out", out.getvalue(), err.getvalue()


MOVED = (
    "5.0 mm forwards, 1.0 mm up, 1.0 mm to the left at the lower incisors (infradentale); "
    "pitch +2.0° (front up)"
)
LINE = f"mandible: {MOVED} [jaw.tfm: from-parent, LPS]"


def test_predict_states_the_plan_before_the_work_and_with_the_result(predicted):
    _, out, err = predicted
    lines = err.splitlines()
    assert f"cmfsim: plan: {LINE}" in lines
    assert lines.index(f"cmfsim: plan: {LINE}") < lines.index("cmfsim: reading surface skin")
    assert out.splitlines()[:2] == [f"plan: {LINE}", "plan: cranium: stays"]


def test_the_results_hold_the_plan_in_numbers_and_words(predicted):
    folder, _, _ = predicted
    plan = json.loads((folder / "prediction.json").read_text(encoding="utf-8"))["plan"]
    clinical = plan["mandible"]["clinical"]
    assert (clinical["text"], clinical["source"]) == (MOVED, "jaw.tfm: from-parent, LPS")
    numbers = {name: clinical[name] for name in ("forwards_mm", "up_mm", "left_mm")}
    assert numbers == pytest.approx({"forwards_mm": 5, "up_mm": 1, "left_mm": 1})
    assert clinical["pitch_deg"] == pytest.approx(2.0)
    assert plan["cranium"]["clinical"]["text"] == "stays"


def test_the_report_states_the_plan(predicted):
    pytest.importorskip("jinja2")
    folder, _, _ = predicted
    assert LINE in unescape((folder / "report.html").read_text(encoding="utf-8"))


def test_the_picture_of_the_plan_has_its_words_below(predicted):
    """Dark letters on white in the lowest lines, as far as the words go."""
    image_of = pytest.importorskip("matplotlib.image")
    folder, _, _ = predicted
    if not (folder / "plan.png").exists():
        pytest.skip("nothing can be drawn here")
    image = image_of.imread(folder / "plan.png")[:, :, :3]
    assert image.shape[:2] == (820, 1650)
    # Its legend is the row above them.
    band = image[-3 * 26 - 16 :].min(axis=2)
    assert (band[:4] == 1.0).all()
    assert (band == 1.0).mean() > 0.9
    for line, words_of_it in enumerate((f"plan: {LINE}", "cranium: stays"), start=1):
        dark = np.flatnonzero((band[8 + 26 * line : 34 + 26 * line] < 0.5).any(axis=0))
        assert 6.0 < dark.max() / len(words_of_it) < 11.0


def test_a_plan_that_turns_bone_still_to_be_segmented_is_measured_when_it_is_built(tmp_path):
    """The doctor has no surface of a CT's bones; a forgotten centre must not pass for that."""
    head = HeadCase()
    head.replace(TYPED, "angle = 3")
    table = head.toml.split("[surfaces]")[1].split("[landmarks]")[0]
    head.replace(f"[surfaces]{table}", '[image]\nfile = "ct.nrrd"\n\n')
    case = cmfsim.Case.load(head.write(tmp_path))
    jaw = head.surfaces["mandible"]
    level = cmfsim.ImageData(np.zeros((2, 2, 2)), (1, 1, 1))
    segments = (cmfsim.BoneSegment("mandible", level, jaw),)
    planned = PlannedBones(segments, {"mandible": case.plan["mandible"].matrix})
    with pytest.raises(
        cmfsim.CaseError, match=r"mandible moves by up to 7\d\.\d mm; give the centre"
    ):
        plan_sizes(case, planned, [])
    small = PlannedBones(segments, {"mandible": TINY})
    assert [f.code for f in plan_sizes(case, small, [])] == ["plan-tiny"]
