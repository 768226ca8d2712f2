"""Landmarks of a case that gives none: found on its head, and where they come from in words."""

from typing import Any

from cmfsim.errors import LandmarkError
from cmfsim.io import Case
from cmfsim.pipeline.building.stages import Stages
from cmfsim.registration.proposed import ProposedLandmarks
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.finding import Finding

__all__ = ["found_landmarks", "landmark_summary"]


def found_landmarks(case: Case, anatomy: Anatomy, stages: Stages) -> ProposedLandmarks | None:
    """The landmarks found on a head, with findings; None, with a warning, where it shows no face.

    What cannot do without landmarks (muscles, standard procedures) is refused where it is reached.
    """
    # A case with landmarks loads nothing of the synthetic heads that others are compared with.
    from cmfsim.pipeline.proposing import proposed_for_case  # noqa: PLC0415

    stages.begin("finding the landmarks")
    try:
        found = proposed_for_case(case, anatomy)
    except LandmarkError as error:
        stages.add(
            [
                Finding.warning(
                    "landmarks-not-found",
                    f"no landmarks are given, and none were found automatically: {error}",
                    where="landmarks",
                    why="the region is placed by the head's depth, and contact of the teeth from "
                    "the image alone",
                    fix="place the landmarks by hand and name the files under [landmarks]",
                )
            ]
        )
        return None
    stages.add(found.findings)
    return found


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
