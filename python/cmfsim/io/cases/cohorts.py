"""Cohorts and their variants, and the files `cohort.toml` and `variants.toml` (docs/formats.md)."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io.cases.case_files import CASE_FILE
from cmfsim.io.cases.tables import CaseChanges, Table, read_tables
from cmfsim.io.files.reading_writing import is_there
from cmfsim.values.checks import AnyPath, as_text, check_one_of
from cmfsim.values.prediction import MODELS

# The variant without changes, with which all others are compared.
AS_GIVEN = "as-given"
# Keys of a case file that no result depends on.
NO_SETTINGS = ("format", "version", "name", "note", "output", "band")
MOST_NAME = 40

COHORT_FORMAT = "cmfsim-cohort"
# What a cohort's file is called where its folder alone is given.
COHORT_FILE = "cohort.toml"
# Where results go, below the folder of the cohort.
OUTPUT = "study"


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
    def load(cls, path: AnyPath, models: tuple[str, ...] = MODELS) -> "Variants":
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
            if not name or len(name) > MOST_NAME or not _is_name(name):
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
    description = table.text("description") if "description" in table else ""
    changes = CaseChanges(values, without, file, below)
    return Variant(name, changes, _models(table, models, models), description)


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


@dataclass(frozen=True)
class Cohort:
    """The cases and models of a study.

    Attributes
    ----------
    name : str
    file : Path
        The cohort file; in a folder without one, where it would be.
    cases : mapping of str to Path
        The case file of each patient, by the patient's name.
    models : tuple of str
    output : Path
        Folder of everything that is written for the study.
    note : str
        Printed with every result, such as what the patients are.
    changes : CaseChanges, optional
        Made to every case, in a variant of a cohort.

    Examples
    --------
    >>> import cmfsim
    >>> cohort = cmfsim.Cohort.load("cohort.toml")  # doctest: +SKIP
    """

    name: str
    file: Path
    cases: dict[str, Path]
    models: tuple[str, ...]
    output: Path
    note: str = ""
    changes: CaseChanges | None = None

    def __post_init__(self) -> None:
        as_text("cohort name", self.name)
        if not self.cases:
            raise CaseInputError("a cohort needs at least one case")
        for model in self.models:
            check_one_of("model", model, MODELS)

    @classmethod
    def load(cls, path: AnyPath) -> "Cohort":
        """The cohort that a `cohort.toml` describes.

        Parameters
        ----------
        path : path
            Of the file, or of a folder that holds a `cohort.toml`. A folder without one is the
            cohort of the cases in its folders, `NAME/case.toml`, with all models.

        Raises
        ------
        FileNotFoundError
            The file does not exist. The cases that it names are not checked.
        CaseError
            (also `ValueError`) Not TOML, an unknown key, a case twice, an unknown model: with file,
            line and key; a folder without a cohort file or cases.
        """
        path = Path(path)
        if is_there(path) and path.is_dir():
            if not (path / COHORT_FILE).exists():
                return cls._of_cases_in(path)
            path = path / COHORT_FILE
        document = read_tables(path).only(
            "format", "version", "name", "note", "models", "cases", "output"
        )
        document.check_format(COHORT_FORMAT)
        models = _models(document, MODELS, MODELS)
        folder = path.parent
        output = document.text("output", OUTPUT)
        if Path(output).is_absolute() or ".." in Path(output).parts:
            document.fail("output", f"is {output!r}: name a folder below the cohort's own")
        cases: dict[str, Path] = {}
        for table in document.tables("cases"):
            table.only("name", "file")
            file = table.path("file", folder)
            name = table.text("name", file.parent.name or file.stem)
            if name in cases:
                table.fail("name" if "name" in table else "file", f"is a second case {name!r}")
            if not _is_name(name):
                table.fail("name" if "name" in table else "file", f"{name!r}: letters, digits, _-+")
            cases[name] = file
        if not cases:
            document.fail(None, 'names no case: [[cases]] with file = "P1/case.toml"')
        name = document.text("name", path.resolve().parent.name or "cohort")
        note = document.text("note").strip() if "note" in document else ""
        return cls(name, path, cases, models, folder / output, note)

    @classmethod
    def _of_cases_in(cls, folder: Path) -> "Cohort":
        """All cases in the folders of a folder."""
        files = sorted(folder.glob(f"*/{CASE_FILE}"))
        if not files:
            raise CaseInputError(
                f"{folder.resolve()}: is a folder without a {COHORT_FILE}, and no folder in it "
                f"has a {CASE_FILE}"
            )
        for file in files:
            if not _is_name(file.parent.name):
                raise CaseInputError(
                    f"{file.parent}: is no name for a case: letters, digits, _-+; rename the "
                    f"folder, or write a {COHORT_FILE}"
                )
        cases = {file.parent.name: file for file in files}
        name = folder.resolve().name or "cohort"
        return cls(name, folder / COHORT_FILE, cases, MODELS, folder / OUTPUT)


def _is_name(name: str) -> bool:
    """Whether a case may have this name: results lie in a folder of it."""
    return all(c.isalnum() or c in "_-+" for c in name)
