"""Equivalent material: the muscle fraction and fibre of every tet, and how materials are mixed.

Kim et al. (2010), section 2.3; Uesu et al. (2005).
"""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from cmfsim import _core
from cmfsim._core import PRESETS, MuscleFibres, MuscleShares, Surface, TetMesh, Tissue
from cmfsim.errors import MaterialInputError, MeshError, MeshInputError
from cmfsim.values.checks import Floats, check_instance, check_one_of, frozen, nearest
from cmfsim.values.finding import Finding
from cmfsim.values.moduli import MuscleModuli, TissueModuli, moduli_unusual
from cmfsim.values.musculature import MuscleSurface
from cmfsim.values.surface_data import SurfaceData
from cmfsim.values.tissue_data import DEFAULT_PRESET, MIXINGS, TissueData

MODULI_CODES = frozenset({"muscle-moduli", "moduli-unusual"})


def _tissue(
    shares: MuscleShares, names: Sequence[str], moduli: TissueModuli, preset: str, mixing: str
) -> tuple[Tissue, TissueData | None]:
    """The tissue of every tet, and the arrays that a scene takes for it unless it has others.

    With the share p_i of muscle i in the tet and p = Σ p_i: "moduli" mixes
    E = E_fat (1 − p) + Σ p_i E_i along and across the mean fibre, and ν likewise; "stiffness" mixes
    C = C_fat (1 − p) + Σ p_i C_i(a_i). Both are the rules of the presets where all E_i are equal.
    Arrays are None for "stiffness", whose are those of the tissue, and for a preset.
    """
    if moduli.is_preset(preset):
        return shares.tissue(preset, mixing=mixing), None
    moduli = moduli.resolved(preset)
    rows = [moduli.muscles.get(name, moduli.muscle) for name in names]
    table = np.array([row.constants() for row in rows], dtype=np.float64).reshape(-1, 3)
    young, poisson = moduli.fat.constants()
    if mixing == "stiffness":
        return _by_stiffness(shares, table, Tissue.isotropic(young, poisson)), None
    tets, muscles, _, share, _ = shares.shares
    p = shares.fraction

    def mixed(of_fat: float, column: int) -> Floats:
        of_muscle = np.bincount(tets, weights=share * table[muscles, column], minlength=len(p))
        mean: Floats = of_fat * (1.0 - p) + of_muscle
        return mean

    along, across, ratio = mixed(young, 0), mixed(young, 1), mixed(poisson, 2)
    # Fat has no direction; any unit vector serves.
    fibre = np.where(p[:, np.newaxis] > 0.0, shares.fibre, [1.0, 0.0, 0.0])
    data = TissueData(
        "transversely_isotropic", young_along=along, young_across=across, poisson=ratio, fibre=fibre
    )
    return Tissue.transversely_isotropic(along, across, ratio, fibre), data


def _by_stiffness(shares: MuscleShares, table: Floats, fat: Tissue) -> Tissue:
    tets, muscles, _, share, fibre = shares.shares
    n_tets = len(shares.fraction)
    rest = np.maximum(1.0 - np.bincount(tets, weights=share, minlength=n_tets), 0.0)
    sums = rest[:, np.newaxis, np.newaxis] * fat.stiffness()[0]
    if len(tets):
        along, across, poisson = table[muscles].T.copy()
        each = Tissue.transversely_isotropic(along, across, poisson, fibre).stiffness()
        np.add.at(sums, tets, share[:, np.newaxis, np.newaxis] * each)
    return Tissue.from_stiffness(sums)


def check_muscle_names(moduli: TissueModuli, names: Sequence[str]) -> None:
    """`MaterialError`, with the nearest name, for moduli of a muscle that is not there."""
    for name in moduli.muscles:
        if name not in names:
            known = ", ".join(names) or "none"
            raise MaterialInputError(
                f"moduli are given for the muscle {name!r}, which does not "
                f"exist{nearest(name, tuple(names))} (muscles: {known})"
            )


def moduli_findings(moduli: TissueModuli, preset: str, where: str = "") -> Iterator[Finding]:
    """A note of moduli that are not the preset's; a warning of those that no muscle has."""
    if moduli.is_preset(preset):
        return
    own = moduli.resolved(preset)
    named: Mapping[str, MuscleModuli] = {"muscle": own.muscle, **own.muscles}
    stated = ["fat {:g} (poisson {:g})".format(*own.fat.constants())]
    stated += [
        "{} {:g} along and {:g} across (poisson {:g})".format(name, *m.constants())
        for name, m in named.items()
    ]
    yield Finding(
        "muscle-moduli",
        f"moduli differ from those of {preset}, MPa: {'; '.join(stated)}",
        where=where,
    )
    yield from moduli_unusual({"fat": own.fat, **named}, where)


