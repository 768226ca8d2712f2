"""Muscles as surfaces with what their fibres need to be known, alone or in a template with a skull.

A template's muscles, the same muscles in a patient, and surfaces that a user brings all become a
`Musculature`, from which the equivalent material of the tets is sampled.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import MOST_BOXES, MuscleFibres
from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.values import checks
from cmfsim.values.checks import Floats, Frozen, as_rows, as_text, check_instance, check_one_of
from cmfsim.values.finding import Finding
from cmfsim.values.surface_data import SurfaceData

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]{0,63}")

# How the fibres of a muscle run: along it; spread from a narrow insertion; round an opening; in a
# layer whose surface does not tell their direction.
MUSCLE_KINDS = ("strap", "fan", "ring", "sheet")
MUSCLE_SIDES = ("L", "R", "both")


@dataclass(frozen=True, eq=False)
class MuscleSurface(Frozen):
    """One muscle: its closed surface and how its fibres run.

    Attributes
    ----------
    name : str
        With its side, such as "masseter_L"; without one where it crosses the midline.
    side : str
        "L", "R" (the patient's) or "both".
    surface : SurfaceData
        Closed, with outward normals, as far as the atlas allows.
    kind : str
        "strap", "fan", "ring" or "sheet".
    boxes : int or None
        Number of oriented boxes from which its fibre directions are computed, 1 to 64; None: from
        the shape.
    course : tuple of (n, 3) float64, mm
        Fibre lines from origin to insertion, if the template's author knows them; they take
        precedence over boxes.

    Raises
    ------
    CaseError
        (also `ValueError`) An unknown side or kind, boxes that are not a whole number from 1 to 64,
        a line of one point.

    Examples
    --------
    >>> import cmfsim
    >>> sheet = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> cmfsim.MuscleSurface("masseter_L", "L", sheet).kind
    'strap'
    """

    name: str
    side: str
    surface: SurfaceData
    kind: str = "strap"
    boxes: int | None = None
    course: tuple[Floats, ...] = ()

    def __post_init__(self) -> None:
        as_text("muscle name", self.name)
        check_one_of(f"side of {self.name}", self.side, MUSCLE_SIDES)
        check_one_of(f"kind of {self.name}", self.kind, MUSCLE_KINDS)
        check_instance(f"surface of {self.name}", self.surface, SurfaceData)
        if self.boxes is not None:
            object.__setattr__(self, "boxes", _checked_boxes(self.name, self.boxes))
        lines = []
        for i, line in enumerate(self.course):
            points = as_rows(f"course {i} of {self.name}", line, 3)
            if len(points) < 2:
                raise CaseInputError(f"course {i} of {self.name} has one point: two are needed")
            lines.append(points)
        object.__setattr__(self, "course", tuple(lines))

    def fibres(self) -> MuscleFibres:
        """How its fibres run: by their lines, by boxes, or by its shape."""
        return MuscleFibres(self.surface.searched, self.kind, self.boxes, self.course)


@dataclass(frozen=True, eq=False)
class Musculature:
    """The muscles of one head.

    Attributes
    ----------
    muscles : tuple of MuscleSurface
        Names differ.
    findings : tuple of Finding
        Findings of their creation: folds, residuals, open surfaces.

    Raises
    ------
    CaseError
        (also `ValueError`) A name twice.

    Examples
    --------
    >>> import cmfsim
    >>> sheet = cmfsim.SurfaceData([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> muscles = cmfsim.Musculature((cmfsim.MuscleSurface("masseter_L", "L", sheet),))
    >>> muscles["masseter_L"].side, len(muscles)
    ('L', 1)
    """

    muscles: tuple[MuscleSurface, ...]
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        muscles = tuple(self.muscles)
        seen: set[str] = set()
        for i, muscle in enumerate(muscles):
            check_instance(f"muscles[{i}]", muscle, MuscleSurface)
            if muscle.name in seen:
                raise CaseInputError(f"muscles[{i}] is a second {muscle.name!r}: names must differ")
            seen.add(muscle.name)
        checks.keep(self, muscles=muscles, findings=tuple(self.findings))

    def __len__(self) -> int:
        """The number of muscles."""
        return len(self.muscles)

    def __iter__(self) -> Iterator[MuscleSurface]:
        """The muscles in their order."""
        return iter(self.muscles)

    def __getitem__(self, name: str) -> MuscleSurface:
        """The muscle of a name."""
        for muscle in self.muscles:
            if muscle.name == name:
                return muscle
        names = ", ".join(muscle.name for muscle in self.muscles)
        raise KeyError(f"no muscle {name!r}; there are: {names}")


def is_template_name(name: object) -> bool:
    """Whether a name can be that of a template or muscle: it becomes a file name."""
    return isinstance(name, str) and NAME.fullmatch(name) is not None


@dataclass(frozen=True, eq=False)
class TemplateData(Frozen):
    """The contents of a template with its names checked, as `MuscleTemplate` describes them."""

    name: str
    muscles: tuple[MuscleSurface, ...]
    skull: SurfaceData
    landmarks: Mapping[str, Floats]
    licence: str
    attribution: str = ""
    source: str = ""
    definitions: Mapping[str, str] = field(default_factory=dict)
    concepts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        if not is_template_name(self.name):
            raise CaseInputError(
                f"template name is {self.name!r}: letters, digits, '_', '-' and '+', 64 at most"
            )
        as_text("licence of the template", self.licence)
        check_instance("skull of the template", self.skull, SurfaceData)
        muscles = Musculature(tuple(self.muscles)).muscles
        if not muscles:
            raise CaseInputError("the template has no muscle")
        taken: dict[str, str] = {}
        for muscle in muscles:
            if not is_template_name(muscle.name):
                raise CaseInputError(
                    f"muscle name is {muscle.name!r}: letters, digits, '_', '-' and '+', 64 at "
                    "most, because it becomes a file name"
                )
            other = taken.setdefault(muscle.name.lower(), muscle.name)
            if other != muscle.name:
                raise CaseInputError(
                    f"muscles {other!r} and {muscle.name!r} differ only in capitals, which some "
                    "file systems do not distinguish"
                )
        checks.keep(self, muscles=muscles, landmarks=as_landmarks(self.landmarks))
        checks.keep(self, definitions=self.definitions, concepts=self.concepts)
        checks.keep(self, findings=tuple(self.findings))

    @property
    def musculature(self) -> Musculature:
        """The muscles as they lie in the template."""
        return Musculature(self.muscles, self.findings)


def as_landmarks(landmarks: Mapping[str, ArrayLike]) -> Mapping[str, Floats]:
    """Read-only points by name, or an error about what is no point."""
    if not landmarks:
        raise LandmarkInputError("the template has no landmark")
    try:
        rows = as_rows("template landmarks", np.array([np.ravel(p) for p in landmarks.values()]), 3)
    except ValueError as error:
        raise LandmarkInputError(str(error)) from error
    return MappingProxyType(dict(zip(landmarks, rows, strict=True)))


def _checked_boxes(name: str, boxes: Any) -> int:
    """A number of boxes that the core takes, whether from a template, an archive or code."""
    if isinstance(boxes, bool) or not isinstance(boxes, int | np.integer):
        raise CaseInputError(
            f"boxes of {name} is {boxes!r:.40}: a whole number from 1 to {MOST_BOXES} is needed"
        )
    count = int(boxes)
    if not 1 <= count <= MOST_BOXES:
        shown = str(count) if abs(count) < 10**18 else "a number of more than 18 digits"
        raise CaseInputError(f"boxes of {name} is {shown}: allowed is 1 to {MOST_BOXES}")
    return count
