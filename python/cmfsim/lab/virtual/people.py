"""The virtual patients P1 to P6, and their operations."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from cmfsim.errors import CaseInputError
from cmfsim.phantom import HeadParameters

Triple = tuple[float, float, float]

# Numbers above this belong to patients drawn at random.
DRAWN = 1000


@dataclass(frozen=True)
class Relocation:
    """The motion of a segment in a planner's numbers, as in Table 2 of Kim et al. (2010).

    translation: tuple of 3 float, mm. Left, backwards, up.
    angle: degrees, about `axis` by the right-hand rule, through the landmark `centre`.
    axis: tuple of 3 float.
    centre: A skull landmark.
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
    offsets: mapping of str to 3 float, mm, by muscle, the distance left, backwards and up by which
        it lies elsewhere.
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
        object.__setattr__(self, "offsets", MappingProxyType(dict(self.offsets)))


@dataclass(frozen=True)
class VirtualPatient:
    """A synthetic person with an operation.

    label: Of the operation, in the paper's letters: MxA, MxSB maxilla advanced, set back; MA, MSB
        the same for the mandible; G genioplasty.
    muscle_thickness, muscle_stiffness: Of the true muscles, relative to those of the phantom and to
        the default moduli.
    osteotomies: Procedures, in their order.
    plan: By segment.
    separate_lips: Whether the true lips are separate down to the teeth and touch each other.
        Otherwise they are connected behind the slit in the skin, as on a CT.
    departures: By segment, how the operation departs from the plan. The case file has only the
        plan.
    thickness_change: Swelling of the soft tissue after the operation, as a share of its depth.
    """

    number: int
    label: str
    parameters: HeadParameters
    muscle_thickness: float
    muscle_stiffness: float
    osteotomies: tuple[str, ...]
    plan: Mapping[str, Relocation] = field(default_factory=dict)
    separate_lips: bool = False
    departures: Mapping[str, Relocation] = field(default_factory=dict)
    thickness_change: float = 0.0
    tissue: TrueTissue = field(default_factory=TrueTissue)

    def __post_init__(self) -> None:
        for name in ("plan", "departures"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def name(self) -> str:
        """P1 to P6, or D001 and so on if drawn at random."""
        return f"D{self.number - DRAWN:03d}" if self.number > DRAWN else f"P{self.number}"


_BOTH_JAWS = ("le_fort_1", "bsso")
_WITH_CHIN = ("le_fort_1", "bsso", "genioplasty")

# People and motions are our own: of the kind and size of the paper's four patients, not its data.
# Lips are 2 mm apart and teeth 2.5 mm, as in a patient who is scanned at rest.
# P5 and P6 have lips 2 mm apart too: an open mandible widens `lip_gap`. In P5 the mouth closes and
# the lower lip goes behind the upper one: turned about the incisors, the mandible rises half as far
# at the molars. P6 has vertical excess: the maxilla goes up and the mandible follows, turning about
# its condyles; its motion is that turn, written about infradentale.
_PEOPLE = (
    VirtualPatient(
        1, "MxA, MSB",
        HeadParameters(
            face_height=1.02, nose_length=1.0, chin_projection=2.0, mandible_advance=3.0,
            lip_gap=2.0, bite_gap=2.5,
        ),
        0.85, 1.2, _BOTH_JAWS,
        {
            "maxilla": Relocation((0.0, -5.0, 0.5), 2.0),
            "mandible_body": Relocation((0.0, 3.5, 0.5), centre="infradentale"),
        },
    ),
    VirtualPatient(
        2, "MxA, MA",
        HeadParameters(
            scale=0.94, face_height=0.96, nose_projection=2.0, lip_fullness=1.15,
            chin_projection=-2.5, mandible_advance=-3.0, fat_thickness=1.5, jaw_width=0.96,
            lip_gap=2.0, bite_gap=2.5,
        ),
        1.2, 0.8, _BOTH_JAWS,
        {
            "maxilla": Relocation((0.0, -3.0, 0.0), 3.0),
            "mandible_body": Relocation((0.0, -6.0, 0.0), -2.0, centre="infradentale"),
        },
    ),
    VirtualPatient(
        3, "MxSB, MSB",
        HeadParameters(
            scale=1.04, nose_length=-1.5, lip_fullness=1.2, fat_thickness=3.0, jaw_width=1.04,
            lip_gap=2.0, bite_gap=2.5,
        ),
        1.1, 1.0, _BOTH_JAWS,
        {
            "maxilla": Relocation((0.0, 3.0, 2.5), 1.5),
            "mandible_body": Relocation((0.0, 2.5, 2.0), centre="infradentale"),
        },
    ),
    VirtualPatient(
        4, "MxA, MSB, G",
        HeadParameters(
            face_height=1.05, nose_projection=-1.0, lip_fullness=0.9, fat_thickness=0.5,
            asymmetry=3.0, mandible_advance=2.0, chin_projection=-2.0, lip_gap=2.0, bite_gap=2.5,
        ),
        0.9, 0.9, _WITH_CHIN,
        {
            "maxilla": Relocation((-1.0, -4.0, 0.5), -2.0, (0.0, 0.0, 1.0)),
            "mandible_body": Relocation((-2.0, 2.5, 0.5), -2.0, (0.0, 0.0, 1.0), "infradentale"),
            "chin": Relocation((-3.0, -1.5, 1.0), -2.0, (0.0, 0.0, 1.0), "infradentale"),
        },
    ),
    VirtualPatient(
        5, "MSB, bite closed",
        HeadParameters(
            face_height=1.03, nose_projection=1.0, mandible_advance=5.0, lip_gap=1.1, bite_gap=6.0,
        ),
        0.9, 1.1, ("bsso",),
        {"mandible_body": Relocation((0.0, 4.0, 4.5), -3.4, centre="infradentale")},
        separate_lips=True,
    ),
    VirtualPatient(
        6, "Mx up, autorotation",
        HeadParameters(
            face_height=1.06, nose_length=1.0, lip_fullness=1.1, chin_projection=-1.0,
            fat_thickness=1.0, lip_gap=1.2, bite_gap=5.0,
        ),
        1.1, 0.85, ("le_fort_1",),
        {
            "maxilla": Relocation((0.0, -1.0, 4.0), 1.0),
            "mandible": Relocation((0.0, -4.15, 7.2), -5.35, centre="infradentale"),
        },
        separate_lips=True,
    ),
)  # fmt: skip
PATIENTS: Mapping[int, VirtualPatient] = MappingProxyType({p.number: p for p in _PEOPLE})


def patient_named(number: int) -> VirtualPatient:
    """One of the virtual patients.

    Raises `CaseError`: A number other than 1 to 6.
    """
    if number not in PATIENTS:
        raise CaseInputError(
            f"patient is {number!r}: {', '.join(map(str, PATIENTS))} are available"
        )
    return PATIENTS[number]
