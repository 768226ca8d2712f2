"""Each segment keeps its own surface, and what notices an exchange."""

import dataclasses
import hashlib
import types
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import cmfsim
import phantom_case
from cmfsim.bones.segment_checks import check_segments
from cmfsim.io import Case
from cmfsim.pipeline.building import case_checks
from cmfsim.pipeline.building.case_model import build_model
from cmfsim.pipeline.building.surgery.motions import PlannedBones
from cmfsim.surfaces import levels as surfaces
from head_case import HeadCase

pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")

PLAN = {"le_fort_1": {}, "bsso": {}}


@pytest.fixture(scope="module")
def head():
    return cmfsim.make_head()


@pytest.fixture(scope="module")
def truth(head):
    return head.anatomy(2.5)


@pytest.fixture(scope="module")
def cut(head, truth):
    """The segments of the synthetic head."""
    return cmfsim.cut_bones(truth.bones, PLAN, landmarks=head.skull_landmarks).segments


def ball(radius, size=60):
    """The level of a ball with a wavy surface, that no other radius gives."""
    image = cmfsim.ImageData(np.zeros((size,) * 3), (1, 1, 1))
    x, y, z = image.axes()
    half = size / 2
    wave = np.sin(x * radius / 40) * np.sin(y / 3)
    from_middle = np.sqrt((x - half) ** 2 + (y - half) ** 2 + (z - half) ** 2)
    return image.with_values((radius + wave - from_middle).clip(-2, 2).astype(np.float32))


def digest(*found):
    """The SHA-256 of some surfaces."""
    whole = hashlib.sha256()
    for surface in found:
        whole.update(np.ascontiguousarray(surface.vertices).tobytes())
        whole.update(np.ascontiguousarray(surface.triangles).tobytes())
    return whole.hexdigest()


def test_surfaces_made_by_two_threads_are_those_made_one_after_another():
    """20 different meshes, byte for byte."""
    options = surfaces.SurfaceOptions(max_triangles=500)
    levels = [ball(15 + 0.5 * n) for n in range(20)]

    def make(level):
        return digest(surfaces.surface_of_level("ball", level, options))

    serial = [make(level) for level in levels]
    assert len(set(serial)) == 20
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(make, levels)) == serial


def test_sound_segments_pass(cut):
    assert len(cut) == 5
    check_segments(cut)


def test_two_segments_with_one_surface_are_an_error(cut):
    other = dataclasses.replace(cut[1], surface=cut[0].surface)
    with pytest.raises(cmfsim.CaseError, match=r"'cranium' and '.*' have the same surface"):
        check_segments([cut[0], other, *cut[2:]])


def test_swapped_surfaces_are_an_error(cut):
    """Of any two segments: those beside each other share a cut face, and that is not enough."""
    for i in range(len(cut)):
        for j in range(i):
            swapped = [*cut]
            swapped[i] = dataclasses.replace(cut[i], surface=cut[j].surface)
            swapped[j] = dataclasses.replace(cut[j], surface=cut[i].surface)
            with pytest.raises(cmfsim.CaseError, match="is not that of its bone"):
                check_segments(swapped)


def test_a_surface_with_a_part_lost_is_an_error(cut):
    """Half of a bone's surface lies on its bone, but does not enclose it."""
    vertices = np.asarray(cut[0].surface.vertices)
    triangles = np.asarray(cut[0].surface.triangles)
    middle = float(np.median(vertices[:, 0]))
    half = triangles[(vertices[triangles, 0] < middle).all(axis=1)]
    surface = cmfsim.SurfaceData(vertices, half)
    with pytest.raises(cmfsim.CaseError, match=r"encloses 0\.\d+ times the volume"):
        check_segments([dataclasses.replace(cut[0], surface=surface)])


def test_a_decimator_that_exchanges_meshes_ends_the_cut(head, truth, monkeypatch):
    """As the race did: the second caller's mesh is given back to both."""
    real, first = surfaces._core.decimated, []

    def exchanged(*mesh):
        first.append(mesh)
        return real(*first[0])

    monkeypatch.setattr(surfaces._core, "decimated", exchanged)
    surface = surfaces.SurfaceOptions(max_triangles=1000)
    with pytest.raises(cmfsim.CaseError, match=r"same surface|is not that of its bone"):
        cmfsim.cut_bones(truth.bones, PLAN, landmarks=head.skull_landmarks, surface=surface)


def test_a_level_and_a_ready_surface_of_another_bone_are_an_error(cut):
    levels = {s.name: s.level for s in cut[:2]}
    ready = {cut[0].name: cut[1].surface, cut[1].name: cut[0].surface}
    with pytest.raises(cmfsim.CaseError, match="is not that of its bone"):
        cmfsim.segments_from_surfaces(levels, ready)


def test_a_moved_segment_without_a_node_is_an_error(tmp_path):
    """The mandible lies below the meshed region: its motion would reach nothing."""
    head = HeadCase()
    head.replace("edge_length = 4.0", "edge_length = 12.0")
    head.toml += "\n[region]\nlower = 1475.0\n"
    case = Case.load(head.write(tmp_path))
    with pytest.raises(cmfsim.CaseError, match=r"'mandible' moves, but no node.*segment-no-tissue"):
        build_model(case, check=False)


