"""The values of a patient case that stages hand to each other: frozen, checked, no files.

An image and everything made from it lies on one axis-aligned grid in LPS. Anatomy is kept as *level
images*: positive inside, negative outside, zero on the surface between voxels, so that a surface is
known better than its voxels and cutting a bone by a plane is a minimum of two numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.checks import (
    Floats,
    as_number,
    as_rows,
    as_text,
    check_instance,
    check_one_of,
    frozen,
)
from cmfsim.errors import CaseInputError
from cmfsim.values.frozen import Frozen
from cmfsim.values.scene import SurfaceData

__all__ = [
    "LIPS",
    "NODE_KINDS",
    "SEVERITIES",
    "SHEET_DEPTH",
    "Anatomy",
    "BoneSegment",
    "DentalArch",
    "Finding",
    "ImageData",
    "LipRegion",
    "NodeKinds",
]

SEVERITIES = ("error", "warning", "note")
# Kinds of node (paper 2.5), by the number that files hold.
NODE_KINDS = ("free", "fixed", "joined", "sliding")
JAWS = ("upper", "lower")
LIPS = ("upper", "lower")
# Half the width, and the length, of the smallest arch, mm: less is landmarks exchanged or in cm.
LEAST_ARCH = 2.0
# How far a node that slides lies from its contact sheet at most, mm: what lies deeper behind is on
# another face of the bone, on the palate or where teeth bite.
SHEET_DEPTH = 2.5


@dataclass(frozen=True, eq=False)
class ImageData(Frozen):
    """A scalar image on an axis-aligned grid: values[i, j, k] lies at origin + (i, j, k)·spacing.

    Attributes
    ----------
    values : (nx, ny, nz) array of real numbers
        Axes along +L, +P, +S. Kept as given, without a copy; treated as read-only.
    spacing : (3,) float64, mm
    origin : (3,) float64, mm
        Centre of voxel (0, 0, 0), LPS.

    Raises
    ------
    CaseError
        (also `ValueError`) Not three axes, an empty axis, spacing not positive, NaN or infinity in
        spacing or origin.

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> image = cmfsim.ImageData(np.zeros((4, 5, 6)), spacing=(1, 1, 2), origin=(0, 0, 10))
    >>> image.highest.tolist()
    [3.0, 4.0, 20.0]
    """

    values: NDArray[Any]
    spacing: ArrayLike
    origin: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        values = np.asarray(self.values)
        if values.ndim != 3 or 0 in values.shape:
            raise CaseInputError(f"image has shape {values.shape}: three axes, none empty, needed")
        if values.dtype.kind not in "fiub":
            raise CaseInputError(f"image has dtype {values.dtype}: real numbers are needed")
        spacing = as_rows("image spacing", np.reshape(self.spacing, (1, -1)), 3)[0]
        if (spacing <= 0.0).any():
            raise CaseInputError(f"image spacing is {spacing.tolist()} mm: must be above 0")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "spacing", spacing)
        object.__setattr__(
            self, "origin", as_rows("image origin", np.reshape(self.origin, (1, -1)), 3)[0]
        )

    @property
    def lowest(self) -> Floats:
        """Centre of the first voxel, (3,) mm."""
        return cast("Floats", self.origin)

    @property
    def highest(self) -> Floats:
        """Centre of the last voxel, (3,) mm."""
        steps = np.array(self.values.shape) - 1
        return cast("Floats", self.lowest + steps * np.asarray(self.spacing))

    def with_values(self, values: NDArray[Any]) -> "ImageData":
        """Other values on the same grid."""
        if np.shape(values) != self.values.shape:
            raise CaseInputError(f"values have shape {np.shape(values)}, not {self.values.shape}")
        return ImageData(values, self.spacing, self.origin)

    def axes(self) -> tuple[Floats, Floats, Floats]:
        """The coordinates of the voxel centres along each axis, mm, shaped to broadcast."""
        x, y, z = (
            o + s * np.arange(n)
            for o, s, n in zip(
                self.lowest, np.asarray(self.spacing), self.values.shape, strict=True
            )
        )
        return x[:, None, None], y[None, :, None], z[None, None, :]

    def sample(self, points: ArrayLike) -> Floats:
        """The values at points, trilinear; beyond the border those of the nearest border point.

        Parameters
        ----------
        points : (n, 3) float64, mm

        Returns
        -------
        (n,) float64
        """
        shape = np.array(self.values.shape)
        place = (as_rows("points", points, 3) - self.lowest) / np.asarray(self.spacing)
        place = np.clip(place, 0.0, shape - 1.0)
        low = np.minimum(place.astype(np.intp), np.maximum(shape - 2, 0))
        part = place - low
        high = np.minimum(low + 1, shape - 1)
        total = np.zeros(len(place))
        for corner in range(8):
            ends = [(corner >> axis) & 1 for axis in range(3)]
            index = tuple((high if end else low)[:, axis] for axis, end in enumerate(ends))
            weight = np.prod(
                [part[:, a] if end else 1.0 - part[:, a] for a, end in enumerate(ends)], axis=0
            )
            total += weight * self.values[index]
        return total


@dataclass(frozen=True)
class Finding:
    """Something that a person should know before trusting a case.

    Attributes
    ----------
    severity : str
        "error" (the work cannot go on), "warning" (the result may be wrong), "note".
    code : str
        Short stable name, such as "ct-spacing-coarse".
    what : str
        The fact, with its figure.
    where : str
        File, table, place in mm.
    why : str
        What it does to the result.
    mend : str
        What to do.
    """

    severity: str
    code: str
    what: str
    where: str = ""
    why: str = ""
    mend: str = ""

    def __post_init__(self) -> None:
        check_one_of("severity", self.severity, SEVERITIES)
        as_text("finding code", self.code)
        as_text("finding", self.what)


@dataclass(frozen=True, eq=False)
class Anatomy(Frozen):
    """A head as level images on one grid: positive inside, zero on the surface.

    Attributes
    ----------
    skin : ImageData
        Inside the outer skin, bones and hollows included; float32. Its size is clipped, so it is a
        distance nowhere but near zero, and there only up to a factor.
    bones : mapping of str to ImageData
        Each bone with the hollows that it encloses (cranial cavity, sinuses, marrow): "cranium" and
        "mandible", or "skull" where they were not parted.
    air : ImageData or None
        Hollows inside the skin that no bone encloses: airway, nasal and oral cavity.
    teeth : ImageData or None
        Teeth and what lies with them, where they could be told from bone.
    findings : tuple of Finding
    surfaces : mapping of str to SurfaceData
        The surfaces that levels were made from ("skin" and bones), where surfaces were given.
    """

    skin: ImageData
    bones: Mapping[str, ImageData]
    air: ImageData | None = None
    teeth: ImageData | None = None
    findings: tuple[Finding, ...] = ()
    surfaces: Mapping[str, SurfaceData] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_instance("skin", self.skin, ImageData)
        others = {f"bone {name!r}": level for name, level in self.bones.items()}
        others |= {n: v for n, v in (("air", self.air), ("teeth", self.teeth)) if v is not None}
        for name, level in others.items():
            check_instance(name, level, ImageData)
            same = (
                level.values.shape == self.skin.values.shape
                and np.array_equal(level.lowest, self.skin.lowest)
                and np.array_equal(np.asarray(level.spacing), np.asarray(self.skin.spacing))
            )
            if not same:
                raise CaseInputError(f"{name} lies on another grid than the skin")
        object.__setattr__(self, "bones", MappingProxyType(dict(self.bones)))
        object.__setattr__(self, "surfaces", MappingProxyType(dict(self.surfaces)))


@dataclass(frozen=True, eq=False)
class BoneSegment(Frozen):
    """A piece of bone that moves as one, or that stays.

    Attributes
    ----------
    name : str
        "cranium", "maxilla", "mandible_body", "ramus_left", "chin", …
    level : ImageData
        Positive inside; on the grid of the anatomy.
    surface : SurfaceData
        Its surface, outward normals; the contact surface of nodes that slide on it.
    """

    name: str
    level: ImageData
    surface: SurfaceData

    def __post_init__(self) -> None:
        as_text("segment name", self.name)
        check_instance(f"level of segment {self.name!r}", self.level, ImageData)
        check_instance(f"surface of segment {self.name!r}", self.surface, SurfaceData)


@dataclass(frozen=True, eq=False)
class DentalArch(Frozen):
    """Where the teeth of one jaw stand.

    Attributes
    ----------
    jaw : str
        "upper" or "lower".
    tip, left, right : (3,) float64, mm
        On the alveolar bone: between the central incisors, and at the second molars (`supradentale`
        and `supra_m2`, or `infradentale` and `sub_m2`).
    out : (3,) float64
        Unit vector from the bite to the roots of this arch.
    depth_front, depth_molars : float, mm
        From `tip`, and from the middle between `left` and `right`, to the other arch's, against
        `out`: the edges of the teeth lie about half-way.

    Raises
    ------
    CaseError
        (also `ValueError`) Not three finite numbers, or places that span no arch.
    """

    jaw: str
    tip: ArrayLike
    left: ArrayLike
    right: ArrayLike
    out: ArrayLike
    depth_front: float
    depth_molars: float

    def __post_init__(self) -> None:
        check_one_of("jaw", self.jaw, JAWS)
        for name in ("tip", "left", "right", "out"):
            value = as_rows(f"{self.jaw} arch: {name}", np.reshape(getattr(self, name), (1, -1)), 3)
            object.__setattr__(self, name, value[0])
        for name in ("depth_front", "depth_molars"):
            as_number(f"{self.jaw} arch: {name}", getattr(self, name))
        axes = self.axes()
        tip, left, right = (np.asarray(place) for place in (self.tip, self.left, self.right))
        if self.half_width < LEAST_ARCH or float(axes[1] @ (tip - self.middle)) < LEAST_ARCH:
            raise CaseInputError(
                f"{self.jaw} arch: its front {tip.round(1).tolist()} and its molars "
                f"{left.round(1).tolist()} and {right.round(1).tolist()} mm span "
                f"no arch: the front lies ahead of the molars, and these apart, by {LEAST_ARCH:g} "
                "mm at least; are landmarks exchanged?"
            )

    @property
    def middle(self) -> Floats:
        """Half-way between the molars, (3,) mm."""
        return np.asarray(0.5 * (np.asarray(self.left) + np.asarray(self.right)))

    @property
    def half_width(self) -> float:
        """Half the distance between the molars, mm."""
        return 0.5 * float(np.linalg.norm(np.asarray(self.left) - np.asarray(self.right)))

    def axes(self) -> Floats:
        """Unit vectors to the left, ahead, and along `out`, as rows (3, 3).

        The last two are at right angles to the first, but not quite to each other: `ahead` is.
        """
        out = np.asarray(self.out)
        across = np.asarray(self.left) - np.asarray(self.right)
        across = across / max(float(np.linalg.norm(across)), np.finfo(float).tiny)
        ahead = np.asarray(self.tip) - self.middle
        ahead = ahead - (ahead @ across) * across - (ahead @ out) * out
        ahead = ahead / max(float(np.linalg.norm(ahead)), np.finfo(float).tiny)
        return np.stack([across, ahead, out])


@dataclass(frozen=True, eq=False)
class NodeKinds(Frozen):
    """What each node of a mesh does (paper 2.5, Figure 4).

    Attributes
    ----------
    kind : (n,) uint8
        0 free, 1 fixed, 2 joined, 3 sliding: the order of `NODE_KINDS` in scene files.
    segment : (n,) int16
        Index into `segments` of the nodes that lie on a segment: joined, sliding, and those that
        are fixed on bone; −1 elsewhere.
    segments : tuple of str
    """

    kind: NDArray[np.uint8]
    segment: NDArray[np.int16]
    segments: tuple[str, ...]

    def __post_init__(self) -> None:
        kind = np.asarray(self.kind, dtype=np.uint8)
        segment = np.asarray(self.segment, dtype=np.int16)
        if kind.ndim != 1 or segment.shape != kind.shape:
            raise CaseInputError(f"kind has shape {kind.shape}, segment {segment.shape}: (n,) both")
        bad = np.flatnonzero((kind > 3) | ((kind >= 2) & (segment < 0)))
        if len(bad) or (segment >= len(self.segments)).any():
            raise CaseInputError("kind is 0 to 3, and joined and sliding nodes need a segment")
        object.__setattr__(self, "kind", frozen(kind))
        object.__setattr__(self, "segment", frozen(segment))

    def nodes(self, kind: str, segment: str | None = None) -> NDArray[np.uint32]:
        """The indices of the nodes of a kind ("free", "fixed", "joined", "sliding")."""
        check_one_of("kind", kind, NODE_KINDS)
        chosen = self.kind == NODE_KINDS.index(kind)
        if segment is not None:
            check_one_of("segment", segment, self.segments)
            chosen &= self.segment == self.segments.index(segment)
        return np.flatnonzero(chosen).astype(np.uint32)


@dataclass(frozen=True, eq=False)
class LipRegion(Frozen):
    """One lip on the boundary of a mesh that was separated between the lips.

    Attributes
    ----------
    triangles : (t, 3) uint32
        Skin and red of the lip, the face that it turns to the other lip, and the one towards the
        teeth: mesh nodes, outward, one connected patch from corner to corner of the mouth.
    nodes : (n,) uint32
        Free nodes of the triangles that the other lip has not, ascending.
    released : mapping of str to (k,) uint32
        Those of the nodes that lie on a segment and would slide on it, by segment: they may lift
        off.
    """

    triangles: NDArray[np.uint32]
    nodes: NDArray[np.uint32]
    released: Mapping[str, NDArray[np.uint32]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("triangles", "nodes"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), np.uint32)))
        object.__setattr__(self, "released", MappingProxyType(dict(self.released)))
