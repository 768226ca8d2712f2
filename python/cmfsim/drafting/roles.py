"""The part of a head that the name of a file or of a scene's node refers to."""

import itertools
import re
import unicodedata
from dataclasses import dataclass

# Words that programs and people use, without accents: English, then German, French, Spanish,
# Italian and Dutch. "schaedel" and "schadel" are the two ways to write an umlaut without it.
# Parts that are no bone of a case.
NO_BONE = frozenset(
    ("canal", "airway", "sinus", "tongue", "muscle", "muscles", "plate", "plates", "pulp")
    + ("screw", "screws", "splint", "guide", "plane", "planes", "eye", "eyes", "brain", "vertebra")
    + ("vertebrae", "spine", "cartilage", "implant", "couch", "predicted", "bridge", "pharynx")
    + ("kanal", "atemweg", "zunge", "muskel", "platte", "schiene", "hirn", "gehirn", "nerv")
    + ("wirbel", "wirbelsaule", "wirbelsaeule", "knorpel", "implantat", "langue", "lengua")
)
TEETH = frozenset(
    ("teeth", "tooth", "incisor", "canine", "premolar", "molar", "dentition")
    + ("zahn", "zahne", "zaehne", "zahnreihe", "dent", "dents", "diente", "dientes", "dente")
    + ("denti", "tand", "tanden", "gebit")
)
JOINING = frozenset(["with", "and", "including", "incl", "mit", "und", "avec", "et", "con", "met"])
UPPER = frozenset(
    ("upper", "maxillary", "maxilla", "oben", "obere", "oberer", "oberkiefer")
    + ("superieur", "superieure", "superieures", "sup", "superior", "superiores", "superiore")
    + ("superiori", "boven", "bovenste", "bovenkaak")
)
LOWER = frozenset(
    ("lower", "mandibular", "mandible", "unten", "untere", "unterer", "unterkiefer")
    + ("inferieur", "inferieure", "inferieures", "inf", "inferior", "inferiores", "inferiore")
    + ("inferiori", "onder", "onderste", "onderkaak")
)
# The first of these that a head has holds the row of teeth.
JAWS_OF_TEETH = {
    "upper teeth": ("maxilla", "midface", "cranium", "bone"),
    "lower teeth": ("mandible", "mandible_body", "bone"),
}
AFTER = frozenset(
    ("post", "postop", "postoperative", "after", "achieved", "postsurgery", "postsurgical")
    + ("postoperativ", "nachher", "nach", "apres", "postoperatoire", "despues", "dopo")
    + ("postoperatief",)
)
SKIN = frozenset(
    ("skin", "face", "softtissue", "softtissues", "epidermis", "soft", "haut", "gesicht")
    + ("gesichtshaut", "weichteil", "weichteile", "weichgewebe", "peau", "visage", "piel", "cara")
    + ("pelle", "cute", "viso", "huid", "gezicht")
)
CRANIUM = frozenset(
    ("cranium", "cranial", "skull", "neurocranium", "schadel", "schaedel", "hirnschadel")
    + ("hirnschaedel", "crane", "craneo", "cranio", "teschio", "schedel")
)
MANDIBLE = frozenset(
    ("mandible", "mandibula", "mandibular", "jaw", "unterkiefer", "unterkieferknochen")
    + ("mandibule", "mandibulaire", "mandibola", "mandibolare", "onderkaak")
)
MAXILLA = frozenset(
    ("maxilla", "maxillary", "lefort", "lefort1", "lf1", "upperjaw", "upperjawbone")
    + ("oberkiefer", "oberkieferknochen", "maxillaire", "maxilar", "mascella", "bovenkaak")
)
MIDFACE = frozenset(["midface", "lefort3", "lf3", "mittelgesicht"])
CHIN = frozenset(["chin", "genio", "genioplasty", "kinn", "kinnplastik", "menton", "mento", "kin"])
RAMUS = frozenset(
    ("ramus", "proximal", "condyle", "condylar", "proximales", "kieferast", "unterkieferast")
    + ("gelenkfortsatz", "kondylus", "branche", "rama", "ramo", "condilo")
)
JAW = frozenset(["jaw", "jawbone", "kiefer", "machoire", "mascellare", "kaak"])
DISTAL = frozenset(["distal", "distales"])
BODY = frozenset(["body", "corpus", "korper", "koerper", "corps", "cuerpo", "corpo", "lichaam"])
# Of the lower jaw, where "inferior" stands with them.
EITHER_JAW = frozenset(["maxillaire", "maxilar"])
BONE = frozenset(["bone", "bones", "skeleton", "knochen", "skelett", "hueso", "osso"])
LEFT = frozenset(
    ("left", "l", "lt", "links", "linke", "linker", "linkes", "gauche", "izquierda")
    + ("izquierdo", "sinistra", "sinistro")
)
RIGHT = frozenset(
    ("right", "r", "rt", "rechts", "rechte", "rechter", "rechtes", "droit", "droite", "derecha")
    + ("derecho", "destra", "destro")
)
# Words of a transform that brings data together, and moves no bone.
REGISTERS = frozenset(
    ("registration", "register", "registered", "align", "alignment", "aligned", "icp")
)
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
    """The meaning of a name.

    part: "skin", "bone" (a skull with its jaw), "cranium", one of `MOVING`, "upper teeth", "lower
        teeth", "teeth" (of which jaw, the name does not say), "other" (no bone of a case), or
        empty: the name does not say it.
    is_after: Of the patient after the operation.
    registers: Of a transform: it brings data together, and is no plan.
    word: What in the name says it.
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
    return NameRole(part, bool(found & AFTER), bool(found & REGISTERS), word)


def _part(words: set[str]) -> tuple[str, str]:
    """The part that words name, and the word that does; the more special comes first."""

    def said(known: frozenset[str]) -> str:
        return min(words & known, default="")

    if word := said(NO_BONE):
        return "other", word
    if word := said(TEETH):
        # "Mandible with teeth" is the bone, "mandibular teeth" are its teeth.
        bone = _part(words - TEETH - JOINING) if words & JOINING else ("", "")
        return bone if bone[0] else (_row(words), word)
    if word := said(CHIN):
        return "chin", word
    if word := said(RAMUS):
        left, right = bool(words & LEFT), bool(words & RIGHT)
        if left != right:
            return ("ramus_left" if left else "ramus_right"), word
        return "", word
    if words & MANDIBLE and (word := said(DISTAL | BODY)):
        return "mandible_body", word
    if word := said(CRANIUM):
        return "cranium", word
    if word := said(MIDFACE):
        return "midface", word
    if words & LOWER and (word := said(EITHER_JAW)):
        return "mandible", word
    for part, known, side in (("maxilla", MAXILLA, UPPER), ("mandible", MANDIBLE, LOWER)):
        if word := said(known - {"jaw"}):
            return part, word
        if words & side and (word := said(JAW)):
            return part, word
    if "jaw" in words:
        return "mandible", "jaw"
    if word := said(DISTAL):
        return "mandible_body", word
    if word := said(SKIN):
        return "skin", word
    if "head" in words:
        return "skin", "head"
    if word := said(BONE):
        return "bone", word
    return "", ""


def _row(words: set[str]) -> str:
    """Upper or lower teeth, by words or by the numbers of teeth; else "teeth"."""
    quadrants = {word[0] for word in words if TOOTH_NUMBER.fullmatch(word)}
    upper = bool(words & UPPER) or bool(quadrants & set(UPPER_QUADRANTS))
    lower = bool(words & LOWER) or bool(quadrants - set(UPPER_QUADRANTS))
    if upper == lower:
        return "teeth"
    return "upper teeth" if upper else "lower teeth"


def safe_key(name: str) -> str:
    """A name that is valid for a bone in a case file: letters, digits, '_', '-' and '+'."""
    key = "".join(c if c.isalnum() or c in "_-+" else "_" for c in name)[:60].strip("_")
    return key or "part"
