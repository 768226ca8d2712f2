"""A plan by surfaces before and after: the bone's motion, whatever happened to its triangles."""

import numpy as np
import pytest

import cmfsim
from head_case import ELLIPSOIDS, HeadCase, ellipsoid
from pebbles import slid

pytest.importorskip("meshio")
pytest.importorskip("scipy")

MOVED_PLAN = '[plan.mandible]\nmoved = "mandible_post.ply"\n'
PUT = cmfsim.rigid_motion((1.0, -5.0, 1.0), 4.0, (1, 0.3, 0), (3, -128, 1445))


def carried(points, matrix):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def bumpy(rounds):
    """The mandible with bumps, so that its shape leaves no motion open."""
    surface = ellipsoid("mandible", rounds)
    offset = np.asarray(surface.vertices) - ELLIPSOIDS["mandible"][0]
    away = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    wave = np.sin(offset @ [0.17, 0.05, 0.11]) + np.cos(offset @ [-0.06, 0.13, 0.21])
    vertices = np.asarray(surface.vertices) + 1.5 * wave[:, None] * away
    return cmfsim.SurfaceData(vertices, surface.triangles)


def resliced(surface):
    """The same surface with other triangles: vertices at the middles of the former ones."""
    triangles = np.asarray(surface.triangles).astype(np.int64)
    vertices = np.asarray(surface.vertices)
    middles = len(vertices) + np.arange(len(triangles))
    a, b, c = triangles.T
    parts = [
        np.column_stack(corners) for corners in ((a, b, middles), (b, c, middles), (c, a, middles))
    ]
    return cmfsim.SurfaceData(
        np.concatenate([vertices, vertices[triangles].mean(axis=1)]), np.concatenate(parts)
    )


def put(surface, scale=1.0):
    vertices = np.asarray(surface.vertices)
    middle = vertices.mean(axis=0)
    return cmfsim.SurfaceData(carried(middle + scale * (vertices - middle), PUT), surface.triangles)


def planned_by(before, after, folder):
    head = HeadCase(rounds=3)
    table = head.toml[head.toml.index("[plan.mandible]") : head.toml.index("[tissue]")]
    head.replace(table, MOVED_PLAN)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 12.0")
    head.surfaces["mandible"], head.surfaces["mandible_post"] = before, after
    return cmfsim.Case.load(head.write(folder))


@pytest.mark.parametrize(
    ("after", "method"),
    [
        (lambda bone: put(slid(bone, 1.0, seed=1)), "shape"),
        (lambda bone: put(slid(bone, 2.0, seed=2)), "shape"),
        (lambda bone: put(resliced(slid(bone, 2.0, seed=3))), "icp"),
        (lambda _: put(bumpy(5)), "icp"),
    ],
)
def test_a_plan_by_surfaces_is_the_bone_s_motion_not_that_of_the_vertices(after, method, tmp_path):
    """Within 0.1 mm anywhere on the bone, and 0.05 mm on the face, of the motion itself."""
    before = bumpy(4)
    model = cmfsim.build_model(planned_by(before, after(before), tmp_path), check=False)
    assert model.summary["plan_fits"]["mandible"]["method"] == method
    found = model.scene.plan["mandible"]
    here = np.asarray(before.vertices)
    assert np.linalg.norm(carried(here, found) - carried(here, PUT), axis=1).max() < 0.1
    (face, true) = (
        cmfsim.predict_patient(patient, "H").skin_displacements
        for patient in (model, model.with_plan({"mandible": PUT}))
    )
    assert np.linalg.norm(true, axis=1).max() > 2.0
    assert np.linalg.norm(face - true, axis=1).max() < 0.05
    codes = [finding.code for finding in model.findings]
    assert ("motion-slip" in codes) == (method == "shape")


@pytest.mark.parametrize("scale", [0.96, 1.05])
@pytest.mark.parametrize("is_paired", [True, False])
def test_the_size_of_a_planned_bone_is_reported_and_is_no_motion(scale, is_paired, tmp_path):
    before = bumpy(4)
    after = put(before if is_paired else resliced(slid(before, 1.0)), scale)
    model = cmfsim.build_model(planned_by(before, after, tmp_path), check=True)
    here = np.asarray(before.vertices)
    off = carried(here, model.scene.plan["mandible"]) - carried(here, PUT)
    assert np.linalg.norm(off, axis=1).max() < 0.1
    (finding,) = [f for f in model.findings if f.code == "moved-scaled"]
    assert finding.severity == "warning"
    assert "95 % interval" in finding.what
    assert "plan.mandible" in finding.where


def test_resected_bone_of_a_fitted_plan_is_removed_and_takes_no_tissue_along(tmp_path):
    before = bumpy(4)
    vertices = np.array(slid(before, 1.0).vertices)
    vertices[:, 0] = np.minimum(vertices[:, 0], np.quantile(vertices[:, 0], 0.9))
    after = put(cmfsim.SurfaceData(vertices, before.triangles))
    model = cmfsim.build_model(planned_by(before, after, tmp_path), check=False)
    assert list(model.scene.segments) == ["cranium", "mandible"]
    here = np.asarray(before.vertices)
    off = carried(here, model.scene.plan["mandible"]) - carried(here, PUT)
    assert np.linalg.norm(off, axis=1).max() < 0.3
    (finding,) = [f for f in model.findings if f.code == "bone-removed"]
    assert finding.severity == "warning"


@pytest.mark.parametrize("ratio", [pytest.param(0.1, marks=pytest.mark.slow), 10.0])
def test_a_remeshed_bone_of_another_unit_is_refused_by_name(ratio, tmp_path):
    before = bumpy(4)
    after = resliced(before)
    small = cmfsim.SurfaceData(ratio * np.asarray(after.vertices), after.triangles)
    with pytest.raises(cmfsim.CmfsimError, match="mandible"):
        cmfsim.build_model(planned_by(before, small, tmp_path))
