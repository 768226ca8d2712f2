"""Changes of a case's settings, as a variant of a study makes them."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from cmfsim.io.files.toml_lines import KeyPath


@dataclass(frozen=True)
class CaseChanges:
    """Keys of a case file with other values than the file has.

    Attributes
    ----------
    values : mapping of str to plain values
        Nested as in a case file. Tables are merged with the case's own; any other value, and any
        list, replaces the case's.
    without : tuple of str
        Dotted keys of the case file that are removed first, such as "tissue.preset".
    file : str
        The file that states the changes, for errors.
    lines : mapping of key path to int
        The line of each changed key in that file; if left out, 1 for all.

    Examples
    --------
    >>> import cmfsim
    >>> changes = cmfsim.CaseChanges({"muscles": {"fit": False}})
    >>> case = cmfsim.Case.load("case.toml", changes=changes)  # doctest: +SKIP
    """

    values: Mapping[str, Any]
    without: tuple[str, ...] = ()
    file: str = "changes"
    lines: Mapping[KeyPath, int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        lines = self.lines or dict.fromkeys(_paths(self.values, ()), 1)
        for name, table in (("values", self.values), ("lines", lines)):
            object.__setattr__(self, name, MappingProxyType(dict(table)))

    def as_json(self) -> str:
        """The changes as a text that travels to another process."""
        lines = [[list(path), line] for path, line in self.lines.items()]
        return json.dumps([dict(self.values), self.without, self.file, lines])

    @classmethod
    def from_json(cls, text: str) -> "CaseChanges":
        """The changes that `as_json` wrote."""
        values, without, file, lines = json.loads(text)
        places = {tuple(path): line for path, line in lines}
        return cls(values, tuple(without), file, places)


def _paths(values: Mapping[str, Any], above: KeyPath) -> Iterator[KeyPath]:
    """The path of every key, tables included."""
    for key, value in values.items():
        yield (*above, key)
        if isinstance(value, Mapping):
            yield from _paths(value, (*above, key))
