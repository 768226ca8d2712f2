"""Virtual patients: their parts against what is known exactly, and a coarse twin end to end."""

import json
from dataclasses import replace

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.cli import main
from cmfsim.errors import CaseInputError
from cmfsim.lab.virtual.mechanics.equilibrium import EquilibriumOptions
from cmfsim.lab.virtual.mechanics.muscle_field import muscle_field, skin_share, thickened
from cmfsim.lab.virtual.operation import bone_distances, screw, without_bite, without_gaps
from cmfsim.lab.virtual.patient_folder import virtual_patients
from cmfsim.lab.virtual.population import PATIENTS
from cmfsim.lab.virtual.truth import carried, largest_body, scanned

# A twin that a test can afford: 8.5 mm tets (coarser ones have holes over the nasal bone).
COARSE = {"edge_length": 8.5, "spacing": 4.0, "grid": 3.0, "skin_spacing": 6.0}
OPTIONS = EquilibriumOptions(steps=1, tolerance=5e-3, loose=0.05)


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """P1, coarse: its folder."""
    folder = tmp_path_factory.mktemp("insilico") / "P1"
    cmfsim.write_virtual_patient(folder, 1, options=OPTIONS, **COARSE)
    return folder


def moves(folder) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of the skin before, and how each moved."""
    before = cmfsim.read_surface(folder / "truth/skin_before.ply")
    after = cmfsim.read_surface(folder / "truth/skin_exact.ply")
    start = np.asarray(before.vertices)
    return start, np.asarray(after.vertices) - start


def test_the_twin_is_complete_and_says_what_it_is(twin):
    """Every file of the documented layout; settled, nothing inside out, labelled in silico."""
    record = json.loads((twin / "truth/truth.json").read_text(encoding="utf-8"))
    assert record["what"].startswith("in silico")
    assert record["truth"]["residual"] <= OPTIONS.tolerance
    assert record["truth"]["volume_ratio"][0] > 0.0
    assert record["truth"]["penetration_mm"] < 0.5
    names = {path.relative_to(twin).as_posix() for path in twin.rglob("*") if path.is_file()}
    bones = ("cranium", "maxilla", "mandible_body", "ramus_left", "ramus_right")
    assert names == {
        "case.toml",
        "ct.nrrd",
        "skull.mrk.json",
        "skin.mrk.json",
        "skin.ply",
        "truth/skin.ply",
        "truth/skin_exact.ply",
        "truth/skin_before.ply",
        "truth/skin.mrk.json",
        "truth/skin_exact.mrk.json",
        "truth/skull_exact.mrk.json",
        "truth/truth.json",
        "truth/times.json",
        *(f"truth/bones/{name}.ply" for name in bones),
        *(f"truth/bones_before/{name}.ply" for name in bones),
    }
    case = cmfsim.Case.load(twin / "case.toml")
    assert [cut.procedure for cut in case.osteotomies] == ["le_fort_1", "bsso"]
    assert not [f for f in cmfsim.diagnose(case) if f.severity == "error"]


def test_skin_moves_as_the_operation_moves_it(twin):
    """P1: upper lip forwards, chin backwards, forehead and crown not at all."""
    before = cmfsim.read_landmarks(twin / "skin.mrk.json")
    exact = cmfsim.make_head(PATIENTS[1].parameters).skin_landmarks
    after = cmfsim.read_landmarks(twin / "truth/skin_exact.mrk.json")
    forward = {name: exact[name][1] - after[name][1] for name in exact}
    assert 2.0 < forward["labiale_superius"] < 6.0
    assert 2.0 < forward["subnasale"] < 6.0
    assert -5.0 < forward["pogonion"] < -1.5
    assert abs(forward["nasion"]) < 0.5
    placed = np.array([before[name] - exact[name] for name in exact])
    assert 0.15 < placed.std() < 0.45
    start, move = moves(twin)
    above = start[:, 2] > 80.0
    assert above.sum() > 100
    assert np.abs(move[above]).max() < 0.2
    assert np.linalg.norm(move, axis=1).max() < 12.0


def test_bones_move_exactly_as_planned(twin):
    """Each segment's surfaces before and after differ by the motion of the case file."""
    case = cmfsim.Case.load(twin / "case.toml")
    for name in ("maxilla", "mandible_body", "cranium"):
        before = cmfsim.read_surface(twin / f"truth/bones_before/{name}.ply")
        after = cmfsim.read_surface(twin / f"truth/bones/{name}.ply")
        start, end = np.asarray(before.vertices), np.asarray(after.vertices)
        matrix = case.plan[name].matrix if name in case.plan else np.eye(4)
        assert np.abs(start @ matrix[:3, :3].T + matrix[:3, 3] - end).max() < 1e-4


