"""The text of a case file as the desk changes it: tables are exchanged, everything else stays."""

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io import Case
from cmfsim.io.cases.case_tables import matrix_rows, plan_head
from cmfsim.io.files.reading_writing import toml_module
from cmfsim.io.files.texts import toml_lines
from cmfsim.values.checks import Floats

# A line that `cmfsim init` left to a person, and what may stand there, with words about it.
ASKED = re.compile(r'^([A-Za-z0-9_-]+) = (.*)"\?"(.*?)  # (.*)$')
CHOICE = re.compile(r'^#   ("(?:[^"\\]|\\.)*"|\[[^\]]*\])(?:[:,] )?(.*)$')
SERIES = re.compile(r'^ ?with series = ("[^"]*") on a line of its own: ')
# What init writes about a motion, or about there being none: no longer true of another one.
OUTDATED = ("# It ", "# As typed")

NO_PLAN = re.compile(r"^# No plan was found\..*?(?=\n\n|\Z)", re.MULTILINE | re.DOTALL)
BLANK = re.compile(r"\n{3,}")

Names = tuple[str, ...]


def open_questions(text: str) -> list[dict[str, Any]]:
    """What a person has to decide: number of the line, key, question, and choices as TOML."""
    found: list[dict[str, Any]] = []
    rows = text.split("\n")
    for number, row in enumerate(rows):
        if not (match := ASKED.match(row)):
            continue
        choices = []
        for below in rows[number + 1 :]:
            if not below.startswith("#   "):
                break
            if not (choice := CHOICE.match(below)):
                continue
            value, words = choice[1], choice[2]
            if "slope" in value:
                # A scale that only the user knows; without a line the values are HU.
                choices.append({"toml": "", "words": "nothing: the values are HU"})
                continue
            if series := SERIES.match(words):
                value += f"\nseries = {series[1]}"
                words = words[series.end() :]
            choices.append({"toml": value, "words": f"{choice[1]} {words}".strip()})
        found.append({"line": number, "key": match[1], "text": match[4], "choices": choices})
    return found


def answered(text: str, line: int, toml: str) -> str:
    """The text with one question answered by TOML; by nothing, the line goes."""
    asked = {question["line"]: question for question in open_questions(text)}
    if line not in asked:
        raise CaseInputError("this question is no longer open: reload the page")
    rows = text.split("\n")
    match = ASKED.match(rows[line])
    choices = [choice["toml"] for choice in asked[line]["choices"]]
    if match is None or (toml not in choices and ("\n" in toml or not _is_value(toml))):
        raise CaseInputError(
            f"{toml!r} is no value: a text in quotes, a number or [a, b] is needed"
        )
    rows[line] = f"{match[1]} = {match[2]}{toml}{match[3]}  # decided on the desk: {match[4]}"
    if not toml:
        rows[line] = f"# {match[1]}: decided on the desk that it is not needed"
    elif "\n" in toml:
        rows[line] = f"{match[1]} = {toml}"
    return "\n".join(rows)


def _is_value(toml: str) -> bool:
    try:
        values = toml_module().loads(f"value = {toml}")
    except ValueError:
        return False
    return set(values) == {"value"} and values["value"] != "?"


def with_tables(
    text: str, is_replaced: Callable[[Names, str], bool], tables: Mapping[str, Sequence[str]]
) -> str:
    """The text with other tables in place of some; comments in and below those stay.

    is_replaced: Whether a table goes, by its path and its rows as text.
    tables: New rows by their head; they stand where the first one stood, or at the end.
    """
    new = [row for head, rows in tables.items() for row in ("", head, *rows)]
    kept: list[str] = []
    place = None
    for path, rows in _tables(text):
        if not (path and is_replaced(path, "\n".join(rows))):
            kept += rows
            continue
        if place is None:
            place = len(kept)
        end = max((i for i, r in enumerate(rows) if r.strip() and not r.startswith("#")), default=0)
        notes = [r for r in rows[: end + 1] if r.startswith("#") and not r.startswith(OUTDATED)]
        kept += notes + rows[end + 1 :]
    if place is None:
        place = len(kept)
        while place and not kept[place - 1].strip():
            place -= 1
    else:
        new = new[1:] + [""] if new else []
    kept[place:place] = new
    return BLANK.sub("\n\n", "\n".join(kept).rstrip("\n")) + "\n"


def with_keys(text: str, table: str, values: Mapping[str, str]) -> str:
    """The text with keys of a table set to TOML; its other rows stay."""
    rows: list[str] = []
    is_there = False
    for path, own in _tables(text):
        if path == (table,):
            is_there = True
            pattern = re.compile(rf"^\s*({'|'.join(values)})\s*=")
            rows += [own[0], *(f"{key} = {value}" for key, value in values.items())]
            rows += [row for row in own[1:] if not pattern.match(row)]
            continue
        rows += own
    if not is_there:
        rows = [*rows[:-1], "", f"[{table}]", *(f"{k} = {v}" for k, v in values.items()), ""]
    return "\n".join(rows)


def _tables(text: str) -> list[tuple[Names, list[str]]]:
    """The rows of each table with its path; the first are those before any table."""
    rows = text.split("\n")
    found: list[tuple[Names, list[str]]] = [((), [])]
    lines = set(toml_lines(text).values())
    for number, row in enumerate(rows, 1):
        if number in lines and row.lstrip().startswith("["):
            found.append((_path(row), []))
        found[-1][1].append(row)
    return found


def _path(head: str) -> Names:
    """The path in the head of a table."""
    value = toml_module().loads(head)
    path: list[str] = []
    while isinstance(value, dict) and value:
        path += value
        value = value[path[-1]]
    return tuple(path)


def with_plan(
    text: str, is_replaced: Callable[[str], bool], plan: Mapping[str, Floats], made_by: str
) -> str:
    """The text with motions, (4, 4) mm LPS each, in place of those of some segments."""
    # Adding 0 writes −0 as 0.
    tables = {
        f"{plan_head(name)}  # {made_by}": ['frame = "LPS"', *matrix_rows(motion + 0.0)]
        for name, motion in plan.items()
    }
    text = NO_PLAN.sub("", text) if plan else text

    def goes(path: Names, _: str) -> bool:
        return path[0] == "plan" and len(path) > 1 and is_replaced(path[1])

    return with_tables(text, goes, tables)


def read_as(text: str, file: Path, changed: Sequence[str], before: str) -> Case:
    """The case that a changed text describes, after checks that nothing else has changed."""
    try:
        old, new = (toml_module().loads(given) for given in (before, text))
    except ValueError as error:
        raise CaseInputError(
            f"{file.name}: its tables {', '.join(changed)} are written in a form that the desk "
            f"cannot change ({error}); nothing was written: write them as `cmfsim init` does"
        ) from error
    others = [key for key in {*old, *new} - {*changed} if old.get(key) != new.get(key)]
    if others:
        raise CaseInputError(
            f"{file.name}: {others[0]} would change as well, so nothing was written: write the "
            f"tables {', '.join(changed)} as `cmfsim init` does"
        )
    with tempfile.TemporaryDirectory(prefix="cmfsim-desk-") as folder:
        copy = Path(folder) / file.name
        copy.write_text(text, encoding="utf-8")
        return Case.load(copy)
