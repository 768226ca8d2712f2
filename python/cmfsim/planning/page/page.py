"""The text of the planning page: scripts, style and numbers in one file, nothing from elsewhere.

The scripts are ES modules in their own files; they are joined in the order of their imports. The
policy of the page allows these very scripts and this style, by their hashes, and no network.
"""

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping
from importlib.resources import files

from cmfsim.errors import CaseInputError
from cmfsim.planning.page.content import PageContent
from cmfsim.planning.page.packing import packed_arrays

__all__ = ["page_text"]

MAIN = "main.js"
DISCLAIMER = "Research software, not a medical device. Not for diagnosis or treatment decisions."
IMPORT = re.compile(r'^import \{[^}]*\} from "\./([a-z_]+\.js)";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:function|const|class)\b)", re.MULTILINE)
# A name that a module defines at its top.
DEFINED = re.compile(r"^(?:export )?(?:async )?(?:function|const|let|class) (\w+)", re.MULTILINE)
FIELD = re.compile(r"@([a-z]+)@")
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

    Returns
    -------
    str

    Raises
    ------
    CaseError
        (also `ValueError`) Numbers that are not finite.

    Examples
    --------
    >>> import cmfsim
    >>> text = cmfsim.page_text(content)  # doctest: +SKIP
    """
    package = files("cmfsim.planning.page")
    numbers, table = packed_arrays(content.arrays)
    values = {
        **content.values,
        "arrays": table,
        "case_file": _argument(case_file),
        "exact_note": EXACT_NOTE,
        "is_served": is_served,
    }
    style = package.joinpath("page.css").read_text(encoding="utf-8")
    script = joined_scripts(
        {
            entry.name: entry.read_text(encoding="utf-8")
            for entry in package.joinpath("scripts").iterdir()
            if entry.name.endswith(".js")
        }
    )
    case, model, version = (str(content.values[key]) for key in ("case", "model", "version"))
    fields = {
        "policy": _policy(script, style, is_served=is_served),
        "state": html.escape(str(content.values["built_for"])),
        "title": html.escape(f"{case}: planning page"),
        "facts": html.escape(
            f"Model {model}. Forwards is −P, up +S, left is the patient's left; mm and degrees."
        ),
        "disclaimer": DISCLAIMER,
        "footer": html.escape(
            f"Made by cmfsim {version} for case {case} in the state "
            f"{str(content.values['built_for'])[:12]}. The page loads nothing from elsewhere and "
            "sends nothing."
        ),
        "style": style,
        "script": script,
        "values": _json_in_html(values),
        "numbers": numbers,
    }
    template = package.joinpath("page.html").read_text(encoding="utf-8")
    # In one pass, so that no text is searched for the fields of another.
    return FIELD.sub(lambda match: fields[match[1]], template)


def joined_scripts(modules: Mapping[str, str]) -> str:
    """The modules as one script, each after those that it imports.

    Raises
    ------
    CaseError
        (also `ValueError`) Modules import each other in a circle, or one that is not there; two
        define the same name.
    """
    order: list[str] = []

    def add(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise CaseInputError(f"scripts import each other: {' → '.join((*above, name))}")
        if name not in modules:
            raise CaseInputError(f"{above[-1] if above else MAIN}: there is no script {name!r}")
        for needed in IMPORT.findall(modules[name]):
            if needed not in order:
                add(needed, (*above, name))
        if name not in order:
            order.append(name)

    add(MAIN, ())
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


def _argument(name: str) -> str:
    """A file name as a word of a shell, on Linux and macOS."""
    plain = re.fullmatch(r"[A-Za-z0-9_./-]+", name) is not None and not name.startswith("-")
    return name if plain else "'" + name.replace("'", "'\\''") + "'"
