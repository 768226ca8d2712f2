"""A cohort and its file, `cohort.toml`: the cases and models of a study (docs/formats.md)."""

import os
from dataclasses import dataclass
from pathlib import Path

from cmfsim.errors import CaseInputError
from cmfsim.io.cases.case_files import CASE_FILE
from cmfsim.io.cases.tables import CaseChanges, read_tables
from cmfsim.io.files.reading_writing import is_there
from cmfsim.values.checks import as_text, check_one_of
from cmfsim.values.prediction import MODELS

COHORT_FORMAT = "cmfsim-cohort"
# What a cohort's file is called where its folder alone is given.
COHORT_FILE = "cohort.toml"
# Where results go, below the folder of the cohort.
OUTPUT = "study"


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
    def load(cls, path: str | os.PathLike[str]) -> "Cohort":
        """The cohort that a `cohort.toml` describes.

        Parameters
        ----------
        path : path
            Of the file, or of a folder that holds a `cohort.toml`. A folder without one is the
            cohort of the cases in its folders, `NAME/case.toml`, with all models.

        Returns
        -------
        Cohort

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
        models = document.plain("models") if "models" in document else list(MODELS)
        if not isinstance(models, list) or not models or set(models) - set(MODELS):
            document.fail("models", f"is {models!r}: a list of {', '.join(MODELS)} is needed")
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
        return cls(
            document.text("name", path.resolve().parent.name or "cohort"),
            path,
            cases,
            tuple(dict.fromkeys(models)),
            folder / output,
            document.text("note").strip() if "note" in document else "",
        )

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
