"""A patient case and its file, `case.toml`: what each table may hold (docs/formats.md).

Only the case file itself is read here. Paths that it names are resolved against its folder.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, TypeAlias

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS, PRESETS
from cmfsim.checks import as_text
from cmfsim.errors import CaseInputError
from cmfsim.io.files import FORMAT_VERSION, is_there
from cmfsim.io.tables import Table, read_tables
from cmfsim.io.transforms import DIRECTION_CHOICE, is_itk_file, motion_in_lps
from cmfsim.values.case_parts import (
    DIRECTIONS,
    FRAMES,
    LIP_SEAMS,
    PROCEDURES,
    UNITS,
    CaseImage,
    CaseLandmarks,
    CaseLips,
    CaseMesh,
    CaseMotion,
    CaseMuscles,
    CaseOsteotomy,
    CasePostoperative,
    CaseSurfaces,
    Plane,
    Region,
)
from cmfsim.values.moduli import MOST_POISSON, YOUNG_RANGE, MuscleModuli, TissueModuli
from cmfsim.values.motion import rigid_matrix, rigid_motion
from cmfsim.values.solver_options import CONTACTS, SolverOptions
from cmfsim.values.tissue_data import MIXINGS, TissueData

__all__ = ["CASE_FORMAT", "Case", "CaseOrPath", "as_case"]

CASE_FORMAT = "cmfsim-case"
# What a case's file is called where its folder alone is given.
CASE_FILE = "case.toml"
# What stands for the plan where it is read off the bones after the operation.
ACHIEVED = "achieved"
TABLES = (
    "format",
    "version",
    "name",
    "note",
    "image",
    "surfaces",
    "landmarks",
    "region",
    "mesh",
    "lips",
    "osteotomies",
    "plan",
    "node_kinds",
    "tissue",
    "muscles",
    "solver",
    "postoperative",
    "output",
)
# What [muscles] and each table below [muscles.moduli] may set, as `MuscleModuli` has it.
MODULI = ("young_along", "young_across", "poisson")
# Points in a tet that a muscle's surface crosses.
SAMPLES = (1, 100_000)
# Edge lengths that make a mesh of a head, mm: below, more tets than any memory; above, no face.
EDGE_LENGTHS = (0.3, 30.0)
MOST_CLEFT = 20.0
# How far the seam between the lips may go on past the teeth, and lips may reach from it, mm.
MOST_LIP_DEPTH = 20.0
LIP_HEIGHTS = (3.0, 30.0)
# CT values above this are clipped, HU.
MOST_HU = 4000.0
# What takes the values of an image to HU: images from 0 to 1 have a slope of some 4000.
MOST_SLOPE = 1e5
MOST_INTERCEPT = 1e5
# Grid spacings that a head can be worked on at, mm.
WORKING_SPACINGS = (0.2, 5.0)


@dataclass(frozen=True, eq=False)
class Case:
    """A patient: what to read, where to cut, what moves, and how to solve.

    Attributes
    ----------
    name : str
    file : Path
        The case file.
    output : Path
        Folder of everything that is written for the case.
    image : CaseImage or None
        Exactly one of `image` and `surfaces` is given.
    surfaces : CaseSurfaces or None
    landmarks : CaseLandmarks
    region : Region
    mesh : CaseMesh
    lips : CaseLips
    osteotomies : tuple of CaseOsteotomy
        In the order in which they are made.
    plan : mapping of str to CaseMotion
        Segments that it does not name stay.
    achieved : bool
        The plan is what the operation achieved, read off the bones after it; `plan` is empty.
    node_kinds : mapping of str to plain values
        Options of the stage that classifies nodes.
    tissue : TissueData
        Fat: everywhere in a homogeneous model, between the muscles in the others.
    muscles : CaseMuscles or None
        None leaves them out of what `cmfsim build` makes.
    solver : SolverOptions
    postoperative : CasePostoperative or None
    note : str
        What readers of its report should know, such as that the patient is made by code.
    lines : mapping of str to int
        The line of each dotted key in the case file, for findings.

    Examples
    --------
    >>> import cmfsim
    >>> case = cmfsim.Case.load("case.toml")  # doctest: +SKIP
    """

    name: str
    file: Path
    output: Path
    image: CaseImage | None = None
    surfaces: CaseSurfaces | None = None
    landmarks: CaseLandmarks = field(default_factory=CaseLandmarks)
    region: Region = field(default_factory=Region)
    mesh: CaseMesh = field(default_factory=CaseMesh)
    lips: CaseLips = field(default_factory=CaseLips)
    osteotomies: tuple[CaseOsteotomy, ...] = ()
    plan: Mapping[str, CaseMotion] = field(default_factory=dict)
    achieved: bool = False
    node_kinds: Mapping[str, Any] = field(default_factory=dict)
    tissue: TissueData = field(default_factory=lambda: TissueData("preset", fraction=0.0))
    muscles: CaseMuscles | None = None
    solver: SolverOptions = field(default_factory=SolverOptions)
    postoperative: CasePostoperative | None = None
    note: str = ""
    lines: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        as_text("case name", self.name)
        if (self.image is None) == (self.surfaces is None):
            raise CaseInputError("a case has either an image or surfaces")
        if self.achieved and self.plan:
            raise CaseInputError("a plan is given or achieved, not both")
        for name in ("plan", "node_kinds", "lines"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Case":
        """The case that a `case.toml` describes.

        Parameters
        ----------
        path : path
            Of the file, or of a folder that holds a `case.toml`.

        Returns
        -------
        Case

        Raises
        ------
        FileNotFoundError
            The case file does not exist. Files that it names are not looked for.
        CaseError
            (also `ValueError`) Not TOML, an unknown key, a value of another type or out of range:
            with file, line and key.
        """
        return _read(_case_file(Path(path)))

    def with_plan(self, path: str | os.PathLike[str]) -> "Case":
        """The case under the plan in another file, such as one saved by the planning page.

        Parameters
        ----------
        path : path
            TOML with tables `[plan.SEGMENT]`, as in a case, and nothing else. They replace the
            case's own plan: segments that they do not name stay.

        Raises
        ------
        FileNotFoundError
            The file does not exist.
        CaseError
            (also `ValueError`) Not TOML, another table, no motion, or one that is not valid: with
            file, line and key.
        """
        document = read_tables(Path(path)).only("plan")
        if not list(document.table("plan")):
            document.fail("plan", "has no motion: tables [plan.SEGMENT] are needed")
        return replace(self, plan=_plan(document, Path(path).parent), achieved=False)

    def where(self, key: str) -> str:
        """File, line and key, as findings name a place in the case file."""
        parts = key.split(".")
        for length in range(len(parts), 0, -1):
            line = self.lines.get(".".join(parts[:length]))
            if line is not None:
                return f"{self.file.name}:{line} {key}"
        return f"{self.file.name} {key}"


# What functions on cases take.
CaseOrPath: TypeAlias = Case | str | os.PathLike[str]


def as_case(case: CaseOrPath) -> Case:
    """The case itself, or the one that the file or folder at a path describes.

    Parameters
    ----------
    case : Case or path

    Raises
    ------
    FileNotFoundError, CaseError
        As `Case.load`; `CaseError` (also `ValueError`) also for anything else.
    """
    if isinstance(case, Case):
        return case
    if isinstance(case, str | os.PathLike):
        return Case.load(case)
    raise CaseInputError(
        f"the case is of type {type(case).__name__}: give a Case, or the path of a case.toml or of "
        "the folder that holds it"
    )


def _case_file(path: Path) -> Path:
    """The case file that a path leads to: itself, or the one in a folder."""
    if not is_there(path) or not path.is_dir():
        return path
    file = path / CASE_FILE
    if not file.exists():
        raise CaseInputError(
            f"{path.resolve()}: is a folder without a {CASE_FILE}: name the case file, or the "
            "folder that holds it"
        )
    return file


def _read(path: Path) -> Case:
    document = read_tables(path).only(*TABLES)
    found = document.text("format")
    if found != CASE_FORMAT:
        document.fail("format", f"is {found!r}: {CASE_FORMAT!r} is needed")
    version = document.need("version", f": write version = {FORMAT_VERSION}")
    if isinstance(version, bool) or version != FORMAT_VERSION:
        document.fail("version", f"is {version!r}: this cmfsim reads {FORMAT_VERSION}")
    folder = path.parent
    if ("image" in document) == ("surfaces" in document):
        both = "image" in document
        document.fail(
            "surfaces" if both else None,
            "stands beside [image]: give one of them" if both else "lacks [image] or [surfaces]",
        )
    return Case(
        name=document.text("name", path.resolve().parent.name or "case"),
        file=path,
        output=_output(document.table("output").only("folder"), folder),
        image=_image(document.table("image"), folder) if "image" in document else None,
        surfaces=_surfaces(document.table("surfaces"), folder) if "surfaces" in document else None,
        landmarks=_landmarks(document.table("landmarks"), folder),
        region=_region(document.table("region")),
        mesh=_mesh(document.table("mesh"), folder),
        lips=_lips(document, folder),
        osteotomies=_osteotomies(document),
        plan={} if _is_achieved(document) else _plan(document, folder),
        achieved=_is_achieved(document),
        node_kinds=_node_kinds(document.table("node_kinds")),
        tissue=_tissue(document.table("tissue")),
        muscles=_muscles(document.table("muscles"), folder) if "muscles" in document else None,
        solver=_solver(document.table("solver")),
        postoperative=(
            _postoperative(document.table("postoperative"), folder)
            if "postoperative" in document
            else None
        ),
        note=document.text("note") if "note" in document else "",
        lines=document.all_lines(),
    )


def _frame(table: Table) -> str | None:
    """The frame of numbers or files, where the case states it."""
    return table.text("frame", choices=FRAMES) if "frame" in table else None


def _file(table: Table, key: str, folder: Path) -> Path:
    """A path to read; the case is its owner's, so that it may lead to images kept elsewhere."""
    return table.path(key, folder)


