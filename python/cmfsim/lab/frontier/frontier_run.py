"""Error against run time: the sweep, run job by job in a folder that remembers what is done."""

import hashlib
import json
import logging
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from cmfsim import _core
from cmfsim.errors import CaseInputError, SolverError
from cmfsim.io import Case
from cmfsim.io.files.archives import member_of, read_archive
from cmfsim.io.files.summaries import kept_record
from cmfsim.lab.frontier.choice import Choice, case_choice, reference_choice, sweep_choices
from cmfsim.lab.frontier.rows import (
    WHOLE,
    Frontier,
    FrontierRow,
    Spread,
    read_points,
    skin_errors,
    with_front,
)
from cmfsim.lab.frontier.timing import MOVED_FORMAT, STOPPED, Answer, machine, run_job
from cmfsim.pipeline.building.inputs import input_hashes
from cmfsim.values.checks import Floats, as_positive, as_whole
from cmfsim.values.progress import Progress, no_progress

_log = logging.getLogger(__name__)

# A solve that takes longer than this is timed once, s: repeats tell short ones apart.
LONG = 60.0
# Time that the reference may take, in that of any other choice.
REFERENCE_PATIENCE = 10.0


def frontier(  # noqa: PLR0913 (options by name)
    case: Case,
    folder: str | os.PathLike[str],
    choices: Iterable[Choice] | None = None,
    *,
    reference: Choice | None = None,
    repeats: int = 3,
    threads: int | None = None,
    time_limit: float = 600.0,
    fresh: bool = False,
    progress: Progress | None = None,
) -> Frontier:
    """Error on the skin against run time of many ways to predict one face.

    Every build and every solve is a separate process; choices that share a model share its build.
    Solves are repeated in rounds (A B C, A B C), so that a disturbance of the machine affects all
    of them alike. A choice that is refused or fails is a row with its error.

    Parameters
    ----------
    case : Case
    folder : path
        Keeps models and finished runs, so that an interrupted sweep continues, and a wider sweep
        runs only what is new.
    choices : iterable of Choice, optional
        The first is the base; default `sweep_choices(case_choice(case))`.
    reference : Choice, optional
        The choice with which all are compared; default: quadratic hyperelastic tets of the smallest
        edge length of the choices, with many samples.
    repeats : int
        Rounds of timing. A solve of more than a minute is timed once.
    threads : int, optional
        Of each process; default: all cores.
    time_limit : float, s
        For one build or solve; ten times as long for the reference. A choice that is stopped is not
        tried on smaller tets.
    fresh : bool
        Whether finished runs are repeated.
    progress : callable, optional
        Called with the name of each job as it begins.

    Raises
    ------
    CaseError
        (also `ValueError`) No choice, less than one round or thread, no time.
    SolverError
        The reference was not built or solved, so there is nothing to compare with.
    OSError
        The folder cannot be written to.

    Notes
    -----
    Error: |u - u_ref| at vertices of the detailed face of the patient, the same for every choice,
    carried by each prediction as its mesh's skin moves. It includes the effects of mesh, element,
    kinematics and sampling, but not those of the tissue laws or the plan.

    Examples
    --------
    >>> import cmfsim
    >>> case = cmfsim.Case.load("case.toml")  # doctest: +SKIP
    >>> found = cmfsim.frontier(case, "frontier", repeats=1)  # doctest: +SKIP
    >>> found.base.mean, [row.choice.element for row in found.front]  # doctest: +SKIP
    """
    base, choices, reference = _meant(case, choices, reference)
    as_whole("repeats", repeats, 1)
    as_whole("threads", 1 if threads is None else threads, 1)
    jobs = _Jobs(
        case=case,
        folder=Path(folder),
        of=content_key(case, threads),
        threads=threads,
        time_limit=as_positive("time_limit", time_limit),
        fresh=fresh,
        say=progress or no_progress,
    )
    everyone = [reference, *choices]
    jobs.time_limit *= REFERENCE_PATIENCE
    jobs.build(reference, everyone)
    first = jobs.solve(reference, 0)
    jobs.time_limit /= REFERENCE_PATIENCE
    if "error" in first:
        raise SolverError(
            f"the reference ({_label(reference, base)}) failed, so nothing can be compared with "
            f"it: {first['error']}; fix that, or give another reference"
        )
    for number in range(repeats):
        for choice in choices:
            if number == 0:
                if jobs.is_hopeless(choice):
                    continue
                jobs.build(choice, everyone)
            elif jobs.answers[choice][0].get("wall_s", np.inf) > LONG:
                continue
            jobs.solve(choice, number)
    return _frontier(case, base, choices, reference, jobs)