def test_the_scan_is_noisy_as_stated(twin):
    """0.1 mm white and 0.2 mm of waves, along the normals."""
    exact = cmfsim.read_surface(twin / "truth/skin_exact.ply")
    scan = cmfsim.read_surface(twin / "truth/skin.ply")
    off = np.linalg.norm(np.asarray(scan.vertices) - np.asarray(exact.vertices), axis=1)
    assert np.sqrt((off**2).mean()) == pytest.approx(np.hypot(0.1, 0.2), rel=0.1)


def test_a_patient_made_with_the_same_settings_is_kept(twin, monkeypatch):
    """The second command finds the first one's patient; another seed would make a new one."""
    folder = twin.parent
    record = json.loads((twin / "truth/truth.json").read_text(encoding="utf-8"))["settings"]
    settings = {key: record[key] for key in ("seed", "edge_length", "spacing")}

    def refuse(*_, **__):
        raise AssertionError("made again")

    monkeypatch.setattr("cmfsim.lab.virtual.patient_folder.write_virtual_patient", refuse)
    kept = cmfsim.virtual_patients(folder, [1], **settings)
    assert kept == [twin / "case.toml"]
    with pytest.raises(AssertionError, match="made again"):
        cmfsim.virtual_patients(folder, [1], **{**settings, "seed": 1})


def test_the_cohort_lists_the_patients_who_are_complete(twin):
    """`cohort.toml` beside P1 loads, and names P1 alone though a broken P2 lies there."""
    record = json.loads((twin / "truth/truth.json").read_text(encoding="utf-8"))["settings"]
    (twin.parent / "P2").mkdir(exist_ok=True)
    virtual_patients(
        twin.parent, [1], **{key: record[key] for key in ("seed", "edge_length", "spacing")}
    )
    cohort = cmfsim.Cohort.load(twin.parent / "cohort.toml")
    assert cohort.cases == {"P1": twin / "case.toml"}
    assert cohort.note.startswith("in silico")
    assert cohort.models == ("H", "M", "H+S", "M+S")


def blocks(gap: float):
    """Two bones of 10 mm with a gap along x, and tissue all round."""
    segments = {}
    for name, low in (("front", -10.0), ("back", gap)):
        vertices, triangles = meshes.icosphere(2, 1.0)
        top = np.abs(vertices).max(axis=1, keepdims=True)
        box = 5.0 * vertices / top + np.array([low + 5.0, 0.0, 0.0])
        surface = cmfsim.SurfaceData(box, triangles)
        level = cmfsim.ImageData(np.zeros((2, 2, 2), dtype=np.float32), (1.0,) * 3, (0.0,) * 3)
        segments[name] = cmfsim.BoneSegment(name, level, surface)
    nodes, tets = meshes.box((20, 12, 12), (30.0, 18.0, 18.0))
    return nodes - [14.0, 9.0, 9.0], tets, segments


def test_tissue_between_bones_that_part_is_none():
    """A slit of 1 mm that opens by 4 mm: all tets in it go, none outside, none if nothing moves."""
    nodes, tets, segments = blocks(1.0)
    depth = bone_distances(nodes, segments)
    motions = {"front": cmfsim.rigid_motion((-4.0, 0.0, 0.0)), "back": np.eye(4)}
    kept = without_gaps(nodes, tets, depth, motions)
    x, y, z = nodes[tets].mean(axis=1).T
    slit = (x > 0.0) & (x < 1.0) & (np.abs(y) < 4.0) & (np.abs(z) < 4.0)
    assert slit.sum() > 20
    assert not kept[slit].any()
    beside = (np.abs(y) > 8.0) | (np.abs(z) > 8.0)
    assert kept[beside].all()
    assert without_gaps(nodes, tets, depth, dict.fromkeys(motions, np.eye(4))).all()
    assert (without_bite(nodes, tets, depth["front"], depth["back"], 2.0) <= ~slit).all()


