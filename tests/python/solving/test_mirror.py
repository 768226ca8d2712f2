"""Left and right are alike: a mirrored case gives the mirrored face, a still one none."""

import dataclasses

import numpy as np
import pytest

import cmfsim
from head_case import HeadCase

pytest.importorskip("meshio")
pytest.importorskip("scipy")

FLIP = np.array([-1.0, 1.0, 1.0])
TURN = cmfsim.rigid_motion((1.5, -4.0, 1.0), 4.0, (1.0, 0.4, -0.3), (3.0, -120.0, 1450.0))
# What the displacements of the skin differ by on lattices that are not each other's mirror image,
# as a share of the largest: the mesh's own error, at edges that are a quarter of the jaw.
LATTICE = 0.06


def mirrored(matrix):
    across = np.diag([*FLIP, 1.0])
    return across @ matrix @ across


def other_side(name):
    """The label of the landmark on the other side."""
    swap = {"L": "R", "R": "L"}
    return name[:-1] + swap[name[-1]] if name.endswith(("_L", "_R")) else name


def reflected(scene):
    """The scene in a mirror: nodes, tets turned round, fibres, surfaces and motions."""
    tissue = scene.tissue
    if tissue.fibre is not None:
        tissue = dataclasses.replace(tissue, fibre=np.asarray(tissue.fibre) * FLIP)
    segments = {
        name: dataclasses.replace(
            s, contact=None if s.contact is None else reflected_surface(s.contact)
        )
        for name, s in scene.segments.items()
    }
    plan = {
        name: cmfsim.MovedSurface(
            reflected_surface(motion.surface), np.asarray(motion.moved_vertices) * FLIP
        )
        if isinstance(motion, cmfsim.MovedSurface)
        else mirrored(motion)
        for name, motion in scene.plan.items()
    }
    return dataclasses.replace(
        scene,
        nodes=np.asarray(scene.nodes) * FLIP,
        tets=np.asarray(scene.tets)[:, [0, 2, 1, 3]],
        tissue=tissue,
        segments=segments,
        plan=plan,
    )


def reflected_surface(surface):
    return dataclasses.replace(
        surface,
        vertices=np.asarray(surface.vertices) * FLIP,
        triangles=np.asarray(surface.triangles)[:, ::-1],
    )


def head_case():
    head = HeadCase(rounds=3)
    table = head.toml[head.toml.index("[plan.mandible]") : head.toml.index("[tissue]")]
    rows = ", ".join(str(row.tolist()) for row in TURN)
    head.replace(table, f"[plan.mandible]\nmatrix = [{rows}]\n\n")
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 12.0")
    return head


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    """The ellipsoids with muscle in every tet, so that fibres have a say, and sliding nodes."""
    case = cmfsim.Case.load(head_case().write(tmp_path_factory.mktemp("head")))
    model = cmfsim.build_model(case, check=False)
    rng = np.random.default_rng(0)
    fibre = rng.normal(size=(len(model.scene.tets), 3))
    fibre /= np.linalg.norm(fibre, axis=1, keepdims=True)
    tissue = cmfsim.TissueData(
        "preset", preset="kim2010", fraction=rng.uniform(0, 0.5, len(fibre)), fibre=fibre
    )
    assert sum(np.size(segment.sliding) for segment in model.scene.segments.values()) > 5
    scene = dataclasses.replace(model.scene, tissue=tissue)
    return dataclasses.replace(model, scene=scene, muscles=cmfsim.Musculature(()))


def _surface(model):
    return next(s.surface for s in model.segments if s.name == "mandible")


@pytest.mark.parametrize("model", ["H", "M", "H+S", "M+S"])
def test_a_mirrored_scene_gives_mirrored_displacements(model, patient):
    scene = cmfsim.model_scene(patient, model)
    one = cmfsim.solve_scene(scene)
    other = cmfsim.solve_scene(reflected(scene))
    assert np.abs(one.displacements).max() > 3.0
    np.testing.assert_allclose(other.displacements * FLIP, one.displacements, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", ["H", "M", "H+S", "M+S"])
@pytest.mark.parametrize("motion", ["matrix", "surface"])
def test_no_motion_gives_no_change(model, motion, patient):
    surface = _surface(patient)
    still = np.eye(4) if motion == "matrix" else cmfsim.MovedSurface(surface, surface.vertices)
    scene = dataclasses.replace(patient.scene, plan={**patient.scene.plan, "mandible": still})
    found = cmfsim.predict_patient(dataclasses.replace(patient, scene=scene), model)
    assert np.abs(found.result.displacements).max() < 1e-9
    np.testing.assert_allclose(found.skin.vertices, found.skin_before.vertices, rtol=0, atol=1e-9)


def test_a_mirrored_case_gives_the_mirrored_face(tmp_path):
    """From files on: surfaces, landmarks and plan mirrored; the lattice of the mesh is not."""
    head = head_case()
    there = head_case()
    for name, surface in head.surfaces.items():
        there.surfaces[name] = reflected_surface(surface)
    there.skull = {other_side(name): place * FLIP for name, place in head.skull.items()}
    there.skin = {other_side(name): place * FLIP for name, place in head.skin.items()}
    for row, flipped in zip(TURN, mirrored(TURN), strict=True):
        there.replace(str(row.tolist()), str(flipped.tolist()))
    faces = []
    for name, case in (("here", head), ("there", there)):
        folder = tmp_path / name
        folder.mkdir()
        path = cmfsim.Case.load(case.write(folder))
        assert not [f for f in cmfsim.diagnose(path) if f.severity == "error"]
        faces.append(cmfsim.predict(path, model="H", check=False))
    one, other = faces
    back = reflected_surface(other.skin_before)
    motion = cmfsim.SurfaceMotion(
        cmfsim.Surface(back.vertices, back.triangles), np.asarray(other.skin.vertices) * FLIP
    )
    apart = motion.displacement(one.skin_before.vertices) - one.skin_displacements
    largest = np.linalg.norm(one.skin_displacements, axis=1).max()
    assert largest > 3.0
    assert np.linalg.norm(apart, axis=1).mean() < LATTICE * largest