INSIDE_TESTS = ("winding", "normal")
# Fraction of a closed muscle that may be outside the mesh before a finding reports it.
LOST_PART = 0.02

_log = logging.getLogger(__name__)


class HasMuscles(Protocol):
    """Anything that holds muscles: a `Musculature`, a morphed template."""

    @property
    def muscles(self) -> Sequence[MuscleSurface]:
        """The muscles."""


# What muscles are given as.
Muscle = MuscleSurface | SurfaceData | Surface
Muscles = HasMuscles | Sequence[Muscle]


@dataclass(frozen=True, eq=False)
class PreparedMuscles:
    """Muscles with what is found on each, in the same order, before a mesh is known."""

    named: Mapping[str, Muscle]
    ready: Sequence[tuple[Surface, MuscleFibres]]


def prepared_muscles(muscles: Muscles) -> PreparedMuscles:
    """The muscles with search trees and fibres; raises as `equivalent_material`."""
    return _prepared(_named(muscles))


def _prepared(named: Mapping[str, Muscle]) -> PreparedMuscles:
    with ThreadPoolExecutor() as pool:  # most of the work is the core's, without the GIL
        return PreparedMuscles(named, tuple(pool.map(_ready, named, named.values())))


@dataclass(frozen=True)
class MuscleVolume:
    """Volumes of one muscle.

    Attributes
    ----------
    inside : float, mm³
        Inside the muscle and the mesh.
    shared : float, mm³
        The same, but where k muscles overlap each counts 1/k, so that the sum is the muscle in the
        mesh.
    error : float, mm³
        Standard error of `inside`, from those of the tets' fractions.
    enclosed : float or None, mm³
        Volume enclosed by the surface, in the mesh or not; parts that overlap count twice. None if
        it is not closed.
    """

    inside: float
    shared: float
    error: float
    enclosed: float | None


@dataclass(frozen=True, eq=False)
class Mixture:
    """The effect of muscles on the tets of a mesh.

    Attributes
    ----------
    fraction : (m,) float64
        Volume fraction of muscle, 0 to 1; where muscles overlap they count once.
    fibre : (m, 3) float64
        Unit vectors, zero where there is no muscle; the component of largest size is positive.
    coherence : (m,) float64
        How dominant one direction is in the tet: 1 for parallel fibres, 0 for none (then the fibre
        is that of the first of the muscles, in an order that depends on their shapes).
    error : (m,) float64
        Standard error of `fraction`, 0.7 q^(1/3) samples^(−2/3) with q = min(p, 1−p), where the
        surface is smooth over the tet; that of as many random points, √(p(1−p)/samples), at most.
        0 where no surface crosses.
    tissue : Tissue
    volumes : mapping of str to MuscleVolume
        By the muscle's name, in the order given.
    samples : int
        Points that were tested against a muscle.
    findings : tuple of Finding
        Muscles that are inside out, open, outside the mesh, sheets.
    summary : mapping
        Preset, mixing, moduli, inside test, seed, samples per crossed tet, counts of work.
    timings : mapping of str to float, s
    """

    fraction: Floats
    fibre: Floats
    coherence: Floats
    error: Floats
    tissue: Tissue
    volumes: Mapping[str, MuscleVolume]
    samples: int
    findings: tuple[Finding, ...]
    summary: Mapping[str, Any]
    timings: Mapping[str, float]
    shares: _core.MuscleShares
    # The arrays of the tissue where moduli that are not the preset's are mixed one by one.
    mixed: TissueData | None = None

    @cached_property
    def tissue_data(self) -> TissueData:
        """The tissue as a `Scene` takes it."""
        if self.mixed is not None:
            return self.mixed
        if self.summary["mixing"] == "stiffness":
            return TissueData("stiffness", stiffness=self.tissue.stiffness())
        return TissueData(
            "preset", preset=self.summary["preset"], fraction=self.fraction, fibre=self.fibre
        )

    def muscle_fraction(self, name: str) -> Floats:
        """The volume fraction of one muscle in each tet, (m,) float64, overlaps shared.

        Raises
        ------
        KeyError
            No muscle of that name; the text lists them.
        """
        names = list(self.volumes)
        if name not in names:
            raise KeyError(f"no muscle {name!r}; there are: {', '.join(names) or 'none'}")
        tets, muscles, _, shares, _ = self.shares.shares
        chosen = muscles == names.index(name)
        fraction = np.zeros(len(self.fraction))
        fraction[tets[chosen]] = shares[chosen]
        return fraction


