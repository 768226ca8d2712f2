"""The model of a case, built and written to its output folder with pictures."""

import logging
import time
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

from cmfsim.errors import CmfsimError
from cmfsim.io import CaseOrPath, as_case, write_model
from cmfsim.pictures import picture_anatomy, picture_node_kinds
from cmfsim.pipeline.building.case_model import build_model
from cmfsim.pipeline.building.inputs import check_output
from cmfsim.values.finding import Finding, OnFindings
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.progress import ProgressOrBar, expected_stages, shown_progress

_log = logging.getLogger(__name__)
WRITING = "writing the model"


def build_case(
    case: CaseOrPath,
    *,
    progress: ProgressOrBar = None,
    check: bool = True,
    findings: Iterable[Finding] = (),
    on_findings: OnFindings | None = None,
) -> PatientModel:
    """The model of a case, written to its output folder.

    Parameters
    ----------
    case : Case, or path of its file or folder
    progress : callable or bool, optional
        Called with the name of each stage as it begins; True shows a bar (tqdm).
    check : bool
        Whether the doctor checks the case first; an error that it finds ends the work.
    findings : iterable of Finding
        Findings on the case so far; the model keeps them.
    on_findings : callable, optional
        Called with new findings at the end of each stage.

    Returns
    -------
    PatientModel

    Raises
    ------
    CmfsimError
        (also `ValueError` if the input is at fault) A stage cannot continue. Files of an earlier
        run are then unchanged.
    OSError
        The output folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> model = cmfsim.build_case(cmfsim.Case.load("case.toml"))  # doctest: +SKIP
    >>> result = cmfsim.solve_scene(model.scene)  # doctest: +SKIP
    """
    case = as_case(case)
    check_output(case)
    with shown_progress(progress, expected_stages(WRITING)) as shown:
        model = build_model(
            case, progress=shown, check=check, findings=findings, on_findings=on_findings
        )
        shown(WRITING)
        begun = time.perf_counter()
        names = write_model(case.output, model, partial(_draw, model))
    timings = {**model.summary["timings"], WRITING: time.perf_counter() - begun}
    more = {"timings": timings, "output": str(case.output), "files": names}
    return replace(model, summary={**model.summary, **more})


def _draw(model: PatientModel, folder: Path) -> list[str]:
    """The names of the pictures drawn into a folder: none without PyVista or OpenGL."""
    anatomy, kinds = folder / "anatomy.png", folder / "node_kinds.png"
    try:
        picture_anatomy(anatomy, model.skin, model.segments)
        picture_node_kinds(
            kinds, model.scene.nodes, model.boundary_triangles, model.kinds, lips=model.lips
        )
    except CmfsimError as error:
        _log.warning("no pictures: %s", error)
    return [path.name for path in (anatomy, kinds) if path.exists()]
