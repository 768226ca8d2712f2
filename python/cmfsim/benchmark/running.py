"""The benchmark of a folder: own entries are made, all predictions there are scored."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cmfsim.benchmark.entries import (
    ENTRIES,
    FAILURE,
    LEARNED,
    EntryFolder,
    learned_entries,
    patient_entries,
    times_of,
)
from cmfsim.benchmark.patients import BenchmarkPatient, patients_of
from cmfsim.benchmark.scores import score
from cmfsim.benchmark.skin_predictions import read_skin_prediction
from cmfsim.benchmark.table import BenchmarkTable, MethodResult
from cmfsim.checks import as_number, check_one_of
from cmfsim.errors import CaseInputError
from cmfsim.io import replacing
from cmfsim.io.parallel import answers
from cmfsim.io.populations import FAILED, PARTS, PENDING, TEST, TRAIN, Population

__all__ = ["Benchmark", "run_benchmark"]

PREDICTIONS, RESULTS = "predictions", "benchmark"


@dataclass(frozen=True)
class Benchmark:
    """What a benchmark found, and the files that say so.

    Attributes
    ----------
    table : BenchmarkTable
    files : tuple of Path
        CSV, Markdown and JSON, the same bytes each time; and the run times.
    """

    table: BenchmarkTable
    files: tuple[Path, ...]


def run_benchmark(
    folder: str | os.PathLike[str],
    *,
    part: str = TEST,
    entries: Sequence[str] = ENTRIES,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> Benchmark:
    """The scores of every method that has predictions in a population's folder.

    The package's own entries are predicted first, where they are not there yet. Then each folder of
    `predictions` is a method, whoever made it.

    Parameters
    ----------
    folder : path
        Written by `virtual_population`.
    part : str
        "test"; or "calibration" or "train", which show nothing about a method that learned there.
    entries : sequence of str
        Own entries to predict; may be empty.
    workers : int
        Patients predicted at a time.
    progress : callable, optional
        Called with a line of text.

    Returns
    -------
    Benchmark

    Raises
    ------
    FileNotFoundError
        The folder has no `population.json`.
    CaseError
        (also `ValueError`) An unknown entry or part; a population that is not complete; a
        prediction of another skin, or that is no prediction: with file, index and value.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.run_benchmark("insilico", workers=2)  # doctest: +SKIP
    >>> print(found.table.markdown())  # doctest: +SKIP
    """
    check_one_of("part", part, PARTS)
    for entry in entries:
        check_one_of("entry", entry, ENTRIES)
    if as_number("workers", workers) < 1 or int(workers) != workers:
        raise CaseInputError(f"workers is {workers!r}: a whole number from 1 is needed")
    place = Path(folder)
    population = Population.load(place)
    pending = population.named(PENDING)
    if pending:
        raise CaseInputError(
            f"{', '.join(pending[:5])}{'…' if len(pending) > 5 else ''}: not made yet; run cmfsim "
            "virtual-patients --count again, so that all methods meet the same patients"
        )
    patients = patients_of(place, population, [part])
    if not patients:
        raise CaseInputError(f"{place}: no patient of the part {part!r} has a truth")
    predictions = place / PREDICTIONS
    _predict_each(patients, predictions, entries, int(workers), progress)
    if LEARNED in entries and part != TRAIN:
        learned_entries(patients_of(place, population, [TRAIN]), patients, predictions)
    methods = _methods(predictions)
    if not methods:
        raise CaseInputError(f"{predictions}: no method has a folder there (docs/benchmark.md)")
    results = [_result(predictions, method, patients) for method in methods]
    table = BenchmarkTable(
        part,
        tuple(patient.name for patient in patients),
        population.named(FAILED, part),
        tuple(results),
        dict(population.settings),
    )
    return Benchmark(table, _write(place / RESULTS, table, predictions))


def _predict_each(
    patients: Sequence[BenchmarkPatient],
    folder: Path,
    entries: Sequence[str],
    workers: int,
    progress: Callable[[str], None] | None,
) -> None:
    """The entries that need one patient at a time, each patient in a process."""
    alone = [entry for entry in entries if entry != LEARNED]
    if not alone:
        return
    jobs = [
        {"patient": str(p.folder.absolute()), "folder": str(folder.absolute()), "methods": alone}
        for p in patients
    ]
    function = f"{patient_entries.__module__}:{patient_entries.__name__}"
    for done, (index, _) in enumerate(answers(function, jobs, workers), 1):
        if progress is not None:
            progress(f"{done} of {len(jobs)}  {patients[index].name} predicted")


def _methods(predictions: Path) -> list[str]:
    """Folders with predictions: own entries in their order, then others by name."""
    if not predictions.is_dir():
        return []
    found = sorted(place.name for place in predictions.iterdir() if place.is_dir())
    return [name for name in ENTRIES if name in found] + [n for n in found if n not in ENTRIES]


def _result(folder: Path, method: str, patients: Sequence[BenchmarkPatient]) -> MethodResult:
    """The scores of a method, and for whom it has no prediction."""
    place = EntryFolder(folder)
    scores, missing = {}, []
    for patient in patients:
        file = place.file(method, patient.name)
        if not file.exists():
            missing.append(patient.name)
            continue
        try:
            prediction = read_skin_prediction(file)
            if method in ENTRIES:
                _check_own(method, prediction.made_from, patient)
            scores[patient.name] = score(patient, prediction)
        except CaseInputError as error:
            raise CaseInputError(f"{file}: {error}") from error
    failed = [name for name in missing if place.file(method, name, FAILURE).exists()]
    return MethodResult(method, scores, tuple(missing), tuple(failed))


def _check_own(method: str, made_from: str, patient: BenchmarkPatient) -> None:
    """Refuses an own entry of another version, or of a patient who was made again."""
    if not made_from.endswith(patient.digest()):
        raise CaseInputError(
            "was not made by this version from the patient as they are: predict it again "
            f"(--entries {method}), or give a method of your own another name"
        )


def _write(folder: Path, table: BenchmarkTable, predictions: Path) -> tuple[Path, ...]:
    """Writes the table in three forms, and the run times apart from it."""
    folder.mkdir(exist_ok=True)
    texts = {
        f"{table.part}.csv": table.csv(),
        f"{table.part}.md": table.markdown(),
        f"{table.part}.json": table.json(),
        f"{table.part}_times.csv": _times(table, predictions),
    }
    for name, text in texts.items():
        with replacing(folder / name) as file:
            file.write(text.encode())
    return tuple(folder / name for name in texts)


def _times(table: BenchmarkTable, predictions: Path) -> str:
    """Seconds of each prediction that has them."""
    lines = ["method,patient,seconds"]
    for result in table.results:
        times = times_of(predictions, result.method, table.patients)
        lines += [f"{result.method},{name},{seconds:.3f}" for name, seconds in times.items()]
    return "\n".join([*lines, ""])
