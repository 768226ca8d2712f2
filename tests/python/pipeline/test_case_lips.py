"""A case whose lips are separated: from its file to the scene, on the synthetic head."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

import cmfsim
import phantom_case
from cmfsim.meshing.lips.seam import seam_faces

pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")

LIPS = "\n[lips]\ncontact = true\n"


@pytest.fixture(scope="module")
def head():
    return cmfsim.make_head(cmfsim.HeadParameters(lip_gap=3.0, bite_gap=2.5))


@pytest.fixture(scope="module")
def anatomy(head):
    return head.anatomy(2.0)


def model_of(folder, head, anatomy, change):
    """The model of the case, with its text changed; the head is known and not read.

    Tets of 10 mm: lips that press on each other take as many solves as facets.
    """
    path = phantom_case.surface_case(folder, head, anatomy)
    text = path.read_text(encoding="utf-8").replace("edge_length = 7.0", "edge_length = 10.0")
    path.write_text(change(text), encoding="utf-8")
    return cmfsim.build_model(cmfsim.Case.load(path), anatomy=anatomy, check=False)


@pytest.fixture(scope="module")
def whole(head, anatomy, tmp_path_factory):
    return model_of(tmp_path_factory.mktemp("whole"), head, anatomy, lambda text: text)


@pytest.fixture(scope="module")
def model(head, anatomy, tmp_path_factory):
    return model_of(tmp_path_factory.mktemp("lips"), head, anatomy, lambda text: text + LIPS)


@pytest.fixture(scope="module")
def lower_jaw(head, anatomy, tmp_path_factory):
    """Only the mandible is operated: the upper teeth are the cranium's, which stays."""

    def change(text):
        text = text.replace('[[osteotomies]]\nprocedure = "le_fort_1"\n', "")
        return text.replace("[plan.maxilla]\ntranslation = [0, -4, 0]\n", "") + LIPS

    return model_of(tmp_path_factory.mktemp("mandible"), head, anatomy, change)


def test_a_case_that_does_not_ask_for_it_has_no_lips(whole):
    assert not whole.lips
    assert whole.scene.touching == ()
    assert whole.scene.obstacles == ()
    assert "lips" not in whole.summary
    assert "touching" not in whole.scene.header()


def test_kinds_outside_the_lips_are_those_of_the_whole_mesh(model, whole):
    """Where the mesh was not refined further, nodes of both have one place and one kind."""
    lip_nodes = np.concatenate([region.nodes for region in model.lips.values()])
    far = np.ones(model.scene.n_nodes, dtype=bool)
    far[lip_nodes] = False
    places = {tuple(p): k for p, k in zip(model.scene.nodes[far].tolist(), model.kinds.kind[far],
                                          strict=True)}  # fmt: skip
    same = [
        (places[tuple(place)], kind)
        for place, kind in zip(whole.scene.nodes.tolist(), whole.kinds.kind, strict=True)
        if tuple(place) in places
    ]
    assert len(same) > 0.8 * whole.scene.n_nodes
    assert sum(one != other for one, other in same) < 0.001 * len(same)


def test_the_scene_states_what_lips_may_not_enter(model):
    upper, lower = model.lips["upper"], model.lips["lower"]
    one, other = model.scene.touching
    assert np.array_equal(one.triangles, upper.triangles)
    assert np.array_equal(other.triangles, lower.triangles)
    assert set(one.nodes.tolist()) <= set(lower.nodes.tolist())
    assert set(other.nodes.tolist()) <= set(upper.nodes.tolist())
    assert {o.segment for o in model.scene.obstacles} >= {"maxilla", "mandible_body"}
    free = model.kinds.nodes("free")
    for obstacle in model.scene.obstacles:
        assert np.isin(obstacle.nodes, free).all()
    summary = model.summary["lips"]
    # Voxels of 2 mm show a gap of 3 mm, or no more than a deep crease.
    assert summary["source"] in {"gap", "crease"}
    assert summary["upper"]["released"]["maxilla"] > 10