def equivalent_material(
    mesh: TetMesh,
    muscles: Muscles | PreparedMuscles,
    *,
    preset: str = DEFAULT_PRESET,
    samples: int = 64,
    seed: int = 0,
    mixing: str = "moduli",
    inside: str = "winding",
    moduli: TissueModuli | None = None,
) -> Mixture:
    """The tissue of every tet, fat and muscle mixed by volume.

    A tet that no muscle's surface crosses is decided by one evaluation, many neighbouring tets at
    once, and without evaluation if no muscle is near. A crossed tet takes `samples` points of a
    low-discrepancy sequence, uniform in volume, with a different shift for each tet. A point inside
    several muscles counts once in the fraction; each of k muscles gets 1/k of it. The fibre of a
    tet is the principal eigenvector of Σ w a aᵀ over the directions a at its points in muscle, the
    first 16 in each, with these weights w. The result does not depend on the number of threads nor
    on the order of the muscles.

    Parameters
    ----------
    mesh : TetMesh
    muscles : Musculature, morphed template, or sequence of MuscleSurface, SurfaceData or Surface
        Without a name they are called "muscle_0", "muscle_1", ... Without any muscle, the tissue is
        homogeneous fat, with a finding. Also the result of `prepared_muscles`.
    preset : str
        One of `PRESETS`: constants of fat and muscle.
    samples : int
        Points in each tet that a surface crosses, 1 to 1048576.
    seed : int
        Of the points' shifts, 0 or more.
    mixing : str
        "moduli": Young's moduli and Poisson's ratio mix with the fraction (the paper); "stiffness":
        C = Σ p_i C(a_i) + (1 − Σ p_i) C_fat with the share p_i and fibre a_i of each muscle.
    inside : str
        "winding": the generalised winding number exceeds ½, which is also correct for surfaces that
        overlap or have small holes or a few flipped triangles; "normal": the closest normal points
        away (the paper), which is correct for closed surfaces that do not overlap themselves.
    moduli : TissueModuli, optional
        Moduli (MPa) of fat, of all muscles or of single ones instead of the preset's.

    Raises
    ------
    MaterialError
        (also `ValueError`) Unknown preset, mixing or inside test; samples or seed out of range;
        moduli for a muscle that is not there.
    MeshError
        (also `ValueError`) A muscle that is no surface, has degenerate triangles or no direction,
        with its name.

    Notes
    -----
    Kim et al. (2010), section 2.3; Uesu et al. (2005); winding number: Barill et al. (2018).

    Examples
    --------
    >>> import cmfsim, numpy as np
    >>> mesh = cmfsim.mesh_from_labels(np.ones((9, 9, 9)) > 0, spacing=1.0)
    >>> x, y, z = np.mgrid[0:2, 0:2, 0:2].reshape(3, -1) * 4.0 + 1.0
    >>> corners = np.column_stack([x, y, 0.5 * z])
    >>> quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    >>> triangles = [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])]
    >>> mixture = cmfsim.equivalent_material(mesh, [cmfsim.SurfaceData(corners, triangles)])
    >>> abs(mixture.volumes["muscle_0"].inside - 4 * 4 * 2) < 0.5
    True
    """
    check_instance("mesh", mesh, TetMesh)
    check_one_of("preset", preset, PRESETS, MaterialInputError)
    check_one_of("mixing", mixing, MIXINGS, MaterialInputError)
    check_one_of("inside", inside, INSIDE_TESTS, MaterialInputError)
    given = TissueModuli() if moduli is None else moduli
    check_instance("moduli", given, TissueModuli)
    start = time.perf_counter()
    named = muscles.named if isinstance(muscles, PreparedMuscles) else _named(muscles)
    check_muscle_names(given, list(named))
    ready = (muscles if isinstance(muscles, PreparedMuscles) else _prepared(named)).ready
    surfaces_done = time.perf_counter()
    shares = _core.sample_muscles(mesh, ready, samples=samples, seed=seed, inside=inside)
    tissue_start = time.perf_counter()
    tissue, mixed = _tissue(shares, list(named), given, preset, mixing)
    end = time.perf_counter()
    columns = [shares.volumes[key] for key in ("inside", "shared", "error", "enclosed")]
    volumes = {name: MuscleVolume(*row) for name, *row in zip(named, *columns, strict=True)}
    summary = {
        "preset": preset,
        "mixing": mixing,
        "moduli": given.resolved(preset).as_dict(),
        "inside": inside,
        "samples_per_crossed_tet": int(samples),
        "seed": int(seed),
        "muscles": len(volumes),
        # Not by BLAS: the last bit of its sums depends on the number of threads.
        "muscle_volume": float(np.sum(shares.fraction * mesh.volumes)),
        "muscle_tets": int(np.count_nonzero(shares.fraction)),
        **shares.counts,
    }
    timings = {"surfaces": surfaces_done - start, **shares.timings}
    timings |= {"tissue": end - tissue_start, "total": end - start}
    points = shares.counts["points"]
    _log.info("muscle in %d of %d tets, %d points", summary["muscle_tets"], mesh.n_tets, points)
    return Mixture(
        fraction=frozen(shares.fraction),
        fibre=frozen(shares.fibre),
        coherence=frozen(shares.coherence),
        error=frozen(shares.error),
        tissue=tissue,
        volumes=MappingProxyType(volumes),
        samples=points,
        findings=(*_findings(volumes, shares, ready), *moduli_findings(given, preset)),
        summary=MappingProxyType(summary),
        timings=MappingProxyType(timings),
        shares=shares,
        mixed=mixed,
    )


