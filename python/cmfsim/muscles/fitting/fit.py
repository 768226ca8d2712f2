"""Muscles of a template, mapped to a patient by landmarks, then moved into the tissue."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface
from cmfsim.errors import MeshError, MeshInputError
from cmfsim.muscles.fitting.room import Room
from cmfsim.muscles.fitting.solving import Lattice, Problem, Targets, Volumes
from cmfsim.muscles.template.muscle_template import MorphedMusculature
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.musculature import MuscleSurface
from cmfsim.values.surface_data import SurfaceData

# Spacing of the displacement's coefficients, mm: the width of a strap muscle. With a finer one, a
# thin muscle follows every voxel of bone; with a coarser one, it cannot follow the zygomatic arch.
SPACING = 10.0
# One point of a muscle's surface in each cube of this edge is moved into the tissue, mm.
POINT_SPACING = 3.0
# Points that measure the share of a muscle outside the tissue: standard error at most 2.5 %.
SAMPLES = 400
# Distance up to which a muscle counts as attached to the template's bone, mm.
ATTACHED = 1.0
# Depth inside bone that a muscle may keep if it is inside the template's bone, mm: a CT voxel.
MOST_DEPTH = 1.0
# Smallest and largest stretch of space that a fit may have; beyond them, space is made stiffer.
STRETCHES = (0.5, 1.6)
STIFFER = 3.0
MOST_TRIES = 4
# Change of a muscle's volume beyond which it is reported.
VOLUME_CHANGE = 0.05
# Share of a muscle outside the tissue beyond which it is reported as not fitting.
STILL_OUTSIDE = 0.15


@dataclass(frozen=True)
class FittedMuscle:
    """The effect of a fit on one muscle.

    Attributes
    ----------
    outside_before, outside_after : float
        Share of its volume in bone, in air or outside the skin, within the field of view; the
        standard error is at most 0.02.
    unseen : float
        Share of its volume outside the field of view, where the tissue is unknown.
    volume_before, volume_after : float, mm³
    largest_move : float, mm
    """

    outside_before: float
    outside_after: float
    unseen: float
    volume_before: float
    volume_after: float
    largest_move: float

    @property
    def volume_change(self) -> float:
        """Relative change of its volume."""
        return self.volume_after / self.volume_before - 1.0


@dataclass(frozen=True, eq=False)
class MuscleFit:
    """Muscles in the tissue of a patient.

    Attributes
    ----------
    musculature : MorphedMusculature
        Surfaces and fibre courses are moved; everything else is unchanged.
    muscles : mapping of str to FittedMuscle
    stretches : (2,) tuple of float
        The least and the largest principal stretch of space at the muscles.
    stiffness : float
        Factor on the strain energy that kept the stretches within bounds.
    findings : tuple of Finding
    seconds : float
    """

    musculature: MorphedMusculature
    muscles: Mapping[str, FittedMuscle]
    stretches: tuple[float, float]
    stiffness: float
    findings: tuple[Finding, ...]
    seconds: float

    @property
    def helps(self) -> bool:
        """Whether less of the muscles is outside the tissue than before, without folding space."""
        before, after = (_summed(self.muscles, f"outside_{w}") for w in ("before", "after"))
        return after < before and self.stretches[0] > 0.0

    def summary(self) -> dict[str, Any]:
        """Shares, volumes and stretches as plain values: for `build.json`."""
        return {
            "outside_before": _summed(self.muscles, "outside_before"),
            "outside_after": _summed(self.muscles, "outside_after"),
            "stretches": list(self.stretches),
            "stiffness": self.stiffness,
            "seconds": self.seconds,
            "muscles": {
                name: {
                    "outside_before": m.outside_before,
                    "outside_after": m.outside_after,
                    "unseen": m.unseen,
                    "volume_change": m.volume_change,
                    "largest_move": m.largest_move,
                }
                for name, m in self.muscles.items()
            },
        }


def fit_muscles(morphed: MorphedMusculature, anatomy: Anatomy) -> MuscleFit:
    """Muscles moved out of bone, air and skin, by one smooth displacement of space for all.

    Points on their surfaces are pulled into the tissue, and those on the template's bone towards
    the patient's bone. Space resists strain and bending, and each muscle resists a change of its
    volume. Because one displacement moves all muscles, those that were separate stay separate, and
    no triangle is inverted unless space folds: this is checked, and space made stiffer if it does.

    Parameters
    ----------
    morphed : MorphedMusculature
        Result of `MuscleTemplate.morph`, in the frame of the anatomy.
    anatomy : Anatomy

    Returns
    -------
    MuscleFit

    Raises
    ------
    MeshError
        (also `ValueError`) A muscle that is not a valid surface.

    Notes
    -----
    Free-form deformation by B-splines: Rueckert et al. (1999), with quadratic splines. Landmarks
    are not fixed: they lie on bone, where there is no muscle.

    Examples
    --------
    >>> import cmfsim
    >>> head = cmfsim.make_head()
    >>> template = cmfsim.MuscleTemplate.load("default")
    >>> muscles = template.morph(head.skull_landmarks)
    >>> fit = cmfsim.fit_muscles(muscles, head.anatomy(3.0))
    """
    begun = time.perf_counter()
    vertices = np.concatenate([m.surface.vertices for m in morphed.muscles])
    volumes = Volumes.of([m.surface for m in morphed.muscles])
    samples = [_samples(i, muscle) for i, muscle in enumerate(morphed.muscles)]
    courses = [line for muscle in morphed.muscles for line in muscle.course]
    lattice = Lattice.round(np.concatenate([vertices, *samples, *courses]), SPACING)
    room = Room.of(anatomy, vertices)
    basis = lattice.basis(vertices)
    targets = _targets(morphed, volumes.begins)
    problem = Problem(vertices, volumes, targets, room, lattice, basis)
    watched = np.concatenate([vertices[targets.vertices], *samples])
    found, stretches, stiffness = _bounded(problem, watched)

    def moved(points: Floats) -> Floats:
        moved: Floats = points + lattice.basis(points) @ found
        return moved

    after = vertices + basis @ found
    muscles = tuple(
        replace(
            muscle,
            surface=replace(muscle.surface, vertices=volumes.part(after, i)),
            course=tuple(moved(line) for line in muscle.course),
        )
        for i, muscle in enumerate(morphed.muscles)
    )
    done = _compared(problem, after, [(inside, moved(inside)) for inside in samples], muscles)
    findings = tuple(_findings(done))
    return MuscleFit(
        replace(morphed, muscles=muscles, findings=(*morphed.findings, *findings), is_fitted=True),
        MappingProxyType(done),
        stretches,
        stiffness,
        findings,
        time.perf_counter() - begun,
    )


def _compared(
    problem: Problem,
    after: Floats,
    samples: Sequence[tuple[Floats, Floats]],
    muscles: Sequence[MuscleSurface],
) -> dict[str, FittedMuscle]:
    """The effect on each muscle, from its vertices and from points inside it, before and after."""
    volumes, room = problem.volumes, problem.room
    first, last = volumes.enclosed(problem.vertices), volumes.enclosed(after)
    moves = np.linalg.norm(after - problem.vertices, axis=1)
    done = {}
    for i, (muscle, (inside, moved)) in enumerate(zip(muscles, samples, strict=True)):
        known = room.known(inside)
        done[muscle.name] = FittedMuscle(
            _outside(room, inside[known]),
            _outside(room, moved[known]),
            float(1.0 - known.mean()) if len(known) else 0.0,
            abs(float(first[i])),
            abs(float(last[i])),
            float(volumes.part(moves, i).max()),
        )
    return done


def _bounded(problem: Problem, points: Floats) -> tuple[Floats, tuple[float, float], float]:
    """A displacement, its stretches at some points, and the stiffness that keeps them in bounds."""
    stiffness = 1.0
    for _ in range(MOST_TRIES):
        found = problem.solved(stiffness)
        stretches = _stretches(problem.lattice, found, points)
        if STRETCHES[0] <= stretches[0] and stretches[1] <= STRETCHES[1]:
            break
        stiffness *= STIFFER
    return found, stretches, stiffness


def _outside(room: Room, points: Floats) -> float:
    """The share of points outside the tissue."""
    return float(np.mean(room.tissue.sample(points) < 0.0)) if len(points) else 0.0


def _samples(index: int, muscle: MuscleSurface) -> Floats:
    """Points within a muscle, uniform in its volume; the same in every run."""
    try:
        surface = Surface(muscle.surface.vertices, muscle.surface.triangles)
    except MeshError as error:
        raise MeshInputError(f"muscle {muscle.name!r}: {error}") from error
    vertices = muscle.surface.vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    volume = surface.volume or 0.5 * surface.area
    edge = (abs(volume) / SAMPLES) ** (1.0 / 3.0)
    # One point at random in each cell of a grid.
    cells = np.maximum(np.ceil((high - low) / edge).astype(int), 1)
    corners = np.indices(cells.tolist()).reshape(3, -1).T
    places = corners + np.random.default_rng(index).random(corners.shape)
    points = low + places * (high - low) / cells
    inside = np.abs(surface.winding_number(points)) > 0.5
    inner: Floats = points[inside]
    return inner


def _targets(morphed: MorphedMusculature, begins: Sequence[int]) -> Targets:
    """Vertices of the muscles' surfaces, and their places relative to the template's bone."""
    bone = Surface(morphed.template.skull.vertices, morphed.template.skull.triangles)
    carried = Surface(morphed.skull.vertices, morphed.skull.triangles)
    spread = [_spread(muscle.surface) for muscle in morphed.muscles]
    first, last = (
        np.concatenate([m.surface.vertices[c] for m, (c, _) in zip(muscles, spread, strict=True)])
        for muscles in (morphed.template.muscles, morphed.muscles)
    )
    closest, normals, _ = bone.closest(first)
    height = np.einsum("na,na->n", first - closest, normals)
    apart = np.linalg.norm(first - closest, axis=1)
    return Targets(
        np.concatenate([begin + c for begin, (c, _) in zip(begins, spread, strict=False)]),
        np.concatenate([area for _, area in spread]),
        carried.closest(last)[1],
        (apart < ATTACHED) | (height < 0.0),
        np.clip(-height, 0.0, MOST_DEPTH),
    )


def _spread(surface: SurfaceData) -> tuple[NDArray[np.intp], Floats]:
    """Vertices spread evenly over a surface, and the area that each represents."""
    vertices = surface.vertices
    triangles = surface.triangles.astype(np.intp)
    cross = np.cross(
        vertices[triangles[:, 1]] - vertices[triangles[:, 0]],
        vertices[triangles[:, 2]] - vertices[triangles[:, 0]],
    )
    area = np.linalg.norm(cross, axis=1) / 6.0
    each = np.bincount(triangles.ravel(), np.repeat(area, 3), minlength=len(vertices))
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    cells = np.floor((vertices - middle) / POINT_SPACING).astype(np.int64)
    cells -= cells.min(axis=0)
    # One number for each cell, which ascends as rows of three do and is sorted much faster.
    number = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    _, cell = np.unique(number, return_inverse=True)
    # The vertex nearest to the mean of its cell.
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, vertices[:, a]) / count for a in range(3)], axis=1)
    order = np.lexsort((np.linalg.norm(vertices - mean[cell], axis=1), cell))
    _, start = np.unique(cell[order], return_index=True)
    return order[start], np.asarray(np.bincount(cell, each), dtype=np.float64)


def _stretches(lattice: Lattice, found: Floats, points: Floats) -> tuple[float, float]:
    """Smallest and largest principal stretch of space at points; negative where it folds."""
    slopes: list[Floats] = [lattice.basis(points, axis) @ found for axis in range(3)]
    gradient = np.stack(slopes, axis=2)
    whole = gradient + np.eye(3)
    sizes = np.linalg.svd(whole, compute_uv=False)
    least = sizes[:, 2] * np.sign(np.linalg.det(whole))
    return float(least.min()), float(sizes[:, 0].max())


def _summed(done: Mapping[str, FittedMuscle], name: str) -> float:
    """A share averaged over all muscles, weighted by volume."""
    volume = sum(m.volume_before for m in done.values())
    part = sum(getattr(m, name) * m.volume_before for m in done.values())
    return float(part / volume) if volume else 0.0


def _findings(done: Mapping[str, FittedMuscle]) -> Iterator[Finding]:
    before, after = (_summed(done, f"outside_{when}") for when in ("before", "after"))
    furthest = max(done, key=lambda name: done[name].largest_move)
    yield Finding(
        "muscles-fitted",
        f"muscles were moved into the tissue: {before:.0%} of their volume was in bone, in air "
        f"or outside the skin, now {after:.0%}; the muscle that moved most is {furthest}, by up "
        f"to {done[furthest].largest_move:.1f} mm",
        where="muscles",
    )
    for name, muscle in done.items():
        if muscle.outside_after > STILL_OUTSIDE:
            yield Finding(
                "muscle-does-not-fit",
                f"{muscle.outside_after:.0%} of {name} lies in bone, in air or outside the skin, "
                f"{muscle.outside_before:.0%} before it was moved",
                where=name,
            )
        if abs(muscle.volume_change) > VOLUME_CHANGE:
            yield Finding(
                "muscle-volume-changed",
                f"the volume of {name} changed by {muscle.volume_change:+.0%} as it was moved into "
                "the tissue",
                where=name,
            )
