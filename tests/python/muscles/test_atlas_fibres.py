"""Fibres of the real atlas run as anatomy says, from origin to insertion. Needs the real data."""

import numpy as np
import pytest

import cmfsim
import real_heads
from benches.scenes.angles import angle_of_lines
from cmfsim.muscles.template.bodyparts3d import PAIRED_MUSCLES, atlas_course

pytest.importorskip("meshio")

# Largest angle between the mean direction of a muscle and the line of its attachments, degrees.
PARALLEL = 10.0
# Leaves of a vector what the view from the side shows.
SAGITTAL = (0.0, 1.0, 1.0)


def muscle(name, side):
    """A muscle of the atlas: its repaired surface, and its fibres as the importer gives them."""
    pair = next(pair for pair in PAIRED_MUSCLES if pair.name == name)
    part = pair.left if side == "L" else pair.right
    path = real_heads.data_folder() / "bodyparts3d" / "v3_obj99" / f"{part}.obj"
    surface, _ = cmfsim.repair_surface(cmfsim.read_surface(path), name)
    course = atlas_course(name, side, surface)
    core = cmfsim.Surface(surface.vertices, surface.triangles)
    return surface, cmfsim.MuscleFibres(core, pair.kind, course=course)


def mean_direction(surface, fibres):
    """Principal axis of the directions over the surface, by area."""
    corners = np.asarray(surface.vertices)[np.asarray(surface.triangles)]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    along = fibres.directions(corners.mean(axis=1))
    return np.linalg.eigh((along * area[:, None]).T @ along)[1][:, -1]


@pytest.mark.parametrize("side", ["L", "R"])
def test_the_larger_masseter_runs_from_the_zygomatic_arch_to_the_angle_of_the_jaw(side):
    marks = real_heads.landmarks("atlas_head")
    surface, fibres = muscle("masseter_deep", side)
    line = marks[f"gonion_{side}"] - marks[f"zygomatic_arch_{side}"]
    assert angle_of_lines(mean_direction(surface, fibres), line) < PARALLEL


@pytest.mark.parametrize("side", ["L", "R"])
def test_zygomaticus_major_runs_from_the_cheek_bone_to_the_corner_of_the_mouth(side):
    corner = real_heads.landmarks("atlas_head", "skin")[f"cheilion_{side}"]
    surface, fibres = muscle("zygomaticus_major", side)
    vertices = np.asarray(surface.vertices)
    origin = vertices[vertices[:, 2] > np.quantile(vertices[:, 2], 0.95)].mean(axis=0)
    assert angle_of_lines(mean_direction(surface, fibres), corner - origin) < PARALLEL


@pytest.mark.parametrize("side", ["L", "R"])
def test_temporalis_converges_on_the_coronoid_process(side):
    """In the view from the side every fibre points at the tip; it follows the temple in depth."""
    surface, fibres = muscle("temporalis", side)
    vertices = np.asarray(surface.vertices)
    tip = vertices[np.argsort(vertices[:, 2])[:20]].mean(axis=0)
    far = vertices[np.linalg.norm(vertices - tip, axis=1) > 30.0]
    along = fibres.directions(far)
    off = angle_of_lines(along * SAGITTAL, (tip - far) * SAGITTAL)
    assert np.median(off) < 3.0
    assert np.percentile(off, 95) < 10.0
    # The foremost fibres run down, the hindmost nearly level.
    steep = np.degrees(np.arctan2(np.abs(along[:, 2]), np.abs(along[:, 1])))
    front, back = far[:, 1] < np.quantile(far[:, 1], 0.1), far[:, 1] > np.quantile(far[:, 1], 0.9)
    assert steep[front].mean() > 70.0
    assert steep[back].mean() < 50.0


@pytest.mark.parametrize("side", ["L", "R"])
def test_buccinator_runs_forwards_to_the_corner_of_the_mouth(side):
    surface, fibres = muscle("buccinator", side)
    mean = mean_direction(surface, fibres)
    assert abs(np.degrees(np.arcsin(mean[2]))) < 25.0, "nearly level"
    assert abs(mean[1]) > 0.85, "from behind to the front"
    assert fibres.is_sheet or len(fibres.course) > 0
