"""The clinical figures of a prediction: its measures before and as planned, and how sites move."""

import itertools
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.planning.face_measures import sites as face
from cmfsim.planning.face_measures.cephalometry import (
    BITES,
    CEPHALOMETRIC_MEASURES,
    cephalometry,
    missing_sites,
    projected,
)
from cmfsim.planning.face_measures.definitions import MEASURES, Measure, measure_sites
from cmfsim.planning.face_measures.occlusion import (
    FOUND_MOLARS,
    OCCLUSAL_MEASURES,
    BiteFrame,
    bite_frame,
    missing_for_occlusion,
    occlusion,
)
from cmfsim.planning.occlusion.molars import first_molars
from cmfsim.planning.occlusion.rows import bite_sites, patient_rows, rigid_of
from cmfsim.surfaces.depth import distances
from cmfsim.values.anatomy import BoneSegment
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import profile_sites, short_name, tooth_of
from cmfsim.values.motion import carried
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import Prediction

Values = Mapping[str, float | None]
# Sites that only locate the occlusal plane.
TARGET = "Lower teeth off the target bite"
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
            [_with_error(measure, before) for measure in OCCLUSAL_MEASURES],
            occlusion(before),
            occlusion(after, before),
            missing_for_occlusion(before, unfound_molars(patient)),
        )
        + _off_target(prediction),
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


def lateral_sites(prediction: Prediction) -> tuple[dict[str, Floats], dict[str, Floats], BiteFrame]:
    """The sites of bone and skin in the lateral view, (2,) mm, before and as planned; its frame."""
    bone, skin = bone_sites(prediction.patient), prediction.patient.landmarks.get("skin", {})
    at_rest = {name: site.place for name, site in bone.items()}
    before = projected(at_rest)
    planned = projected(face.moved_bone_sites(prediction, bone), at_rest)
    frame = bite_frame(at_rest)
    places = np.array([*skin.values()]).reshape(-1, 3)
    for sites, points in ((before, places), (planned, places + prediction.carried(places))):
        flat = points @ np.stack([frame.forwards, frame.up]).T
        sites.update(zip((short_name("skin", name) for name in skin), flat, strict=True))
    return before, planned, frame


def bone_sites(patient: PatientModel) -> dict[str, face.BoneSite]:
    """The sites of the skull on their segments, and the cusps and molars that the bone shows."""
    skull = patient.landmarks.get("skull", {}) if patient.segments else {}
    sites = {}
    for name, place in skull.items():

        def away(segment: BoneSegment, place: Any = place) -> float:
            return float(distances(place[None], segment.surface.searched)[0])

        sites[name] = face.BoneSite(place, min(patient.segments, key=away).name)
    with suppress(CaseInputError):
        given, rows = profile_sites(skull), patient_rows(patient)
        for name, (place, segment) in bite_sites(*rows).items():
            if name not in given:
                sites[name] = face.BoneSite(place, segment)
        # One cusp of a tooth is given, or it is found.
        teeth = {tooth[:2] for name in skull if (tooth := tooth_of(name)) is not None}
        for name, tooth in FOUND_MOLARS.items():
            row = rows["UL".index(tooth[0][0])]
            found = first_molars(row)[tooth[1]]
            if tooth[:2] not in teeth and not isinstance(found, str):
                sites[name] = face.BoneSite(found, row.segment)
    return sites


def unfound_molars(patient: PatientModel) -> dict[str, str]:
    """Why first molars of a side were not found, by the key of the molar relation."""
    if not patient.segments:
        return {}
    try:
        rows = patient_rows(patient)
        reasons = [(row.arch.jaw, first_molars(row)) for row in rows]
    except CaseInputError as error:
        return dict.fromkeys(("molar_left", "molar_right"), str(error))
    return {
        f"molar_{side}": "; ".join(
            f"{jaw}: {found[side[0].upper()]}"
            for jaw, found in reasons
            if isinstance(found[side[0].upper()], str)
        )
        for side in ("left", "right")
    }


def _off_target(prediction: Prediction) -> list[dict[str, Any]]:
    """How far the lower teeth are from the bite of the case's scans; nothing without scans."""
    target = prediction.patient.summary.get("target_bite")
    if target is None:
        return []
    places, into = np.array(target["places"]), np.array(target["motion"])
    plan = prediction.scene.plan
    upper, lower = (rigid_of(plan.get(target[jaw])) for jaw in ("upper", "lower"))
    before, planned = (
        float(np.linalg.norm(carried(up @ into, places) - carried(low, places), axis=1).max())
        for up, low in ((np.eye(4), np.eye(4)), (upper, lower))
    )
    text = {"label": TARGET, "unit": "mm", "norm": "0", "source": "scans of [bite]"}
    return [{**text, "before": before, "planned": planned, "absent": ""}]


def _with_error(measure: Measure, sites: Collection[str]) -> Measure:
    """A measure that states how far off it is where molars were found."""
    side = measure.key.removeprefix("molar_")
    if not any(f"{tooth}-{side}" in sites for tooth in ("U6", "L6")):
        return measure
    return replace(measure, source=f"{measure.source}; molars found on the crowns: ± 1.5 mm")


def _rows(
    measures: Iterable[Measure], before: Values, planned: Values, absent: Mapping[str, str]
) -> list[dict[str, Any]]:
    return [
        {name: getattr(m, name) for name in ("label", "unit", "norm", "source")}
        | {"before": before[m.key], "planned": planned[m.key], "absent": absent[m.key]}
        for m in measures
    ]
