"""The allowed contents of `prediction.json`, and the names of a prediction's files."""

import re

from cmfsim.io.files.summaries import (
    file_of,
    finding,
    flag,
    listing,
    mapping,
    number,
    one_of,
    optional,
    plain,
    table,
    text,
    whole,
)
from cmfsim.values.moduli import MOST_POISSON, YOUNG_RANGE
from cmfsim.values.prediction import MODELS

PREDICTION_FILES = re.compile(
    r"prediction\.(vtp|stl|vtu|npz|png|json|mrb)|face\.(vtp|stl)|face_before\.vtp|(bones|muscles)\.vtp"
    r"|(plan|muscles|band)\.png|timings\.json"
)


def is_prediction_file(name: str) -> bool:
    """Whether a prediction is written as files of this name, among others."""
    return PREDICTION_FILES.fullmatch(name) is not None


_LENGTH, _COUNT, _SECONDS = number(-1e6, 1e6), whole(0, 10**12), number(0.0, 1e9)
_VECTOR = listing(_LENGTH, length=3)
_RIGID = table({"translation": _VECTOR, "angle": number(0.0, 360.0), "axis": _VECTOR})
_MOVED = table({"mean": number(0.0, 1e6), "largest": number(0.0, 1e6)})


def _motion(where: str, value: object) -> None:
    table({}, {"mean": number(0.0, 1e6), "bending": number(0.0, 1e6)})(where, value)
    rigid = isinstance(value, dict) and "translation" in value
    (_RIGID if rigid else _MOVED)(where, value)


_SOLUTION = table(
    {
        "method": text,
        "n_tets": _COUNT,
        "n_unknowns": _COUNT,
        "residual": optional(number(0.0, 1e12)),
        "contact_iterations": _COUNT,
        "contact_gap": optional(_LENGTH),
    },
    dict.fromkeys(("error_bound", "error_estimate"), optional(number(0.0, 1e12))),
)
_SIZE = number(0.1, 10.0)
_FIT = table(
    {
        **dict.fromkeys(("rms_mm", "worst_mm", "median_mm", "p95_mm"), number(0.0, 1e6)),
        "share": number(0.0, 1.0),
    },
    {
        "shape": table(
            {
                "scale": _SIZE,
                "scale_interval": listing(_SIZE, length=2),
                "eigenvalue_ratio": number(0.0, 1.0),
                "open": listing(plain),
            }
        ),
        "slip_mm": number(0.0, 1e6),
    },
)
_YOUNG, _POISSON = number(*YOUNG_RANGE), number(-1.0, MOST_POISSON)
_MUSCLE = table({"young_along": _YOUNG, "young_across": _YOUNG, "poisson": _POISSON})
_WIDTH, _SHARE = number(0.0, 1e6), number(0.0, 1.0)
_FACTOR = table(
    {
        "factor": number(0.0, 1e9),
        "n": _COUNT,
        "rank": _COUNT,
        **dict.fromkeys(("coverage", "coverage_5_percent", "coverage_95_percent"), _SHARE),
    }
)
_BAND_REGION = table(
    {
        **dict.fromkeys(
            ("half_width_mean_mm", "half_width_p95_mm", "half_width_largest_mm", "sd_mean_mm"),
            _WIDTH,
        ),
        "calibration": optional(_FACTOR),
        "sources_rms_mm": mapping(_WIDTH, most=1000),
    }
)
_BAND = table(
    {
        "state": one_of("calibrated", "uncalibrated"),
        "coverage": _SHARE,
        "factor_uncalibrated": optional(number(0.0, 1e3)),
        "settings_digest": text,
        "settings": mapping(plain),
        "regions": mapping(_BAND_REGION, most=100),
        "sources": mapping(
            table({"sd": number(0.0, 1e6), "unit": text, "reference": text}), most=1000
        ),
        "not_covered": listing(text),
        "notes": listing(text),
        "calibration": optional(
            table({"file": text, "note": text, "n": _COUNT}, {"group": optional(text)})
        ),
        "seconds": number(0.0, 1e9),
    }
)
PREDICTION = table(
    {
        "case": text,
        "model": one_of(*MODELS),
        "case_key": text,
        "versions": mapping(text, most=100),
        "inputs": mapping(text),
        "timings": mapping(_SECONDS, most=1000),
        "skin": table(dict.fromkeys(("mean", "p95", "largest"), number(0.0, 1e6))),
        "plan": mapping(_motion, most=1000),
        "segments": mapping(table({"joined": _COUNT, "sliding": _COUNT}), most=1000),
        "mesh": mapping(plain),
        "solution": _SOLUTION,
        "findings": listing(finding),
        "parts": mapping(listing(text), most=10, keys=one_of("bones", "muscles")),
        "files": listing(file_of("a prediction", is_prediction_file)),
    },
    {
        "note": text,
        "plan_digits": text,
        "left_out": listing(text),
        "achieved": table({"segments": mapping(_FIT, most=1000)}),
        "muscles": table(
            {},
            {
                "volumes": mapping(number(0.0, 1e12)),
                "template": text,
                "moduli": table(
                    {
                        "fat": table({"young": _YOUNG, "poisson": _POISSON}),
                        "muscle": _MUSCLE,
                        "muscles": mapping(_MUSCLE, most=1000),
                    }
                ),
            },
        ),
        "refined": flag,
        "band": _BAND,
    },
)
