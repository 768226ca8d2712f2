"""The model of a case, built and written to its output folder with pictures."""

import logging
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cmfsim.errors import CmfsimError
from cmfsim.io import CaseOrPath, as_case, write_model
from cmfsim.pictures import picture_anatomy, picture_node_kinds
from cmfsim.pipeline.building.case_model import build_model
from cmfsim.pipeline.building.inputs import check_output
from cmfsim.pipeline.building.stages import BuildKeywords, build_options
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.progress import expected_stages

if TYPE_CHECKING:
    from typing_extensions import Unpack

_log = logging.getLogger(__name__)
WRITING = "writing the model"


def build_case(case: CaseOrPath, **options: "Unpack[BuildKeywords]") -> PatientModel:
    """The model of a case, written to its output folder.

    Parameters
    ----------
    case : Case, or path of its file or folder
    **options
        Those of `BuildOptions`.

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
    with build_options(options, expected_stages(WRITING)) as asked:
        model = build_model(case, **options)
        asked.observer.stage(WRITING)
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
