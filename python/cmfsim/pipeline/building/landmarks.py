"""Landmarks of a case that gives none: found on its head, and where they come from in words."""

from typing import Any

from cmfsim.errors import LandmarkError, LandmarkInputError
from cmfsim.io import Case
from cmfsim.pipeline.building.parts import Head
from cmfsim.pipeline.building.stages import Stages
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.finding import Finding
from cmfsim.values.proposed_landmarks import ProposedLandmarks

__all__ = ["found_landmarks", "landmark_summary"]


def found_landmarks(case: Case, anatomy: Anatomy, stages: Stages, *, is_read: bool) -> Head:
    """A head with the landmarks found on it, by which its jaws may be separated.

    Without any, with a warning, where it shows no face: what cannot do without landmarks (muscles,
    standard procedures) is refused where it is reached.

    Parameters
    ----------
    case : Case
    anatomy : Anatomy
    stages : Stages
    is_read : bool
        Whether the anatomy was made of the case's own files: the jaws of another one stay.

    Raises
    ------
    LandmarkError
        (also `ValueError`) What was taken for the mandible in the image cannot be one.
    """
    # A case with landmarks loads nothing of the synthetic heads that others are compared with.
    from cmfsim.pipeline.proposing import BY_SHAPE, proposed_head  # noqa: PLC0415

    stages.begin("finding the landmarks")
    try:
        head = proposed_head(case, anatomy, stages.begin, is_read=is_read)
    except LandmarkError as error:
        stages.add(
            [
                Finding(
                    "landmarks-not-found",
                    f"the case names no landmarks, and none were found automatically: {error}",
                    where="landmarks",
                )
            ]
        )
        return Head(case, {}, anatomy)
    found = head.landmarks
    if found.impossible_jaw and case.image is not None:
        raise LandmarkInputError(
            f"{case.where('image.file')}: the jaws in the image could not be separated, because "
            f"the part taken for the mandible is not one: {found.impossible_jaw}. Place the "
            "landmarks of the skull by hand (menton, gonion, supradentale, infradentale, "
            "occlusal_line, ...) and name the file under [landmarks], or give surfaces of both "
            "bones"
        )
    if head.anatomy is not anatomy:
        stages.drop({BY_SHAPE})
    stages.add(head.findings)
    stages.add(found.findings)
    return Head(case, found.points, head.anatomy, found, head.skin)


def landmark_summary(found: ProposedLandmarks) -> dict[str, Any]:
    """Where landmarks come from, for the summary of a model."""
    return {
        "source": "found automatically",
        **{
            kind: {
                name: {"error": round(site.error, 2), "doubt": site.doubt}
                for name, site in sites.items()
            }
            for kind, sites in (("skull", found.skull), ("skin", found.skin))
        },
        "missing": [*found.missing_skull, *(f"{name} (skin)" for name in found.missing_skin)],
    }
