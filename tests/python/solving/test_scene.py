"""Scenes and results on disk and in memory, and the faults of their files."""

import dataclasses
import io
import json
import os
import xml.etree.ElementTree as ET
import zipfile

import meshio
import numpy as np
import pytest
from block_scene import HIGH, LOW, NODES, SIDE, TETS, floor, scene, tissue

import cmfsim

LOWER = np.asarray(floor().vertices) - [0.0, 0.0, 0.1]
KINDS = ["isotropic", "transversely_isotropic", "stiffness", "preset"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_survives_its_file(kind, tmp_path):
    """write, read: the same content, and the same bytes when written again."""
    first, second = tmp_path / "a.npz", tmp_path / "b.npz"
    original = scene(kind)
    cmfsim.write_scene(first, original)
    found = cmfsim.read_scene(first)
    assert found.header() == original.header()
    assert found.sha256() == original.sha256()
    for name, array in original.arrays().items():
        np.testing.assert_array_equal(found.arrays()[name], array, err_msg=name)
    cmfsim.write_scene(second, found)
    assert first.read_bytes() == second.read_bytes()


def test_a_changed_scene_has_another_hash():
    """The hash covers arrays, names and options."""
    one = scene()
    nodes = NODES.copy()
    nodes[40] += 1e-12
    others = [
        scene(nodes=nodes),
        scene(conflicts="resolve"),
        scene(options=cmfsim.SolverOptions(method="pcg")),
    ]
    hashes = {s.sha256() for s in (one, *others)}
    assert len(hashes) == 4


@pytest.mark.parametrize("kind", KINDS)
def test_solving_a_scene_is_solving_by_hand(kind):
    """`solve_scene` adds nothing to what `StaticSolver` gives."""
    s = scene(kind)
    result = cmfsim.solve_scene(s)
    solver = cmfsim.scene_solver(s)
    expected = solver.solve(cmfsim.scene_plan(s), loads=s.loads)
    np.testing.assert_array_equal(result.displacements, expected.displacements)
    np.testing.assert_allclose((NODES + result.displacements)[LOW, 2], 0.15, rtol=0, atol=1e-6)
    assert result.summary["method"] == "cholesky"
    assert result.summary["scene_sha256"] == s.sha256()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"nodes": 2.0 * NODES}, "nodes"),
        ({"options": cmfsim.SolverOptions(kinematics="corotational")}, "kinematics"),
        ({"fixed": []}, "fixed nodes"),
        ({"tissue": cmfsim.TissueData("isotropic", young=7.0, poisson=0.3)}, "tissue"),
    ],
)
def test_a_solver_of_another_scene_is_refused(change, said):
    """Its solution would be that of the other scene, with the name of this one."""
    one = scene()
    solver = cmfsim.scene_solver(one)
    same = cmfsim.solve_scene(dataclasses.replace(one, loads=None), solver=solver)
    assert same.summary["residual"] >= 0.0
    with pytest.raises(cmfsim.BoundaryError, match=f"other {said}"):
        cmfsim.solve_scene(dataclasses.replace(one, **change), solver=solver)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"gap": np.full(len(LOW), 0.2)}, "gaps"),
        ({"contact": cmfsim.SurfaceData(LOWER, floor().triangles)}, "contact surfaces"),
    ],
)
def test_a_solver_with_other_contact_is_refused(change, said):
    one = scene()
    solver = cmfsim.scene_solver(one)
    segments = dict(one.segments)
    segments["floor"] = dataclasses.replace(segments["floor"], **change)
    plan = {**one.plan, "floor": np.eye(4)}
    other = dataclasses.replace(one, segments=segments, plan=plan)
    with pytest.raises(cmfsim.BoundaryError, match=f"other {said}"):
        cmfsim.solve_scene(other, solver=solver)


def test_a_result_survives_its_file(tmp_path):
    """Npz keeps every array and the summary."""
    result = cmfsim.solve_scene(scene())
    cmfsim.write_result(tmp_path / "out.npz", result)
    found = cmfsim.read_result(tmp_path / "out.npz")
    for name, array in result.arrays().items():
        np.testing.assert_array_equal(found.arrays()[name], array, err_msg=name)
        assert found.arrays()[name].dtype == array.dtype
    for key, value in result.summary.items():
        assert found.summary[key] == value


