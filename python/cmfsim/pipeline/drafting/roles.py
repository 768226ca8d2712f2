"""The part of a head that the name of a file or of a scene's node refers to."""

import itertools
import re
from dataclasses import dataclass

__all__ = ["MOVING", "NameRole", "name_role", "safe_key"]

# Parts that are no bone of a case, by the words that programs and people use.
NO_BONE = frozenset(
    ("teeth", "tooth", "canal", "airway", "sinus", "tongue", "muscle", "muscles", "plate", "plates")
    + ("screw", "screws", "splint", "guide", "plane", "planes", "eye", "eyes", "brain", "vertebra")
    + ("vertebrae", "spine", "cartilage", "implant", "couch", "predicted")
)
AFTER = frozenset(
    ("post", "postop", "postoperative", "after", "achieved", "postsurgery", "postsurgical")
)
SKIN = frozenset(["skin", "face", "softtissue", "softtissues", "epidermis", "soft"])
CRANIUM = frozenset(["cranium", "cranial", "skull", "neurocranium"])
MANDIBLE = frozenset(["mandible", "mandibula", "mandibular", "jaw"])
MAXILLA = frozenset(["maxilla", "maxillary", "lefort", "lefort1", "lf1", "upperjaw"])
MIDFACE = frozenset(["midface", "lefort3", "lf3"])
CHIN = frozenset(["chin", "genio", "genioplasty"])
RAMUS = frozenset(["ramus", "proximal", "condyle", "condylar"])
BONE = frozenset(["bone", "bones", "skeleton"])
LEFT, RIGHT = frozenset(("left", "l", "lt")), frozenset(("right", "r", "rt"))
# Words of a transform that brings data together, and moves no bone.
REGISTERS = frozenset(
    ("registration", "register", "registered", "align", "alignment", "aligned", "icp")
)
# Segments that a plan may move; the cranium holds the head.
MOVING = (
    "maxilla",
    "midface",
    "mandible",
    "mandible_body",
    "ramus_left",
    "ramus_right",
    "chin",
)
# A name in two cases, or with digits, holds several words.
WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-zà-ÿ]+|\d+")


@dataclass(frozen=True)
class NameRole:
    """The meaning of a name.

    Attributes
    ----------
    part : str
        "skin", "bone" (a skull with its jaw), "cranium", one of `MOVING`, "other" (no bone of a
        case), or empty: the name does not say it.
    is_after : bool
        Of the patient after the operation.
    registers : bool
        Of a transform: it brings data together, and is no plan.
    word : str
        What in the name says it.
    """

    part: str
    is_after: bool = False
    registers: bool = False
    word: str = ""


def name_role(name: str) -> NameRole:
    """The meaning of a file's name without its ending, or of the name of a node.

    Examples
    --------
    >>> name_role("Maxilla_postOp").part, name_role("Maxilla_postOp").is_after
    ('maxilla', True)
    """
    words = [word.lower() for word in WORDS.findall(name)]
    # le fort 1, soft tissue, post op: two or three words for one.
    pairs = [a + b for a, b in itertools.pairwise(words)]
    triples = [a + b for a, b in zip(pairs, words[2:], strict=False)]
    found = {*words, *pairs, *triples}
    part, word = _part(found)
    return NameRole(part, bool(found & AFTER), bool(found & REGISTERS), word)


def _part(words: set[str]) -> tuple[str, str]:
    """The part that words name, and the word that does; the more special comes first."""

    def said(known: frozenset[str]) -> str:
        return min(words & known, default="")

    if word := said(NO_BONE):
        return "other", word
    if word := said(CHIN):
        return "chin", word
    if word := said(RAMUS):
        left, right = bool(words & LEFT), bool(words & RIGHT)
        if left != right:
            return ("ramus_left" if left else "ramus_right"), word
        return "", word
    if words & MANDIBLE and words & {"body", "distal"}:
        return "mandible_body", said(frozenset(("body", "distal")))
    if word := said(CRANIUM):
        return "cranium", word
    if word := said(MIDFACE):
        return "midface", word
    if (word := said(MAXILLA)) or {"upper", "jaw"} <= words:
        return "maxilla", word or "upper jaw"
    if word := said(MANDIBLE):
        return "mandible", word
    if "distal" in words:
        return "mandible_body", "distal"
    if word := said(SKIN):
        return "skin", word
    if word := said(BONE):
        return "bone", word
    return "", ""


def safe_key(name: str) -> str:
    """A name that is valid for a bone in a case file: letters, digits, '_', '-' and '+'."""
    key = "".join(c if c.isalnum() or c in "_-+" else "_" for c in name)[:60].strip("_")
    return key or "part"