def _file_or_none(table: Table, key: str, folder: Path) -> Path | None:
    return _file(table, key, folder) if key in table else None


def _output(table: Table, folder: Path) -> Path:
    """The folder to write to, below that of the case: a case never writes anywhere else."""
    name = table.text("folder", "out")
    relative = PurePosixPath(name)
    plain = not relative.is_absolute() and ".." not in relative.parts
    if not plain or any(c in name for c in "\\:\0") or relative == PurePosixPath():
        table.fail(
            "folder",
            f"is {name!r}: name a folder below the case's own (another one: cmfsim build -o)",
        )
    try:
        is_there(folder / relative)
    except CaseInputError as error:
        table.fail("folder", f"names {error}")
    return folder / relative


def _image(table: Table, folder: Path) -> CaseImage:
    table.only(
        "file",
        "skin_threshold",
        "bone_threshold",
        "metal_threshold",
        "working_spacing",
        "series",
        "rescale",
    )
    skin = table.number("skin_threshold", "HU", low=-1024.0, high=3071.0)
    bone = table.number("bone_threshold", "HU", low=-1024.0, high=3071.0)
    metal = table.number("metal_threshold", "HU", low=-1024.0, high=MOST_HU)
    if skin is not None and bone is not None and skin >= bone:
        table.fail("skin_threshold", f"is {skin:g}, bone_threshold {bone:g}: it must be below")
    if bone is not None and metal is not None and bone >= metal:
        table.fail("bone_threshold", f"is {bone:g}, metal_threshold {metal:g}: it must be below")
    low, high = WORKING_SPACINGS
    spacing = table.number("working_spacing", "mm", low=low, high=high)
    path = _file(table, "file", folder)
    return CaseImage(path, skin, bone, spacing, metal, _dicom_series(table), _rescale(table))


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