def test_a_result_is_read_by_others(tmp_path):
    """VTU as meshio reads it; VTP as well-formed XML with the boundary's counts."""
    result = cmfsim.solve_scene(scene())
    cmfsim.write_result(tmp_path / "out.vtu", result)
    mesh = meshio.read(tmp_path / "out.vtu")
    np.testing.assert_array_equal(mesh.points, NODES)
    np.testing.assert_array_equal(mesh.cells_dict["tetra"], TETS)
    np.testing.assert_array_equal(mesh.point_data["displacement"], result.displacements)
    np.testing.assert_array_equal(mesh.point_data["force"], result.forces)
    cmfsim.write_result(tmp_path / "out.vtp", result)
    piece = ET.parse(tmp_path / "out.vtp").getroot().find("PolyData/Piece")  # noqa: S314
    assert piece is not None
    assert int(piece.attrib["NumberOfPolys"]) == len(result.skin_triangles)
    assert int(piece.attrib["NumberOfPoints"]) == len(np.unique(result.skin_triangles))


def toml_scene(folder, kind="isotropic"):
    """The same kind of scene as VTU, STL and TOML."""
    kinds = np.zeros(len(NODES))
    segments = np.full(len(NODES), -1)
    for ids, value, segment in ((SIDE, 1, -1), (HIGH, 2, 0), (LOW, 3, 1)):
        kinds[ids], segments[ids] = value, segment
    data = {name: [a] for name, a in tissue(kind).arrays().items() if len(a) == len(TETS)}
    meshio.Mesh(
        NODES,
        [("tetra", TETS.astype(np.int64))],
        point_data={"kind": kinds, "segment": segments},
        cell_data=data,
    ).write(folder / "tissue.vtu")
    contact = floor()
    meshio.Mesh(contact.vertices, [("triangle", np.asarray(contact.triangles, dtype=int))]).write(
        folder / "floor.ply"
    )
    text = """
        format = "cmfsim-scene"
        version = 1
        mesh = "tissue.vtu"
        [tissue]
        kind = "isotropic"
        poisson = 0.4
        [segments.bone]
        [segments.floor]
        contact = "floor.ply"
        crease_angle = 45
        gap = 0.1
        [plan.bone]
        translation = [0.2, 0.1, -0.2]
        [plan.floor]
        matrix = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1]]
        [solver]
        method = "cholesky"
    """
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_toml_scene_is_the_same_scene(tmp_path):
    """VTU, PLY and TOML give the displacements of the npz."""
    found = cmfsim.read_scene(toml_scene(tmp_path))
    expected = cmfsim.solve_scene(scene(loads=None)).displacements
    assert np.abs(cmfsim.solve_scene(found).displacements - expected).max() < 1e-6


def test_surfaces_of_repeated_vertices_are_welded(tmp_path):
    """STL stores three vertices per triangle: contact and moved surface get their edges back."""
    path = toml_scene(tmp_path)
    contact = floor()
    corners = np.asarray(contact.vertices)[np.asarray(contact.triangles)].reshape(-1, 3)
    soup = [("triangle", np.arange(len(corners)).reshape(-1, 3))]
    meshio.Mesh(corners, soup).write(tmp_path / "floor.ply")
    meshio.Mesh(corners + [0.1, 0, 0.05], soup).write(tmp_path / "after.ply")
    text = path.read_text("utf-8")
    motion = 'surface = "floor.ply"\n        moved_surface = "after.ply"'
    matrix = next(line.strip() for line in text.splitlines() if "matrix" in line)
    path.write_text(text.replace(matrix, motion), "utf-8")
    found = cmfsim.read_scene(path)
    assert len(found.segments["floor"].contact.vertices) == len(contact.vertices)
    expected = cmfsim.solve_scene(scene(loads=None)).displacements
    assert np.abs(cmfsim.solve_scene(found).displacements - expected).max() < 1e-6


