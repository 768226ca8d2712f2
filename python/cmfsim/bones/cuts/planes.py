"""Cutting planes and the procedures made of them: frozen values, no bones yet."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError
from cmfsim.values.case_parts import Plane
from cmfsim.values.checks import Floats, as_text, check_instance, keep
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData


@dataclass(frozen=True, eq=False)
class CuttingPlane(Plane):
    """An unbounded plane that cuts bone; its normal points into the piece that is cut off.

    Attributes
    ----------
    point : (3,) float64, mm
        LPS.
    normal : (3,) float64
        Any length but zero; kept as a unit vector.
    name : str

    Raises
    ------
    CaseError
        (also `ValueError`) A zero normal, a wrong shape, NaN or infinity.

    Examples
    --------
    >>> import cmfsim
    >>> plane = cmfsim.CuttingPlane((0, 0, 10), (0, 0, -2), "below 10 mm")
    >>> plane.distance([[5, 5, 7]]).tolist()
    [3.0]
    """

    name: str

    def __init__(self, point: ArrayLike, normal: ArrayLike, name: str = "plane") -> None:
        super().__init__(point, normal, f"plane {as_text('plane name', name)!r}")
        keep(self, name=name)

    def distance_along(self, image: ImageData) -> tuple[Floats, Floats, Floats]:
        """The signed distance at the voxels of an image's grid, mm: the sum of what is returned.

        Its parts that vary along x, y and z, shaped to broadcast.
        """
        x, y, z = (
            n * (line - p) for line, p, n in zip(image.axes(), self.point, self.normal, strict=True)
        )
        return x, y, z


@dataclass(frozen=True, eq=False)
class Cut:
    """A piece to be cut from a bone: it lies where all planes of any one group are positive.

    sources: The piece is cut from the first of these bones or segments that exists.
    rest: What the source is called afterwards; None leaves its name.
    joined: Where the source is a "skull" whose jaws could not be separated, the piece also lies on
        the positive side of this plane, so that the other jaw stays. None refuses such a source.
    """

    segment: str
    groups: tuple[tuple[CuttingPlane, ...], ...]
    sources: tuple[str, ...]
    rest: str | None = None
    joined: CuttingPlane | None = None

    def __post_init__(self) -> None:
        as_text("segment", self.segment)
        if not self.sources:
            raise CaseInputError(f"cut of {self.segment!r} names no bone to cut")
        if not self.groups or not all(self.groups):
            raise CaseInputError(f"cut of {self.segment!r} has a group without planes")
        for plane in (p for group in self.groups for p in group):
            check_instance(f"plane of {self.segment!r}", plane, CuttingPlane)

    def of(self, source: str) -> "Cut":
        """The cut as it is made from a bone: from a "skull" the other jaw is left out."""
        if source != "skull" or self.joined is None:
            return self
        return replace(self, groups=tuple((*group, self.joined) for group in self.groups))


@dataclass(frozen=True, eq=False)
class Procedure:
    """An osteotomy: cuts made one after another.

    Attributes
    ----------
    kind : str
        "le_fort_1", "le_fort_3", "bsso", "genioplasty" or "free".
    cuts : tuple of Cut
    options : mapping of str to float
        The distances (mm) and angles (degrees) that placed the planes, defaults included.
    findings : tuple of Finding
        Points to check in its placement.
    """

    kind: str
    cuts: tuple[Cut, ...]
    options: Mapping[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        as_text("procedure", self.kind)
        for cut in self.cuts:
            check_instance(f"cut of {self.kind!r}", cut, Cut)
        keep(self, options=self.options)


def free_cut(
    bone: str, segment: str, planes: tuple[CuttingPlane, ...], *, rest: str | None = None
) -> Procedure:
    """The procedure that cuts a piece from a bone where all given planes are positive.

    Parameters
    ----------
    bone : str
        The bone or segment to cut.
    segment : str
        The name of the piece.
    planes : tuple of CuttingPlane
        Normals point into the piece.
    rest : str, optional
        Name of the remaining bone; by default its own name.

    Raises
    ------
    CaseError
        (also `ValueError`) No plane.

    Examples
    --------
    >>> import cmfsim
    >>> plane = cmfsim.CuttingPlane((0, -180, 1440), (0, 0, -1), "chin")
    >>> cmfsim.free_cut("mandible", "chin", (plane,)).cuts[0].segment
    'chin'
    """
    return Procedure("free", (Cut(segment, (tuple(planes),), (bone,), rest),))