def test_lips_lift_off_in_front_and_stay_attached_further_away(model, whole):
    """Nodes that would slide are released near the seam alone."""
    nodes = np.asarray(model.scene.nodes)
    seam = nodes[np.unique(_seam(model))]
    middle = seam[:, 2].mean()
    for region in model.lips.values():
        for ids in region.released.values():
            assert np.abs(nodes[ids, 2] - middle).max() < 18.0
            assert np.isin(ids, model.kinds.nodes("free")).all()
    sliding, before = (
        np.asarray(m.scene.nodes)[m.kinds.nodes("sliding", "maxilla")] for m in (model, whole)
    )
    for places, lifted in ((sliding, True), (before, False)):
        front = places[np.abs(places[:, 0]) < 12.0]
        assert len(front) > 10
        assert (front[:, 2].min() > middle + 8.0) == lifted


def _seam(model):
    boundary = np.asarray(model.boundary_triangles)
    return boundary[seam_faces(model.scene.nodes, boundary)]


def test_the_faces_of_the_seam_are_no_skin(model, whole):
    faces = {tuple(t) for t in np.sort(_seam(model), axis=1).tolist()}
    assert len(faces) > 100
    skin = {tuple(t) for t in np.sort(model.skin_triangles, axis=1).tolist()}
    assert not faces & skin

    def area(some):
        a, b, c = (np.asarray(some.scene.nodes)[some.skin_triangles[:, k]] for k in range(3))
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    assert area(model) == pytest.approx(area(whole), rel=0.01)


def test_the_report_is_that_of_the_separated_mesh(model):
    report = model.summary["mesh"]
    assert report["n_nodes"] == model.scene.n_nodes
    assert report["n_tets"] == model.scene.n_tets
    assert report["min_dihedral"] > 5.0
    assert np.asarray(cmfsim.TetMesh(model.scene.nodes, model.scene.tets).volumes).min() > 0.0


def test_models_without_sliding_have_the_lips_attached(model):
    scene = cmfsim.model_scene(model, "H")
    assert scene.touching == ()
    assert scene.obstacles == ()
    for region in model.lips.values():
        for name, ids in region.released.items():
            assert np.isin(ids, scene.segments[name].joined).all()
    with_sliding = cmfsim.model_scene(model, "H+S")
    assert len(with_sliding.touching) == 2


def test_a_prediction_without_contact_warns_that_lips_may_pass_through_each_other(model, whole):
    codes = {
        name: [found["code"] for found in cmfsim.predict_patient(some, "H").summary["findings"]]
        for name, some in (("separate", model), ("whole", whole))
    }
    assert "lips-contact" in codes["separate"]
    assert "lips-contact" not in codes["whole"]


def test_lips_press_on_each_other_and_do_not_pass(model):
    """From the case file to equilibrium: what was separated touches, pushes and never pulls."""
    result = cmfsim.predict_patient(model, "H+S").result
    touching = result.summary["touching"]
    assert touching["pressed"] > 10
    assert touching["penetration"] < 0.2
    without = cmfsim.solve_scene(
        dataclasses.replace(cmfsim.model_scene(model, "H+S"), touching=(), obstacles=())
    )
    moved = np.linalg.norm(result.displacements - without.displacements, axis=1)
    lips = np.concatenate([region.nodes for region in model.lips.values()])
    assert moved[lips].max() > 0.5
    assert np.median(moved) < 0.05 * moved[lips].max()


def test_teeth_that_stay_are_an_obstacle_too(lower_jaw):
    """The cranium bears the upper teeth where no osteotomy makes a maxilla."""
    names = {obstacle.segment for obstacle in lower_jaw.scene.obstacles}
    assert "cranium" in names
    assert np.array_equal(lower_jaw.scene.plan["cranium"], np.eye(4))


def test_a_scene_with_lips_comes_back_from_its_file(model, tmp_path):
    path = tmp_path / "scene.npz"
    cmfsim.write_scene(path, model.scene)
    scene = cmfsim.read_scene(path)
    assert scene.sha256() == model.scene.sha256()
    assert scene.sha256() != dataclasses.replace(model.scene, touching=()).sha256()
    for one, other in zip(scene.obstacles, model.scene.obstacles, strict=True):
        assert one.segment == other.segment
        assert np.array_equal(one.nodes, other.nodes)
        assert np.array_equal(one.surface.triangles, other.surface.triangles)
    assert np.array_equal(scene.touching[0].triangles, model.scene.touching[0].triangles)


