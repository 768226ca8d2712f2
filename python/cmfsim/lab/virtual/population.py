"""The virtual patients P1 to P6 and those drawn at random, with their operations."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np

from cmfsim.errors import CaseInputError
from cmfsim.phantom.muscles import COURSES
from cmfsim.phantom.parameters import HeadParameters
from cmfsim.values.calibration import ADDED, PLAN
from cmfsim.values.checks import as_whole, check_one_of, in_files, keep

Triple = tuple[float, float, float]
# Numbers above this belong to patients drawn at random.
DRAWN = 1000
# Mean, standard deviation and largest departure from the mean.
Distribution = tuple[float, float, float]
# Osteotomies, and the share of patients who have them.
OPERATIONS = (
    (("le_fort_1", "bsso"), 0.5),
    (("bsso",), 0.25),
    (("le_fort_1", "bsso", "genioplasty"), 0.15),
    (("le_fort_1",), 0.1),
)
LABELS: Mapping[str, str] = {"le_fort_1": "Mx", "bsso": "M", "genioplasty": "G"}
# By how much the mandible of a patient is too long or too short, mm; half of them each.
DISCREPANCY: Distribution = (4.0, 1.2, 2.0)
# Motions of a plan, mm.
MAXILLA_FORWARDS: Distribution = (4.0, 1.9, 3.0)
MAXILLA_UP: Distribution = (0.5, 1.5, 3.0)
CHIN_FORWARDS: Distribution = (3.0, 1.5, 3.0)
# Motion of the mandible beyond the correction of its length, and the share of the maxilla's motion
# that it follows.
MANDIBLE_BEYOND: Distribution = (0.0, 1.0, 2.0)
MANDIBLE_UP: Distribution = (0.5, 0.5, 1.0)
FOLLOWS = 0.5
# Share of the patients whose mandible is too long.
LONGER = 0.5
# Turns about the transverse axis, degrees.
PITCH: Distribution = (0.0, 1.5, 3.0)
# The shortest motion of a mandible that is operated, mm.
LEAST_WAY = 2.0
# Of the logarithm of the ratio of a person's muscles to the phantom's.
MUSCLE_THICKNESS: Distribution = (0.0, 0.12, 0.25)
MUSCLE_STIFFNESS: Distribution = (0.0, 0.5, 1.0)
# Gap between the lips, mm, as in a patient who is scanned at rest; and between the teeth.
LIP_GAP: Distribution = (2.0, 0.5, 1.0)
BITE_GAP = 2.5
# Errors of execution are limited to this many standard deviations.
MOST_ERRORS = 2.0
# Of a chin relative to the jaw from which it is cut, mm along each axis.
CHIN_ERROR = 0.5
# Of the soft tissue, as a share of its depth.
THICKNESS_CHANGE = next(source.sd for source in ADDED if source.name == "thickness change")
# Central share of a `HeadParameters` range from which values are drawn: no person is at the ends of
# several ranges at once.
MIDDLE = 0.7
SHAPES = (
    "scale", "face_height", "nose_length", "nose_projection", "lip_fullness", "chin_projection",
    "jaw_width", "fat_thickness", "asymmetry",
)  # fmt: skip
# How the true tissue is made: with muscles, moduli and sliding of its own, or with those that the
# models assume, as the phantom has them from which the built-in template was drawn.
TRUTHS = OWN, PHANTOM = "own", "phantom"
# Number that makes the draws of a person's tissue independent of all others.
TISSUE_DRAW = 1
# Young's modulus of muscle along its fibres, MPa, log-uniform: from the masseter at rest in
# elastography to the constants of Kim et al. 2010 (docs/moduli.md); and the ratio of it to that
# across, about whose direction sources disagree.
MUSCLE_YOUNG = (0.007, 0.79)
ALONG_OVER_ACROSS = (0.5, 2.0)
# Of fat, uniform: what tissue squeezed for weeks loses in volume is not known.
FAT_POISSON = (0.3, 0.48)
# Of skin, MPa, log-uniform, and its thickness, mm, uniform.
SKIN_YOUNG = (0.01, 0.5)
SKIN_THICKNESS = (1.0, 2.0)
# Offset of a muscle along each axis, mm: 5 mm in all.
MUSCLE_OFFSET: Distribution = (0.0, 2.9, 5.8)
# Share of persons who lack a muscle of expression on both sides, and the muscles nobody lacks.
LACKING = 0.1
NEVER_LACKING = (
    "masseter", "temporalis", "medial_pterygoid", "buccinator", "orbicularis_oris",
    "orbicularis_oculi",
)  # fmt: skip
# Depth of the vestibule beyond that which the models assume, mm.
VESTIBULE: Distribution = (0.0, 2.0, 4.0)


@dataclass(frozen=True)
class Relocation:
    """The motion of a segment in a planner's numbers, as in Table 2 of Kim et al. (2010).

    translation: mm. Left, backwards, up.
    angle: degrees, about `axis` by the right-hand rule, through the skull landmark `centre`.
    """

    translation: Triple
    angle: float = 0.0
    axis: Triple = (1.0, 0.0, 0.0)
    centre: str = "supradentale"


@dataclass(frozen=True)
class TrueTissue:
    """How a person's tissue departs from the phantom's, from which the built-in template was drawn.

    The values by default are those of the phantom and of the models: what a model assumes is then
    true of the person.

    muscle_young: MPa, of muscle along and across its fibres; None: those of the phantom.
    skin_young, skin_thickness: MPa and mm, of a layer of skin; none if the thickness is 0.
    offsets: mm, by muscle, the distance left, backwards and up by which it lies elsewhere.
    absent: Muscles that the person does not have.
    slides_on: Where tissue slides at the tooth rows: "sheet" or "bone", as `KindOptions` has it.
    vestibule: mm, by how much the zone in which it slides is deeper than models assume.
    """

    muscle_young: tuple[float, float] | None = None
    fat_poisson: float = 0.46
    skin_young: float = 0.0
    skin_thickness: float = 0.0
    offsets: Mapping[str, Triple] = field(default_factory=dict)
    absent: tuple[str, ...] = ()
    slides_on: str = "sheet"
    vestibule: float = 0.0

    def __post_init__(self) -> None:
        keep(self, offsets=self.offsets)


@dataclass(frozen=True)
class VirtualPatient:
    """A synthetic person with an operation.

    label: Of the operation, in the paper's letters: MxA, MxSB maxilla advanced, set back; MA, MSB
        the same for the mandible; G genioplasty.
    muscle_thickness, muscle_stiffness: Of the true muscles, relative to those of the phantom and to
        the default moduli.
    separate_lips: Whether the true lips are separate down to the teeth and touch each other.
        Otherwise they are connected behind the slit in the skin, as on a CT.
    departures: How the operation departs from the plan, the only one that the case file has.
    thickness_change: Swelling of the soft tissue after the operation, as a share of its depth.
    """

    number: int = field(metadata=in_files(None))
    label: str
    parameters: HeadParameters = field(metadata=in_files("head"))
    muscle_thickness: float
    muscle_stiffness: float
    osteotomies: tuple[str, ...]
    plan: Mapping[str, Relocation] = field(default_factory=dict)
    separate_lips: bool = field(default=False, metadata=in_files(None))
    departures: Mapping[str, Relocation] = field(default_factory=dict)
    thickness_change: float = 0.0
    tissue: TrueTissue = field(default_factory=TrueTissue)

    def __post_init__(self) -> None:
        keep(self, plan=self.plan, departures=self.departures)

    @property
    def name(self) -> str:
        """P1 to P6, or D001 and so on if drawn at random."""
        return f"D{self.number - DRAWN:03d}" if self.number > DRAWN else f"P{self.number}"


def _file(name: str) -> str:
    return files(__package__).joinpath("cases", name).read_text(encoding="utf-8")


def template_text(name: str) -> str:
    """The text of a case file of a synthetic head: "demo" and "patient" have fields to fill in."""
    return _file(f"{name}.txt")


def _tuples(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in entry.items()}


def _person_of(entry: dict[str, Any]) -> VirtualPatient:
    """A patient of people.json."""
    plan = {segment: Relocation(**_tuples(move)) for segment, move in entry["plan"].items()}
    made = {"parameters": HeadParameters(**entry["parameters"]), "plan": plan}
    return VirtualPatient(**{**_tuples(entry), **made})


# People and motions are our own: of the kind and size of the paper's four patients, not its data.
# Lips are 2 mm apart and teeth 2.5 mm, as in a patient who is scanned at rest.
# P5 and P6 have lips 2 mm apart too: an open mandible widens `lip_gap`. In P5 the mouth closes and
# the lower lip goes behind the upper one: turned about the incisors, the mandible rises half as far
# at the molars. P6 has vertical excess: the maxilla goes up and the mandible follows, turning about
# its condyles; its motion is that turn, written about infradentale.
PATIENTS: Mapping[int, VirtualPatient] = MappingProxyType(
    {entry["number"]: _person_of(entry) for entry in json.loads(_file("people.json"))}
)


def patient_named(number: int) -> VirtualPatient:
    """One of the virtual patients, 1 to 6."""
    if number not in PATIENTS:
        raise CaseInputError(
            f"patient is {number!r}: {', '.join(map(str, PATIENTS))} are available"
        )
    return PATIENTS[number]


class _Draws:
    """The random numbers of one patient."""

    def __init__(self, *seed: int) -> None:
        self.generator = np.random.default_rng(seed)

    def within(self, distribution: Distribution) -> float:
        """A normal draw, limited to the largest departure and rounded as in a plan."""
        mean, sd, most = distribution
        off = float(np.clip(sd * self.generator.standard_normal(), -most, most))
        return round(mean + off, 2)

    def error(self, sd: float) -> float:
        """A normal draw about zero."""
        return self.within((0.0, sd, MOST_ERRORS * sd))

    def uniform(self, low: float, high: float) -> float:
        """A number between two others, rounded to a thousandth."""
        return round(float(self.generator.uniform(low, high)), 3)

    def log_uniform(self, low: float, high: float) -> float:
        """A number whose logarithm is uniform, rounded to three digits."""
        return float(f"{np.exp(self.generator.uniform(np.log(low), np.log(high))):.3g}")


def drawn_patient(seed: int, index: int, *, truth: str = OWN) -> VirtualPatient:
    """One patient of the population that belongs to a seed.

    Parameters
    ----------
    seed : int
        0 or more.
    index : int
        1 or more; the patient is named D with this number.
    truth : str
        "own": the person's muscles lie elsewhere than the phantom's, some are absent, all have
        their own moduli, fat and skin too, and tissue slides on bone; "phantom": muscles, moduli of
        fat and sliding are what the models assume. Shape, operation, plan and errors are the same.

    Returns
    -------
    VirtualPatient
        Always the same for the same seed, index and truth.

    Raises
    ------
    CaseError
        (also `ValueError`) A seed or index that is not a whole number in its range; another truth.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.drawn_patient(0, 1) == cmfsim.drawn_patient(0, 1)
    True
    """
    seed, index = as_whole("seed", seed, 0), as_whole("index", index, 1)
    check_one_of("truth", truth, TRUTHS)
    draws = _Draws(seed, index)
    shares = np.array([share for _, share in OPERATIONS])
    osteotomies = OPERATIONS[int(draws.generator.choice(len(OPERATIONS), p=shares))][0]
    person = _person(draws, only_maxilla=osteotomies == ("le_fort_1",))
    plan = _plan(draws, person, osteotomies)
    patient = VirtualPatient(
        DRAWN + int(index),
        ", ".join(LABELS[procedure] for procedure in osteotomies),
        person,
        round(float(np.exp(draws.within(MUSCLE_THICKNESS))), 3),
        round(float(np.exp(draws.within(MUSCLE_STIFFNESS))), 3),
        osteotomies,
        plan,
        departures=_departures(draws, plan),
        thickness_change=round(0.01 * draws.error(100.0 * THICKNESS_CHANGE), 4),
    )
    if truth == PHANTOM:
        return patient
    tissue = _own_tissue(_Draws(int(seed), int(index), TISSUE_DRAW))
    return replace(patient, muscle_stiffness=1.0, tissue=tissue)


def _own_tissue(draws: _Draws) -> TrueTissue:
    """Tissue about which the models know nothing but that it lies between bones and skin."""
    along = draws.log_uniform(*MUSCLE_YOUNG)
    across = float(f"{along / draws.log_uniform(*ALONG_OVER_ACROSS):.3g}")
    offsets: dict[str, tuple[float, float, float]] = {}
    absent: list[str] = []
    for name, course in COURSES.items():
        sides = [f"{name}_{side}" for side in "LR"] if course.paired else [name]
        lacking = draws.generator.random() < LACKING
        if lacking and name not in NEVER_LACKING:
            absent += sides
        for side in sides:
            left, back, up = (draws.within(MUSCLE_OFFSET) for _ in range(3))
            offsets[side] = (left, back, up)
    return TrueTissue(
        muscle_young=(along, across),
        fat_poisson=draws.uniform(*FAT_POISSON),
        skin_young=draws.log_uniform(*SKIN_YOUNG),
        skin_thickness=draws.uniform(*SKIN_THICKNESS),
        offsets={name: offset for name, offset in offsets.items() if name not in absent},
        absent=tuple(absent),
        slides_on="bone",
        vestibule=draws.within(VESTIBULE),
    )


def _person(draws: _Draws, *, only_maxilla: bool) -> HeadParameters:
    """A head whose jaws do not meet."""
    extreme = HeadParameters.random(int(draws.generator.integers(2**31)))
    ordinary = HeadParameters()
    values = {}
    for name in SHAPES:
        middle = getattr(ordinary, name)
        values[name] = round(middle + MIDDLE * (getattr(extreme, name) - middle), 4)
    longer = bool(draws.generator.random() < LONGER)
    excess = draws.within(DISCREPANCY)
    # A maxilla is advanced alone if the mandible is too long.
    values["mandible_advance"] = excess if longer or only_maxilla else -excess
    return replace(ordinary, **values, lip_gap=draws.within(LIP_GAP), bite_gap=BITE_GAP)


def _plan(
    draws: _Draws, person: HeadParameters, osteotomies: tuple[str, ...]
) -> dict[str, Relocation]:
    """The plan that a surgeon would make for the person."""
    plan = {}
    forwards, up, pitch = (draws.within(d) for d in (MAXILLA_FORWARDS, MAXILLA_UP, PITCH))
    if "le_fort_1" in osteotomies:
        plan["maxilla"] = Relocation((0.0, -forwards, up), pitch)
    follow = FOLLOWS * forwards if "maxilla" in plan else 0.0
    back = person.mandible_advance - follow + draws.within(MANDIBLE_BEYOND)
    back = round(float(np.copysign(max(abs(back), LEAST_WAY), back)), 2)
    up, pitch = draws.within(MANDIBLE_UP), draws.within(PITCH)
    left = round(-person.asymmetry, 2)
    if "bsso" in osteotomies:
        plan["mandible_body"] = Relocation((left, back, up), pitch, centre="infradentale")
    chin = draws.within(CHIN_FORWARDS)
    if "genioplasty" in osteotomies:
        # Moves with the body of the mandible, and further forward.
        way = (left, round(back - chin, 2), up)
        plan["chin"] = Relocation(way, pitch, centre="infradentale")
    return plan


def _departures(draws: _Draws, plan: Mapping[str, Relocation]) -> dict[str, Relocation]:
    """The deviation of the operation from the plan.

    If both jaws are operated, they depart together, since a splint holds them in occlusion.
    """
    left, back, up, pitch, roll, yaw = (draws.error(source.sd) for source in PLAN)
    angle = float(np.linalg.norm([pitch, roll, yaw]))
    axis = (pitch / angle, roll / angle, yaw / angle) if angle > 0.0 else (1.0, 0.0, 0.0)
    centre = "supradentale" if "maxilla" in plan else "infradentale"
    both = Relocation((left, back, up), angle, axis, centre)
    found = {name: both for name in plan if name != "chin"}
    own = [draws.error(CHIN_ERROR) for _ in range(3)]
    if "chin" in plan:
        way = (left + own[0], back + own[1], up + own[2])
        found["chin"] = replace(both, translation=way)
    return found
