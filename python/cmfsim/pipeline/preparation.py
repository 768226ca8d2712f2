"""Checks of a command before it works: required packages, and a writable output."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from cmfsim.errors import CaseInputError
from cmfsim.io import Case
from cmfsim.io.results.predictions import is_prediction_file
from cmfsim.pipeline.building.inputs import check_output

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Need:
    """A module of an extra, and its purpose; some are optional."""

    module: str
    extra: str
    purpose: str
    is_optional: bool = False


def prepare(
    case: Case,
    is_written: Callable[[str], bool] = is_prediction_file,
    *,
    report: bool = False,
    evaluation: bool = False,
) -> None:
    """Finds before any work what would end it late.

    is_written: Whether a file of a name is written to the output folder.
    report: Whether a report is written.
    evaluation: Whether predictions are compared with the face after the operation.
    Raises `CaseError`: Packages are missing, all named in one line; the output folder is a file,
        leads out of the case's folder, or holds an input of a name that is written there.
    Raises `OSError`: The output folder cannot be written to.
    """
    check_output(case, is_written)
    check_extras(_needs(case, report=report, evaluation=evaluation))


def check_extras(needs: Iterator[_Need] | Sequence[_Need]) -> None:
    """Refuses to begin without required modules, and warns of missing optional ones."""
    missing = [need for need in dict.fromkeys(needs) if not _is_there(need.module)]
    if not missing:
        return
    extras = ",".join(sorted({need.extra for need in missing}))
    reasons = "; ".join(dict.fromkeys(f"{need.module}: {need.purpose}" for need in missing))
    line = f"{reasons}; install with: pip install '.[{extras}]' in cmfsim's folder"
    if all(need.is_optional for need in missing):
        _log.warning("skipped: %s", line)
        return
    raise CaseInputError(f"packages are missing: {line}")


def _needs(case: Case, *, report: bool, evaluation: bool) -> Iterator[_Need]:
    after = case.postoperative
    images = [case.image, None if after is None else after.image]
    if any(image is not None for image in images):
        yield _Need("SimpleITK", "imaging", "reads images")
    yield _Need("scipy", "imaging", "computes on the grid of the tissue")
    yield _Need("skimage", "imaging", "makes surfaces from the grid")
    if case.image is not None or case.osteotomies:
        yield _Need("fast_simplification", "imaging", "coarsens surfaces of bone")
    for path in _surface_files(case):
        yield _Need("meshio", "mesh", "reads surfaces and meshes")
        if path.lower().endswith(".vtk"):
            yield _Need("vtkmodules", "mesh", "reads legacy VTK")
    if report:
        yield _Need("jinja2", "report", "writes the report (or use --no-report)")
        yield _Need("pyvista", "mesh", "draws 3-D pictures", is_optional=True)
    if evaluation:
        yield _Need("scipy", "report", "tests the differences between models")
        yield _Need("matplotlib", "report", "draws the chart of errors", is_optional=not report)


def _surface_files(case: Case) -> Iterator[str]:
    if case.surfaces is not None:
        yield from map(str, (case.surfaces.skin, *case.surfaces.bones.values()))
    if case.postoperative is not None:
        after = case.postoperative
        yield from map(str, (path for path in (after.skin, *after.bones.values()) if path))
    for motion in case.plan.values():
        yield from map(str, (path for path in (motion.surface, motion.moved_surface) if path))
    seam = None if isinstance(case.lips.seam, str) else case.lips.seam
    yield from map(str, (path for path in (case.mesh.file, case.mesh.parting, seam) if path))


def _is_there(module: str) -> bool:
    """Whether a module can be found; it is not loaded."""
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):  # its package is missing; it was put out of reach
        return False
