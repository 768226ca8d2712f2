"""Tables of a case file: what each may hold, and within what limits; plans written back."""

import json
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from numpy.typing import ArrayLike

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS, PRESETS
from cmfsim.errors import CaseInputError
from cmfsim.io.cases.tables import Table
from cmfsim.io.files.reading_writing import is_there, replace_text
from cmfsim.io.slicer.transforms import DIRECTION_CHOICE, is_itk_file, motion_in_lps
from cmfsim.values import case_parts
from cmfsim.values.case_parts import DIRECTIONS, PROCEDURES, CaseMotion, CaseOsteotomy
from cmfsim.values.checks import AnyPath, Floats
from cmfsim.values.moduli import MOST_POISSON, YOUNG_RANGE, MuscleModuli, TissueModuli
from cmfsim.values.motion import rigid_matrix, rigid_motion
from cmfsim.values.solver_options import CONTACTS, SolverOptions
from cmfsim.values.tissue_data import TissueData

# What [muscles] and each table below [muscles.moduli] may set, as `MuscleModuli` has it.
MODULI = ("young_along", "young_across", "poisson")
# What takes the values of an image to HU: images from 0 to 1 have a slope of some 4000.
MOST_SLOPE = 1e5
MOST_INTERCEPT = 1e5


def stated_frame(table: Table) -> str | None:
    """The frame of numbers or files, where the case states it."""
    return table.text("frame", choices=case_parts.FRAMES) if "frame" in table else None


def output_folder(table: Table, folder: Path) -> Path:
    """The folder to write to, below that of the case: a case never writes anywhere else."""
    name = table.text("folder", "out")
    relative = PurePosixPath(name)
    plain = not relative.is_absolute() and ".." not in relative.parts
    if not plain or any(c in name for c in "\\:\0") or relative == PurePosixPath():
        table.fail(
            "folder",
            f"is {name!r}: give a folder below the case's own (for any other: cmfsim build -o)",
        )
    try:
        is_there(folder / relative)
    except CaseInputError as error:
        table.fail("folder", f"names {error}")
    return folder / relative


def image_of(table: Table, folder: Path) -> case_parts.CaseImage:
    """The image of [image], with how its values become HU."""
    series, rescale = _dicom_series(table), _rescale(table)
    bones = _bones(table, folder)
    scans = table.table("teeth").part(case_parts.CaseBite, folder) if "teeth" in table else None
    image = table.part(
        case_parts.CaseImage, folder, series=series, rescale=rescale, bones=bones, teeth=scans
    )
    for low, high in (("skin", "bone"), ("bone", "metal")):
        small, large = (getattr(image, f"{name}_threshold") for name in (low, high))
        if small is not None and large is not None and small >= large:
            table.fail(
                f"{low}_threshold",
                f"is {small:g}, {high}_threshold is {large:g}: the former must be smaller",
            )
    return image


def _rescale(table: Table) -> tuple[float, float] | None:
    """Slope and intercept from the values of an image to HU."""
    if "rescale" not in table:
        return None
    given = table.plain("rescale")
    if not isinstance(given, list) or len(given) != 2 or any(isinstance(n, str) for n in given):
        table.fail("rescale", f"is {given!r}: [slope, intercept] is needed, such as [1, -1024]")
    slope, intercept = (float(n) for n in given)
    if not 0.0 < slope <= MOST_SLOPE or abs(intercept) > MOST_INTERCEPT:
        table.fail(
            "rescale",
            f"is [{slope:g}, {intercept:g}]: the slope must be above 0 and at most {MOST_SLOPE:g}, "
            f"the intercept within ±{MOST_INTERCEPT:g}",
        )
    return slope, intercept


def _dicom_series(table: Table) -> str | None:
    """The DICOM series that is meant, by its number or UID."""
    if "series" not in table:
        return None
    given = table.plain("series")
    if isinstance(given, bool) or not isinstance(given, int | str) or not str(given).strip():
        table.fail("series", f'is {given!r}: the number or UID of a DICOM series, such as "3"')
    return str(given)


def surfaces_of(table: Table, folder: Path) -> case_parts.CaseSurfaces:
    """The skin and the bones of [surfaces], with their unit and frame."""
    table.only(*case_parts.CaseSurfaces.__dataclass_fields__)
    if not list(table.table("bones")):
        table.fail(
            "bones" if "bones" in table else None,
            'names no bone: add a line such as cranium = "file.ply"',
        )
    return table.part(case_parts.CaseSurfaces, folder, bones=_bones(table, folder))


