"""How rough a model makes the skin of cheeks and lips: skin_roughness.py CASE... [--markdown PAGE].

The roughness of a skin is the rms distance of its vertices from a quadric that is fitted to the
other vertices within 8 mm (`--radius`). Furrows and lumps of the predicted face are the part of it
that the skin before the operation does not have. Each case is built once; the same mesh is then
predicted by H+S and M+S with the constants and placements of muscles in SETTINGS. A setting that
states no fat of its own takes that of its preset, in H+S too, so that each M+S is compared with
homogeneous tissue of the same fat. Cases with a face after the operation also get their errors.
"""

import argparse
import platform
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import cmfsim
from benches.scenes.marked import publish
from cmfsim.pipeline.banding import face_landmarks

NAME = "benches/accuracy/skin_roughness.py"
RADIUS = 8.0
MODELS = ("H+S", "M+S")
PARTS = {"cheeks": ("left cheek", "right cheek"), "lips": ("upper lip", "lower lip")}
# A quadric z = a + b x + c y + d x² + e xy + f y² over the tangent plane takes six vertices; with
# twice as many, one vertex does not decide it.
LEAST = 12
SETTINGS: Mapping[str, cmfsim.CaseMuscles] = {
    "default": cmfsim.CaseMuscles(),
    "default, sharp": cmfsim.CaseMuscles(blur=0.0),
    "kim2010": cmfsim.CaseMuscles(preset="kim2010", blur=0.0),
}
Floats = NDArray[np.float64]


def heights(skin: cmfsim.SurfaceData, chosen: NDArray[np.bool_], radius: float = RADIUS) -> Floats:
    """The distance of each chosen vertex from the quadric of its neighbours, mm, with sign.

    NaN where fewer than 12 vertices that face the same way lie within the radius.
    """
    vertices, normals = skin.vertices, skin.searched.vertex_normals
    tree = cKDTree(vertices)
    found = np.full(int(chosen.sum()), np.nan)
    for row, vertex in enumerate(np.flatnonzero(chosen)):
        near = np.array(tree.query_ball_point(vertices[vertex], radius))
        near = near[(near != vertex) & (normals[near] @ normals[vertex] > 0.0)]
        if len(near) < LEAST:
            continue
        normal = normals[vertex]
        across = np.linalg.svd(normal[None])[2][1:]
        x, y = across @ (vertices[near] - vertices[vertex]).T
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        height = (vertices[near] - vertices[vertex]) @ normal
        # The vertex itself is the origin, so that its distance is the constant term.
        found[row] = -np.linalg.lstsq(terms, height, rcond=None)[0][0]
    return found


def roughness(skin: cmfsim.SurfaceData, chosen: NDArray[np.bool_], radius: float = RADIUS) -> float:
    """The rms distance of the chosen vertices from the quadrics of their neighbours, mm."""
    found = heights(skin, chosen, radius)
    return float(np.sqrt(np.nanmean(found**2)))


def with_setting(patient: cmfsim.PatientModel, given: cmfsim.CaseMuscles) -> cmfsim.PatientModel:
    """The patient with the fat of a preset, and with muscles as `given` states."""
    fat = cmfsim.TissueData("preset", preset=given.preset, fraction=0.0)
    scene = replace(patient.scene, tissue=fat)
    return cmfsim.with_muscles(replace(patient, fat=fat, scene=scene), given)


def parts_of(patient: cmfsim.PatientModel) -> dict[str, NDArray[np.bool_]]:
    """The vertices of the mesh's skin in cheeks and lips."""
    regions = cmfsim.skin_regions(patient.skin.vertices, face_landmarks(patient).points)
    return {
        part: np.logical_or.reduce([regions[name] for name in names])
        for part, names in PARTS.items()
    }


def errors_of(
    case: cmfsim.Case, patient: cmfsim.PatientModel, skins: Mapping[str, cmfsim.SurfaceData]
) -> list[str]:
    """Mean error over the lower face and the lips, mm, of each model; dashes without a face after.

    Through the landmarks of the skin where both faces have them, else to the closest point.
    """
    after = case.postoperative
    if after is None or after.skin is None:
        return ["–"] * 4
    known = face_landmarks(patient).points
    marks = None
    if after.landmarks is not None:
        marks = (known, cmfsim.read_landmarks(after.landmarks))
    found = cmfsim.compare_models(
        patient.skin,
        {model: skin.vertices for model, skin in skins.items()},
        cmfsim.read_surface(after.skin),
        landmarks=marks,
        regions=cmfsim.skin_regions(patient.skin.vertices, known),
        mask="face",
    ).regions
    parts = (("lower face",), PARTS["lips"])
    return [
        f"{np.mean([found[name][model].mean for name in names]):.2f}"
        for names in parts
        for model in skins
    ]


def rows_of(case: cmfsim.Case, radius: float) -> list[str]:
    """A row for each setting of a case."""
    patient = cmfsim.build_model(replace(case, muscles=None), check=False)
    parts = parts_of(patient)
    rows = []
    for name, given in SETTINGS.items():
        used = with_setting(patient, given)
        skins = {m: cmfsim.predict_patient(used, m).skin for m in MODELS}
        cells = [case.name, name]
        for chosen in parts.values():
            before, h, m = (roughness(s, chosen, radius) for s in (patient.skin, *skins.values()))
            cells += [f"{before:.4f}", f"{h:.4f}", f"{m:.4f}", f"{100 * (m / h - 1):+.1f}"]
        rows.append(f"| {' | '.join([*cells, *errors_of(case, patient, skins)])} |")
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Builds each case, predicts it, and prints or publishes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=Path, nargs="+", metavar="CASE")
    parser.add_argument("--radius", type=float, default=RADIUS, help="mm")
    parser.add_argument("--markdown", type=Path, metavar="PAGE", help="page to write into")
    options = parser.parse_args()
    roughs = [f"{part}: {what}" for part in PARTS for what in ("before", *MODELS, "%")]
    errors = [f"error, {part}: {model}" for part in ("lower face", "lips") for model in MODELS]
    head = ["case", "muscles", *roughs, *errors]
    rows = [f"| {' | '.join(head)} |", "| --- | --- |" + " ---: |" * (len(head) - 2)]
    for path in options.cases:
        rows += rows_of(cmfsim.Case.load(path), options.radius)
    words = (
        f"Roughness within {options.radius:g} mm and mean error, mm; %: M+S over H+S. "
        f"{platform.machine()}, cmfsim {cmfsim.__version__}."
    )
    publish(options.markdown, NAME, "\n".join(rows) + f"\n\n{words}")


if __name__ == "__main__":
    main()
