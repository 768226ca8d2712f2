"""Prints the errors of the motion of virtual patients' skin by variant.

    python -m benches.accuracy.variant_motion STUDY FOLDER

FOLDER holds virtual patients, STUDY what `cmfsim study … --variants` wrote for them. An evaluation
compares positions, as with a real patient: where the skin of the CT and of the mesh lies behind the
true skin before the operation, so does every prediction. This compares the displacement of each
vertex with the true one of the nearest point of the exact skin, along its normal: mean size over
patients, mm, and in brackets the signed mean; negative is too far back.
"""

import sys
from pathlib import Path

import numpy as np
import pyvista as pv
from scipy.spatial import cKDTree

import cmfsim

REGIONS = ("face", "lower face", "upper lip", "lower lip", "chin")
# Vertices of a mesh further from the exact skin are not on it, mm.
NEAR = 4.0


def errors(study: Path, folder: Path, variant: str, model: str, patient: str) -> np.ndarray | None:
    """Mean size and mean of the errors in each region, (r, 2) mm; None where there is no result."""
    place = study / variant / patient
    if not (place / "H+S").exists() and not (place / "M+S").exists():
        # A variant with one model has no folders of models.
        if model != "M+S" or not (place / "prediction.vtp").exists():
            return None
    elif not (place / model / "prediction.vtp").exists():
        return None
    else:
        place = place / model
    skin = pv.read(place / "prediction.vtp")
    points = np.asarray(skin.points, dtype=np.float64)
    truth = folder / patient / "truth"
    before, after = (
        cmfsim.read_surface(truth / f"skin_{name}.ply") for name in ("before", "exact")
    )
    start = np.asarray(before.vertices)
    distance, at = cKDTree(start).query(points)
    normals = np.asarray(cmfsim.Surface(before.vertices, before.triangles).vertex_normals)
    moved = (np.asarray(after.vertices) - start)[at]
    off = ((np.asarray(skin.point_data["displacement"]) - moved) * normals[at]).sum(axis=1)
    landmarks = cmfsim.read_landmarks(folder / patient / "skin.mrk.json")
    regions = cmfsim.skin_regions(points, landmarks)
    chosen = [off[regions[name] & (distance < NEAR)] for name in REGIONS]
    return np.array([[np.abs(part).mean(), part.mean()] for part in chosen])


def main(study: Path, folder: Path) -> None:
    """Prints the table of the patients whom every variant has."""
    variants = sorted(path.name for path in study.iterdir() if path.is_dir())
    patients = sorted(path.name for path in (study / "as-given").iterdir() if path.is_dir())
    print(f"| model | variant | n | {' | '.join(REGIONS)} |")
    print(f"|---|---|---:|{'---:|' * len(REGIONS)}")
    for model in ("H+S", "M+S"):
        for variant in variants:
            found = [errors(study, folder, variant, model, patient) for patient in patients]
            rows = [row for row in found if row is not None]
            if rows:
                means = np.mean(rows, axis=0)
                cells = " | ".join(f"{size:.2f} ({mean:+.2f})" for size, mean in means)
                print(f"| {model} | {variant} | {len(rows)} | {cells} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
