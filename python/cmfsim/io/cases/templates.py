"""Muscle templates on disk: a folder with `template.toml`, or one `.npz` archive.

A survey reads as much as it can and lists everything that is wrong; reading refuses at the first.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cmfsim._core import MOST_BOXES
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io.cases.tables import Table, read_tables
from cmfsim.io.cases.template_archives import (
    TEMPLATE_FORMAT,
    read_template_archive,
    write_template_archive,
)
from cmfsim.io.files.folders import PREFIX, replacing_files
from cmfsim.io.files.reading_writing import FORMAT_VERSION, beside, is_there, named
from cmfsim.io.landmarks import read_landmark_file, write_landmarks
from cmfsim.io.meshes.surfaces import read_surface, write_surface
from cmfsim.io.slicer.markups import read_curves, write_curves
from cmfsim.values.case_parts import FRAMES, UNITS
from cmfsim.values.checks import AnyPath
from cmfsim.values.finding import Finding
from cmfsim.values.musculature import MUSCLE_KINDS, MUSCLE_SIDES, MuscleSurface, TemplateData
from cmfsim.values.surface_data import SurfaceData

TEMPLATE_FILE = "template.toml"
KEYS = (
    "format", "version", "name", "licence", "attribution", "source", "skull", "units", "frame",
    "landmarks", "muscles",
)  # fmt: skip
MUSCLE_KEYS = ("name", "side", "kind", "file", "boxes", "course", "concepts")
# File and line at the start of an error's text.
PLACE = re.compile(r"([^\s:]+(?::\d+)?): (.*)", re.DOTALL)
MISSING = "file-missing"


@dataclass(frozen=True, eq=False)
class TemplateSurvey:
    """What a template on disk holds, and what is wrong with it; no template if it cannot be one."""

    template: TemplateData | None
    findings: tuple[Finding, ...]


def read_template(path: AnyPath) -> TemplateData:
    """The template of a folder with `template.toml`, or of an `.npz` archive.

    An error names file, line and key of what is wrong first, and how many more there are.
    """
    survey = survey_template(path)
    errors = [f for f in survey.findings if f.severity == "error"]
    if survey.template is None or errors:
        first = errors[0]
        more = f" (and {len(errors) - 1} more: cmfsim template check)" if len(errors) > 1 else ""
        text = f"{first.where}: {first.what}{more}"
        raise FileNotFoundError(text) if first.code == MISSING else CaseInputError(text)
    return survey.template


def survey_template(path: AnyPath) -> TemplateSurvey:
    """What a template on disk holds, and everything that keeps it from being read."""
    path = Path(path)
    if not is_there(path):
        raise FileNotFoundError(f"{path}: no such template")
    gathered = _Gathered(path.name)
    template: TemplateData | None = None
    if path.is_dir():
        template = _survey_folder(path, gathered)
    else:
        with gathered.at("create it again"), named(path):
            template = read_template_archive(path)
    if gathered.has_error:
        template = None
    elif template is not None and gathered.findings:
        template = replace(template, findings=(*template.findings, *gathered.findings))
    return TemplateSurvey(template, tuple(gathered.findings))


def write_template(
    path: AnyPath, template: TemplateData, report: Mapping[str, Any] | None = None
) -> None:
    """Writes a template: a folder, or one archive if the name ends in `.npz`.

    A report is written beside it in the folder, as `report.json`; an archive has no place for one.
    The files of a folder take their places together. A folder that is there must hold a template
    and nothing else; files that the new one lacks go.
    """
    path = Path(path)
    if path.suffix == ".npz":
        write_template_archive(path, template)
        return
    _refuse_foreign(path)

    def fill(fresh: Path) -> list[str]:
        _write_files(fresh, template)
        if report is not None:
            text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
            (fresh / "report.json").write_text(text + "\n", encoding="utf-8", newline="\n")
        return _names_in(fresh)

    replacing_files(path, None, _is_template_file, fill, lambda: _names_in(path))


class _Gathered:
    """Findings in the order in which they turn up: a context that makes them of errors."""

    def __init__(self, where: str) -> None:
        self.findings: list[Finding] = []
        self._where, self._fix = where, ""

    @property
    def has_error(self) -> bool:
        return any(finding.severity == "error" for finding in self.findings)

    def at(self, fix: str) -> "_Gathered":
        """The context for a place with this remedy; what comes after it goes on."""
        self._fix = fix
        return self

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if not isinstance(error, CmfsimError | OSError | ValueError):
            return False
        found = PLACE.fullmatch(str(error))
        where, what = (found[1], found[2]) if found else (self._where, str(error))
        self.findings.append(
            Finding(MISSING, what, where=where)
            if isinstance(error, FileNotFoundError)
            else Finding("template-unusable", what, where=where, fix=self._fix)
        )
        return True


def _survey_folder(folder: Path, gathered: _Gathered) -> TemplateData | None:
    table: Table | None = None
    with gathered.at("correct the line"):
        table = read_tables(folder / TEMPLATE_FILE)
    if table is None:
        return None
    given: dict[str, Any] = {}
    with gathered.at("correct the line"):
        table.only(*KEYS)
    with gathered.at(f'write format = "{TEMPLATE_FORMAT}"'):
        table.check_format(TEMPLATE_FORMAT)
    with gathered.at('state its terms of use: licence = "…"'):
        given["licence"] = table.text("licence")
    with gathered.at("correct the line"):
        given["name"] = table.text("name")
        given.update({key: table.text(key) for key in ("attribution", "source") if key in table})
    units, frame = "mm", "LPS"
    with gathered.at("correct the line"):
        units = table.text("units", units, tuple(UNITS))
        frame = table.text("frame", frame, FRAMES)
    with gathered.at("repair the skull reference"):
        given["skull"] = _surface(table, "skull", folder, units, frame)
    with gathered.at("correct the landmarks"):
        landmarks = table.table("landmarks").only("file", "definitions")
        definitions = landmarks.table("definitions")
        given["definitions"] = {name: definitions.text(name) for name in definitions}
        found = read_landmark_file(_file(landmarks, "file", folder))
        gathered.findings += found.findings
        given["landmarks"] = found.points
    muscles: list[MuscleSurface] = []
    concepts: dict[str, tuple[str, ...]] = {}
    entries: list[Table] = []
    with gathered.at("write [[muscles]] before each muscle"):
        entries = table.tables("muscles")
    for entry in entries:
        with gathered.at("correct this muscle's table or file"):
            muscle = _muscle(entry, folder, units, frame)
            muscles.append(muscle)
            concepts[muscle.name] = _texts(entry, "concepts")
    if gathered.has_error:
        return None
    with gathered.at("correct the template"):
        return TemplateData(
            muscles=tuple(muscles), concepts={k: v for k, v in concepts.items() if v}, **given
        )
    return None


def _file(table: Table, key: str, folder: Path) -> Path:
    """A file inside the template's folder: a template may come from a stranger."""
    name = table.text(key)
    try:
        path = beside(folder, key, name)
        there = is_there(path) and path.is_file()
    except CaseInputError:
        table.fail(key, f"is {name!r}: a file inside the template's folder is needed")
    if not there:
        place = f"{TEMPLATE_FILE}:{table.line(key)}"
        raise FileNotFoundError(f"{place}: {key} names {name!r}: no such file")
    return path