def test_a_head_built_again_has_the_same_bytes(head, truth, tmp_path):
    """Three builds of a small case: surfaces, nodes, tets and what each node is."""
    path = phantom_case.surface_case(tmp_path, head, truth)
    text = path.read_text(encoding="utf-8").replace("edge_length = 7.0", "edge_length = 10.0")
    path.write_text(text, encoding="utf-8")
    case, found = Case.load(path), set()
    for _ in range(3):
        model = build_model(case, check=False, anatomy=truth)
        whole = hashlib.sha256(digest(*(s.surface for s in model.segments)).encode())
        for array in (model.scene.nodes, model.scene.tets, model.kinds.kind, model.kinds.segment):
            whole.update(np.ascontiguousarray(array).tobytes())
        found.add(whole.hexdigest())
    assert len(found) == 1


@pytest.mark.parametrize("inwards", [True, False])
def test_a_given_bone_with_an_inner_wall_is_taken_as_it_is(inwards):
    """Exports of skulls have walls of marrow and sinuses, and some of these face outwards."""
    outer, inner = (surfaces.surface_of_level("b", ball(r)) for r in (20, 14))
    skin = surfaces.surface_of_level("skin", ball(27))
    walls = np.asarray(inner.triangles)
    walls = walls[:, ::-1] if inwards else walls
    hollow = cmfsim.SurfaceData(
        np.concatenate([outer.vertices, inner.vertices]),
        np.concatenate([outer.triangles, walls + len(np.asarray(outer.vertices))]),
    )
    anatomy = cmfsim.anatomy_from_surfaces(skin, {"cranium": hollow}, spacing=1.0)
    (segment,) = cmfsim.segments_from_surfaces(anatomy.bones, anatomy.surfaces)
    assert segment.surface is anatomy.surfaces["cranium"]


def moved_without_nodes(segments, motions, *, plan):
    """What the build does with moved segments that hold no node of a mesh in front of the face."""
    nodes = np.array([[0, -90, -80], [5, -90, -80], [0, -85, -80], [0, -90, -75.0]])
    mesh = cmfsim.TetMesh(nodes, [[0, 1, 2, 3]])
    none = cmfsim.NodeKinds(
        np.zeros(4, np.uint8), np.full(4, -1, np.int16), tuple(s.name for s in segments)
    )
    case = types.SimpleNamespace(where=lambda key: key, plan=plan, osteotomies=())
    return case_checks.untouched(case, mesh, none, PlannedBones(tuple(segments), motions))


def test_a_piece_beyond_the_mesh_that_nobody_named_is_a_warning(cut):
    """Vertebrae that moved between two scans are no part of the plan; a bone of the plan is."""
    forwards = cmfsim.rigid_motion((0, -3, 0))
    vertices = np.asarray(cut[0].surface.vertices) + [0, 500, 0]
    behind = dataclasses.replace(
        cut[0], surface=dataclasses.replace(cut[0].surface, vertices=vertices)
    )
    name = behind.name
    (finding,) = moved_without_nodes([behind], {name: forwards}, plan={})
    assert (finding.severity, finding.code) == ("warning", "segment-no-tissue")
    with pytest.raises(cmfsim.CaseError, match=f"'{name}' moves, but no node"):
        moved_without_nodes([behind], {name: forwards}, plan={name: None})
    assert moved_without_nodes([behind], {name: np.eye(4)}, plan={name: None}) == ()


def test_a_build_compares_landmarks_with_the_bones_that_it_made(head, truth, cut):
    """Correct ones give no word; all 5 mm up are found on bones and skin, and end no build."""
    case = types.SimpleNamespace(where=lambda key: key)
    # Sella lies in no surface: measures alone use it.
    skull = {**head.skull_landmarks, "S": np.array([0.0, -20.0, 25.0])}
    marks = {"skull": skull, "skin": head.skin_landmarks}
    assert case_checks.misplaced(case, marks, truth, cut) == []
    for shift, words in ((5.0, "5.0 mm too high"), (12.0, "12.0 mm too high")):
        moved = {
            key: {name: place + [0, 0, shift] for name, place in places.items()}
            for key, places in marks.items()
        }
        told = case_checks.misplaced(case, moved, truth, cut)
        assert {f.severity for f in told} == {"warning"}
        assert any(words in f.what for f in told if f.where == "landmarks.skull")
        assert any(f.where == "landmarks.skin" for f in told)


def test_a_cut_by_lengths_of_roots_is_reported_in_a_head_of_a_childs_size():
    """0.8 times the ordinary head, unless the height of the cut is given."""
    sites = cmfsim.make_head().skull_landmarks
    for size, options, warned in (
        (0.8, {}, True),
        (0.8, {"height": 1.4}, False),
        (1.0, {}, False),
        (1.1, {}, False),
    ):
        placed = cmfsim.place_procedure(
            "le_fort_1", {name: size * place for name, place in sites.items()}, options
        )
        found = [f.what for f in placed.findings if f.code == "cut-small-head"]
        assert len(found) == warned
        assert not found or "has 0.80 times" in found[0]
