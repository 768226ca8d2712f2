"""The benchmark of a folder: own entries are made, all predictions there are scored."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io import replace_text
from cmfsim.io.results.populations import (
    CALIBRATION,
    FAILED,
    PARTS,
    PENDING,
    TEST,
    TRAIN,
    Population,
)
from cmfsim.lab.benchmark.entries import (
    EntryFolder,
    check_own,
    learned_entries,
    patient_entries,
    times_of,
)
from cmfsim.lab.benchmark.entry_names import ENTRIES, LEARNED, ON_REQUEST
from cmfsim.lab.benchmark.patients import (
    BenchmarkPatient,
    far_from_models,
    patients_of,
    read_skin_prediction,
)
from cmfsim.lab.benchmark.scores import BenchmarkTable, MethodResult, calibrated_band, score
from cmfsim.processes.parallel import answers
from cmfsim.values.checks import as_whole, check_one_of
from cmfsim.values.solver_options import MODELS

OWN = (*ENTRIES, *ON_REQUEST)
PREDICTIONS, RESULTS = "predictions", "benchmark"


@dataclass(frozen=True)
class Benchmark:
    """The results of a benchmark, and their files: the same bytes each time, but for run times."""

    table: BenchmarkTable
    files: tuple[Path, ...]


def run_benchmark(
    folder: str | os.PathLike[str],
    *,
    part: str = TEST,
    entries: Sequence[str] = ENTRIES,
    band: Sequence[str] = (),
    band_parts: Sequence[str] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[str], None] | None = None,
) -> Benchmark:
    """The scores of every method that has predictions in a population's folder.

    The package's own entries are predicted first if they do not exist yet. Then each folder of
    `predictions` is scored as a method, whoever made it.

    Parameters
    ----------
    folder : path
        Written by `virtual_population`.
    part : str
        "test"; or "calibration" or "train", which say nothing about a method that learned from
        them.
    entries : sequence of str
        Own entries to predict; may be empty. "hyperelastic" takes longer and must be named.
    band : sequence of str
        Models among them that also provide a standard deviation, for the part `calibration` as
        well. That part determines how many standard deviations cover 90 % of patients, and the
        scored part tests it.
    band_parts : sequence of str, optional
        The parts on which bands are calibrated; default "calibration". Adding "train" gives more
        patients, if no method with a band has learned from it.
    workers : int
        Patients predicted at a time.
    scheduler : str, optional
        Address of a Dask cluster with access to the same folder; it then decides how many run at a
        time.
    progress : callable, optional
        Called with a line of text.

    Raises
    ------
    FileNotFoundError
        The folder has no `population.json`.
    CaseError
        (also `ValueError`) An unknown entry or part; a population that is not complete; a
        prediction of another skin, or that is no prediction: with file, index and value.

    Notes
    -----
    Any method may provide standard deviations; those of the calibration part calibrate its band.
    For models of this package, the calibration is written as `benchmark/calibration_MODEL.json`.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.run_benchmark("insilico", workers=2)  # doctest: +SKIP
    >>> print(found.table.markdown())  # doctest: +SKIP
    """
    if band_parts is None:
        band_parts = [] if part == CALIBRATION else [CALIBRATION]
    for name in (part, *band_parts):
        check_one_of("part", name, PARTS)
    for entry in entries:
        check_one_of("entry", entry, OWN)
    for model in band:
        check_one_of("band", model, [entry for entry in entries if entry in MODELS])
    as_whole("workers", workers, 1)
    place = Path(folder)
    population = Population.load(place)
    pending = population.named(PENDING)
    if pending:
        raise CaseInputError(
            f"{', '.join(pending[:5])}{'…' if len(pending) > 5 else ''}: not yet made; run "
            "cmfsim virtual-patients --count again, so that all methods are scored on the same "
            "patients"
        )
    patients = patients_of(place, population, [part])
    if not patients:
        raise CaseInputError(f"{place}: no patient of the part {part!r} has a truth")
    predictions = place / PREDICTIONS
    if part in band_parts:
        raise CaseInputError(
            f"the part {part!r} would be used both for scoring and for calibrating the bands, "
            "which proves nothing; score another part, or choose other band_parts"
        )
    calibrating = patients_of(place, population, band_parts)
    jobs = _jobs(patients, predictions, entries, band)
    jobs += _jobs(calibrating, predictions, band, band)
    _predict_each(jobs, int(workers), scheduler, progress)
    if LEARNED in entries and part != TRAIN:
        learned_entries(patients_of(place, population, [TRAIN]), patients, predictions)
    methods = _methods(predictions)
    if not methods:
        raise CaseInputError(f"{predictions}: contains no folder of a method (docs/benchmark.md)")
    results = [_result(predictions, method, patients, calibrating) for method in methods]
    table = BenchmarkTable(
        part,
        tuple(patient.name for patient in patients),
        population.named(FAILED, part),
        tuple(results),
        dict(population.settings),
        far_from_models(patients),
    )
    return Benchmark(table, _write(place / RESULTS, table, predictions))


def _jobs(
    patients: Sequence[BenchmarkPatient], folder: Path, entries: Sequence[str], band: Sequence[str]
) -> list[dict[str, Any]]:
    """What a process is to predict of each patient: the entries that need one at a time."""
    alone = [entry for entry in entries if entry != LEARNED]
    if not alone:
        return []
    return [
        {
            "patient": str(patient.folder.absolute()),
            "folder": str(folder.absolute()),
            "methods": alone,
            "banded": list(band),
        }
        for patient in patients
    ]


def _predict_each(
    jobs: Sequence[Mapping[str, Any]],
    workers: int,
    scheduler: str | None,
    progress: Callable[[str], None] | None,
) -> None:
    """Each patient in a process."""
    function = f"{patient_entries.__module__}:{patient_entries.__name__}"
    for done, (index, _) in enumerate(answers(function, jobs, workers, scheduler), 1):
        if progress is not None:
            progress(f"{done} of {len(jobs)}  {Path(jobs[index]['patient']).name} predicted")


def _methods(predictions: Path) -> list[str]:
    """Folders with predictions: own entries in their order, then others by name."""
    if not predictions.is_dir():
        return []
    found = sorted(place.name for place in predictions.iterdir() if place.is_dir())
    return [name for name in OWN if name in found] + [n for n in found if n not in OWN]


def _result(
    folder: Path,
    method: str,
    patients: Sequence[BenchmarkPatient],
    calibrating: Sequence[BenchmarkPatient],
) -> MethodResult:
    """The scores of a method, and the patients for whom it has no prediction."""
    place = EntryFolder(folder)
    band = calibrated_band(method, folder, calibrating)
    factors = band.factors if band is not None else {}
    scores, missing = {}, []
    for patient in patients:
        file = place.file(method, patient.name)
        if not file.exists():
            missing.append(patient.name)
            continue
        try:
            prediction = read_skin_prediction(file)
            check_own(method, prediction, patient)
            scores[patient.name] = score(patient, prediction, factors)
        except CaseInputError as error:
            raise CaseInputError(f"{file}: {error}") from error
    reasons = {name: place.reason(method, name) for name in missing}
    failed = {name: reason for name, reason in reasons.items() if reason is not None}
    return MethodResult(method, scores, tuple(missing), failed, band)


def _write(folder: Path, table: BenchmarkTable, predictions: Path) -> tuple[Path, ...]:
    """Writes the table in three forms, and the run times separately."""
    folder.mkdir(exist_ok=True)
    texts = {
        f"{table.part}.csv": table.csv(),
        f"{table.part}.md": table.markdown(),
        f"{table.part}.json": table.json(),
        f"{table.part}_times.csv": _times(table, predictions),
    }
    for name, text in texts.items():
        replace_text(folder / name, text)
    found = [folder / name for name in texts]
    for result in table.results:
        if result.method in MODELS and result.band is not None:
            found.append(folder / f"calibration_{result.method}.json")
            result.band.write(found[-1], result.method, table.settings)
    return tuple(found)


def _times(table: BenchmarkTable, predictions: Path) -> str:
    """Seconds of each prediction that has them."""
    lines = ["method,patient,seconds"]
    for result in table.results:
        times = times_of(predictions, result.method, table.patients)
        lines += [f"{result.method},{name},{seconds:.3f}" for name, seconds in times.items()]
    return "\n".join([*lines, ""])
