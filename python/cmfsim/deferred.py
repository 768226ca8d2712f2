"""Names that a package loads when they are first asked for: a scene pays for what it has."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__all__ = ["deferred"]


def deferred(
    package: str, homes: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """The `__getattr__`, `__dir__` and `__all__` of a package (Python reference, 3.3.2.1).

    Parameters
    ----------
    package : str
        Its `__name__`.
    homes : mapping of str to tuple of str
        The public names by the module of the package that defines them, `folder.module` where
        it lies in a folder. Modules and folders too are attributes. `__init__.pyi` has the same
        list for type checkers.
    """
    home_of = {name: home for home, names in homes.items() for name in names}
    names = sorted(home_of)
    beside = {home.split(".")[0] for home in homes}

    def get(name: str) -> Any:
        if name in home_of:
            value = getattr(import_module(f"{package}.{home_of[name]}"), name)
        elif name in beside:
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name)
        # The next time it is found without this function.
        vars(import_module(package))[name] = value
        return value

    return get, lambda: names, names
