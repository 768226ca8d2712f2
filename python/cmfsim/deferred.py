"""Names that a package loads on first use, so that a scene loads only what it needs."""

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

# A line of a stub that makes a name of another module public.
PUBLIC = re.compile(r"^from (\S+) import (\w+) as \2$", re.MULTILINE)


def deferred(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """The `__getattr__`, `__dir__` and `__all__` of a package (Python reference, 3.3.2.1).

    The stub next to its `__init__.py` has the one list of its public names, a line each:
    `from module import name as name`. Modules and folders of the package too are attributes.

    package, file: Its `__name__` and `__file__`.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    home_of = {name: home for home, name in PUBLIC.findall(stub)}
    names = sorted(home_of)
    inside = [home for home in home_of.values() if home.startswith(f"{package}.")]
    beside = {home.removeprefix(f"{package}.").split(".")[0] for home in inside}

    def get(name: str) -> Any:
        if name in home_of:
            value = getattr(import_module(home_of[name]), name)
        elif name in beside:
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name)
        # The next time it is found without this function.
        vars(import_module(package))[name] = value
        return value

    return get, lambda: names, names
