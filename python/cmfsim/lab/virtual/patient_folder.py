"""A virtual patient on disk: the case before the operation, and the truth after it."""

import logging
import os
import platform
import shutil
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import __version__
from cmfsim.errors import third_party
from cmfsim.io import Case, write_image, write_landmarks, write_surface
from cmfsim.io.cases.cohorts import COHORT_FORMAT
from cmfsim.io.files.reading_writing import replace_text
from cmfsim.io.files.summaries import kept_record, write_record
from cmfsim.lab.virtual.mechanics.equilibrium import EquilibriumOptions
from cmfsim.lab.virtual.population import (
    DRAWN,
    PATIENTS,
    VirtualPatient,
    patient_named,
    template_text,
)
from cmfsim.lab.virtual.truth import PostoperativeTruth, postoperative_truth, scanned
from cmfsim.phantom.model import PhantomHead, make_head
from cmfsim.values.checks import Floats, as_positive, as_whole, plain
from cmfsim.values.motion import carried
from cmfsim.values.progress import Progress, no_progress
from cmfsim.values.surface_data import SurfaceData

_log = logging.getLogger(__name__)
# Standard deviations, mm: of a landmark along each axis, on the skull for one operator and on the
# skin for the mean of several; of a surface scanner's noise at a point, and of its waves.
SKULL_NOISE, SKIN_NOISE = 0.7, 0.3
SCAN_WHITE, SCAN_SMOOTH = 0.1, 0.2
# Numbers that make the draws of one patient independent, next to seed and patient number.
CT_DRAW, SKULL_DRAW, SKIN_DRAW, SCAN_DRAW, AFTER_DRAW = range(5)
# Edge length of the mesh in the case file, relative to the true mesh.
COARSER = 1.25
# Patients made by default.
PATIENTS_WITH_JOINED_LIPS = tuple(n for n, p in PATIENTS.items() if not p.separate_lips)
TRUTH = "truth"
RECORD = "truth.json"
TIMES = "times.json"
# The skin before the operation, whose vertices a prediction moves.
SKIN = "skin.ply"
COHORT = "cohort.toml"
# The case with the operation as it was carried out, where it departs from the plan; and the cohort
# of these.
EXECUTED = "executed.toml"


def virtual_patients(
    folder: str | os.PathLike[str],
    numbers: Iterable[int] = PATIENTS_WITH_JOINED_LIPS,
    *,
    seed: int = 0,
    edge_length: float = 6.0,
    spacing: float = 2.0,
    progress: Progress | None = None,
) -> list[Path]:
    """The case files of virtual patients, each in its own folder with the truth.

    Patients who exist already with the same settings are kept. `cohort.toml` in the folder lists
    the complete ones, for `cmfsim study`.

    Parameters
    ----------
    folder : path
        Patient n goes to `folder/Pn`.
    numbers : iterable of int
        1 to 6. Those whose lips meet, 5 and 6, take many times as long and are made on request.
    seed : int
        Of all noise; the same seed produces the same files.
    edge_length : float, mm
        Of the true mesh.
    spacing : float, mm
        Of the CT.
    progress : callable, optional
        Called with the name of each stage as it begins.

    Raises
    ------
    CmfsimError
        (also `ValueError` where the input is at fault) As `write_virtual_patient`.
    OSError
        A folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cases = cmfsim.virtual_patients("insilico", [1, 2])  # doctest: +SKIP
    """
    patients = [patient_named(number) for number in numbers]
    for patient in patients:
        place = Path(folder) / patient.name
        if is_made(place, patient_settings(patient, seed, edge_length, spacing)):
            _log.info("%s already exists", patient.name)
            continue

        def stage(name: str, of: VirtualPatient = patient) -> None:
            if progress is not None:
                progress(f"{of.name}: {name}")

        write_virtual_patient(
            place,
            patient.number,
            seed=seed,
            edge_length=edge_length,
            spacing=spacing,
            progress=stage,
        )
    complete = [
        p.name for p in PATIENTS.values() if (Path(folder) / p.name / TRUTH / RECORD).exists()
    ]
    replace_text(Path(folder) / COHORT, cohort_text("virtual patients", complete))
    return [Path(folder) / patient.name / "case.toml" for patient in patients]


def cohort_text(name: str, patients: Iterable[str], *, executed: bool = False) -> str:
    """The text of a `cohort.toml` next to the folders of patients."""
    lines = [
        "# `cmfsim study` with this file predicts every patient by every model.",
        f'format = "{COHORT_FORMAT}"',
        "version = 1",
        f'name = "{name}"',
        'note = "in silico: synthetic heads and computed operations; no patients"',
        'output = "executed"' if executed else 'output = "study"',
    ]
    for patient in patients:
        file = f"{TRUTH}/{EXECUTED}" if executed else "case.toml"
        lines += ["", "[[cases]]", f'name = "{patient}"', f'file = "{patient}/{file}"']
    return "\n".join([*lines, ""])