def _surfaces(table: Table, folder: Path) -> CaseSurfaces:
    table.only("skin", "bones", "units", "frame")
    bones = table.table("bones")
    names = list(bones)
    if not names:
        table.fail("bones" if "bones" in table else None, 'names no bone: cranium = "file.ply"')
    return CaseSurfaces(
        skin=_file(table, "skin", folder),
        bones={_name(bones, name, name): _file(bones, name, folder) for name in names},
        units=table.text("units", "mm", tuple(UNITS)),
        frame=_frame(table),
    )


def _name(table: Table, key: str, name: str) -> str:
    """A name that can stand in a file name: of a bone or segment."""
    if not name or not all(c.isalnum() or c in "_-+" for c in name) or len(name) > 64:
        table.fail(key, f"is no name ({name!r}): letters, digits, '_', '-' and '+', 64 at most")
    return name


def _landmarks(table: Table, folder: Path) -> CaseLandmarks:
    table.only("skull", "skin", "frame", "automatic", "templates")
    return CaseLandmarks(
        _file_or_none(table, "skull", folder),
        _file_or_none(table, "skin", folder),
        _frame(table),
        table.flag("automatic", default=True),
        _template_folders(table, folder),
    )


def _template_folders(table: Table, folder: Path) -> tuple[Path, ...]:
    """The folders of heads whose landmarks are known."""
    if "templates" not in table:
        return ()
    given = table.plain("templates")
    if not isinstance(given, list) or not all(isinstance(n, str) and n.strip() for n in given):
        table.fail("templates", f'is {given!r}: a list of folders, such as ["heads/a", "heads/b"]')
    return tuple(folder / name for name in given)