def _bones(table: Table, folder: Path) -> dict[str, Path]:
    """The files of bones by name."""
    bones = table.table("bones")
    return {checked_name(bones, name, name): bones.path(name, folder) for name in bones}


NAME_RULE = "letters, digits, '_', '-' and '+', 64 at most"


def is_segment_name(name: str) -> bool:
    """Whether a bone or segment can have a name: it can stand in a file name."""
    return 0 < len(name) <= 64 and all(c.isalnum() or c in "_-+" for c in name)


def checked_name(table: Table, key: str, name: str) -> str:
    """A name that can stand in a file name: of a bone or segment."""
    if not is_segment_name(name):
        table.fail(key, f"is not a valid name ({name!r}): {NAME_RULE}")
    return name


def landmarks_of(table: Table, folder: Path) -> case_parts.CaseLandmarks:
    """The files of [landmarks], and whether missing ones are to be found."""
    automatic = table.plain("automatic") if "automatic" in table else True
    if not isinstance(automatic, bool) and automatic != "missing":
        table.fail("automatic", f'is {automatic!r}: true, false or "missing" is needed')
    heads = table.plain("templates") if "templates" in table else []
    if not isinstance(heads, list) or not all(isinstance(n, str) and n.strip() for n in heads):
        table.fail("templates", f'is {heads!r}: a list of folders, such as ["heads/a", "heads/b"]')
    templates = tuple(folder / name for name in heads)
    return table.part(case_parts.CaseLandmarks, folder, automatic=automatic, templates=templates)


def plane_of(table: Table, key: str) -> case_parts.Plane:
    """The plane of a table with a point and a normal."""
    plane = table.table(key).only("point", "normal")
    point, normal = plane.vector("point"), plane.vector("normal")
    if point is None or normal is None:
        table.fail(key, "needs point = [x, y, z] and normal = [x, y, z]")
    with table.at(key):
        return case_parts.Plane(point, normal)


def region_of(table: Table, folder: Path) -> case_parts.Region:
    """The part of the head that is meshed, from [region]."""
    if "posterior_plane" in table and "posterior_depth" in table:
        table.fail("posterior_depth", "is given together with posterior_plane: give one of them")
    plane = plane_of(table, "posterior_plane") if "posterior_plane" in table else None
    return table.part(case_parts.Region, folder, at="lower", posterior_plane=plane)


def mesh_of(table: Table, folder: Path) -> case_parts.CaseMesh:
    """The edge lengths of [mesh], or its own mesh."""
    if "parting" in table:
        table.fail("parting", 'was removed: write contact = true and seam = "FILE" in [lips]')
    return table.part(case_parts.CaseMesh, folder)


def lips_of(document: Table, folder: Path) -> case_parts.CaseLips:
    """Whether and where lips are separated; a seam is a way to find it, or a surface."""
    table = document.table("lips")
    seam: Path | str | None = table.text("seam") if "seam" in table else None
    if seam is not None and seam not in case_parts.LIP_SEAMS:
        seam = table.path("seam", folder)
    return table.part(case_parts.CaseLips, folder, seam=seam)


def node_kinds_of(table: Table) -> dict[str, Any]:
    """The options by name; regions as plain tables."""
    options = {key: table.plain(key) for key in table if key != "regions"}
    if "regions" in table:
        regions = table.tables("regions")
        options["regions"] = [{key: region.plain(key) for key in region} for region in regions]
    return options


def tissue_of(table: Table) -> TissueData | None:
    """The fat that the table states; None if it states none."""
    table.only("preset", "young", "poisson")
    young = table.number("young", "MPa", *YOUNG_RANGE)
    poisson = table.number("poisson", above=-1.0, high=0.4999)
    if "preset" in table:
        if young is not None or poisson is not None:
            table.fail("preset", "is given together with young or poisson: give one or the other")
        with table.at("preset"):
            return TissueData("preset", preset=table.text("preset"), fraction=0.0)
    if young is None and poisson is None:
        return None
    if young is None or poisson is None:
        table.fail(None, "needs both young (MPa) and poisson, or neither")
    return TissueData("isotropic", young=young, poisson=poisson)


