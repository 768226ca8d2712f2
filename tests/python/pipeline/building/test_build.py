"""The whole way from a case to a scene, on a head that is known exactly."""

import dataclasses
import json
import types

import numpy as np
import pytest
from build_runs import PICTURES, run

import cmfsim
import phantom_case
from cmfsim.pipeline.building.tissue import nodes as tissue_mesh
from cmfsim.pipeline.outputs import model as model_output
from shared_values import drawn_levels

pytest.importorskip("skimage", reason="needs scikit-image (pip install '.[imaging]')")
meshio = pytest.importorskip("meshio", reason="needs meshio (pip install '.[mesh]')")

EDGE = 7.0


def built(path, *, drawn=True):
    """A case built by the command line: its model, folder and all that was said."""
    models_built = []

    def build_model(case, **options):
        models_built.append(build(case, **options))
        return models_built[-1]

    build = model_output.build_model
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_output, "build_model", build_model)
        if not drawn:
            patch.setattr(model_output, "_draw", lambda *_: [])
        code, out, err = run("build", path)
    assert code == 0, err
    folder = path.parent / "out"
    summary = json.loads((folder / "build.json").read_text(encoding="utf-8"))
    return types.SimpleNamespace(
        model=models_built[0], folder=folder, summary=summary, out=out, err=err, case=path
    )


@pytest.fixture(scope="session")
def head():
    return cmfsim.make_head()


@pytest.fixture(scope="session")
def truth(tmp_path_factory):
    """The head as it was drawn, as levels."""
    return drawn_levels(tmp_path_factory, 2.0)


@pytest.fixture(scope="session")
def from_surfaces(head, truth, tmp_path_factory):
    return built(phantom_case.surface_case(tmp_path_factory.mktemp("surfaces"), head, truth))


@pytest.fixture(scope="session")
def from_ct(head, tmp_path_factory):
    pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
    return built(phantom_case.ct_case(tmp_path_factory.mktemp("ct"), head), drawn=False)


@pytest.fixture(params=["from_surfaces", "from_ct"])
def made(request):
    return request.getfixturevalue(request.param)


def plane_of(head):
    """The height of the posterior plane, which the roots of the arches place."""
    roots = [head.skull_landmarks[f"supraglenoid_{side}"][1] for side in "LR"]
    return np.mean(roots) + 10.0


def on_planes(head, nodes):
    """Which nodes lie where the tissue was cut off: behind and at the neck."""
    ends = np.abs(nodes[:, 2] - nodes[:, 2].min()) < 0.5 * EDGE
    return ends | (np.abs(nodes[:, 1] - plane_of(head)) < 0.5 * EDGE)


def test_tissue_has_the_volume_of_the_head_that_was_drawn(head, truth, from_surfaces, from_ct):
    """Voxels of the true levels inside the skin, outside the bones, in the same region."""
    _, y, z = truth.skin.axes()
    bone = np.maximum.reduce([level.values for level in truth.bones.values()])
    tissue = (truth.skin.values > 0.0) & (bone <= 0.0) & (y < plane_of(head))
    nodes = np.asarray(from_surfaces.model.scene.nodes)
    tissue &= z > nodes[:, 2].min()
    # Surfaces say nothing of the airway; what they enclose behind bone is said to be left out.
    (hollow,) = (f for f in from_surfaces.model.findings if f.code == "hollow-left-out")
    left_out = 1000.0 * float(hollow.what.split()[0])
    volume = from_surfaces.summary["mesh"]["volume"]
    assert volume == pytest.approx(8.0 * np.count_nonzero(tissue) - left_out, rel=0.03)
    # Thresholds in voxels of 2.5 mm make thin bone, at the orbits above all, thicker.
    airless = tissue & (truth.air.values <= 0.0)
    share = from_ct.summary["mesh"]["volume"] / (8.0 * np.count_nonzero(airless))
    assert 0.78 < share < 1.05


def test_the_boundary_lies_on_the_skin_and_bones_that_were_drawn(head, from_surfaces, from_ct):
    """Within a quarter of an edge on average; from a CT within its voxel besides."""
    for made, slack in ((from_surfaces, 0.0), (from_ct, 1.25)):
        nodes, kinds = np.asarray(made.model.scene.nodes), made.model.kinds
        skin = made.model.skin_nodes
        skin = skin[~on_planes(head, nodes[skin])]
        off = np.abs(head.skin_level(nodes[skin]))
        assert off.mean() < min(EDGE / 4.0, 0.5 + slack)
        held = np.flatnonzero(np.isin(kinds.kind, (1, 2, 3)))
        held = held[~on_planes(head, nodes[held])]
        # Beyond a few mm a level is no distance, but never below the half of it.
        off = np.abs(head.bone_level("bone", nodes[held]))
        assert off.mean() < min(EDGE / 4.0, 0.5 + slack)


