"""Tables of a case file but those of its plan: what each may hold, and within what limits."""

from pathlib import Path, PurePosixPath
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS, PRESETS
from cmfsim.errors import CaseInputError
from cmfsim.io.cases.tables import Table
from cmfsim.io.files.reading_writing import is_there
from cmfsim.values import case_parts
from cmfsim.values.moduli import MOST_POISSON, YOUNG_RANGE, MuscleModuli, TissueModuli
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
    image = table.part(case_parts.CaseImage, folder, series=series, rescale=rescale, bones=bones)
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


def checked_name(table: Table, key: str, name: str) -> str:
    """A name that can stand in a file name: of a bone or segment."""
    if not name or not all(c.isalnum() or c in "_-+" for c in name) or len(name) > 64:
        table.fail(
            key, f"is not a valid name ({name!r}): letters, digits, '_', '-' and '+', 64 at most"
        )
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
    parting = None
    if "parting" in table:
        parting = table.table("parting").only("surface").path("surface", folder)
    return table.part(case_parts.CaseMesh, folder, parting=parting)


def lips_of(document: Table, folder: Path) -> case_parts.CaseLips:
    """Whether and where lips are separated; a seam is a way to find it, or a surface."""
    table = document.table("lips")
    seam: Path | str | None = table.text("seam") if "seam" in table else None
    if seam is not None and seam not in case_parts.LIP_SEAMS:
        seam = table.path("seam", folder)
        if "parting" in document.table("mesh"):
            table.fail("seam", "is a surface, as is parting in [mesh]: give one of them")
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
