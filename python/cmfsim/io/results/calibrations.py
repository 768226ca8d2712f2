"""Calibrations as JSON (docs/band.md): scores by case and region, with what they belong to."""

import json
from pathlib import Path
from typing import Any

from cmfsim.errors import CalibrationError, CaseInputError
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.files.summaries import Closed, Maybe, Span, check, plain_json
from cmfsim.values.calibration import Calibration, CalibrationCase
from cmfsim.values.checks import AnyPath
from cmfsim.values.prediction import MODELS

CALIBRATION_FORMAT, CALIBRATION_VERSION = "cmfsim-calibration", 1

_CASE = Closed({"case": str, "scores": {str: Span(0.0, 1e9)}, "group?": str})
_CALIBRATION = Closed({
    "format": frozenset({CALIBRATION_FORMAT}),
    "version": Span(CALIBRATION_VERSION, CALIBRATION_VERSION, whole=True),
    "model": frozenset(MODELS), "settings": {str: object}, "settings_digest": str, "cases": [_CASE],
    "note?": str, "coverage?": Maybe(Span(0.0, 1.0)),
})  # fmt: skip


def read_calibration(path: AnyPath) -> Calibration:
    """The calibration in a file.

    Raises
    ------
    FileNotFoundError
        There is no such file.
    CalibrationError
        (also `ValueError`) Not a calibration, another version, a value out of range, settings that
        are not those of the digest: with the file and the place in it.

    Examples
    --------
    >>> import cmfsim
    >>> calibration = cmfsim.read_calibration("calibration.json")  # doctest: +SKIP
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such calibration file")
    try:
        content: dict[str, Any] = plain_json(path)
        check("", content, _CALIBRATION)
        found = Calibration(
            content["model"],
            content["settings"],
            tuple(CalibrationCase(**case) for case in content["cases"]),
            content.get("note", ""),
            content.get("coverage"),
        )
    except (OSError, CaseInputError) as error:
        raise CalibrationError(f"{path}: {error}") from error
    if found.digest != content["settings_digest"]:
        raise CalibrationError(
            f"{path}: settings_digest is not that of its settings: one of them was changed by "
            "hand; write the file again with write_calibration"
        )
    return found


def write_calibration(path: AnyPath, calibration: Calibration) -> None:
    """Writes a calibration; the same calibration always gives the same bytes.

    Raises
    ------
    OSError
        The file cannot be written.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_calibration("calibration.json", calibration)  # doctest: +SKIP
    """
    content = {
        "format": CALIBRATION_FORMAT,
        "version": CALIBRATION_VERSION,
        "model": calibration.model,
        "note": calibration.note,
        "coverage": calibration.coverage,
        "settings_digest": calibration.digest,
        "settings": dict(calibration.settings),
        "cases": [
            {"case": case.case, "group": case.group, "scores": dict(case.scores)}
            for case in calibration.cases
        ],
    }
    text_of = json.dumps(content, indent=1, sort_keys=False, allow_nan=False, ensure_ascii=False)
    with replacing(Path(path)) as file:
        file.write(f"{text_of}\n".encode())
