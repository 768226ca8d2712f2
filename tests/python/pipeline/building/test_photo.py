"""A 3D photo in a frame of its own is registered to the skin, which gets the colours."""

from types import SimpleNamespace

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.doctor.surgery.operation import check_photo
from cmfsim.io import write_landmarks
from cmfsim.pipeline.building.case_checks import Head
from cmfsim.pipeline.building.inputs import input_hashes, plan_key
from cmfsim.pipeline.building.skin import GREY, with_photo
from cmfsim.values.case_parts import CasePhoto

pytest.importorskip("vtkmodules")

SIDES = {"pronasale": (0, -1, 0), "exocanthion_L": (1, -1, 1), "exocanthion_R": (-1, -1, 1)}
SIDES |= {"cheilion_L": (0.6, -1, -0.6), "cheilion_R": (-0.6, -1, -0.6)}


@pytest.fixture(scope="module")
def skin():
    """An egg with a nose."""
    unit, triangles = meshes.icosphere(5)
    egg = unit * (60.0, 75.0, 95.0)
    nose = np.exp(-((unit - (0, -1, 0)) ** 2).sum(axis=1) / 0.02)
    return cmfsim.SurfaceData(egg - nose[:, None] * (0, 15.0, 0), triangles)


@pytest.fixture(scope="module")
def landmarks(skin):
    def nearest(side):
        return skin.vertices[(skin.vertices @ (side / np.linalg.norm(side))).argmax()]

    return {name: nearest(np.array(side)) for name, side in SIDES.items()}


@pytest.fixture
def photo(skin, landmarks, tmp_path):
    """Its front, turned and in cm: red on the patient's left, green on the right."""
    kept = (skin.vertices[skin.triangles][:, :, 1] < -10.0).all(axis=1)
    used, triangles = np.unique(skin.triangles[kept], return_inverse=True)
    front = skin.vertices[used]
    motion = cmfsim.rigid_motion(
        angle=80.0, axis=(1, 2, 3), translation=(200, -30, 90), centre=(0, 0, 0)
    )
    places = (front @ motion[:3, :3].T + motion[:3, 3]) / 10.0
    colour = np.where(front[:, :1] > 0.0, (255, 0, 0), (0, 255, 0))
    head = ["ply", "format ascii 1.0", f"element vertex {len(places)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"property uchar {name}" for name in ("red", "green", "blue")]
    head += [f"element face {kept.sum()}", "property list uchar int vertex_indices", "end_header"]
    rows = [f"{x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(places, colour, strict=True)]
    rows += [f"3 {a} {b} {c}" for a, b, c in triangles.reshape(-1, 3)]
    (tmp_path / "photo.ply").write_text("\n".join([*head, *rows, ""]))
    rng = np.random.default_rng(1)
    there = {
        name: (motion[:3, :3] @ p + motion[:3, 3] + rng.normal(0.0, 1.0, 3)) / 10.0
        for name, p in landmarks.items()
    }
    write_landmarks(tmp_path / "photo.mrk.json", there)
    return CasePhoto(tmp_path / "photo.ply", tmp_path / "photo.mrk.json", units="cm")


def head_of(skin, landmarks, photo):
    case = SimpleNamespace(photo=photo, where=lambda key: f"case.toml:9 {key}", name="egg")
    return Head(case, {"skin": landmarks}, SimpleNamespace(surfaces={"skin": skin}))


def test_the_skin_has_the_colours_where_the_photo_shows_it(skin, landmarks, photo):
    face, colours, finding = with_photo(head_of(skin, landmarks, photo))
    assert face is skin
    x, y, _ = skin.vertices.T
    front = y < -12.0
    assert (colours[front & (x > 2.0)] == (255, 0, 0)).all()
    assert (colours[front & (x < -2.0)] == (0, 255, 0)).all()
    assert (colours[y > 0.0] == GREY).all()
    assert (finding.code, finding.severity) == ("photo-placed", "note")
    assert "lies 0.0 mm from the skin" in finding.what


def test_a_photo_that_is_not_on_the_skin_is_refused(skin, landmarks, photo):
    def refused(match, **change):
        given = {"file": photo.file, "landmarks": photo.landmarks, "units": "cm", **change}
        with pytest.raises(cmfsim.CaseError, match=match):
            with_photo(head_of(skin, landmarks, CasePhoto(**given)))

    refused("check names, sides and units", units="mm")
    refused("its frame, or give landmarks", landmarks=None, aligned=True)
    write_landmarks(photo.landmarks, {"pronasale": (0, 0, 0), "nose": (1, 1, 1)})
    refused(r"1 skin landmarks .* \(pronasale\): 3 are needed")


def test_a_photo_of_a_wider_face_is_doubted(skin, landmarks, photo):
    wider = cmfsim.SurfaceData(skin.vertices * (1.15, 1.0, 1.0), skin.triangles)
    _, _, finding = with_photo(head_of(wider, landmarks, photo))
    assert finding.severity == "warning"


def test_sides_that_are_exchanged_are_refused(skin, landmarks, photo):
    swapped = {n[:-1] + {"L": "R", "R": "L"}.get(n[-1], n[-1]): p for n, p in landmarks.items()}
    with pytest.raises(cmfsim.CaseError, match="check names, sides and units"):
        with_photo(head_of(skin, swapped, photo))


def test_the_table_needs_landmarks_or_alignment_and_its_files_are_inputs(tmp_path):
    """Also the texture, which only the material names: results of another picture are stale."""

    def case(table):
        lines = ['format = "cmfsim-case"\nversion = 1\nname = "a"\n[surfaces]\nskin = "s.ply"']
        lines += ['[surfaces.bones]\ncranium = "c.ply"\n[plan]', f"[photo]\n{table}", ""]
        (tmp_path / "case.toml").write_text("\n".join(lines))
        return cmfsim.Case.load(tmp_path / "case.toml")

    for table in ('file = "p.obj"', 'file = "p.obj"\nlandmarks = "p.fcsv"\naligned = true'):
        with pytest.raises(cmfsim.CaseError, match=r"needs landmarks = .* not both"):
            case(table)
    with pytest.raises(cmfsim.CaseError, match="units"):
        case('file = "p.obj"\naligned = true\nunits = "miles"')
    (tmp_path / "p.obj").write_text("mtllib p.mtl\n")
    (tmp_path / "p.mtl").write_text("map_Kd p.png\n")
    for name in ("s.ply", "c.ply", "p.png"):
        (tmp_path / name).write_bytes(b"1")
    read = case('file = "p.obj"\naligned = true')
    hashes = input_hashes(read)
    assert {"p.obj", "p.mtl", "p.png"} <= hashes.keys()
    (finding,) = check_photo(read)
    assert (finding.code, finding.severity) == ("input-unreadable", "error")
    about = plan_key(read)
    (tmp_path / "p.png").write_bytes(b"2")
    assert input_hashes(read)["p.png"] != hashes["p.png"]
    # Plans are about bones: a page stays valid.
    assert plan_key(read) == about
