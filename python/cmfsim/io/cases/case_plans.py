"""Cuts and plan of a case file: osteotomies, how each segment moves, and plans written back."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from cmfsim.io.cases.case_tables import checked_name, plane_of, stated_frame
from cmfsim.io.cases.tables import Table
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.slicer.transforms import DIRECTION_CHOICE, is_itk_file, motion_in_lps
from cmfsim.values.case_parts import DIRECTIONS, PROCEDURES, CaseMotion, CaseOsteotomy
from cmfsim.values.checks import AnyPath, Floats
from cmfsim.values.motion import rigid_matrix, rigid_motion

# A name that TOML takes as a key without quotes.
BARE = re.compile(r"[A-Za-z0-9_-]+")

# What stands for the plan where it is read off the bones after the operation.
ACHIEVED = "achieved"


def osteotomies_of(document: Table) -> tuple[CaseOsteotomy, ...]:
    """The cuts of [[osteotomies]], by procedure or by plane."""
    cuts: list[CaseOsteotomy] = []
    made: dict[str, int] = {}
    for table in document.tables("osteotomies"):
        if "procedure" in table:
            procedure = table.text("procedure", choices=tuple(PROCEDURES))
            options = {key: table.plain(key) for key in table if key != "procedure"}
            cut = CaseOsteotomy(procedure, options)
        elif "plane" in table:
            table.only("plane", "bone", "name")
            name = checked_name(table, "name", table.text("name"))
            cut = CaseOsteotomy(plane=plane_of(table, "plane"), bone=table.text("bone"), name=name)
        else:
            known = ", ".join(PROCEDURES)
            table.fail(None, f"needs procedure (one of {known}), or plane, bone and name")
        for segment in cut.segments:
            if segment in made:
                table.fail(None, f"makes {segment!r}, as the one on line {made[segment]} does")
            made[segment] = table.line()
        cuts.append(cut)
    return tuple(cuts)


def is_achieved(document: Table) -> bool:
    """Whether the case asks for the plan that the operation achieved."""
    if "plan" not in document or isinstance(document.need("plan"), dict):
        return False
    if document.need("plan") != ACHIEVED:
        document.fail(
            "plan", f'is {document.need("plan")!r}: tables [plan.SEGMENT] are needed, or "achieved"'
        )
    after = document.table("postoperative")
    if "image" not in after and "bones" not in after:
        document.fail(
            "plan",
            'is "achieved", but the case has no post-operative bone to measure it on: add '
            "[postoperative] image, or [postoperative.bones]",
        )
    return True


def plan_of(document: Table, folder: Path) -> dict[str, CaseMotion]:
    """The motion of each segment that [plan] names."""
    table = document.table("plan")
    motions = {}
    for name in table:
        motion = table.table(name)
        if "moved" in motion:
            motions[checked_name(table, name, name)] = _moved(document, motion, name, folder)
        else:
            motions[checked_name(table, name, name)] = _motion(motion, folder)
    return motions


def _moved(document: Table, motion: Table, name: str, folder: Path) -> CaseMotion:
    """The motion of a bone of the case, given by the same surface after it moved."""
    bones = document.table("surfaces").table("bones") if "surfaces" in document else ()
    if name not in bones:
        known = f"one of {', '.join(bones)}" if bones else "no bone, because there is no [surfaces]"
        motion.fail(
            "moved",
            f"is for bones that [surfaces.bones] names ({known}), not for {name!r}: give surface "
            "and moved_surface, the piece before and after",
        )
    before = document.table("surfaces").table("bones").path(name, folder)
    return CaseMotion(surface=before, moved_surface=motion.only("moved").path("moved", folder))


def _motion(table: Table, folder: Path) -> CaseMotion:
    if "transform" in table:
        return _transform(table.only("transform"), folder)
    if "moved_surface" in table or "surface" in table:
        table.only("surface", "moved_surface")
        surface = table.path("surface", folder)
        return CaseMotion(surface=surface, moved_surface=table.path("moved_surface", folder))
    frame = stated_frame(table)
    if "matrix" in table:
        matrix = table.only("matrix", "frame").matrix("matrix")
        with table.at("matrix"):
            matrix = rigid_matrix(matrix)
        return CaseMotion(matrix=motion_in_lps(matrix, frame or "LPS"), frame=frame)
    numbers = ("translation", "angle", "axis", "centre", "frame")
    table.only(*numbers, "matrix", "transform", "moved", "surface")
    given: dict[str, Any] = {
        key: vector
        for key in ("translation", "axis", "centre")
        if (vector := table.vector(key)) is not None
    }
    angle = table.number("angle", "degrees", low=-360.0, high=360.0)
    with table.at("axis" if "axis" in given else None):
        matrix = rigid_motion(angle=0.0 if angle is None else angle, **given)
    centre = given.get("centre")
    if centre is not None and frame == "RAS":
        centre = centre * [-1.0, -1.0, 1.0]
    matrix = motion_in_lps(matrix, frame or "LPS")
    return CaseMotion(matrix=matrix, centre=centre, frame=frame, typed=True)


def _transform(motion: Table, folder: Path) -> CaseMotion:
    """The motion in a transform file; which way the file carries points is stated for ITK's."""
    key = "transform"
    if not isinstance(motion.need(key), dict):
        file = motion.path(key, folder)
        if is_itk_file(file):
            name = motion.text(key)
            motion.fail(
                key,
                f"is an ITK file, which does not record its direction: write {key} = {{ file = "
                f'"{name}", direction = "..." }} with {DIRECTION_CHOICE}',
            )
        return CaseMotion(transform=file)
    table = motion.table(key).only("file", "direction", "frame")
    file = table.path("file", folder)
    direction = table.text("direction", choices=DIRECTIONS) if "direction" in table else None
    frame = stated_frame(table)
    if is_itk_file(file) and direction is None:
        table.fail(
            None, f"lacks direction, which the ITK file does not record: write {DIRECTION_CHOICE}"
        )
    if is_itk_file(file) and frame == "RAS":
        table.fail(
            "frame",
            'is "RAS", but ITK files (.tfm, .h5) are always in LPS, as are those that 3D '
            "Slicer saves: remove frame",
        )
    return CaseMotion(transform=file, direction=direction, frame=frame)


