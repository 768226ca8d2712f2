"""The options of a build, and its stages as they run."""

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cmfsim.pipeline.building.surgery.postoperative import Postoperative
from cmfsim.values.anatomy import Anatomy, BoneSegment
from cmfsim.values.finding import Finding, OnFindings
from cmfsim.values.progress import Progress, no_progress

if TYPE_CHECKING:
    # A case without muscles loads nothing of them.
    from cmfsim.values.musculature import Musculature

# What is called with the muscles of a patient and the segments of the bones.
OnMuscles = Callable[["Musculature", Sequence[BoneSegment]], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildOptions:
    """The options of the functions that build a case.

    Attributes
    ----------
    progress : callable or None
        Called with the name of each stage as it begins.
    check : bool
        Whether the doctor checks the case first; an error that it finds ends the work.
    findings : iterable of Finding
        What is known of the case already; the model keeps it.
    anatomy : Anatomy or None
        The head, where it is known; the image or surfaces of the case are then not read.
    after : Postoperative or None
        What `read_postoperative` gives, where it is known already.
    on_findings : callable or None
        Called with new findings at the end of each stage.
    on_muscles : callable or None
        Called with the muscles and the segments of bone once both are known, and perhaps again
        before any model is solved.
    """

    progress: Progress | None = None
    check: bool = True
    findings: Iterable[Finding] = ()
    anatomy: Anatomy | None = None
    after: Postoperative | None = None
    on_findings: OnFindings | None = None
    on_muscles: OnMuscles | None = None


class Stages:
    """The stages as they pass: the seconds that each took, and what was found so far."""

    def __init__(self, options: BuildOptions) -> None:
        self._progress = options.progress or no_progress
        self._on_findings = options.on_findings
        self.findings: list[Finding] = [*options.findings]
        self._known = set(self.findings)
        self._name: str | None = None
        self._begun = 0.0
        self.seconds: dict[str, float] = {}

    def begin(self, name: str) -> None:
        """Ends the stage before, and begins another."""
        self.end()
        self._name, self._begun = name, time.perf_counter()
        self._progress(name)

    def end(self) -> None:
        """Ends the stage, and hands over what is new of the findings."""
        if self._name is not None:
            took = time.perf_counter() - self._begun
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + took
            self._name = None
        new = [finding for finding in self.findings if finding not in self._known]
        self._known.update(new)
        if new and self._on_findings is not None:
            self._on_findings(new)

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

    def drop_repeated(self) -> None:
        """Keeps each finding once."""
        self.findings = [*dict.fromkeys(self.findings)]