def test_distances_of_bones_reach_far():
    """Against the exact distance from a sphere, 10 mm outside and 5 mm inside."""
    vertices, triangles = meshes.icosphere(4, 12.0)
    level = cmfsim.ImageData(np.zeros((2, 2, 2), dtype=np.float32), (1.0,) * 3, (0.0,) * 3)
    ball = cmfsim.BoneSegment("ball", level, cmfsim.SurfaceData(vertices, triangles))
    points = np.vstack([r * meshes.unit_vectors(50, 1) for r in (7.0, 14.0, 22.0)])
    depth = bone_distances(points, {"ball": ball})["ball"].sample(points)
    assert np.abs(depth - (12.0 - np.linalg.norm(points, axis=1))).max() < 0.15


def test_a_flap_on_an_edge_is_left_out():
    """Two tets that share a face, and two more that hang on an edge and on a node of them."""
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [0, 1, 5, 6], [4, 7, 8, 9]])
    assert largest_body(tets).tolist() == [True, True, False, False]


def test_muscle_fractions_are_those_of_random_points():
    """Fractions against the share of 400 random points of each tet that lie in the muscle."""
    head = cmfsim.make_head()
    names = ("masseter_L", "zygomaticus_major_R")
    muscles = {name: head.muscles[name] for name in names}
    centre = np.mean([line.mean(axis=0) for line in muscles["masseter_L"].course], axis=0)
    nodes, tets = meshes.box((8, 8, 8), (24.0, 24.0, 24.0))
    nodes = nodes + centre - 12.0
    depth = head.skin_level(nodes)
    fraction, fibre = muscle_field(head, muscles, nodes, tets, depth)
    outside_bone = (head.bone_level("bone", nodes) < 0.0)[tets].all(axis=1)
    inside_skin = (depth > 1.0)[tets].all(axis=1)
    asked = np.flatnonzero(outside_bone & inside_skin)[::7]
    weights = np.random.default_rng(0).dirichlet(np.ones(4), 400)
    points = np.einsum("pc,tci->tpi", weights, nodes[tets[asked]]).reshape(-1, 3)
    held = np.maximum(*(muscles[name].level(points) for name in names)) > 0.0
    expected = held.reshape(len(asked), -1).mean(axis=1)
    assert expected.max() == 1.0
    assert np.abs(fraction[asked] - expected).mean() < 0.02
    assert np.abs(fraction[asked] - expected).max() < 0.3
    full = np.flatnonzero(fraction > 0.5)
    along = muscles["masseter_L"].fibre(nodes[tets[full]].mean(axis=1))
    assert (np.abs((fibre[full] * along).sum(axis=1)) > 0.999).all()


def test_thicker_muscles_fill_more():
    """A factor of 1.5 on the straps gives about 1.5 times the volume."""
    head = cmfsim.make_head()
    muscles = {"zygomaticus_major_L": head.muscles["zygomaticus_major_L"]}
    centre = muscles["zygomaticus_major_L"].course[0].mean(axis=0)
    nodes, tets = meshes.box((14, 14, 14), (28.0, 28.0, 28.0))
    nodes = nodes + centre - 14.0
    deep = np.full(len(nodes), 50.0)
    volume = [
        muscle_field(head, thickened(muscles, factor), nodes, tets, deep)[0].sum()
        for factor in (1.0, 1.5)
    ]
    assert 1.4 < volume[1] / volume[0] < 1.6


def test_a_muscle_with_an_offset_is_the_same_muscle_elsewhere():
    """Asked where everything is shifted alike, fractions and fibres are those without offset."""
    head = cmfsim.make_head()
    muscles = {name: head.muscles[name] for name in ("masseter_L", "risorius_L")}
    centre = np.mean([line.mean(axis=0) for line in muscles["masseter_L"].course], axis=0)
    nodes, tets = meshes.box((6, 6, 6), (30.0, 30.0, 30.0))
    nodes = nodes + centre - 15.0
    deep = np.full(len(nodes), 50.0)
    offset = (3.0, -2.5, 4.0)
    fraction, fibre = muscle_field(head, muscles, nodes, tets, deep)
    both = dict.fromkeys(muscles, offset)
    moved = muscle_field(head, muscles, nodes + np.array(offset), tets, deep, offsets=both)
    assert fraction.max() == 1.0
    np.testing.assert_allclose(moved[0], fraction, atol=1e-5)
    held = fraction > 0.01
    assert (np.abs((moved[1] * fibre)[held].sum(axis=1)) > 1.0 - 1e-6).all()
    # In place, the offset takes muscle away from where it was.
    there = muscle_field(head, muscles, nodes, tets, deep, offsets=both)[0]
    assert np.abs(there - fraction).max() > 0.5