def _plane(table: Table, key: str) -> Plane:
    plane = table.table(key).only("point", "normal")
    point, normal = plane.vector("point"), plane.vector("normal")
    if point is None or normal is None:
        table.fail(key, "needs point = [x, y, z] and normal = [x, y, z]")
    with table.at(key):
        return Plane(point, normal)


def _region(table: Table) -> Region:
    table.only("posterior_plane", "posterior_depth", "lower", "upper")
    if "posterior_plane" in table and "posterior_depth" in table:
        table.fail("posterior_depth", "stands beside posterior_plane: give one of them")
    plane = _plane(table, "posterior_plane") if "posterior_plane" in table else None
    with table.at("lower"):
        return Region(
            plane,
            table.number("posterior_depth", "mm", low=-200.0, high=200.0),
            table.number("lower", "mm"),
            table.number("upper", "mm"),
        )


def _mesh(table: Table, folder: Path) -> CaseMesh:
    table.only("edge_length", "refine", "cleft", "parting", "file")
    low, high = EDGE_LENGTHS
    edge_length = table.number("edge_length", "mm", low=low, high=high)
    cleft = table.number("cleft", "mm", low=0.0, high=MOST_CLEFT)
    parting = table.table("parting").only("surface") if "parting" in table else None
    default = CaseMesh()
    return CaseMesh(
        default.edge_length if edge_length is None else edge_length,
        table.flag("refine", default=default.refine),
        default.cleft if cleft is None else cleft,
        None if parting is None else _file(parting, "surface", folder),
        _file_or_none(table, "file", folder),
    )


def _lips(document: Table, folder: Path) -> CaseLips:
    """Whether and where lips are separated; a seam is a way to find it, or a surface."""
    table = document.table("lips").only("contact", "seam", "depth", "height")
    default = CaseLips()
    contact = table.flag("contact", default=default.contact)
    seam: Path | str = default.seam
    if "seam" in table:
        seam = table.text("seam")
        if seam not in LIP_SEAMS:
            seam = _file(table, "seam", folder)
            if "parting" in document.table("mesh"):
                table.fail("seam", "is a surface, as parting in [mesh] is: give one of them")
    depth = table.number("depth", "mm", low=0.0, high=MOST_LIP_DEPTH)
    low, high = LIP_HEIGHTS
    height = table.number("height", "mm", low=low, high=high)
    return CaseLips(
        contact,
        seam,
        default.depth if depth is None else depth,
        default.height if height is None else height,
    )


