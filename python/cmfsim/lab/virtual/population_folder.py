"""A population of drawn patients on disk, made by several processes and resumed where it ended."""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io import replace_text
from cmfsim.io.files.summaries import kept_record, write_record
from cmfsim.io.results.populations import (
    FAILED,
    MADE,
    PARTS,
    PENDING,
    Population,
    PopulationEntry,
    part_of,
)
from cmfsim.lab.virtual.patient_folder import (
    EXECUTED,
    TRUTH,
    cohort_text,
    is_made,
    patient_settings,
    write_virtual_patient,
)
from cmfsim.lab.virtual.population import OWN, VirtualPatient, drawn_patient
from cmfsim.processes.parallel import answers
from cmfsim.values.checks import as_positive, as_whole

FAILURE = "failed.json"
# Of the level images that the true mesh is made from, and of the skin, in the mesh's edge length:
# 1.5 mm and 2.25 mm at 6 mm.
GRID, SKIN_SPACING = 0.25, 0.375


@dataclass(frozen=True)
class PatientOutcome:
    """The outcome of a patient, why it failed, and the number of finished patients.

    status: "made", "kept" (there from an earlier run, of the same settings) or "failed".
    """

    name: str
    status: str
    reason: str
    done: int
    count: int


@dataclass(frozen=True)
class _Job:
    """One patient to make, as it is sent to a process."""

    folder: str
    seed: int
    index: int
    edge_length: float
    spacing: float
    truth: str = OWN

    @property
    def patient(self) -> VirtualPatient:
        return drawn_patient(self.seed, self.index, truth=self.truth)

    @property
    def settings(self) -> dict[str, Any]:
        return patient_settings(self.patient, self.seed, self.edge_length, self.spacing)


def virtual_population(  # noqa: PLR0913 (options by name)
    folder: str | os.PathLike[str],
    count: int,
    *,
    seed: int = 0,
    edge_length: float = 6.0,
    spacing: float = 2.0,
    truth: str = OWN,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[PatientOutcome], None] | None = None,
) -> Population:
    """Virtual patients D001 to D`count`, drawn at random, each in a folder with the truth.

    A patient whose truth cannot be computed is recorded with the reason, and neither left out nor
    drawn again. A run that was interrupted resumes where it ended. The same arguments give the same
    files to the last byte for any number of workers; only `truth/times.json` differs.

    Parameters
    ----------
    folder : path
    count : int
        1 or more. A larger count later adds patients, and changes none.
    seed : int
        Draws the patients and all noise.
    edge_length : float, mm
        Of the true meshes.
    spacing : float, mm
        Of the CTs.
    truth : str
        "own" or "phantom": how the true tissue is made, see `drawn_patient`.
    workers : int
        Patients at a time, each in its own process with one thread.
    scheduler : str, optional
        Address of a Dask cluster with access to the same folder; it then decides how many run at a
        time.
    progress : callable, optional
        Called with the outcome of each patient.

    Returns
    -------
    Population
        As `population.json` has it.

    Raises
    ------
    CaseError
        (also `ValueError`) An invalid count, seed, number of workers or length; a folder that
        contains a population of another seed, truth or resolution; a worker that died; a missing
        package of the extra "study".
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.virtual_population("insilico", 20, seed=1)  # doctest: +SKIP
    """
    count, seed = as_whole("count", count, 1), as_whole("seed", seed, 0)
    workers = as_whole("workers", workers, 1)
    edge, voxel = as_positive("edge_length", edge_length), as_positive("spacing", spacing)
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    numbers = range(1, int(count) + 1)
    jobs = [_Job(str(place), int(seed), i, edge, voxel, truth) for i in numbers]
    record = {"seed": int(seed), "truth": truth, "edge_length_mm": edge, "ct_spacing_mm": voxel}
    entries = {job.patient.name: _entry(job, PENDING) for job in jobs}
    entries |= _further(place, record, entries)
    _write(place, record, entries)
    for done, (job, status, reason) in enumerate(_made(jobs, int(workers), scheduler), 1):
        name = job.patient.name
        entries[name] = _entry(job, FAILED if reason else MADE, reason)
        _write(place, record, entries)
        if progress is not None:
            progress(PatientOutcome(name, status, reason, done, len(jobs)))
    return Population(entries, record)


def _entry(job: _Job, state: str, reason: str = "") -> PopulationEntry:
    return PopulationEntry(state, part_of(job.index), job.patient.label, reason)


def _further(
    folder: Path, record: dict[str, Any], wanted: dict[str, PopulationEntry]
) -> dict[str, PopulationEntry]:
    """Patients of an earlier, larger run, who stay in the population."""
    try:
        earlier = Population.load(folder)
    except FileNotFoundError:
        return {}
    if earlier.settings != record:
        raise CaseInputError(
            f"{folder} contains a population with {dict(earlier.settings)}, not {record}: use "
            "another folder, or the same values"
        )
    return {name: entry for name, entry in earlier.patients.items() if name not in wanted}


def _write(folder: Path, record: dict[str, Any], entries: dict[str, PopulationEntry]) -> None:
    """The population's file, and cohorts for `cmfsim study`: of each part, and as carried out."""
    population = Population(entries, record)
    population.write(folder)
    for part in PARTS:
        names = population.named(MADE, part)
        if names:
            replace_text(folder / f"{part}.toml", cohort_text(f"virtual patients, {part}", names))
    everyone = population.named(MADE)
    if everyone:
        text = cohort_text("virtual patients, plans as carried out", everyone, executed=True)
        replace_text(folder / EXECUTED, text)


def _made(jobs: list[_Job], workers: int, scheduler: str | None) -> Iterator[tuple[_Job, str, str]]:
    """Each job with its status, as they end, and the reason where it failed."""
    function = f"{__name__}:{make_patient.__name__}"
    asked = [asdict(job) for job in jobs]
    for index, (status, reason) in answers(function, asked, workers, scheduler):
        yield jobs[index], status, reason


def make_patient(**values: Any) -> tuple[str, str]:
    """Makes the patient of a job: "made", "kept" or "failed", and why it failed."""
    job = _Job(**values)
    place, patient, settings = Path(job.folder) / job.patient.name, job.patient, job.settings
    failure = place / FAILURE
    if is_made(place, settings):
        return "kept", ""
    earlier = kept_record(failure, settings=settings)
    if earlier is not None:
        return "failed", str(earlier["reason"])
    failure.unlink(missing_ok=True)
    shutil.rmtree(place / TRUTH, ignore_errors=True)
    try:
        write_virtual_patient(
            place,
            patient,
            seed=job.seed,
            edge_length=job.edge_length,
            spacing=job.spacing,
            grid=GRID * job.edge_length,
            skin_spacing=SKIN_SPACING * job.edge_length,
        )
    except (CmfsimError, np.linalg.LinAlgError) as error:
        # The computer lacks a package: no patient failed, and once it is installed, none is to.
        if isinstance(error.__cause__, ImportError):
            raise
        write_record(failure, {"settings": settings, "reason": str(error)})
        return "failed", str(error)
    return "made", ""
