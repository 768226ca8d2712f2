"""Writes the face after the demo's operation, in silico: make_demo_truth.py [FILE].

The head and the plan are those of the virtual patient P1, with exact landmarks. Run it after a
change of the phantom, of P1 or of the truth's physics. It takes some minutes and needs the extras
`study`, `imaging` and `mesh`. In FILE:

vertices (v, 3) float32, mm, LPS: the skin of the face triangles (t, 3) uint32 (uint16 where that
suffices) landmark_names, landmarks (k,) text and (k, 3) float32, mm: on that skin, exact parameters
JSON text: the head, the plan, how the face was computed and how well it converged
"""

import json
import sys
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from numpy.typing import NDArray

from cmfsim import Case, SurfaceData, __version__, make_head, write_landmarks
from cmfsim.io.files.reading_writing import replacing
from cmfsim.lab.virtual.patient_folder import case_text
from cmfsim.lab.virtual.population import PATIENTS
from cmfsim.lab.virtual.truth import PostoperativeTruth, postoperative_truth
from cmfsim.phantom.model import PhantomHead

PATIENT = PATIENTS[1]
EDGE_LENGTH = 6.0
# Triangles of the face, and how far behind the roots of the zygomatic arches and over the nasion it
# ends, mm.
TRIANGLES = 14_000
BEHIND, ABOVE = 5.0, 60.0
FILE = Path(__file__).parents[1] / "python" / "cmfsim" / "lab" / "virtual" / "demo_truth.npz"


def main(path: Path) -> int:
    """Makes the face, writes it, and says how large it is."""
    head = make_head(PATIENT.parameters)
    with tempfile.TemporaryDirectory() as folder:
        case = _case(Path(folder), head)
        truth = postoperative_truth(PATIENT, head, case, edge_length=EDGE_LENGTH, progress=print)
    skin = _face(truth, head)
    names = list(truth.skin_landmarks)
    parameters = {
        "what": "in silico: a synthetic head and a computed operation; no patient",
        "head": asdict(PATIENT.parameters),
        "plan": {name: asdict(move) for name, move in PATIENT.plan.items()},
        "muscle_thickness": PATIENT.muscle_thickness,
        "muscle_stiffness": PATIENT.muscle_stiffness,
        "edge_length_mm": EDGE_LENGTH,
        "tets": len(truth.tets),
        "residual": truth.equilibrium.residual,
        "cmfsim": __version__,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        np.savez_compressed(
            file,
            vertices=np.asarray(skin.vertices, dtype=np.float32),
            triangles=np.asarray(skin.triangles, dtype=np.uint16),
            landmark_names=np.array(names),
            landmarks=np.array([truth.skin_landmarks[name] for name in names], dtype=np.float32),
            parameters=np.array(json.dumps(parameters)),
        )
    print(f"wrote {path}: {len(skin.triangles)} triangles, {path.stat().st_size} bytes")
    return 0


def _case(folder: Path, head: PhantomHead) -> Case:
    """The demo's cuts and plan, as a case."""
    write_landmarks(folder / "skull.mrk.json", head.skull_landmarks)
    write_landmarks(folder / "skin.mrk.json", head.skin_landmarks)
    (folder / "ct.nrrd").touch()
    text = case_text(PATIENT, head.skull_landmarks, EDGE_LENGTH)
    (folder / "case.toml").write_text(text, encoding="utf-8")
    case = Case.load(folder / "case.toml")
    return replace(case, postoperative=None)


def _face(truth: PostoperativeTruth, head: PhantomHead) -> SurfaceData:
    """The face after the operation: cropped where it was at rest, and decimated."""
    rest = np.asarray(truth.skin_before.vertices)
    last = float(head.skull_landmarks["supraglenoid_L"][1]) + BEHIND
    top = float(head.skull_landmarks["nasion"][2]) + ABOVE
    inside = (rest[:, 1] < last) & (rest[:, 2] < top)
    triangles: NDArray[Any] = truth.skin.triangles.astype(np.int64)
    triangles = triangles[inside[triangles].all(axis=1)]
    mesh = pyvista.PolyData.from_regular_faces(np.asarray(truth.skin.vertices), triangles).clean()
    small = mesh.decimate(max(0.0, 1.0 - TRIANGLES / mesh.n_cells))
    corners = small.regular_faces.astype(np.uint32)
    return SurfaceData(np.asarray(small.points, dtype=np.float64), corners)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE))
