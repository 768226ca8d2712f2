"""The file of a scene that uses everything."""

import pytest
from block_scene import scene

import cmfsim


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "scene.npz"
    cmfsim.write_scene(path, scene())
    return path
