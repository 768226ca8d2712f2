"""The part of a head that the name of a file or of a scene's node refers to."""

import itertools
import json
import re
import unicodedata
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from importlib.resources import files

# Words that programs and people use, without accents: English, then German, French, Spanish,
# Italian and Dutch. "schaedel" and "schadel" are the two ways to write an umlaut without it.
# "no_bone" are parts that are no bone of a case, "either_jaw" words for the lower jaw where
# "inferior" stands with them, "registers" those of a transform that moves no bone.
KNOWN: Mapping[str, frozenset[str]] = {
    name: frozenset(" ".join(rows).split())
    for name, rows in json.loads(
        files("cmfsim.drafting").joinpath("part_words.json").read_text(encoding="utf-8")
    ).items()
}
# The first of these that a head has holds the row of teeth.
JAWS_OF_TEETH = {
    "upper teeth": ("maxilla", "midface", "cranium", "bone"),
    "lower teeth": ("mandible", "mandible_body", "bone"),
}
# Segments that a plan may move; the cranium holds the head.
MOVING = ("maxilla", "midface", "mandible", "mandible_body", "ramus_left", "ramus_right", "chin")
# A name in two cases, or with digits, holds several words.
WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
UMLAUTS = str.maketrans({"ß": "ss", "œ": "oe", "æ": "ae"})
# Teeth by their numbers (ISO 3950): the first digit is the quadrant, 1, 2, 5 and 6 the upper ones.
TOOTH_NUMBER = re.compile(r"[1-8][1-8]")
UPPER_QUADRANTS = "1256"


@dataclass(frozen=True)
class NameRole:
    """The meaning of a name, and the word in it that shows it; `is_after`: after the operation.

    part: "skin", "bone" (a skull with its jaw), "cranium", one of `MOVING`, "upper teeth", "lower
        teeth", "teeth" (of an unknown jaw), "other" (no bone of a case), or empty: not said.
    registers: Of a transform: it brings data together, and is no plan.
    """

    part: str
    is_after: bool = False
    registers: bool = False
    word: str = ""


def name_role(name: str) -> NameRole:
    """The meaning of a file's name without its ending, or of the name of a node."""
    letters = unicodedata.normalize("NFKD", name.translate(UMLAUTS))
    plain = "".join(c for c in letters if not unicodedata.combining(c))
    words = [word.lower() for word in WORDS.findall(re.sub(r"[&+]", " and ", plain))]
    # le fort 1, soft tissue, post op: two or three words for one.
    pairs = [a + b for a, b in itertools.pairwise(words)]
    triples = [a + b for a, b in zip(pairs, words[2:], strict=False)]
    found = {*words, *pairs, *triples}
    part, word = _part(found)
    return NameRole(part, bool(found & KNOWN["after"]), bool(found & KNOWN["registers"]), word)


def _part(words: set[str]) -> tuple[str, str]:
    """The part that words name, and the word that does; the more special comes first."""

    def said(known: AbstractSet[str]) -> str:
        return min(words & known, default="")

    if word := said(KNOWN["no_bone"]):
        return "other", word
    if word := said(KNOWN["teeth"]):
        # "Mandible with teeth" is the bone, "mandibular teeth" are its teeth.
        rest = words - KNOWN["teeth"] - KNOWN["joining"] if words & KNOWN["joining"] else set()
        bone = _part(rest)
        return bone if bone[0] else (_row(words), word)
    if word := said(KNOWN["chin"]):
        return "chin", word
    if word := said(KNOWN["ramus"]):
        left, right = bool(words & KNOWN["left"]), bool(words & KNOWN["right"])
        if left != right:
            return ("ramus_left" if left else "ramus_right"), word
        return "", word
    # A part, the words that say it, and those of which one has to stand beside them.
    rules = (
        ("mandible_body", KNOWN["distal"] | KNOWN["body"], KNOWN["mandible"]),
        ("cranium", KNOWN["cranium"], words),
        ("midface", KNOWN["midface"], words),
        ("mandible", KNOWN["either_jaw"], KNOWN["lower"]),
        ("maxilla", KNOWN["maxilla"] - {"jaw"}, words),
        ("maxilla", KNOWN["jaw"], KNOWN["upper"]),
        ("mandible", KNOWN["mandible"] - {"jaw"}, words),
        ("mandible", KNOWN["jaw"], KNOWN["lower"]),
        ("mandible", {"jaw"}, words),
        ("mandible_body", KNOWN["distal"], words),
        ("skin", KNOWN["skin"], words),
        ("skin", {"head"}, words),
        ("bone", KNOWN["bone"], words),
    )
    found = ((part, said(own)) for part, own, beside in rules if words & beside)
    return next((entry for entry in found if entry[1]), ("", ""))


def _row(words: set[str]) -> str:
    """Upper or lower teeth, by words or by the numbers of teeth; else "teeth"."""
    quadrants = {word[0] for word in words if TOOTH_NUMBER.fullmatch(word)}
    upper = bool(words & KNOWN["upper"]) or bool(quadrants & set(UPPER_QUADRANTS))
    lower = bool(words & KNOWN["lower"]) or bool(quadrants - set(UPPER_QUADRANTS))
    if upper == lower:
        return "teeth"
    return "upper teeth" if upper else "lower teeth"


def safe_key(name: str) -> str:
    """A name that is valid for a bone in a case file: letters, digits, '_', '-' and '+'."""
    key = "".join(c if c.isalnum() or c in "_-+" else "_" for c in name)[:60].strip("_")
    return key or "part"
