"""Feeds damaged files to every reader: python fuzz/readers.py --mutants 10000 --seed 0.

Each mutant of a small valid file must be read according to the rules of its format, or be refused
with a specific error, within ten seconds. Readers run in a separate process, so that a crash is
counted and the run continues. Exit code 1 if anything is wrong; the files that fail are kept.
"""

import argparse
import contextlib
import multiprocessing as mp
import os
import platform
import random
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import cmfsim
from mutations import mutated, mutated_inside
from reader_table import READERS, Reader, changed_in_silence, plain

# What may come of a mutant: the first three are as it should be.
SOUND = ("same", "other", "refused")
FAULTS = ("silent", "traceback", "hang", "crash")
# Wall time of one mutant, s; one that takes longer is tried once more, for the machine may be busy.
LONGEST = 10.0
# Memory that a process may take, bytes: a file of some kB needs a thousandth of it.
MEMORY = 8 * 2**30
# Between these marks of a page stands the table.
BEGIN, END = "<!-- readers: begin -->", "<!-- readers: end -->"
# Files at fault that are kept of one reader, and the characters of a text that is shown.
MOST_KEPT, SHOWN = 20, 400


@dataclass
class Tally:
    """What came of the mutants of one reader."""

    name: str
    counts: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    seconds: float = 0.0
    slowest: float = 0.0

    @property
    def is_sound(self) -> bool:
        """Whether no mutant went wrong."""
        return not any(self.counts[fault] for fault in FAULTS)


@dataclass(frozen=True)
class _Seed:
    """A valid file in its folder, and what it is read as."""

    path: Path
    data: bytes
    result: object


def run(
    readers: Iterable[Reader],
    mutants: int,
    seed: int,
    keep: Path,
    report: Callable[[Tally], None] = lambda _: None,
) -> list[Tally]:
    """What came of the mutants of each reader; files at fault are in `keep`.

    Raises
    ------
    RuntimeError
        A seed cannot be read.
    """
    tallies = []
    with tempfile.TemporaryDirectory(prefix="cmfsim-fuzz-") as folder:
        worker = _Worker(Path(folder))
        try:
            for reader in readers:
                tallies.append(_one_reader(worker, reader, mutants, seed, keep))
                report(tallies[-1])
        finally:
            worker.end()
    return tallies


def _one_reader(worker: "_Worker", reader: Reader, mutants: int, seed: int, keep: Path) -> Tally:
    tally = Tally(reader.name)
    begun = time.monotonic()
    at, retried = 0, -1
    while at < mutants:
        worker.ask((reader.name, seed, at, mutants))
        for number, outcome, text, seconds in worker.answers():
            at = number + 1
            if outcome in {"hang", "crash"} and retried != number:
                # Once more, alone: what is counted can be done again.
                retried, at = number, number
                break
            tally.counts[outcome] += 1
            tally.slowest = max(tally.slowest, seconds)
            if outcome in FAULTS:
                _keep(tally, reader, seed, number, f"{outcome}: {text}", keep)
            if outcome in {"hang", "crash"}:
                break
        else:
            break
    tally.seconds = time.monotonic() - begun
    return tally


def _keep(tally: Tally, reader: Reader, seed: int, number: int, text: str, keep: Path) -> None:
    tally.faults.append(f"{reader.name} mutant {number} (seed {seed}): {text}")
    if len(tally.faults) > MOST_KEPT:
        return
    plain_name = "".join(c if c.isalnum() else "-" for c in reader.name)
    folder = keep / f"{plain_name}-{seed}-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix="cmfsim-fuzz-") as scratch:
        seeds = _seeds(reader, Path(scratch), read=False)
        chosen, data = _mutant(reader, seeds, seed, number)
        chosen.path.write_bytes(data)
        top = chosen.path.parents[len(Path(reader.target).parts) - 1]
        shutil.copytree(top, folder)
    (folder / "fault.txt").write_text(text + "\n", encoding="utf-8")


