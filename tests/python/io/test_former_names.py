"""Modules of readers that scripts of others import under the names of the first versions."""

import importlib

import pytest


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("cmfsim.io.images", "read_image_file"),
        ("cmfsim.io.landmarks", "read_landmark_file"),
        ("cmfsim.io.landmarks", "read_landmarks"),
        ("cmfsim.io.ply", "write_ply"),
        ("cmfsim.io.surfaces", "read_surface"),
    ],
)
def test_a_reader_is_where_it_was(module, name):
    assert callable(getattr(importlib.import_module(module), name))