def muscles_of(table: Table, folder: Path) -> case_parts.CaseMuscles:
    """A template's name is that of one in the package; a path leads to a folder."""
    if "fit" in table:
        table.fail("fit", "was removed, because it made faces worse (docs/moduli.md): delete it")
    template: Path | str = table.text("template", str(case_parts.CaseMuscles().template))
    if template != case_parts.CaseMuscles().template:
        template = table.path("template", folder)
    moduli = _muscle_moduli(table)
    return table.part(case_parts.CaseMuscles, folder, MODULI, template=template, moduli=moduli)


def _muscle_moduli(table: Table) -> TissueModuli:
    """Moduli of all muscles from the table itself, of single ones from those below `moduli`."""
    each = table.table("moduli")

    def given(table: Table) -> MuscleModuli:
        along, across = (table.number(key, "MPa", *YOUNG_RANGE) for key in MODULI[:2])
        poisson = table.number("poisson", above=-1.0, high=MOST_POISSON)
        return MuscleModuli(along, across, poisson)

    moduli = TissueModuli(
        muscle=given(table), muscles={name: given(each.table(name).only(*MODULI)) for name in each}
    )
    with table.at("moduli" if "moduli" in table else None):
        moduli.resolved(table.text("preset", case_parts.CaseMuscles().preset, PRESETS))
    return moduli


def photo_of(table: Table, folder: Path) -> case_parts.CasePhoto:
    """The 3D photo of [photo]."""
    photo = table.part(case_parts.CasePhoto, folder)
    if photo.aligned == (photo.landmarks is not None):
        table.fail(
            "aligned" if photo.aligned else None,
            "needs landmarks = a file with three skin landmarks or more on the photo, or aligned = "
            "true if it lies in the frame of the other data already; not both",
        )
    return photo


def postoperative_of(table: Table, folder: Path) -> case_parts.CasePostoperative:
    """The face and bones after the operation, from [postoperative]."""
    table.only(*case_parts.CasePostoperative.__dataclass_fields__)
    bones = _bones(table, folder)
    if "skin" in table and "image" in table:
        table.fail("image", "is given together with skin: give one of them")
    if "image" in table and "bones" in table:
        table.fail(
            "bones",
            "is given together with image, from which bones are segmented: give one of them",
        )
    if "series" in table and "image" not in table:
        table.fail("series", "chooses among the DICOM series of an image, but there is no image")
    if "skin" not in table and "image" not in table and not bones:
        table.fail(None, "needs skin, image or bones")
    return table.part(
        case_parts.CasePostoperative, folder, bones=bones, series=_dicom_series(table)
    )


def solver_of(table: Table) -> SolverOptions:
    """The options of [solver]."""
    names = tuple(SolverOptions().as_dict())
    table.only(*names)
    texts = {"method": METHODS, "contact": CONTACTS, "element": ELEMENTS, "kinematics": KINEMATICS}
    given: dict[str, Any] = {}
    for key in table:
        if key in texts:
            given[key] = table.text(key, choices=texts[key])
        else:
            given[key] = table.plain(key)
            with table.at(key):
                SolverOptions(**{key: given[key]})
    return SolverOptions(**given)


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
            motions[checked_name(table, name, name)] = motion_of(motion, folder)
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


def motion_of(table: Table, folder: Path) -> CaseMotion:
    """A motion by numbers, by a matrix, by a file, or by a bone before and after."""
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
    if angle is None and "axis" in given:
        table.fail("axis", "turns nothing without an angle: give angle (degrees), or remove axis")
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
    CaseError
        (also `ValueError`) What `predict --plan` would refuse: another ending than `.toml`, no
        segment, or a name that no segment can have.
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> motion = cmfsim.rigid_motion(translation=(0, -4, 0))
    >>> cmfsim.write_plan("plan.toml", {"maxilla": motion})
    """
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise CaseInputError(f"{path.name}: a plan is written as .toml")
    if not plan:
        raise CaseInputError(f"{path.name}: the plan has no motion: give one of a segment")
    for name in plan:
        if not is_segment_name(name):
            raise CaseInputError(f"segment {name!r} of the plan is not a valid name: {NAME_RULE}")
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
    replace_text(path, "\n".join(lines) + "\n")


def plan_head(segment: str) -> str:
    """The head of the table with a segment's motion."""
    return f"[plan.{segment if BARE.fullmatch(segment) else json.dumps(segment)}]"


def matrix_rows(matrix: Floats) -> list[str]:
    """The rows of TOML with a motion, (4, 4) mm."""
    rows = [f"  [{', '.join(repr(float(v)) for v in row)}]," for row in matrix]
    return ["matrix = [", *rows, "]"]
