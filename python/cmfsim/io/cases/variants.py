"""Variants of a cohort's settings and their file, `variants.toml` (docs/formats.md)."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmfsim.io.cases.tables import CaseChanges, Table, read_tables
from cmfsim.values.prediction import MODELS

# The variant without changes, with which all others are compared.
AS_GIVEN = "as-given"
# Keys of a case file that no result depends on.
NO_SETTINGS = ("format", "version", "name", "note", "output", "band")
MOST_NAME = 40


@dataclass(frozen=True)
class Variant:
    """Named changes of every case of a cohort.

    Attributes
    ----------
    name : str
    changes : CaseChanges or None
        None: the cases as given.
    models : tuple of str
    description : str
    """

    name: str
    changes: CaseChanges | None
    models: tuple[str, ...]
    description: str = ""

    @property
    def words(self) -> str:
        """The changes as a line of text."""
        if self.changes is None:
            return "the cases as their files describe them"
        removed = [f"without {key}" for key in self.changes.without]
        return ", ".join([*removed, *_assignments(self.changes.values, "")])


@dataclass(frozen=True)
class Variants:
    """The variants of a study; the first is "as-given", without changes.

    Attributes
    ----------
    file : Path
    models : tuple of str
        Of the variant "as-given"; the others have these or some of them.
    variants : mapping of str to Variant
        By name, in the order of the file.
    description : str

    Examples
    --------
    >>> import cmfsim
    >>> variants = cmfsim.Variants.load("variants.toml", ("H", "M+S"))  # doctest: +SKIP
    >>> list(variants.variants)  # doctest: +SKIP
    ['as-given', 'bone', 'soft']
    """

    file: Path
    models: tuple[str, ...]
    variants: Mapping[str, Variant]
    description: str = ""

    @classmethod
    def load(cls, path: str | os.PathLike[str], models: tuple[str, ...] = MODELS) -> "Variants":
        """The variants that a `variants.toml` describes.

        Parameters
        ----------
        path : path
        models : tuple of str
            Those of the cohort, if the file does not choose among all models.

        Returns
        -------
        Variants
            Their changes have not been applied to any case.

        Raises
        ------
        FileNotFoundError
            The file does not exist.
        CaseError
            (also `ValueError`) Not TOML, an unknown key outside the changes, a variant without a
            change, an unknown model: with file, line and key.
        """
        path = Path(path)
        document = read_tables(path).only("description", "models", "variants")
        models = _models(document, models, MODELS)
        description = document.text("description") if "description" in document else ""
        tables = document.table("variants")
        if not list(tables):
            document.fail(None, "names no variant: add [variants.NAME] with settings of a case")
        found = {AS_GIVEN: Variant(AS_GIVEN, None, models)}
        lines = document.all_paths()
        for name in tables:
            if name == AS_GIVEN:
                tables.fail(name, "is always there, without changes: choose another name")
            if (
                not name
                or len(name) > MOST_NAME
                or not all(c.isalnum() or c in "_-+" for c in name)
            ):
                tables.fail(name, f"is no name: letters, digits, _-+, {MOST_NAME} at most")
            found[name] = _variant(name, tables.table(name), models, path.name, lines)
        return cls(path, models, found, description)


def _variant(
    name: str,
    table: Table,
    models: tuple[str, ...],
    file: str,
    lines: Mapping[tuple[str | int, ...], int],
) -> Variant:
    """One variant; whether its keys are those of a case shows where it is applied to one."""
    without: tuple[str, ...] = ()
    if "without" in table:
        given = table.plain("without")
        if not isinstance(given, list) or not all(isinstance(key, str) for key in given):
            table.fail("without", f'is {given!r}: a list of keys, such as ["tissue.preset"]')
        without = tuple(given)
    for key in table:
        if key in NO_SETTINGS:
            table.fail(key, "has no influence on a predicted face: a variant cannot change it")
    own = ("description", "models", "without")
    values = {key: value for key, value in table.values().items() if key not in own}
    if not values and not without:
        table.fail(None, f"changes nothing: {AS_GIVEN!r} is always there for comparison")
    top = ("variants", name)
    below = {path[2:]: line for path, line in lines.items() if path[:2] == top and len(path) > 2}
    return Variant(
        name,
        CaseChanges(values, without, file, below),
        _models(table, models, models),
        table.text("description") if "description" in table else "",
    )


def _models(table: Table, default: tuple[str, ...], allowed: tuple[str, ...]) -> tuple[str, ...]:
    if "models" not in table:
        return default
    given = table.plain("models")
    if not isinstance(given, list) or not given or set(given) - set(allowed):
        table.fail("models", f"is {given!r}: a list of {', '.join(allowed)} is needed")
    return tuple(dict.fromkeys(given))


def _assignments(values: Mapping[str, Any], above: str) -> list[str]:
    """Each changed key with its value."""
    found: list[str] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            found += _assignments(value, f"{above}{key}.") or [f"{above}{key} = {{}}"]
        else:
            found.append(f"{above}{key} = {json.dumps(value, default=str)}")
    return found