def _osteotomies(document: Table) -> tuple[CaseOsteotomy, ...]:
    cuts: list[CaseOsteotomy] = []
    made: dict[str, int] = {}
    for table in document.tables("osteotomies"):
        if "procedure" in table:
            procedure = table.text("procedure", choices=tuple(PROCEDURES))
            options = {key: table.plain(key) for key in table if key != "procedure"}
            cut = CaseOsteotomy(procedure, options)
        elif "plane" in table:
            table.only("plane", "bone", "name")
            name = _name(table, "name", table.text("name"))
            cut = CaseOsteotomy(plane=_plane(table, "plane"), bone=table.text("bone"), name=name)
        else:
            known = ", ".join(PROCEDURES)
            table.fail(None, f"needs procedure (one of {known}), or plane, bone and name")
        for segment in cut.segments:
            if segment in made:
                table.fail(None, f"makes {segment!r}, as the one on line {made[segment]} does")
            made[segment] = table.line()
        cuts.append(cut)
    return tuple(cuts)


def _is_achieved(document: Table) -> bool:
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
            "is achieved, and there is no bone after the operation to read it off: add "
            "[postoperative] image, or [postoperative.bones]",
        )
    return True


def _plan(document: Table, folder: Path) -> dict[str, CaseMotion]:
    table = document.table("plan")
    motions = {}
    for name in table:
        motion = table.table(name)
        if "moved" in motion:
            motions[_name(table, name, name)] = _moved(document, motion, name, folder)
        else:
            motions[_name(table, name, name)] = _motion(motion, folder)
    return motions


def _moved(document: Table, motion: Table, name: str, folder: Path) -> CaseMotion:
    """The motion of a bone of the case, given by the same surface after it moved."""
    bones = document.table("surfaces").table("bones") if "surfaces" in document else ()
    if name not in bones:
        known = f"one of {', '.join(bones)}" if bones else "no bone, for there is no [surfaces]"
        motion.fail(
            "moved",
            f"is for bones that [surfaces.bones] names ({known}), not for {name!r}: give surface "
            "and moved_surface, the piece before and after",
        )
    before = _file(document.table("surfaces").table("bones"), name, folder)
    return CaseMotion(surface=before, moved_surface=_file(motion.only("moved"), "moved", folder))


def _motion(table: Table, folder: Path) -> CaseMotion:
    if "transform" in table:
        return _transform(table.only("transform"), folder)
    if "moved_surface" in table or "surface" in table:
        table.only("surface", "moved_surface")
        surface = _file(table, "surface", folder)
        return CaseMotion(surface=surface, moved_surface=_file(table, "moved_surface", folder))
    frame = _frame(table)
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
        file = _file(motion, key, folder)
        if is_itk_file(file):
            name = motion.text(key)
            motion.fail(
                key,
                f"is an ITK file, which does not record its direction: write {key} = {{ file = "
                f'"{name}", direction = "..." }} with {DIRECTION_CHOICE}',
            )
        return CaseMotion(transform=file)
    table = motion.table(key).only("file", "direction", "frame")
    file = _file(table, "file", folder)
    direction = table.text("direction", choices=DIRECTIONS) if "direction" in table else None
    frame = _frame(table)
    if is_itk_file(file) and direction is None:
        table.fail(
            None, f"lacks direction, which the ITK file does not record: write {DIRECTION_CHOICE}"
        )
    if is_itk_file(file) and frame == "RAS":
        table.fail(
            "frame",
            'is "RAS", but ITK files (.tfm, .h5) are in LPS always, those that 3D Slicer saves as '
            "well: remove frame",
        )
    return CaseMotion(transform=file, direction=direction, frame=frame)


def _node_kinds(table: Table) -> dict[str, Any]:
    """The options by name; regions as plain tables."""
    options = {key: table.plain(key) for key in table if key != "regions"}
    if "regions" in table:
        options["regions"] = [_plain(region) for region in table.tables("regions")]
    return options


def _plain(table: Table) -> dict[str, Any]:
    return {key: table.plain(key) for key in table}