def test_held_nodes_lie_on_their_bones(head, made):
    """Maxilla below the Le Fort plane, jaw on the mandible, fixed nodes on cranium or planes."""
    nodes, kinds = np.asarray(made.model.scene.nodes), made.model.kinds
    on_plane = on_planes(head, nodes)
    reach = 0.75 * EDGE
    belongs = {
        "maxilla": ("cranium", "upper_teeth"),
        "mandible_body": ("mandible", "lower_teeth"),
        "ramus_left": ("mandible",),
        "ramus_right": ("mandible",),
    }
    for name, bones in belongs.items():
        found = np.concatenate([kinds.nodes("joined", name), kinds.nodes("sliding", name)])
        assert len(found) > 100, name
        level = np.max([head.bone_level(bone, nodes[found]) for bone in bones], axis=0)
        assert np.percentile(np.abs(level), 99.0) < reach, name
        # The ramus touches the skull in the joint; teeth of the jaws touch.
        assert np.abs(level).mean() < 1.8, name
    fixed = kinds.nodes("fixed")
    fixed = fixed[~on_plane[fixed]]
    level = head.bone_level("bone", nodes[fixed])
    assert np.percentile(np.abs(level), 99.0) < reach
    cut = cmfsim.place_procedure("le_fort_1", head.skull_landmarks).cuts[0]
    joined = nodes[kinds.nodes("joined", "maxilla")]
    above = np.max([np.min([p.distance(joined) for p in g], axis=0) for g in cut.groups], axis=0)
    # On the side of the piece, or on the cut itself.
    assert (above > -0.5 * EDGE).all()
    assert joined[:, 2].max() < head.skull_landmarks["suborbital_L"][2]


def test_tissue_slides_near_the_teeth_alone(head, made):
    nodes, kinds = np.asarray(made.model.scene.nodes), made.model.kinds
    sliding = nodes[kinds.nodes("sliding")]
    assert len(sliding) > 300
    # The tuberosity and the front of the ramus lie up to 12 mm behind the last teeth.
    teeth = -head.bone_level("teeth", sliding)
    assert np.percentile(teeth, 95.0) < 18.0
    low, high = head.skull_landmarks["infradentale"][2], head.skull_landmarks["supradentale"][2]
    assert sliding[:, 2].min() > low - 15.0
    assert sliding[:, 2].max() < high + 15.0


def test_no_skin_is_held_but_on_the_planes(head, from_surfaces):
    """Where skin is as thin as a voxel a handful of nodes are both."""
    model = from_surfaces.model
    nodes, skin = np.asarray(model.scene.nodes), model.skin_nodes
    held = skin[(model.kinds.kind[skin] > 0) & ~on_planes(head, nodes[skin])]
    assert len(held) < 0.02 * len(skin)
    assert len(skin) > 3000


def test_a_symmetric_head_gives_both_sides_alike(from_surfaces):
    model = from_surfaces.model
    nodes, kinds = np.asarray(model.scene.nodes), model.kinds
    for kind, name in (("joined", "mandible_body"), ("joined", "maxilla"), ("sliding", None)):
        x = nodes[kinds.nodes(kind, name) if name else kinds.nodes(kind), 0]
        assert np.count_nonzero(x > 0) == pytest.approx(np.count_nonzero(x < 0), rel=0.1)
    left, right = (len(kinds.nodes("joined", f"ramus_{s}")) for s in ("left", "right"))
    assert left == pytest.approx(right, rel=0.12)


def test_the_mesh_is_of_the_quality_that_is_promised(made):
    mesh = made.summary["mesh"]
    assert mesh["min_dihedral"] >= 10.0
    assert mesh["boundary_error_mean"] <= EDGE / 4.0
    assert abs(mesh["volume_error"]) < 0.04
    assert mesh["n_tets"] == made.model.scene.n_tets
    counts = made.summary["nodes"]
    assert sum(counts.values()) == mesh["n_nodes"] == made.model.scene.n_nodes
    segments = made.summary["segments"].values()
    for kind in ("joined", "sliding"):
        assert sum(held[kind] for held in segments) == counts[kind]


def test_without_motion_nothing_moves(from_surfaces):
    """The scene as it was written; the identity for each segment."""
    scene = cmfsim.read_scene(from_surfaces.folder / "scene.npz")
    assert scene.sha256() == from_surfaces.model.scene.sha256()
    still = dataclasses.replace(scene, plan={name: np.eye(4) for name in scene.segments})
    result = cmfsim.solve_scene(still)
    assert np.abs(result.displacements).max() < 1e-6