def write_virtual_patient(  # noqa: PLR0913 (options by name)
    folder: str | os.PathLike[str],
    patient: int | VirtualPatient,
    *,
    seed: int = 0,
    edge_length: float = 6.0,
    refine: bool = False,
    spacing: float = 2.0,
    grid: float = 1.5,
    skin_spacing: float = 2.0,
    options: EquilibriumOptions | None = None,
    progress: Progress | None = None,
) -> Path:
    """The `case.toml` of a virtual patient, with CT and landmarks; the truth lies in `truth`.

    *In silico*: a synthetic head and a computed operation. Its tissue, mesh, muscles and contact
    differ from those of the models under test; see docs/virtual_patients.md.

    Parameters
    ----------
    folder : path
        Created if needed. An earlier truth in it is replaced once the new one is complete.
    patient : int or VirtualPatient
        1 to 6, or a result of `drawn_patient`.
    seed : int
        Of the noise of CT, landmarks and scan.
    edge_length : float, mm
        Of the true mesh.
    refine : bool
        Whether tets are smaller where tissue is thin; always so if the lips are separate.
    spacing : float, mm
        Of the CT.
    grid : float, mm
        Spacing of the level images from which the true mesh is made.
    skin_spacing : float, mm
        Of the marching cubes that make the skin.
    options : EquilibriumOptions, optional
    progress : callable, optional

    Raises
    ------
    CaseError
        (also `ValueError`) No such patient, a length that is not positive, a missing package of
        the extra "study".
    SolverError
        The equilibrium was not found.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> case = cmfsim.write_virtual_patient("P1", 1)  # doctest: +SKIP
    """
    if not isinstance(patient, VirtualPatient):
        patient = patient_named(patient)
    for name, value in (("edge_length", edge_length), ("spacing", spacing), ("grid", grid)):
        as_positive(name, value)
    as_positive("skin_spacing", skin_spacing)
    seed = as_whole("seed", seed, 0)
    for package in ("skfem", "pyamg"):  # before half a minute of work
        third_party(package, "virtual patients are solved", "study")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stage = progress or no_progress
    begun = time.perf_counter()
    head = make_head(patient.parameters)
    stage("imaging the head")
    case = _write_case(folder, patient, head, seed, spacing=spacing, edge_length=edge_length)
    truth = postoperative_truth(
        patient,
        head,
        case,
        edge_length=edge_length,
        refine=refine,
        grid=grid,
        skin_spacing=skin_spacing,
        options=options,
        progress=progress,
    )
    stage("writing the truth")
    write_surface(folder / SKIN, truth.skin_before)
    fresh = folder / f".{TRUTH}.new"
    shutil.rmtree(fresh, ignore_errors=True)
    _write_truth(fresh, truth, patient, seed)
    if patient.departures:
        text = case_text(patient, {}, COARSER * edge_length, executed=truth.motions)
        (fresh / EXECUTED).write_text(text, encoding="utf-8")
    settings = patient_settings(patient, seed, edge_length, spacing)
    write_record(fresh / RECORD, _record(patient, truth, settings))
    # In a separate file: the record is reproduced to the last byte by the same seed.
    times = {"seconds": time.perf_counter() - begun, "solve_seconds": truth.equilibrium.seconds}
    write_record(fresh / TIMES, times)
    shutil.rmtree(folder / TRUTH, ignore_errors=True)
    fresh.rename(folder / TRUTH)
    return folder / "case.toml"


def _write_case(
    folder: Path,
    patient: VirtualPatient,
    head: PhantomHead,
    seed: int,
    *,
    spacing: float,
    edge_length: float,
) -> Case:
    """The case before the operation, read back from the files written: CT, landmarks, case file."""
    draw = np.random.SeedSequence([seed, patient.number, CT_DRAW]).generate_state(1)[0]
    ct = head.ct((spacing, spacing, spacing), seed=int(draw))
    write_image(ct, folder / "ct.nrrd")
    skull = _placed(head.skull_landmarks, SKULL_NOISE, [seed, patient.number, SKULL_DRAW])
    write_landmarks(folder / "skull.mrk.json", skull)
    skin = _placed(head.skin_landmarks, SKIN_NOISE, [seed, patient.number, SKIN_DRAW])
    write_landmarks(folder / "skin.mrk.json", skin)
    replace_text(folder / "case.toml", case_text(patient, skull, COARSER * edge_length))
    return Case.load(folder / "case.toml")


