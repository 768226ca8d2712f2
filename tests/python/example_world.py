"""What the examples in docstrings speak of: a small case on disk, and the values made from it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import cmfsim
import phantom_case
from cmfsim.lab.virtual.demo import write_demo_case
from shared_values import COARSE_EDGE, coarse_demo_patient, shared

MOTION = cmfsim.rigid_motion((0.0, -5.0, 0.0))


def example_values(temporary: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that examples use beside their own."""
    patient = coarse_demo_patient(temporary)
    prediction = shared(
        temporary, "example-prediction", lambda _: cmfsim.predict_patient(patient, "M+S")
    )
    head = cmfsim.make_head()
    return {
        "patient": patient,
        "prediction": prediction,
        "anatomy": patient.anatomy,
        "findings": patient.findings,
        "segments": patient.segments,
        "scene": patient.scene,
        "result": prediction.result,
        "skin": prediction.skin_before,
        "landmarks": patient.landmarks["skull"],
        "skin_landmarks": head.skin_landmarks,
        "motion": MOTION,
    }


def write_example_files(folder: Path, values: Mapping[str, Any]) -> None:
    """The files that examples read, beside one another."""
    write_demo_case(folder, edge_length=COARSE_EDGE)
    head = cmfsim.make_head()
    phantom_case.write_landmarks(folder, head)
    image = head.ct((3.0, 3.0, 3.0))
    for name in ("ct.nii.gz", "head.nii.gz"):
        cmfsim.write_image(image, folder / name)
    cmfsim.write_surface(folder / "skin.stl", cmfsim.read_surface(folder / "skin.ply"))
    mandible = cmfsim.read_surface(folder / "mandible.ply")
    moved = cmfsim.SurfaceData(mandible.vertices + [0.0, 5.0, 0.0], mandible.triangles)
    cmfsim.write_surface(folder / "mandible_post.ply", moved)
    cmfsim.write_transform(folder / "maxilla.tfm", MOTION, direction="from-parent")
    cmfsim.write_scene(folder / "scene.npz", values["scene"])
    for name in ("out.npz", "mesh.vtu"):
        cmfsim.write_result(folder / name, values["result"])
    cmfsim.write_slicer_bundle(folder / "planning.mrb", values["prediction"])
