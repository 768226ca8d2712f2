"""The allowed contents of `prediction.json`, and the names of a prediction's files."""

import re

from cmfsim.io.files.summaries import COUNT, FINDING, Maybe, Span, check
from cmfsim.values.moduli import MOST_POISSON, YOUNG_RANGE
from cmfsim.values.prediction import MODELS

PREDICTION_FILES = re.compile(
    r"prediction\.(vtp|stl|vtu|npz|png|json|mrb)|face\.(vtp|stl)|face_before\.vtp|(bones|muscles)\.vtp"
    r"|(plan|muscles|band)\.png|timings\.json"
)


def is_prediction_file(name: str) -> bool:
    """Whether a prediction is written as files of this name, among others."""
    return PREDICTION_FILES.fullmatch(name) is not None


_SIZE, _SHARE, _SECONDS = Span(0.0, 1e6), Span(0.0, 1.0), Span(0.0, 1e9)
_LARGE, _VECTOR = Span(0.0, 1e12), [Span(-1e6, 1e6)] * 3
_SCALE = Span(0.1, 10.0)


def _motion(where: str, value: object) -> None:
    """A rigid motion by its numbers, or another by how far it goes."""
    rigid = isinstance(value, dict) and "translation" in value
    shape = {"translation": _VECTOR, "angle": Span(0.0, 360.0), "axis": _VECTOR}
    moved = {"mean": _SIZE, "largest": _SIZE, "bending?": _SIZE}
    check(where, value, {**shape, "mean?": _SIZE, "bending?": _SIZE} if rigid else moved)


_SOLUTION = {
    "method": str,
    **dict.fromkeys(("n_tets", "n_unknowns", "contact_iterations"), COUNT),
    **dict.fromkeys(("residual", "error_bound?", "error_estimate?"), Maybe(_LARGE)),
    "contact_gap": Maybe(Span(-1e6, 1e6)),
}
_FIT = {
    **dict.fromkeys(("rms_mm", "worst_mm", "median_mm", "p95_mm", "slip_mm?"), _SIZE),
    "share": _SHARE,
    "shape?": {
        "scale": _SCALE,
        "scale_interval": [_SCALE] * 2,
        "eigenvalue_ratio": _SHARE,
        "open": [object],
    },
}
_YOUNG, _POISSON = Span(*YOUNG_RANGE), Span(-1.0, MOST_POISSON)
_MUSCLE = {"young_along": _YOUNG, "young_across": _YOUNG, "poisson": _POISSON}
_BAND_REGION = {
    **dict.fromkeys(
        ("half_width_mean_mm", "half_width_p95_mm", "half_width_largest_mm", "sd_mean_mm"), _SIZE
    ),
    "calibration": Maybe(
        {
            "factor": Span(0.0, 1e9),
            **dict.fromkeys(("n", "rank"), COUNT),
            **dict.fromkeys(("coverage", "coverage_5_percent", "coverage_95_percent"), _SHARE),
        }
    ),
    "sources_rms_mm": {str: _SIZE},
}
_BAND = {
    "state": frozenset({"calibrated", "uncalibrated"}),
    "coverage": _SHARE,
    "factor_uncalibrated": Maybe(Span(0.0, 1e3)),
    "settings_digest": str,
    "settings": {str: object},
    "regions": {str: _BAND_REGION},
    "sources": {str: {"sd": _SIZE, "unit": str, "reference": str}},
    "not_covered": [str],
    "notes": [str],
    "calibration": Maybe({"file": str, "note": str, "n": COUNT, "group?": Maybe(str)}),
    "seconds": _SECONDS,
}
_PLACE = Span(-1e6, 1e6)
_MEASURE = {
    **dict.fromkeys(("label", "unit", "norm", "source", "absent"), str),
    **dict.fromkeys(("before", "planned"), Maybe(_PLACE)),
}
_SITE = {
    **dict.fromkeys(("name", "moves_with"), str),
    **dict.fromkeys(("forwards_mm", "up_mm", "left_mm"), _PLACE),
}
PREDICTION = {
    **dict.fromkeys(("case", "case_key", "note?", "plan_digits?"), str),
    "model": frozenset(MODELS),
    "versions": {str: str},
    "inputs": {str: str},
    "timings": {str: _SECONDS},
    "skin": dict.fromkeys(("mean", "face_mean?", "p95", "largest"), _SIZE),
    "plan": {str: _motion},
    "segments": {str: {"joined": COUNT, "sliding": COUNT}},
    "mesh": {str: object},
    "solution": _SOLUTION,
    "findings": [FINDING],
    "parts": {frozenset({"bones", "muscles"}): [str]},
    "files": [PREDICTION_FILES],
    "left_out?": [str],
    "clinical?": {"cephalometry": [_MEASURE], "face": [_MEASURE], "sites": [_SITE]},
    "achieved?": {"segments": {str: _FIT}},
    "muscles?": {
        "volumes?": {str: _LARGE},
        "template?": str,
        "moduli?": {
            "fat": {"young": _YOUNG, "poisson": _POISSON},
            "muscle": _MUSCLE,
            "muscles": {str: _MUSCLE},
        },
    },
    "refined?": bool,
    "band?": _BAND,
}
