"""A patient case and its file, `case.toml` (docs/formats.md).

Only the case file itself is read here. Paths that it names are resolved against its folder.
"""

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

from cmfsim.errors import CaseInputError
from cmfsim.io.cases import case_tables
from cmfsim.io.cases.case_tables import is_achieved, osteotomies_of, plan_of
from cmfsim.io.cases.tables import CaseChanges, Table, read_tables
from cmfsim.io.files.reading_writing import is_there
from cmfsim.values import case_parts
from cmfsim.values.checks import AnyPath, as_text, keep, listing
from cmfsim.values.solver_options import SolverOptions
from cmfsim.values.tissue_data import TissueData

CASE_FORMAT = "cmfsim-case"
# What a case's file is called where its folder alone is given.
CASE_FILE = "case.toml"
# What plans in files state of the case that they were made for.
MADE_FOR = re.compile(r"^# made for: ([0-9a-f]{64})\s*$", re.MULTILINE)
TABLES = (
    "format", "version", "name", "patient", "note", "image", "surfaces", "landmarks", "region",
    "mesh", "lips", "osteotomies", "plan", "node_kinds", "tissue", "muscles", "solver", "band",
    "postoperative", "photo", "bite", "output",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Case:
    """A patient: input files, cuts, plan and solver options.

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
        The plan is measured on the post-operative bones; `plan` is empty.
    node_kinds : mapping of str to plain values
        Options of the stage that classifies nodes.
    tissue : TissueData or None
        Fat: everywhere in a homogeneous model, between the muscles in the others. None: that of the
        muscles' preset, or of the default preset without muscles.
    muscles : CaseMuscles or None
        None: `cmfsim build` makes a model without muscles.
    solver : SolverOptions
    band : CaseBand
    postoperative : CasePostoperative or None
    photo : CasePhoto or None
    bite : CaseBite or None
        Scans of the bite that results are compared with; `cmfsim bite` makes a plan of them.
    patient : str
        Who it is, as report and chart state it: only what the user has written.
    note : str
        A remark for readers of the report, such as that the patient is synthetic.
    made_for : str
        What the file of its plan states of the case that it was made for (`with_plan`).
    places : mapping of str to str
        File and line of each dotted key, such as "case.toml:12", for findings.

    Examples
    --------
    >>> import cmfsim
    >>> case = cmfsim.Case.load("case.toml")
    """

    name: str
    file: Path
    output: Path
    image: case_parts.CaseImage | None = None
    surfaces: case_parts.CaseSurfaces | None = None
    landmarks: case_parts.CaseLandmarks = field(default_factory=case_parts.CaseLandmarks)
    region: case_parts.Region = field(default_factory=case_parts.Region)
    mesh: case_parts.CaseMesh = field(default_factory=case_parts.CaseMesh)
    lips: case_parts.CaseLips = field(default_factory=case_parts.CaseLips)
    osteotomies: tuple[case_parts.CaseOsteotomy, ...] = ()
    plan: Mapping[str, case_parts.CaseMotion] = field(default_factory=dict)
    achieved: bool = False
    node_kinds: Mapping[str, Any] = field(default_factory=dict)
    tissue: TissueData | None = None
    muscles: case_parts.CaseMuscles | None = None
    solver: SolverOptions = field(default_factory=SolverOptions)
    band: case_parts.CaseBand = field(default_factory=case_parts.CaseBand)
    postoperative: case_parts.CasePostoperative | None = None
    photo: case_parts.CasePhoto | None = None
    bite: case_parts.CaseBite | None = None
    patient: str = ""
    note: str = ""
    made_for: str = ""
    places: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        as_text("case name", self.name)
        if (self.image is None) == (self.surfaces is None):
            raise CaseInputError("a case has either an image or surfaces")
        if self.achieved and self.plan:
            raise CaseInputError("a plan is either given or achieved, not both")
        keep(self, plan=self.plan, node_kinds=self.node_kinds, places=self.places)

    def __repr__(self) -> str:
        """File, inputs, cuts, plan and muscles."""
        bones = () if self.surfaces is None else self.surfaces.bones
        cuts = [cut.procedure or f"plane for {cut.name}" for cut in self.osteotomies]
        muscles = self.muscles
        rows = {
            "file": str(self.file),
            "image": "" if self.image is None else self.image.file.name,
            "surfaces": ", ".join(["skin", *bones]) if self.surfaces is not None else "",
            "cuts": ", ".join(cuts),
            "plan": "achieved" if self.achieved else ", ".join(self.plan) or "nothing moves",
            "muscles": "none" if muscles is None else f"{muscles.template}, {muscles.preset}",
            "output": str(self.output),
        }
        return listing(f"Case {self.name!r}", rows)

    @property
    def fat(self) -> TissueData:
        """The fat of the case: `tissue`, or that of the preset of its muscles."""
        if self.tissue is not None:
            return self.tissue
        muscles = case_parts.CaseMuscles() if self.muscles is None else self.muscles
        return TissueData("preset", preset=muscles.preset, fraction=0.0)

    @classmethod
    def load(cls, path: AnyPath, *, changes: CaseChanges | None = None) -> "Case":
        """The case that a `case.toml` describes.

        Parameters
        ----------
        path : path
            Of the file, or of a folder that holds a `case.toml`.
        changes : CaseChanges, optional
            Of settings in the file. Paths in it are resolved against the folder of the case, too.

        Raises
        ------
        FileNotFoundError
            The case file does not exist. The files that it names are not checked.
        CaseError
            (also `ValueError`) Not TOML, an unknown key, a value of another type or out of range:
            with file, line and key.
        """
        # A script may change its working folder, where the same path leads to another patient.
        return _read(_case_file(Path(path)).absolute(), changes)

    def with_plan(self, path: AnyPath) -> "Case":
        """The case under the plan in another file, such as one saved by the planning page.

        Parameters
        ----------
        path : path
            TOML with tables `[plan.SEGMENT]`, as in a case, and nothing else. They replace the
            case's own plan: segments that they do not name stay. If the file states another case
            that it was made for, predictions have the finding `plan-other-case`.

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
            document.fail("plan", "has no motion: add tables [plan.SEGMENT]")
        made_for = MADE_FOR.search(Path(path).read_text(encoding="utf-8"))
        return replace(
            self,
            plan=plan_of(document, Path(path).absolute().parent),
            achieved=False,
            made_for="" if made_for is None else made_for[1],
        )

    def where(self, key: str) -> str:
        """File, line and key, as findings name a place in the case file."""
        parts = key.split(".")
        for length in range(len(parts), 0, -1):
            place = self.places.get(".".join(parts[:length]))
            if place is not None:
                return f"{place} {key}"
        return f"{self.file.name} {key}"


# What functions on cases take.
CaseOrPath: TypeAlias = Case | AnyPath


def as_case(case: CaseOrPath) -> Case:
    """The case itself, or the one that the file or folder at a path describes, as `Case.load`."""
    if isinstance(case, Case):
        return case
    if isinstance(case, str | os.PathLike):
        return Case.load(case)
    raise CaseInputError(
        f"the case is of type {type(case).__name__}: give a Case, or the path of a case.toml or "
        "of the folder that contains it"
    )


def _case_file(path: Path) -> Path:
    """The case file that a path leads to: itself, or the one in a folder."""
    if not is_there(path) or not path.is_dir():
        return path
    file = path / CASE_FILE
    if not file.exists():
        raise CaseInputError(
            f"{path.resolve()}: is a folder without a {CASE_FILE}: give the path of the case "
            "file, or of the folder that contains it"
        )
    return file


def _read(path: Path, changes: CaseChanges | None) -> Case:
    document = read_tables(path)
    if changes is not None:
        document = document.changed(changes)
    document.only(*TABLES)
    document.check_format(CASE_FORMAT)
    folder = path.parent
    if "image" in document and "surfaces" in document:
        document.fail("surfaces", "is given together with [image]: give one of them")
    if "image" not in document and "surfaces" not in document:
        document.fail(None, "needs [image] or [surfaces]")

    def given(name: str, read: Callable[[Table, Path], Any]) -> Any:
        return read(document.table(name), folder) if name in document else None

    return Case(
        name=document.text("name", path.resolve().parent.name or "case"),
        file=path,
        output=case_tables.output_folder(document.table("output").only("folder"), folder),
        image=given("image", case_tables.image_of),
        surfaces=given("surfaces", case_tables.surfaces_of),
        landmarks=case_tables.landmarks_of(document.table("landmarks"), folder),
        region=case_tables.region_of(document.table("region"), folder),
        mesh=case_tables.mesh_of(document.table("mesh"), folder),
        lips=case_tables.lips_of(document, folder),
        osteotomies=osteotomies_of(document),
        plan={} if is_achieved(document) else plan_of(document, folder),
        achieved=is_achieved(document),
        node_kinds=case_tables.node_kinds_of(document.table("node_kinds")),
        tissue=case_tables.tissue_of(document.table("tissue")),
        muscles=given("muscles", case_tables.muscles_of),
        solver=case_tables.solver_of(document.table("solver")),
        band=replace(
            document.table("band").part(case_parts.CaseBand, folder), asked="band" in document
        ),
        postoperative=given("postoperative", case_tables.postoperative_of),
        photo=given("photo", case_tables.photo_of),
        bite=given("bite", lambda table, folder: table.part(case_parts.CaseBite, folder)),
        patient=document.text("patient") if "patient" in document else "",
        note=document.text("note") if "note" in document else "",
        places=document.all_places(),
    )
