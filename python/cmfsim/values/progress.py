"""Progress of long work: callbacks with each stage and the share that is done, and observers."""

import contextlib
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

from cmfsim.errors import CmfsimError, third_party
from cmfsim.values.finding import Finding

if TYPE_CHECKING:
    # A case without muscles loads nothing of them.
    from cmfsim.values.anatomy import BoneSegment
    from cmfsim.values.musculature import Musculature
    from cmfsim.values.patient_model import PatientModel
Progress = Callable[[str], None]
# What public functions take: True shows a bar.
ProgressOrBar = Progress | bool | None
# A stage of equal steps names the one that begins: "solving nearby plans (3 of 96)".
COUNT = re.compile(r" \(?(\d+) of (\d+)\)?$")
# Typical seconds of the longer stages of a build, in order: the CT phantom and the demo on one
# thread (timings.json). Once some stages have passed, only ratios count.
BUILDING: Mapping[str, float] = MappingProxyType({
    "reading the face after the operation": 2.0, "checking the case": 5.0,
    "reading the image": 2.0, "segmenting the head": 25.0, "reading surface": 2.0,
    "measuring distances from the surfaces": 7.0, "finding the landmarks": 8.0,
    "cutting the bones": 3.0, "finding the soft tissue": 1.5, "filling the tissue with tets": 2.0,
    "classifying nodes": 4.0, "placing and sampling the muscles": 5.0,
})  # fmt: skip
# The same of the planning page, for its usual options.
PLANNING: Mapping[str, float] = MappingProxyType({
    "computing the plan operator": 20.0, "solving the case's plan": 3.0,
    "solving nearby plans to correct the operator": 20.0, "solving a nearby plan exactly": 8.0,
    "making the page": 4.0,
})  # fmt: skip
# Of a solution by one model, of comparing faces, and of writing one result.
AFTER = 4.0
# How long the typical seconds weigh against those that this machine takes, s.
PRIOR = 5.0
# After so many steps of a stage, their time weighs as much as the typical one: some come at once.
FEW_STEPS = 3
# The least that is left of a stage, as a share of the time it has taken: it may take any time.
LEAST_LEFT = 0.1


class Observer:
    """What learns of the work on a case as it goes on: override the methods that you need.

    Examples
    --------
    >>> import cmfsim
    >>> stages = []
    >>> class Log(cmfsim.Observer):
    ...     def stage(self, name):
    ...         stages.append(name)
    >>> prediction = cmfsim.predict("case.toml", model="H", observer=Log())
    >>> stages[0]
    'checking the case'
    """

    def stage(self, name: str) -> None:
        """A stage begins."""

    def found(self, findings: Sequence[Finding]) -> None:
        """Findings of a stage or a solution; some may have been reported before."""

    def muscles(self, muscles: "Musculature", segments: "Sequence[BoneSegment]") -> None:
        """Muscles and segments of bone are known: before a model is solved, perhaps repeatedly."""

    def built(self, patient: "PatientModel") -> None:
        """The patient is built: models are solved next."""

    def failed(self, model: str, error: CmfsimError) -> None:
        """A model cannot be solved: the other models continue unless this raises the error."""
        del model
        raise error


def no_progress(stage: str) -> None:
    """Reports nothing: the default that stages call if no progress is requested."""
    del stage


def expected_stages(*after: str) -> dict[str, float]:
    """The stages of a build and those after it, with their typical seconds."""
    return {**BUILDING, **dict.fromkeys(after, AFTER)}


class TimeLeft:
    """The time that a work of known stages still takes, estimated as its stages begin.

    `expected`: Typical seconds of the stages, in order; those that do not occur are skipped.
    """

    def __init__(self, expected: Mapping[str, float]) -> None:
        self._expected, self._left = expected, dict(expected)
        self._stage, self._typical, self._passed = "", 0.0, 0.0
        self._begun = self._since = time.perf_counter()
        self._done, self._whole = 0, 0.0

    def begin(self, name: str) -> None:
        """Goes on to a stage, or to another step of it."""
        plain, now = COUNT.sub("", name), time.perf_counter()
        # Without what is counted or read in it.
        stage = next((known for known in BUILDING if plain.startswith(known)), plain)
        if stage != self._stage:
            self._passed += self._typical
            # A second for what nobody expected.
            self._stage, self._typical = stage, self._left.get(stage, 1.0)
            self._since, self._done = now, 0
            names = [*self._left]
            for passed in names[: names.index(stage) + 1] if stage in self._left else ():
                del self._left[passed]
        if (count := COUNT.search(name)) and int(count[1]) > 1:
            # The steps behind show how long the whole stage takes.
            self._done = int(count[1]) - 1
            self._whole = (now - self._since) * int(count[2]) / self._done

    def estimate(self) -> tuple[float, float]:
        """The share of the time that has passed, from 0 to below 1, and the seconds left."""
        now = time.perf_counter()
        pace = (self._since - self._begun + PRIOR) / (self._passed + PRIOR)
        known = self._done / (self._done + FEW_STEPS)
        whole = known * self._whole + (1.0 - known) * pace * self._typical
        took = now - self._since
        left = max(whole - took, LEAST_LEFT * took) + pace * sum(self._left.values())
        return (now - self._begun) / max(now - self._begun + left, 1e-9), left

    def text(self) -> str:
        """Both in words, "43 %, 20 s left: "; empty if no stage was expected."""
        if not self._expected:
            return ""
        share, seconds = self.estimate()
        left = f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"
        return f"{100.0 * share:.0f} %, about {left} left: "


@contextlib.contextmanager
def shown_progress(progress: ProgressOrBar, expected: Mapping[str, float]) -> Iterator[Progress]:
    """What is called with each stage: the function given, for True a bar of tqdm, or nothing."""
    if progress is not True:
        yield progress or no_progress
        return
    tqdm = third_party("tqdm.auto", "progress is shown", "report")
    left = TimeLeft(expected)
    form = "{percentage:3.0f} %|{bar}| {elapsed}{postfix}"
    with tqdm.tqdm(total=1.0, bar_format=form) as bar:

        def show(stage: str) -> None:
            left.begin(stage)
            bar.n = left.estimate()[0]
            bar.set_postfix_str(left.text().partition(", ")[2] + stage)

        yield show
        bar.n = 1.0
        bar.set_postfix_str("done")
