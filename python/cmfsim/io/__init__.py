"""Files and values: each format's reader beside its writer, one file per subject."""

from cmfsim.io.images import read_image, write_image
from cmfsim.io.results import read_result, result_suffixes, write_result
from cmfsim.io.scenes import read_plan, read_scene, write_scene
from cmfsim.io.transforms import read_transform, write_transform

__all__ = [
    "read_image",
    "read_plan",
    "read_result",
    "read_scene",
    "read_transform",
    "result_suffixes",
    "write_image",
    "write_result",
    "write_scene",
    "write_transform",
]
