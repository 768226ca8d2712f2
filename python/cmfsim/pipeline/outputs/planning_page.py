"""The planning page as a file of a case: written, and recognised by what it was made for."""

import os
import re
from pathlib import Path

from cmfsim.io import replacing
from cmfsim.planning.page import PageContent, page_text

# The page, and the plan for a desired face that is saved next to it.
PAGE_FILE, PLAN_FILE = "plan.html", "towards.toml"
STATE = re.compile(rb'<meta name="cmfsim-made-for" content="([0-9a-f]{64})">')
# The state stands before the style and scripts.
HEAD_BYTES = 2048


def write_planning_page(
    path: str | os.PathLike[str], content: PageContent, *, case_file: str = "case.toml"
) -> int:
    """The size in bytes of a planning page, written to a file in one step.

    Raises
    ------
    CaseError
        (also `ValueError`) Numbers that are not finite.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_planning_page("plan.html", content)  # doctest: +SKIP
    5550695
    """
    data = page_text(content, case_file=case_file).encode()
    with replacing(Path(path)) as file:
        file.write(data)
    return len(data)


def page_state(path: str | os.PathLike[str]) -> str | None:
    """What the planning page at a path was made for (`plan_key`); None where there is no page.

    Raises `OSError`: The file is there and cannot be read.
    """
    if not Path(path).is_file():
        return None
    with Path(path).open("rb") as file:
        found = STATE.search(file.read(HEAD_BYTES))
    return None if found is None else found[1].decode()
