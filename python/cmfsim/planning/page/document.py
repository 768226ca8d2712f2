"""A page as one HTML file: scripts, style and numbers in it, nothing from elsewhere.

The scripts are ES modules in their own files; they are joined in the order of their imports. The
policy of the page allows these very scripts and this style, by their hashes, and no network.

Arrays travel in it as text: one block of bytes, compressed, in base64, with a table of what lies
where.
"""

import base64
import gzip
import hashlib
import html
import json
import re
import shlex
from collections.abc import Container, Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError
from cmfsim.planning.page.arrays import PageContent
from cmfsim.values.language import language, script_texts, translated

TYPES = ("float32", "float16", "uint32")
# Arrays begin at multiples of this, bytes, as typed arrays of JavaScript need it.
ALIGNED = 8

MAIN = "main.js"
# The folder of the template, of the style and of the scripts that all pages share.
SHARED = "cmfsim.planning.page"
DISCLAIMER = "Research software, not a medical device. Not for diagnosis or treatment decisions."
IMPORT = re.compile(r'^import \{[^}]*\} from "\./([a-z_]+\.js)";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:function|const|class)\b)", re.MULTILINE)
# A name that a module defines at its top.
DEFINED = re.compile(r"^(?:export )?(?:async )?(?:function|const|let|class) (\w+)", re.MULTILINE)
# What stands in a template for people to read: between tags, and as a label.
TAGGED = re.compile(r"(<p[^>]*>|aria-label=\")([^<>@\"]+)(<|\")")
# Values of pages that people read; others are names.
READ = (
    *("about", "absent", "caption", "choices", "doubt", "exact_note", "label", "measure_notes"),
    *("note", "occlusion_absent", "problems", "profile_absent", "text", "title", "where", "why"),
    "words",
)
FIELD = re.compile(r"@([a-z]+)@")
# Parts that templates have in common, and the template of a picture within another page.
INCLUDED = ("canvases", "scripts")
VIEW = """<style>@style@</style>
@canvases@
<div class="controls" id="controls"></div>
@scripts@
"""


@dataclass(frozen=True, eq=False)
class Document:
    """The parts of a page; `made_for` is the state of the case.

    stage, panel, picture: What the drawing, the fields next to it and the picture itself are, for
        screen readers.
    values, arrays: Plain values, ready for JSON; float32, float16 and uint32.
    package: The package that has the first script, `main`, and a style besides the shared ones.
    is_served: Whether the page asks the program that serves it; otherwise it makes no connection.
    """

    title: str
    facts: str
    footer: str
    stage: str
    panel: str
    picture: str
    made_for: str
    values: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    package: str = SHARED
    main: str = MAIN
    is_served: bool = False


def document_text(document: Document) -> str:
    """The text of a page; `CaseError` unless numbers are finite and scripts can be joined."""
    texts = ("title", "facts", "footer", "stage", "panel", "picture")
    packages = tuple(dict.fromkeys((SHARED, document.package)))
    parts = _parts(document.values, document.arrays, packages, document.main)
    fields = {
        **{name: html.escape(translated(getattr(document, name))) for name in texts},
        "policy": _policy(parts["script"], parts["style"], is_served=document.is_served),
        "state": html.escape(document.made_for),
        "disclaimer": html.escape(translated(DISCLAIMER)),
        "language": language(),
        **parts,
    }
    return _filled(_template("page"), fields)


def view_markup(
    values: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    *,
    package: str,
    main: str,
    picture: str,
) -> tuple[str, str]:
    """The markup of a picture to turn, for a page of another kind, and its script's source policy.

    picture: What it is, for screen readers; otherwise, and in what it raises, as `document_text`.
    """
    parts = _parts(values, arrays, (package,), main)
    fields = {**parts, "picture": html.escape(translated(picture))}
    return _filled(VIEW, fields), f"'sha256-{_digest(parts['script'])}'"


def _parts(
    values: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    packages: tuple[str, ...],
    main: str,
) -> dict[str, str]:
    """Style, script, values and numbers as a page has them; the shared picture has the first."""
    numbers, table = packed_arrays(arrays)
    paths = [files(SHARED) / "picture.css", *(files(name) / "page.css" for name in packages)]
    scripts = {
        entry.name: entry.read_text(encoding="utf-8")
        for package in dict.fromkeys((SHARED, *packages))
        for entry in (files(package) / "scripts").iterdir()
        if entry.name.endswith(".js")
    }
    script = joined_scripts(scripts, main)
    shown = {**shown_values(values), "arrays": table, "texts": script_texts(script)}
    return {
        "style": "".join(p.read_text(encoding="utf-8") for p in paths if p.is_file()),
        "script": script,
        "values": _json_in_html(shown),
        "numbers": numbers,
    }


def shown_values(values: Any, read: Container[str] = READ, key: str = "") -> Any:
    """Values of a page, with those that people read, by their keys, in their language."""
    if isinstance(values, str):
        return translated(values) if key in read else values
    if isinstance(values, Mapping):
        return {name: shown_values(value, read, name) for name, value in values.items()}
    return [shown_values(v, read, key) for v in values] if isinstance(values, list) else values


def _filled(text: str, fields: Mapping[str, str]) -> str:
    """A template with its fields, after the templates that it includes."""
    for part in INCLUDED:
        text = text.replace(f"@{part}@\n", TAGGED.sub(_in_language, _template(part)))
    # In one pass, so that no text is searched for the fields of another.
    return FIELD.sub(lambda match: fields[match[1]], text)


def _in_language(match: re.Match[str]) -> str:
    return f"{match[1]}{html.escape(translated(match[2]), quote=False)}{match[3]}"


def _template(name: str) -> str:
    return (files(SHARED) / f"{name}.html").read_text(encoding="utf-8")


def joined_scripts(modules: Mapping[str, str], main: str = MAIN) -> str:
    """The first module and those that it imports as one script, each after those that it needs.

    Raises `CaseError`: Imports in a circle or of no module; two that define the same name.
    """
    order: list[str] = []

    def add(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise CaseInputError(f"scripts import each other: {' → '.join((*above, name))}")
        if name not in modules:
            raise CaseInputError(f"{above[-1] if above else main}: there is no script {name!r}")
        for needed in IMPORT.findall(modules[name]):
            if needed not in order:
                add(needed, (*above, name))
        if name not in order:
            order.append(name)

    add(main, ())
    homes: dict[str, str] = {}
    for name in order:
        for defined in DEFINED.findall(modules[name]):
            if defined in homes:
                raise CaseInputError(f"{homes[defined]} and {name} both define {defined!r}")
            homes[defined] = name
    return "\n".join(EXPORT.sub("", IMPORT.sub("", modules[name])) for name in order)


def _policy(script: str, style: str, *, is_served: bool) -> str:
    """What the page may do: run this script, apply this style, save files; ask its own server."""
    allowed = {
        "default-src": "'none'",
        "script-src": f"'sha256-{_digest(script)}'",
        "style-src": f"'sha256-{_digest(style)}'",
        "img-src": "data: blob:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    if is_served:
        allowed["connect-src"] = "'self'"
    return "; ".join(f"{name} {value}" for name, value in allowed.items())


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _json_in_html(values: Mapping[str, object]) -> str:
    """JSON in which nothing ends the element or opens a comment, whatever a case is called."""
    text = json.dumps(values, allow_nan=False, ensure_ascii=True)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def packed_arrays(arrays: Mapping[str, NDArray[Any]]) -> tuple[str, list[dict[str, Any]]]:
    """The text of arrays, and where each starts; `CaseError` for numbers beyond its precision."""
    table: list[dict[str, Any]] = []
    block = bytearray()
    for name, array in arrays.items():
        kind = array.dtype.name
        if kind not in TYPES:
            raise CaseInputError(f"array {name!r} has type {kind}: one of {', '.join(TYPES)}")
        if not np.isfinite(array).all():
            raise CaseInputError(
                f"array {name!r} of the page holds numbers that are not finite in {kind}"
            )
        block.extend(b"\0" * (-len(block) % ALIGNED))
        table.append({"name": name, "type": kind, "shape": list(array.shape), "start": len(block)})
        block.extend(np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes())
    # Without the time, so that equal pages have equal bytes. Level 9 takes four times as long for
    # 1 % fewer bytes.
    return base64.b64encode(gzip.compress(bytes(block), 6, mtime=0)).decode(), table


EXACT_NOTE = (
    "Away from the case's own plan, the contact of soft tissue with teeth and gums is "
    "extrapolated, not solved again. For the exact face, save the plan next to the case file "
    "and run:"
)


def page_text(
    content: PageContent, *, case_file: str = "case.toml", is_served: bool = False
) -> str:
    """The text of a planning page.

    Parameters
    ----------
    content : PageContent
    case_file : str
        The name of the case file in the command that solves a plan exactly.
    is_served : bool
        Whether the page requests exact solutions from the program that serves it; otherwise it
        makes no connection.

    Raises
    ------
    CaseError
        (also `ValueError`) Numbers that are not finite.

    Examples
    --------
    >>> import cmfsim
    >>> text = cmfsim.page_text(content)  # doctest: +SKIP
    """
    values = {
        **content.values,
        "case_file": shlex.quote(case_file),
        "exact_note": EXACT_NOTE,
        "is_served": is_served,
    }
    case, model, version = (str(content.values[key]) for key in ("case", "model", "version"))
    state = str(content.values["built_for"])
    return document_text(
        Document(
            title=f"{case}: planning page",
            facts=f"Model {model}. Forwards is −P, up +S, left is the patient's left; "
            "mm and degrees.",
            footer=f"Made by cmfsim {version} for case {case} in the state {state[:12]}. The page "
            "loads nothing from elsewhere and sends nothing.",
            stage="Face and bones",
            panel="Plan and measures",
            picture="The face under the plan. Arrow keys rotate it, plus and minus zoom, 1 to 6 "
            "choose a view.",
            made_for=state,
            values=values,
            arrays=content.arrays,
            is_served=is_served,
        )
    )