class _Worker:
    """The process in which readers run, replaced when it crashes or hangs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process: mp.process.BaseProcess | None = None
        self.pipe: Connection | None = None

    def ask(self, task: tuple[str, int, int, int]) -> None:
        """Begins with the mutants of a reader from one on."""
        if self.process is None:
            context = mp.get_context("spawn")
            self.pipe, other = context.Pipe()
            self.process = context.Process(target=_serve, args=(other, str(self.folder)))
            self.process.start()
            other.close()
        assert self.pipe is not None
        self.pipe.send(task)

    def answers(self) -> Iterable[tuple[int, str, str, float]]:
        """Number, outcome, text and seconds of each mutant, until the last, a crash or a hang."""
        pipe, process = self.pipe, self.process
        assert pipe is not None
        assert process is not None
        number = -1
        while True:
            # Seeds may take a while to make; a mutant may not.
            used = None
            while not (answered := pipe.poll(LONGEST if number >= 0 else 600.0)):
                # On a busy machine it may have had no turn.
                used = _used_by(process.pid) if used is None else used
                if not _waits_for_its_turn(process.pid) or _used_by(process.pid) - used > LONGEST:
                    break
            if not answered:
                self.end()
                yield number, "hang", f"no end after {LONGEST:g} s", LONGEST
                return
            try:
                message = pipe.recv()
            except (EOFError, ConnectionResetError):
                process.join()
                code = process.exitcode
                self.end()
                if number < 0:
                    message = f"the worker ended with exit code {code} before the first mutant"
                    raise RuntimeError(message) from None
                yield number, "crash", f"exit code {code}", 0.0
                return
            if message is None:
                return
            if isinstance(message, str):
                raise RuntimeError(message)  # noqa: TRY004 (the worker's own words)
            if isinstance(message, int):
                number = message
            else:
                yield (number, *message)

    def end(self) -> None:
        """Stops the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
        if self.pipe is not None:
            self.pipe.close()
        self.process = self.pipe = None


def _stat_of(pid: int | None) -> list[tuple[str, float]]:
    """State and processor time, s, of a process and its children; nothing where unknown."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            words = path.read_text(encoding="latin-1").rpartition(")")[2].split()
            if pid in {int(path.parent.name), int(words[1])}:
                ticks = int(words[11]) + int(words[12])
                found.append((words[0], ticks / os.sysconf("SC_CLK_TCK")))
    return found


def _waits_for_its_turn(pid: int | None) -> bool:
    return any(state == "R" for state, _ in _stat_of(pid))


def _used_by(pid: int | None) -> float:
    return sum(seconds for _, seconds in _stat_of(pid))


def _serve(pipe: Connection, folder: str) -> None:
    """Nothing; runs mutants until the parent goes. The worker's main function."""
    warnings.simplefilter("ignore")
    # What libraries print of each mutant is of no use.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    with contextlib.suppress(ImportError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    by_name = {reader.name: reader for reader in READERS}
    ready: dict[str, list[_Seed]] = {}
    with contextlib.suppress(EOFError):
        while True:
            name, seed, start, stop = pipe.recv()
            reader = by_name[name]
            if name not in ready:
                try:
                    plain_name = "".join(c if c.isalnum() else "-" for c in name)
                    place = Path(folder) / f"{plain_name}-{time.monotonic_ns()}"
                    ready = {name: _seeds(reader, place)}
                except Exception:  # noqa: BLE001 (told to the parent)
                    pipe.send(f"{name}: no seed\n{traceback.format_exc()}")
                    return
            for number in range(start, stop):
                pipe.send(number)
                begun = time.perf_counter()
                outcome, text = _outcome(reader, ready[name], seed, number)
                pipe.send((outcome, text, time.perf_counter() - begun))
            pipe.send(None)


def _seeds(reader: Reader, folder: Path, *, read: bool = True) -> list[_Seed]:
    seeds: list[_Seed] = []
    while True:
        place = folder / str(len(seeds))
        place.mkdir(parents=True)
        if not reader.make(place, len(seeds)):
            return seeds
        path = place / reader.target
        result = None
        if read:
            # A format that this version does not read is refused: so must all its mutants be.
            with contextlib.suppress(*((cmfsim.CmfsimError,) if reader.optional else ())):
                result = reader.read(path)
        if result is not None and (fault := changed_in_silence(reader, path.read_bytes(), result)):
            message = f"{reader.name}: its seed is not sound: {fault}"
            raise RuntimeError(message)
        seeds.append(_Seed(path, path.read_bytes(), plain(result)))


def _mutant(reader: Reader, seeds: Sequence[_Seed], seed: int, number: int) -> tuple[_Seed, bytes]:
    dice = random.Random(f"{seed}/{reader.name}/{number}")  # noqa: S311 (to be reproducible)
    chosen = seeds[number % len(seeds)]
    inside = reader.inside and dice.random() < 0.5
    return chosen, (mutated_inside if inside else mutated)(chosen.data, dice)


