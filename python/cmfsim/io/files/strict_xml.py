"""XML of strangers: in UTF-8, without anything that could define entities."""

from pyexpat import XMLParserType
from xml.parsers import expat

from cmfsim.errors import CaseInputError


def strict_parser(text: bytes, separator: str | None = None) -> XMLParserType:
    """A parser for a text that refuses zero bytes, document types and entities.

    The encoding is UTF-8 whatever the text states: nothing hides behind another one. Entities could
    grow without bound.

    Parameters
    ----------
    text : bytes
        What will be parsed.
    separator : str, optional
        Between namespace and name; without one, namespaces are not resolved.

    Raises
    ------
    CaseError
        (also `ValueError`) The text holds zero bytes; while parsing, a document type or an entity.
    """
    if b"\0" in text:
        raise CaseInputError("is not XML in UTF-8: it holds zero bytes")
    parser = expat.ParserCreate("UTF-8", separator)

    def refuse(*_: object) -> None:
        raise CaseInputError("XML with a document type or entities is not read")

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    return parser
