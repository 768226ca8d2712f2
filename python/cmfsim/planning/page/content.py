"""The content of a planning page: surfaces, operator, sites, errors and band, as plain values."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cmfsim._core import __version__
from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.planning.face_measures.clinical_figures import bone_sites, unfound_molars
from cmfsim.planning.face_measures.definitions import MEASURES
from cmfsim.planning.face_measures.occlusion import (
    OCCLUSAL_MEASURES,
    bite_frame,
    missing_for_occlusion,
    occlusal_terms,
)
from cmfsim.planning.face_measures.profile import midline_profile
from cmfsim.planning.face_measures.sites import BoneSite, FaceSites, face_sites
from cmfsim.planning.page.arrays import Arrays, PageContent, add_surface, framing, indices, singles
from cmfsim.planning.page.row_overlap import row_overlap
from cmfsim.planning.page.segment_points import segment_points
from cmfsim.planning.replanning.expected_error import ExpectedError, segment_boxes
from cmfsim.planning.replanning.model import Motions, PlanningModel
from cmfsim.planning.replanning.plan_band import PlanBand
from cmfsim.surfaces.depth import barycentric
from cmfsim.values.anatomy import segment_colours
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.prediction import Prediction
from cmfsim.values.skin_motion import attachment
from cmfsim.values.surface_data import SurfaceData

# Triangles that the page draws of the face, and of all bones together.
FACE_TRIANGLES, BONE_TRIANGLES, LEAST_BONE = 40_000, 60_000, 500
# Largest number of skin nodes on a page: a larger file is slow to open and to send.
MOST_NODES = 60_000
# A node moves if a plan in the range moves it by this, mm: a tenth of the rounding error.
STILL = 4e-4
# The product of the page takes columns in steps of so many.
PRODUCT_STEP = 4
# Motions that decide whether a node moves: entries of R − I, and shifts in mm.
LARGE_TURN, LARGE_SHIFT = 0.5, 30.0
# How far behind its foremost point the profile is drawn, mm.
PROFILE_DEPTH = 60.0
# Pairs of the skin that jaw surgery does not move: they place the plane of the mirror image.
EYES = ("exocanthion", "endocanthion")


def page_content(
    planning: PlanningModel,
    reference: Prediction,
    errors: ExpectedError,
    *,
    variants: Mapping[str, Motions] | None = None,
    band: PlanBand | None = None,
) -> PageContent:
    """The content of the page of a planning model.

    Parameters
    ----------
    planning : PlanningModel
    reference : Prediction
        The exact solution of its reference plan.
    errors : ExpectedError
    variants : mapping of str to plan, optional
        Plans by name that the page shows at first, in addition to the reference.
    band : PlanBand, optional
        How far to trust the face, which follows the plan.

    Returns
    -------
    PageContent

    Raises
    ------
    CaseError
        (also `ValueError`) More nodes on the skin than a page can have.

    Examples
    --------
    >>> import cmfsim
    >>> exact = planning.solve(planning.reference)  # doctest: +SKIP
    >>> errors = cmfsim.expected_error(planning)  # doctest: +SKIP
    >>> content = cmfsim.page_content(planning, exact, errors)  # doctest: +SKIP
    """
    patient = planning.patient
    findings: list[Finding] = []
    skin = planning.skin_before
    count = len(skin.vertices)
    if count > MOST_NODES:
        raise CaseInputError(
            f"the skin has {count} nodes, but a page can have at most {MOST_NODES}: use a larger "
            "edge_length in [mesh], or --edge-length"
        )
    sites = face_sites(patient)
    arrays: Arrays = {"nodes": singles(skin.vertices), "skin_triangles": indices(skin.triangles)}
    whole = patient.face or skin
    face = _fewer(arrays, "face", "face", whole, FACE_TRIANGLES, findings=findings)
    arrays |= {
        **_operator(planning, reference),
        **_carried("face", skin, face.vertices),
        **_carried("site", skin, _rows(sites.skin.values())),
        "sites": singles(_rows(sites.skin.values())),
    }
    bones = _bones(planning, arrays, findings)
    band_values, band_arrays = band_content(band)
    arrays |= band_arrays
    profile = _profile(planning, face, arrays)
    teeth = _teeth(planning, arrays)
    values = {
        "case": patient.name,
        "model": planning.model,
        "version": __version__,
        "built_for": str(patient.summary.get("plan_key") or "a patient without a case file"),
        "segments": _segments(planning),
        "bones": bones,
        **_measured(planning, sites),
        "variants": [
            {"name": name, "motions": [m.ravel().tolist() for m in planning.whole(plan).values()]}
            for name, plan in (variants or {}).items()
        ],
        **profile,
        **teeth,
        "target_bite": _target_bite(planning),
        "expected_error": errors.as_dict(),
        "correction": _correction(planning),
        "band": band_values,
        "midplane": _midplane(planning.patient.landmarks.get("skin", {})),
        **framing(skin.vertices[arrays["active"]] if len(arrays["active"]) else skin.vertices),
    }
    return PageContent(values, arrays, tuple(findings))


def _rows(places: Any) -> Floats:
    return np.array([*places], dtype=np.float64).reshape(-1, 3)


def _fewer(
    arrays: Arrays, key: str, name: str, surface: SurfaceData, most: int, *, findings: list[Finding]
) -> SurfaceData:
    """The surface added to arrays, with a finding where it has more triangles than are drawn."""
    fewer, off = add_surface(arrays, key, name, surface, most)
    if fewer is not surface:
        findings.append(
            Finding(
                "page-simplified",
                f"{name} has {len(surface.triangles)} triangles; the page draws it with "
                f"{len(fewer.triangles)}, at most {off:.2f} mm away",
                where=name,
            )
        )
    return fewer


def _operator(planning: PlanningModel, reference: Prediction) -> Arrays:
    """The columns of the nodes that move, in half precision, and the reference in single.

    After the columns of the segments come the shapes of the correction, in fours as the product
    takes them.
    """
    columns, correction = planning.columns, planning.correction
    largest = np.tile([LARGE_TURN] * 9 + [LARGE_SHIFT] * 3, len(columns.segments))
    moves = (np.abs(columns.matrix) * largest).max(axis=2).max(axis=1) > STILL
    moves |= np.abs(columns.offset).max(axis=1) > STILL
    if correction is not None:
        moves |= np.abs(correction.shapes).max(axis=(1, 2)) > STILL
    active = np.flatnonzero(moves)
    rows = columns.matrix[active]
    plans = weights = np.zeros((0, 0))
    if correction is not None:
        plans = correction.plans.reshape(len(correction.plans), -1)
        spare = -correction.shapes.shape[2] % PRODUCT_STEP
        rows = np.concatenate(
            [rows, np.pad(correction.shapes[active], ((0, 0), (0, 0), (0, spare)))], axis=2
        )
        weights = np.pad(correction.weights, ((0, 0), (0, spare)))
    with np.errstate(over="ignore"):
        half = rows.astype(np.float16)
    return {
        "correction_plans": singles(plans),
        "correction_weights": singles(weights),
        "active": indices(active),
        "columns": half,
        "reference_shift": singles(reference.skin_displacements[active]),
    }


def _correction(planning: PlanningModel) -> dict[str, Any] | None:
    """The parameters of the correction; empty if there is none."""
    if planning.correction is None:
        return None
    numbers = planning.correction.numbers
    return {
        "length": planning.correction.length,
        "segments": [planning.segments.index(name) for name in numbers.segments],
        "middles": numbers.middles.tolist(),
        "arms": numbers.arms.tolist(),
        "plans": len(planning.correction.plans),
    }


def _carried(part: str, skin: SurfaceData, points: Floats) -> Arrays:
    """How points are attached to the skin, as in `carried_points` of a prediction."""
    found = attachment(skin.searched, points)
    corners = skin.vertices[skin.triangles[found.triangles]]
    return {
        f"{part}_triangle": indices(found.triangles),
        f"{part}_barycentric": singles(barycentric(corners, found.closest)),
        f"{part}_offset": singles(found.places - found.closest),
        f"{part}_share": singles(found.share),
    }


def _segments(planning: PlanningModel) -> list[dict[str, Any]]:
    skull = planning.patient.landmarks.get("skull", {})
    boxes = segment_boxes(planning)
    found = []
    for name, centre in zip(planning.segments, planning.columns.centres, strict=True):
        points = segment_points(name, skull, planning.patient.segment_vertices(name))
        found.append(
            {
                "name": name,
                "label": name.replace("_", " "),
                "centre": centre.tolist(),
                "box": [boxes[name].min(axis=0).tolist(), boxes[name].max(axis=0).tolist()],
                "points": [{"label": p.label, "place": p.place.tolist()} for p in points],
                "reference": planning.reference[name].ravel().tolist(),
            }
        )
    return found


def _bones(
    planning: PlanningModel, arrays: Arrays, findings: list[Finding]
) -> list[dict[str, Any]]:
    """All bones, including those that stay; each is simplified by the same ratio."""
    segments = planning.patient.segments
    counts = [len(segment.surface.triangles) for segment in segments]
    colours = segment_colours([segment.name for segment in segments])
    found: list[dict[str, Any]] = []
    for number, segment in enumerate(segments):
        most = max(LEAST_BONE, BONE_TRIANGLES * counts[number] // sum(counts))
        _fewer(arrays, f"bone_{number}", segment.name, segment.surface, most, findings=findings)
        found.append(
            {
                "name": segment.name,
                "segment": _number(planning, segment.name),
                "colour": colours[segment.name],
            }
        )
    return found


def _number(planning: PlanningModel, segment: str) -> int | None:
    """The number of a segment, which pages know it by; None if the plan does not move it."""
    return planning.segments.index(segment) if segment in planning.segments else None


def _measured(planning: PlanningModel, sites: FaceSites) -> dict[str, Any]:
    found = ", ".join(name.replace("_", " ") for name in sites.found)
    notes = [
        (
            "Heights are measured along S of the data, not in natural head position. Sites move "
            "with the tissue; they are not located again on the moved face."
        )
    ]
    if found:
        notes.append(
            f"Located on the profile and the bone because the case does not give them: {found}."
        )
    return {
        "skin_sites": [{"name": name} for name in sites.skin],
        "bone_sites": [
            {"name": name, "place": site.place.tolist(), "segment": _number(planning, site.segment)}
            for name, site in sites.bone.items()
        ],
        "measures": [
            {
                **{name: getattr(measure, name) for name in ("key", "label", "unit", "formula")},
                "sites": list(measure.sites),
                "about": measure.about,
                "absent": sites.why_absent(measure.sites),
            }
            for measure in MEASURES
        ]
        + occlusal_measures(
            bone_sites(planning.patient), planning.segments, unfound_molars(planning.patient)
        ),
        "measure_notes": notes,
    }


def occlusal_measures(
    sites: Mapping[str, BoneSite], segments: Sequence[str], unfound: Mapping[str, str]
) -> list[dict[str, Any]]:
    """The measures of occlusion, by points that move with segments, each with its share."""
    before = {name: site.place for name, site in sites.items()}
    frame, terms = bite_frame(before), occlusal_terms(before)
    absent = missing_for_occlusion(before, unfound)
    numbers = {name: number for number, name in enumerate(segments)}
    bearers = np.array([numbers.get(site.segment, -1) for site in sites.values()])
    places = np.array([*before.values()]).reshape(-1, 3)

    def point(weights: Floats) -> list[dict[str, Any]]:
        shares = {int(b): weights * (bearers == b) for b in np.unique(bearers[weights > 0.0])}
        return [
            {
                "segment": None if bearer < 0 else bearer,
                "share": float(share.sum()),
                "place": (share @ places / share.sum()).tolist(),
            }
            for bearer, share in shares.items()
        ]

    axes = {n: getattr(frame, n).tolist() for n in ("forwards", "up", "left")}
    found = []
    for measure in OCCLUSAL_MEASURES:
        text = {name: getattr(measure, name) for name in ("key", "label", "unit", "about")}
        own: dict[str, Any] = {"sites": [], "formula": "", "absent": absent[measure.key]}
        if not own["absent"]:
            term = terms[measure.key]
            own |= {
                "formula": term.formula,
                "points": [point(weights) for weights in term.weights],
                "offset": frame.middle if term.formula == "left" else term.offset,
                "axes": axes,
            }
        found.append({**text, **own})
    return found


def _profile(planning: PlanningModel, face: SurfaceData, arrays: Arrays) -> dict[str, Any]:
    try:
        profile = midline_profile(face, planning.patient.landmarks.get("skin", {}))
    except LandmarkInputError as error:
        arrays["profile_ends"] = np.zeros((0, 2), dtype=np.uint32)
        arrays["profile_share"] = np.zeros(0, dtype=np.float32)
        return {"has_profile": False, "profile_absent": str(error)}
    # Without scalp and neck, which would make the drawing small.
    shown = profile.points[:, 1] <= profile.points[:, 1].min() + PROFILE_DEPTH
    arrays["profile_ends"] = indices(profile.ends[shown])
    arrays["profile_share"] = singles(profile.share[shown])
    return {"has_profile": True, "profile_absent": ""}


def _target_bite(planning: PlanningModel) -> dict[str, Any] | None:
    """The motion of the lower jaw into the bite of the case's scans, by numbers of segments."""
    target = planning.patient.summary.get("target_bite")
    if target is None:
        return None
    return {
        "upper": _number(planning, target["upper"]),
        "lower": _number(planning, target["lower"]),
        "motion": np.ravel(target["motion"]).tolist(),
        "places": target["places"],
    }


