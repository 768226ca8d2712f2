"""The templates that come with the package, by name."""

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from cmfsim.io.files.reading_writing import is_there

# Made by scripts/make_default_template.py.
BUILT_IN: Mapping[str, str] = MappingProxyType({"default": "default.npz"})


def template_names() -> tuple[str, ...]:
    """The names of the templates that come with the package.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.template_names()
    ('default',)
    """
    return tuple(BUILT_IN)


def template_path(folder_or_name: str | os.PathLike[str]) -> Path:
    """The folder or archive of a template.

    A text that is the name of a built-in template means that one; `./default` means a folder.

    Raises `FileNotFoundError`: Neither a name nor a folder or archive.
    Raises `CaseError`: A name that no file can have.
    """
    if isinstance(folder_or_name, str) and folder_or_name in BUILT_IN:
        return Path(__file__).with_name(BUILT_IN[folder_or_name])
    path = Path(folder_or_name)
    if not is_there(path):
        known = ", ".join(BUILT_IN)
        raise FileNotFoundError(f"{path}: no such template; built in: {known}")
    return path
