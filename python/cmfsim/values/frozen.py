"""How values travel to other processes: read-only mappings and arrays stay what they are.

Values hold their mappings as `types.MappingProxyType`, which Python can neither pickle nor copy,
and their arrays read-only, which numpy forgets when it does either. Pickles are for process pools
and `copy.deepcopy` alone: no file is ever read by unpickling it.
"""

import copyreg
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np


class Frozen:
    """Base of values whose arrays are still read-only after a pickle or a deep copy."""

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Takes the fields as they were, arrays read-only."""
        for name, value in state.items():
            object.__setattr__(self, name, _read_only(value))


def listing(title: str, rows: Mapping[str, str]) -> str:
    """What a value shows of itself: a title, and a line for each row that has a text."""
    shown = {name: text for name, text in rows.items() if text}
    width = max((len(name) for name in shown), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in shown.items())])


def frozen_mapping(items: Mapping[Any, Any]) -> Mapping[Any, Any]:
    """A read-only mapping of these items, arrays among them read-only too."""
    return MappingProxyType({key: _read_only(value) for key, value in items.items()})


def _read_only(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, tuple):
        for entry in value:
            _read_only(entry)
    return value


def _reduced(mapping: "MappingProxyType[Any, Any]") -> tuple[Any, ...]:
    return frozen_mapping, (dict(mapping),)


# For every value that holds one, also deep in a summary: there is one table of this in Python,
# which `pickle` and `copy` both ask. Nothing that could be pickled before is pickled otherwise.
copyreg.pickle(MappingProxyType, _reduced)