def _surface(table: Table, key: str, folder: Path, units: str, frame: str) -> SurfaceData:
    return read_surface(_file(table, key, folder), units=units, frame=frame)


def _muscle(table: Table, folder: Path, units: str, frame: str) -> MuscleSurface:
    table.only(*MUSCLE_KEYS)
    boxes = table.number("boxes", "", 1, MOST_BOXES)
    if boxes is not None and boxes != int(boxes):
        table.fail("boxes", f"is {boxes:g}: a whole number is needed")
    name = table.text("name")
    side = table.text("side", choices=MUSCLE_SIDES)
    kind = table.text("kind", choices=MUSCLE_KINDS)
    course = read_curves(_file(table, "course", folder)) if "course" in table else ()
    surface = _surface(table, "file", folder, units, frame)
    with table.at(None):
        return MuscleSurface(
            name, side, surface, kind, None if boxes is None else int(boxes), course
        )


def _texts(table: Table, key: str) -> tuple[str, ...]:
    if key not in table:
        return ()
    value = table.plain(key)
    if not isinstance(value, list) or not all(isinstance(entry, str) for entry in value):
        table.fail(key, f"is {value!r}: a list of texts is needed")
    return tuple(value)


def _write_files(folder: Path, template: TemplateData) -> None:
    """Writes the files of a template into a folder that is there."""
    skull, landmarks = "skull.ply", "skull.mrk.json"
    write_surface(folder / skull, template.skull)
    write_landmarks(folder / landmarks, template.landmarks)
    lines = [f'format = "{TEMPLATE_FORMAT}"', f"version = {FORMAT_VERSION}"]
    about = {key: getattr(template, key) for key in ("name", "licence", "attribution", "source")}
    lines += [f"{key} = {_toml_text(text)}" for key, text in about.items() if text]
    lines += [f'skull = "{skull}"', "", "[landmarks]", f'file = "{landmarks}"']
    if template.definitions:
        lines += ["", "[landmarks.definitions]"]
        lines += [
            f"{_toml_text(name)} = {_toml_text(where)}"
            for name, where in template.definitions.items()
        ]
    for muscle in template.muscles:
        file, course = f"muscle-{muscle.name}.ply", f"course-{muscle.name}.mrk.json"
        own = {"name": muscle.name, "side": muscle.side, "kind": muscle.kind, "file": file}
        lines += ["", "[[muscles]]", *(f'{key} = "{text}"' for key, text in own.items())]
        write_surface(folder / file, muscle.surface)
        if muscle.boxes is not None:
            lines.append(f"boxes = {muscle.boxes}")
        if muscle.course:
            lines.append(f'course = "{course}"')
            write_curves(folder / course, muscle.course)
        if concepts := template.concepts.get(muscle.name):
            lines.append(f"concepts = [{', '.join(_toml_text(c) for c in concepts)}]")
    (folder / TEMPLATE_FILE).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _toml_text(text: str) -> str:
    """A text as a basic string of TOML, whose escapes are JSON's, with DEL escaped too."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


# What templates and their reports are written as.
TEMPLATE_FILES = re.compile(
    r"template\.toml|skull\.ply|skull\.mrk\.json|report\.json|muscles\.png|"
    r"muscle-[A-Za-z0-9_+-]+\.ply|course-[A-Za-z0-9_+-]+\.mrk\.json"
)


def _names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def _is_template_file(name: str) -> bool:
    return TEMPLATE_FILES.fullmatch(name) is not None


def _refuse_foreign(folder: Path) -> None:
    """Refuses to replace what somebody else has put there."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise CaseInputError(f"{folder.name}: is a file, but a folder is to be written there")
    left = [name for name in _names_in(folder) if not name.startswith(PREFIX)]
    foreign = [name for name in left if not _is_template_file(name)]
    if foreign:
        raise CaseInputError(
            f"{folder.name}: holds {foreign[0]!r} ({len(foreign)} such), which is not part of a "
            "template: choose another folder, or move that file away"
        )
