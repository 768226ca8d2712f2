"""The options of a build, and its stages as they run."""

import contextlib
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass
from typing import TYPE_CHECKING, TypedDict

from cmfsim.errors import CmfsimError
from cmfsim.pipeline.building.surgery.postoperative import Postoperative
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.finding import Finding, OnFindings
from cmfsim.values.progress import Observer, ProgressOrBar, shown_progress

if TYPE_CHECKING:
    from cmfsim.pipeline.building.inputs import OpenHeads

    # A case without muscles loads nothing of them.
    from cmfsim.values.musculature import Musculature
    from cmfsim.values.patient_model import PatientModel


class _Callbacks(Observer):
    """An observer with functions in place of some of its methods."""

    def __init__(self, observer: Observer, **functions: Callable[..., None] | None) -> None:
        for name, function in functions.items():
            setattr(self, name, function or getattr(observer, name))


class BuildKeywords(TypedDict, total=False):
    """The attributes of `BuildOptions` as keywords of the functions that build a case."""

    observer: Observer
    check: bool
    findings: Iterable[Finding]
    anatomy: Anatomy | None
    opened: "OpenHeads | None"
    after: Postoperative | None
    progress: ProgressOrBar
    on_findings: OnFindings | None
    on_muscles: Callable[["Musculature", Sequence[BoneSegment]], None] | None
    on_built: Callable[["PatientModel"], None] | None
    failed: dict[str, CmfsimError] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildOptions:
    """The options of the functions that build a case.

    Attributes
    ----------
    observer : Observer
        Learns of stages, findings, muscles, and models that cannot be solved.
    check : bool
        Whether the doctor checks the case first; an error that it finds ends the work.
    findings : iterable of Finding
        What is known of the case already; the model keeps it.
    anatomy : Anatomy or None
        The head, where it is known; the image or surfaces of the case are then not read.
    opened : dict or None
        Heads that `read_anatomy` has opened before; it is emptied when the head is there.
    after : Postoperative or None
        What `read_postoperative` gives, where it is known already.

    Parameters
    ----------
    progress : callable or bool, optional
        Called in place of the method `stage` of the observer; True shows a bar (tqdm), where a
        function is given it.
    on_findings, on_muscles, on_built : callable, optional
        Called in place of the methods `found`, `muscles` and `built` of the observer.
    failed : dict, optional
        If given, a model that cannot be solved (for example, because contact does not converge) is
        recorded here with its error, and the others continue.
    """

    observer: Observer = Observer()  # noqa: RUF009 (it has no state)
    check: bool = True
    findings: Iterable[Finding] = ()
    anatomy: Anatomy | None = None
    opened: "OpenHeads | None" = None
    after: Postoperative | None = None
    progress: InitVar[ProgressOrBar] = None
    on_findings: InitVar[OnFindings | None] = None
    on_muscles: InitVar[Callable[["Musculature", Sequence[BoneSegment]], None] | None] = None
    on_built: InitVar[Callable[["PatientModel"], None] | None] = None
    failed: InitVar[dict[str, CmfsimError] | None] = None

    def __post_init__(
        self,
        progress: ProgressOrBar,
        on_findings: OnFindings | None,
        on_muscles: Callable[["Musculature", Sequence[BoneSegment]], None] | None,
        on_built: Callable[["PatientModel"], None] | None,
        failed: dict[str, CmfsimError] | None,
    ) -> None:
        record = None if failed is None else failed.__setitem__
        observer = _Callbacks(
            self.observer,
            stage=progress if callable(progress) else None,
            found=on_findings,
            muscles=on_muscles,
            built=on_built,
            failed=record,
        )
        object.__setattr__(self, "observer", observer)


@contextlib.contextmanager
def build_options(given: BuildKeywords, expected: Mapping[str, float]) -> Iterator[BuildOptions]:
    """The options that a function was given; `progress=True` shows a bar of expected stages."""
    if given.get("progress") is not True:
        yield BuildOptions(**given)
        return
    with shown_progress(given["progress"], expected) as given["progress"]:
        yield BuildOptions(**given)


class Stages:
    """The stages as they pass: the seconds that each took, and what was found so far."""

    def __init__(self, options: BuildOptions) -> None:
        self._observer = options.observer
        self.findings: list[Finding] = [*options.findings]
        self._known = set(self.findings)
        self._name: str | None = None
        self._begun = 0.0
        self.seconds: dict[str, float] = {}

    def begin(self, name: str) -> None:
        """Ends the stage before, and begins another."""
        self.end()
        self._name, self._begun = name, time.perf_counter()
        self._observer.stage(name)

    def end(self) -> None:
        """Ends the stage, and hands over what is new of the findings."""
        if self._name is not None:
            took = time.perf_counter() - self._begun
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + took
            self._name = None
        new = [finding for finding in self.findings if finding not in self._known]
        self._known.update(new)
        if new:
            self._observer.found(new)

    def add(self, findings: Iterable[Finding]) -> None:
        """Takes what a stage noticed."""
        self.findings += findings

    def drop(self, codes: Collection[str], where: str | None = None) -> None:
        """Forgets the findings of some codes, at one place alone if it is given."""
        self.findings = [
            finding
            for finding in self.findings
            if finding.code not in codes or where not in {None, finding.where}
        ]
