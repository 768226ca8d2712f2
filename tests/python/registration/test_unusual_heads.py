"""Real heads in other shapes than their own: landmarks are found, or doubted honestly."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes import warped_heads
from benches.scenes.warped_heads import KnownHead, warped
from cmfsim.pipeline.proposing import read_template_head
from cmfsim.registration.proposed.definitions import detection
from cmfsim.registration.proposed.pose import Pose
from cmfsim.registration.proposed.shape_model.fitted_head import FIRST
from cmfsim.registration.proposed.shape_model.fitting import refined
from cmfsim.registration.proposed.shape_model.model import SITES, head_model
from cmfsim.registration.proposed.shape_model.samples import samples_of
from cmfsim.registration.proposed.shape_model.search import found_poses
from cmfsim.registration.proposed.template_head import average_head
from cmfsim.values.surface_data import joined_surface


@cache
def atlas():
    known = read_template_head(real_heads.data_folder() / "atlas_head")
    return KnownHead(known.bones, known.skin, (known.skull, known.skin_landmarks))


# Before, in turn: 3.7, 4.0 and 3.1 mm; gonion 14 mm, incisors 43 mm off.
@pytest.mark.parametrize("name", ["narrow", "long skull", "front half"])
def test_an_unusual_head_has_its_landmarks(name):
    head = next(head for known, head in warped(atlas()) if known == name)
    found = cmfsim.propose_landmarks(head.bones, head.skin)
    for sites, truth in zip((found.skull, found.skin), head.truth, strict=True):
        errors = np.array([np.linalg.norm(site.point - truth[n]) for n, site in sites.items()])
        assert errors.mean() < 2.5
        assert errors.max() < 9.0


# Molars were found between incisors of one jaw and the ramus of the other, up to 11 mm off, and a
# chin 10 mm aside about the plane of symmetry, 8 to 11 mm off, both without a doubt.
@pytest.mark.parametrize("name", warped_heads.JAW_SHIFTS)
def test_a_mandible_far_from_its_place_has_its_landmarks_and_leaves_the_upper_jaw_its_own(name):
    head = next(head for known, head in warped(atlas()) if known == name)
    found = cmfsim.propose_landmarks(head.bones, head.skin)
    for sites, truth in zip((found.skull, found.skin), head.truth, strict=True):
        errors = {n: np.linalg.norm(site.point - truth[n]) for n, site in sites.items()}
        assert np.mean([*errors.values()]) < 2.5
        molars = [e for n, e in errors.items() if n.startswith(("sub_m2", "supra_m2"))]
        assert max(molars, default=0.0) < 4.0
        assert all(e < 2.0 * sites[n].error for n, e in errors.items() if not sites[n].doubt)


@pytest.mark.parametrize("size", [0.7, 0.85, 1.25])
def test_the_pose_of_a_head_of_another_size_is_found_from_every_start_that_is_kept(size):
    head = atlas().moved(lambda p: size * p)
    samples = samples_of(joined_surface([*head.bones.values()]), head.skin)
    model, few = head_model().coarse, samples.fewer(1200)
    truth = np.array([head.truth[kind == "skin"][label] for kind, label in SITES])
    for start in found_poses(model, few):
        state = refined(model, few, start.state(model), FIRST, still_jaw=True).state
        places = state.out(state.sites(model)[0])
        assert np.linalg.norm(places - truth, axis=1).mean() < 10.0 * size


def test_a_site_that_a_surface_with_holes_does_not_show_is_left_out(monkeypatch):
    """A cut chin gave a place of NaN, and the fit of all sites ended in "SVD did not converge"."""
    sites = {"nasion": np.zeros(3), "pogonion": np.array([0.0, np.nan, -90.0])}
    monkeypatch.setattr(detection, "find_skull_sites", lambda _: dict(sites))
    head = average_head()
    parts = detection.HeadSurfaces(head.bones["cranium"], head.bones["mandible"])
    pose = Pose(np.zeros(3), np.eye(3), 1.0, 0.0)
    found = detection.detect(parts, pose, detection.HeadBuild(np.eye(4), 1.0))
    assert set(found.skull) == {"nasion"}


def test_nose_and_orbits_beside_the_plane_of_symmetry_are_found_where_they_are():
    """They were looked for about the plane of the whole cranium: 3 to 4 mm off across."""
    head = average_head()
    pose = Pose(np.zeros(3), np.eye(3), 1.0, 0.0)
    build = detection.HeadBuild(np.eye(4), 1.0)

    def aside(points):
        upper = np.exp(-0.5 * ((points[:, 2:] - 20.0) / 30.0) ** 2) * (points[:, 1:2] < -40.0)
        return points + 4.0 * upper * [1.0, 0.0, 0.0]

    def sites(move):
        bones = [replace(head.bones[n], vertices=move(head.bones[n].vertices))
                 for n in ("cranium", "mandible")]  # fmt: skip
        skin = replace(head.skin, vertices=move(head.skin.vertices))
        return detection.detect(detection.HeadSurfaces(*bones, skin), pose, build)

    straight, moved = sites(lambda p: p), sites(aside)
    for name in ("nasion", "rhinion", "suborbital_L", "suborbital_R", "supraorbital_L"):
        place = aside(straight.skull[name][None])[0]
        assert abs(moved.skull[name][0] - place[0]) < 1.5, name
    for name in ("nasion", "endocanthion_L", "endocanthion_R"):
        place = aside(straight.skin[name][None])[0]
        assert abs(moved.skin[name][0] - place[0]) < 1.5, name


def test_sites_beyond_an_oblique_cut_are_missing():
    """They were 160 to 174 mm off, doubtful: what the plane leaves of the vault has a brow too."""
    pv = pytest.importorskip("pyvista")
    head = atlas()
    tilt = np.radians(20.0)
    plane = head.truth[0]["nasion"] + [0.0, 0.0, 8.0], [0.0, -np.sin(tilt), np.cos(tilt)]

    def cut(surface):
        mesh = pv.PolyData.from_regular_faces(surface.vertices, surface.triangles.astype(np.int64))
        part = mesh.clip(normal=plane[1], origin=plane[0], invert=True).triangulate()
        return cmfsim.SurfaceData(np.asarray(part.points, dtype=float), part.regular_faces)

    found = cmfsim.propose_landmarks({n: cut(b) for n, b in head.bones.items()}, cut(head.skin))
    for name, place in head.truth[0].items():
        if (place - plane[0]) @ plane[1] > 3.0:
            assert name in found.missing_skull, name