def _meant(
    case: Case, choices: Iterable[Choice] | None, reference: Choice | None
) -> tuple[Choice, list[Choice], Choice]:
    """The base, all choices but the reference, and the reference."""
    wanted = sweep_choices(case_choice(case)) if choices is None else [*dict.fromkeys(choices)]
    if not wanted:
        raise CaseInputError("no choice is given: at least one is needed")
    if reference is None:
        reference = reference_choice(wanted[0], min(choice.edge_length for choice in wanted))
    return wanted[0], [c for c in wanted if c != reference], reference


@dataclass
class _Jobs:
    """What has been built and solved, here or by an earlier run."""

    case: Case
    folder: Path
    of: str
    threads: int | None
    time_limit: float
    fresh: bool
    say: Progress
    # Times of one run are of one state of the machine: only these are compared.
    run: str = field(default_factory=lambda: f"{time.time():.0f}-{os.getpid()}")
    builds: dict[str, Answer] = field(default_factory=dict)
    answers: dict[Choice, list[Answer]] = field(default_factory=dict)

    @property
    def points(self) -> Path:
        """The points of the skin, of this content of the case."""
        return self.folder / f"points-{self.of}.npz"

    def moved(self, choice: Choice) -> Path:
        """How the points move by a choice."""
        return self.folder / "runs" / f"{choice.key(self.of)}.npz"

    def build(self, choice: Choice, everyone: Sequence[Choice]) -> None:
        """Builds the model of a choice with the scenes of all who share it."""
        key = choice.build_key(self.of)
        if key in self.builds:
            return
        folder = self.folder / "models" / key
        models = sorted({c.model for c in everyone if c.build_key(self.of) == key})
        made = [folder / name for name in (*(f"{model}.npz" for model in models), "skin.npz")]
        sampling = f"{choice.samples} samples, {choice.mixing}"
        muscles = sampling if choice.model.startswith("M") else "no muscles"
        self.builds[key] = self._answer(
            f"building at {choice.edge_length:g} mm, {muscles}",
            folder / "build.json",
            [self.points, *made],
            {
                "task": "build",
                "case": str(self.case.file),
                "choice": asdict(choice),
                "models": models,
                "folder": str(folder),
                "points": None if self.points.exists() else str(self.points),
            },
        )

    def _answer(self, doing: str, file: Path, made: Sequence[Path], job: Answer) -> Answer:
        """The answer that an earlier run left, with all that it made, or that of the job."""
        answer = None if self.fresh else kept_record(file)
        if answer is None or ("error" not in answer and not all(path.exists() for path in made)):
            self.say(doing)
            job = {**job, "answer": str(file)}
            answer = run_job(job, threads=self.threads, time_limit=self.time_limit)
        return answer

    def is_hopeless(self, choice: Choice) -> bool:
        """Whether the same on larger tets was stopped; it is then answered so, and not run."""
        for other, answers in self.answers.items():
            coarser = other.edge_length > choice.edge_length
            alike = coarser and replace(other, edge_length=choice.edge_length) == choice
            if alike and "error" in answers[0] and STOPPED in answers[0]["error"]:
                why = f"not run: at {other.edge_length:g} mm it was {answers[0]['error']}"
                self.answers[choice] = [{"error": why}]
                return True
        return False

    def solve(self, choice: Choice, number: int) -> Answer:
        """Solves a choice for the round of this number."""
        built = self.builds[choice.build_key(self.of)]
        answers = self.answers.setdefault(choice, [])
        if "error" in built:
            answers.append({"error": f"building: {built['error']}"})
            return answers[-1]
        answer = self._answer(
            f"round {number + 1}: solving {_label(choice)}",
            self.folder / "runs" / f"{choice.key(self.of)}-{number}.json",
            [self.moved(choice)],
            {
                "task": "solve",
                "choice": asdict(choice),
                "folder": str(self.folder / "models" / choice.build_key(self.of)),
                "points": str(self.points),
                "moved": str(self.moved(choice)),
                "run": self.run,
            },
        )
        if "error" in answer:
            _log.warning("%s: %s", _label(choice), answer["error"])
        answers.append(answer)
        return answer


