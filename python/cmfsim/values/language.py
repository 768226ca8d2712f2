"""Texts in the reader's language: GNU gettext, with one catalogue for the process.

Texts are English wherever they are made and stored, and are translated where they are shown: in
reports and pages, and on the terminal. What programs read stays English.

The catalogue is LANGUAGE/LC_MESSAGES/cmfsim.mo in the package's folder `locale`, or in the folder
that the variable CMFSIM_LOCALE names; `scripts/extract_texts.py` collects its messages. The
language is that of CMFSIM_LANGUAGE, else of LANGUAGE, LC_ALL, LC_MESSAGES or LANG. In a message
{0}, {1} … are values, in the order of the English text.
"""

import gettext
import logging
import os
import re
import struct
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from importlib.resources import files

DOMAIN = "cmfsim"
# A value in a message.
VALUE = re.compile(r"\{(\d+)\}")
# A text without the marks after it, and without figures and marks around it.
AROUND = (
    re.compile(r"()(.*?)([.;:,\s]*)", re.DOTALL),
    re.compile(r"([\W\d_]*)(.*?)([\W\d_]*)", re.DOTALL),
)
# Where texts are joined, first the larger ones.
JOINTS = tuple(
    re.compile(rf"({j})") for j in (r"\n", r"(?<=\.)\s", r";\s", r"\s(?=[(\[])", r"[:,]\s")
)
# A message fits a text if it has so many letters at the start or end, or this share of all.
AT_START, AT_END, LEAST_SHARE = 4, 12, 0.36
# Characters by which messages are looked up; joints between sentences.
KEY, SENTENCES = 4, 3
# Longer texts are data, such as pictures.
MOST_CHARACTERS = 4000
_log = logging.getLogger(__name__)


@cache
def catalogue() -> Mapping[str, str]:
    """The translation of each message, and under "" the header; empty for English."""
    named = os.environ.get("CMFSIM_LANGUAGE")
    folder = os.environ.get("CMFSIM_LOCALE") or str(files("cmfsim").joinpath("locale"))
    place = gettext.find(DOMAIN, folder, [named] if named else None)
    if place is None:
        if named and named != "en":
            text = "there is no catalogue of CMFSIM_LANGUAGE=%s in %s: texts are English"
            _log.warning(text, named, folder)
        return {}
    found: Mapping[str, str]
    try:
        with open(place, "rb") as file:  # noqa: PTH123 (the name that gettext found)
            found = vars(gettext.GNUTranslations(file))["_catalog"]
    except (OSError, struct.error, ValueError, LookupError, AttributeError) as error:
        _log.warning("%s: is no catalogue of GNU gettext (%s): texts are English", place, error)
        return {}
    return found


def language() -> str:
    """The language of the texts as the header of the catalogue states it, such as "pt-BR"."""
    header = re.search(r"^Language: *(\w+)", catalogue().get("", ""), re.MULTILINE)
    return header[1].replace("_", "-") if header else "en"


@lru_cache(maxsize=4096)
def translated(text: str) -> str:
    """The text in the reader's language; what the catalogue lacks stays English.

    A text with its values filled in is found by its message, and its values are translated as
    well. A text without a message is translated sentence by sentence, or item by item.
    """
    known = catalogue()
    if not known or len(text) > MOST_CHARACTERS or not any(map(str.isalpha, text)):
        return text
    if text in known:
        return known[text]
    templates = _templates()
    fitting = (
        (message, values)
        for message, parts in (*templates.get(text[:KEY], ()), *templates[""])
        if (values := _values(parts, text)) is not None and _fits(parts, values)
    )
    message, values = next(fitting, ("", []))
    if message:
        return VALUE.sub(lambda match: translated(values[int(match[1])]), known[message])
    return _joined(text, JOINTS[:SENTENCES]) or _core(text) or _joined(text, JOINTS) or text


def _joined(text: str, joints: Sequence[re.Pattern[str]]) -> str:
    """A text translated part by part; empty if it has no parts."""
    split = (joint.split(text) for joint in joints)
    return "".join(map(translated, next((parts for parts in split if len(parts) > 1), [])))


def _core(text: str) -> str:
    """A text translated without the marks and figures around it; empty if it has none."""
    for around in AROUND:
        before, core, after = around.fullmatch(text).groups()  # type: ignore[union-attr]
        if core != text:
            return f"{before}{translated(core)}{after}"
    return ""


def script_texts(script: str) -> dict[str, str]:
    """The translations of the messages in a script of a page."""
    return {
        message: text
        for message, text in catalogue().items()
        if message and all(part in script for part in VALUE.split(message)[::2])
    }


@cache
def _templates() -> dict[str, list[tuple[str, list[str]]]]:
    """Messages with values and the texts between these, by how they begin; the longest first."""
    found: dict[str, list[tuple[str, list[str]]]] = {"": []}
    for message in sorted(catalogue(), key=_letters, reverse=True):
        parts = VALUE.split(message)[::2]
        if len(parts) > 1:
            key = parts[0][:KEY] if len(parts[0]) >= KEY else ""
            found.setdefault(key, []).append((message, parts))
    return found


def _fits(parts: list[str], values: list[str]) -> bool:
    """Whether a text with these values is the message, not another that shares some words."""
    letters = _letters("".join(parts))
    if letters >= LEAST_SHARE * (letters + _letters("".join(values))):
        return True
    is_anchored = _letters(parts[0]) >= AT_START or _letters(parts[-1]) >= AT_END
    return is_anchored and not any(JOINTS[i].search(v) for v in values for i in range(SENTENCES))


def _letters(text: str) -> int:
    return sum(map(str.isalpha, text))


def _values(parts: list[str], text: str) -> list[str] | None:
    """What stands in a text between the parts of a message; None if it is another message."""
    first, *middle, last = parts
    if not (text.startswith(first) and text.endswith(last)):
        return None
    start, end, values = len(first), len(text) - len(last), []
    for part in middle:
        at = text.find(part, start, end)
        if at < 0:
            return None
        values.append(text[start:at])
        start = at + len(part)
    return [*values, text[start:end]] if start <= end else None