def _record(
    patient: VirtualPatient, truth: PostoperativeTruth, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Content of `truth.json`: how the patient was made, and the properties of the truth."""
    return {
        "what": "in silico: a synthetic head and a computed operation; no patient",
        "settings": settings,
        "patient": _described(patient),
        "motions": {name: matrix.tolist() for name, matrix in truth.motions.items()},
        "noise_mm": {
            "skull_landmarks": SKULL_NOISE,
            "skin_landmarks": SKIN_NOISE,
            "scan_white": SCAN_WHITE,
            "scan_smooth": SCAN_SMOOTH,
        },
        "truth": _measured(truth),
        "versions": {"cmfsim": __version__, "python": platform.python_version()},
    }


def _placed(landmarks: Mapping[str, Floats], noise: float, seed: list[int]) -> dict[str, Floats]:
    """Landmarks with placement noise along each axis."""
    generator = np.random.default_rng(seed)
    return {
        label: point + noise * generator.standard_normal(3) for label, point in landmarks.items()
    }


def case_text(
    patient: VirtualPatient,
    skull: Mapping[str, Floats],
    edge_length: float,
    *,
    executed: Mapping[str, Floats] | None = None,
) -> str:
    """The text of `case.toml`, or of the case with the operation as it was carried out.

    skull: Landmarks about which the turns of the plan are.
    executed: (4, 4), mm. True motions of the segments: they replace the plan, beside the truth.
    """
    place, truth = ("", f"{TRUTH}/") if executed is None else ("../", "")
    what = (
        "# `cmfsim evaluate case.toml` predicts the face and compares it with the truth in truth/."
        if executed is None
        else "# Its plan is what the operation did: errors are those of the tissue alone."
    )
    lines = [""]
    for procedure in patient.osteotomies:
        lines += ["", "[[osteotomies]]", f'procedure = "{procedure}"']
    for segment, move in patient.plan.items():
        lines += ["", f"[plan.{segment}]"]
        if executed is not None:
            lines.append(f"matrix = {executed[segment].tolist()}")
            continue
        lines.append(f"translation = {list(move.translation)}")
        if move.angle:
            centre = [round(float(x), 3) for x in skull[move.centre]]
            lines += [f"angle = {move.angle}", f"axis = {list(move.axis)}"]
            lines.append(f"centre = {centre}   # {move.centre}")
    return template_text("patient").format(
        name=patient.name,
        label=patient.label,
        what=what,
        place=place,
        tables="\n".join(lines),
        edge_length=edge_length,
        truth=truth,
    )


def patient_settings(
    patient: VirtualPatient, seed: int, edge_length: float, spacing: float
) -> dict[str, Any]:
    """The settings that determine a patient's files; `truth.json` stores them for comparison."""
    # A drawn patient depends on the distributions of this version.
    return {
        **({"person": _described(patient)} if patient.number > DRAWN else {}),
        "version": __version__,
        "patient": patient.number,
        "seed": int(seed),
        "edge_length": float(edge_length),
        "spacing": float(spacing),
    }


def _described(patient: VirtualPatient) -> dict[str, Any]:
    return {"name": patient.name, **plain(patient)}


def _measured(truth: PostoperativeTruth) -> dict[str, Any]:
    """Figures of the solution."""
    found = truth.equilibrium
    moved = truth.skin.vertices - truth.skin_before.vertices
    lips = truth.lips
    contact: dict[str, Any] = {}
    if lips is not None:
        contact = {
            "lip_nodes": len(lips.upper.nodes) + len(lips.lower.nodes),
            "lip_nodes_touching": lips.touching(truth.displacements),
            "lip_penetration_mm": lips.penetration(truth.displacements),
        }
    return {
        **contact,
        "nodes": len(truth.nodes),
        "tets": len(truth.tets),
        "muscle_fraction": float(truth.fraction.mean()),
        "stripped_nodes": truth.operation.stripped,
        "residual": found.residual,
        "newton_iterations": len(found.history),
        "linear_iterations": found.linear_iterations,
        "energy_Nmm": found.energy,
        "penetration_mm": truth.penetration,
        "last_skin_step_mm": truth.last_step,
        "volume_ratio": [float(truth.volume_ratios.min()), float(truth.volume_ratios.max())],
        "largest_skin_move_mm": float(np.linalg.norm(moved, axis=1).max()),
    }


def _write_truth(
    folder: Path, truth: PostoperativeTruth, patient: VirtualPatient, seed: int
) -> None:
    """Writes the truth, and its skin and landmarks as they are measured after the operation."""
    folder.mkdir()
    draw = [seed, patient.number, SCAN_DRAW]
    scan = scanned(truth.skin, white=SCAN_WHITE, smooth=SCAN_SMOOTH, seed=draw)
    placed = _placed(truth.skin_landmarks, SKIN_NOISE, [seed, patient.number, AFTER_DRAW])
    write_surface(folder / "skin.ply", scan)
    write_surface(folder / "skin_exact.ply", truth.skin)
    write_surface(folder / "skin_before.ply", truth.skin_before)
    write_landmarks(folder / "skin.mrk.json", placed)
    write_landmarks(folder / "skin_exact.mrk.json", truth.skin_landmarks)
    write_landmarks(folder / "skull_exact.mrk.json", truth.skull_landmarks)
    for name in ("bones", "bones_before"):
        (folder / name).mkdir()
    for name, segment in truth.segments.items():
        before = segment.surface
        after = SurfaceData(carried(truth.motions[name], before.vertices), before.triangles)
        write_surface(folder / "bones_before" / f"{name}.ply", before)
        write_surface(folder / "bones" / f"{name}.ply", after)


def is_made(folder: Path, settings: Mapping[str, Any]) -> bool:
    """Whether a complete patient with these settings exists."""
    record = kept_record(folder / TRUTH / RECORD, settings=dict(settings))
    return record is not None and (folder / "case.toml").exists()
