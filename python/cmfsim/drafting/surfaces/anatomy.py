"""The surfaces of a drafted case, and the questions about them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cmfsim.drafting.choices import Taken
from cmfsim.drafting.finds import SurfaceFind
from cmfsim.values.checks import Floats

# Lengths of other units that numbers may be in, mm.
UNITS: Mapping[str, float] = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "inch": 25.4, "um": 0.001}
# Vertices at which it is asked whether one surface holds another.
SAMPLES = 300
FLIP = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Question:
    """A decision about a key that a person has to make.

    key: Below [surfaces].
    text: The question.
    choices: What may be written: the file of a surface, or none, and words about it.
    """

    key: str
    text: str
    choices: tuple[tuple[SurfaceFind | None, str], ...]


@dataclass
class Anatomy:
    """The surfaces of a case.

    Attributes
    ----------
    skin : SurfaceFind or None
    bones : dict of str to SurfaceFind
        By the name that the case gives them.
    units : str
    frame : str or None
        What the case states; None where every file states its own, or nothing needs to be stated.
    frame_why, units_why : str
    questions : list of Question
        Keys "skin", "units", "frame" of [surfaces], or "bones.NAME".
    after_skin, after_bones
        The same after the operation.
    taken : list of Taken
    """

    skin: SurfaceFind | None = None
    bones: dict[str, SurfaceFind] = field(default_factory=dict)
    units: str = "mm"
    units_why: str = ""
    frame: str | None = None
    frame_why: str = ""
    questions: list[Question] = field(default_factory=list)
    after_skin: SurfaceFind | None = None
    after_bones: dict[str, SurfaceFind] = field(default_factory=dict)
    taken: list[Taken] = field(default_factory=list)

    @property
    def is_complete(self) -> bool:
        """Whether there is a skin, or a question about it, and a bone."""
        asked = {question.key.partition(".")[0] for question in self.questions}
        return (self.skin is not None or "skin" in asked) and (bool(self.bones) or "bones" in asked)

    @property
    def chosen(self) -> list[SurfaceFind]:
        """Skin and bones before the operation."""
        return [*([self.skin] if self.skin else []), *self.bones.values()]

    @property
    def after(self) -> list[SurfaceFind]:
        """Skin and bones after the operation."""
        return [*([self.after_skin] if self.after_skin else []), *self.after_bones.values()]

    def asks(self, key: str) -> Question | None:
        """The question about a key, where there is one."""
        return next((question for question in self.questions if question.key == key), None)

    def placed(self, find: SurfaceFind) -> Floats:
        """The vertices of a surface in LPS mm, as far as unit and frame are known, (v, 3)."""
        frame = find.stated or self.frame or "LPS"
        scale = UNITS.get(self.units, 1.0) * (FLIP if frame == "RAS" else np.ones(3))
        return find.surface.vertices * scale