def test_a_layer_of_skin_has_the_volume_of_its_thickness():
    """A block of 30 mm below a plane of skin: the layer is area times thickness, within 10 %."""
    nodes, tets = meshes.box((6, 6, 6), (30.0, 30.0, 30.0), jitter=0.1, seed=1)
    volumes = np.abs(np.linalg.det(nodes[tets[:, 1:]] - nodes[tets[:, :1]])) / 6.0
    for thickness in (1.0, 1.5, 2.0, 5.0):
        share = skin_share(nodes, tets, nodes[:, 2], thickness)
        assert (share * volumes).sum() == pytest.approx(900.0 * thickness, rel=0.1)
    assert not skin_share(nodes, tets, nodes[:, 2] + 20.0, 2.0).any()


def test_points_are_carried_by_the_linear_field():
    """An affine field exactly, inside; outside nothing beyond what the border has."""
    nodes, tets = meshes.box((4, 4, 4), (8.0, 8.0, 8.0), jitter=0.2)
    slope = np.random.default_rng(0).normal(size=(3, 3))
    points = np.random.default_rng(1).uniform(0.2, 7.8, (200, 3))
    found = carried(points, nodes, tets, nodes @ slope.T)
    assert np.abs(found - points @ slope.T).max() < 1e-10
    ramp = np.maximum(nodes[:, :1], 0.0) * np.array([[1.0, 0.0, 0.0]])
    outside = carried([[9.0, 4.0, 4.0], [-1.0, 4.0, 4.0]], nodes, tets, ramp)
    assert np.abs(outside[:, 0] - [8.0, 0.0]).max() < 1e-9


def test_scan_noise_is_seeded():
    """The same seed gives the same scan, another seed another one, none gives the surface."""
    vertices, triangles = meshes.icosphere(3, 50.0)
    surface = cmfsim.SurfaceData(vertices, triangles)
    first, again, other = (
        np.asarray(scanned(surface, white=0.1, smooth=0.2, seed=s).vertices) for s in (1, 1, 2)
    )
    assert (first == again).all()
    assert np.abs(first - other).max() > 0.1
    silent = scanned(surface, white=0.0, smooth=0.0, seed=1)
    assert np.abs(np.asarray(silent.vertices) - vertices).max() < 1e-12


def test_a_screw_ends_with_the_whole_motion_and_starts_with_none():
    """Part 0 is the identity, part 1 the matrix itself, parts are rigid."""
    matrix = cmfsim.rigid_motion((1.0, 2.0, 3.0), 25.0, (1.0, 0.5, 0.0), (10.0, 0.0, -5.0))
    motion = screw(matrix, np.array([4.0, 4.0, 4.0]))
    assert np.abs(motion(0.0) - np.eye(4)).max() < 1e-14
    assert (motion(1.0) == matrix).all()
    assert np.abs(motion(1.0 - 1e-9) - matrix).max() < 1e-7
    half = motion(0.5)[:3, :3]
    assert np.abs(half @ half - matrix[:3, :3]).max() < 1e-12


def test_the_patients_differ():
    """Six people, six operations, muscles other than those that the phantom draws."""
    assert sorted(PATIENTS) == [1, 2, 3, 4, 5, 6]
    assert len({patient.parameters for patient in PATIENTS.values()}) == 6
    assert len({patient.label for patient in PATIENTS.values()}) == 6
    for patient in PATIENTS.values():
        assert (patient.muscle_thickness, patient.muscle_stiffness) != (1.0, 1.0)
        assert replace(patient.parameters) == patient.parameters


def test_bad_input_is_named(tmp_path, capsys):
    """Number, length and seed out of range, before any work."""
    with pytest.raises(CaseInputError, match="patient is 7: 1, 2, 3, 4, 5, 6"):
        cmfsim.write_virtual_patient(tmp_path, 7)
    with pytest.raises(CaseInputError, match="edge_length"):
        cmfsim.write_virtual_patient(tmp_path, 1, edge_length=-1.0)
    with pytest.raises(CaseInputError, match=r"seed is 0.5"):
        cmfsim.write_virtual_patient(tmp_path, 1, seed=0.5)
    assert main(["virtual-patients", str(tmp_path), "--patients", "8"]) == 2
    assert "patient is 8" in capsys.readouterr().err