def _frontier(
    case: Case, base: Choice, choices: Sequence[Choice], reference: Choice, jobs: _Jobs
) -> Frontier:
    """The rows of what was built and solved."""
    regions = read_points(jobs.points)[1]
    exact = _moved(jobs, reference)
    paces = jobs.answers.get(base, [])
    rows = []
    for choice in [*choices, reference]:
        answers = jobs.answers[choice]
        # None was made for a choice that was not run.
        built = jobs.builds.get(choice.build_key(jobs.of), {})
        row = _row(choice, built, answers, paces)
        if not row.failure:
            row = replace(row, error=skin_errors(_moved(jobs, choice), exact, regions))
        rows.append(replace(row, is_base=choice == base, is_reference=choice == reference))
    return Frontier(
        case=case.name,
        rows=with_front(rows),
        n_points=len(exact),
        moved=float(np.linalg.norm(exact[regions[WHOLE]], axis=1).mean()),
        machine=machine(jobs.threads),
    )


def _row(
    choice: Choice, built: Answer, answers: Sequence[Answer], paces: Sequence[Answer]
) -> FrontierRow:
    failures = [answer["error"] for answer in answers if "error" in answer]
    row = FrontierRow(
        choice,
        build_wall=built.get("wall_s"),
        build_cpu=built.get("cpu_s"),
        build_peak=built.get("peak_mb"),
        n_tets=built.get("n_tets"),
    )
    if failures:
        return replace(row, failure=failures[0])
    walls = [answer["wall_s"] for answer in answers]
    # Rounds in which the base was timed too, in the same run.
    ratios = [
        answer["wall_s"] / pace["wall_s"]
        for answer, pace in zip(answers, paces, strict=False)
        if "wall_s" in pace and answer.get("run") == pace.get("run")
    ]
    solution = answers[0]["solution"]
    return replace(
        row,
        solve_wall=Spread.of(walls),
        solve_cpu=Spread.of([answer["cpu_s"] for answer in answers]),
        ratio=Spread.of(ratios) if ratios else None,
        solve_peak=answers[0]["peak_mb"],
        n_unknowns=solution["n_unknowns"],
        details={"build_stages_s": built["stages_s"], "solution": solution},
    )


def _moved(jobs: _Jobs, choice: Choice) -> Floats:
    _, arrays = read_archive(jobs.moved(choice), MOVED_FORMAT, "moved")
    return np.asarray(member_of(arrays, "displacements"), dtype=np.float64)


def content_key(case: Case, threads: int | None) -> str:
    """What a finished run depends on beside its choice: inputs, plan, core, machine, threads."""
    core = Path(str(_core.__file__))
    content = {
        "inputs": input_hashes(case),
        "core": hashlib.sha256(core.read_bytes()).hexdigest(),
        "machine": machine(threads)["processor"],
        "threads": threads,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _label(choice: Choice, base: Choice | None = None) -> str:
    """A choice in a few words: edge, element, kinematics, and what else is unusual."""
    usual = base or Choice()
    main = ("edge_length", "element", "kinematics")
    rest = [f"{n} {v}" for n, v in choice.changes(usual).items() if n not in main]
    first = f"{choice.model} {choice.element} {choice.kinematics} at {choice.edge_length:g} mm"
    return ", ".join([first, *(part for part in rest if not part.startswith("model "))])