@pytest.mark.parametrize(
    ("old", "new", "pattern"),
    [
        ("version = 1", "version = 2", "version is 2"),
        ("cmfsim-scene", "other", "format is 'other'"),
        ('"tissue.vtu"', '"../tissue.vtu"', "in the same folder or below"),
        ('"tissue.vtu"', '"/etc/passwd"', "in the same folder or below"),
        ('"floor.ply"', '"scene.toml"', "files of .toml are not supported"),
        ("poisson = 0.4", "", "lacks 'poisson'"),
        ("poisson = 0.4", "poisson = 0.4\nyoung = 1.0", "remove one"),
        ("poisson = 0.4", "poison = 0.4", "poison is unknown; did you mean 'poisson'"),
        ('kind = "isotropic"', 'kind = "rubber"', "tissue kind is 'rubber'"),
        ("[plan.bone]", "[plan.chin]", "'chin'"),
        ("[segments.floor]", "[segments.floor]\nspeed = 1", "segments.floor.speed is unknown"),
        ("gap = 0.1", 'gap = "far"', "gap is 'far'"),
        ("[solver]", "[solver]\nspeed = 3", "^scene.toml:18: solver.speed is unknown"),
        ('method = "cholesky"', 'method = "lu"', "method is 'lu'"),
        ("[segments.bone]", "[segments.bone", "scene.toml:8: is not TOML"),
        ("translation = [0.2, 0.1, -0.2]", "translation = [0.2, 0.1]", "three numbers"),
    ],
)
def test_a_faulty_toml_scene_says_what_is_wrong(old, new, pattern, tmp_path):
    """Each fault alone, with the file's name in the text."""
    path = toml_scene(tmp_path)
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=pattern) as caught:
        cmfsim.read_scene(path)
    assert isinstance(caught.value, ValueError)
    assert "scene.toml" in str(caught.value)


def test_xml_with_entities_is_refused(tmp_path):
    """A document type could define entities that grow without bound."""
    path = toml_scene(tmp_path)
    mesh = tmp_path / "tissue.vtu"
    mesh.write_bytes(b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]>' + mesh.read_bytes())
    with pytest.raises(cmfsim.CaseError, match="document type"):
        cmfsim.read_scene(path)


# Corrupt archives.


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def rewrite(path, contents):
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in contents.items():
            archive.writestr(name, data)


def npy(array, **options):
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


def header_with(path, **changes):
    text = json.loads(str(np.load(path)["scene"]))
    return npy(np.array(json.dumps(text | changes)))


def bad_case(path, pattern):
    with pytest.raises(cmfsim.CaseError, match=pattern) as caught:
        cmfsim.read_scene(path)
    assert isinstance(caught.value, ValueError)
    assert path.name in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK", b"not a zip", b"\x93NUMPY" + bytes(100)])
def test_what_is_no_archive_is_refused(content, tmp_path):
    """Empty, cut, text, a lone array."""
    path = tmp_path / "scene.npz"
    path.write_bytes(content)
    bad_case(path, "archive")


def test_a_cut_file_is_refused_wherever_it_is_cut(saved):
    """A download that stopped: no prefix of a scene is a scene."""
    data = saved.read_bytes()
    for length in range(0, len(data), max(1, len(data) // 25)):
        saved.write_bytes(data[:length])
        bad_case(saved, "archive|array")


def test_a_flipped_byte_changes_nothing_unseen(saved):
    """The archive's checksums find damage in any array; unused fields of the archive may change."""
    data = bytearray(saved.read_bytes())
    expected = scene().sha256()
    refused = 0
    places = range(10, len(data), max(1, len(data) // 60))
    for at in places:
        damaged = data.copy()
        damaged[at] ^= 0xFF
        saved.write_bytes(damaged)
        try:
            found = cmfsim.read_scene(saved)
        except cmfsim.CaseError:
            refused += 1
        else:
            assert found.sha256() == expected
    assert refused > len(places) // 2


@pytest.mark.parametrize(
    "name", ["scene", "nodes", "tets", "fixed", "tissue.young", "segment.0.joined", "segment.1.gap"]
)
def test_a_missing_member_is_named(name, saved):
    """Each member taken out alone."""
    contents = members(saved)
    del contents[f"{name}.npy"]
    rewrite(saved, contents)
    bad_case(saved, name.removeprefix("tissue."))


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"version": 2}, "version is 2.*newer"),
        ({"version": "1"}, "version is '1'"),
        ({"format": "x"}, "format is 'x'"),
        ({"segments": {}}, "segments"),
        ({"segments": [{}]}, "no name"),
        ({"tissue": {"kind": []}}, "tissue kind"),
        ({"solver": {"method": "lu"}}, "method is 'lu'"),
        ({"solver": {"tolerance": -1}}, "tolerance"),
        ({"solver": []}, "solver"),
        ({"conflicts": "x"}, "conflicts is 'x'"),
    ],
)
def test_a_faulty_header_is_refused(changes, pattern, saved):
    """Version, format, names and options."""
    contents = members(saved)
    contents["scene.npy"] = header_with(saved, **changes)
    rewrite(saved, contents)
    bad_case(saved, pattern)


