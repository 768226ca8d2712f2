"""The text of the page of landmarks."""

from cmfsim.planning.landmark_page.content import LandmarkContent
from cmfsim.planning.page.document import Document, document_text


def landmark_page_text(content: LandmarkContent) -> str:
    """The text of a page of landmarks, which loads nothing and sends nothing.

    Raises
    ------
    CaseError
        (also `ValueError`) Numbers that are not finite.

    Examples
    --------
    >>> import cmfsim
    >>> text = cmfsim.landmark_page_text(content)  # doctest: +SKIP
    """
    case, version = content.values["case"], content.values["version"]
    return document_text(
        Document(
            title=f"{case}: landmarks",
            facts="Choose a site in the list and click on the bone or skin where it is, or drag "
            "its ball. Sites that nobody has confirmed follow. L and R are the patient's sides.",
            footer=f"Made by cmfsim {version} for case {case}. The page loads nothing from "
            "elsewhere and sends nothing. Coordinates are LPS in mm.",
            stage="Skull and skin",
            panel="Landmarks",
            picture="Skull and skin with their landmarks. Arrow keys rotate, plus and minus zoom, "
            "1 to 6 choose a view.",
            made_for=str(content.values["built_for"]),
            values=content.values,
            arrays=content.arrays,
            package="cmfsim.planning.landmark_page",
            main="landmarks_main.js",
        )
    )
