"""The points of the patient's skin at which predictions are compared, and their error there."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.evaluation import SKIN_LANDMARKS, DistanceStatistics, distance_statistics, skin_regions
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.values.checks import Floats, as_rows
from cmfsim.values.patient_model import PatientModel

Regions = dict[str, NDArray[np.bool_]]

POINTS_FORMAT = "cmfsim-bench-points"
# The region that figures speak of: by landmarks on the skin, without them all points.
WHOLE = "face"
# All points: the skin of the simulated tissue, the face and what lies round it.
SKIN = "skin"
# Points at most: beyond, figures do not change any more.
MOST_POINTS = 20_000
# Points up to this far from the mesh's skin are on the tissue, mm.
ON_TISSUE = 2.0


def skin_points(patient: PatientModel) -> tuple[Floats, Regions]:
    """Points of the skin of a patient's simulated tissue, and which lie in each region of the face.

    They are vertices of the detailed face, so that they are the same however the tissue is meshed.
    Without all of the skin's landmarks the face is all of them, in one part.

    Raises `CaseError`: There is no detailed face: the case is an image, and scikit-image is not
        installed. No point of it lies on the face.
    """
    face = patient.face
    if face is None:
        raise CaseInputError(
            f"{patient.name}: predictions are compared on the detailed face, which is read from "
            "the image with scikit-image: pip install '.[imaging]' in cmfsim's folder"
        )
    vertices = face.vertices
    landmarks = patient.landmarks.get("skin", {})
    on_tissue = _on_tissue(patient, vertices)
    regions = {WHOLE: on_tissue}
    if set(SKIN_LANDMARKS) <= set(landmarks):
        regions = skin_regions(vertices, landmarks)
    regions = {**regions, SKIN: on_tissue | regions[WHOLE]}
    if not regions[WHOLE].any():
        raise CaseInputError(
            f"{patient.name}: no point of the skin is on the face: check that the skin landmarks "
            "are in the frame of the image"
        )
    chosen = np.flatnonzero(regions[SKIN])
    chosen = chosen[:: -(-len(chosen) // MOST_POINTS)]
    return vertices[chosen], {name: inside[chosen] for name, inside in regions.items()}


def _on_tissue(patient: PatientModel, vertices: Floats) -> NDArray[np.bool_]:
    skin = patient.skin
    closest, _, _ = Surface(skin.vertices, skin.triangles).closest(vertices)
    near: NDArray[np.bool_] = np.linalg.norm(closest - vertices, axis=1) <= ON_TISSUE
    return near


def skin_errors(
    moved: ArrayLike, reference: ArrayLike, regions: Mapping[str, NDArray[np.bool_]]
) -> dict[str, DistanceStatistics]:
    """Figures of |u - u_ref| at the same points, mm: over each region that has points.

    moved, reference: (k, 3), mm. Displacements by a prediction and by the reference.
    regions: mapping of str to (k,) bool.
    Raises `CaseError`: Another number of points, NaN.
    """
    ours, theirs = as_rows("moved", moved, 3), as_rows("reference", reference, 3)
    if len(ours) != len(theirs):
        raise CaseInputError(f"moved has {len(ours)} points, the reference {len(theirs)}")
    apart = np.linalg.norm(ours - theirs, axis=1)
    return {
        name: distance_statistics(apart[inside]) for name, inside in regions.items() if inside.any()
    }


def write_points(path: Path, points: Floats, regions: Mapping[str, NDArray[np.bool_]]) -> None:
    """Replaces a file of points and regions in one step."""
    arrays = {f"region.{name}": inside for name, inside in regions.items()}
    write_archive(path, POINTS_FORMAT, "points_of", {}, {"points": points, **arrays})


def read_points(path: Path) -> tuple[Floats, Regions]:
    """The points and regions that `write_points` wrote."""
    _, arrays = read_archive(path, POINTS_FORMAT, "points_of")
    regions = {
        name.removeprefix("region."): array
        for name, array in arrays.items()
        if name.startswith("region.")
    }
    return member_of(arrays, "points"), regions
