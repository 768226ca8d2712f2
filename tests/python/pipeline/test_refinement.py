"""Where the edge of a mesh is halved at least: at the mouth, on jaws that are boxes."""

import numpy as np
import pytest

import cmfsim
from cmfsim.meshing.levels import TissueRegion, tissue_level
from cmfsim.pipeline.building.tissue.nodes import (
    GAP_REFINEMENTS,
    MOUTH_DEPTH,
    MOUTH_LENGTH,
    MOUTH_WIDTH,
    allowed_halvings,
    needed_halvings,
)
from shared_values import drawn_levels

# Hollows are told from tissue with scipy.
pytest.importorskip("scipy", reason="needs scipy (pip install '.[imaging]')")

SPACING = (2.0, 1.0, 1.5)
# The skin's front, the jaws' front, and their edges: a bite 8 mm open behind 10 mm of lip, mm.
FRONT, TEETH, BITE = -60.0, -50.0, 4.0


def head(**renamed):
    """A head with flat sides and a flat front, and two jaws in it as wide as it is."""
    grid = cmfsim.ImageData(np.zeros((21, 81, 81), np.float32), SPACING, (-20.0, -70.0, -60.0))
    x, y, z = (np.broadcast_to(axis, grid.values.shape) for axis in grid.axes())
    skin = np.minimum(y - FRONT, 18.0 - np.abs(x))
    jaw = np.minimum(y - TEETH, 9.0 - np.abs(x))
    bones = {"cranium": np.minimum(jaw, z - BITE), "mandible": np.minimum(jaw, -BITE - z)}
    level = np.minimum.reduce([skin, *(-bone for bone in bones.values())])
    image = {name: grid.with_values(values.astype(np.float32)) for name, values in bones.items()}
    anatomy = cmfsim.Anatomy(
        skin=grid.with_values(skin.astype(np.float32)),
        bones={renamed.get(name, name): bone for name, bone in image.items()},
    )
    return grid.with_values(level.astype(np.float32)), anatomy, (x, y, z)


def test_the_mouth_is_tissue_near_both_jaws_near_the_skin_and_in_front():
    level, anatomy, (x, y, z) = head()
    needed = needed_halvings(level, anatomy)
    mouth = needed.astype(bool)
    assert needed.dtype == np.uint8
    assert set(np.unique(needed)) == {0, 1}
    assert not mouth[level.values <= 0.0].any()
    # In the middle plane the distances are those from quarter planes, to a voxel's size.
    middle = (x == 0.0) & (y < TEETH) & (level.values > 0.0)
    width = sum(np.hypot(y - TEETH, np.maximum(BITE - jaw * z, 0.0)) for jaw in (-1, 1))
    near = middle & (width < MOUTH_WIDTH - 3.0)
    assert mouth[near].all()
    assert np.count_nonzero(near) > 50
    assert not mouth[middle & (width > MOUTH_WIDTH + 3.0)].any()
    # Between the rows it ends at a depth from the front, beside the teeth at a length behind it.
    assert mouth[(x == 0.0) & (np.abs(z) < 1.0) & (np.abs(y - TEETH - 2.0) < 1.0)].all()
    assert not mouth[(np.abs(x) < 2.0) & (y > FRONT + MOUTH_DEPTH + 1.0)].any()
    foremost = float(y[mouth].min())
    beside = (np.abs(x) == 12.0) & (np.abs(z) < BITE)
    assert mouth[beside & (y > TEETH) & (y < foremost + MOUTH_LENGTH - 1.0)].all()
    assert not mouth[y > foremost + MOUTH_LENGTH + 1.0].any()


@pytest.mark.parametrize("renamed", [{"mandible": "skull"}, {"cranium": "mandible"}])
def test_a_head_with_one_jaw_has_no_mouth(renamed):
    level, anatomy, _ = head(**renamed)
    assert not needed_halvings(level, anatomy).any()


def test_the_lips_of_the_phantom_have_tets_of_half_the_edge(tmp_path_factory):
    """At an edge of 5 mm lips are not thin; a lattice has twelve tets in a cube."""
    head = cmfsim.make_head()
    anatomy = drawn_levels(tmp_path_factory, 2.0)
    level, _ = tissue_level(anatomy, TissueRegion((0, -40, 0), lower=-75.0, upper=0.0))
    edge, ends = 5.0, ("superius", "inferius")
    lips = np.mean([head.skin_landmarks[f"labiale_{end}"] for end in ends], axis=0)
    largest = []
    for needed in (needed_halvings(level, anatomy), None):
        options = cmfsim.MeshOptions(edge, refinements=GAP_REFINEMENTS)
        allowed = allowed_halvings(anatomy)
        made = cmfsim.mesh_from_level(level, options, allowed=allowed, needed=needed)
        assert made.report.min_dihedral >= 10.0
        middles = np.asarray(made.mesh.nodes)[np.asarray(made.mesh.tets)].mean(axis=1)
        near = np.linalg.norm(middles - lips, axis=1) < 15.0
        largest.append(np.percentile(np.asarray(made.mesh.volumes)[near], 95.0))
    assert largest[0] < 1.5 * (0.5 * edge) ** 3 / 12.0 < largest[1]