def _teeth(planning: PlanningModel, arrays: Arrays) -> dict[str, Any]:
    try:
        rows = row_overlap(planning.patient)
    except CaseInputError as error:
        return {"occlusion": None, "occlusion_absent": str(error)}
    arrays["occlusion_points"] = singles(rows.points)
    arrays["occlusion_depth"] = singles(rows.depth.values)
    return {
        "occlusion": {
            "upper": _number(planning, rows.upper),
            "lower": _number(planning, rows.lower),
            "origin": rows.depth.lowest.tolist(),
            "spacing": float(rows.depth.spacing[0]),
            "shape": list(rows.depth.values.shape),
        },
        "occlusion_absent": "",
    }


def _midplane(landmarks: Mapping[str, Floats]) -> dict[str, list[float]] | None:
    """A point and the unit normal, to the left, of the plane between the corners of the eyes."""
    sides = [[landmarks[f"{n}_{s}"] for n in EYES if f"{n}_{s}" in landmarks] for s in "LR"]
    if not sides[0] or len(sides[0]) != len(sides[1]):
        return None
    left, right = np.mean(sides[0], axis=0), np.mean(sides[1], axis=0)
    normal = (left - right) / np.linalg.norm(left - right)
    return {"point": (0.5 * (left + right)).tolist(), "normal": normal.tolist()}


def band_content(band: PlanBand | None) -> tuple[dict[str, Any] | None, Arrays]:
    """Values and arrays of a band; none where the page has no band.

    Rates in half precision change a half-width by 0.01 mm at most.
    """
    if band is None:
        return None, {}
    known = band.at_reference
    factor = band.factor
    regions = [
        {
            "name": name,
            "factor": known.factors[name].factor if name in known.factors else known.plain_factor,
            "cases": known.factors[name].n if name in known.factors else None,
        }
        for name in known.regions
    ]
    arrays: Arrays = {
        "band_still": band.still.astype(np.float32),
        "band_shift": band.shift.astype(np.float32),
        "band_rates": band.rates.astype(np.float16),
        # 0 outside of the face, where no band is stated.
        "band_factor": np.nan_to_num(factor, nan=0.0).astype(np.float32),
    }
    for index, part in enumerate(known.regions.values()):
        arrays[f"band_region_{index}"] = np.flatnonzero(part).astype(np.uint32)
    calibration = known.about.get("calibration") or {}
    values = {
        "state": known.state,
        "coverage": known.coverage,
        "regions": regions,
        "note": str(calibration.get("note") or ""),
    }
    return values, arrays
