"""A head whose landmarks are known: what proposed landmarks are compared with and corrected by."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from cmfsim.errors import LandmarkInputError
from cmfsim.values.checks import Floats, Frozen, as_text, check_instance
from cmfsim.values.surface_data import SurfaceData


@dataclass(frozen=True, eq=False)
class TemplateHead(Frozen):
    """A head whose landmarks are known.

    bones: "cranium" and "mandible", LPS mm; the mandible apart, as far as it is known.
    skull: mapping of str to (3,), mm. Its skull landmarks by label.
    skin_landmarks: mapping of str to (3,), mm.
    biases: tuple of two mappings of str to (3,), mm, or None. How far the landmarks of skull and
        skin lie from where their definitions put them on this head, in its own frame; None where
        that has to be measured.
    Raises `LandmarkError`: No cranium, or no skull landmarks.
    """

    name: str
    bones: Mapping[str, SurfaceData]
    skull: Mapping[str, Floats]
    skin: SurfaceData | None = None
    skin_landmarks: Mapping[str, Floats] = field(default_factory=dict)
    biases: tuple[Mapping[str, Floats], Mapping[str, Floats]] | None = None

    def __post_init__(self) -> None:
        as_text("name of the template head", self.name)
        if not self.bones or not self.skull:
            raise LandmarkInputError(
                f"template head {self.name!r} has {len(self.bones)} bones and {len(self.skull)} "
                "skull landmarks: both are needed"
            )
        for name, bone in self.bones.items():
            check_instance(f"bone {name!r} of template head {self.name!r}", bone, SurfaceData)
        for name in ("bones", "skull", "skin_landmarks"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
