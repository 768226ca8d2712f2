"""Optional dependencies: imported where they are used, with the pip line where one is missing."""

from importlib import import_module
from typing import Any

from cmfsim.errors import CaseInputError, CmfsimError

__all__ = ["third_party"]


def third_party(
    module: str, purpose: str, extra: str, error: type[CmfsimError] = CaseInputError
) -> Any:
    """A module of an optional dependency; where it is missing, the pip line that installs it.

    Parameters
    ----------
    module : str
        As `import` takes it: "scipy.ndimage".
    purpose : str
        What needs it, as the beginning of a sentence: "bones are cut".
    extra : str
        The extra of cmfsim that brings it.
    error : type of CmfsimError
        What to raise.

    Raises
    ------
    CmfsimError
        (of type `error`) The module cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as reason:
        package = module.partition(".")[0]
        raise error(
            f"{purpose} with {package}, which cannot be imported ({reason}): "
            f"pip install 'cmfsim[{extra}]'"
        ) from reason