def _outcome(reader: Reader, seeds: Sequence[_Seed], seed: int, number: int) -> tuple[str, str]:
    chosen, data = _mutant(reader, seeds, seed, number)
    chosen.path.write_bytes(data)
    try:
        result = reader.read(chosen.path)
        found = plain(result)
    except Exception as error:  # noqa: BLE001 (that is what is looked for)
        named = isinstance(error, cmfsim.CmfsimError) and isinstance(error, ValueError)
        if named or isinstance(error, FileNotFoundError):
            return "refused", ""
        return "traceback", "".join(traceback.format_exception(error))[-4000:]
    fault = changed_in_silence(reader, data, result)
    if fault is not None:
        return "silent", fault
    if found == chosen.result:
        return "same", ""
    if reader.sealed and data != chosen.data and not _was_packed_again(reader, seed, number):
        return "silent", "its checksums hold, and it was read as something else"
    return "other", ""


def _was_packed_again(reader: Reader, seed: int, number: int) -> bool:
    dice = random.Random(f"{seed}/{reader.name}/{number}")  # noqa: S311
    return reader.inside and dice.random() < 0.5


def markdown(tallies: Sequence[Tally], mutants: int, seed: int) -> str:
    """The result as a table of Markdown."""
    system = f"Python {platform.python_version()}, {platform.machine()} {platform.system()}"
    heads = ("reader", "refused", "read, the same", "read, another", *FAULTS, "slowest, s")
    lines = [
        f"{mutants} mutants of each reader, seed {seed}; cmfsim {cmfsim.__version__}, {system}.",
        "",
        f"| {' | '.join(heads)} |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for tally in tallies:
        counts = (tally.counts[key] for key in ("refused", "same", "other", *FAULTS))
        lines.append(f"| {tally.name} | {' | '.join(map(str, counts))} | {tally.slowest:.2f} |")
    total: Counter[str] = sum((tally.counts for tally in tallies), Counter())
    counts = (total[key] for key in ("refused", "same", "other", *FAULTS))
    slowest = max((tally.slowest for tally in tallies), default=0.0)
    lines.append(f"| **{len(tallies)} readers** | {' | '.join(map(str, counts))} | {slowest:.2f} |")
    return "\n".join(lines) + "\n"


def main(words: Sequence[str] | None = None) -> int:
    """The exit code: 1 if a mutant went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", action="append", help="a name, or the beginning of one")
    parser.add_argument("--fast", action="store_true", help="without those whose seed takes long")
    parser.add_argument("--keep", type=Path, default=Path("target/fuzz"), help="for files at fault")
    parser.add_argument("--markdown", type=Path, help="write the table here")
    parser.add_argument("--fill", type=Path, help="put the table between the marks of this page")
    parser.add_argument("--list", action="store_true", help="print the readers")
    options = parser.parse_args(words)
    chosen = [
        reader
        for reader in READERS
        if not (options.fast and reader.slow)
        and (
            not options.reader
            or any(reader.name.lower().startswith(name.lower()) for name in options.reader)
        )
    ]
    if options.list or not chosen:
        print("\n".join(reader.name for reader in READERS))
        return 0 if options.list else 2

    def report(tally: Tally) -> None:
        counts = ", ".join(f"{n} {outcome}" for outcome, n in sorted(tally.counts.items()))
        print(f"{tally.name}: {counts} ({tally.seconds:.0f} s)", flush=True)
        for fault in tally.faults[:5]:
            print(f"  {fault[:SHOWN]} …{fault[-SHOWN:]}" if len(fault) > SHOWN else f"  {fault}")
        if len(tally.faults) > 5:
            print(f"  … and {len(tally.faults) - 5} more")

    tallies = run(chosen, options.mutants, options.seed, options.keep, report)
    table = markdown(tallies, options.mutants, options.seed)
    if options.fill:
        page = options.fill.read_text(encoding="utf-8")
        head, rest = page.split(BEGIN)
        options.fill.write_text(
            f"{head}{BEGIN}\n{table}{END}{rest.split(END)[1]}", encoding="utf-8"
        )
    if options.markdown:
        options.markdown.write_text(table, encoding="utf-8")
    print(table)
    return 0 if all(tally.is_sound for tally in tallies) else 1


if __name__ == "__main__":
    sys.exit(main())