def write_plan(path: AnyPath, plan: Mapping[str, ArrayLike], *, made_for: str = "") -> None:
    """Writes rigid motions as tables `[plan.SEGMENT]`, which `cmfsim predict --plan` reads.

    Parameters
    ----------
    path : path
        Replaced when all is written.
    plan : mapping of str to (4, 4) float64, mm
        In LPS.
    made_for : str
        The `plan_key` of the case, so that a plan for another head is noticed.

    Raises
    ------
    BoundaryError
        (also `ValueError`) A matrix that is not a rigid motion.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.rigid_motion(translation=(0, -4, 0))
    >>> cmfsim.write_plan("plan.toml", {"maxilla": motion})
    """
    lines = [
        "# Plan. Not a medical device.",
        "# Each matrix carries the bone from where it is to where it goes: LPS, mm.",
        "# cmfsim predict case.toml --plan THIS_FILE; or copy the tables into the case's [plan].",
    ]
    if made_for:
        lines.append(f"# made for: {made_for}")
    for name, motion in plan.items():
        matrix = rigid_matrix(motion, f"motion of {name!r}")
        lines += ["", plan_head(name), *matrix_rows(matrix)]
    with replacing(Path(path)) as file:
        file.write(("\n".join(lines) + "\n").encode())


def plan_head(segment: str) -> str:
    """The head of the table with a segment's motion."""
    return f"[plan.{segment if BARE.fullmatch(segment) else json.dumps(segment)}]"


def matrix_rows(matrix: Floats) -> list[str]:
    """The rows of TOML with a motion, (4, 4) mm."""
    rows = [f"  [{', '.join(repr(float(v)) for v in row)}]," for row in matrix]
    return ["matrix = [", *rows, "]"]