def test_wrong_contact_of_a_scene_is_refused(model):
    scene = model.scene
    surface = scene.obstacles[0].surface
    for contact, message in (
        ({"touching": (cmfsim.TouchingData([scene.n_nodes], [[0, 1, 2]]),)}, "touching"),
        ({"touching": (cmfsim.TouchingData([0], [[0, 1, scene.n_nodes]]),)}, "touching"),
        ({"obstacles": (cmfsim.ObstacleData([0], "tooth", surface),)}, "'tooth'"),
        ({"obstacles": (cmfsim.ObstacleData([scene.n_nodes], "maxilla", surface),)}, "obstacles"),
        ({"obstacles": ("maxilla",)}, "obstacles"),
    ):
        with pytest.raises(cmfsim.CaseError, match=message):
            dataclasses.replace(scene, **contact)


def test_a_face_without_a_mouth_is_not_separated_and_says_so(tmp_path, anatomy, head):
    """The landmarks of the arches are missing, and surfaces show no teeth apart from bone."""
    path = phantom_case.surface_case(tmp_path, head, anatomy)
    text = path.read_text(encoding="utf-8")
    text = text[: text.index("[[osteotomies]]")] + "[plan.mandible]\ntranslation = [0, 3, 0]\n"
    marks = {n: p for n, p in head.skull_landmarks.items() if "m2" not in n}
    cmfsim.write_landmarks(path.parent / "skull.mrk.json", marks)
    text = text.replace("edge_length = 7.0", "edge_length = 10.0")
    path.write_text(text + LIPS, encoding="utf-8")
    bare = cmfsim.Anatomy(anatomy.skin, anatomy.bones)
    model = cmfsim.build_model(cmfsim.Case.load(path), anatomy=bare, check=False)
    assert not model.lips
    assert model.scene.touching == ()
    (finding,) = (f for f in model.findings if f.code == "lip-seam-not-found")
    assert finding.severity == "warning"
    assert model.summary["lips"]["source"] == "none"


def solved(model, plan):
    scene = cmfsim.model_scene(model.with_plan(plan), "H+S")
    options = dataclasses.replace(scene.options, method="auto")
    return cmfsim.solve_scene(dataclasses.replace(scene, options=options))


def test_nothing_moves_when_nothing_moves(model):
    result = solved(model, {})
    assert np.abs(result.displacements).max() < 1e-9
    touching = result.summary["touching"]
    assert touching["converged"]
    assert touching["penetration"] < 1e-9


def test_lips_do_not_enter_each_other_when_the_mandible_rises(model):
    """By 4 mm, which closes the gap of 3 mm between the lips; without contact they pass through."""
    plan = {"mandible_body": cmfsim.rigid_motion(translation=(0.0, 0.0, 4.0))}
    result = solved(model, plan)
    touching = result.summary["touching"]
    # Coarse lips may end with a node that meets two facets by turns: the result then warns.
    warned = [f["code"] for f in result.summary.get("findings", [])]
    assert touching["converged"] or "contact-stopped" in warned
    assert touching["pressed"] > 5
    assert touching["penetration"] < 0.1
    free = dataclasses.replace(model.scene, touching=(), obstacles=())
    assert _deepest(model, result) < 0.1
    through = solved(dataclasses.replace(model, scene=free), plan)
    assert "touching" not in through.summary
    assert _deepest(model, through) > 0.25


def _deepest(model, result):
    """How deep a node of either lip lies in a deformed tet that is not its own, mm."""
    scene = model.scene
    tets, places = np.asarray(scene.tets), np.asarray(scene.nodes) + result.displacements
    corners = places[tets]
    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    nodes = np.unique(np.concatenate([touch.nodes for touch in scene.touching]))
    near = cKDTree(middles).query_ball_point(places[nodes], reach.max())
    node, tet = np.repeat(nodes, [len(n) for n in near]), np.concatenate(near).astype(int)
    inside = np.linalg.norm(places[node] - middles[tet], axis=1) <= reach[tet]
    inside &= (tets[tet] != node[:, None]).all(axis=1)
    node, tet = node[inside], tet[inside]
    ways = np.swapaxes(corners[tet, 1:] - corners[tet, :1], 1, 2)
    inverse = np.linalg.inv(ways)
    three = np.einsum("nij,nj->ni", inverse, places[node] - corners[tet, 0])
    weights = np.column_stack([1.0 - three.sum(axis=1), three])
    # A weight changes by the length of its gradient over a millimetre.
    slopes = np.linalg.norm(np.concatenate([inverse.sum(axis=1)[:, None], inverse], axis=1), axis=2)
    return float((weights / slopes).min(axis=1).max(initial=0.0))