def test_a_jaw_that_is_moved_forward_takes_the_chin_along(head, from_surfaces):
    """By about its own way over the chin; the forehead stays."""
    scene = from_surfaces.model.scene
    glued = {
        name: dataclasses.replace(
            segment,
            joined=np.union1d(segment.joined, segment.sliding),
            sliding=[],
            contact=None,
            gap=0.0,
        )
        for name, segment in scene.segments.items()
    }
    forward = np.eye(4)
    forward[1, 3] = -2.0
    plan = {name: forward if name == "mandible_body" else np.eye(4) for name in glued}
    result = cmfsim.solve_scene(dataclasses.replace(scene, segments=glued, plan=plan))
    nodes = np.asarray(scene.nodes)
    skin = from_surfaces.model.skin_nodes

    def motion_at(label):
        place = head.skin_landmarks[label]
        nearest = skin[np.argmin(np.linalg.norm(nodes[skin] - place, axis=1))]
        return result.displacements[nearest]

    assert -2.3 < motion_at("pogonion")[1] < -1.4
    assert np.linalg.norm(motion_at("nasion")) < 0.1


def test_nothing_slides_where_the_case_says_so(head, from_surfaces):
    """`[node_kinds] sliding = false`, classified on the mesh that is there."""
    model = from_surfaces.model
    found = cmfsim.classify_nodes(
        model.scene.nodes,
        model.boundary_triangles,
        model.anatomy,
        model.segments,
        moved=["maxilla", "mandible_body"],
        landmarks=head.skull_landmarks,
        options=cmfsim.KindOptions(sliding=False),
    )
    assert found.counts["sliding"] == 0
    assert (
        found.counts["joined on maxilla"] > from_surfaces.summary["segments"]["maxilla"]["joined"]
    )


def test_everything_is_written_and_readable(made):
    names = set(made.summary["files"])
    assert {path.name for path in made.folder.iterdir()} == names
    segments = {f"segment-{segment.name}.ply" for segment in made.model.segments}
    expected = {"scene.npz", "tissue.vtu", "skin.ply", "build.json"} | segments
    assert names - PICTURES == expected
    tissue = meshio.read(made.folder / "tissue.vtu")
    assert np.array_equal(tissue.points, made.model.scene.nodes)
    assert np.array_equal(tissue.cells_dict["tetra"], made.model.scene.tets)
    assert np.array_equal(tissue.point_data["kind"].ravel(), made.model.kinds.kind)
    assert np.array_equal(tissue.point_data["segment"].ravel(), made.model.kinds.segment)
    skin = cmfsim.read_surface(made.folder / "skin.ply")
    assert np.array_equal(skin.triangles, made.model.skin.triangles)
    for segment in made.model.segments:
        surface = cmfsim.read_surface(made.folder / f"segment-{segment.name}.ply")
        assert len(surface.triangles) == len(segment.surface.triangles)


def test_the_summary_is_plain_and_complete(made):
    """Finite JSON with timings, hashes and findings; hashes follow the files."""
    text = (made.folder / "build.json").read_text(encoding="utf-8")
    assert "NaN" not in text
    assert "Infinity" not in text
    assert set(made.summary["inputs"]) >= {"case.toml", "skull.mrk.json", "skin.mrk.json"}
    assert all(len(digest) == 64 for digest in made.summary["inputs"].values())
    assert all(seconds >= 0.0 for seconds in made.summary["timings"].values())
    assert "filling the tissue with tets" in made.summary["timings"]
    assert [f["code"] for f in made.summary["findings"]] == [f.code for f in made.model.findings]
    assert not [f for f in made.model.findings if f.severity == "error"]


def test_pictures_are_drawn_where_this_machine_can(from_surfaces):
    drawn = PICTURES & set(from_surfaces.summary["files"])
    if not drawn:
        pytest.skip("cannot draw here: PyVista or OpenGL is missing")
    assert drawn == PICTURES
    for name in drawn:
        assert (from_surfaces.folder / name).read_bytes().startswith(b"\x89PNG")


def test_stages_are_named_once_and_the_end_is_a_table(made):
    """On a pipe: a line per stage on standard error, a readable end on standard output."""
    stages = [line for line in made.err.splitlines() if line.startswith("cmfsim: ")]
    assert len(stages) == len(set(stages))
    assert stages == made.err.splitlines()
    for stage in ("checking the case", "filling the tissue with tets", "writing the model"):
        assert f"cmfsim: {stage}" in stages
    if "ct.nrrd" in made.summary["inputs"]:
        assert "cmfsim: segmenting the head: skin" in stages
    lines = made.out.splitlines()
    assert max(len(line) for line in lines if str(made.folder) not in line) <= 100
    assert "\x1b" not in made.out
    assert "{" not in made.out
    for word in ("case ", "nodes ", "mesh ", "dihedral ", "worst tets", "time ", "written "):
        assert any(line.startswith(word) for line in lines), word


def test_a_crown_is_no_cut_and_a_cut_is(truth):
    """Whatever the voxels; the neck of the phantom ends in a cut."""
    whole = np.count_nonzero(truth.skin.values > 0.0, axis=(0, 1))
    whole = whole[whole > 0]
    for every in (1, 2):
        areas, spacing = whole[::every], 2.0 * every
        assert tissue_mesh._is_cut(areas, spacing)
        assert not tissue_mesh._is_cut(areas[::-1], spacing)
        lower = areas[: -int(35.0 / spacing)]
        assert tissue_mesh._is_cut(lower[::-1], spacing)
