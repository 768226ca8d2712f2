"""The parts of a patient case as its file states them: files, cuts, motions, region, mesh.

docs/formats.md has every key with its meaning; here is what it does not say. Nothing is read from
disk here: files may be missing, which `cmfsim doctor` says. `cmfsim.Case` holds the whole.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import PRESETS
from cmfsim.errors import CaseInputError
from cmfsim.values import checks
from cmfsim.values.moduli import TissueModuli
from cmfsim.values.tissue_data import DEFAULT_PRESET, MIXINGS

# Distance of the posterior plane behind the roots of the zygomatic arches, mm: behind the whole
# ramus and its joint, so that the jaw moves inside tissue, and before the mastoid and neck.
POSTERIOR_DEPTH = 10.0
# Share of the head's depth, from the foremost point of the skin, in front of the plane where there
# are no landmarks: the same plane on a head of ordinary proportions.
POSTERIOR_SHARE = 0.6
# Landmarks that the posterior plane is placed from: the roots of the arches, in front of the ears.
POSTERIOR_LANDMARKS = ("supraglenoid_L", "supraglenoid_R")
# Units that a surface file may be in, and their length in mm.
UNITS: Mapping[str, float] = MappingProxyType(
    {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "inch": 25.4}
)
# Longest extent of a skin from a face mask to a head with neck, mm.
SKIN_EXTENT = (110.0, 420.0)
FRAMES = ("LPS", "RAS")
# What the numbers of a transform file do, in 3D Slicer's words: carry a bone from where it is to
# where it goes, or the moved bone back.
DIRECTIONS = ("to-parent", "from-parent")
# Standard procedures, and the segments that each makes (paper 2.1, 3.1).
PROCEDURES: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "le_fort_1": ("maxilla",), "le_fort_3": ("midface",),
    "bsso": ("mandible_body", "ramus_left", "ramus_right"), "genioplasty": ("chin",),
})  # fmt: skip
# The bone that a procedure cuts up, so that no segment has its name afterwards.
CUT_UP: Mapping[str, str] = MappingProxyType({"bsso": "mandible"})
# Edge length of the mesh where a case states none, mm: some 400 000 tets of a face with its neck,
# whose edges are 2.9 mm long on average, half of an edge where tissue is thin.
EDGE_LENGTH = 4.0
# Tooth rows rest 2 to 4 mm apart, and a mucoperiosteal flap is lifted about as far at a cut, mm.
CLEFT = 4.0
# Share of cases that a band is to hold, where nothing else is asked for.
BAND_COVERAGE = 0.9
# Whether lips are separated, and kept apart by contact, where a case does not ask for it.
LIP_CONTACT = False
# Ways to find the seam between the lips, besides a surface.
LIP_SEAMS = ("auto", "landmarks")
# How far it goes on past the front of the teeth, mm: through the tissue between their rows.
LIP_DEPTH = 8.0
# How far from it a lip reaches, mm: over its red, and inside to the roots of the front teeth.
LIP_HEIGHT = 13.0
# How far the seam between the lips may go on past the teeth, and lips may reach from it, mm.
MOST_LIP_DEPTH = 20.0
LIP_HEIGHTS = (3.0, 30.0)
# Wider, mm, than any muscle of the face is thick.
MOST_BLUR = 30.0
# Points in a tet that a muscle's surface crosses.
SAMPLES = (1, 100_000)
# Edge lengths that make a mesh of a head, mm: below, more tets than most memories hold (30 million
# at 1 mm, a gigabyte each million); above, no face.
EDGE_LENGTHS = (1.0, 30.0)
MOST_CLEFT = 20.0
# Coverages of a band that a calibration of up to a thousand cases can give.
COVERAGES = (0.001, 0.999)
# CT values of thresholds; those above the last are clipped, HU.
TISSUE_HU, METAL_HU = (-1024.0, 3071.0), (-1024.0, 4000.0)
# Grid spacings that a head can be worked on at, mm.
WORKING_SPACINGS = (0.2, 5.0)

# A field that a case file states under its name (`Table.part`): any text, flag or file.
PLAIN: Mapping[str, Any] = MappingProxyType({"unit": "", "range": (None, None), "choices": ()})


def stated(
    default: Any,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Iterable[str] = (),
) -> Any:
    """Such a field with a default, a unit, a range or choices."""
    metadata = {"unit": unit, "range": (low, high), "choices": tuple(choices)}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, eq=False)
class Plane(checks.Frozen):
    """A plane through a point (3,), mm, LPS. Its normal is made a unit vector: never zero."""

    point: checks.Floats
    normal: checks.Floats

    def __init__(self, point: ArrayLike, normal: ArrayLike, called: str = "plane") -> None:
        unit = checks.as_direction(f"{called} normal", normal)
        checks.keep(self, point=checks.as_point(f"{called} point", point), normal=unit)

    def distance(self, points: ArrayLike) -> checks.Floats:
        """The signed distances of (n, 3) points from the plane, mm: positive along its normal."""
        offsets = checks.as_rows("points", points, 3) - self.point
        return offsets @ self.normal


@dataclass(frozen=True)
class Region:
    """The part of the head that is meshed, in front of a posterior plane (its normal backwards)."""

    posterior_plane: Plane | None = None
    posterior_depth: float | None = stated(None, "mm", -200.0, 200.0)
    lower: float | None = stated(None, "mm")
    upper: float | None = stated(None, "mm")

    def __post_init__(self) -> None:
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise CaseInputError(f"lower is {self.lower:g}, upper {self.upper:g}: lower < upper")

    def plane(self, landmarks: Mapping[str, ArrayLike], foremost: float, hindmost: float) -> Plane:
        """The posterior plane: as given, or coronal, from skull landmarks or from the head's depth.

        foremost, hindmost: mm. P coordinates of the skin's first and last point.
        """
        if self.posterior_plane is not None:
            return self.posterior_plane
        depth = POSTERIOR_DEPTH if self.posterior_depth is None else self.posterior_depth
        roots = [np.asarray(landmarks[n]) for n in POSTERIOR_LANDMARKS if n in landmarks]
        if len(roots) == len(POSTERIOR_LANDMARKS):
            height = float(np.mean([root[1] for root in roots])) + depth
        elif self.posterior_depth is not None:
            names = " and ".join(POSTERIOR_LANDMARKS)
            raise CaseInputError(
                f"posterior_depth is {depth:g} mm behind {names}, which are not among the "
                "landmarks: add them, or give posterior_plane"
            )
        else:
            height = foremost + POSTERIOR_SHARE * (hindmost - foremost)
        return Plane((0.0, height, 0.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class CaseBite:
    """Intraoral scans in occlusion, in one frame: those of the CT, or in the bite of a plan."""

    upper: Path = field(metadata=PLAIN)
    lower: Path = field(metadata=PLAIN)


@dataclass(frozen=True)
class CaseImage:
    """A CT and how to read tissue from it; None stands for the default of the imaging stage."""

    file: Path = field(metadata=PLAIN)
    skin_threshold: float | None = stated(None, "HU", *TISSUE_HU)
    bone_threshold: float | None = stated(None, "HU", *TISSUE_HU)
    working_spacing: float | None = stated(None, "mm", *WORKING_SPACINGS)
    metal_threshold: float | None = stated(None, "HU", *METAL_HU)
    series: str | None = None
    rescale: tuple[float, float] | None = None
    bones: Mapping[str, Path] = field(default_factory=dict)
    teeth: CaseBite | None = None

    def __post_init__(self) -> None:
        checks.keep(self, bones=self.bones)


@dataclass(frozen=True)
class CaseSurfaces:
    """Surfaces of skin and bones. `frame` None: as each header states, LPS where none does."""

    skin: Path = field(metadata=PLAIN)
    bones: Mapping[str, Path]
    units: str = stated("mm", choices=UNITS)
    frame: str | None = stated(None, choices=FRAMES)

    def __post_init__(self) -> None:
        checks.check_one_of("units", self.units, tuple(UNITS))
        if self.frame is not None:
            checks.check_one_of("frame", self.frame, FRAMES)
        checks.keep(self, bones=self.bones)


# With fewer landmarks of the skull than this, the others are found where the case needs them.
FEW_SITES = 12


@dataclass(frozen=True)
class CaseLandmarks:
    """Files of landmarks, 3D Slicer's `.mrk.json` or `.fcsv`.

    automatic: Whether landmarks are found automatically where neither file is given, and the others
        where the one of the skull has fewer than twelve; "missing": whatever the files lack.
    """

    skull: Path | None = stated(None)
    skin: Path | None = stated(None)
    frame: str | None = stated(None, choices=FRAMES)
    automatic: bool | str = True
    templates: tuple[Path, ...] = ()

    @property
    def proposed(self) -> bool:
        """Whether landmarks are to be found automatically: none are given, or not all."""
        none = self.skull is None and self.skin is None
        return self.fills or (bool(self.automatic) and none)

    @property
    def fills(self) -> bool:
        """Whether landmarks that the files lack are filled in."""
        return self.automatic == "missing"

    def is_completed(self, count: int) -> bool:
        """Whether others are found automatically for want of sites, `count` of the skull placed."""
        return bool(self.automatic) and 0 < count < FEW_SITES


@dataclass(frozen=True)
class CaseMesh:
    """Options of the mesh of the soft tissue; none is used where a file has the tets.

    cleft: mm. Tissue of which two segments that part are less than this away, taken together, is
        left out: between tooth rows and at cuts. 0: none.
    """

    edge_length: float = stated(EDGE_LENGTH, "mm", *EDGE_LENGTHS)
    refine: bool = stated(default=True)
    cleft: float = stated(CLEFT, "mm", 0.0, MOST_CLEFT)
    file: Path | None = stated(None)


@dataclass(frozen=True)
class CaseLips:
    """Whether the lips of a case are separated, and where; see `lip_seam` and `lip_regions`.

    seam: "auto": from the gap or crease that the skin shows, else from landmarks; "landmarks"; or
        the file of a surface between the lips, its normals towards the upper lip.
    """

    contact: bool = stated(LIP_CONTACT)
    seam: Path | str = "auto"
    depth: float = stated(LIP_DEPTH, "mm", 0.0, MOST_LIP_DEPTH)
    height: float = stated(LIP_HEIGHT, "mm", *LIP_HEIGHTS)


@dataclass(frozen=True)
class CaseBand:
    """Whether a prediction comes with a band (`asked`: the case has a table [band]), and which."""

    asked: bool = False
    calibration: Path | None = stated(None)
    coverage: float = stated(BAND_COVERAGE, "", *COVERAGES)
    group: str | None = stated(None)


@dataclass(frozen=True)
class CaseOsteotomy:
    """One cut: a standard procedure placed from landmarks, or a plane through a bone.

    options: Adjustments of the procedure, as the osteotomy stage takes them.
    plane: The side to which its normal points becomes the new segment, `name`, of `bone`.
    """

    procedure: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    plane: Plane | None = None
    bone: str | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if (self.procedure is None) == (self.plane is None):
            raise CaseInputError("an osteotomy is either a procedure or a plane")
        if self.procedure is not None:
            checks.check_one_of("procedure", self.procedure, tuple(PROCEDURES))
        else:
            checks.as_text("bone", self.bone)
            checks.as_text("name", self.name)
        checks.keep(self, options=self.options)

    @property
    def segments(self) -> tuple[str, ...]:
        """The names of the segments that it makes."""
        if self.procedure is not None:
            return PROCEDURES[self.procedure]
        return (str(self.name),)


@dataclass(frozen=True, eq=False)
class CaseMotion(checks.Frozen):
    """The motion of one segment: a matrix, a transform file, or a surface before and after.

    matrix: (4, 4), mm, or None, in LPS, whatever the frame of the case file's own numbers.
    centre: (3,), mm, LPS, or None. The centre of the turn, where the case states one.
    direction: Of the transform file: one of `DIRECTIONS`; stated for ITK's files.
    frame: The frame in which the case file, or the transform file, has its numbers, where stated.
    typed: Whether the motion is given by translation, angle, axis and centre.
    """

    matrix: checks.Floats | None = None
    transform: Path | None = None
    surface: Path | None = None
    moved_surface: Path | None = None
    centre: checks.Floats | None = None
    direction: str | None = None
    frame: str | None = None
    typed: bool = False

    def source(self, understood: str = "") -> str:
        """Where the motion comes from, how its file was `understood`, in words; empty if typed."""
        if self.transform is not None:
            return f"{self.transform.name}{f': {understood}' if understood else ''}"
        if self.moved_surface is not None:
            return self.moved_surface.name
        if not self.typed:
            return f"matrix: {self.frame}" if self.frame else "matrix: LPS (frame assumed)"
        words = ["typed in RAS"] if self.frame == "RAS" else []
        turns = self.matrix is not None and not np.array_equal(self.matrix[:3, :3], np.eye(3))
        if turns and self.centre is None:
            words.append("rotated about the origin of the coordinates, because no centre is given")
        return "; ".join(words)


@dataclass(frozen=True)
class CaseMuscles:
    """The source of the muscles, and the options of sampling the material of the tets from them.

    Attributes
    ----------
    template : Path or str
        The folder of a template, or the name of one that comes with the package.
    smoothing : float
        Of the thin-plate spline that maps the template to the patient; 0 matches every landmark.
    preset : str
        Constants of fat and muscle; its fat is the case's too, unless `[tissue]` states another.
    mixing : str
        "moduli" (the paper) or "stiffness".
    samples : int
        Points in a tet that a muscle's surface crosses.
    seed : int
    moduli : TissueModuli
        Of muscles, instead of the preset's; those of fat come from the case.
    blur : float, mm
        Standard deviation of the blur of the shares of muscle, in which they fade into fat; 0 takes
        them as sampled, so that the tissue changes from tet to tet.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.CaseMuscles(samples=16).template
    'default'
    """

    template: Path | str = "default"
    smoothing: float = stated(0.0, "", 0.0, 1e6)
    preset: str = stated(DEFAULT_PRESET, choices=PRESETS)
    mixing: str = stated("moduli", choices=MIXINGS)
    samples: int = stated(64, "", *SAMPLES)
    seed: int = stated(0, "", 0, 2**63 - 1)
    moduli: TissueModuli = field(default_factory=TissueModuli)
    blur: float = stated(4.0, "mm", 0.0, MOST_BLUR)


@dataclass(frozen=True)
class CasePhoto:
    """The 3D photo whose colours the skin gets; its landmarks are in its own unit and frame."""

    file: Path = field(metadata=PLAIN)
    landmarks: Path | None = stated(None)
    aligned: bool = stated(default=False)
    units: str = stated("mm", choices=UNITS)

    def __post_init__(self) -> None:
        checks.check_one_of("units", self.units, tuple(UNITS))


@dataclass(frozen=True)
class CasePostoperative:
    """The post-operative data: a CT, or surfaces, which have `units` and `frame`.

    bones: Surfaces of bones or segments, by name, for the achieved plan.
    verified: Whether the user states that this is the patient after this operation: findings that
        it is another face, or the face before, are then warnings, not errors.
    """

    skin: Path | None = stated(None)
    image: Path | None = stated(None)
    landmarks: Path | None = stated(None)
    bones: Mapping[str, Path] = field(default_factory=dict)
    aligned: bool = stated(default=True)
    units: str = stated("mm", choices=UNITS)
    frame: str | None = stated(None, choices=FRAMES)
    series: str | None = None
    verified: bool = stated(default=False)

    def __post_init__(self) -> None:
        if self.image is not None and (self.skin is not None or self.bones):
            raise CaseInputError("post-operative data are either surfaces or an image, not both")
        if self.image is None and self.skin is None and not self.bones:
            raise CaseInputError("post-operative data need a skin, an image or a bone")
        checks.check_one_of("units", self.units, tuple(UNITS))
        if self.frame is not None:
            checks.check_one_of("frame", self.frame, FRAMES)
        checks.keep(self, bones=self.bones)
