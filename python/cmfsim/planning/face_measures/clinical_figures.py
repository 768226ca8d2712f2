"""The clinical figures of a prediction: its measures before and as planned, and how sites move."""

import itertools
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.planning.face_measures import sites as face
from cmfsim.planning.face_measures.cephalometry import (
    BITES,
    CEPHALOMETRIC_MEASURES,
    cephalometry,
    missing_sites,
)
from cmfsim.planning.face_measures.definitions import MEASURES, Measure, measure_sites
from cmfsim.planning.face_measures.occlusion import (
    OCCLUSAL_MEASURES,
    missing_for_occlusion,
    occlusion,
)
from cmfsim.planning.occlusion import bite_sites, patient_rows
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.landmark_sites import profile_sites
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import Prediction

Values = Mapping[str, float | None]
# Sites that only locate the occlusal plane.
BITE = frozenset(itertools.chain(*BITES[1]))


def clinical_figures(prediction: Prediction) -> dict[str, Any]:
    """The clinical figures of a prediction: plain values, ready for JSON.

    Sites of bone move with the segment nearest to them, sites of the skin with the predicted skin.

    Returns
    -------
    dict
        "occlusion", "cephalometry" and "face": measures, each with `label`, `unit`, `norm`,
        `source`, `before` and `planned`, and where these are None why, as `absent`. "sites":
        landmarks with `name`, `moves_with` (a segment, or "skin"), `forwards_mm`, `up_mm` and
        `left_mm`.

    Examples
    --------
    >>> import cmfsim
    >>> figures = cmfsim.clinical_figures(prediction)["cephalometry"]
    >>> [measure["label"] for measure in figures][:3]
    ['SNA', 'SNB', 'ANB']
    """
    patient = prediction.patient
    bone, sites = bone_sites(patient), face.face_sites(patient)
    before = {name: site.place for name, site in bone.items()}
    after = face.moved_bone_sites(prediction, bone)
    at_rest = {**sites.skin, **{name: site.place for name, site in sites.bone.items()}}
    skin = {**patient.landmarks.get("skin", {}), **sites.skin}
    moved = prediction.carried(np.array([*skin.values()])) if skin else np.zeros((0, 3))
    shifts = [
        (name, bone[name].segment, after[name] - before[name]) for name in after if name not in BITE
    ]
    shifts += [(f"{name} (skin)", "skin", m) for name, m in zip(skin, moved, strict=True)]
    ways = ("forwards_mm", "up_mm", "left_mm")
    return {
        "occlusion": _rows(
            OCCLUSAL_MEASURES,
            occlusion(before),
            occlusion(after, before),
            missing_for_occlusion(before),
        ),
        "cephalometry": _rows(
            CEPHALOMETRIC_MEASURES,
            cephalometry(before),
            cephalometry(after, before),
            missing_sites(before),
        ),
        "face": _rows(
            MEASURES,
            measure_sites(at_rest),
            face.measure_face(prediction, sites),
            {m.key: sites.why_absent(m.sites) for m in MEASURES},
        ),
        "sites": [
            {"name": name, "moves_with": part, **dict(zip(ways, (-y + 0.0, z, x), strict=True))}
            for name, part, shift in shifts
            for x, y, z in [shift.tolist()]
        ],
    }


def bone_sites(patient: PatientModel) -> dict[str, face.BoneSite]:
    """The sites of the skull on their segments, and the cusps that the bone shows."""
    skull = patient.landmarks.get("skull", {}) if patient.segments else {}
    sites = {}
    for name, place in skull.items():

        def away(segment: BoneSegment, place: Any = place) -> float:
            closest = segment.surface.searched.closest(place[None])[0][0]
            return float(np.linalg.norm(closest - place))

        sites[name] = face.BoneSite(place, min(patient.segments, key=away).name)
    with suppress(CaseInputError):
        given = profile_sites(skull)
        for name, (place, segment) in bite_sites(*patient_rows(patient)).items():
            if name not in given:
                sites[name] = face.BoneSite(place, segment)
    return sites


def _rows(
    measures: Iterable[Measure], before: Values, planned: Values, absent: Mapping[str, str]
) -> list[dict[str, Any]]:
    return [
        {name: getattr(m, name) for name in ("label", "unit", "norm", "source")}
        | {"before": before[m.key], "planned": planned[m.key], "absent": absent[m.key]}
        for m in measures
    ]