def test_pickles_are_never_loaded(saved):
    """An object array could run code: it is refused, unread."""

    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(saved.parent / "exploded"),))

    contents = members(saved)
    contents["nodes.npy"] = npy(np.array([Bomb()], dtype=object), allow_pickle=True)
    rewrite(saved, contents)
    bad_case(saved, "pickle")
    assert not (saved.parent / "exploded").exists()


@pytest.mark.parametrize(
    ("member", "array", "pattern"),
    [
        ("nodes", np.zeros((4, 2)), r"nodes has shape \(4, 2\)"),
        ("nodes", np.array(["a"]), "nodes has dtype"),
        ("tets", TETS.astype(float), "tets has dtype"),
        ("tets", TETS + 1000, r"tets\[0, 0\] is 1\d\d\d"),
        ("tissue.young", np.ones(3), "tissue young has 3 rows"),
        ("fixed", np.array([9999]), r"fixed\[0\] is 9999"),
        ("segment.0.joined", np.array([-1]), r"joined\[0\] is -1"),
        ("segment.1.gap", np.ones(2), "gap has shape"),
        ("segment.0.motion", np.eye(3), "plan of segment"),
        ("loads", np.zeros((2, 3)), "loads has 2 rows"),
        ("loads", np.full(NODES.shape, np.nan), r"loads\[0, 0\] is nan"),
    ],
)
def test_a_faulty_array_is_named(member, array, pattern, saved):
    """Shape, dtype, index and value of the first fault."""
    contents = members(saved)
    contents[f"{member}.npy"] = npy(array)
    rewrite(saved, contents)
    bad_case(saved, pattern)


# Scenes in memory.


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"nodes": NODES * np.nan}, r"nodes\[0, 0\] is nan"),
        ({"tets": TETS[:, :3]}, "tets has shape"),
        ({"tets": TETS.astype(np.int64) - 1}, r"is -1"),
        ({"fixed": [0.5]}, "fixed has dtype"),
        ({"plan": {}}, "plan lacks segment"),
        ({"segments": {}, "plan": {"x": np.eye(4)}}, "plan names segment 'x'"),
        ({"conflicts": "maybe"}, "conflicts is 'maybe'"),
    ],
)
def test_a_faulty_scene_is_refused(changes, pattern):
    """Checked where it is made."""
    with pytest.raises(cmfsim.CaseError, match=pattern):
        scene(**changes)


def test_scene_values_are_frozen():
    """Neither fields nor arrays can change after the check."""
    s = scene()
    with pytest.raises(dataclasses.FrozenInstanceError):
        s.nodes = NODES
    with pytest.raises(ValueError, match="read-only"):
        s.nodes[0] = 0.0
    with pytest.raises(TypeError):
        s.plan["x"] = np.eye(4)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("tissue", {"young": 1.0}, "tissue is of type dict"),
        ("segments", {"bone": [0, 1]}, "segment 'bone' is of type list"),
        ("options", "cholesky", "options is of type str"),
    ],
)
def test_a_scene_of_other_types_names_the_field(field, value, words):
    """A part of a scene of another type is a CaseError that names the field and both types."""
    parts = {
        "nodes": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "tets": [[0, 1, 2, 3]],
        "tissue": cmfsim.TissueData("isotropic", young=0.003, poisson=0.46),
    }
    with pytest.raises(cmfsim.CaseError, match=words):
        cmfsim.Scene(**{**parts, field: value})


def test_a_contact_of_another_type_is_named():
    """Vertices and triangles belong into a SurfaceData."""
    with pytest.raises(cmfsim.CaseError, match="contact is of type tuple"):
        cmfsim.SegmentData(sliding=[0], contact=([[0, 0, 0]], [[0, 0, 0]]))