def _tissue(table: Table) -> TissueData:
    """Fat of the paper's Table 1 unless the case says otherwise."""
    table.only("preset", "young", "poisson")
    young = table.number("young", "MPa", above=0.0, high=1e5)
    poisson = table.number("poisson", above=-1.0, high=0.4999)
    if young is None and poisson is None:
        with table.at("preset"):
            return TissueData("preset", preset=table.text("preset", "kim2010"), fraction=0.0)
    if "preset" in table:
        table.fail("preset", "stands beside young or poisson: give the one or the others")
    if young is None or poisson is None:
        table.fail(None, "needs both young (MPa) and poisson, or neither")
    return TissueData("isotropic", young=young, poisson=poisson)


def _muscles(table: Table, folder: Path) -> CaseMuscles:
    """A template's name is that of one in the package; a path leads to a folder."""
    settings = ("template", "smoothing", "preset", "mixing", "samples", "seed")
    table.only(*settings, *MODULI, "moduli")
    default = CaseMuscles()
    template: Path | str = table.text("template", str(default.template))
    if template != default.template:
        template = _file(table, "template", folder)
    smoothing = table.number("smoothing", low=0.0, high=1e6)
    return CaseMuscles(
        template,
        default.smoothing if smoothing is None else smoothing,
        table.text("preset", default.preset, PRESETS),
        table.text("mixing", default.mixing, MIXINGS),
        table.whole("samples", default.samples, *SAMPLES),
        table.whole("seed", default.seed, 0, 2**63 - 1),
        _muscle_moduli(table),
    )


def _muscle_moduli(table: Table) -> TissueModuli:
    """Moduli of all muscles from the table itself, of single ones from those below `moduli`."""
    each = table.table("moduli")

    def given(table: Table) -> MuscleModuli:
        low, high = YOUNG_RANGE
        along, across = (table.number(key, "MPa", low=low, high=high) for key in MODULI[:2])
        poisson = table.number("poisson", above=-1.0, high=MOST_POISSON)
        return MuscleModuli(along, across, poisson)

    moduli = TissueModuli(
        muscle=given(table), muscles={name: given(each.table(name).only(*MODULI)) for name in each}
    )
    with table.at("moduli" if "moduli" in table else None):
        moduli.resolved(table.text("preset", CaseMuscles().preset, PRESETS))
    return moduli


def _postoperative(table: Table, folder: Path) -> CasePostoperative:
    table.only("skin", "image", "landmarks", "bones", "aligned", "units", "frame", "series")
    bones = table.table("bones")
    if "skin" in table and "image" in table:
        table.fail("image", "stands beside skin: give one of them")
    if "image" in table and "bones" in table:
        table.fail("bones", "stands beside image, from which bones are read: give one of them")
    if "series" in table and "image" not in table:
        table.fail("series", "chooses among the DICOM series of an image, and there is no image")
    if "skin" not in table and "image" not in table and not list(bones):
        table.fail(None, "lacks skin, image or bones")
    return CasePostoperative(
        _file_or_none(table, "skin", folder),
        _file_or_none(table, "image", folder),
        _file_or_none(table, "landmarks", folder),
        {_name(bones, name, name): _file(bones, name, folder) for name in bones},
        table.flag("aligned", default=True),
        table.text("units", "mm", tuple(UNITS)),
        _frame(table),
        _dicom_series(table),
    )


def _solver(table: Table) -> SolverOptions:
    names = tuple(SolverOptions().as_dict())
    table.only(*names)
    given: dict[str, Any] = {}
    for key in table:
        if key == "method":
            given[key] = table.text(key, choices=METHODS)
        elif key == "contact":
            given[key] = table.text(key, choices=CONTACTS)
        elif key == "element":
            given[key] = table.text(key, choices=ELEMENTS)
        elif key == "kinematics":
            given[key] = table.text(key, choices=KINEMATICS)
        else:
            given[key] = table.plain(key)
            with table.at(key):
                SolverOptions(**{key: given[key]})
    return SolverOptions(**given)
