"""The text of the planning page."""

import re

from cmfsim.planning.page.content import PageContent
from cmfsim.planning.page.document import Document, document_text

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
        "case_file": _argument(case_file),
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


def _argument(name: str) -> str:
    """A file name as a word of a shell, on Linux and macOS."""
    plain = re.fullmatch(r"[A-Za-z0-9_./-]+", name) is not None and not name.startswith("-")
    return name if plain else "'" + name.replace("'", "'\\''") + "'"
