"""The values of a muscle template: muscles, the skull that they lie on, and its landmarks."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError, LandmarkInputError
from cmfsim.values.checks import Floats, as_rows, as_text, check_instance
from cmfsim.values.finding import Finding
from cmfsim.values.frozen import Frozen
from cmfsim.values.musculature import MuscleSurface, Musculature
from cmfsim.values.surface_data import SurfaceData

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]{0,63}")


def is_template_name(name: object) -> bool:
    """Whether a name can be that of a template or muscle: it becomes a file name."""
    return isinstance(name, str) and NAME.fullmatch(name) is not None


@dataclass(frozen=True, eq=False)
class TemplateData(Frozen):
    """The contents of a template, with its names checked.

    `MuscleTemplate` is what works with it, and describes the attributes.
    """

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
        object.__setattr__(self, "muscles", muscles)
        object.__setattr__(self, "landmarks", as_landmarks(self.landmarks))
        for name in ("definitions", "concepts"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        object.__setattr__(self, "findings", tuple(self.findings))

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
