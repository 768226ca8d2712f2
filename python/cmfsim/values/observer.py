"""The observer of the work on a case: stages, findings, muscles and models that fail."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cmfsim.errors import CmfsimError
from cmfsim.values.finding import Finding

if TYPE_CHECKING:
    # A case without muscles loads nothing of them.
    from cmfsim.values.anatomy import BoneSegment
    from cmfsim.values.musculature import Musculature


class Observer:
    """What learns of the work on a case as it goes on: override the methods that you need.

    Examples
    --------
    >>> import cmfsim
    >>> class Log(cmfsim.Observer):
    ...     def stage(self, name):
    ...         print(name)
    >>> prediction = cmfsim.predict("case.toml", observer=Log())  # doctest: +SKIP
    checking the case
    """

    def stage(self, name: str) -> None:
        """A stage begins."""

    def found(self, findings: Sequence[Finding]) -> None:
        """Findings of a stage or a solution; some may have been reported before."""

    def muscles(self, muscles: "Musculature", segments: "Sequence[BoneSegment]") -> None:
        """Muscles and segments of bone are known: before a model is solved, perhaps repeatedly."""

    def failed(self, model: str, error: CmfsimError) -> None:
        """A model cannot be solved: the other models continue unless this raises the error."""
        del model
        raise error