def _named(muscles: Muscles) -> dict[str, Muscle]:
    """The muscles by their names, which differ."""
    named: dict[str, Muscle] = {}
    listed = getattr(muscles, "muscles", muscles)
    if isinstance(listed, Muscle) or not isinstance(listed, Sequence):
        found = type(muscles).__name__
        raise MeshInputError(
            f"muscles is of type {found}: a Musculature, a morphed template or a sequence of "
            "MuscleSurface, SurfaceData or Surface is needed"
        )
    for i, muscle in enumerate(listed):
        if not isinstance(muscle, Muscle):
            raise MeshInputError(
                f"muscles[{i}] is of type {type(muscle).__name__}: a MuscleSurface, SurfaceData or "
                "Surface is needed"
            )
        name = muscle.name if isinstance(muscle, MuscleSurface) else f"muscle_{i}"
        if name in named:
            raise MeshInputError(f"muscles[{i}] is a second {name!r}: names must differ")
        named[name] = muscle
    return named


def _ready(name: str, muscle: Muscle) -> tuple[Surface, MuscleFibres]:
    """The surface and the fibres of a muscle, ready for the core."""
    try:
        if isinstance(muscle, MuscleSurface):
            return muscle.surface.searched, muscle.fibres()
        surface = muscle if isinstance(muscle, Surface) else muscle.searched
        return surface, MuscleFibres(surface)
    except MeshError as error:
        raise MeshInputError(f"muscle {name!r}: {error}") from error


def _findings(
    volumes: Mapping[str, MuscleVolume],
    shares: MuscleShares,
    ready: Sequence[tuple[Surface, MuscleFibres]],
) -> Iterator[Finding]:
    if not volumes:
        yield Finding("muscles-none")
    for (name, volume), was_turned, (surface, fibres) in zip(
        volumes.items(), shares.volumes["was_turned"], ready, strict=True
    ):
        if was_turned:
            yield Finding(
                "surface-repaired",
                f"the surface of {name} was inside out and has been flipped",
                where=name,
            )
        if volume.enclosed is None:
            yield Finding(
                "surface-open",
                f"the surface of {name} is not closed: {surface.n_border_edges} border edges",
                severity="note",
                where=name,
                why="Points with a winding number above one half count as inside, which bridges "
                "holes.",
                fix="close the surface in the template",
            )
        if volume.inside == 0.0:
            yield Finding("muscle-missed", f"{name} contains no sample of any tet", where=name)
        elif volume.enclosed is not None:
            lost = 1.0 - volume.inside / volume.enclosed
            if lost > LOST_PART and lost * volume.enclosed > 3.0 * volume.error:
                yield Finding(
                    "muscle-does-not-fit",
                    f"{lost:.1%} of {name} lies outside the mesh or in its own overlaps",
                    where=name,
                )
        if fibres.is_sheet:
            yield Finding(
                "muscle-sheet",
                f"{name} is a sheet: second extent {fibres.sheet_ratio:.2f} of the first",
                where=name,
            )
